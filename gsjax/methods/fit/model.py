"""The parameters of a fit: the Gaussians, and optionally exposures and camera poses of the photographs."""

from typing import TypeVar

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from gsjax.geometry.cameras import perturbed
from gsjax.methods.fit.config import FitConfig
from gsjax.optim.densification import EMPTY_LOGIT
from gsjax.scene.gaussians import Gaussians, with_sh_degree


class Model(eqx.Module):
    """The parameters of a fit. Fields that are None are not optimised and cost nothing.

    Attributes:
        gaussians: the Gaussians of all slots.
        nudges: zeros that are added to the projected means. Their gradient tells which Gaussians are visible,
            and where there are too few.
        exposures: deviation of each photograph's affine colour transform from [I | 0].
        twists: rotation (radians) and translation (scene radii) of each camera, in the world's axes.
    """

    gaussians: Gaussians
    nudges: Float[Array, "1 n 2"]
    exposures: Float[Array, "views 3 4"] | None = None
    twists: Float[Array, "views 6"] | None = None


def model_of(gaussians: Gaussians, config: FitConfig, views: int) -> Model:
    """The model before the first step.

    Args:
        gaussians: the initial Gaussians.
        config: selects what is optimised.
        views: number of photographs.
    """
    dtype = gaussians.means.dtype
    nudges = np.zeros((1, gaussians.num, 2), dtype)
    exposures = np.zeros((views, 3, 4), dtype) if config.exposure else None
    twists = np.zeros((views, 6), dtype) if config.refine_poses else None
    return Model(gaussians, *jax.device_put((nudges, exposures, twists)))


def with_exposure(
    colors: Float[Array, "c h w 3"], exposures: Float[Array, "views 3 4"], view: Int[Array, ""]
) -> Float[Array, "c h w 3"]:
    """Colours at the exposure of a photograph: E [c; 1]. The mean of E over photographs is [I | 0], because
    an exposure that all of them share belongs to the scene.

    Args:
        colors: colours of the scene.
        exposures: E - [I | 0] of each photograph.
        view: index of the photograph.
    """
    map_ = (exposures - exposures.mean(0))[view]
    return colors + jnp.einsum("chwj,ij->chwi", colors, map_[:, :3]) + map_[:, 3]


def refined(
    viewmats: Float[Array, "c 4 4"],
    twists: Float[Array, "views 6"],
    view: Int[Array, ""],
    radius: Float[Array, ""] | float,
) -> Float[Array, "c 4 4"]:
    """View matrices of cameras, rotated about their centres and translated. The mean twist over photographs
    is zero, because otherwise the scene could drift.

    Args:
        viewmats: the given matrices, world to camera.
        twists: twist of each photograph.
        view: index of the photograph.
        radius: radius of the scene, the unit of translations.
    """
    return perturbed(viewmats, (twists - twists.mean(0))[view], radius)


def with_degree(model: Model, degree: int) -> Model:
    """The model with spherical harmonics up to a degree; new coefficients are zero."""
    if degree <= model.gaussians.sh_degree:
        return model
    return eqx.tree_at(lambda m: m.gaussians, model, with_sh_degree(model.gaussians, degree))


def with_slots(model: Model, count: int) -> Model:
    """The model with at least `count` slots; new ones are empty."""
    more = count - model.gaussians.num
    if more <= 0:
        return model
    nudges = jnp.pad(model.nudges, [(0, 0), (0, more), (0, 0)])
    return Model(in_slots(model.gaussians, count), nudges, model.exposures, model.twists)


def in_slots(gaussians: Gaussians, count: int) -> Gaussians:
    """The Gaussians, followed by empty slots up to `count`. Padded on the host, which needs no compiled
    program."""
    rows = np.minimum(np.arange(count), gaussians.num) % gaussians.num  # empty slots hold copies of the first
    padded = jax.tree.map(lambda leaf: np.asarray(leaf)[rows], gaussians)
    logits = np.where(np.arange(count) < gaussians.num, padded.logit_opacities, EMPTY_LOGIT)
    padded = eqx.tree_at(lambda g: g.logit_opacities, padded, logits.astype(padded.logit_opacities.dtype))
    return jax.device_put(padded)


State = TypeVar("State")


def extend_state(old: State, fresh: State) -> State:
    """The optimizer state of an enlarged model, with the old state's values where it has them."""
    known = {jax.tree_util.keystr(path): leaf for path, leaf in jax.tree_util.tree_leaves_with_path(old)}

    def filled(path, leaf):
        before = known.get(jax.tree_util.keystr(path))
        if before is None or before.shape == leaf.shape:
            return leaf if before is None else before
        return leaf.at[tuple(map(slice, before.shape))].set(before)

    return jax.tree_util.tree_map_with_path(filled, fresh)
