"""Opens recordings and sets of photographs in any layout that has a reader."""

import inspect
from collections.abc import Callable, Collection
from contextlib import suppress
from dataclasses import dataclass, fields, replace
from pathlib import Path
from typing import Any, TypeVar
from urllib.parse import parse_qsl

import numpy as np

from gsjax.data import clip, colmap, poses_bounds, transforms
from gsjax.data.duplicates import without_duplicates
from gsjax.data.endonerf import is_unambiguous_endonerf
from gsjax.data.errors import COMPLETE, DataError
from gsjax.data.layouts import PHOTOGRAPHS, RECORDINGS, Layout, in_words, layout_of
from gsjax.data.open3d_rgbd import without_poses
from gsjax.data.paris import Split
from gsjax.data.photographs import Photographs, photographs_of
from gsjax.data.pictures import is_picture, reject_unread
from gsjax.data.realsense import read_realsense
from gsjax.data.record3d import EXPORT_THIS
from gsjax.data.sequence import Sequence
from gsjax.data.simulated import articulated, bar, cabinet, hard_parts, tabletop, tissue
from gsjax.data.through_lenses import Fisheye
from gsjax.data.tool_masks import Tool
from gsjax.geometry.cameras import NEAR
from gsjax.io.brief import shortened

SIMULATED_PREFIX = "simulated:"
SIMULATED_SCENES = {
    "tabletop": tabletop,
    "articulated": articulated,
    "bar": bar,
    "cabinet": cabinet,
    "hard_parts": hard_parts,
    "tissue": tissue,
}

# Option -> what it applies to, and whether the data that were read have it.
_ABOUT = {
    "depth_unit_m": ("depth", lambda data: data.load_depth is not None),
    "depth_percentiles": ("depth", lambda data: data.load_depth is not None),
    "tool": ("masks", lambda data: data.load_mask is not None),
    "baseline_m": ("a right eye", lambda data: data.num_cameras > 1),
}

Data = TypeVar("Data", Sequence, Photographs)


@dataclass(frozen=True)
class ReadOptions:
    """Options for what some layouts do not specify. A layout's reader takes those that it has arguments for;
    the others are refused rather than ignored."""

    K: tuple[float, float, float, float] | None = None
    """fx fy cx cy for data without intrinsics (Open3D, videos) or from one's own camera (TUM, 7-Scenes), in
    pixels, with pixel centres at +0.5."""
    axes: poses_bounds.Axes | None = None
    """Meaning of the rotation columns in poses_bounds.npy: llff (down, right, back; DyNeRF too) or endonerf
    (right, up, back). Default: endonerf if masks and depth lie beside the images; otherwise required."""
    images: str = "images"
    """Folder of the photographs or frames, in the COLMAP, LLFF and EndoNeRF layouts."""
    model: str | None = None
    """Folder of the reconstruction (COLMAP), such as sparse/1; default: the one with the most photographs."""
    masks: str | None = None
    """Folder of the tool masks, beside a video or in a folder of frames without poses."""
    tool: Tool = "white"
    """Colour of the tool in black-and-white masks (EndoNeRF, videos): white or black."""
    fisheye: Fisheye = "undistort"
    """Fisheye photographs (COLMAP, nerfstudio): undistort to pinhole views, which lose what lies far off the
    axis, or keep as they are and render through the same lens."""
    depth_unit_m: float | None = None
    """Metres per unit of the stored depth values (TUM, 7-Scenes, BOP, PARIS, Panoptic, Open3D, nerfstudio,
    EndoNeRF, RealSense); default: the value given in the data, else that of the layout: 0.0002 for TUM,
    0.001 for others."""
    depth_percentiles: tuple[float, float] | None = None
    """Lowest and highest percentile of each frame's depth to keep (EndoNeRF), for example 3 99.8 for depth
    from stereo matching; default: keep all."""
    pose_unit_m: float = 1.0
    """Metres per unit of the poses (EndoNeRF), for a camera that moves."""
    world: str | None = None
    """What is static in a recording without camera poses (BOP): camera, or the number of an object, such as
    5, whose frame is then the world."""
    split: Split = "train"
    """Which pictures of the two states to read (PARIS): train, val or test."""
    baseline_m: float | None = None
    """Metres from the left eye to the right one (EndoNeRF, EndoVis without a calibration)."""
    near: float = NEAR
    """Near clipping distance, in the unit of the poses: nothing nearer to a camera is rendered, for example
    not the rig, where cameras see each other."""

    def __post_init__(self):
        if not 0 <= self.near < np.inf:
            raise ValueError(f"near: expected 0 or more, found {self.near}")
        for name in ("depth_unit_m", "pose_unit_m", "baseline_m"):
            if (length := getattr(self, name)) is not None and not 0 < length < np.inf:
                raise ValueError(f"{name}: expected metres above 0, found {length}")


