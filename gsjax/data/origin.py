"""Recordings and photographs with coordinates far from 0, read relative to an origin of their own."""

import functools
import warnings
from collections.abc import Callable
from dataclasses import replace
from typing import Any, ParamSpec, TypeVar

import numpy as np
from jaxtyping import Float

from gsjax.data.errors import DataError, DataWarning
from gsjax.data.objects import PointModel, Truth
from gsjax.data.photographs import Photographs
from gsjax.data.sequence import Sequence
from gsjax.scene.origin import about, far_origin, origin_message

Data = TypeVar("Data", Photographs, Sequence)
Given = ParamSpec("Given")
_FARTHEST = 1e30  # squares of it are still finite
_MIN_EXTENT = 1.0  # assumed size of what static cameras see
_STILL = 1e-9  # movement, relative to the distance from 0


def near_origin(read: Callable[Given, Data]) -> Callable[Given, Data]:
    """Decorate a reader so that data far from 0 become relative to an `origin`, with a DataWarning. Errors of
    `Sequence` and `Photographs`, which do not know the folder, are raised again with its name.

    Args:
        read: reads photographs or a recording in the coordinates of the files.
    """

    @functools.wraps(read)
    def reader(*args: Given.args, **options: Given.kwargs) -> Data:
        try:
            data = read(*args, **options)
        except ValueError as error:
            where = str(args[0] if args else next(iter(options.values())))
            if isinstance(error, DataError) or where in str(error):
                raise
            raise ValueError(f"{where}: {error}") from error
        centers = np.linalg.solve(data.viewmats, np.array([0.0, 0.0, 0.0, 1.0])[:, None])[..., :3, 0]
        if not (np.abs(centers) < _FARTHEST).all():
            expected, found = f"cameras within {_FARTHEST:g} of 0", f"one at {np.abs(centers).max():g}"
            raise DataError(args[0] if args else data.name, expected, found, "Correct its pose.")
        cloud = data.cloud if isinstance(data, Photographs) else None
        least = _MIN_EXTENT if _are_static(centers) else 0.0
        origin = far_origin(centers.reshape(-1, 3), [] if cloud is None else [cloud.points], least)
        if origin is None:
            return data
        words = origin_message(centers.reshape(-1, 3), origin)
        warnings.warn(f"{data.name}: {words}, and put back in what is written", DataWarning, stacklevel=2)
        return relative_to_origin(data, origin)

    return reader


def _are_static(centers: Float[np.ndarray, "frames *cameras 3"]) -> bool:
    """Whether no camera moves: then the baseline of a pair or a rig says nothing about the scene's size."""
    return bool(np.ptp(centers, axis=0).max() <= _STILL * np.abs(centers).max())


def relative_to_origin(data: Data, origin: Float[np.ndarray, "3"] | None) -> Data:
    """The same data relative to another origin; None for the coordinates of the files."""
    old, new = (np.zeros(3) if each is None else each for each in (data.origin, origin))
    shift = new - old
    if not shift.any():
        return data
    changed: dict[str, Any] = {"origin": origin, "viewmats": about(data.viewmats, shift)}
    if isinstance(data, Photographs):
        if data.cloud is not None:
            changed["cloud"] = replace(data.cloud, points=np.asarray(data.cloud.points, np.float64) - shift)
    else:
        changed["truth"] = None if data.truth is None else _moved_truth(data.truth, shift)
        changed["models"] = tuple(_moved_model(model, shift) for model in data.models)
    return replace(data, **changed)


def _moved_truth(truth: Truth, shift: Float[np.ndarray, "3"]) -> Truth:
    tracks = None if truth.tracks is None else truth.tracks - shift
    joints = tuple(joint and replace(joint, point=joint.point - shift) for joint in truth.joints)
    return replace(truth, poses=_moved_poses(truth.poses, shift), joints=joints, tracks=tracks)


def _moved_model(model: PointModel, shift: Float[np.ndarray, "3"]) -> PointModel:
    pose = None if model.pose is None else _moved_poses(model.pose, shift)
    plane = model.plane
    if plane is not None:  # n.x + d = 0
        plane = np.append(plane[:3], plane[3] + plane[:3] @ shift)
    return replace(model, pose=pose, plane=plane)


def _moved_poses(
    poses: Float[np.ndarray, "*batch 4 4"], shift: Float[np.ndarray, "3"]
) -> Float[np.ndarray, "*batch 4 4"]:
    """Object-to-world transforms after the world's origin has moved by `shift`."""
    moved = np.array(poses, np.float64)
    moved[..., :3, 3] -= shift
    return moved
