"""Learned limits: what parts were seen to do, and where an edited trajectory leaves that.

What a part was seen to do is the path of its handle: the captured poses and the screws between them. Beyond
it, weights have never been compared with an image, and what no camera saw comes to light.
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
"""What is nearer than this to what was seen, is within the limits: tracked handles are not surer."""


class Beyond(NamedTuple):
    """How far each part is from the pose nearest to it of all that it was seen in.

    Attributes:
        metres: between the places of the handle.
        radians: between the orientations.
    """

    metres: Float[Array, "T P"]
    radians: Float[Array, "T P"]


def beyond_captured(captured: Layer, edited: Trajectory) -> Beyond:
    """Where parts leave what they were seen to do.

    The nearest pose is the one from which the part's points would have to go least, the handle's way and the
    turn's (by the part's radius) together. Poses between two that were captured, on the screw that leads from
    one to the other, count as seen; so edits of time stay within the limits. Size and opacity have none.

    Args:
        captured: the scene as it was found, and its trajectory.
        edited: the same parts, at any times.
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
        # The ends too: what is far off in place is little nearer by a turn that it does not have.
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
    """A sentence for each part that leaves its limits, to warn with. On the host.

    Args:
        times: of the edited trajectory, seconds.
        names: of parts, with their numbers; a part without a name goes by its number.
        least_m, least_rad: what is nearer than both is within the limits.
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
            f"at {len(when)} of {len(times)} moments from {when[0]:.2f} s to {when[-1]:.2f} s: expect flaws"
        )
    return sentences


def _radii(scene: PartScene) -> Float[Array, "P"]:
    """How far the Gaussians of each part are from its handle, root mean square, metres."""
    means, weights = scene.gaussians.means, scene.weights
    total = jnp.maximum(jnp.sum(weights, axis=0), 1e-9)
    middle = weights.T @ means / total[:, None]
    spread = weights.T @ jnp.sum(means**2, axis=-1) / total - jnp.sum(middle**2, axis=-1)
    return jnp.sqrt(jnp.maximum(spread + jnp.sum((middle - scene.centers) ** 2, axis=-1), 1e-6))
