"""One step of the fit, and densification: relocation and noise as in 3DGS-MCMC, or cloning, splitting and
pruning as in 3DGS."""

from collections.abc import Callable
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import optax
from jaxtyping import Array, Bool, Float, Int, PRNGKeyArray

from gsjax.geometry.cameras import Camera
from gsjax.losses.extra import ExtraLosses, extra_terms, named_losses
from gsjax.losses.photometric import photometric_loss, weighted_mean
from gsjax.methods.fit.config import FitConfig
from gsjax.methods.fit.model import Model, refined, with_exposure
from gsjax.optim.densification import EMPTY_LOGIT, exploration, is_alive, relocate, reset_rows
from gsjax.optim.splitting import Pull, accumulate_pull, densify, reset_opacities, strongly_pulled
from gsjax.optim.step import Step, all_finite, gradient_step, keep_if, per_field_adam
from gsjax.rasterize.plan import Plan
from gsjax.scene.frame import Frame
from gsjax.scene.gaussians import Gaussians
from gsjax.scene.render import Rendered, render

_FINAL_RATE = 0.01  # learning rates of means and twists in the last step, relative to the first


class Batch(NamedTuple):
    """The input of a step.

    Attributes:
        frame: the photograph, of one camera, RGB in bytes, on the device.
        view: index of the photograph.
        background: RGB behind the scene, 0 to 1.
        progress: share of the fit that is done, 0 to 1, over which learning rates fall.
        radius: radius of the scene, the unit of learning rates and of the depth loss.
        plan: the render plan.
        share: the shares of the picture's width and height that are not padding; None for all.
    """

    frame: Frame
    view: Int[Array, ""]
    background: Float[Array, "1 3"]
    progress: Float[Array, ""] | float
    radius: Float[Array, ""] | float
    plan: Plan
    share: Float[Array, "2"] | None = None


def fit_loss(config: FitConfig, extra_losses: ExtraLosses = ()) -> Callable:
    """`loss(model, batch, *, step, key)`: L1 and D-SSIM, the depth error, and with relocation the costs of
    opacity and scale (3DGS-MCMC, eq. 10), for one photograph.

    Args:
        config: the weights.
        extra_losses: custom losses of the `Model`, its rendering, and the photograph; masked pixels are
            rendered as photographed. Photographs of many sizes are padded, and the padding is masked: take
            means over the pixels of `frame.masks`, unless it is None.
    """

    def loss(model: Model, batch: Batch, *, step: Any, key: Any):
        frame, gaussians = batch.frame, model.gaussians
        drawn, camera = _photographed(model, batch)
        image, target = drawn.colors, frame.colors
        if frame.masks is not None:  # masked pixels equal the photograph's: no gradient, no edge
            image = jnp.where(frame.masks[..., None], image, target)
        value = photometric_loss(image, target, config.dssim_weight)
        if batch.share is not None:
            value /= batch.share.prod()
        if config.depth_weight and frame.depths is not None:
            value += config.depth_weight * _depth_error(drawn, frame.depths, frame.masks) / batch.radius
        if config.strategy == "relocate":
            alive = is_alive(gaussians).astype(value.dtype)
            value += config.growth.opacity_cost * weighted_mean(gaussians.opacities, alive)
            value += config.growth.scale_cost * weighted_mean(gaussians.scales.mean(-1), alive) / batch.radius
        counted = 1.0 if frame.masks is None else frame.masks.mean()
        mse = jnp.square(image - target).mean() / counted
        aux = {
            "psnr": -10 * jnp.log10(mse),
            "overflow": drawn.meta.overflow.any(),
            "needed": drawn.meta.needed.max(),
        }
        if extra_losses:
            rendered = drawn._replace(colors=image)
            seen = Frame(target, frame.depths, camera, frame.masks)
            context = {"index": batch.view, "progress": batch.progress}
            aux["extra"] = extra_terms(extra_losses, model, rendered, seen, **context)
            value += sum(aux["extra"].values())
        return value, aux

    return loss


