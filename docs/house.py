"""Prints the table of "The house" in docs/architecture.md: how this code reads, beside two libraries.

    .venv/bin/python docs/house.py

It counts what is installed of these, and this checkout.
"""

import ast
from collections.abc import Iterable
from importlib.metadata import version
from importlib.util import find_spec
from pathlib import Path
from statistics import median

GSJAX = Path(__file__).resolve().parents[1] / "gsjax"
HEAD = ("", "files", "lines, median / longest", "body of a function, median / 90 %", "prose")
HEAD += ("public without docstring",)
Definition = ast.FunctionDef | ast.ClassDef


def main() -> None:
    """Print it."""
    print(_row(HEAD), _row(("---", *["---:"] * (len(HEAD) - 1))), sep="\n")
    for name in ("optimistix", "jaxlie"):
        print(_row(count(f"{name} {version(name)}", Path(find_spec(name).origin).parent.rglob("*.py"))))
    commands = set((GSJAX / "cli").rglob("*.py"))
    print(_row(count("gsjax, the library", set(GSJAX.rglob("*.py")) - commands)))
    print(_row(count("gsjax, the command line", commands)))


def _row(cells: Iterable[str]) -> str:
    return f"| {' | '.join(cells)} |".replace("|  |", "| |")


def count(name: str, files: Iterable[Path]) -> tuple[str, ...]:
    """The row of one package; its empty files do not count."""
    texts = [text for file in files if (text := file.read_text(encoding="utf-8")).strip()]
    trees = [ast.parse(text) for text in texts]
    lines = [len(text.splitlines()) for text in texts]
    functions = [node for tree in trees for node in ast.walk(tree) if isinstance(node, ast.FunctionDef)]
    bodies = sorted(map(body, functions))
    words = [said for text, tree in zip(texts, trees, strict=True) for said in prose(text, tree)]
    offered = [node for tree in trees for node in public(tree)]
    silent = sum(ast.get_docstring(node) is None for node in offered)
    return (
        name,
        str(len(texts)),
        f"{median(lines):.0f} / {max(lines)}",
        f"{median(bodies):.0f} / {bodies[9 * len(bodies) // 10]}",
        f"{100 * sum(words) / len(words):.0f} %",
        f"{silent} of {len(offered)}",
    )


def body(function: ast.FunctionDef) -> int:
    """Its lines, without the docstring."""
    statements = function.body[1:] if is_text(function.body[0]) else function.body
    return statements[-1].end_lineno - statements[0].lineno + 1 if statements else 0


def prose(text: str, tree: ast.Module) -> list[bool]:
    """Of each line that is not empty, whether it is a docstring's or a comment."""
    told = {n for node in ast.walk(tree) if is_text(node) for n in range(node.lineno, node.end_lineno + 1)}
    lines = enumerate(map(str.strip, text.splitlines()), 1)
    return [number in told or line.startswith("#") for number, line in lines if line]


def is_text(node: ast.AST) -> bool:
    """Whether a statement is a docstring, of an attribute too."""
    return isinstance(node, ast.Expr) and isinstance(getattr(node.value, "value", None), str)


def public(node: ast.Module | ast.ClassDef) -> list[Definition]:
    """Functions, classes and methods whose names begin with no underscore."""
    own = [n for n in node.body if isinstance(n, Definition) and not n.name.startswith("_")]
    return own + [method for n in own if isinstance(n, ast.ClassDef) for method in public(n)]


if __name__ == "__main__":
    main()
