"""Opens recordings and sets of photographs in any layout that has a reader."""

import inspect
from collections.abc import Callable, Collection
from contextlib import suppress
from dataclasses import dataclass, fields, replace
from pathlib import Path
from typing import Any, NamedTuple, TypeVar
from urllib.parse import parse_qsl

import numpy as np

from gsjax.data import clip, colmap, poses_bounds, transforms
from gsjax.data.bop import read_bop
from gsjax.data.duplicates import without_duplicates
from gsjax.data.endonerf import is_endonerf, is_unambiguous_endonerf, read_endonerf
from gsjax.data.endovis import LEFT, is_endovis, read_endovis
from gsjax.data.errors import COMPLETE, DataError
from gsjax.data.open3d_rgbd import is_open3d, read_open3d, without_poses
from gsjax.data.panoptic import read_panoptic
from gsjax.data.paris import Split, read_paris
from gsjax.data.photographs import Photographs, photographs_of
from gsjax.data.pictures import is_picture, refuse_unread
from gsjax.data.push_t import read_push_t
from gsjax.data.realsense import read_realsense
from gsjax.data.record3d import EXPORT_THIS, is_record3d, read_record3d
from gsjax.data.sequence import Sequence
from gsjax.data.seven_scenes import read_seven_scenes
from gsjax.data.simulated import articulated, bar, cabinet, hard_parts, tabletop, tissue
from gsjax.data.through_lenses import Fisheye
from gsjax.data.tool_masks import Tool
from gsjax.data.tum import read_tum
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

# Glob pattern that only a folder of that layout matches -> the layout and its reader.
_LAYOUTS = {
    "train_meta.json": ("Panoptic", read_panoptic),
    "sample_demos": ("push-T", read_push_t),
    "rgb.txt": ("TUM RGB-D", read_tum),
    "frame-*.pose.txt": ("7-Scenes", read_seven_scenes),
    "frame-*.color.*": ("7-Scenes", read_seven_scenes),
    "seq-*": ("7-Scenes", read_seven_scenes),
    "scene_camera*.json": ("BOP", read_bop),
    "*/scene_camera.json": ("BOP", read_bop),
    "start/camera_*.json": ("PARIS", read_paris),
}
_RECORDINGS = {mark: layout for mark, (layout, _) in _LAYOUTS.items()} | {LEFT: "EndoVis"}
_RECORDINGS |= {"poses_bounds.npy and depth or masks": "EndoNeRF", "poses_bounds.npy and cam*.mp4": "DyNeRF"}
_RECORDINGS |= {"rgb and depth/*.exr": "Record3D", "color, depth and a trajectory (.log)": "Open3D"}

# Option -> what it is about, and whether data that were read have that.
_ABOUT = {
    "depth_unit_m": ("depth", lambda data: data.load_depth is not None),
    "depth_percentiles": ("depth", lambda data: data.load_depth is not None),
    "tool": ("masks", lambda data: data.load_mask is not None),
    "baseline_m": ("a right eye", lambda data: data.num_cameras > 1),
}

Data = TypeVar("Data", Sequence, Photographs)


