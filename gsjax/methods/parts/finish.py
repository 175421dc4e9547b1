"""The end of a discovery: parts that no picture needs are removed, the refinement of the scene and of all
poses is set up, and the scene and its trajectory are assembled for edits."""

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from gsjax.geometry.cameras import on_device
from gsjax.geometry.rotations import quats_to_matrices
from gsjax.methods.parts.absence import absences, loss_of_picture, with_absences
from gsjax.methods.parts.config import PartsConfig
from gsjax.methods.parts.discover import centers_of
from gsjax.methods.parts.discovery import Discovery, adjacent_parts, join_parts, weights_of_run
from gsjax.methods.parts.pictures import Problem, coarse_frame, with_part_masks
from gsjax.methods.parts.refine import RefineParams, refine_step
from gsjax.methods.parts.stream import posed
from gsjax.methods.parts.trajectory import BACKGROUND, PartScene, Trajectory, trajectory_of
from gsjax.optim.method import Run
from gsjax.optim.step import copied
from gsjax.rasterize.plan import with_room
from gsjax.scene.frame import Frame, one_camera
from gsjax.scene.handles import HandlePose
from gsjax.scene.render import plan_render

_PICTURES, _CAMERAS = 12, 2  # pictures by which parts are evaluated, and fewest cameras per frame
_LEAST_WEIGHT = 0.02


def begin_refinement(problem: Problem, run: Run, config: PartsConfig) -> Run:
    """The run before the first step of the refinement, without unneeded parts and with fixed weights.

    Args:
        problem: the recording.
        run: a run that has found all frames.
        config: settings.
    """
    discovery = prune_parts(problem, run.kept, np.asarray(weights_of_run(run)), config)
    if config.absences and not problem.at_once:
        absent = absences(problem, discovery, config)
        discovery = discovery if absent is None else with_absences(discovery, absent)
    poses = HandlePose(*jax.device_put((discovery.quats, discovery.translations)))
    canonical = discovery.canonical
    params = copied(RefineParams(canonical.movable, canonical.fixed, poses))
    return run.having(params=params, state=jax.jit(refine_step(config).init)(params), kept=discovery)


def prune_parts(
    problem: Problem, discovery: Discovery, weights: Float[np.ndarray, "M P"], config: PartsConfig
) -> Discovery:
    """Removes the parts that no picture needs: starting with the smallest, each part joins a part that it
    touches, or the background, whichever raises the loss least, if it rises by at most `unify.least_gain`.

    The criterion is the loss rather than a comparison of motions: the motion of a thin part is poorly
    known, and matters little for the same reason.

    The remaining weights are fixed from here on, and those below 2 % are cut: a softmax gives every part a
    small weight everywhere, so that moving one part would move all others slightly.

    Args:
        problem: the recording.
        discovery: the discovery of all frames.
        weights: weights of the movable Gaussians.
        config: settings.
    """
    mean_loss = _MeanLoss(problem, discovery, weights, config)
    found, into = weights, np.arange(len(discovery.canonical.alive))
    here, before = mean_loss(weights), None
    while before is None or (into != before).any():
        before = into.copy()
        for part in _smallest_first(weights.argmax(-1)):
            options = {q: moved_weights(weights, part, q) for q in adjacent_parts(discovery, weights, part)}
            losses = {q: mean_loss(changed) for q, changed in options.items()}
            best = min(losses, key=losses.__getitem__)
            if losses[best] <= (1 + config.unify.least_gain) * here:
                weights, here = options[best], losses[best]
                into[into == part] = best
    discovery, _ = join_parts(discovery, found, into)
    kept = cut_weights(weights, np.asarray(discovery.canonical.alive))
    return discovery._replace(weights=jnp.asarray(kept))


def cut_weights(weights: Float[np.ndarray, "M P"], alive: Bool[np.ndarray, "P"]) -> Float[np.ndarray, "M P"]:
    """The weights without those below 2 %, which only tie parts to each other, but with the largest of each
    row; rows sum to 1."""
    least = np.minimum(_LEAST_WEIGHT, weights.max(-1, keepdims=True))
    kept = np.where((weights < least) | ~alive, 0.0, weights)
    return (kept / kept.sum(-1, keepdims=True)).astype(weights.dtype)


def moved_weights(weights: Float[np.ndarray, "M P"], part: int, to: int) -> Float[np.ndarray, "M P"]:
    """The weights, with those of `part` moved `to` another part."""
    changed = weights.copy()
    changed[:, to] += changed[:, part]
    changed[:, part] = 0
    return changed


