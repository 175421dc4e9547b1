"""Runs the notebooks of docs/notebooks and stores their pictures and printed output in them.

    .venv/bin/python docs/make_notebooks.py [NAME ...]    # `make notebooks`

HTML output is dropped, because repository hosts do not display it: it appears when the cell is run.
"""

import sys
from base64 import b64decode, b64encode
from collections.abc import Iterable
from io import BytesIO
from pathlib import Path
from tempfile import TemporaryDirectory

import nbformat
from nbclient import NotebookClient
from PIL import Image

FOLDER = Path(__file__).resolve().parent / "notebooks"
_MOST_SECONDS = 1800  # per cell
_QUALITY = 85  # of JPEG pictures


def main(names: list[str]) -> None:
    """Run the named notebooks, or all.

    Raises:
        ValueError: there is no notebook of a given name.
    """
    if unknown := set(names) - {path.stem for path in FOLDER.glob("*.ipynb")}:
        raise ValueError(f"expected names of notebooks in {FOLDER}, found {', '.join(sorted(unknown))}")
    for path in sorted(FOLDER.glob("*.ipynb")):
        if names and path.stem not in names:
            continue
        print(path.name, flush=True)
        notebook = nbformat.read(path, as_version=4)
        with TemporaryDirectory() as where:  # files that cells write are not kept
            NotebookClient(notebook, timeout=_MOST_SECONDS, resources={"metadata": {"path": where}}).execute()
        path.write_text(nbformat.writes(cleaned(notebook), indent=1) + "\n", encoding="utf-8")


def cleaned(notebook: nbformat.NotebookNode) -> nbformat.NotebookNode:
    """The notebook without HTML output and without anything that differs from run to run.

    Args:
        notebook: as it was run.
    """
    notebook.metadata = {"kernelspec": {"display_name": "Python 3", "language": "python", "name": "python3"}}
    for number, cell in enumerate(notebook.cells):
        cell.id, cell.metadata = f"cell-{number}", {}
        if cell.cell_type != "code":
            continue
        cell.execution_count = None
        cell.outputs = joined(output for output in cell.outputs if output.get("name") != "stderr")
        for output in cell.outputs:
            if "execution_count" in output:
                output.execution_count = None
            data = output.get("data", {})
            data.pop("text/html", None)
            if "image/png" in data:
                data["image/jpeg"] = smaller(data.pop("image/png"))
    return notebook


def joined(outputs: Iterable[nbformat.NotebookNode]) -> list[nbformat.NotebookNode]:
    """The outputs, with consecutive printed outputs joined.

    Args:
        outputs: of a cell.
    """
    found = []
    for output in outputs:
        if found and output.output_type == found[-1].output_type == "stream":
            found[-1].text += output.text
        else:
            found.append(output)
    return found


def smaller(picture: str) -> str:
    """A JPEG picture in base64.

    Args:
        picture: a PNG in base64, as a cell produced it.
    """
    packed = BytesIO()
    Image.open(BytesIO(b64decode(picture))).convert("RGB").save(packed, "JPEG", quality=_QUALITY)
    return b64encode(packed.getvalue()).decode()


if __name__ == "__main__":
    main(sys.argv[1:])