def open_sequence(path: str | Path, options: ReadOptions | None = None) -> Sequence:
    """Open the sequence in a folder (its layout is recognised), a video, or a built-in scene.

    A video, or a folder of frames with masks but without poses, is read as the recording of one static
    camera. A built-in scene is "simulated:NAME", optionally followed by arguments of its function, as in
    "simulated:tabletop?seed=3&frames=20&hide=true".

    Raises:
        DataError: there is no such folder, its layout is unknown, or it holds photographs without a time.
        ValueError: there is no built-in scene of that name, it has no such argument, an option is missing, or
            one is given that does not apply to the layout.
    """
    options = options or ReadOptions()
    return replace(_sequence(path, options), near=options.near)


def _sequence(path: str | Path, options: ReadOptions) -> Sequence:
    if str(path).startswith(SIMULATED_PREFIX):
        return _read("built-in", _simulate, str(path), options)
    root = Path(path)
    if root.is_file() and clip.is_clip(root):
        return _read("video", clip.read_clip, root, options, unused={"images"})
    if root.is_file() and _is_bag(root):
        return _read("RealSense", read_realsense, root, options)
    root = _folder(path)
    if (layout := layout_of(root, RECORDINGS, options.images)) is not None:
        return _read_layout(layout, root, options)
    if (layout := layout_of(root, PHOTOGRAPHS)) is not None:
        found = f"photographs ({layout.name} layout), which are not ordered in time"
        raise DataError(root, "a recording over time", found, "Use gsjax fit for photographs.")
    if clip.is_clip(root, options.images, options.masks):
        return _read("clip", clip.read_clip, root, options)
    raise _unknown(root, RECORDINGS, options)


def _read_layout(layout: Layout, root: Path, options: ReadOptions) -> Any:
    settled = {"axes": _axes(root, options)} if layout.needs_axes else {}
    return _read(layout.name, layout.read, root, options, **settled)


def _axes(root: Path, options: ReadOptions) -> poses_bounds.Axes:
    if options.axes is None and is_unambiguous_endonerf(root, options.images):
        return "endonerf"
    if options.axes is None:
        raise ValueError(
            f"{root}: poses_bounds.npy does not state the meaning of its columns; set axes (--read.axes) "
            "to llff (down, right, back) or endonerf (right, up, back)"
        )
    return options.axes


def _read(
    layout: str,
    read: Callable[..., Data],
    path: Any,
    options: ReadOptions,
    *,
    unused: Collection[str] = (),
    **settled: Any,
) -> Data:
    """Call a reader with a path and the options that were given, matched by name.

    Raises:
        ValueError: an option is given that the reader has no argument for, or that does not apply to the
            data.
    """
    given = {f.name for f in fields(options) if getattr(options, f.name) != f.default} - {"near"}
    taken = (inspect.signature(read).parameters.keys() & {f.name for f in fields(options)}) - set(unused)
    if refused := sorted(given - taken):
        expected = f"options for {layout} data ({', '.join(map(_flag, sorted({*taken, 'near'})))})"
        found = ", ".join(map(_flag, refused))
        raise ValueError(f"{path}: expected {expected}, found {found}. Leave it out.")
    data = read(path, **({name: getattr(options, name) for name in given} | settled))
    for name in sorted(given & _ABOUT.keys()):
        what, has = _ABOUT[name]
        if not has(data):
            expected = f"data with {what}, as {_flag(name)} is given"
            raise ValueError(f"{path}: expected {expected}, found none. Leave it out.")
    return replace(data, layout=layout)


def _flag(name: str) -> str:
    """The name of an option on the command line."""
    return f"--read.{name.replace('_', '-')}"


def open_photographs(path: str | Path, options: ReadOptions | None = None) -> Photographs:
    """Open the photographs in a folder (its layout is recognised), or all frames of a recording.

    Of photographs that are listed twice, one is kept (see `gsjax.data.duplicates`).

    Raises:
        DataError: there is no such folder, or its layout is unknown.
        ValueError: as for `open_sequence`, or `axes` is required and missing.
    """
    options = options or ReadOptions()
    return replace(_photographs(path, options), near=options.near)


def _photographs(path: str | Path, options: ReadOptions) -> Photographs:
    text = str(path)
    if text.startswith(SIMULATED_PREFIX):
        return photographs_of(open_sequence(text, options))
    if text.endswith(".json") and Path(path).is_file():
        return without_duplicates(_read("nerfstudio", transforms.read_transforms, Path(path), options))
    if _is_bag(Path(path)):
        return photographs_of(open_sequence(path, options))
    root = _folder(path)
    if (layout := layout_of(root, PHOTOGRAPHS)) is not None:
        return without_duplicates(_read_layout(layout, root, options))
    if is_recording(root):
        return photographs_of(open_sequence(root, options))
    raise _unknown(root, PHOTOGRAPHS + RECORDINGS, options)


