"""The discovery of parts with extreme data and settings."""

import warnings
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Int

from experiments.shared.discoveries import FIT, Options, canonical_of
from experiments.shared.recordings import labels_at
from gsjax.data import Sequence, open_sequence
from gsjax.engine.drive import drive
from gsjax.io.ply import read_ply
from gsjax.methods.parts import (
    Parts,
    PartsConfig,
    PartsResult,
    begin,
    choose_anchor,
    moved_pixels,
)
from gsjax.metrics.tracking import relative_motion
from gsjax.perception.segmenters import PieceSegmenter
from gsjax.scene.gaussians import Gaussians, take

DATASET = "simulated:hard_parts?case=small&width=160&height=120&cameras=6&frames=12"
BLOCK, BOX = 1, 2  # labels


class Case(NamedTuple):
    """The input of a discovery.

    Attributes:
        sequence: the recording.
        gaussians: the scene at frame 0.
        labels: true labels of the Gaussians.
        config: settings.
        meter: length of a metre in units of the scene.
    """

    sequence: Sequence
    gaussians: Gaussians
    labels: Int[np.ndarray, "N"]
    config: PartsConfig
    meter: float = 1.0


def run(options: dict[str, Any], seed: int, folder: Path) -> dict[str, Any]:
    """One discovery; a ValueError is an outcome, any other error is raised."""
    case = CASES[options["case"]](as_it_is(folder.parent / "canonical"))
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always", UserWarning)
        try:
            row = discovered(case)
        except ValueError as error:
            nothing = dict.fromkeys(("skipped", "parts", "block_mm", "box_mm", "update_s"))
            return nothing | {"finite": None, "said": f"error: {error}"}
    warned = dict.fromkeys(str(one.message) for one in caught if one.category is UserWarning)
    return row | {"said": "; ".join(warned)}


def discovered(case: Case) -> dict[str, Any]:
    """A discovery as in `gsjax parts`, from an existing scene."""
    sequence, config = case.sequence, case.config
    anchor = choose_anchor(sequence.image, sequence.num_frames, sequence.num_cameras, 0)
    moved = moved_pixels(sequence.image, anchor, sequence.num_cameras)
    start = begin(sequence, case.gaussians, anchor, moved, config, PieceSegmenter(), jax.random.key(0))
    method = Parts(config)
    problem, run = method.start(sequence, start)
    ticks, skipped, seconds = drive(method, problem, run, headroom=config.headroom), 0, []
    for now in ticks:
        skipped += int(now.info["skipped"])
        seconds.append(now.seconds)
    result, steps = ticks.result, config.stream.iterations
    frames = np.reshape(seconds[: method.steps_of_frames(problem)], (-1, steps)).sum(1)
    everything = jax.tree.leaves(eqx.filter((result.scene, result.trajectory), eqx.is_inexact_array))
    block, box = (_error_mm(case, result, label) for label in (BLOCK, BOX))
    return {
        "finite": all(bool(jnp.isfinite(leaf).all()) for leaf in everything),
        "skipped": skipped,
        "parts": len(np.unique(np.asarray(result.scene.labels))) - 1,
        "block_mm": block,
        "box_mm": box,
        "update_s": float(np.median(frames)),
    }


def _error_mm(case: Case, result: PartsResult, label: int) -> float:
    """Median over the Gaussians of an object of their error, averaged over the frames, mm."""
    mine, truth = case.labels == label, case.sequence.truth
    frames = range(case.sequence.num_frames)
    means = np.stack([np.asarray(result.at(t).means)[mine] for t in frames])
    motions = relative_motion(truth.poses[:, list(truth.label_ids).index(label)])
    true = np.einsum("tij,nj->tni", motions[:, :3, :3], means[0]) + motions[:, None, :3, 3]
    off = np.linalg.norm(means - true, axis=-1).mean(0)
    return 1000 * float(np.median(off)) / case.meter


def as_it_is(folder: Path) -> Case:
    """The scene and its recording, unchanged."""
    sequence = open_sequence(DATASET)
    fit = replace(FIT, steps=1500, cap=5_000, start=replace(FIT.start, count=3_000))
    gaussians, _ = read_ply(canonical_of(Options(DATASET, folder, anchor=0, fit=fit), folder) / "scene.ply")
    labels = labels_at(sequence, np.asarray(gaussians.means))
    config = PartsConfig()
    return Case(sequence, gaussians, labels, replace(config, refine=replace(config.refine, iterations=60)))