@dataclass(frozen=True)
class ReadOptions:
    """Options for what some layouts leave open. A layout's reader takes those that it has arguments for; the
    others are refused rather than ignored."""

    K: tuple[float, float, float, float] | None = None
    """fx fy cx cy for data without intrinsics (Open3D, videos) or by one's own camera (TUM, 7-Scenes), in
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
    """Photographs by fisheyes (COLMAP, nerfstudio): undistort to pinhole views, which lose what lies far off
    the axis, or keep as they are and render through the same lens."""
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
    """What stands still in a recording without poses of its camera (BOP): camera, or the number of an object,
    such as 5, whose frame is then the world."""
    split: Split = "train"
    """Which pictures of the two states (PARIS): train, val or test."""
    baseline_m: float | None = None
    """Metres from the left eye to the right one (EndoNeRF, EndoVis without a calibration)."""
    near: float = NEAR
    """Near clipping distance, in the unit of the poses: nothing nearer to a camera is drawn, for example the
    rig where cameras see each other."""

    def __post_init__(self):
        if not 0 <= self.near < np.inf:
            raise ValueError(f"near: expected 0 or more, found {self.near}")
        for name in ("depth_unit_m", "pose_unit_m", "baseline_m"):
            if (length := getattr(self, name)) is not None and not 0 < length < np.inf:
                raise ValueError(f"{name}: expected metres above 0, found {length}")


def open_sequence(path: str | Path, options: ReadOptions | None = None) -> Sequence:
    """Open the sequence in a folder, whose layout is recognised, a video, or a built-in scene.

    A video, or frames with masks but without poses, are read as one camera that stands still. A built-in
    scene is "simulated:NAME", optionally followed by arguments of its function, as in
    "simulated:tabletop?seed=3&frames=20&hide=true".

    Raises:
        DataError: there is no such folder, its layout is unknown, or it holds photographs without a time.
        ValueError: there is no built-in scene of that name, it has no such argument, an option is missing, or
            one is given that the layout has no use for.
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
    for mark, (layout, read) in _LAYOUTS.items():
        if next(root.glob(mark), None):
            return _read(layout, read, root, options)
    if is_open3d(root):
        return _read("Open3D", read_open3d, root, options)
    if is_record3d(root):
        return _read("Record3D", read_record3d, root, options)
    if poses_bounds.find(root) and next(root.glob("cam*.mp4"), None):
        return _read("DyNeRF", poses_bounds.read_dynerf, root, options)
    if is_endonerf(root, options.images):
        return _read("EndoNeRF", read_endonerf, root, options, axes=_axes(root, options))
    if is_endovis(root):
        return _read("EndoVis", read_endovis, root, options)
    photographs = _photograph_layout(root)
    if photographs:
        found = f"photographs ({photographs.name} layout), which are not ordered in time"
        raise DataError(root, "a recording over time", found, "Use gsjax fit for photographs.")
    if clip.is_clip(root, options.images, options.masks):
        return _read("clip", clip.read_clip, root, options)
    raise _unknown(root, _RECORDINGS, options)


def _read(
    layout: str,
    read: Callable[..., Data],
    path: Any,
    options: ReadOptions,
    *,
    unused: Collection[str] = (),
    **settled: Any,
) -> Data:
    """What a reader makes of a path and of the options that were given, which it takes by their names.

    Raises:
        ValueError: an option is given that the reader has no argument for, or that the data has no use for.
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
    """An option as the command line spells it."""
    return f"--read.{name.replace('_', '-')}"


def open_photographs(path: str | Path, options: ReadOptions | None = None) -> Photographs:
    """Open the photographs in a folder, whose layout is recognised, or all frames of a recording.

    Of photographs that are listed twice, one is left (see `gsjax.data.duplicates`).

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
    if (layout := _photograph_layout(root)) is not None:
        settled = {"axes": _axes(root, options)} if layout.read is poses_bounds.read_llff else {}
        return without_duplicates(_read(layout.name, layout.read, root, options, **settled))
    if is_recording(root):
        return photographs_of(open_sequence(root, options))
    raise _unknown(root, {layout.mark: layout.name for layout in _PHOTOGRAPHS} | _RECORDINGS, options)


def is_recording(path: str | Path) -> bool:
    """Whether a path holds a recording over time, judged by its files."""
    root = Path(path)
    known = _is_bag(root) or any(next(root.glob(mark), None) for mark in _LAYOUTS)
    known = known or any(layout(root) for layout in (is_open3d, is_record3d, is_endonerf, is_endovis))
    return str(path).startswith(SIMULATED_PREFIX) or known or next(root.glob("cam*.mp4"), None) is not None


def _is_bag(path: Path) -> bool:
    return path.suffix.lower() == ".bag"


def is_photographs(path: str | Path) -> bool:
    """Whether a path holds photographs of a static scene rather than a recording over time. EndoNeRF folders
    are both: `open_photographs` reads the left eye's frames, `open_sequence` everything."""
    if str(path).startswith(SIMULATED_PREFIX):
        return False
    root = Path(path)
    return (root.is_file() and root.suffix == ".json") or (
        root.is_dir() and _photograph_layout(root) is not None
    )


