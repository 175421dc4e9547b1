"""A cabinet in two states: doors and drawers before and after they moved, each seen by its own cameras."""

import numpy as np
from jaxtyping import Float

from gsjax.data.sequence import Sequence
from gsjax.data.simulated.motion import rigid
from gsjax.data.simulated.primitives import Primitive
from gsjax.data.simulated.raycaster import Light, Scene
from gsjax.data.simulated.simulation import check_counts, simulated_sequence
from gsjax.data.simulated.textures import Texture
from gsjax.geometry.cameras import intrinsics, look_at
from gsjax.geometry.joints import Joint

# Half sizes, metres. The floor is z = 0, the front is at +x, columns go along y.
_DEEP, _HIGH, _COLUMN, _BOARD = 0.20, 0.26, 0.16, 0.008
_SHELF = 0.34  # height of the board between doors and drawers, metres
_TARGET = np.array([0.0, 0.0, 0.26])
_LIGHT = Light(position=(1.6, 0.9, 2.2), radius=0.03)
_OPEN = {"revolute": np.deg2rad((5.0, 110.0)), "prismatic": np.array((0.01, 0.24))}
_LEAST = 0.4  # share of that range that each part moves at least


def cabinet(
    doors: int = 1,
    drawers: int = 1,
    seed: int = 0,
    width: int = 320,
    height: int = 240,
    cameras: int = 24,
) -> Sequence:
    """Two states of a cabinet with doors that turn and drawers that slide, as PARIS has them: RGB-D, labels,
    exact poses and joints. Each state is seen by its own cameras, in front of the cabinet and above it.

    Labels are 0 scene (the floor and the cabinet), then the doors, then the drawers.

    Args:
        doors: number of doors, hinged alternately on the left and on the right.
        drawers: number of drawers, above the doors.
        seed: seed of the patterns, of how far parts are open, and of the cameras.
        width: pixels.
        height: pixels.
        cameras: number of cameras of each state.

    Raises:
        ValueError: a number is too small.
    """
    check_counts(width=width, height=height, cameras=cameras, parts=doors + drawers)
    if min(doors, drawers) < 0:
        raise ValueError(f"doors, drawers: expected 0 or more of each, found {doors} and {drawers}")
    random = np.random.default_rng(seed)
    columns = max(doors, drawers)
    middles = 2 * _COLUMN * (np.arange(columns) - (columns - 1) / 2)
    joints, solids = [], _frame(middles, seed)
    for k in range(doors):
        body, side = len(joints) + 1, -1.0 if k % 2 else 1.0
        hinge = np.array([_DEEP + _BOARD, middles[k] - side * _COLUMN, 0.0])
        joints.append(Joint("revolute", np.array([0.0, 0.0, -side]), hinge, _values("revolute", random)))
        solids += _door(body, middles[k], _wood(seed, body))
    for k in range(drawers):
        body = len(joints) + 1
        middle = np.array([0.0, middles[k], 0.0])
        joints.append(Joint("prismatic", np.array([1.0, 0.0, 0.0]), middle, _values("prismatic", random)))
        solids += _drawer(body, middles[k], _wood(seed, body))
    poses = np.broadcast_to(np.eye(4), (2, len(joints) + 1, 4, 4)).copy()
    for body, joint in enumerate(joints, start=1):
        poses[:, body] = joint.motions()
    distance = 1.1 + 0.3 * columns
    eyes = np.stack([_eyes(random, cameras, distance) for _ in range(2)])
    scene = Scene(
        primitives=tuple(solids),
        labels=np.arange(len(joints) + 1),
        poses=poses,
        light=_LIGHT,
        Ks=np.broadcast_to(intrinsics(0.95 * width, width, height), (2, cameras, 3, 3)),
        viewmats=np.array([[look_at(eye, _TARGET) for eye in of] for of in eyes]),
        width=width,
        height=height,
    )
    names = [f"door_{k + 1}" for k in range(doors)] + [f"drawer_{k + 1}" for k in range(drawers)]
    bodies = {name: body for body, name in enumerate(names, start=1)}
    return simulated_sequence(
        f"cabinet_{doors}_{drawers}", scene, np.arange(2.0), bodies, joints=tuple(joints)
    )


