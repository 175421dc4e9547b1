"""Where adapters of foundation models find their weights: in a folder on this machine, nowhere else."""

import importlib
import os
from pathlib import Path
from types import ModuleType

_CONFIG = "config.json"
_WEIGHTS = ("model.safetensors", "model.safetensors.index.json", "pytorch_model.bin")


def weights_folder(path: str | os.PathLike, model: str, others: tuple[str, ...], example: str) -> Path:
    """The folder of a model in the layout of Hugging Face, checked.

    Args:
        path: as the user gave it.
        model: what it should hold, in words.
        others: further files that must be there; one with "|" in it names alternatives.
        example: a model of that kind on the Hugging Face hub.

    Raises:
        FileNotFoundError: there is no such folder, or a file is missing.
    """
    folder = Path(path)
    wanted = (_CONFIG, "|".join(_WEIGHTS), *others)
    listed = ", ".join(files.replace("|", " or ") for files in wanted)
    advice = f"One way to get them: hf download {example} --local-dir {folder}"
    if not folder.is_dir():
        found = "a file" if folder.exists() else "nothing there"
        raise FileNotFoundError(f"{folder}: expected a folder of {model} ({listed}), found {found}. {advice}")
    missing = [files for files in wanted if not any((folder / file).is_file() for file in files.split("|"))]
    if missing:
        names = ", ".join(sorted(entry.name for entry in folder.iterdir())[:8]) or "an empty folder"
        lacking = ", ".join(files.replace("|", " or ") for files in missing)
        raise FileNotFoundError(f"{folder}: expected {model}; it lacks {lacking}, found {names}. {advice}")
    return folder


def foundation_modules(model: str) -> tuple[ModuleType, ModuleType]:
    """(torch, transformers), imported now.

    Raises:
        ImportError: one is not installed.
    """
    try:
        return importlib.import_module("torch"), importlib.import_module("transformers")
    except ImportError as error:
        raise ImportError(
            f"{model} needs torch and transformers, and {error.name} is not installed: "
            "pip install 'gsjax[foundation]'"
        ) from error
