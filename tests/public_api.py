"""Generates the page of public names, and checks that CHANGELOG.md mentions every change to them.

python -m tests.public_api              # writes docs/api/public.md
python -m tests.public_api release    # and the record that later changes are compared with
"""

import ast
import dataclasses
import hashlib
import inspect
import json
import re
import sys
from pathlib import Path
from types import FunctionType

import gsjax

ROOT = Path(__file__).resolve().parents[1]
PAGE, RELEASED = ROOT / "docs/api/public.md", ROOT / "tests/released_api.json"
AGAIN = "python -m tests.public_api"
"""The command that brings the page up to date."""
_INTRODUCTION = """# What is promised

What `import gsjax` offers: these names, as they are written here, and the settings within settings with their
defaults (`TrackConfig.grow`). Before version 1.0 a minor version may
change them, a patch version does not, and CHANGELOG.md says what changed: a test fails otherwise. The same
holds, without a test, for options of commands and for the files of a run.

All else that can be imported is documented for those who compose methods of their own, but internal: it may
move in any version.
"""


def signatures() -> dict[str, str]:
    """Returns the signature of each public name, and of each nested config class, as source."""
    named = {name: inspect.unwrap(getattr(gsjax, name)) for name in gsjax.__all__}
    within = {}
    for name, thing in named.items():
        if name.endswith("Config"):
            within |= _within(name, thing())
    return {name: _signature(thing) for name, thing in (named | within).items()}


def _within(name: str, settings: object) -> dict[str, type]:
    """Returns the nested config classes by their paths, such as `TrackConfig.grow`."""
    found = {}
    for field in dataclasses.fields(settings):
        value = getattr(settings, field.name)
        if dataclasses.is_dataclass(value):
            place = f"{name}.{field.name}"
            found |= {place: type(value)} | _within(place, value)
    return found


def page() -> str:
    """Returns the page, generated from the source of the public names."""
    blocks = [f"## {name}\n\n```\n{signature}\n```\n" for name, signature in signatures().items()]
    return _INTRODUCTION + "\n" + "\n".join(blocks)


def unmentioned() -> list[str]:
    """Returns the changes since the last release that the changelog's newest section does not mention.

    A change is mentioned if its name is in backticks, for a member together with its class in one paragraph.
    """
    newest = re.split(r"^## ", (ROOT / "CHANGELOG.md").read_text(), flags=re.MULTILINE)[1]
    code = (" ".join(re.findall(r"`([^`]*)`", paragraph)) for paragraph in newest.split("\n\n"))
    quoted = [set(re.findall(r"\w+", text)) for text in code]
    return [name for name in changed() if not any({*name.split(".")} <= words for words in quoted)]


def changed() -> list[str]:
    """Returns what differs from the last release: names, or `Name.member` for classes that exist in both."""
    before, now, found = json.loads(RELEASED.read_text()), digests(), []
    for name in sorted(before.keys() | now.keys()):
        old, new = before.get(name, {}), now.get(name, {})
        members = [member for member in old | new if old.get(member) != new.get(member)]
        whole = not old or not new or "" in members
        found += [name] if whole else [f"{name}.{member}" for member in members]
    return found


def broken() -> list[str]:
    """Returns changes to released names and their members if this is a patch version, which allows none."""
    if gsjax.__version__.split(".")[2] == "0":
        return []
    before = json.loads(RELEASED.read_text())
    return [name for name in changed() if name in before or name.rpartition(".")[0] in before]


def digests() -> dict[str, dict[str, str]]:
    """Returns a digest of each line of each signature, keyed by the member it declares ("" for the first)."""
    return {name: _digests(text.splitlines()) for name, text in signatures().items()}


def _digests(lines: list[str]) -> dict[str, str]:
    found, kinds = {"": lines[0]}, ""
    for line in map(str.strip, lines[1:]):
        if line.startswith("@"):
            kinds += line
        else:
            found[re.match(r"(?:def )?(\w+)", line)[1]], kinds = kinds + line, ""
    return {member: hashlib.sha256(text.encode()).hexdigest()[:16] for member, text in found.items()}


def _signature(thing: type | FunctionType) -> str:
    tree = ast.parse(Path(inspect.getsourcefile(thing)).read_text(encoding="utf-8"))
    node = next(node for node in tree.body if getattr(node, "name", None) == thing.__name__)
    if isinstance(node, ast.FunctionDef):
        return _function(node)
    lines = [f"class {node.name}({', '.join(map(ast.unparse, node.bases))}):".replace("()", "")]
    for part in node.body:
        if isinstance(part, ast.AnnAssign) and not part.target.id.startswith("_"):
            lines.append(f"    {ast.unparse(part)}")
        elif isinstance(part, ast.FunctionDef) and not part.name.startswith("_"):
            kinds = [f"    @{ast.unparse(one)}" for one in part.decorator_list]
            lines += [*kinds, f"    {_function(part)}"]
    return "\n".join(lines)


def _function(node: ast.FunctionDef) -> str:
    returns = "" if node.returns is None else f" -> {ast.unparse(node.returns)}"
    return f"def {node.name}({ast.unparse(node.args)}){returns}: ..."


if __name__ == "__main__":
    PAGE.write_text(page(), encoding="utf-8")
    if "release" in sys.argv[1:]:
        RELEASED.write_text(json.dumps(digests(), indent=1) + "\n")