def _smallest_first(labels: Int[np.ndarray, "M"]) -> list[int]:
    names, counts = np.unique(labels[labels != BACKGROUND], return_counts=True)
    return names[np.argsort(counts, kind="stable")].tolist()


class _MeanLoss:
    """The mean loss of some pictures, spread over frames and cameras, for given weights."""

    def __init__(
        self,
        problem: Problem,
        discovery: Discovery,
        weights: Float[np.ndarray, "M P"],
        config: PartsConfig,
    ):
        self._config = config.stream
        self._canonical, self._headroom = discovery.canonical, 2 * config.headroom
        done, count = np.flatnonzero(discovery.done), problem.sequence.num_cameras
        most = min(_PICTURES // _CAMERAS, len(done))
        frames, cameras_of_one = (
            done[np.linspace(0, len(done) - 1, most).round().astype(int)],
            _PICTURES // most,
        )
        self._pictures: list[tuple[HandlePose, Frame]] = []
        for i, t in enumerate(frames.tolist()):
            frame = coarse_frame(problem, discovery, t)
            cameras = {(i + k * count // cameras_of_one) % count for k in range(cameras_of_one)}
            place = self._canonical, jnp.asarray(weights), discovery.pose(t)
            seen = with_part_masks(frame, *place, blend=config.stream.blend)
            self._pictures += [(discovery.pose(t), one_camera(seen, c)) for c in sorted(cameras)]
        scene = posed(self._canonical, jnp.asarray(weights), discovery.pose(int(done[0])))
        self._plan = plan_render(scene, on_device(frame.cameras), headroom=self._headroom)

    def __call__(self, weights: Float[np.ndarray, "M P"]) -> float:
        losses = []
        for pose, frame in self._pictures:
            scene = self._canonical, jnp.asarray(weights), pose
            draw = partial(loss_of_picture, *scene, frame, config=self._config)
            loss, self._plan = with_room(draw, self._plan, self._headroom)
            losses.append(float(loss))
        return float(np.mean(losses))


def scene_and_trajectory(
    discovery: Discovery, weights: Float[np.ndarray, "M P"], times: Float[np.ndarray, "T"]
) -> tuple[PartScene, Trajectory]:
    """The scene with its parts, with all Gaussians in their given order, and the trajectory of the parts.

    Handles without Gaussians are left out; the others are moved to the centroids of their parts. The times of
    the trajectory begin at 0.

    Args:
        discovery: the discovery.
        weights: weights of the movable Gaussians.
        times: times of the frames, seconds.
    """
    labels = weights.argmax(-1)
    kept = [BACKGROUND, *(p for p in np.unique(labels).tolist() if p != BACKGROUND)]
    count = len(discovery.order)
    full = np.zeros((count, len(kept)), np.float32)
    full[:, BACKGROUND] = 1
    full[discovery.order[: len(weights)]] = weights[:, kept] / weights[:, kept].sum(-1, keepdims=True)
    canonical = discovery.canonical
    before = np.asarray(canonical.centers)[kept]
    means = np.asarray(canonical.movable.means)
    after = centers_of(means, labels, weights.shape[1])[kept]
    poses = HandlePose(*jax.device_put((discovery.quats[:, kept], discovery.translations[:, kept])))
    poses = _about_other_centers(poses, after - before)
    everything = jax.tree.map(lambda a, b: np.concatenate([a, b]), canonical.movable, canonical.fixed)
    gaussians = jax.tree.map(lambda a: a[np.argsort(discovery.order)], everything)
    scene = PartScene(*jax.device_put((gaussians, full, after)))
    absent, dtype = discovery.absent, poses.quats.dtype
    shown = None if absent is None else jnp.asarray(~absent[:, kept], dtype)
    since = np.asarray(times, np.float64) - times[0]  # float32 cannot tell times of day apart
    return scene, trajectory_of(jax.device_put(since.astype(dtype)), poses, shown)


@jax.jit
def _about_other_centers(poses: HandlePose, shifts: Float[Array, "P 3"]) -> HandlePose:
    """The same motions about centres that are shifted, metres: x -> R (x - c) + c + T about any c, with
    T' = T + (R - I)(c' - c)."""
    turned = jnp.einsum("tpij,pj->tpi", quats_to_matrices(poses.quats), shifts, precision="highest")
    return HandlePose(poses.quats, poses.translations + turned - shifts)