def is_dataset_file(path: Path) -> bool:
    """Whether a file by itself may be a dataset: a video, a recording, a list of photographs."""
    return _is_bag(path) or clip.is_clip(path) or path.suffix.lower() in (".json", ".r3d")


class _PhotographLayout(NamedTuple):
    """A layout of photographs: its name, the file that marks it, whether a folder has it, and its reader."""

    name: str
    mark: str
    is_layout_of: Callable[[Path], bool]
    read: Callable[..., Photographs]


_PHOTOGRAPHS = (
    _PhotographLayout(
        "nerfstudio",
        "transforms.json",
        lambda root: (root / "transforms.json").is_file(),
        transforms.read_transforms,
    ),
    _PhotographLayout(
        "Blender",
        "transforms_train.json",
        lambda root: next(root.glob("transforms_*.json"), None) is not None,
        transforms.read_transforms,
    ),
    _PhotographLayout(
        "COLMAP",
        "sparse/0/cameras.bin",
        lambda root: bool(colmap.find_models(root)),
        colmap.read_colmap,
    ),
    _PhotographLayout(
        "LLFF",
        "poses_bounds.npy",
        lambda root: bool(poses_bounds.find(root)) and not next(root.glob("cam*.mp4"), None),
        poses_bounds.read_llff,
    ),
)


def _photograph_layout(root: Path) -> _PhotographLayout | None:
    """The layout of a folder of photographs, judged by its files; None if it has none."""
    return next((layout for layout in _PHOTOGRAPHS if layout.is_layout_of(root)), None)


def _axes(root: Path, options: ReadOptions) -> poses_bounds.Axes:
    if options.axes is None and is_unambiguous_endonerf(root, options.images):
        return "endonerf"
    if options.axes is None:
        raise ValueError(
            f"{root}: poses_bounds.npy does not state the meaning of its columns; set axes (--read.axes) "
            "to llff (down, right, back) or endonerf (right, up, back)"
        )
    return options.axes


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


def _unknown(root: Path, marks: dict[str, str], options: ReadOptions) -> DataError:
    if (missing := colmap.find_missing_file(root)) is not None:
        return DataError(missing, "a file of the reconstruction", "no such file", COMPLETE)
    from gsjax.io.sequences import scenes_in_words, scenes_within  # slow to import

    if not any(root.iterdir()):
        return DataError(root, "a dataset", "an empty folder", "Check the path.")
    scenes = scenes_within(root)
    expected = f"poses of the photographs ({', '.join(layout.mark for layout in _PHOTOGRAPHS)})"
    for folder in (root, root / options.images):
        files = [*folder.iterdir()] if folder.is_dir() else []
        count = sum(map(is_picture, files))
        if count and count >= len(scenes):
            return DataError(root, expected, f"{count} photographs without poses", _find_poses(folder))
        refuse_unread(folder, expected, files)
    if scenes:
        advice = "Give a file, or a folder of nothing but numbered ones, to gsjax view, info or export."
        return DataError(root, "a dataset", scenes_in_words(scenes), advice)
    if (lacking := without_poses(root)) is not None:
        return lacking
    by_layout: dict[str, list[str]] = {}
    for mark, layout in marks.items():
        by_layout.setdefault(layout, []).append(mark)
    expected = ", ".join(f"{layout} ({' or '.join(several)})" for layout, several in by_layout.items())
    names = sorted(entry.name for entry in root.iterdir())
    found = shortened(names, 8)
    advice = "Give the folder that holds them."
    if not any(layout.mark in marks for layout in _PHOTOGRAPHS):
        photographs = ", ".join(layout.mark for layout in _PHOTOGRAPHS)
        advice = f"Give the folder that holds them; photographs ({photographs}) are for gsjax fit."
    return DataError(root, f"the files of a known layout: {expected}", found, advice)


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
    if kind is int and value.lstrip("-").isdecimal():
        return int(value)
    if kind is float:
        with suppress(ValueError):
            return float(value)
    wanted = {bool: "true or false", int: "an integer", float: "a number"}[kind]
    raise ValueError(f"{text}: {key} must be {wanted}, got {value!r}")
