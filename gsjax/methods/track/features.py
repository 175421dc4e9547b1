"""Features of Gaussians from features of pixels in the first frame (Object-Aware Gaussian Splatting for
Robotic Manipulation, section III-A). Later frames need no others: the features move with the Gaussians.

Rendering is linear in what is rendered: F = W f, where W [pixels, N] holds the weight of each Gaussian in
each pixel. W is never formed: a render applies it, and the render's VJP applies its transpose, exactly. The
paper names two ways from maps m to features f. *Projection* gives each Gaussian the mean of the pixels in
which it is visible, weighted by its contribution to them:

    f = (W^T m) / (W^T 1)

*Distillation* finds the features whose render comes closest to the maps:

    min_f  |W f - a m|^2 + damping |f - f_projected|^2

where a = W 1 is the rendered alpha: a half transparent pixel shows half a feature. It is a linear least
squares problem, so conjugate gradients solve it without a learning rate. W^T 1 is the preconditioner, because
it bounds the sum of each row of W^T W. Both reproduce a constant map exactly.
"""

from collections.abc import Callable
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from gsjax.geometry.cameras import Camera
from gsjax.geometry.neighbors import nearest
from gsjax.methods.track.motion import Pose, place
from gsjax.methods.track.scene import TrackedScene
from gsjax.optim.conjugate_gradients import Conjugate, advanced, turned
from gsjax.optim.step import Step, all_finite, keep_if
from gsjax.rasterize.plan import Plan
from gsjax.scene.frame import Frame
from gsjax.scene.gaussians import Gaussians
from gsjax.scene.render import plan_render, render

MIN_WEIGHT = 0.1
"""A Gaussian with less total weight over all pixels counts as unseen."""
_CHANNELS = 16  # rendered at a time; hundreds, as in foundation models, compile slowly and fill the memory


class FeatureBatch(NamedTuple):
    """The batch of the distillation.

    Attributes:
        gaussians: the scene, frozen.
        cameras: C cameras.
        maps: features of each pixel.
        valid: 1 for pixels that count, else 0.
        prior: features towards which damping pulls.
        weights: W^T 1 of each Gaussian, pixels.
        damping: weight of the prior, pixels.
        plan: from `plan_render`.
    """

    gaussians: Gaussians
    cameras: Camera
    maps: Float[Array, "c height width d"]
    valid: Float[Array, "c height width"]
    prior: Float[Array, "n d"]
    weights: Float[Array, "n"]
    damping: Float[Array, ""]
    plan: Plan


class DistillState(NamedTuple):
    """State of conjugate gradients, which are independent for each channel.

    Attributes:
        residual: residual of the normal equations.
        direction: next search direction.
        energy: squared preconditioned residual of each channel.
        begun: whether the residual is known; the first update only computes it.
    """

    residual: Float[Array, "n d"]
    direction: Float[Array, "n d"]
    energy: Float[Array, "d"]
    begun: Bool[Array, ""]


def project_features(
    scene: TrackedScene, frame: Frame, maps: Float[Array | np.ndarray, "..."]
) -> Float[np.ndarray, "n d"]:
    """The mean feature of the pixels in which each Gaussian is visible. On the host.

    A Gaussian that is visible nowhere takes the feature of the nearest visible one with its label, because
    the far side of an object mostly resembles its near side; zeros if none of its label is visible.

    Args:
        scene: the scene at the time of `frame`.
        frame: the frame that `maps` describe.
        maps: features of each pixel, [C,H,W,D]; pixels that are not finite do not count.

    Raises:
        ValueError: the maps differ from the frame in number of cameras or size.
    """
    maps, valid = _checked(maps, frame)
    return _project(scene, frame, maps, valid, plan_render(scene.gaussians, frame.cameras))[0]


def distill_features(
    scene: TrackedScene,
    frame: Frame,
    maps: Float[Array | np.ndarray, "..."],
    *,
    iterations: int = 10,
    damping: float = 0.1,
) -> Float[np.ndarray, "n d"]:
    """The features whose render is closest to the maps; invisible Gaussians keep their projected ones. On the
    host.

    Args:
        scene, frame, maps: as for `project_features`.
        iterations: steps of conjugate gradients, each a render and its transpose.
        damping: weight of the projected feature of each Gaussian, in pixels. Without damping, Gaussians that
            are hardly visible would take whatever values compensate for others.

    Raises:
        ValueError: as for `project_features`; or damping is negative.
    """
    if not damping >= 0:
        raise ValueError(f"damping: expected 0 or more, found {damping}")
    maps, valid = _checked(maps, frame)
    plan = plan_render(scene.gaussians, frame.cameras)
    prior, weights = _project(scene, frame, maps, valid, plan)
    known = (jnp.asarray(weights), jnp.asarray(damping, maps.dtype), plan)

    step = feature_distiller()

    def solve(part: Array, prior: Array) -> Array:
        batch = FeatureBatch(scene.gaussians, frame.cameras, part, valid, prior, *known)
        features, state = prior, step.init(prior)
        for i in range(iterations + 1):  # the first computes the residual
            features, state, _ = step.update(features, state, batch, step=i, key=None)
        return features

    return _in_chunks(solve, maps, prior)


