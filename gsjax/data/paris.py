"""Two states of an articulated object, as in PARIS (Liu et al. 2023), each photographed by its own cameras.

start/camera_train.json       K (3x3, pixel centres at +0.5), and for each NAME camera to world, OpenGL axes;
                              _val and _test likewise
start/train/NAME.png          the object on a transparent background; or in start/train/rgba/
start/train/depth/NAME.png    uint16 millimetres, 0 = invalid, of depth-augmented copies, optional
end/                          the same of the other state
trans.json                    optional; also in gt/ or textured_objs/: trans_info with axis (o, d), type, and
                              rotate (degrees) or translate, from l (start) to r (end); one, or a list of them
"""

import warnings
from pathlib import Path
from typing import Any, Literal, NamedTuple

import numpy as np
from jaxtyping import Float

from gsjax.data.errors import COMPLETE, DataError, DataWarning
from gsjax.data.files import image_size, read_depth, read_image, read_json
from gsjax.data.names import find_file
from gsjax.data.objects import Truth
from gsjax.data.origin import near_origin
from gsjax.data.pictures import SUFFIXES
from gsjax.data.sequence import Sequence
from gsjax.data.validation import check_intrinsics, check_poses
from gsjax.geometry.cameras import viewmat_from_opengl
from gsjax.geometry.joints import Joint
from gsjax.io.brief import shortened

STATES = ("start", "end")
DEPTH_UNIT_M = 0.001
Split = Literal["train", "val", "test"]
_FOLDERS = ("rgba", "rgb", ".")
_TRUTHS = ("trans.json", "gt/trans.json", "textured_objs/trans.json")
_ADVICE = "Correct that entry, or fetch the file again."


class _State(NamedTuple):
    """The pictures of a state, by name, their poses, and names of those that cannot be used."""

    K: Float[np.ndarray, "3 3"]
    poses: dict[str, Float[np.ndarray, "4 4"]]
    images: dict[str, Path]
    lost: list[str]


@near_origin
def read_paris(path: str | Path, *, split: Split = "train", depth_unit_m: float = DEPTH_UNIT_M) -> Sequence:
    """Two frames, the start at 0 s and the end at 1 s. Pictures of the same name count as one camera, even if
    its pose differs between the states (as in PARIS's own data, except for the test cameras).

    Cameras have the numbers of their names. Pictures without a file, without a finite pose or without a
    partner in the other state are left out, with a DataWarning that counts them. Lengths are in the unit of
    the poses; PARIS's objects are about 1 unit wide. There are no masks; the truth, if there is one, has the
    moving parts and their joints.

    Args:
        path: the folder that holds start and end.
        split: which pictures: train, val or test.
        depth_unit_m: units of length per depth step.

    Raises:
        DataError: a file is missing or malformed, or no name has a picture in both states.
        ValueError: a pose is not a rigid motion, or `K` is invalid.
    """
    root = Path(path)
    states = [_read_state(root, state, split) for state in STATES]
    names = sorted(states[0].poses.keys() & states[1].poses.keys())
    every = {name for state in states for name in (*state.poses, *state.lost)}
    if not names:
        counted = " and ".join(
            f"{len(state.poses)} in {which}" for which, state in zip(STATES, states, strict=True)
        )
        advice = f"Check the names in camera_{split}.json. {COMPLETE}"
        raise DataError(root, "pictures of one name in both states", f"{counted}, none in both", advice)
    if len(names) < len(every):
        left_out = sorted(every - set(names))
        some = f"{len(left_out)} of {len(every)} cameras lack a picture or a pose in a state and are left out"
        warnings.warn(f"{root}: {some} ({shortened(left_out)})", DataWarning, stacklevel=2)
    width, height = image_size(states[0].images[names[0]])
    numbers = [int(name) if name.isdecimal() else -1 for name in names]
    unique = len(set(numbers)) == len(numbers) and -1 not in numbers
    depths = [root / state / split / "depth" for state in STATES]

    def picture(kind: str, t: int, c: int) -> Path:
        return depths[t] / f"{names[c]}.png" if kind == "depth" else states[t].images[names[c]]

    return Sequence(
        name=root.resolve().name,
        camera_ids=tuple(numbers) if unique else tuple(range(len(names))),
        width=width,
        height=height,
        times=np.array([0.0, 1.0]),
        frame_ids=(0, 1),
        Ks=np.stack([np.broadcast_to(state.K, (len(names), 3, 3)) for state in states]),
        viewmats=viewmat_from_opengl(np.array([[state.poses[name] for name in names] for state in states])),
        load_image=lambda t, c: read_image(picture("image", t, c), width, height),
        load_depth=(lambda t, c: read_depth(picture("depth", t, c), depth_unit_m, width, height))
        if all(folder.is_dir() for folder in depths)
        else None,
        truth=_read_truth(root),
        locate=lambda kind, t, c: str(picture(kind, t, c)),
    )


