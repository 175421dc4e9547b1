"""A film: a scene and its trajectory, or several drawn together: copies of parts, parts of elsewhere."""

from collections.abc import Sequence

import equinox as eqx
import jax.numpy as jnp
import jaxlie
import numpy as np
from jaxtyping import Array, Float, Int

from gsjax.geometry.rotations import multiply_quats, normalize_quats
from gsjax.methods.parts.edits import at_times, ghost
from gsjax.methods.parts.trajectory import PartScene, Trajectory, gaussians_at, moment
from gsjax.scene.gaussians import Gaussians, concatenate, take
from gsjax.scene.handles import Blend, HandlePose

_FAINTEST = 1 / 255  # an opacity that the rasterizer skips (its `alpha_min`)


class Layer(eqx.Module):
    """A scene whose parts move; which of them are shown, its trajectory's opacities say."""

    scene: PartScene
    trajectory: Trajectory


Film = tuple[Layer, ...]
"""Layers with the same times. The first is the scene that is edited."""


def film_gaussians(film: Film, t: Int[Array, ""] | int, blend: Blend = "quaternion") -> Gaussians:
    """All Gaussians of a film at moment `t`. Under jit, `film` is a pytree and `t` may be traced.

    Raises:
        ValueError: layers differ in their number of moments, or in their features.
    """
    lengths = {len(layer.trajectory.times) for layer in film}
    if len(lengths) > 1:
        raise ValueError(f"film: expected layers with the same times, found {sorted(lengths)} moments")
    now = [gaussians_at(layer.scene, moment(layer.trajectory, t), blend) for layer in film]
    return concatenate(now)


def trimmed(film: Film) -> Film:
    """The film without the Gaussians that are never seen in it, so that they cost nothing. On the host.

    A layer of which nothing is left goes too, but for the first; if nothing is seen at all, that stays whole.
    """
    layers = []
    for layer in film:
        scene = layer.scene
        # How visible a shown part is makes no difference: a faded one shall not change all shapes.
        shown = (np.asarray(layer.trajectory.opacities) > 0).any(axis=0).astype(scene.weights.dtype)
        rows = np.flatnonzero(scene.gaussians.opacities * (scene.weights @ shown) >= _FAINTEST)
        if len(rows) or not layers:
            seen = PartScene(take(scene.gaussians, rows), scene.weights[rows], scene.centers)
            layers.append(Layer(seen, layer.trajectory))
    return tuple(layers) if any(layer.scene.gaussians.num for layer in layers) else film[:1]


def composite(film: Film, layer: Layer, parts: Sequence[int]) -> Film:
    """The film with parts of another scene in it, where they are there; `placed` puts them elsewhere."""
    trajectory = at_times(layer.trajectory, film[0].trajectory.times)
    return (*film, Layer(layer.scene, ghost(trajectory, parts)))


def placed(
    layer: Layer,
    turn: Float[Array, "3"],
    shift: Float[Array, "3"],
    factor: float = 1.0,
    about: Float[Array, "3"] | None = None,
) -> Layer:
    """A layer as a whole put elsewhere, motion and all: x -> about + shift + factor R (x - about).

    Colours that depend on the side they are seen from keep doing so in the directions of the old place.

    Args:
        turn: axis times angle, radians.
        shift: metres.
        factor: of the size, more than 0.
        about: the point that the turn and the factor leave in place, metres; default: the origin.

    Raises:
        ValueError: `factor` is not more than 0.
    """
    if not factor > 0:
        raise ValueError(f"factor: expected more than 0, found {factor}")
    rotation = jaxlie.SO3.exp(turn)
    about = jnp.zeros(3) if about is None else about

    def there(points: Float[Array, "*n 3"]) -> Float[Array, "*n 3"]:
        return about + shift + factor * rotation.apply(points - about)

    gaussians, poses = layer.scene.gaussians, layer.trajectory.poses
    around = multiply_quats(normalize_quats(poses.quats), rotation.inverse().wxyz)
    return eqx.tree_at(
        lambda at: (
            at.scene.gaussians.means,
            at.scene.gaussians.quats,
            at.scene.gaussians.log_scales,
            at.scene.centers,
            at.trajectory.poses,
        ),
        layer,
        (
            there(gaussians.means),
            multiply_quats(rotation.wxyz, normalize_quats(gaussians.quats)),
            gaussians.log_scales + jnp.log(factor),
            there(layer.scene.centers),
            HandlePose(multiply_quats(rotation.wxyz, around), factor * rotation.apply(poses.translations)),
        ),
    )
