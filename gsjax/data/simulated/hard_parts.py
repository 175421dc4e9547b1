"""Parts that are hard to find: a wheel with gaps, a small motion, a thin rod, a panel flush in its frame."""

from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from gsjax.data.sequence import Sequence
from gsjax.data.simulated.motion import minimum_jerk, rigid, turn
from gsjax.data.simulated.primitives import Primitive
from gsjax.data.simulated.raycaster import Light, Scene
from gsjax.data.simulated.simulation import check_counts, simulated_sequence
from gsjax.data.simulated.textures import Texture
from gsjax.geometry.cameras import intrinsics, look_at
from gsjax.geometry.joints import Joint

RATE_HZ = 15.0
AMOUNTS = {"wheel": 6.0, "small": 0.1, "thin": 0.02, "flush": 0.02}
"""Default amount of each case: number of spokes, and metres of slide, width and protrusion."""

_WORLD, _PART, _BOX = range(3)  # bodies; labels are the same numbers

# Half sizes and centres, metres; the floor is z = 0, the wall is at the back, cameras look from +x.
_WALL_SIZE, _WALL_AT = (0.02, 0.55, 0.30), (-0.22, 0.0, 0.30)
_BOX_SIZE, _BOX_FROM, _BOX_PATH = (0.05, 0.05, 0.06), (0.10, -0.34, 0.06), (0.12, 0.16, 0.0)
_TARGET = np.array([0.0, 0.0, 0.18])
_DISTANCE, _ARC = 1.15, 130.0  # metres, and degrees of the cameras' arc
_LIGHT = Light(position=(1.2, 0.7, 1.8), radius=0.03)
_WALL_FRONT = _WALL_AT[0] + _WALL_SIZE[0]
_TURN = np.deg2rad(80.0)
_FRAMES = 15.0  # duration of all motions


class _PartModel(NamedTuple):
    """Solids of the part relative to the centre of its body at rest, that centre, and the joint."""

    solids: list[Primitive]
    middle: Float[np.ndarray, "3"]
    joint: Joint


def hard_parts(
    case: str = "wheel",
    amount: float = 0.0,
    seed: int = 0,
    frames: int = 16,
    width: int = 320,
    height: int = 240,
    cameras: int = 8,
) -> Sequence:
    """A part that is hard to find, and a box that is not: RGB-D, labels, optical flow, exact poses, and the
    joint of the part; 15 Hz. These are the failure cases of MotionSplicer, figure 9, with adjustable
    difficulty. A sequence of fewer frames is a prefix of the longer one; after frame 15 nothing moves.

    Labels are 0 scene (a floor and a wall), 1 the part, 2 a box that slides by 0.2 m and turns. The cameras
    are on an arc in front of the wall.

    Args:
        case: "wheel", which turns by 80 degrees about its axle, with the wall visible through its gaps;
            "small", a block that slides; "thin", a rod that swings about its foot; "flush", a panel that
            slides in a frame of the same wood.
        amount: the number of spokes; or the slide of the block, the width of the rod, or the protrusion of
            the panel from its frame, metres. 0 selects the default in `AMOUNTS`.
        seed: seed of the patterns.
        frames: number of frames.
        width: pixels.
        height: pixels.
        cameras: number of cameras.

    Raises:
        ValueError: there is no such case, or a number is too small.
    """
    if case not in AMOUNTS:
        raise ValueError(f"case: expected one of {', '.join(AMOUNTS)}, found {case!r}")
    amount = amount or AMOUNTS[case]
    if not amount > 0 or (case == "wheel" and amount < 2):
        expected = "2 or more spokes" if case == "wheel" else "more than 0 metres"
        raise ValueError(f"amount: expected {expected}, found {amount}")
    check_counts(frames=frames, width=width, height=height, cameras=cameras)
    share = minimum_jerk(np.arange(frames) / _FRAMES)
    make = {"wheel": _wheel, "small": _small, "thin": _thin, "flush": _flush}[case]
    part = make(amount, share, seed)
    rest = np.array([[0.0, 0.0, 0.0], part.middle, _BOX_FROM])
    poses = np.broadcast_to(rigid(None, rest), (frames, 3, 4, 4)).copy()
    poses[:, _PART] = part.joint.motions() @ poses[:, _PART]
    poses[:, _BOX, :3, 3] += share[:, None] * np.array(_BOX_PATH)
    poses[:, _BOX, :3, :3] = turn((0.0, 0.0, 1.0), 0.8 * share).as_matrix()
    angles = np.deg2rad(_ARC) * (np.linspace(-0.5, 0.5, cameras) if cameras > 1 else np.zeros(1))
    heights = np.deg2rad(np.where(np.arange(cameras) % 2, 32.0, 16.0))
    flat = np.stack([np.cos(angles), np.sin(angles)], axis=1) * np.cos(heights)[:, None]
    eyes = _TARGET + _DISTANCE * np.concatenate([flat, np.sin(heights)[:, None]], axis=1)
    scene = Scene(
        primitives=(*_room(seed), *part.solids),
        labels=np.arange(_BOX + 1),
        poses=poses,
        light=_LIGHT,
        Ks=np.broadcast_to(intrinsics(0.95 * width, width, height), (frames, cameras, 3, 3)),
        viewmats=np.broadcast_to([look_at(eye, _TARGET) for eye in eyes], (frames, cameras, 4, 4)),
        width=width,
        height=height,
    )
    name = f"hard_parts_{case}_{amount:g}"
    bodies = {"part": _PART, "box": _BOX}
    return simulated_sequence(name, scene, np.arange(frames) / RATE_HZ, bodies, joints=(part.joint, None))


