"""Two boxes on a floor as inputs of one streaming step, and initial poses and fields."""

import jax
import jax.numpy as jnp
import numpy as np

from gsjax.methods.parts.stream import Canonical, StreamBatch, StreamParams
from gsjax.scene.feature_grid import locate
from gsjax.scene.frame import Frame
from gsjax.scene.gaussians import take
from gsjax.scene.handles import HandlePose, at_rest
from gsjax.scene.render import plan_render
from tests.methods.parts.moving_boxes import Box, MovingBoxes

PARTS = 4  # slots: the background, two boxes, and one that is free


def two_boxes() -> MovingBoxes:
    """Two boxes at rest, seen by two cameras."""
    still = np.zeros((2, 3)), np.zeros((2, 3))
    first, second = (
        Box((-0.1, 0, 0.04), (0.08, 0.08, 0.08), *still),
        Box((0.1, 0, 0.03), (0.08, 0.06, 0.06), *still),
    )
    return MovingBoxes([first, second], cameras=2)


def canonical_of(boxes, field=None, dtype=jnp.float32):
    means = np.asarray(boxes.gaussians.means)
    order = np.argsort(boxes.bodies == 0, kind="stable")
    count = int((boxes.bodies > 0).sum())
    gaussians = jax.tree.map(lambda a: jnp.asarray(a, dtype), take(boxes.gaussians, order))
    movable, fixed = (
        jax.tree.map(lambda a: a[:count], gaussians),
        jax.tree.map(lambda a: a[count:], gaussians),
    )
    centers = np.stack([means[boxes.bodies == k].mean(0) if k < 3 else np.zeros(3) for k in range(PARTS)])
    gaps = np.linalg.norm(means[order][:count, None] - means[order][None], axis=-1)
    return Canonical(
        movable,
        fixed,
        None if field is None else locate(field, movable.means),
        jnp.asarray(centers, dtype),
        jnp.full(PARTS, 0.05, dtype),
        jnp.asarray(0.01, dtype),
        jnp.array([True, True, True, False]),
        jnp.asarray(np.argsort(gaps, axis=1)[:, 1:5]),
    ), boxes.bodies[order][:count]


def batch_of(boxes, dtype=jnp.float32, past=True):
    """(the batch of a step with frame 0's picture of one camera, the bodies of the movable Gaussians)."""
    canonical, bodies = canonical_of(boxes, dtype=dtype)
    weights = jax.nn.one_hot(bodies, PARTS, dtype=dtype)
    frame = jax.tree.map(lambda a: jnp.asarray(a, dtype)[:1], boxes.frame(0))
    seen = Frame(frame.images, frame.depths, frame.cameras, jnp.ones(frame.images.shape[:3], bool))
    plan = plan_render(boxes.gaussians, frame.cameras, headroom=3)
    rest = jax.tree.map(lambda a: a.astype(dtype), at_rest(PARTS))
    then = ((seen, rest),) if past else ()
    return StreamBatch(canonical, seen, 1, 0, 0.0, plan, weights, then, plan if past else None), bodies


def params_of(pose, field, bodies):
    """The parameters that a step changes; `bodies` are those of the movable Gaussians."""
    return StreamParams(pose, field, jnp.zeros((len(bodies), 3)))


def soft(bodies, sureness=2.0, dtype=jnp.float32):
    return sureness * jax.nn.one_hot(bodies, PARTS, dtype=dtype)


def shifted(by, dtype=jnp.float32):
    rest = at_rest(PARTS)
    shifts = jnp.zeros((PARTS, 3), dtype).at[1:3].set(jnp.asarray(by, dtype))
    return HandlePose(rest.quats.astype(dtype), shifts)