def _photographed(model: Model, batch: Batch) -> tuple[Rendered, Camera]:
    """The scene from the photograph's refined pose, at its refined exposure; and the camera there."""
    camera = batch.frame.cameras
    if model.twists is not None:
        viewmat = refined(camera.viewmat, model.twists, batch.view, batch.radius)
        camera = eqx.tree_at(lambda c: c.viewmat, camera, viewmat)
    # Relative to half the image, so that one threshold suits images of any size.
    half = jnp.array([camera.width / 2, camera.height / 2], model.nudges.dtype)
    nudges = model.nudges * (half if batch.share is None else half * batch.share)
    behind = batch.background
    drawn = render(model.gaussians, camera, batch.plan, backgrounds=behind, means2d_offset=nudges)
    if model.exposures is not None:
        drawn = drawn._replace(colors=with_exposure(drawn.colors, model.exposures, batch.view))
    return drawn, camera


def _depth_error(drawn: Rendered, depths: Any, masks: Any) -> Float[Array, ""]:
    """Mean absolute error of the rendered depth, where depth is known and the rendering more than half
    opaque."""
    known = (depths > 0) & jax.lax.stop_gradient(drawn.alphas > 0.5)
    if masks is not None:
        known &= masks
    return weighted_mean(jnp.abs(drawn.depths - depths), known.astype(drawn.depths.dtype))


def fit_step(config: FitConfig, extra_losses: ExtraLosses = ()) -> Step:
    """A step of Adam on a `Model`, with the noise of 3DGS-MCMC if Gaussians are relocated.

    `batch` is a `Batch`; `key` is for the noise; `step` is not used, as rates depend on `batch.progress`.
    `info` has `psnr` and `alive` in addition to what every step reports.

    Args:
        config: settings.
        extra_losses: custom losses (`gsjax.losses.extra`), added to that of the photographs.
    """
    named_losses(extra_losses)
    rates = vars(config.rates)
    loss = fit_loss(config, extra_losses)

    def adam_step(model: Model) -> Step:
        present = [name for name in rates if getattr(model.gaussians, name, None) is not None]
        present += [name for name in ("exposures", "twists") if getattr(model, name) is not None]
        # Means and twists move at a rate of 1 here; `update` scales their steps by rates that decay.
        used = {name: 1.0 if name in ("means", "twists") else rates[name] for name in present}
        return gradient_step(loss, per_field_adam(used, others={"nudges": accumulate_pull()}))

    def update(params: Model, state, batch: Batch, *, step, key: PRNGKeyArray):
        moved, new_state, info = adam_step(params).update(params, state, batch, step=step, key=key)
        radius, fall = batch.radius, _FINAL_RATE**batch.progress
        rate = rates["means"] * radius * fall
        before, after = params.gaussians, moved.gaussians
        means = before.means + rate * (after.means - before.means)
        if config.strategy == "relocate":
            walk = exploration(after, key, config.growth.noise * rate / radius**2)
            means += jnp.where(is_alive(after)[:, None] & ~info["skipped"], walk, 0.0)
        moved = eqx.tree_at(lambda m: m.gaussians.means, moved, means)
        if moved.twists is not None:
            twists = params.twists + rates["twists"] * fall * (moved.twists - params.twists)
            moved = eqx.tree_at(lambda m: m.twists, moved, twists)
        sound = all_finite(moved)
        params, state = keep_if(sound, (moved, new_state), (params, state))
        alive = is_alive(params.gaussians).sum()
        return params, state, info | {"alive": alive, "skipped": info["skipped"] | ~sound}

    return Step(lambda params: adam_step(params).init(params), update)


