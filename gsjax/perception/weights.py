"""Weights of foundation models. They are read only from local folders, and only from files that cannot run
code when they are read.
"""

import json
import os
import shlex
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from types import ModuleType
from typing import Any

from gsjax import extras

_CONFIG = "config.json"
_WHOLE, _INDEX = "model.safetensors", "model.safetensors.index.json"
_CONVERT = (
    "import sys, torch; from safetensors.torch import save_file; "
    "w = torch.load(sys.argv[1], map_location='cpu', weights_only=True); "
    "save_file({k: v.clone().contiguous() for k, v in w.items()}, sys.argv[2], {'format': 'pt'})"
)
LOCAL_FILES = {"local_files_only": True, "trust_remote_code": False}
"""Options for transformers to load anything; by default it would ask whether to run code in the folder."""
LOCAL_WEIGHTS = LOCAL_FILES | {"use_safetensors": True, "dtype": "auto"}
"""Options with which transformers loads a model, in the precision of its files."""
PROCESSOR = "preprocessor_config.json|processor_config.json"
"""The file that specifies how images are resized and normalised, under either of its names."""


def model_folder(path: str | os.PathLike, model: str, others: tuple[str, ...], example: str) -> Path:
    """The folder of a model in the layout of Hugging Face, checked.

    Args:
        path: the folder, as given by the user.
        model: description of what it should hold, for error messages.
        others: further required files; "|" separates alternatives.
        example: a model of that kind on the Hugging Face hub.

    Raises:
        FileNotFoundError: the folder does not exist, or a file is missing.
        ValueError: a file points to pickled weights, or is not valid JSON.
    """
    folder = Path(path)
    wanted = (_CONFIG, f"{_WHOLE}|{_INDEX}", *others)
    listed = ", ".join(files.replace("|", " or ") for files in wanted)
    advice = f"One way to get them: hf download {example} --local-dir {folder}"
    if not folder.is_dir():
        found = "a file" if folder.exists() else "nothing there"
        raise FileNotFoundError(f"{folder}: expected a folder of {model} ({listed}), found {found}. {advice}")
    missing = [files for files in wanted if not any((folder / file).is_file() for file in files.split("|"))]
    if missing:
        names = ", ".join(sorted(entry.name for entry in folder.iterdir())[:8]) or "an empty folder"
        lacking = ", ".join(files.replace("|", " or ") for files in missing)
        pickles = sorted(folder.glob("*.bin"))
        if pickles and _WHOLE in lacking:
            advice = (
                f"{pickles[0].name} is a pickle, which can run code when read, so it is refused. "
                f'In an environment with torch and safetensors: python -c "{_CONVERT}" '
                f"{shlex.quote(str(pickles[0]))} {shlex.quote(str(folder / _WHOLE))}"
            )
        raise FileNotFoundError(f"{folder}: expected {model}; it lacks {lacking}, found {names}. {advice}")
    _check_no_pickles(folder)
    return folder


def model_type(folder: Path) -> Any:
    """The kind of model that a folder's configuration names; None where it names none."""
    return _read_json(folder / _CONFIG).get("model_type")


def load_model(transformers: ModuleType, kind: str, folder: Path, device: str, *, half: bool = False) -> Any:
    """A model, ready for inference.

    Args:
        transformers: the module.
        kind: the name of its class.
        folder: from `model_folder`.
        device: device of torch.
        half: keep weights of half precision as they are, except on a CPU, which is slower with them; the
            caller must pass inputs of the model's `dtype`. Otherwise they are converted to single precision.
    """
    with _no_progress(transformers.utils.logging):
        model = getattr(transformers, kind).from_pretrained(folder, **LOCAL_WEIGHTS).eval()
    return (model if half and device != "cpu" else model.float()).to(device)


@contextmanager
def _no_progress(logging: Any) -> Iterator[None]:
    """Hide the progress bars of transformers, which would mix with a command's own."""
    shown = logging.is_progress_bar_enabled()
    logging.disable_progress_bar()
    try:
        yield
    finally:
        if shown:
            logging.enable_progress_bar()


def image_processor(transformers: ModuleType, folder: Path) -> Any:
    """The image processor of the model in a folder, in the variant that needs no torchvision."""
    return transformers.AutoImageProcessor.from_pretrained(folder, **LOCAL_FILES, backend="pil")


def _check_no_pickles(folder: Path) -> None:
    """Refuse files that could make transformers load other weights, which may be pickles."""
    named = _read_json(folder / _CONFIG).get("transformers_weights")
    if named is not None:
        raise ValueError(
            f"{folder / _CONFIG}: expected no transformers_weights, found {named!r}; delete the entry, "
            f"so that weights come from {_WHOLE}"
        )
    if (adapter := folder / "adapter_config.json").exists():
        raise ValueError(
            f"{adapter}: expected the weights of a whole model, found only an adapter; merge it into the "
            "model (with merge_and_unload and save_pretrained of peft)"
        )
    if not (folder / _WHOLE).is_file():
        parts = _read_json(folder / _INDEX).get("weight_map")
        if not isinstance(parts, dict) or not all(
            str(part).endswith(".safetensors") for part in parts.values()
        ):
            raise ValueError(
                f"{folder / _INDEX}: expected a weight_map that names .safetensors files only, found none; "
                "save the model again with save_pretrained"
            )


def _read_json(path: Path) -> dict:
    try:
        read = json.loads(path.read_text("utf-8"))
    except (ValueError, RecursionError) as error:
        raise ValueError(f"{path}: expected JSON, found {error}; fetch the file again") from error
    if not isinstance(read, dict):
        raise ValueError(f"{path}: expected a JSON object, found {type(read).__name__}; fetch the file again")
    return read


def foundation_modules(model: str) -> tuple[ModuleType, ModuleType]:
    """Import and return (torch, transformers).

    Raises:
        MissingExtra: one of them is not installed.
    """
    return extras.load("torch", "foundation", model), extras.load("transformers", "foundation", model)