def is_recording(path: str | Path, images: str = "images") -> bool:
    """Whether a path holds a recording over time, judged by its files; `images` is the name of the folder of
    frames within."""
    root = Path(path)
    if str(path).startswith(SIMULATED_PREFIX) or _is_bag(root):
        return True
    return layout_of(root, RECORDINGS, images) is not None


def _is_bag(path: Path) -> bool:
    return path.suffix.lower() == ".bag"


def is_photographs(path: str | Path) -> bool:
    """Whether a path holds photographs of a static scene rather than a recording over time. EndoNeRF folders
    are both: `open_photographs` reads the left eye's frames, `open_sequence` everything."""
    if str(path).startswith(SIMULATED_PREFIX):
        return False
    root = Path(path)
    return (root.is_file() and root.suffix == ".json") or (
        root.is_dir() and layout_of(root, PHOTOGRAPHS) is not None
    )


def is_only_photographs(path: str | Path, images: str = "images") -> bool:
    """Whether a path holds photographs and no recording over time; `images` as in `is_recording`."""
    return is_photographs(path) and not is_recording(path, images)


def is_dataset_file(path: Path) -> bool:
    """Whether a file by itself may be a dataset: a video, a recording, a list of photographs."""
    return _is_bag(path) or clip.is_clip(path) or path.suffix.lower() in (".json", ".r3d")


def _folder(path: str | Path) -> Path:
    root = Path(path)
    if not root.is_dir():
        known = ", ".join(SIMULATED_PREFIX + name for name in SIMULATED_SCENES)
        found = "a file" if root.exists() else "nothing there"
        advice = f"Pass its folder, or a built-in scene: {known}."
        if clip.is_clip(root):
            found, advice = "a video, which has no poses", _find_poses(root)
        elif root.suffix.lower() == ".r3d":
            found, advice = "an .r3d file, whose depth is not read", EXPORT_THIS
        raise DataError(root, "a folder with a recording", found, advice)
    return root


def _find_poses(images: Path) -> str:
    return f"Find them first: gsjax poses {images} --out DATASET, then give DATASET."


def _unknown(root: Path, layouts: tuple[Layout, ...], options: ReadOptions) -> DataError:
    if (missing := colmap.find_missing_file(root)) is not None:
        return DataError(missing, "a file of the reconstruction", "no such file", COMPLETE)
    from gsjax.io.sequences import scenes_in_words, scenes_within  # slow to import

    if not any(root.iterdir()):
        return DataError(root, "a dataset", "an empty folder", "Check the path.")
    scenes = scenes_within(root)
    of_photographs = ", ".join(mark for layout in PHOTOGRAPHS for mark in layout.marks)
    expected = f"poses of the photographs ({of_photographs})"
    for folder in (root, root / options.images):
        files = [*folder.iterdir()] if folder.is_dir() else []
        count = sum(map(is_picture, files))
        if count and count >= len(scenes):
            return DataError(root, expected, f"{count} photographs without poses", _find_poses(folder))
        reject_unread(folder, expected, files)
    if scenes:
        advice = "Give a file, or a folder of nothing but numbered ones, to gsjax view, info or export."
        return DataError(root, "a dataset", scenes_in_words(scenes), advice)
    if (lacking := without_poses(root)) is not None:
        return lacking
    names = sorted(entry.name for entry in root.iterdir())
    found = shortened(names, 8)
    advice = "Give the folder that holds them."
    if layouts == RECORDINGS:
        advice = f"Give the folder that holds them; photographs ({of_photographs}) are for gsjax fit."
    return DataError(root, f"the files of a known layout: {in_words(*layouts)}", found, advice)


def _simulate(text: str) -> Sequence:
    name, _, query = text.removeprefix(SIMULATED_PREFIX).partition("?")
    if name not in SIMULATED_SCENES:
        raise ValueError(f"no built-in scene {name!r}; available: {', '.join(SIMULATED_SCENES)}")
    scene = SIMULATED_SCENES[name]
    parameters = inspect.signature(scene).parameters
    arguments = {}
    for key, value in parse_qsl(query, keep_blank_values=True):
        if key not in parameters:
            raise ValueError(f"{text}: {name} has no argument {key!r}; it has: {', '.join(parameters)}")
        arguments[key] = _parse(text, key, value, type(parameters[key].default))
    return scene(**arguments)


def _parse(text: str, key: str, value: str, kind: type) -> int | float | bool | str:
    """A value of the type of the argument's default; booleans are written true, false, 1 or 0."""
    if kind is bool and value.lower() in ("true", "false", "1", "0"):
        return value.lower() in ("true", "1")
    if kind is str:
        return value
    if kind is int and value.removeprefix("-").isdecimal():
        return int(value)
    if kind is float:
        with suppress(ValueError):
            return float(value)
    wanted = {bool: "true or false", int: "an integer", float: "a number"}[kind]
    raise ValueError(f"{text}: {key} must be {wanted}, got {value!r}")
