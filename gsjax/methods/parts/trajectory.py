"""The data that a discovery produces and edits transform: Gaussians with weights, and handles over time."""

from functools import partial
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from gsjax.scene.gaussians import Gaussians
from gsjax.scene.handles import Blend, HandlePose, at_rest, skin

BACKGROUND = 0
"""The handle of the static background; its pose is the identity."""
_OPAQUE = 40.0  # largest logit: its opacity is 1 in float32, and its exponential is finite
_FAINTEST = 1e-9  # factor on the opacity of hidden Gaussians, so that their logits stay finite


class PartScene(eqx.Module):
    """A canonical scene and the handles that move it.

    Attributes:
        gaussians: N Gaussians, at the anchor frame.
        weights: weights of each Gaussian, which sum to 1. Column 0 is the background's.
        centers: positions of the handles in the canonical scene, metres.
    """

    gaussians: Gaussians
    weights: Float[Array, "N P"]
    centers: Float[Array, "P 3"]

    @property
    def labels(self) -> Int[Array, "N"]:
        """The handle of the largest weight."""
        return jnp.argmax(self.weights, axis=-1)

    @property
    def num_parts(self) -> int:
        """Number of parts, P, including the background."""
        return self.centers.shape[0]


class Trajectory(eqx.Module):
    """Poses of P handles at T moments, and the appearance of their parts.

    Attributes:
        times: seconds, increasing.
        poses: poses of the handles relative to the canonical scene.
        opacities: factors on the opacities of each part's Gaussians, 0 to 1; 0 hides it.
        scales: factors on the size of each part, about its handle.
    """

    times: Float[Array, "T"]
    poses: HandlePose
    opacities: Float[Array, "T P"]
    scales: Float[Array, "T P"]

    @property
    def num_parts(self) -> int:
        """Number of parts, P, including the background."""
        return self.opacities.shape[1]


def trajectory_of(
    times: Float[Array, "T"], poses: HandlePose, opacities: Float[Array, "T P"] | None = None
) -> Trajectory:
    """The trajectory with these poses, with all parts at their own size.

    Args:
        times: seconds, increasing.
        poses: poses of P handles at T moments.
        opacities: factors on the opacities of each part's Gaussians, 0 to 1 (default: all are visible).
    """
    ones = jnp.ones(poses.translations.shape[:2], poses.translations.dtype)
    return Trajectory(times, poses, ones if opacities is None else opacities, ones)


def still(num_parts: int, times: Float[Array, "T"]) -> Trajectory:
    """The trajectory in which nothing moves."""
    rest = at_rest(num_parts)
    every = (len(times), 1, 1)
    return trajectory_of(times, HandlePose(jnp.tile(rest.quats, every), jnp.tile(rest.translations, every)))


class Moment(NamedTuple):
    """One of the T moments of a `Trajectory`, without its T axis."""

    pose: HandlePose
    opacities: Float[Array, "P"]
    scales: Float[Array, "P"]


@partial(jax.jit, inline=True)
def moment(trajectory: Trajectory, t: Int[Array, ""] | int) -> Moment:
    """Moment `t`."""
    poses = HandlePose(trajectory.poses.quats[t], trajectory.poses.translations[t])
    return Moment(poses, trajectory.opacities[t], trajectory.scales[t])


def gaussians_at(scene: PartScene, now: Moment, blend: Blend = "quaternion") -> Gaussians:
    """The scene at a moment: parts are scaled about their handles, moved, and faded.

    A Gaussian between parts takes the weighted mean of their positions, as in skinning, and of their scales
    and opacities. With scale and opacity 1 a Gaussian is unchanged, bit for bit.

    Args:
        scene: the parts.
        now: poses, scales and opacities of the parts.
        blend: how rotations are blended.
    """
    changed = eqx.tree_at(
        lambda g: (g.means, g.log_scales, g.logit_opacities), scene.gaussians, _scaled_and_faded(scene, now)
    )
    return skin(changed, scene.weights, scene.centers, now.pose, blend)


@partial(jax.jit, inline=True)
def _scaled_and_faded(
    scene: PartScene, now: Moment
) -> tuple[Float[Array, "N 3"], Float[Array, "N 3"], Float[Array, "N"]]:
    """Means, logarithms of scales, and logits of opacities at a moment, before anything moves."""
    gaussians, weights = scene.gaussians, scene.weights
    # Written in terms of the change, so that the rounding of weights that sum to 1 has no effect.
    larger = now.scales - 1
    weighted = partial(jnp.matmul, weights, precision="highest")  # no TF32 on GPUs that have it
    growth = weighted(larger)[:, None]
    means = gaussians.means + growth * gaussians.means - weighted(larger[:, None] * scene.centers)
    logits = faded(gaussians.logit_opacities, weighted(1 - now.opacities))
    return means, gaussians.log_scales + jnp.log1p(growth), logits


def faded(logits: Float[Array, "N"], hidden: Float[Array, "N"]) -> Float[Array, "N"]:
    """Logits of opacities times 1 - `hidden`, or times 1e-9 where that is 0.

    Args:
        logits: of the opacities.
        hidden: the share that is taken away, 0 to 1.
    """
    logits = jnp.minimum(logits, _OPAQUE)
    return logits + (jnp.log(jnp.maximum(1 - hidden, _FAINTEST)) - jnp.log1p(hidden * jnp.exp(logits)))
