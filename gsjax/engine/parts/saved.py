"""A run of `gsjax parts` read back: the scene, the motion of its parts, and its recording."""

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import jax.numpy as jnp
import jaxlie
import numpy as np
from jaxtyping import Float

from gsjax.engine.files import check_arrays, chosen_camera, read_arrays, read_scene, relative_to_scene, reopen
from gsjax.engine.folder import expect_run
from gsjax.engine.recording import Recording
from gsjax.io.brief import brief
from gsjax.io.parsed import parse_json, parse_yaml
from gsjax.methods.parts import PartScene, order_of_frames, trajectory_of
from gsjax.methods.parts.film import Layer
from gsjax.methods.parts.timeline import Names
from gsjax.scene.handles import Blend, HandlePose
from gsjax.scene.origin import in_world, rebased, relative_to

_FILES = ("parts.npz", "scene.ply")
_ARRAYS = {
    "anchor": (),
    "weights": ("N", "P"),
    "centres": ("P", 3),
    "times": ("T",),
    "R": ("T", "P", 3, 3),
    "t": ("T", "P", 3),
}
_OPTIONAL = {"opacities": ("T", "P")}  # only if a part is absent in some frame
_AGAIN = "run gsjax parts again with this version of gsjax, or name another folder"


@dataclass(frozen=True, eq=False)
class PartsRun:
    """A run of `gsjax parts`.

    Attributes:
        path: the folder.
        layer: the scene, and its parts at the tracked frames.
        names: numbers of the parts by name: "part 1", and the name of the true part if it is known.
        complete: whether all frames were tracked.
        recording: the frames and cameras of the run.
        blend: how rotations are blended.
    """

    path: Path
    layer: Layer
    names: Names
    complete: bool
    recording: Recording
    blend: Blend

    def camera(self, camera: int | None) -> int:
        """The id of a camera of the run; default: the first held-out one, else the first.

        Raises:
            ValueError: the run had no such camera.
        """
        return chosen_camera(self.recording, camera, self.path)


def open_parts_run(path: Path) -> PartsRun:
    """Read the folder of a run, and open its recording.

    Raises:
        FileNotFoundError: there is no such folder, it is not that of a run, or one of its files is missing.
        ValueError: a file is not as the run wrote it, or its recording cannot be opened.
    """
    layer, names, complete, origin = _read(path)
    recording, blend = reopen(path / "config.yml", _AGAIN, _blend)
    return PartsRun(path, layer, names, complete, relative_to_scene(recording, origin), blend)


def blend_of(path: Path) -> Blend:
    """How a run blends rotations, read without opening its recording; the default if it does not say."""
    try:
        return _blend(parse_yaml((path / "config.yml").read_text(encoding="utf-8")))
    except (OSError, ValueError, KeyError, TypeError):
        return "quaternion"


def _blend(settings: Mapping[str, Any]) -> Blend:
    return settings["parts"]["stream"]["blend"]


def read_parts(path: str | Path) -> tuple[Layer, Names, Float[np.ndarray, "3"] | None]:
    """The scene of a run with its parts, their names, and the origin of the scene, without opening its
    recording.

    Raises:
        FileNotFoundError, ValueError: as for `open_parts_run`.
    """
    layer, names, _, origin = _read(Path(path))
    return layer, names, origin


def read_parts_about(path: str | Path, origin: Float[np.ndarray, "3"] | None) -> tuple[Layer, Names]:
    """As `read_parts`, relative to the origin of another run.

    Args:
        path: the folder.
        origin: that of the other run.

    Raises:
        FileNotFoundError, ValueError: as for `open_parts_run`.
    """
    layer, names, _, own = _read(Path(path))
    scene = layer.scene
    centers = jnp.asarray(relative_to(in_world(np.asarray(scene.centers), own), origin), float)
    scene = PartScene(rebased(scene.gaussians, own, origin), scene.weights, centers)
    return Layer(scene, layer.trajectory), names


