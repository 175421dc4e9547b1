"""Files of BOP datasets other than those of single frames: entries by number, and the models of objects.

models_eval/models_info.json   by obj_id: diameter (mm), optionally symmetries_discrete (4x4, row by row, mm)
                               and symmetries_continuous (axis, offset in mm)
models_eval/obj_OBJ_ID.ply     vertices in millimetres
"""

from collections.abc import Callable, Collection
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float
from scipy.spatial.transform import Rotation

from gsjax.data.clouds import read_cloud
from gsjax.data.errors import DataError
from gsjax.data.files import read_json
from gsjax.data.objects import ObjectModel
from gsjax.data.validation import check_poses

MM = 0.001
MODELS, INFO = "models_eval", "models_info.json"
# Of a continuous symmetry: BOP's ceil(pi / 0.01), about 1 % of the diameter apart.
_NUM_ROTATIONS = 315


def by_number(path: Path, parse: Callable[[Any], Any], what: str = "frame") -> dict[int, Any]:
    """The entries of a file, by the number of the frame or object that they describe.

    Args:
        path: a JSON file whose keys are numbers.
        parse: parses the value of a key.
        what: what the numbers stand for, for messages.

    Raises:
        DataError: the file is missing, malformed, or an entry cannot be parsed.
    """
    described = read_json(path)
    key = "its outermost level"
    try:
        entries = {}
        for key in described:
            if int(key) in entries:
                raise ValueError(f"a second entry of {what} {int(key)}")
            entries[int(key)] = parse(described[key])
    except (AttributeError, TypeError, KeyError, IndexError, ValueError, OverflowError) as error:
        expected = f"entries of this layout, by {what} number"
        found = f"something else ({type(error).__name__}: {error}) in {key!r}"
        raise DataError(path, expected, found, "Correct that entry, or fetch the file again.") from None
    return entries


def read_models(dataset: Path, numbers: Collection[int]) -> dict[int, ObjectModel]:
    """The models of these objects, by number; objects that the dataset's models_eval lacks are left out.

    Args:
        dataset: folder of the dataset, above that of the split.
        numbers: obj_id of each object.

    Raises:
        DataError: a file is malformed, or a model has no vertices.
    """
    folder = dataset / MODELS
    if not (folder / INFO).is_file():
        return {}
    described, models = by_number(folder / INFO, _model_info, "object"), {}
    for number in sorted(described.keys() & set(numbers)):
        file = folder / f"obj_{number:06d}.ply"
        if not file.is_file():
            continue
        points = MM * read_cloud(file).points
        if not len(points):
            raise DataError(file, "a model with vertices", "none", "Fetch the file again.")
        models[number] = ObjectModel(f"{MODELS}/{file.name}", points, *described[number])
    return models


def _model_info(entry: dict[str, Any]) -> tuple[float, Float[np.ndarray, "symmetries 4 4"]]:
    """The diameter of a model, metres, and its symmetries."""
    diameter = MM * float(entry["diameter"])
    if not 0 < diameter < np.inf:
        raise ValueError(f"diameter is {entry['diameter']}")
    return diameter, _symmetries(entry)


def _symmetries(entry: dict[str, Any]) -> Float[np.ndarray, "symmetries 4 4"]:
    """All symmetries, metres: each discrete one, the identity first, alone or followed by each rotation of a
    continuous one."""
    discrete = [np.eye(4)]
    for values in entry.get("symmetries_discrete", []):
        motion = np.array(values, np.float64).reshape(4, 4)
        motion[:3, 3] *= MM
        discrete.append(motion)
    check_poses("symmetry", np.stack(discrete)[:, None], lambda i, _: f"place {i - 1}", "Use rigid motions.")
    turns = [_rotations(symmetry) for symmetry in entry.get("symmetries_continuous", [])]
    if not turns:
        return np.stack(discrete)
    return (np.concatenate(turns)[:, None] @ np.stack(discrete)).reshape(-1, 4, 4)


def _rotations(symmetry: dict[str, Any]) -> Float[np.ndarray, "turns 4 4"]:
    """Rotations about an axis in equal steps of a full turn, the identity first."""
    axis = np.array(symmetry["axis"], np.float64).reshape(3)
    offset = MM * np.array(symmetry.get("offset", [0, 0, 0]), np.float64).reshape(3)
    length = np.linalg.norm(axis)
    if not (0 < length < np.inf and np.isfinite(offset).all()):
        raise ValueError(f"axis is {axis}, offset is {offset}")
    angles = np.linspace(0, 2 * np.pi, _NUM_ROTATIONS, endpoint=False)
    motions = np.tile(np.eye(4), (_NUM_ROTATIONS, 1, 1))
    motions[:, :3, :3] = Rotation.from_rotvec(angles[:, None] * axis / length).as_matrix()
    motions[:, :3, 3] = offset - motions[:, :3, :3] @ offset
    return motions
