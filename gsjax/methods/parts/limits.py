"""Learned limits: the observed motion of parts, and where an edited trajectory leaves it.

The observed motion of a part is the path of its handle: the captured poses and the screw motions between
them. Beyond it, the weights were never compared with an image, and surfaces that no camera saw are revealed.
"""

from collections.abc import Mapping
from typing import NamedTuple

import jax
import jax.numpy as jnp
import jaxlie
import numpy as np
from jaxtyping import Array, Float

from gsjax.methods.parts.film import Layer
from gsjax.methods.parts.screws import motions_of
from gsjax.methods.parts.trajectory import PartScene, Trajectory

NOISE_M, NOISE_RAD = 2e-3, 0.02
"""Tolerances of the limits, metres and radians: the accuracy of tracked handles."""


class Beyond(NamedTuple):
    """The distance of each part from the nearest pose in which it was observed.

    Attributes:
        metres: distance between the positions of the handle.
        radians: angle between the orientations.
    """

    metres: Float[Array, "T P"]
    radians: Float[Array, "T P"]


@jax.jit
def beyond_captured(captured: Layer, edited: Trajectory) -> Beyond:
    """How far parts leave their observed motion.

    The nearest pose minimises the sum of the handle's translation and its rotation times the part's radius.
    Poses between two captured ones, on the screw from one to the other, count as observed, so edits of time
    stay within the limits. Scales and opacities have no limits.

    Args:
        captured: the discovered scene and its trajectory.
        edited: a trajectory of the same parts, at any times.
    """
    path = motions_of(captured.trajectory.poses)
    start = path.wxyz_xyz if len(path.wxyz_xyz) == 1 else path.wxyz_xyz[:-1]
    start, end = jaxlie.SE3(start), jaxlie.SE3(path.wxyz_xyz[-len(start) :])
    along = (start.inverse() @ end).log()
    radii = _radii(captured.scene)[:, None]
    metric = jnp.concatenate([jnp.ones((len(radii), 3)), jnp.broadcast_to(radii**2, (len(radii), 3))], axis=1)
    length = jnp.sum(metric * along**2, axis=-1)

    def nearest(pose: Float[Array, "P 7"]) -> Beyond:
        away = (start.inverse() @ jaxlie.SE3(pose)).log()
        share = jnp.sum(metric * away * along, axis=-1) / jnp.where(length > 0, length, 1.0)
        # Try both ends too, so that a distant position is not explained by a spurious rotation.
        share = jnp.stack([jnp.zeros_like(share), jnp.clip(share, 0.0, 1.0), jnp.ones_like(share)])
        seen = start @ jaxlie.SE3.exp(share[..., None] * along)
        metres = jnp.linalg.norm(pose[:, 4:] - seen.translation(), axis=-1)
        turn = (seen.rotation().inverse() @ jaxlie.SO3(pose[:, :4])).log()
        radians = jnp.linalg.norm(turn, axis=-1)
        metres, radians = (values.reshape(-1, len(radii)) for values in (metres, radians))
        least = jnp.argmin(metres + radii[:, 0] * radians, axis=0)[None]
        return Beyond(*(jnp.take_along_axis(values, least, axis=0)[0] for values in (metres, radians)))

    return jax.lax.map(nearest, motions_of(edited.poses).wxyz_xyz)


def describe_beyond(
    beyond: Beyond,
    times: Float[Array, "T"],
    names: Mapping[str, int],
    least_m: float = NOISE_M,
    least_rad: float = NOISE_RAD,
) -> list[str]:
    """A warning for each part that leaves its limits. On the host.

    Args:
        beyond: from `beyond_captured`.
        times: times of the edited trajectory, seconds.
        names: part numbers by name; a part without a name is called by its number.
        least_m, least_rad: tolerances, metres and radians.
    """
    metres, radians = np.asarray(beyond.metres), np.asarray(beyond.radians)
    outside = (metres > least_m) | (radians > least_rad)
    called = {number: name for name, number in names.items()}
    sentences = []
    for p in np.flatnonzero(outside.any(axis=0)):
        when = np.asarray(times)[outside[:, p]]
        shift, turn = metres[:, p].max(), radians[:, p].max()
        far = [f"{1000 * shift:.0f} mm"] if shift > least_m else []
        far += [f"{np.rad2deg(turn):.1f} degrees"] if turn > least_rad else []
        sentences.append(
            f"{called.get(int(p), f'part {p}')} goes up to {' and '.join(far)} beyond what was captured, "
            f"at {len(when)} of {len(times)} moments from {when[0]:.2f} s to {when[-1]:.2f} s: "
            "expect artefacts"
        )
    return sentences


def _radii(scene: PartScene) -> Float[Array, "P"]:
    """The distance of each part's Gaussians from its handle, root mean square, metres."""
    squares = jnp.sum((scene.gaussians.means[:, None] - scene.centers) ** 2, axis=-1)
    total = jnp.maximum(jnp.sum(scene.weights, axis=0), 1e-9)
    return jnp.sqrt(jnp.maximum(jnp.sum(scene.weights * squares, axis=0) / total, 1e-6))
