"""What a fit may change: the Gaussians, and where asked, how each photograph was exposed and where from."""

from typing import TypeVar

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from gsjax.geometry.cameras import perturbed
from gsjax.geometry.spherical_harmonics import num_sh_bases
from gsjax.methods.fit.config import FitConfig
from gsjax.optim.densification import EMPTY_LOGIT
from gsjax.scene.gaussians import Gaussians


class Model(eqx.Module):
    """The parameters of a fit. What is None is not changed and costs nothing.

    Attributes:
        gaussians: of all slots.
        exposures: of each photograph, what is added to the affine map [I | 0] of its colours.
        twists: of each camera, a turn (radians) and a shift (radii of the scene), in the world's axes.
        nudges: zeros added to the projected means. Their gradient says which Gaussians are seen at all, and
            where there are too few.
    """

    gaussians: Gaussians
    nudges: Float[Array, "1 n 2"]
    exposures: Float[Array, "views 3 4"] | None = None
    twists: Float[Array, "views 6"] | None = None


def model_of(gaussians: Gaussians, config: FitConfig, views: int) -> Model:
    """The model before the first step.

    Args:
        gaussians: where it starts.
        config: what is learned.
        views: how many photographs there are.
    """
    dtype = gaussians.means.dtype
    return Model(
        gaussians,
        jnp.zeros((1, gaussians.num, 2), dtype),
        jnp.zeros((views, 3, 4), dtype) if config.exposure else None,
        jnp.zeros((views, 6), dtype) if config.refine_poses else None,
    )


def exposed(
    colors: Float[Array, "c h w 3"], exposures: Float[Array, "views 3 4"], view: Int[Array, ""]
) -> Float[Array, "c h w 3"]:
    """Colours as the camera of a photograph made them: E [c; 1]. On average over photographs E is [I | 0]:
    what all share belongs to the scene.

    Args:
        colors: as the scene sends them.
        exposures: E of each photograph.
        view: which photograph.
    """
    map_ = (exposures - exposures.mean(0))[view]
    return colors + jnp.einsum("chwj,ij->chwi", colors, map_[:, :3]) + map_[:, 3]


def refined(
    viewmats: Float[Array, "c 4 4"],
    twists: Float[Array, "views 6"],
    view: Int[Array, ""],
    radius: Float[Array, ""] | float,
) -> Float[Array, "c 4 4"]:
    """View matrices of cameras that were turned about their centres and shifted. On average over photographs
    neither turned nor shifted, for else the scene could move along.

    Args:
        viewmats: as they were given, world to camera.
        twists: of each photograph.
        view: which photograph.
        radius: of the scene: what shifts are counted in.
    """
    return perturbed(viewmats, (twists - twists.mean(0))[view], radius)


def with_degree(model: Model, degree: int) -> Model:
    """With the coefficients of a degree of the spherical harmonics, of zero where they are new."""
    gaussians = model.gaussians
    missing = num_sh_bases(degree) - num_sh_bases(gaussians.sh_degree)
    if missing <= 0:
        return model
    zeros = jnp.zeros((gaussians.num, missing, 3), gaussians.sh0.dtype)
    shN = zeros if gaussians.shN is None else jnp.concatenate([gaussians.shN, zeros], axis=1)
    return eqx.tree_at(lambda m: m.gaussians.shN, model, shN, is_leaf=lambda leaf: leaf is None)


def with_slots(model: Model, count: int) -> Model:
    """With room for so many Gaussians; the new slots hold none."""
    more = count - model.gaussians.num
    if more <= 0:
        return model
    padded = jax.tree.map(
        lambda leaf: jnp.concatenate([leaf, jnp.repeat(leaf[:1], more, axis=0)]), model.gaussians
    )
    logits = padded.logit_opacities.at[-more:].set(EMPTY_LOGIT)
    padded = eqx.tree_at(lambda g: g.logit_opacities, padded, logits)
    nudges = jnp.pad(model.nudges, [(0, 0), (0, more), (0, 0)])
    return Model(padded, nudges, model.exposures, model.twists)


State = TypeVar("State")


def carried_over(old: State, fresh: State) -> State:
    """The state of an optimizer of a larger model, which knows what the old one knew."""
    known = {jax.tree_util.keystr(path): leaf for path, leaf in jax.tree_util.tree_leaves_with_path(old)}

    def of(path, leaf):
        before = known.get(jax.tree_util.keystr(path))
        if before is None or before.shape == leaf.shape:
            return leaf if before is None else before
        return leaf.at[tuple(slice(0, size) for size in before.shape)].set(before)

    return jax.tree_util.tree_map_with_path(of, fresh)