def grow(
    model: Model,
    state: Any,
    key: PRNGKeyArray,
    cap: Int[Array, ""] | int,
    factor: float,
    all_seen: Bool[Array, ""] | bool,
) -> tuple[Model, Any]:
    """Relocates dead Gaussians, and grows their number by `factor`, up to `cap`.

    Args:
        model: the parameters.
        state: state of the optimizer, with the pulls.
        key: random key of the relocation.
        cap: largest number of Gaussians.
        factor: growth, 1 or more.
        all_seen: whether all photographs were used since the last time, so that Gaussians that none of them
            sees count as dead.
    """
    gaussians, pull = _without_unseen(model.gaussians, state, all_seen), _pull_of(state)
    used = jnp.max(jnp.where(is_alive(gaussians), jnp.arange(gaussians.num) + 1, 0))
    slots = jnp.clip(jnp.ceil(used * factor).astype(jnp.int32), used, cap)
    moved, touched = relocate(gaussians, key, slots)
    state = _map_nodes(Gaussians, lambda known: reset_rows(known, touched), state)
    seen = jnp.where(all_seen, 0.0, jnp.where(touched, 1.0, pull.seen))  # new ones had no chance to be seen
    state = _map_nodes(Pull, lambda pull: Pull(pull.total, seen), state)
    return eqx.tree_at(lambda m: m.gaussians, model, moved), state


def slots_wanted(model: Model, state: Any, config: FitConfig) -> Int[Array, ""]:
    """The number of slots that `split` would fill if there were enough.

    Args:
        model: the parameters.
        state: state of the optimizer, with the pulls.
        config: the threshold of pulls.
    """
    pulled = strongly_pulled(model.gaussians, _pull_of(state), config.split.pull)
    return is_alive(model.gaussians).sum() + pulled.sum()


def split(
    model: Model,
    state: Any,
    key: PRNGKeyArray,
    config: FitConfig,
    radius: Float[Array, ""] | float,
    reset: Bool[Array, ""] | bool,
    pruning: Bool[Array, ""] | bool,
    all_seen: Bool[Array, ""] | bool,
) -> tuple[Model, Any]:
    """Clones or splits Gaussians with large pulls, prunes others, and resets the pulls.

    Args:
        model: the parameters.
        state: state of the optimizer, with the pulls.
        key: random key for the positions of the halves.
        config: thresholds.
        radius: radius of the scene, the unit of scales.
        reset: whether to lower all opacities.
        pruning: whether to prune Gaussians that are too large.
        all_seen: whether all photographs were used since the last time, so that Gaussians that none of them
            sees are pruned too.
    """
    options, pull = config.split, _pull_of(state)
    moved, touched = densify(
        _without_unseen(model.gaussians, state, all_seen),
        pull,
        key,
        config.cap,
        threshold=options.pull,
        large=options.large * radius,
        too_large=jnp.where(pruning, options.too_large * radius, jnp.inf),
    )
    moved = keep_if(jnp.asarray(reset), reset_opacities(moved), moved)
    every = jnp.full_like(touched, True)

    def is_masked(node):  # another part of the optimizer has that field
        return isinstance(node, optax.MaskedNode)

    def reset_moments(moments: Gaussians) -> Gaussians:
        moments = reset_rows(moments, touched)
        logits = reset_rows(moments.logit_opacities, every & reset)
        return eqx.tree_at(lambda g: g.logit_opacities, moments, logits, is_leaf=is_masked)

    state = _map_nodes(Gaussians, reset_moments, state)
    state = _map_nodes(Pull, lambda pull: reset_rows(pull, every), state)
    return eqx.tree_at(lambda m: m.gaussians, model, moved), state


def _without_unseen(gaussians: Gaussians, state: Any, all_seen: Any) -> Gaussians:
    """The Gaussians, with those that no photograph sees turned into empty slots."""
    unseen = all_seen & (_pull_of(state).seen == 0)
    logits = jnp.where(unseen, EMPTY_LOGIT, gaussians.logit_opacities)
    return eqx.tree_at(lambda g: g.logit_opacities, gaussians, logits)


def _map_nodes(kind: type, function: Callable, tree: Any) -> Any:
    """The tree with `function` applied to all nodes of a kind."""

    def is_kind(node):
        return isinstance(node, kind)

    return jax.tree.map(lambda node: function(node) if is_kind(node) else node, tree, is_leaf=is_kind)


def _pull_of(state: Any) -> Pull:
    leaves = jax.tree.leaves(state, is_leaf=lambda node: isinstance(node, Pull))
    return next(leaf for leaf in leaves if isinstance(leaf, Pull))
