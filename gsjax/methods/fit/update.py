"""One step of the fit: draw a view, compare, descend. From time to time Gaussians go where they are needed,
as in 3DGS-MCMC (relocation and noise) or as in 3DGS (cloning, splitting, pruning).
"""

from collections.abc import Callable
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import optax
from jaxtyping import Array, Bool, Float, Int, PRNGKeyArray

from gsjax.losses.extra import ExtraLosses, extra_terms, named_losses
from gsjax.losses.photometric import photometric_loss, weighted_mean
from gsjax.methods.fit.config import FitConfig
from gsjax.methods.fit.model import Model, exposed, refined
from gsjax.optim.densification import EMPTY_LOGIT, exploration, is_alive, relocate, reset_rows
from gsjax.optim.splitting import Pull, divide, reset_opacities, strongly_pulled, watch_pull
from gsjax.optim.step import Step, all_finite, gradient_step, keep_if, per_field_adam
from gsjax.rasterize.plan import Plan
from gsjax.scene.frame import Frame
from gsjax.scene.gaussians import Gaussians
from gsjax.scene.render import render

_FINAL_RATE = 0.01  # of means and twists, over the first


class Batch(NamedTuple):
    """What a step is given.

    Attributes:
        frame: the photograph, of one camera, RGB in bytes.
        view: which of the photographs it is.
        background: RGB behind the scene, 0 to 1.
        progress: how far the fit is, 0 to 1, by which rates fall.
        radius: of the scene, the unit in which means and cameras move and depth counts.
        plan: to draw with.
    """

    frame: Frame
    view: Int[Array, ""]
    background: Float[Array, "1 3"]
    progress: Float[Array, ""] | float
    radius: Float[Array, ""] | float
    plan: Plan


def fit_loss(config: FitConfig, extra_losses: ExtraLosses = ()) -> Callable:
    """`loss(model, batch, *, step, key)`: L1 and D-SSIM, the difference in depth, and under relocation what
    opacity and size cost (3DGS-MCMC, eq. 10), of one photograph.

    Args:
        config: its weights.
        extra_losses: given the `Model`, how it was drawn, and the photograph; what does not count is drawn as
            photographed.
    """

    def loss(model: Model, batch: Batch, *, step: Any, key: Any):
        frame, radius = batch.frame, batch.radius
        gaussians, camera = model.gaussians, frame.cameras
        if model.twists is not None:
            viewmat = refined(camera.viewmat, model.twists, batch.view, radius)
            camera = eqx.tree_at(lambda c: c.viewmat, camera, viewmat)
        # By half a picture, so that one threshold of the pull serves pictures of any size.
        nudges = model.nudges * jnp.array([camera.width / 2, camera.height / 2], model.nudges.dtype)
        drawn = render(gaussians, camera, batch.plan, backgrounds=batch.background, means2d_offset=nudges)
        image = drawn.colors
        if model.exposures is not None:
            image = exposed(image, model.exposures, batch.view)
        target = frame.colors
        if frame.masks is not None:  # what does not count is as it was photographed: no slope, no edge
            image = jnp.where(frame.masks[..., None], image, target)
        value = photometric_loss(image, target, config.dssim_weight)
        counted = 1.0 if frame.masks is None else frame.masks.mean()
        mse = jnp.square(image - target).mean() / counted
        if config.depth_weight and frame.depths is not None:
            known = (frame.depths > 0) & jax.lax.stop_gradient(drawn.alphas > 0.5)
            if frame.masks is not None:
                known &= frame.masks
            off = weighted_mean(jnp.abs(drawn.depths - frame.depths), known.astype(value.dtype))
            value += config.depth_weight * off / radius
        if config.strategy == "relocate":
            alive = jax.lax.stop_gradient(is_alive(gaussians).astype(value.dtype))
            value += config.growth.opacity_cost * weighted_mean(gaussians.opacities, alive)
            value += config.growth.scale_cost * weighted_mean(gaussians.scales.mean(-1), alive) / radius
        aux = {
            "psnr": -10 * jnp.log10(mse),
            "overflow": drawn.meta.overflow.any(),
            "needed": drawn.meta.needed.max(),
        }
        if extra_losses:
            rendered = drawn._replace(colors=image)
            aux["extra"] = extra_terms(
                extra_losses, model, rendered, Frame(target, frame.depths, camera, frame.masks)
            )
            value += sum(aux["extra"].values())
        return value, aux

    return loss


def fit_step(config: FitConfig, extra_losses: ExtraLosses = ()) -> Step:
    """Adam on a `Model`, and under relocation the walk of 3DGS-MCMC.

    `batch` is a `Batch`; `key` is used by the walk; `step` is not, for rates fall with `batch.progress`.
    `info` has `psnr` and `alive` beside what every step reports.

    Args:
        config: of the fit.
        extra_losses: custom losses (`gsjax.losses.extra`) beside that of photographs.
    """
    named_losses(extra_losses)
    rates = vars(config.rates)
    loss = fit_loss(config, extra_losses)

    def of(model: Model) -> Step:
        there = [name for name in rates if getattr(model.gaussians, name, None) is not None]
        there += [name for name in ("exposures", "twists") if getattr(model, name) is not None]
        # Means and twists go as far as Adam's rate of 1 says, and then only a share of it, which falls.
        ours = {name: 1.0 if name in ("means", "twists") else rates[name] for name in there}
        return gradient_step(loss, per_field_adam(ours, others={"nudges": watch_pull()}))

    def update(params: Model, state, batch: Batch, *, step, key: PRNGKeyArray):
        moved, new_state, info = of(params).update(params, state, batch, step=step, key=key)
        radius, fall = batch.radius, _FINAL_RATE**batch.progress
        rate = rates["means"] * radius * fall
        before, after = params.gaussians, moved.gaussians
        means = before.means + rate * (after.means - before.means)
        if config.strategy == "relocate":
            walk = exploration(after, key, config.growth.noise * rate)
            means += jnp.where(is_alive(after)[:, None] & ~info["skipped"], walk, 0.0)
        moved = eqx.tree_at(lambda m: m.gaussians.means, moved, means)
        if moved.twists is not None:
            twists = params.twists + rates["twists"] * fall * (moved.twists - params.twists)
            moved = eqx.tree_at(lambda m: m.twists, moved, twists)
        sound = all_finite(moved)
        params, state = keep_if(sound, (moved, new_state), (params, state))
        alive = is_alive(params.gaussians).sum()
        return params, state, info | {"alive": alive, "skipped": info["skipped"] | ~sound}

    return Step(lambda params: of(params).init(params), update)


