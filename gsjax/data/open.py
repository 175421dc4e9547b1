"""Opens any recording that some reader here knows."""

import inspect
from pathlib import Path
from urllib.parse import parse_qsl

from gsjax.data.errors import DataError
from gsjax.data.panoptic import read_panoptic
from gsjax.data.push_t import read_push_t
from gsjax.data.sequence import Sequence
from gsjax.data.seven_scenes import read_seven_scenes
from gsjax.data.simulated import tabletop
from gsjax.data.tum import read_tum

SIMULATED_PREFIX = "simulated:"
SIMULATED_SCENES = {"tabletop": tabletop}

# What only a folder of that layout has (* stands for anything), and its reader.
_LAYOUTS = {
    "train_meta.json": ("Panoptic", read_panoptic),
    "sample_demos": ("push-T", read_push_t),
    "rgb.txt": ("TUM RGB-D", read_tum),
    "frame-*.pose.txt": ("7-Scenes", read_seven_scenes),
    "seq-*": ("7-Scenes", read_seven_scenes),
}


def open_sequence(path: str | Path) -> Sequence:
    """The sequence in a folder, whose layout is recognised, or a built-in scene.

    A built-in scene is "simulated:NAME" with the arguments of its function behind it, as in
    "simulated:tabletop?seed=3&frames=20&hide=true".

    Raises:
        DataError: there is no such folder, or its layout is not known.
        ValueError: there is no built-in scene of that name, or it has no such argument.
    """
    if str(path).startswith(SIMULATED_PREFIX):
        return _simulate(str(path))
    root = Path(path)
    if not root.is_dir():
        known = ", ".join(SIMULATED_PREFIX + name for name in SIMULATED_SCENES)
        found = "a file" if root.exists() else "nothing there"
        raise DataError(
            root, "a folder with a recording", found, f"Give its folder, or a built-in scene: {known}."
        )
    for mark, (_, read) in _LAYOUTS.items():
        if next(root.glob(mark), None):
            return read(root)
    marks = ", ".join(f"{mark} ({layout} layout)" for mark, (layout, _) in _LAYOUTS.items())
    names = sorted(entry.name for entry in root.iterdir())
    found = ", ".join(names[:8]) + (", ..." if len(names) > 8 else "") if names else "an empty folder"
    raise DataError(root, f"one of {marks}", found, "Give the folder that holds one of these.")


def _simulate(text: str) -> Sequence:
    name, _, query = text.removeprefix(SIMULATED_PREFIX).partition("?")
    if name not in SIMULATED_SCENES:
        raise ValueError(f"no built-in scene {name!r}; there are: {', '.join(SIMULATED_SCENES)}")
    scene = SIMULATED_SCENES[name]
    parameters = inspect.signature(scene).parameters
    arguments = {}
    for key, value in parse_qsl(query, keep_blank_values=True):
        if key not in parameters:
            raise ValueError(f"{text}: {name} has no argument {key!r}; it has: {', '.join(parameters)}")
        arguments[key] = _parse(text, key, value, type(parameters[key].default))
    return scene(**arguments)


def _parse(text: str, key: str, value: str, kind: type) -> int | bool:
    """An integer, or a truth value written true, false, 1, or 0."""
    if kind is bool and value.lower() in ("true", "false", "1", "0"):
        return value.lower() in ("true", "1")
    if kind is int and value.lstrip("-").isdecimal():
        return int(value)
    wanted = "true or false" if kind is bool else "an integer"
    raise ValueError(f"{text}: {key} must be {wanted}, got {value!r}")
