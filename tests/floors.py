"""Prints the lowest versions that pyproject.toml allows, as constraints for pip.

`make test-floors` installs them and runs tests with them, so that what pyproject.toml promises is true. What
those packages need in turn is the newest that suits them, as in an environment that has grown old.
"""

import re
import sys
import tomllib
from pathlib import Path

PROJECT = Path(__file__).resolve().parents[1] / "pyproject.toml"
_REQUIREMENT = re.compile(r"(?P<name>[\w.-]+)(\[.*\])?(>=|==)(?P<version>[\w.]+)")


def floors(project: dict) -> dict[str, str]:
    """The lowest version of each package that a `[project]` table names, in its extras too.

    Raises:
        ValueError: a requirement has no lowest version, or a package has two.
    """
    found: dict[str, str] = {}
    for requirement in [*project["dependencies"], *sum(project["optional-dependencies"].values(), [])]:
        if re.match(rf"{project['name']}\[", requirement):
            continue  # an extra that takes in others
        if not (parts := _REQUIREMENT.fullmatch(requirement)):
            raise ValueError(f"pyproject.toml: expected NAME>=VERSION or NAME==VERSION, found {requirement!r}")
        name, version = parts["name"], parts["version"]
        if found.setdefault(name, version) != version:
            raise ValueError(f"pyproject.toml: {name} has two lowest versions, {found[name]} and {version}")
    return found


if __name__ == "__main__":
    project = tomllib.loads(PROJECT.read_text(encoding="utf-8"))["project"]
    sys.stdout.writelines(f"{name}=={version}\n" for name, version in floors(project).items())