def _values(kind: str, random: np.random.Generator) -> Float[np.ndarray, "2"]:
    """How far a part is open in each state."""
    low, high = random.uniform(0, (1 - _LEAST) / 2), random.uniform((1 + _LEAST) / 2, 1)
    least, most = _OPEN[kind]
    return least + (most - least) * np.array([low, high] if random.uniform() < 0.5 else [high, low])


def _eyes(random: np.random.Generator, count: int, distance: float) -> Float[np.ndarray, "count 3"]:
    """Camera positions in front of the cabinet and above it."""
    azimuths = np.deg2rad(random.uniform(-100, 100, count))
    heights = np.arcsin(random.uniform(0.1, 0.95, count))
    flat = np.stack([np.cos(azimuths), np.sin(azimuths)], -1) * np.cos(heights)[:, None]
    return _TARGET + distance * np.concatenate([flat, np.sin(heights)[:, None]], -1)


def _frame(middles: Float[np.ndarray, "columns"], seed: int) -> list[Primitive]:
    """The floor, and a cabinet without a top, with a wall between neighbouring columns."""
    floor = Texture("checker", ((0.44, 0.45, 0.47), (0.56, 0.57, 0.58)), 0.12, seed=1)
    wood = Texture("stripes", ((0.50, 0.34, 0.22), (0.66, 0.48, 0.32)), 0.06, seed=20 * seed)
    wide = _COLUMN * len(middles)
    edges = np.append(middles - _COLUMN, wide)
    walls = [_box(0, (_DEEP, _BOARD, _HIGH), (0, edge, _HIGH), wood) for edge in edges]
    back = _box(0, (_BOARD, wide, _HIGH), (-_DEEP, 0, _HIGH), wood)
    boards = [_box(0, (_DEEP, wide, _BOARD), (0, 0, at), wood) for at in (_BOARD, _SHELF)]
    return [Primitive("plane", (), floor, 0), *walls, back, *boards]


def _door(body: int, middle: float, wood: Texture) -> list[Primitive]:
    high = _SHELF / 2 - _BOARD
    knob = (_DEEP + 4 * _BOARD, middle, high)
    return [
        _box(body, (_BOARD, _COLUMN - 0.004, high), (_DEEP + _BOARD, middle, _BOARD + high), wood),
        _box(body, (2 * _BOARD, 0.03, _BOARD), knob, wood),
    ]


def _drawer(body: int, middle: float, wood: Texture) -> list[Primitive]:
    high, wide, low = (2 * _HIGH - _SHELF) / 2 - _BOARD, _COLUMN - 2.5 * _BOARD, _SHELF + _BOARD
    deep, side = _DEEP - 2 * _BOARD, (2 * _HIGH - _SHELF) / 3
    front = _box(body, (_BOARD, _COLUMN - 0.004, high), (_DEEP + _BOARD, middle, low + high), wood)
    bottom = _box(body, (deep, wide, _BOARD / 2), (0, middle, low + _BOARD), wood)
    sides = [
        _box(body, (deep, _BOARD / 2, side / 2), (0, middle + way * wide, low + _BOARD + side / 2), wood)
        for way in (-1, 1)
    ]
    back = _box(body, (_BOARD / 2, wide, side / 2), (-deep, middle, low + _BOARD + side / 2), wood)
    knob = _box(body, (2 * _BOARD, 0.04, _BOARD), (_DEEP + 4 * _BOARD, middle, low + high), wood)
    return [front, bottom, *sides, back, knob]


def _wood(seed: int, body: int) -> Texture:
    """Wood of a part, in one of four brightnesses."""
    light = np.array([0.06, 0.05, 0.03]) * (body % 4)
    dark, bright = (
        tuple((np.array(color) + light).tolist()) for color in ((0.42, 0.46, 0.40), (0.62, 0.66, 0.58))
    )
    return Texture("noise", (dark, bright), 0.05, seed=20 * seed + body)


def _box(body: int, size: tuple[float, ...], center: tuple[float, ...], texture: Texture) -> Primitive:
    return Primitive("box", size, texture, body, rigid(None, np.array(center)))
