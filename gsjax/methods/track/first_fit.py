"""The scene at the first frame, and its photometric optimisation before anything moves."""

import warnings
from collections.abc import Callable
from functools import cache, partial
from types import SimpleNamespace

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from gsjax.geometry.neighbors import drop_flying_pixels
from gsjax.losses.photometric import photometric_loss, truncated_l1
from gsjax.methods.track.config import TrackConfig
from gsjax.methods.track.frames import prepared_first
from gsjax.methods.track.lost import MIN_POINTS
from gsjax.methods.track.scene import TrackedScene, labelled_cloud, scene_from_cloud
from gsjax.optim.compiler import host_options
from gsjax.optim.step import gradient_step, per_field_adam
from gsjax.optim.traces import jit_once
from gsjax.rasterize.plan import with_room
from gsjax.scene.frame import Frame
from gsjax.scene.render import plan_render, render

# Depth has measured the means, so they hardly move; the other fields learn to blend into the images.
RATES = {"means": 2e-5, "quats": 5e-3, "log_scales": 1e-2, "logit_opacities": 3e-2, "sh0": 1e-2}
_DEPTH_WEIGHT, _DEPTH_LIMIT = 1.0, 0.05
_NOISY = 0.2  # fraction of depths on no surface above which a warning is issued
_FEW = 2 * MIN_POINTS  # an object needs this many Gaussians, because a camera sees about half of them


def start_scene(
    frame: Frame,
    mask: np.ndarray,
    mask_camera: int = 0,
    config: TrackConfig | None = None,
    *,
    before_fit: Callable[[TrackedScene], None] | None = None,
) -> TrackedScene:
    """A labelled, photometrically optimised scene from the first RGB-D frame and the mask of one camera.

    Args:
        frame: the first frame, with depth.
        mask: labels [H, W] of one camera's image; 0 is background.
        mask_camera: index of that camera.
        config: configuration of the tracker (default: `TrackConfig()`).
        before_fit: called with the scene before its optimisation. Array shapes do not change after that, so
            programs that depend on them can be compiled meanwhile.

    Raises:
        ValueError: there is no depth, the mask does not fit the images, or cameras are fisheyes.
    """
    config = TrackConfig() if config is None else config
    frame = prepared_first(frame)
    if frame.depths is not None:
        frame = eqx.tree_at(lambda f: f.depths, frame, jnp.asarray(_surfaces(np.asarray(frame.depths))))
    scene = scene_from_cloud(labelled_cloud(frame, mask, mask_camera, config.start), config.start)
    _warn_of_few(scene)
    if before_fit is not None:
        before_fit(scene)
    return fit_scene(scene, frame, config.start.iterations, config.headroom)[0]


def _surfaces(depths: np.ndarray) -> np.ndarray:
    """The depths that lie on surfaces, else 0; warns if many do not."""
    surfaces = drop_flying_pixels(depths)
    share = 1 - (surfaces > 0).sum() / max((depths > 0).sum(), 1)
    if share > _NOISY:
        warnings.warn(
            f"depths: {share:.0%} of those in the first frame differ from all around them by more than 5%, "
            "and are ignored; is the depth noisy, or of another frame?",
            stacklevel=3,
        )
    return surfaces


def _warn_of_few(scene: TrackedScene) -> None:
    """Warns of objects, and parts of large ones, with too few Gaussians to tell whether they are lost."""
    counts = np.bincount(np.asarray(scene.labels), minlength=len(scene.label_ids))[1:].tolist()
    fewest: dict[int, int] = {}
    for label, count in zip(scene.label_ids[1:], counts, strict=True):
        fewest[label] = min(count, fewest.get(label, count))
    few = [f"object {label} has {count}" for label, count in fewest.items() if count < _FEW]
    if few:
        warnings.warn(
            "too few Gaussians in the first frame to tell whether an object, or part of one, is lost: "
            f"{', '.join(few)}, expected {_FEW} or more; lower start.object_pixels "
            "(--track.start.object-pixels), or take the mask of a camera that sees more of it",
            stacklevel=3,
        )


def fit_loss(gaussians, batch, *, step, key):
    """L1 and D-SSIM on the images, and a truncated depth difference where depth is known.

    Args:
        gaussians: the parameters.
        batch: (frame, plan).
        step, key: not used; they belong to the signature of a loss.
    """
    frame, plan = batch
    rendered = render(gaussians, frame.cameras, plan)
    loss = photometric_loss(rendered.colors, frame.images)
    if frame.depths is not None:
        known = (frame.depths > 0).astype(loss.dtype) * jax.lax.stop_gradient(rendered.alphas > 0.5)
        loss += _DEPTH_WEIGHT * truncated_l1(rendered.depths, frame.depths, known, _DEPTH_LIMIT)
    mse = jnp.square(rendered.colors - frame.images).mean()
    return loss, {
        "psnr": -10 * jnp.log10(mse),
        "overflow": rendered.meta.overflow,
        "needed": rendered.meta.needed,
    }


def fit_scene(
    scene: TrackedScene, frame: Frame, iterations: int, headroom: float = 1.5
) -> tuple[TrackedScene, dict]:
    """The scene after `iterations` steps of Adam on the first frame, and the info of the last step.

    `headroom`, 1 or more, is that of the plan, which grows if it overflows.

    Raises:
        ValueError: no step had a finite loss.
    """
    gaussians, info, skipped = scene.gaussians, {}, 0
    state = jax.jit(_STEP.init)(gaussians)
    plan = plan_render(gaussians, frame.cameras, headroom=headroom)

    def advanced(gaussians, state, i, plan):
        result = _advance()(gaussians, state, (frame, plan), i)
        return result, SimpleNamespace(**result[-1])

    for i in range(iterations):
        step = partial(advanced, gaussians, state, i)
        (gaussians, state, info), plan = with_room(step, plan, headroom)
        skipped += int(info["skipped"])
    if iterations and skipped == iterations:
        raise ValueError("first frame: expected a finite loss, found none in any step; check the images")
    return eqx.tree_at(lambda s: s.gaussians, scene, gaussians), info


_STEP = gradient_step(fit_loss, per_field_adam(RATES))


@cache
def _advance() -> Callable:
    """The jitted step, made on first use, because its compiler options depend on the machine."""

    def fit_first_frame(params, state, batch, i):
        return _STEP.update(params, state, batch, step=i, key=None)

    return jit_once(fit_first_frame, RATES, compiler_options=host_options())
