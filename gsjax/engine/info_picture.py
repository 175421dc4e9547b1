"""The picture of `gsjax info --picture`: cameras, coloured by their use, and points."""

from collections.abc import Mapping
from pathlib import Path

import numpy as np
from jaxtyping import Float

from gsjax.data import Photographs, Sequence
from gsjax.engine.options import HeldOutFrames
from gsjax.engine.photographs import split
from gsjax.io.atomic import atomic_write
from gsjax.scene.initialize import points_from_rgbd
from gsjax.scene.origin import cameras_in_world, in_world

_DEPTHS, _PIXELS = 12, 3000  # if the data have no points: depth images to use, and points from each
_MOST_COLORS = 8
_OTHERS = "not used"

Groups = Mapping[str, np.ndarray]
"""Indices of photographs, by their name in the legend."""


def by_split(photographs: Photographs) -> Groups:
    """Photographs by the use that `gsjax fit` makes of them by default."""
    fitted, held_out = split(photographs, HeldOutFrames.test_every)
    others = np.setdiff1d(np.arange(photographs.num), np.concatenate([fitted, held_out]))
    groups = {"fitted": fitted, "held out": held_out, _OTHERS: others}
    return {name: indices for name, indices in groups.items() if len(indices)}


def by_camera(sequence: Sequence) -> Groups:
    """The frames of each camera of a recording, by their indices in `photographs_of`."""
    indices = np.arange(sequence.num_frames * sequence.num_cameras)
    if sequence.num_cameras > _MOST_COLORS:
        return {"cameras": indices}
    return {f"camera {id}": indices[c :: sequence.num_cameras] for c, id in enumerate(sequence.camera_ids)}


def write_picture(path: Path, photographs: Photographs, groups: Groups) -> None:
    """Draw cameras and points into a file, in the format of its suffix."""
    from gsjax.viz.cameras import CameraGroup, cameras_and_points
    from gsjax.viz.colors import BACKGROUND, label_color
    from gsjax.viz.plots import save

    def color(number: int, name: str) -> str:
        return "#{:02x}{:02x}{:02x}".format(*(BACKGROUND if name == _OTHERS else label_color(number + 1)))

    points, colors = scene_points(photographs)
    viewmats = cameras_in_world(photographs.viewmats, photographs.origin)
    figure = cameras_and_points(
        {
            name: CameraGroup(
                viewmats[chosen],
                photographs.Ks[chosen],
                photographs.sizes[chosen],
                color(number, name),
            )
            for number, (name, chosen) in enumerate(groups.items())
        },
        None if points is None else in_world(points, photographs.origin),
        colors,
        unit="m" if photographs.load_depth is not None else "units of the data",
        title=photographs.name,
    )
    with atomic_write(path) as temporary:
        save(figure, temporary)


def scene_points(
    photographs: Photographs,
) -> tuple[Float[np.ndarray, "m 3"], Float[np.ndarray, "m 3"]] | tuple[None, None]:
    """Points with colours, 0 to 1: those of the data, else from some of its depth images; None if it has
    neither."""
    if photographs.cloud is not None and len(photographs.cloud.points):
        return photographs.cloud.points, photographs.cloud.colors
    if photographs.load_depth is None:
        return None, None
    random, points, colors = np.random.default_rng(0), [], []
    for i in np.unique(np.linspace(0, photographs.num - 1, _DEPTHS).astype(int)).tolist():
        depth = photographs.depth(i)
        if depth is None or not (depth > 0).any():
            continue
        fisheye = None if photographs.fisheye is None else photographs.fisheye[i]
        stride = max(1, int(np.sqrt((depth > 0).sum() / (4 * _PIXELS))))
        pose = photographs.viewmats[i], photographs.Ks[i]
        seen = points_from_rgbd(photographs.image(i), depth, *pose, fisheye=fisheye, stride=stride)
        some = random.choice(len(seen[0]), min(_PIXELS, len(seen[0])), replace=False)
        points.append(seen[0][some])
        colors.append(seen[1][some])
    if not points:
        return None, None
    return np.concatenate(points), np.concatenate(colors)
