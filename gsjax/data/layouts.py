"""The layouts of recordings and photographs in folders: the files that identify each, and its reader."""

from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

from gsjax.data import colmap, poses_bounds, transforms
from gsjax.data.bop import read_bop
from gsjax.data.endonerf import is_endonerf, read_endonerf
from gsjax.data.endovis import LEFT, is_endovis, read_endovis
from gsjax.data.open3d_rgbd import is_open3d, read_open3d
from gsjax.data.panoptic import read_panoptic
from gsjax.data.paris import read_paris
from gsjax.data.photographs import Photographs
from gsjax.data.push_t import read_push_t
from gsjax.data.record3d import is_record3d, read_record3d
from gsjax.data.sequence import Sequence
from gsjax.data.seven_scenes import read_seven_scenes
from gsjax.data.tum import read_tum


class Layout(NamedTuple):
    """A layout of the files of a folder.

    Attributes:
        name: as users know it.
        marks: the files that identify it: glob patterns that match in no other layout or, with `recognise`,
            a description for messages.
        read: its reader, which has an argument for each of the `ReadOptions` that apply to this layout.
        recognise: (folder, name of the folder of images within) -> whether it has this layout; None if the
            patterns decide.
        needs_axes: whether its reader must be told the meaning of the rotation columns.
    """

    name: str
    marks: tuple[str, ...]
    read: Callable[..., Sequence | Photographs]
    recognise: Callable[[Path, str], bool] | None = None
    needs_axes: bool = False

    def is_of(self, root: Path, images: str = "images") -> bool:
        """Whether a folder has this layout.

        Args:
            root: the folder.
            images: name of the folder of images within.
        """
        if self.recognise is not None:
            return self.recognise(root, images)
        return any(next(root.glob(mark), None) is not None for mark in self.marks)


def _has_videos(root: Path) -> bool:
    return next(root.glob("cam*.mp4"), None) is not None


RECORDINGS = (
    Layout("Panoptic", ("train_meta.json",), read_panoptic),
    Layout("push-T", ("sample_demos",), read_push_t),
    Layout("TUM RGB-D", ("rgb.txt",), read_tum),
    Layout("7-Scenes", ("frame-*.pose.txt", "frame-*.color.*", "seq-*/"), read_seven_scenes),
    Layout("BOP", ("scene_camera*.json", "*/scene_camera.json"), read_bop),
    Layout("PARIS", ("start/camera_*.json",), read_paris),
    Layout("Open3D", ("color, depth and a trajectory (.log)",), read_open3d, lambda root, _: is_open3d(root)),
    Layout("Record3D", ("rgb and depth/*.exr",), read_record3d, lambda root, _: is_record3d(root)),
    Layout(
        "DyNeRF",
        ("poses_bounds.npy and cam*.mp4",),
        poses_bounds.read_dynerf,
        lambda root, _: poses_bounds.find(root) is not None and _has_videos(root),
    ),
    Layout("EndoNeRF", ("poses_bounds.npy and depth or masks",), read_endonerf, is_endonerf, needs_axes=True),
    Layout("EndoVis", (LEFT,), read_endovis, lambda root, _: is_endovis(root)),
)
"""Layouts of recordings over time; a folder has the first that it matches."""

PHOTOGRAPHS = (
    Layout("nerfstudio", ("transforms.json",), transforms.read_transforms),
    Layout(
        "Blender",
        ("transforms_train.json",),
        transforms.read_transforms,
        lambda root, _: next(root.glob("transforms_*.json"), None) is not None,
    ),
    Layout(
        "COLMAP",
        ("sparse/0/cameras.bin",),
        colmap.read_colmap,
        lambda root, _: bool(colmap.find_models(root)),
    ),
    Layout(
        "LLFF",
        ("poses_bounds.npy",),
        poses_bounds.read_llff,
        lambda root, _: poses_bounds.find(root) is not None and not _has_videos(root),
        needs_axes=True,
    ),
)
"""Layouts of photographs of a static scene; a folder has the first that it matches."""


def layout_of(root: Path, layouts: tuple[Layout, ...], images: str = "images") -> Layout | None:
    """The layout of a folder, judged by its files; None if it has none of those given.

    Args:
        root: the folder.
        layouts: `RECORDINGS` or `PHOTOGRAPHS`.
        images: name of the folder of images within.
    """
    return next((layout for layout in layouts if layout.is_of(root, images)), None)


def in_words(*layouts: Layout) -> str:
    """The names of layouts, each with the files that identify it."""
    return ", ".join(f"{layout.name} ({' or '.join(layout.marks)})" for layout in layouts)
