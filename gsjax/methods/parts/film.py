"""Films: one or more layers that are rendered together, each a scene with its trajectory. Further layers
hold copies of parts, or parts of other scenes."""

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

_FAINTEST = 1 / 255  # opacity below which the rasterizer skips a Gaussian (its `alpha_min`)


class Layer(eqx.Module):
    """A scene whose parts move; the opacities of the trajectory determine which of them are visible."""

    scene: PartScene
    trajectory: Trajectory


Film = tuple[Layer, ...]
"""Layers with the same times. The first is the edited scene."""


def film_gaussians(film: Film, t: Int[Array, ""] | int, blend: Blend = "quaternion") -> Gaussians:
    """All Gaussians of a film at moment `t`. Under jit, `film` is a pytree and `t` may be traced.

    Args:
        film: the layers.
        t: index of the moment.
        blend: how rotations are blended.

    Raises:
        ValueError: layers differ in their number of moments, or in their features.
    """
    lengths = {len(layer.trajectory.times) for layer in film}
    if len(lengths) > 1:
        raise ValueError(f"film: expected layers with the same times, found {sorted(lengths)} moments")
    return concatenate([gaussians_at(layer.scene, moment(layer.trajectory, t), blend) for layer in film])


def trimmed(film: Film) -> Film:
    """The film without Gaussians that are never visible, to save their cost. On the host.

    Empty layers are removed, except for the first; if nothing is visible at all, the first stays complete.
    """
    layers = []
    for layer in film:
        scene = layer.scene
        # Only whether a part is visible matters, so that a different opacity does not change array shapes.
        shown = (np.asarray(layer.trajectory.opacities) > 0).any(axis=0).astype(scene.weights.dtype)
        rows = np.flatnonzero(scene.gaussians.opacities * (scene.weights @ shown) >= _FAINTEST)
        if len(rows) or not layers:
            seen = PartScene(take(scene.gaussians, rows), scene.weights[rows], scene.centers)
            layers.append(Layer(seen, layer.trajectory))
    return tuple(layers) if any(layer.scene.gaussians.num for layer in layers) else film[:1]


def composite(film: Film, layer: Layer, parts: Sequence[int]) -> Film:
    """The film with parts of another scene added, at their original positions; `placed` moves them."""
    trajectory = at_times(layer.trajectory, film[0].trajectory.times)
    return (*film, Layer(layer.scene, ghost(trajectory, parts)))


def placed(
    layer: Layer,
    turn: Float[Array, "3"],
    shift: Float[Array, "3"],
    factor: float = 1.0,
    about: Float[Array, "3"] | None = None,
) -> Layer:
    """A layer moved as a whole, with its motion: x -> about + shift + factor R (x - about).

    View-dependent colours are not rotated.

    Args:
        layer: the layer.
        turn: rotation, axis times angle in radians.
        shift: translation, metres.
        factor: scale, more than 0.
        about: fixed point of the rotation and the scaling, metres; default: the origin.

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
