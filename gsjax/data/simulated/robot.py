"""A two-link arm on a pillar, with a two-finger gripper that points down its z axis."""

import numpy as np
from jaxtyping import Float

from gsjax.data.simulated.motion import between, rigid
from gsjax.data.simulated.primitives import Primitive
from gsjax.data.simulated.textures import Texture

LINK_M = 0.48
SHOULDER = np.array([-0.50, 0.0, 0.33])
_WRIST_HEIGHT = 0.20  # above the grasp point
_FINGER = (0.011, 0.008, 0.045)
BODIES = 6  # pillar, upper arm, forearm, hand, two fingers

_SHELL = Texture("noise", ((0.93, 0.93, 0.90), (0.80, 0.81, 0.82)), 0.10, seed=11, grain=0.10)
_JOINT = Texture("stripes", ((0.22, 0.24, 0.28), (0.40, 0.42, 0.46)), 0.03, seed=12)
_PAD = Texture("checker", ((0.15, 0.16, 0.18), (0.36, 0.36, 0.38)), 0.012, seed=13)


def robot_primitives(first_body: int) -> list[Primitive]:
    """The solids of the arm, with bodies numbered from `first_body`."""
    pillar, upper, fore, hand, left, right = range(first_body, first_body + BODIES)
    middle = SHOULDER[2] / 2
    return [
        Primitive("cylinder", (0.065, middle), _SHELL, pillar, rigid(None, [0, 0, -middle])),
        Primitive("cylinder", (0.10, 0.015), _JOINT, pillar, rigid(None, [0, 0, 0.015 - SHOULDER[2]])),
        Primitive("sphere", (0.075,), _JOINT, pillar),
        Primitive("cylinder", (0.048, LINK_M / 2), _SHELL, upper),
        Primitive("sphere", (0.060,), _JOINT, upper, rigid(None, [0, 0, LINK_M / 2])),
        Primitive("cylinder", (0.040, LINK_M / 2), _SHELL, fore),
        Primitive("sphere", (0.050,), _JOINT, fore, rigid(None, [0, 0, LINK_M / 2])),
        Primitive("cylinder", (0.032, 0.045), _SHELL, hand, rigid(None, [0, 0, _WRIST_HEIGHT - 0.045])),
        Primitive("box", (0.026, 0.075, 0.020), _JOINT, hand, rigid(None, [0, 0, 0.095])),
        Primitive("box", _FINGER, _PAD, left, rigid(None, [0, _FINGER[1], 0.030])),
        Primitive("box", _FINGER, _PAD, right, rigid(None, [0, -_FINGER[1], 0.030])),
    ]


def robot_poses(
    grasp: Float[np.ndarray, "frames 4 4"], opening: Float[np.ndarray, "frames"]
) -> Float[np.ndarray, "frames bodies 4 4"]:
    """Poses of the arm's bodies in the world.

    Args:
        grasp: pose of the frame between the fingers; they close along its y axis, and its z axis points to
            the hand.
        opening: distance of each finger from the middle, metres.
    """
    wrist = grasp[:, :3, 3] + _WRIST_HEIGHT * grasp[:, :3, 2]
    shoulder = np.broadcast_to(SHOULDER, wrist.shape)
    elbow = _elbow(shoulder, wrist)
    slide = opening[:, None] * np.array([0.0, 1.0, 0.0])
    return np.stack(
        [
            rigid(None, shoulder),
            between(shoulder, elbow),
            between(elbow, wrist),
            grasp,
            grasp @ rigid(None, slide),
            grasp @ rigid(None, -slide),
        ],
        axis=1,
    )


def _elbow(shoulder: np.ndarray, wrist: np.ndarray) -> np.ndarray:
    """The upper of the two possible elbows of two links of equal length, in the vertical plane through
    shoulder and wrist.

    A wrist out of reach leaves a gap at the elbow rather than raising an error: the arm is only scenery.
    """
    reach = wrist - shoulder
    length = np.linalg.norm(reach, axis=-1, keepdims=True)
    side = np.cross(reach, [0.0, 0.0, 1.0])
    up = np.cross(side, reach)
    up = up / np.linalg.norm(up, axis=-1, keepdims=True)
    rise = np.sqrt(np.maximum(LINK_M**2 - (length / 2) ** 2, 0.0))
    return shoulder + reach / 2 + rise * up
