"""Furniture that opens: a cabinet with a drawer and two doors, a chest with a lid, and a box on the floor."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from gsjax.data.sequence import Sequence
from gsjax.data.simulated.motion import coast, minimum_jerk, rigid, turn
from gsjax.data.simulated.primitives import Primitive
from gsjax.data.simulated.raycaster import Light, Scene
from gsjax.data.simulated.simulation import check_counts, simulated_sequence, viewmats_around
from gsjax.data.simulated.textures import Texture
from gsjax.geometry.cameras import intrinsics
from gsjax.geometry.joints import Joint

RATE_HZ = 15.0
PARTS = ("drawer", "door", "lid", "box", "shut door")

_WORLD, _DRAWER, _DOOR, _LID, _BOX, _SHUT, _CABINET, _CHEST = range(8)  # bodies; labels are the same numbers
_UP, _FORWARD, _LEFT = (0.0, 0.0, 1.0), (1.0, 0.0, 0.0), (0.0, 1.0, 0.0)
_WALL = 0.008  # half the thickness of a board

# Half sizes and centres, metres; the floor is z = 0, and everything opens towards +x.
_CABINET_SIZE, _CABINET_AT = (0.16, 0.26, 0.27), (0.0, -0.22, 0.27)
_SHELF_Z = 0.20  # below it the drawer, above it the doors
_CHEST_SIZE, _CHEST_AT = (0.14, 0.18, 0.10), (0.0, 0.36, 0.10)
_BOX_SIZE = (0.055, 0.040, 0.070)
_TARGET = np.array([0.08, 0.04, 0.20])
_LIGHT = Light(position=(1.3, 0.9, 1.9), radius=0.03)


@dataclass(frozen=True)
class _Motion:
    """Random parameters drawn from the seed: opening and start frame of each joint, and the box's motion."""

    slide: float  # metres, the drawer's
    swing: float  # radians, the door's
    lift: float  # radians, the lid's
    starts: Float[np.ndarray, "4"]  # frames: drawer, door, lid, box
    box_from: Float[np.ndarray, "2"]
    box_path: Float[np.ndarray, "2"]
    box_turn: float


def articulated(
    seed: int = 0,
    frames: int = 40,
    width: int = 320,
    height: int = 240,
    cameras: int = 10,
    *,
    still: bool = False,
) -> Sequence:
    """Furniture that opens, seen from all around: RGB-D, labels, optical flow, exact poses and joints; 15 Hz.

    Labels are 0 scene, 1 drawer (slides), 2 door (turns), 3 lid (turns), 4 box (slides and turns freely),
    5 shut door (never moves), 6 cabinet, 7 chest. The parts start at different times: one moves from the
    first frame, the last one starts by frame 16. A sequence of fewer frames is a prefix of the longer one;
    after frame 36 everything is at rest.

    Args:
        seed: seed of the openings, the start times, and the patterns.
        frames: number of frames.
        width: pixels.
        height: pixels.
        cameras: number of cameras, in a circle around the furniture, alternately lower and higher.
        still: nothing moves.

    Raises:
        ValueError: a count is below 1.
    """
    check_counts(frames=frames, width=width, height=height, cameras=cameras)
    motion = _draw_motion(seed)
    poses, joints = _poses(motion, np.zeros(frames) if still else np.arange(frames, dtype=np.float64))
    scene = Scene(
        primitives=tuple(_solids(seed)),
        labels=np.arange(_CHEST + 1),
        poses=poses,
        light=_LIGHT,
        Ks=np.broadcast_to(intrinsics(0.95 * width, width, height), (frames, cameras, 3, 3)),
        viewmats=np.broadcast_to(viewmats_around(_TARGET, 1.45, cameras, low=24.0), (frames, cameras, 4, 4)),
        width=width,
        height=height,
    )
    bodies = {name: _DRAWER + i for i, name in enumerate(PARTS)}
    times = np.arange(frames) / RATE_HZ
    return simulated_sequence(f"articulated_seed{seed}", scene, times, bodies, joints=joints)


def _draw_motion(seed: int) -> _Motion:
    rng = np.random.default_rng(seed)
    starts = rng.permutation([0.0, 4.0, 9.0, 16.0])
    return _Motion(
        slide=rng.uniform(0.16, 0.24),
        swing=np.deg2rad(rng.uniform(70, 110)),
        lift=np.deg2rad(rng.uniform(55, 85)),
        starts=starts,
        box_from=np.array([0.42, 0.0]) + rng.uniform(-0.04, 0.04, 2),
        box_path=np.array([rng.uniform(-0.05, 0.05), rng.uniform(0.20, 0.28)]),
        box_turn=rng.choice([-1.0, 1.0]) * rng.uniform(0.6, 1.2),
    )


def _rest() -> Float[np.ndarray, "bodies 3"]:
    """Centre of each body while everything is shut; that of the box is relative to its start."""
    x, y, _ = _CABINET_AT
    front = x + _CABINET_SIZE[0]
    above = (_SHELF_Z + 2 * _CABINET_AT[2]) / 2
    half = _CABINET_SIZE[1] / 2
    return np.array(
        [
            [0.0, 0.0, 0.0],
            [x, y, _SHELF_Z / 2],
            [front, y + half, above],
            [_CHEST_AT[0], _CHEST_AT[1], 2 * _CHEST_AT[2] + _WALL],
            [0.0, 0.0, _BOX_SIZE[2]],
            [front, y - half, above],
            list(_CABINET_AT),
            list(_CHEST_AT),
        ]
    )


