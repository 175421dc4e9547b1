"""What a discovery comes to and edits work on: Gaussians with weights, and handles over time."""

from typing import NamedTuple

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from gsjax.scene.gaussians import Gaussians
from gsjax.scene.handles import Blend, HandlePose, at_rest, skin

BACKGROUND = 0
"""The handle of all that stands still; its pose is the identity."""
_OPAQUE = 40.0  # a logit beyond which an opacity is 1 in float32; its exponential stays finite
_FAINTEST = 1e-9  # factor on the opacity of what is hidden, so that its logit stays finite


class PartScene(eqx.Module):
    """A canonical scene and which handles move what of it.

    Attributes:
        gaussians: N of them, at the anchor frame.
        weights: of each Gaussian, 1 in sum. Column 0 is the background's.
        centers: the handles' places in the canonical scene, metres.
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
        """P, the background included."""
        return self.centers.shape[0]


class Trajectory(eqx.Module):
    """Where P handles are at T moments, and how their parts are shown.

    Attributes:
        times: seconds, increasing.
        poses: of the handles against the canonical scene.
        opacities: factors on the opacities of each part's Gaussians, 0 to 1; 0 hides it.
        scales: factors on the size of each part, about its handle.
    """

    times: Float[Array, "T"]
    poses: HandlePose
    opacities: Float[Array, "T P"]
    scales: Float[Array, "T P"]

    @property
    def num_parts(self) -> int:
        """P, the background included."""
        return self.opacities.shape[1]


def trajectory_of(times: Float[Array, "T"], poses: HandlePose) -> Trajectory:
    """The trajectory that was seen: all parts shown, none larger or smaller."""
    ones = jnp.ones(poses.translations.shape[:2], poses.translations.dtype)
    return Trajectory(times, poses, ones, ones)


def still(num_parts: int, times: Float[Array, "T"]) -> Trajectory:
    """Nothing moves."""
    rest = at_rest(num_parts)
    every = (len(times), 1, 1)
    return trajectory_of(times, HandlePose(jnp.tile(rest.quats, every), jnp.tile(rest.translations, every)))


class Moment(NamedTuple):
    """One of the T moments of a `Trajectory`, without its T axis."""

    pose: HandlePose
    opacities: Float[Array, "P"]
    scales: Float[Array, "P"]


def moment(trajectory: Trajectory, t: Int[Array, ""] | int) -> Moment:
    """Moment `t`."""
    poses = HandlePose(trajectory.poses.quats[t], trajectory.poses.translations[t])
    return Moment(poses, trajectory.opacities[t], trajectory.scales[t])


def gaussians_at(scene: PartScene, now: Moment, blend: Blend = "quaternion") -> Gaussians:
    """The scene at a moment: parts are scaled about their handles, moved, and shown as far as they are.

    A Gaussian between parts goes where its weights' mean has it, as in skinning, and is as large and as
    visible as that. What is 1 times as large and wholly shown is as it was, to the bit.

    Args:
        scene: the parts.
        now: the moment, where they are, how large and how visible.
        blend: of rotations.
    """
    gaussians, weights = scene.gaussians, scene.weights
    # From the change on, so that weights which sum to 1 but for rounding change nothing by it.
    larger = now.scales - 1
    growth = (weights @ larger)[:, None]
    means = gaussians.means + growth * gaussians.means - weights @ (larger[:, None] * scene.centers)
    hidden = weights @ (1 - now.opacities)
    logits = jnp.minimum(gaussians.logit_opacities, _OPAQUE)
    shown = jnp.log(jnp.maximum(1 - hidden, _FAINTEST)) - jnp.log1p(hidden * jnp.exp(logits))
    changed = eqx.tree_at(
        lambda g: (g.means, g.log_scales, g.logit_opacities),
        gaussians,
        (means, gaussians.log_scales + jnp.log1p(growth), logits + shown),
    )
    return skin(changed, weights, scene.centers, now.pose, blend)