def _read_state(root: Path, state: str, split: str) -> _State:
    path = root / state / f"camera_{split}.json"
    described = read_json(path)
    key = "K"
    try:
        K, poses = np.array(described["K"], np.float64).reshape(3, 3), {}
        for key in sorted(described.keys() - {"K"}):
            poses[key] = np.array(described[key], np.float64).reshape(4, 4)
    except (AttributeError, TypeError, KeyError, ValueError, OverflowError) as error:
        found = f"something else ({type(error).__name__}: {error}) in {key!r}"
        raise DataError(path, "K of 3x3 and poses of 4x4 numbers, by name", found, _ADVICE) from None
    check_intrinsics(K[None, None], lambda *_: str(path))
    files = {name: _find(root / state / split, name) for name in poses}
    images = {name: file for name, file in files.items() if file is not None}
    if poses and not images:
        found = f"none of {len(poses)}, for example no {min(poses)}.png"
        raise DataError(root / state / split, f"the pictures listed in {path.name}", found, COMPLETE)
    usable = sorted(name for name in images if np.isfinite(poses[name]).all())
    if usable:
        checked = np.stack([poses[name] for name in usable])[:, None]
        check_poses("pose", checked, lambda i, _: f"{usable[i]} in {path}", "Poses are camera to world.")
    lost = sorted(poses.keys() - set(usable))
    return _State(K, {name: poses[name] for name in usable}, images, lost)


def _find(folder: Path, name: str) -> Path | None:
    found = (find_file(folder / inner, name, SUFFIXES) for inner in _FOLDERS)
    return next((file for file in found if file is not None), None)


def _read_truth(root: Path) -> Truth | None:
    """The moving parts and their joints; None if no file describes them."""
    path = next((root / name for name in _TRUTHS if (root / name).is_file()), None)
    if path is None:
        return None
    described = read_json(path)
    try:
        parts = described["trans_info"]
        joints = [_joint(part) for part in (parts if isinstance(parts, list) else [parts])]
    except (AttributeError, TypeError, KeyError, ValueError, OverflowError) as error:
        found = f"something else ({type(error).__name__}: {error})"
        raise DataError(path, "trans_info with axis, type, and rotate or translate", found, _ADVICE) from None
    if not joints:
        return None
    names = tuple(f"part {k + 1}" for k in range(len(joints)))
    poses = np.stack([joint.motions() for joint in joints], axis=1)
    return Truth(names, np.arange(1, len(joints) + 1), poses, joints=tuple(joints))


def _joint(part: dict[str, Any]) -> Joint:
    direction = np.array(part["axis"]["d"], np.float64)
    turns = part.get("type", "rotate" if "rotate" in part else "translate") == "rotate"
    travel = part["rotate" if turns else "translate"]
    values = np.array([travel["l"], travel["r"]], np.float64)
    point = np.array(part["axis"]["o"], np.float64)
    if not (np.isfinite(values).all() and np.isfinite(point).all()):
        raise ValueError("not finite")
    kind, values = ("revolute", np.deg2rad(values)) if turns else ("prismatic", values)
    return Joint(kind, direction / max(np.linalg.norm(direction), 1e-12), point, values)