def grow(
    model: Model,
    state: Any,
    key: PRNGKeyArray,
    cap: Int[Array, ""] | int,
    factor: float,
    all_looked: Bool[Array, ""] | bool,
) -> tuple[Model, Any]:
    """Dead Gaussians move to where more are needed, and there may be `factor` times as many, up to `cap`.
    Where all photographs looked since the last time, those that none has seen count as dead.

    Args:
        model: what is learned.
        state: of the optimizer, with what it knows of pulls.
        key: says who is copied.
        cap: of Gaussians.
        factor: 1 or more.
        all_looked: whether all photographs did.
    """
    gaussians, pull = _without_unseen(model.gaussians, state, all_looked), _pull_of(state)
    used = jnp.max(jnp.where(is_alive(gaussians), jnp.arange(gaussians.num) + 1, 0))
    slots = jnp.clip(jnp.ceil(used * factor).astype(jnp.int32), used, cap)
    moved, touched = relocate(gaussians, key, slots)
    state = _map_nodes(Gaussians, lambda known: reset_rows(known, touched), state)
    seen = jnp.where(all_looked, 0.0, jnp.where(touched, 1.0, pull.seen))  # who is new cannot have been seen
    state = _map_nodes(Pull, lambda pull: Pull(pull.total, seen), state)
    return eqx.tree_at(lambda m: m.gaussians, model, moved), state


def slots_wanted(model: Model, state: Any, config: FitConfig) -> Int[Array, ""]:
    """How many slots `split` would fill if there were enough.

    Args:
        model: what is learned.
        state: of the optimizer, with what it knows of pulls.
        config: with the threshold of pulls.
    """
    asks = strongly_pulled(model.gaussians, _pull_of(state), config.split.pull)
    return is_alive(model.gaussians).sum() + asks.sum()


def split(
    model: Model,
    state: Any,
    key: PRNGKeyArray,
    config: FitConfig,
    radius: float,
    reset: Bool[Array, ""] | bool,
    pruning: Bool[Array, ""] | bool,
    all_looked: Bool[Array, ""] | bool,
) -> tuple[Model, Any]:
    """Gaussians that are pulled hard are cloned or split, others pruned, and what was known of pulls is
    forgotten.

    Args:
        model: what is learned.
        state: of the optimizer, with what it knows of pulls.
        key: says where halves go.
        config: thresholds.
        radius: of the scene: what sizes are counted in.
        reset: lower opacities.
        pruning: prune what is too large.
        all_looked: all photographs looked since the last time, so those that none has seen are pruned too.
    """
    options, pull = config.split, _pull_of(state)
    moved, touched = divide(
        _without_unseen(model.gaussians, state, all_looked),
        pull,
        key,
        config.cap,
        threshold=options.pull,
        large=options.large * radius,
        too_large=jnp.where(pruning, options.too_large * radius, jnp.inf),
    )
    moved = keep_if(jnp.asarray(reset), reset_opacities(moved), moved)
    every = jnp.full_like(touched, True)
    state = _map_nodes(Gaussians, lambda known: reset_rows(known, touched), state)
    state = _map_nodes(Gaussians, lambda known: _forget_opacities(known, every & reset), state)
    state = _map_nodes(Pull, lambda known: reset_rows(known, every), state)
    return eqx.tree_at(lambda m: m.gaussians, model, moved), state


def _without_unseen(gaussians: Gaussians, state: Any, all_looked: Any) -> Gaussians:
    """What no photograph sees, because it is hidden or outside of all, becomes an empty slot."""
    unseen = all_looked & (_pull_of(state).seen == 0)
    logits = jnp.where(unseen, EMPTY_LOGIT, gaussians.logit_opacities)
    return eqx.tree_at(lambda g: g.logit_opacities, gaussians, logits)


def _map_nodes(kind: type, function: Callable, tree: Any) -> Any:
    """`function` of all nodes of a kind; everything else as it was."""

    def is_it(node):
        return isinstance(node, kind)

    return jax.tree.map(lambda node: function(node) if is_it(node) else node, tree, is_leaf=is_it)


def _forget_opacities(known: Gaussians, rows: Bool[Array, "n"]) -> Gaussians:
    return eqx.tree_at(
        lambda g: g.logit_opacities, known, reset_rows(known.logit_opacities, rows), is_leaf=_is_masked
    )


def _is_masked(node: Any) -> bool:
    """Whether it stands for a field that another part of the optimizer looks after."""
    return isinstance(node, optax.MaskedNode)


def _pull_of(state: Any) -> Pull:
    leaves = jax.tree.leaves(state, is_leaf=lambda node: isinstance(node, Pull))
    return next(leaf for leaf in leaves if isinstance(leaf, Pull))
