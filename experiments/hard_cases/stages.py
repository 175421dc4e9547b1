"""Small scenes on a table, each with one kind of motion that may defeat a tracker."""

from collections.abc import Callable
from typing import NamedTuple

import numpy as np

from gsjax.data import Sequence
from gsjax.data.simulated.motion import along_keyframes, rigid, turn
from gsjax.data.simulated.primitives import Primitive
from gsjax.data.simulated.raycaster import Light, Scene
from gsjax.data.simulated.robot import BODIES as ROBOT_BODIES
from gsjax.data.simulated.robot import robot_poses, robot_primitives
from gsjax.data.simulated.simulation import simulated_sequence
from gsjax.data.simulated.textures import Texture
from gsjax.geometry.cameras import intrinsics, look_at

FRAMES, WIDTH, HEIGHT, HZ = 40, 240, 180, 30.0
_UP = (0.0, 0.0, 1.0)
_TARGET = np.array([0.0, 0.0, 0.04])
_FIRST_LABEL = 2  # 0 is the background, 1 the robot

Poses = np.ndarray  # [FRAMES, 4, 4]


class Thing(NamedTuple):
    """An object: the solids of one body, and its poses."""

    name: str
    solids: tuple[Primitive, ...]
    poses: Poses


def _box(size=(0.045, 0.028, 0.065), kind="label", colors=((0.86, 0.24, 0.16), (0.97, 0.91, 0.72)), seed=4):
    return (Primitive("box", size, Texture(kind, colors, 0.06, seed=seed)),)


def _can(kind="label", colors=((0.16, 0.42, 0.72), (0.95, 0.96, 0.97)), seed=5):
    return (Primitive("cylinder", (0.034, 0.055), Texture(kind, colors, 0.055, seed=seed)),)


def _plain(color):
    """One colour, without grain."""
    return {"kind": "stripes", "colors": (color, color)}


def _path(x, y, z=0.065, yaw=0.0, pitch=0.0) -> Poses:
    """Poses from coordinates in metres and radians, each one value or one per frame."""
    places = np.stack([np.broadcast_to(a, FRAMES).astype(float) for a in (x, y, z)], axis=1)
    yaw, pitch = (np.broadcast_to(a, FRAMES).astype(float) for a in (yaw, pitch))
    return rigid(turn(_UP, yaw) * turn((0.0, 1.0, 0.0), pitch), places)


def _between(start: float, stop: float, low: float, high: float) -> np.ndarray:
    """A coordinate that moves from `low` to `high` between two frames."""
    return along_keyframes(np.arange(FRAMES, dtype=float), (start, stop), [[low], [high]])[:, 0]


def _block(x=-0.16, y=0.16) -> Thing:
    """A block that never moves."""
    return Thing(
        "block",
        _box((0.034, 0.034, 0.03), "checker", ((0.24, 0.56, 0.32), (0.8, 0.86, 0.6)), 8),
        _path(x, y, 0.03),
    )


def jumps() -> list[Thing]:
    """Jumps of 40 mm in random directions at every fourth frame; the can also turns by 20 degrees."""
    rng = np.random.default_rng(0)
    count = FRAMES // 4

    def walk(x, y):
        angles = rng.uniform(0, 2 * np.pi, count)
        steps = 0.04 * np.stack([np.cos(angles), np.sin(angles)], axis=1)
        places = np.cumsum(np.concatenate([[[0.0, 0.0]], steps])[:count], axis=0)
        # Back to the middle where the walk would leave it: a jump of the same length the other way.
        for i in range(1, count):
            if np.abs(places[i]).max() > 0.07:
                places[i:] -= 2 * steps[i - 1]
        x_, y_ = np.repeat(places, 4, axis=0).T
        return x + x_, y + y_

    turns = np.repeat(np.arange(count), 4) * np.deg2rad(20.0)
    return [
        Thing("carton", _box(), _path(*walk(0.02, -0.13))),
        Thing("can", _can(), _path(*walk(0.04, 0.12), 0.055, turns)),
        _block(-0.2, 0.0),
    ]


def spins(degrees: float) -> list[Thing]:
    """A box and a can that turn about the vertical, and a box that tumbles, by the given angle a frame."""
    angle = np.deg2rad(degrees) * np.arange(FRAMES)
    return [
        Thing("carton", _box(), _path(0.02, -0.13, yaw=angle)),
        Thing("can", _can(), _path(0.0, 0.14, 0.055, angle)),
        Thing(
            "tumbler",
            _box(seed=14, colors=((0.3, 0.5, 0.2), (0.9, 0.9, 0.6))),
            _path(-0.14, 0.0, 0.1, 0.3, angle),
        ),
    ]


def touches() -> list[Thing]:
    """A box is pushed against another, pushes it along, and slides along its face."""
    y = _between(2, 14, -0.16, -0.034)
    along = _between(22, 36, 0.0, 0.09)
    return [
        Thing("pusher", _box(), _path(0.02 + along, y + _between(14, 22, 0.0, 0.05))),
        Thing(
            "pushed",
            _box(seed=24, colors=((0.2, 0.3, 0.6), (0.9, 0.8, 0.5))),
            _path(0.02, 0.024 + _between(14, 22, 0.0, 0.05)),
        ),
        _block(-0.2, 0.0),
    ]


def passes() -> list[Thing]:
    """A box goes in front of a can, which goes the other way, and hides it from each camera in turn."""
    return [
        Thing("carton", _box(), _path(0.12, _between(2, 38, -0.2, 0.2))),
        Thing("can", _can(), _path(0.0, _between(2, 38, 0.18, -0.18), 0.055)),
        _block(-0.2, 0.0),
    ]


