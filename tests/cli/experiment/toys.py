"""A toy experiment, and readers of what it leaves in the working directory."""

import json
from pathlib import Path

CONFIG = {
    "claim": "Larger pictures take longer.",
    "source": "nobody, section 1",
    "script": "sweep.py",
    "grid": {"size": [320, 640], "mode": ["fast", "exact"]},
}
SCRIPT = """
def run(options, seed, folder):
    with open("calls.txt", "a") as calls:
        print(options["size"], options["mode"], seed, file=calls)
    return {"ms": options["size"] / 10 + seed, "curve": [1.0, 2.0]}
"""


def calls() -> list[str]:
    """The cells that ran since the last call."""
    path = Path("calls.txt")
    lines = path.read_text().splitlines() if path.exists() else []
    path.unlink(missing_ok=True)
    return lines


def results(folder: Path) -> dict:
    return json.loads((folder / "results.json").read_text())


def cell_files() -> list[Path]:
    return sorted(Path("runs/experiments/toy").glob("*.json"))


def markdown_table(folder: Path) -> list[list[str]]:
    """The header and rows of the table in results.md."""
    lines = [line for line in (folder / "results.md").read_text().splitlines() if line.startswith("| ")]
    return [[cell.strip() for cell in line.strip("|").split(" | ")] for line in lines if "---" not in line]


def stopping(how: str) -> str:
    """The script, except that its third cell first runs `how` while the file `stop` exists."""
    stop = f"if options == dict(size=640, mode='fast') and os.path.exists('stop'):\n        {how}\n    return"
    return "import os, signal, sys\n" + SCRIPT.replace("return", stop)
