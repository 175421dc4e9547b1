"""Public docstrings are complete in every layer; this is checked on the source.

A docstring is complete if it opens with a sentence, mentions each parameter (optional for one or two), says
what is raised, and gives the shapes of arrays that their annotations leave open.
"""

import ast
import re
from collections.abc import Iterator
from functools import cache
from pathlib import Path

import pytest

PACKAGE = Path(__file__).resolve().parents[1] / "gsjax"
LAYERS = (
    *("geometry", "rasterize", "scene", "losses", "optim", "methods"),
    *("perception", "metrics", "data", "io", "viz", "engine", "cli"),
)
FEW = 2  # up to this many parameters need no description
ERRORS = ("ValueError", "TypeError", "OSError", "DataError")
OPEN_SHAPE = re.compile(r"^(np\.ndarray|(jax\.)?Array)$|\[(np\.ndarray|Array), ['\"]\.\.\.['\"]\]")

METHODS = sorted((PACKAGE / "methods").glob("*/**/__init__.py"))

Definition = ast.Module | ast.ClassDef | ast.FunctionDef


def definitions(tree: ast.Module) -> Iterator[tuple[str, Definition]]:
    """Yields a module and its public definitions, except methods that a base class documents."""
    yield "the module", tree
    told = documented(tree)
    for node in tree.body:
        if not isinstance(node, ast.ClassDef | ast.FunctionDef) or node.name.startswith("_"):
            continue
        yield node.name, node
        if isinstance(node, ast.ClassDef):
            inherited = set().union(*(told.get(ast.unparse(base), set()) for base in node.bases))
            public = [m for m in methods(node) if not (m.name.startswith("_") or m.name in inherited)]
            yield from ((f"{node.name}.{m.name}", m) for m in public)


def documented(tree: ast.Module) -> dict[str, set[str]]:
    """Returns, by class defined in a module or imported, the methods that it or its bases document."""
    told: dict[str, set[str]] = {}
    for node in tree.body:
        if isinstance(node, ast.ImportFrom) and (node.module or "").startswith("gsjax."):
            file = PACKAGE.parent.joinpath(*node.module.split(".")).with_suffix(".py")
            classes = [alias.name for alias in node.names if alias.name[0].isupper()]
            if classes and file.exists():
                there = documented_in(file)
                told |= {name: there[name] for name in classes if name in there}
        elif isinstance(node, ast.ClassDef):
            inherited = set().union(*(told.get(ast.unparse(base), set()) for base in node.bases))
            told[node.name] = inherited | {m.name for m in methods(node) if ast.get_docstring(m)}
    return told


@cache
def documented_in(file: Path) -> dict[str, set[str]]:
    """Returns `documented` of a file; cached."""
    return documented(ast.parse(file.read_text(encoding="utf-8")))


def methods(node: ast.ClassDef) -> list[ast.FunctionDef]:
    return [member for member in node.body if isinstance(member, ast.FunctionDef)]


def faults(node: Definition) -> Iterator[str]:
    """Yields what the docstring of one definition lacks."""
    text = ast.get_docstring(node)
    if not text:
        yield "has no docstring"
        return
    opening = text.split("\n\n")[0]
    if not re.search(r"[.:;?]\)?$", opening):
        yield f"opens with no sentence: {opening[:60]!r}"
    if isinstance(node, ast.FunctionDef):
        given = node.args
        arguments = [*given.posonlyargs, *given.args, *given.kwonlyargs]
        arguments = [a for a in arguments if a.arg not in ("self", "cls")]
        silent = [a.arg for a in arguments if not (tells_of(text, a.arg) or is_of_its_class(a))]
        if len(arguments) > FEW and silent and not re.search(r"[Aa]rguments (as for|of) `", text):
            yield f"does not tell of {', '.join(silent)}"
        open_ = [a.arg for a in arguments if a.annotation and OPEN_SHAPE.search(ast.unparse(a.annotation))]
        if open_ and not re.search(r"\[[^\]]+\]|shape|Arguments as for", text):
            yield f"gives no shape for {', '.join(open_)}"
        raised = sorted(set(raises(node)) & set(ERRORS))
        if raised and "Raises" not in text:
            yield f"does not say that it raises {', '.join(raised)}"