def returns() -> list[Thing]:
    """A can is gone from frame 12 to frame 22, and comes back 15 cm away, turned by 40 degrees."""
    gone = (np.arange(FRAMES) >= 12) & (np.arange(FRAMES) < 22)
    back = np.arange(FRAMES) >= 22
    x, y = np.where(back, 0.08, 0.06), np.where(back, -0.05, 0.1)
    z = np.where(gone, -5.0, 0.055)
    return [
        Thing("can", _can(), _path(x, y, z, np.where(back, 0.7, 0.0))),
        _block(),
        Thing("carton", _box(), _path(-0.05, -0.18)),
    ]


def twins() -> list[Thing]:
    """Two boxes that look the same go round each other, their faces a centimetre apart."""
    angle = np.deg2rad(9.0) * np.arange(FRAMES)
    around = 0.035 * np.cos(angle), 0.035 * np.sin(angle)
    small = (0.03, 0.03, 0.05)
    return [
        Thing("one twin", _box(small), _path(around[0], around[1], 0.05, angle)),
        Thing("other twin", _box(small), _path(-around[0], -around[1], 0.05, angle)),
        _block(-0.2, 0.0),
    ]


def plain() -> list[Thing]:
    """A box, a can and a ball of one colour each slide and turn."""
    slide = _between(2, 30, 0.0, 0.15)
    ball = Primitive("sphere", (0.036,), Texture(scale=0.05, seed=7, **_plain((0.9, 0.7, 0.1))))
    return [
        Thing(
            "box", _box(**_plain((0.8, 0.25, 0.2))), _path(slide - 0.05, -0.14, yaw=_between(2, 30, 0.0, 1.2))
        ),
        Thing(
            "can",
            _can(**_plain((0.2, 0.4, 0.75))),
            _path(0.1 - slide, 0.15, 0.055, _between(2, 30, 0.0, 1.0)),
        ),
        Thing("ball", (ball,), _path(-0.1 + slide, 0.02, 0.036)),
    ]


STAGES: dict[str, Callable[[], list[Thing]]] = {
    "jumps of 40 mm": jumps,
    "turns of 10° a frame": lambda: spins(10.0),
    "turns of 20° a frame": lambda: spins(20.0),
    "turns of 30° a frame": lambda: spins(30.0),
    "objects that touch": touches,
    "one passes in front": passes,
    "gone, and back elsewhere": returns,
    "twins": twins,
    "without texture": plain,
}


def gripper() -> Sequence:
    """A hand with an opening of 70 mm closes on a can, lifts it, and turns it by 60 degrees: the fingers move
    relative to it, and all of the robot has one label."""
    opening = _between(2, 16, 0.07, 0.034)
    can = _path(0.02, 0.0, 0.055 + _between(20, 36, 0.0, 0.12), _between(20, 36, 0.0, 1.05))
    grasp = can @ rigid(None, np.tile([0.0, 0.0, 0.02], (FRAMES, 1)))
    arm = robot_poses(grasp, opening)
    return _sequence("gripper", [Thing("can", _can(), can), _block()], arm)


def stage(name: str) -> Sequence:
    """One of `STAGES`, seen by three RGB-D cameras."""
    return _sequence(name, STAGES[name](), None)


def _sequence(name: str, things: list[Thing], arm: np.ndarray | None) -> Sequence:
    first = 1 + (ROBOT_BODIES if arm is not None else 0)
    wood = Texture("stripes", ((0.60, 0.43, 0.28), (0.72, 0.55, 0.38)), 0.035, seed=2, grain=0.18)
    table = Primitive("box", (0.6, 0.55, 0.02), wood, pose=rigid(None, [0.0, 0.0, -0.02]))
    floor = Texture("checker", ((0.46, 0.47, 0.49), (0.54, 0.55, 0.56)), 0.35, seed=1)
    solids = [Primitive("plane", (), floor, pose=rigid(None, [0.0, 0.0, -0.65])), table]
    if arm is not None:
        solids += robot_primitives(1)
    for i, thing in enumerate(things):
        solids += [Primitive(s.shape, s.size, s.texture, first + i, s.pose) for s in thing.solids]
    world = np.broadcast_to(np.eye(4), (FRAMES, 1, 4, 4))
    bodies = [world, *([] if arm is None else [arm]), *(thing.poses[:, None] for thing in things)]
    labels = [0, *([1] * (first - 1)), *range(_FIRST_LABEL, _FIRST_LABEL + len(things))]
    azimuths, heights = np.deg2rad([-55.0, 0.0, 55.0]), np.deg2rad([36.0, 44.0, 36.0])
    eyes = [_eye(a, h) for a, h in zip(azimuths, heights, strict=True)]
    views = np.stack([look_at(eye, _TARGET) for eye in eyes])
    scene = Scene(
        primitives=tuple(solids),
        labels=np.array(labels),
        poses=np.concatenate(bodies, axis=1),
        light=Light(position=(0.55, -0.75, 1.35), radius=0.02),
        Ks=np.broadcast_to(intrinsics(0.95 * WIDTH, WIDTH, HEIGHT), (FRAMES, 3, 3, 3)),
        viewmats=np.broadcast_to(views, (FRAMES, 3, 4, 4)),
        width=WIDTH,
        height=HEIGHT,
    )
    named = {thing.name: first + i for i, thing in enumerate(things)}
    return simulated_sequence(name, scene, np.arange(FRAMES) / HZ, named, robot=None if arm is None else 1)


def _eye(azimuth: float, elevation: float) -> np.ndarray:
    flat = np.array([np.cos(azimuth), np.sin(azimuth)]) * np.cos(elevation)
    return _TARGET + 0.90 * np.array([*flat, np.sin(elevation)])