def _room(seed: int) -> list[Primitive]:
    floor = Texture("checker", ((0.44, 0.45, 0.47), (0.56, 0.57, 0.58)), 0.12, seed=1)
    wall = Texture("noise", ((0.60, 0.58, 0.52), (0.84, 0.82, 0.76)), 0.07, seed=20 * seed + 2)
    red = Texture("label", ((0.80, 0.24, 0.18), (0.96, 0.90, 0.74)), 0.06, seed=20 * seed + 3)
    return [
        Primitive("plane", (), floor, _WORLD),
        Primitive("box", _WALL_SIZE, wall, _WORLD, rigid(None, _WALL_AT)),
        Primitive("box", _BOX_SIZE, red, _BOX),
    ]


def _wheel(spokes: float, share: Float[np.ndarray, "t"], seed: int) -> _PartModel:
    """An upright wheel that faces the cameras, with a rim of short boards, on a post."""
    steel = Texture("noise", ((0.12, 0.30, 0.50), (0.36, 0.58, 0.80)), 0.03, seed=20 * seed + 4)
    middle, radius, board = np.array([-0.02, 0.08, 0.24]), 0.17, 0.012
    solids = [_at(_PART, (board, 0.03, 0.03), steel, np.zeros(3))]
    for angle in np.linspace(0, 2 * np.pi, 32, endpoint=False):
        length = radius * np.tan(np.pi / 32) + 0.002
        solids.append(_around_x(angle, (board, board, length), steel, radius))
    for angle in np.linspace(0, 2 * np.pi, round(spokes), endpoint=False):
        solids.append(_around_x(angle, (board * 0.6, radius / 2, 0.009), steel, radius / 2))
    solids.append(
        _at(_WORLD, (0.02, 0.02, middle[2] / 2), steel, [middle[0] - 0.05, middle[1], middle[2] / 2])
    )
    return _PartModel(solids, middle, Joint("revolute", np.array([1.0, 0, 0]), middle, _TURN * share))


def _small(far: float, share: Float[np.ndarray, "t"], seed: int) -> _PartModel:
    """A block that slides along the wall."""
    blue = Texture("checker", ((0.16, 0.30, 0.52), (0.60, 0.72, 0.86)), 0.03, seed=20 * seed + 4)
    middle = np.array([0.0, 0.10, 0.08])
    solids = [_at(_PART, (0.06, 0.08, 0.08), blue, np.zeros(3))]
    return _PartModel(solids, middle, Joint("prismatic", np.array([0.0, 1.0, 0.0]), middle, far * share))


def _thin(wide: float, share: Float[np.ndarray, "t"], seed: int) -> _PartModel:
    """A rod that swings about its foot, in front of the wall."""
    green = Texture("stripes", ((0.16, 0.42, 0.24), (0.62, 0.80, 0.48)), 0.03, seed=20 * seed + 4)
    foot, half = np.array([0.0, 0.16, 0.02]), 0.16
    middle = foot + np.array([0.0, 0.0, half])
    solids = [_at(_PART, (wide / 2, wide / 2, half), green, np.zeros(3))]
    return _PartModel(solids, middle, Joint("revolute", np.array([1.0, 0, 0]), foot, _TURN * share))


def _flush(out: float, share: Float[np.ndarray, "t"], seed: int) -> _PartModel:
    """A panel that slides in a frame of the same wood."""
    wood = Texture("noise", ((0.55, 0.40, 0.26), (0.74, 0.58, 0.40)), 0.05, seed=20 * seed + 4)
    thick, wide, high, low = 0.015, 0.11, 0.13, 0.18
    front = _WALL_FRONT + 2 * thick
    middle = np.array([front + out - thick, -0.08, low])
    solids = [_at(_PART, (thick, wide, high), wood, np.zeros(3))]
    solids.append(_at(_WORLD, (thick, 0.36, 0.17), wood, [_WALL_FRONT + thick - 1e-3, 0.06, low]))
    return _PartModel(solids, middle, Joint("prismatic", np.array([0.0, 1.0, 0.0]), middle, 0.22 * share))


def _at(body: int, size: tuple[float, ...], texture: Texture, center) -> Primitive:
    return Primitive("box", size, texture, body, rigid(None, center))


def _around_x(angle: float, size: tuple[float, ...], texture: Texture, out: float) -> Primitive:
    """A board of the wheel, at distance `out` and an angle about x."""
    turned = turn((1.0, 0.0, 0.0), angle)
    return Primitive("box", size, texture, _PART, rigid(turned, turned.apply([0.0, out, 0.0])))