def feature_distiller() -> Step:
    """Conjugate gradients on the normal equations of distillation, one iteration per update. The first update
    only computes the residual.

    params: the features [N,D], initially the batch's `prior`. state: `DistillState`. batch: `FeatureBatch`,
    always the same. `step` and `key` are not used. `info` has `energy` [D], the squared preconditioned
    residual of each channel, whose sum is `loss`.
    """

    def init(params: Float[Array, "n d"]) -> DistillState:
        nothing = jnp.zeros_like(params)
        return DistillState(nothing, nothing, nothing.sum(0), jnp.asarray(False))

    def update(params, state: DistillState, batch: FeatureBatch, *, step: Any, key: Any):
        gaussians, cameras, maps, valid, prior, weights, damping, plan = batch
        begun = state.begun
        # W is linear: the same render computes the residual in the first update and applies W^T W later.
        at, towards = jnp.where(begun, state.direction, params), jnp.where(begun, 0.0, maps)
        pull, (overflow, needed) = _residual(at, towards, gaussians, cameras, valid, plan)
        scale = weights + damping + 1e-6
        known = Conjugate(state.residual, state.direction, state.energy)
        features, moved = advanced(params, known, damping * state.direction - pull, scale)
        first = turned(known, pull + damping * (prior - params), scale)
        features = jnp.where(begun, features, params)
        new = (features, DistillState(*keep_if(begun, moved, first), jnp.asarray(True)))
        sound = all_finite(new[:1] + new[1][:3]) & ~overflow
        params, state = keep_if(sound, new, (params, state))
        info = {"loss": state.energy.sum(), "energy": state.energy, "skipped": ~sound}
        return params, state, info | {"overflow": overflow, "needed": needed}

    return Step(init, update)


def render_features(
    scene: TrackedScene,
    pose: Pose,
    features: Float[Array, "n d"],
    cameras: Camera,
    plan: Plan | None = None,
) -> tuple[Float[Array, "c height width d"], Float[Array, "c height width"]]:
    """Feature maps of the scene at `pose`, in any cameras, and their alphas.

    The feature of a pixel is the mean over what it shows, so it does not fade with alpha; zero where nothing
    is drawn.

    Args:
        features: features of each Gaussian.
        plan: from `plan_render(place(scene, pose), cameras)`; required under jit.
    """
    rendered = render(place(scene, pose), cameras, plan, features=features)
    assert rendered.features is not None
    alphas = rendered.alphas[..., None]
    return jnp.where(alphas > 1e-3, rendered.features / jnp.maximum(alphas, 1e-3), 0.0), rendered.alphas


@partial(jax.jit, static_argnames="faded")
def _residual(
    features: Float[Array, "n d"],
    maps: Float[Array, "c height width d"],
    gaussians: Gaussians,
    cameras: Camera,
    valid: Float[Array, "c height width"],
    plan: Plan,
    faded: bool = True,
) -> tuple[Float[Array, "n d"], tuple[Bool[Array, ""], Int[Array, ""]]]:
    """W^T (a m - W f) over the valid pixels, without a unless `faded`; whether the plan overflowed, and the
    capacity needed. All costly computation is here."""

    def draw(features):
        rendered = render(gaussians, cameras, plan, features=features)
        meta = rendered.meta
        return jnp.asarray(rendered.features), (rendered.alphas, (meta.overflow.any(), meta.needed.max()))

    drawn, transpose, (alphas, room) = jax.vjp(draw, features, has_aux=True)
    target = alphas[..., None] * maps if faded else maps
    return transpose(valid[..., None] * (target - drawn))[0], room


def _project(
    scene: TrackedScene, frame: Frame, maps: Array, valid: Array, plan: Plan
) -> tuple[Float[np.ndarray, "n d"], Float[np.ndarray, "n"]]:
    """Projected features, and W^T 1."""

    def gather(part: Array) -> Array:
        nothing = jnp.zeros((scene.gaussians.num, part.shape[-1]), part.dtype)
        return _residual(nothing, part, scene.gaussians, frame.cameras, valid, plan, faded=False)[0]

    sums = _in_chunks(gather, jnp.concatenate([maps, jnp.ones_like(maps[..., :1])], axis=-1))
    weights, points = sums[:, -1], np.asarray(scene.gaussians.means)
    features, seen = sums[:, :-1] / np.maximum(weights, 1e-12)[:, None], weights >= MIN_WEIGHT
    features[~seen] = 0.0
    labels = np.asarray(scene.labels)
    for label in np.unique(labels[~seen]):
        lacking, giving = (np.flatnonzero((labels == label) & rows) for rows in (~seen, seen))
        found, _ = nearest(points[lacking], points[giving])
        features[lacking[found >= 0]] = features[giving[found[found >= 0]]]
    return features, weights


def _checked(maps: Array | np.ndarray, frame: Frame) -> tuple[Array, Array]:
    """Finite maps, and 1 for each pixel where they were."""
    wanted = frame.images.shape[:3]
    if np.ndim(maps) != 4 or maps.shape[:3] != wanted:
        raise ValueError(f"maps: expected shape {[*wanted, 'D']} to match images, found {np.shape(maps)}")
    maps = jnp.asarray(maps, frame.images.dtype)
    valid = jnp.isfinite(maps).all(-1)
    return jnp.where(valid[..., None], maps, 0.0), valid.astype(maps.dtype)


def _in_chunks(function: Callable, *arrays: Array | np.ndarray) -> np.ndarray:
    """The concatenated results of `function` for a few channels at a time, the last axis of each array."""
    count, results = arrays[0].shape[-1], []
    size = min(count, _CHANNELS)
    for start in range(0, count, size):
        parts = [jnp.asarray(array[..., start : start + size]) for array in arrays]
        # Padded to one shape, so that one compiled program serves all.
        pad = size - parts[0].shape[-1]
        parts = [jnp.pad(part, [(0, 0)] * (part.ndim - 1) + [(0, pad)]) for part in parts]
        results.append(np.array(function(*parts)))
    return np.concatenate(results, axis=-1)[..., :count]