def seen_as(change: Callable[[np.ndarray, int, int], np.ndarray]) -> Callable[[Case], Case]:
    """A case with pictures replaced by `change(picture, t, c)`."""

    def changed(case: Case) -> Case:
        load = case.sequence.load_image
        return case._replace(
            sequence=replace(case.sequence, load_image=lambda t, c: change(load(t, c), t, c))
        )

    return changed


def selected(**which: Any) -> Callable[[Case], Case]:
    """A case with a selection of frames or cameras."""
    return lambda case: case._replace(sequence=case.sequence.select(**which))


def set_to(section: str, **values: Any) -> Callable[[Case], Case]:
    """A case with other settings."""

    def changed(case: Case) -> Case:
        one = replace(getattr(case.config, section), **values)
        return case._replace(config=replace(case.config, **{section: one}))

    return changed


def larger(by: float) -> Callable[[Case], Case]:
    """A case in which everything is scaled, cameras included."""

    def changed(case: Case) -> Case:
        sequence, truth = case.sequence, case.sequence.truth
        viewmats, poses = sequence.viewmats.copy(), truth.poses.copy()
        viewmats[..., :3, 3] *= by
        poses[..., :3, 3] *= by
        load = sequence.load_depth
        sequence = replace(
            sequence,
            viewmats=viewmats,
            near=by * sequence.near,
            load_depth=lambda t, c: by * load(t, c),
            truth=replace(truth, poses=poses, joints=()),
        )
        gaussians = eqx.tree_at(
            lambda g: (g.means, g.log_scales),
            case.gaussians,
            (by * case.gaussians.means, case.gaussians.log_scales + np.log(by)),
        )
        return case._replace(sequence=sequence, gaussians=gaussians, meter=by)

    return changed


def fewer_gaussians(count: int) -> Callable[[Case], Case]:
    """A case with a random subset of the Gaussians."""

    def changed(case: Case) -> Case:
        rows = np.sort(np.random.default_rng(0).permutation(case.gaussians.num)[:count])
        return case._replace(gaussians=take(case.gaussians, rows), labels=case.labels[rows])

    return changed


def bad_depth(case: Case) -> Case:
    """Depth of which a third is NaN and a third infinite."""
    load = case.sequence.load_depth

    def broken(t: int, c: int) -> np.ndarray:
        depth = np.array(load(t, c), np.float32)
        depth[::3], depth[1::3] = np.nan, np.inf
        return depth

    return case._replace(sequence=replace(case.sequence, load_depth=broken))


def as_at_first(case: Case) -> Case:
    """A recording in which all pictures are those of frame 0."""
    load = case.sequence.load_image
    return case._replace(sequence=replace(case.sequence, load_image=lambda t, c: load(0, c)))


def noise(picture: np.ndarray, t: int, c: int) -> np.ndarray:
    """Random pixels in one camera."""
    return np.random.default_rng((t, c)).integers(0, 255, picture.shape, np.uint8) if c == 2 else picture


CASES: dict[str, Callable[[Case], Case]] = {
    "as it is": lambda case: case,
    "two cameras": selected(cameras=[2, 3]),
    "every fifth frame": selected(frames=slice(0, None, 5)),
    "twenty times larger": larger(20.0),
    "twenty times smaller": larger(0.05),
    "one camera black from frame 3 on": seen_as(lambda p, t, c: 0 * p if c == 2 and t >= 3 else p),
    "one camera noise": seen_as(noise),
    "all black from frame 5 on": seen_as(lambda p, t, c: 0 * p if t >= 5 else p),
    "light halved at frame 4": seen_as(lambda p, t, c: p // 2 if t >= 4 else p),
    "depth of NaN and infinity": bad_depth,
    "sixty Gaussians": fewer_gaussians(60),
    "one step a frame": set_to("stream", iterations=1),
    "steps a thousand times as long": set_to("stream", rate=500.0, turn_rate=250.0),
    "weights learned a thousand times as fast": set_to("stream", field_rate=1.0),
    "one slot for parts": set_to("discover", most_parts=1),
    "nothing moves": as_at_first,
    "one camera": selected(cameras=[2]),
}