def _poses(
    motion: _Motion, moments: Float[np.ndarray, "t"]
) -> tuple[Float[np.ndarray, "t bodies 4 4"], tuple[Joint | None, ...]]:
    """Body-to-world transforms, and the joint of each of PARTS."""
    rest, starts = _rest(), motion.starts
    poses = np.broadcast_to(rigid(None, rest), (len(moments), len(rest), 4, 4)).copy()
    slid = motion.slide * minimum_jerk((moments - starts[0]) / 14.0)
    swung = motion.swing * minimum_jerk((moments - starts[1]) / 20.0)
    lifted = motion.lift * minimum_jerk((moments - starts[2]) / 16.0)
    hinge = rest[_DOOR] + np.array([0.0, _CABINET_SIZE[1] / 2, 0.0])
    back = rest[_LID] + np.array([-_CHEST_SIZE[0], 0.0, -_WALL])
    drawer = Joint("prismatic", np.array(_FORWARD), rest[_DRAWER], slid)
    door = Joint("revolute", np.array(_UP), hinge, swung)
    lid = Joint("revolute", -np.array(_LEFT), back, lifted)
    shut = Joint("revolute", -np.array(_UP), rest[_SHUT] - (hinge - rest[_DOOR]), 0.0 * swung)
    for body, joint in ((_DRAWER, drawer), (_DOOR, door), (_LID, lid)):
        poses[:, body] = joint.motions() @ poses[:, body]
    share = coast(moments, starts[3], 20.0)
    centers = np.concatenate([motion.box_from + share[:, None] * motion.box_path, 0 * share[:, None]], axis=1)
    poses[:, _BOX] = rigid(turn(_UP, share * motion.box_turn), centers + rest[_BOX])
    return poses, (drawer, door, lid, None, shut)


def _solids(seed: int) -> list[Primitive]:
    s = 20 * seed
    floor = Texture("checker", ((0.44, 0.45, 0.47), (0.56, 0.57, 0.58)), 0.12, seed=1)
    oak = Texture("stripes", ((0.55, 0.40, 0.26), (0.70, 0.54, 0.37)), 0.05, seed=s + 2, grain=0.18)
    inside = Texture("noise", ((0.80, 0.77, 0.70), (0.92, 0.90, 0.85)), 0.06, seed=s + 3)
    blue = Texture("noise", ((0.16, 0.30, 0.52), (0.34, 0.52, 0.72)), 0.07, seed=s + 4)
    green = Texture("checker", ((0.26, 0.48, 0.34), (0.62, 0.76, 0.54)), 0.045, seed=s + 5)
    red = Texture("label", ((0.80, 0.24, 0.18), (0.96, 0.90, 0.74)), 0.06, seed=s + 6)
    steel = Texture("noise", ((0.62, 0.63, 0.66), (0.86, 0.87, 0.88)), 0.03, seed=s + 7)
    solids = [Primitive("plane", (), floor)]
    solids += _case(_CABINET, _CABINET_SIZE, oak, inside, open_side=(0, 1))
    shelf = (_CABINET_SIZE[0], _CABINET_SIZE[1] - 2 * _WALL, _WALL)
    solids.append(_board(_CABINET, shelf, (0.0, 0.0, _SHELF_Z - _CABINET_AT[2]), inside))
    solids += _case(_CHEST, _CHEST_SIZE, green, inside, open_side=(2, 1))
    solids += _drawer(blue, inside, steel)
    for body, side in ((_DOOR, -1.0), (_SHUT, 1.0)):  # handles where the two meet
        high = (2 * _CABINET_AT[2] - _SHELF_Z) / 2 - 0.004
        solids.append(_board(body, (_WALL, _CABINET_SIZE[1] / 2 - 0.003, high), (_WALL, 0.0, 0.0), blue))
        handle = (3 * _WALL, side * (_CABINET_SIZE[1] / 2 - 0.03), 0.0)
        solids.append(_board(body, (0.012, 0.008, 0.045), handle, steel))
    solids.append(_board(_LID, (_CHEST_SIZE[0], _CHEST_SIZE[1], _WALL), (0.0, 0.0, 0.0), green))
    solids.append(_board(_LID, (0.010, 0.030, 0.012), (_CHEST_SIZE[0] + 0.010, 0.0, 0.0), steel))
    solids.append(_board(_BOX, _BOX_SIZE, (0.0, 0.0, 0.0), red))
    return solids


def _board(body: int, size: tuple, center: tuple, texture: Texture) -> Primitive:
    return Primitive("box", size, texture, body, rigid(None, center))


def _case(
    body: int, size: tuple, outside: Texture, inside: Texture, open_side: tuple[int, int]
) -> list[Primitive]:
    """Five boards of a hollow box that is open at the side `open_side` (axis, sign)."""
    boards = []
    for axis in range(3):
        for sign in (-1, 1):
            if (axis, sign) == open_side:
                continue
            half, center = list(size), [0.0, 0.0, 0.0]
            half[axis], center[axis] = _WALL, sign * (size[axis] - _WALL)
            boards.append(_board(body, tuple(half), tuple(center), inside if axis == 0 else outside))
    return boards


def _drawer(front: Texture, inside: Texture, handle: Texture) -> list[Primitive]:
    """An open tray behind a front panel that lies in front of the cabinet."""
    deep, wide, high = _CABINET_SIZE[0], _CABINET_SIZE[1], _SHELF_Z / 2 - 0.006
    tray = (deep - 3 * _WALL, wide - 5 * _WALL, high - 2.5 * _WALL)
    boards = _case(_DRAWER, tray, inside, inside, open_side=(2, 1))
    boards.append(_board(_DRAWER, (_WALL, wide - 0.003, high), (deep + _WALL, 0.0, 0.0), front))
    boards.append(_board(_DRAWER, (0.012, 0.07, 0.008), (deep + 3 * _WALL, 0.0, 0.02), handle))
    return boards