def _read(path: Path) -> tuple[Layer, dict[str, int], bool, Float[np.ndarray, "3"] | None]:
    expect_run(path, made_by="`gsjax parts`")
    missing = [name for name in _FILES if not (path / name).is_file()]
    if missing:
        kind = _kind(path / "metrics.json")
        if kind not in (None, "parts"):
            raise ValueError(
                f"{path}: expected a run of `gsjax parts`, found one of `gsjax {kind}`; name another folder"
            )
        raise FileNotFoundError(
            f"{path}: expected a complete run of `gsjax parts`, found no {missing[0]}; {_AGAIN}"
        )
    arrays = _arrays(path / "parts.npz")
    num, parts = arrays["weights"].shape
    anchor, frames = int(arrays["anchor"]), len(arrays["times"])
    names, followed = {f"part {part}": part for part in range(1, parts)}, frames
    if (metrics := path / "metrics.json").is_file():  # written last, after scoring, which takes minutes
        names, followed = _of_metrics(metrics, frames)
    gaussians, origin = read_scene(path, num, "parts.npz", _AGAIN)
    arrays["centres"] = relative_to(arrays["centres"], origin)
    # The other frames hold the poses of the anchor.
    done = np.sort([anchor, *order_of_frames(frames, anchor)[: followed - 1]])
    since = arrays["times"] - arrays["times"][0]  # float32 cannot tell times of day apart
    R, t, times = (jnp.asarray(array[done], float) for array in (arrays["R"], arrays["t"], since))
    weights, centers = (jnp.asarray(arrays[name], float) for name in ("weights", "centres"))
    poses = HandlePose(jaxlie.SO3.from_matrix(R).wxyz, t)
    names = {name: part for name, part in names.items() if part < parts}
    shown = jnp.asarray(arrays["opacities"][done], float) if "opacities" in arrays else None
    layer = Layer(PartScene(gaussians, weights, centers), trajectory_of(times, poses, shown))
    return layer, names, len(done) == frames, origin


def _kind(file: Path) -> str | None:
    """The command that made a run; None if its metrics do not say."""
    try:
        return parse_json(file.read_text(encoding="utf-8")).get("kind")
    except (OSError, ValueError, AttributeError):
        return None


def _arrays(file: Path) -> dict[str, np.ndarray]:
    """The arrays of parts.npz, checked."""
    arrays = read_arrays(file, tuple(_ARRAYS), _AGAIN)
    there = {name: shape for name, shape in _OPTIONAL.items() if name in arrays}
    frames = check_arrays(file, arrays, _ARRAYS | there, _AGAIN)["T"]
    if there and not ((arrays["opacities"] >= 0) & (arrays["opacities"] <= 1)).all():
        raise ValueError(f"{file}: opacities: expected numbers from 0 to 1, found others; {_AGAIN}")
    times = arrays["times"] = arrays["times"].astype(np.float64)
    late = np.flatnonzero(np.diff(times) <= 0)
    if len(late):
        k = int(late[0]) + 1
        found = f"{times[k]} in frame {k} after {times[k - 1]}"
        raise ValueError(f"{file}: times: expected seconds that increase, found {found}; {_AGAIN}")
    anchor = arrays["anchor"]
    if anchor.dtype.kind not in "iu" or not 0 <= anchor < frames:
        expected = f"the index of one of {frames} frames, 0 to {frames - 1}"
        raise ValueError(f"{file}: anchor: expected {expected}, found {anchor}; {_AGAIN}")
    return arrays


def _of_metrics(file: Path, frames: int) -> tuple[dict[str, int], int]:
    """Parts by name, and the number of tracked frames."""
    try:
        metrics = parse_json(file.read_text(encoding="utf-8"))
        rows, followed = metrics["parts"], metrics["frames"]["followed"]
        called = [(row["part"], row["name"], row.get("true_name")) for row in rows]
    except (ValueError, KeyError, TypeError, AttributeError) as error:
        raise ValueError(f"{file}: expected a run's scores, found something else; {_AGAIN}") from error
    for part, name, true in called:
        if type(part) is not int or part < 0 or not isinstance(name, str) or not isinstance(true, str | None):
            expected = "part, name and true_name to be a number, a text and a text or null"
            found = brief(f"{part!r}, {name!r} and {true!r}")
            raise ValueError(f"{file}: expected {expected}, found {found}; {_AGAIN}")
    if type(followed) is not int or not 1 <= followed <= frames:
        expected = f"1 to {frames} tracked frames, as parts.npz has {frames}"
        raise ValueError(f"{file}: expected {expected}, found {brief(repr(followed))}; {_AGAIN}")
    # True names come last, because messages use the last of two names.
    names = {name: part for part, name, _ in called}
    return names | {true.lower().replace(" ", "_"): part for part, _, true in called if true}, followed