def tells_of(text: str, name: str) -> bool:
    """Whether a docstring contains a parameter's name, or each word of it, in the singular or plural."""
    words = [word.removesuffix("s") for word in name.split("_") if word]
    return all(re.search(rf"(?<![a-zA-Z]){re.escape(word)}", text, re.IGNORECASE) for word in words)


def is_of_its_class(argument: ast.arg) -> bool:
    """Whether an argument is named after its class (`config: TrackConfig`), which then documents it."""
    if argument.annotation is None:
        return False
    classes = re.findall(r"[A-Z]\w*", ast.unparse(argument.annotation).split("[")[0])
    spelled = argument.arg.replace("_", "").removesuffix("s").lower()
    return any(name.removesuffix("s").lower().endswith(spelled) for name in classes if len(spelled) > 3)


def raises(function: ast.FunctionDef) -> Iterator[str]:
    """Yields the names of the exceptions that the body raises, nested functions excluded."""
    pending: list[ast.AST] = list(function.body)
    while pending:
        node = pending.pop()
        if isinstance(node, ast.FunctionDef | ast.ClassDef):
            continue
        if isinstance(node, ast.Raise) and node.exc is not None:
            raised = node.exc.func if isinstance(node.exc, ast.Call) else node.exc
            yield ast.unparse(raised).split(".")[-1]
        pending.extend(ast.iter_child_nodes(node))


def not_full(source: str) -> list[str]:
    """Returns one message for each fault in a module, starting with the line number."""
    tree = ast.parse(source)
    if not tree.body:  # an empty __init__.py
        return []
    return [
        f"{getattr(node, 'lineno', 1)}: {name} {fault}"
        for name, node in definitions(tree)
        for fault in faults(node)
    ]


@pytest.mark.parametrize("layer", LAYERS)
def test_public_docstrings_are_full(layer):
    messages = [
        f"gsjax/{file.relative_to(PACKAGE)}:{message}"
        for file in sorted((PACKAGE / layer).rglob("*.py"))
        for message in not_full(file.read_text(encoding="utf-8"))
    ]
    assert not messages, "\n" + "\n".join(messages)


FULL = '''"""A module."""


def f(a: Float[np.ndarray, "..."], b, some_points):
    """Adds b to all points, and some.

    Args:
        a: [n, 3], metres.

    Raises:
        ValueError: never.
    """
    raise ValueError("a")
'''


@pytest.mark.parametrize(
    ("old", "new", "says"),
    [
        ("A module.", "A module", "1: the module opens with no sentence"),
        ('"""A module."""', "", "the module has no docstring"),
        ("Adds b to", "Adds to", "f does not tell of b"),
        ("all points, and some", "all", "f does not tell of some_points"),
        ("[n, 3], metres", "numbers", "f gives no shape for a"),
        ("Raises:", "Finds:", "f does not say that it raises ValueError"),
        ("def f(", "class F:\n    def g(self): ...\n\n\ndef f(", "F.g has no docstring"),
    ],
)
def test_what_a_docstring_lacks_is_named(old, new, says):
    assert not_full(FULL) == []
    assert any(says in message for message in not_full(FULL.replace(old, new)))


@pytest.mark.parametrize("package", METHODS, ids=lambda path: path.parent.name)
def test_a_method_lists_its_files(package):
    listed = ast.get_docstring(ast.parse(package.read_text(encoding="utf-8"))) or ""
    for file in package.parent.glob("*.py"):
        assert file == package or file.name in listed, f"{package}: expected {file.name} in the list of files"
