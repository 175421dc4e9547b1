"""A run of `gsjax track` read back: the scene, its motion, and the recording that it was tracked in."""

from dataclasses import dataclass
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from gsjax.engine.files import chosen_camera, read_arrays, read_scene, relative_to_scene, reopen
from gsjax.engine.first_mask import OWN_MASKS
from gsjax.engine.folder import expect_run
from gsjax.engine.recording import Recording
from gsjax.engine.track.loop import Tracking
from gsjax.io.parsed import parse_json
from gsjax.methods.track import Pose, TrackedScene
from gsjax.scene.origin import relative_to

_AGAIN = "track again with this version of gsjax, or name another folder"


@dataclass(frozen=True, eq=False)
class SavedRun:
    """A run of `gsjax track`.

    Attributes:
        path: the folder.
        tracking: the scene and its poses; parts of one object are one group here.
        recording: the same frames and cameras as when it was tracked.
        mask_camera: id of the camera whose first mask gave the objects; the first tracked one if none did.
        names: name of each object, by its group, 1 to K.
    """

    path: Path
    tracking: Tracking
    recording: Recording
    mask_camera: int
    names: dict[int, str]

    def seen_by(self, camera: int | None) -> Recording:
        """The recording with one camera only; default: the first held-out one, else the first tracked.

        Raises:
            ValueError: the run had no such camera.
        """
        camera = chosen_camera(self.recording, camera, self.path)
        one = self.recording.judged.select(cameras=[camera])
        return Recording(one, one, self.recording.frames_in_data, self.recording.simulated)


def open_run(path: Path) -> SavedRun:
    """Read the folder of a run.

    Raises:
        FileNotFoundError: there is no such folder, it is not a run's, or one of its files is missing.
        ValueError: a file is not as the run wrote it, or its recording cannot be opened.
    """
    expect_run(path, made_by="`gsjax track`")
    missing = [n for n in ("trajectory.npz", "scene.ply", "metrics.json") if not (path / n).is_file()]
    if missing:
        raise FileNotFoundError(f"{path}: expected a complete run, found no {missing[0]}; {_AGAIN}")
    tracking, origin = read_tracking(path)
    recording = relative_to_scene(reopen(path / "config.yml", _AGAIN)[0], origin)
    if recording.tracked.num_frames < tracking.num_frames:
        found = f"{recording.tracked.num_frames} frames where the run has {tracking.num_frames}"
        raise ValueError(f"{path}: expected its recording as it was, found {found}; restore it, or {_AGAIN}")
    camera, names = _read_metrics(path / "metrics.json", tracking.scene)
    first = recording.tracked.camera_ids[0]
    return SavedRun(path, tracking, recording, first if camera is None else camera, names)


def read_tracking(path: Path) -> tuple[Tracking, Float[np.ndarray, "3"] | None]:
    """The scene of scene.ply with the poses of trajectory.npz, and the origin that they are relative to.

    Raises:
        ValueError: they do not match, or one of them cannot be read.
    """
    wanted = ("means", "quats", "normals", "labels", "label_ids", "lost", "turn_known")
    arrays = read_arrays(path / "trajectory.npz", wanted, _AGAIN)
    for name in ("means", "quats", "normals"):
        if lost := int((~np.isfinite(arrays[name])).sum()):
            found = f"{lost} of {arrays[name].size} that are not"
            raise ValueError(f"{path / 'trajectory.npz'}: expected finite {name}, found {found}; {_AGAIN}")
    means, quats, labels = arrays["means"], arrays["quats"], arrays["labels"]
    count, moving = means.shape[1], quats.shape[1]
    gaussians, origin = read_scene(path, count, "trajectory.npz", _AGAIN)
    if origin is not None:
        means = relative_to(means, origin).astype(np.float32)
    if len(labels) != count:
        raise ValueError(f"{path}: expected {count} labels in trajectory.npz, found {len(labels)}; {_AGAIN}")
    scene = TrackedScene(
        gaussians=gaussians,
        normals=jnp.asarray(arrays["normals"]),
        labels=jnp.asarray(labels, jnp.int32),
        label_ids=tuple(arrays["label_ids"].tolist()),
        num_moving=moving,
    )
    poses = jax.device_get(
        [Pose(jnp.asarray(m[:moving]), jnp.asarray(q)) for m, q in zip(means, quats, strict=True)]
    )
    flags = {name: [*arrays[name][1:]] for name in ("lost", "turn_known")}
    return Tracking(scene, poses, **flags), origin


def _read_metrics(file: Path, scene: TrackedScene) -> tuple[int | None, dict[int, str]]:
    """The camera whose mask gave the objects, and the name of each group; only labels of the recording's own
    masks have names in the file, others are numbered."""
    try:
        metrics = parse_json(file.read_text(encoding="utf-8"))
        camera, source = metrics["mask"]["camera"], metrics["mask"]["source"]
        known = {found["label"]: name for name, found in metrics["objects"].items()}
    except (ValueError, KeyError, TypeError, AttributeError) as error:
        raise ValueError(f"{file}: expected a run's scores, found something else; {_AGAIN}") from error
    if source not in OWN_MASKS:
        known = {}
    labels = enumerate(scene.label_ids[1:], 1)
    return camera, {k: known.get(label, f"object {label}") for k, label in labels}
