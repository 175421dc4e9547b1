"""`python tests/floors.py [EXTRA ...]` prints the lowest versions that pyproject.toml allows, for `pip -c`.

`make test-floors` installs these versions and runs tests with them, which verifies the lower bounds. Their
own dependencies are the newest compatible versions, as in an environment that has grown old.
"""

import re
import sys
import tomllib
from pathlib import Path
from typing import Any

PROJECT = Path(__file__).resolve().parents[1] / "pyproject.toml"
_REQUIREMENT = re.compile(r"(?P<name>[\w.-]+)(\[(?P<extras>[\w,-]+)\])?(>=|==)?(?P<version>[\w.]+)?")


def floors(project: dict[str, Any], extras: list[str]) -> dict[str, str]:
    """Returns the lowest version of each package that a `[project]` table and the given extras require.

    Raises:
        ValueError: an extra does not exist, a requirement has no lowest version, or a package has two.
    """
    optional, found, left = project["optional-dependencies"], {}, list(extras)
    requirements = list(project["dependencies"])
    while left:
        if (extra := left.pop()) not in optional:
            raise ValueError(
                f"pyproject.toml: expected one of the extras {', '.join(optional)}, found {extra!r}"
            )
        requirements += optional[extra]
        for requirement in optional[extra]:
            if requirement.startswith(f"{project['name']}["):
                left += _REQUIREMENT.fullmatch(requirement)["extras"].split(",")
    for requirement in requirements:
        parts = _REQUIREMENT.fullmatch(requirement)
        if parts and parts["name"] == project["name"]:
            continue  # the project's own extras, expanded above
        if not parts or not parts["version"]:
            raise ValueError(
                f"pyproject.toml: expected NAME>=VERSION or NAME==VERSION, found {requirement!r}"
            )
        name, version = parts["name"], parts["version"]
        if found.setdefault(name, version) != version:
            raise ValueError(f"pyproject.toml: {name} has two lowest versions, {found[name]} and {version}")
    return found


if __name__ == "__main__":
    project = tomllib.loads(PROJECT.read_text(encoding="utf-8"))["project"]
    sys.stdout.writelines(f"{name}=={version}\n" for name, version in floors(project, sys.argv[1:]).items())
