"""A table on which an arm carries a carton, a can slides, a ball rolls, and a block never moves."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from gsjax.data.sequence import Sequence
from gsjax.data.simulated.motion import along_keyframes, coast, rigid, turn
from gsjax.data.simulated.primitives import Primitive
from gsjax.data.simulated.raycaster import Light, Scene, render_labels, trace
from gsjax.data.simulated.robot import BODIES as ROBOT_BODIES
from gsjax.data.simulated.robot import robot_poses, robot_primitives
from gsjax.data.simulated.simulation import check_counts, simulated_sequence
from gsjax.data.simulated.textures import Texture
from gsjax.geometry.cameras import intrinsics, look_at

RATE_HZ = 30.0
NAMES = ("carton", "can", "ball", "block")
ROBOT_LABEL, FIRST_OBJECT_LABEL = 1, 2

_FIRST_BODY = 1 + ROBOT_BODIES  # the first object's; body 0 is the world

CARTON = (0.045, 0.028, 0.065)
CAN = (0.034, 0.055)
BALL = 0.036
BLOCK = (0.034, 0.034, 0.030)
_HEIGHTS = (CARTON[2], CAN[1], BALL, BLOCK[2])
_CLEARANCES = (0.085, 0.045, 0.045, 0.055)  # the carton's includes the fingers

# Frames at which the carton is gripped, lifted, carried across, and put down.
_CARRY = (4.0, 16.0, 37.0, 47.0)
_LIFT_M = 0.16
_LIGHT = Light(position=(0.55, -0.75, 1.35), radius=0.02)
_UP = (0.0, 0.0, 1.0)
_TARGET = np.array([-0.03, 0.0, 0.04])

# The garage that hides the can: inner half sizes and position; open towards the robot.
_GARAGE = (0.115, 0.060, 0.065)
_GARAGE_WALL = 0.006
_GARAGE_X = 0.10
_INTO_GARAGE = (0.0, 15.0, 28.0, 43.0)
_INTO_GARAGE_M = 0.22


@dataclass(frozen=True)
class _Layout:
    """Random parameters drawn from the seed: start and end positions in the plane, rotations, yaws at rest,
    and the frames at which objects start to move."""

    starts: Float[np.ndarray, "objects 2"]
    ends: Float[np.ndarray, "objects 2"]
    turns: Float[np.ndarray, "objects"]
    yaws: Float[np.ndarray, "objects"]
    begins: Float[np.ndarray, "objects"]


def tabletop(
    seed: int = 0,
    frames: int = 60,
    width: int = 320,
    height: int = 240,
    cameras: int = 3,
    *,
    still: bool = False,
    leave: bool = False,
    hide: bool = False,
    moving_cameras: bool = False,
) -> Sequence:
    """A robot arm and four objects on a table: RGB-D, labels, optical flow and exact poses, at 30 Hz.

    Labels are 0 scene, 1 robot, 2 carton (gripped, lifted, carried, put down), 3 can (slides and turns),
    4 ball (rolls), 5 block (never moves). Objects move up to 30 mm and 15 degrees per frame. A sequence of
    fewer frames is a prefix of the longer one; after frame 60 everything is at rest.

    Args:
        seed: seed of the positions, motions and patterns.
        frames: number of frames.
        width: pixels.
        height: pixels.
        cameras: number of cameras, on an arc in front of the table.
        still: nothing moves.
        leave: the can keeps sliding until it is out of all views.
        hide: the can slides into a garage, where no camera sees it around frame 20, and out again.
        moving_cameras: the cameras sway by 6 degrees around the table.

    Raises:
        ValueError: a count is below 1, or both `leave` and `hide` are set.
    """
    check_counts(frames=frames, width=width, height=height, cameras=cameras)
    if leave and hide:
        raise ValueError("leave and hide exclude each other: both move the can; set at most one")
    times = np.arange(frames) / RATE_HZ
    moments = np.zeros(frames) if still else np.arange(frames, dtype=np.float64)
    layout = _draw_layout(seed, leave, hide)
    viewmats = _viewmats(cameras, times if moving_cameras else np.zeros(frames))
    scene = _build_scene(seed, layout, moments, viewmats, width, height, leave, hide)
    named = {name: _FIRST_BODY + i for i, name in enumerate(NAMES)}
    return simulated_sequence(f"tabletop_seed{seed}", scene, times, named, robot=ROBOT_LABEL)


def _build_scene(
    seed: int,
    layout: _Layout,
    moments: Float[np.ndarray, "t"],
    viewmats: Float[np.ndarray, "t c 4 4"],
    width: int,
    height: int,
    leave: bool,
    hide: bool,
) -> Scene:
    objects, grasp, opening = _object_poses(moments, layout, leave, hide)
    world = np.broadcast_to(np.eye(4), (len(moments), 1, 4, 4))
    object_labels = [FIRST_OBJECT_LABEL + i for i in range(len(NAMES))]
    return Scene(
        primitives=(*_surroundings(layout, leave, hide), *robot_primitives(1), *_object_primitives(seed)),
        labels=np.array([0] + [ROBOT_LABEL] * ROBOT_BODIES + object_labels),
        poses=np.concatenate([world, robot_poses(grasp, opening), objects], axis=1),
        light=_LIGHT,
        Ks=np.broadcast_to(intrinsics(0.95 * width, width, height), (*viewmats.shape[:2], 3, 3)),
        viewmats=viewmats,
        width=width,
        height=height,
    )


def _draw_layout(seed: int, leave: bool, hide: bool) -> _Layout:
    """Draw layouts until no two objects collide, all stay on the table, and the standard cameras see all of
    them in the first frame."""
    rng = np.random.default_rng(seed)
    moments = np.arange(61.0)
    first_views = _viewmats(3, np.zeros(1))
    while True:
        layout = _propose_layout(rng, leave, hide)
        poses, _, _ = _object_poses(moments, layout, leave, hide)
        if not _is_clear(poses[:, :, :3, 3], leave, hide):
            continue
        preview = _build_scene(seed, layout, moments[:1], first_views, 80, 60, leave, hide)
        if all(_sees_all(preview, c) for c in range(3)):
            return layout


def _sees_all(preview: Scene, c: int) -> bool:
    """Whether each object covers at least 12 of 80x60 pixels, which is about 200 of 320x240."""
    counts = np.bincount(render_labels(preview, trace(preview, 0, c)).ravel(), minlength=6)
    return bool((counts[FIRST_OBJECT_LABEL:] >= 12).all())


def _propose_layout(rng: np.random.Generator, leave: bool, hide: bool) -> _Layout:
    count = len(NAMES)
    starts = rng.uniform([-0.22, -0.26], [0.24, 0.26], (count, 2))
    # These distances keep the can below 30 mm per frame and the ball below 15 degrees.
    distances = np.array([rng.uniform(0.22, 0.30), rng.uniform(0.20, 0.29), rng.uniform(0.14, 0.18), 0.0])
    angles = rng.uniform(0, 2 * np.pi, count)
    ends = starts + distances[:, None] * np.stack([np.cos(angles), np.sin(angles)], axis=1)
    turns = rng.uniform([0.6, 1.2, 0.0, 0.0], [1.5, 1.9, 0.0, 0.0]) * rng.choice([-1.0, 1.0], count)
    layout = _Layout(starts, ends, turns, rng.uniform(-0.5, 0.5, count), rng.uniform(1, 8, count))
    if leave:
        ends[1] = starts[1] + np.array([1.0, rng.uniform(-0.3, 0.3)])  # past the cameras
    if hide:
        starts[1] = [_GARAGE_X - _INTO_GARAGE_M, rng.choice([-1.0, 1.0]) * rng.uniform(0.12, 0.20)]
        ends[1] = starts[1] + np.array([_INTO_GARAGE_M, 0.0])
    return layout


def _is_clear(centers: Float[np.ndarray, "frames objects 3"], leave: bool, hide: bool) -> bool:
    stay = [0, 2, 3] if leave else [0, 1, 2, 3]
    on_table = (np.abs(centers[:, stay, :2]) < 0.30).all()
    reachable = (np.linalg.norm(centers[:, 0, :2] - [-0.50, 0.0], axis=-1) > 0.25).all()
    apart = True
    for i in range(len(NAMES)):
        for j in range(i):
            needed = _CLEARANCES[i] + _CLEARANCES[j]
            distance = np.linalg.norm(centers[:, i, :2] - centers[:, j, :2], axis=-1)
            above = centers[:, j, 2] > CARTON[2] + 0.14  # only the carton rises, above all others
            apart &= bool(((distance > needed) | above).all())
    if hide:  # nothing else, including the hand with the carton, comes near the garage
        garage = np.array([_GARAGE_X, centers[0, 1, 1]])
        others = centers[:, [0, 2, 3], :2] - garage
        apart &= bool((np.abs(others) > np.array(_GARAGE[:2]) + 0.09).any(-1).all())
    return bool(on_table and reachable and apart)


def _object_poses(
    moments: Float[np.ndarray, "t"], layout: _Layout, leave: bool, hide: bool
) -> tuple[Float[np.ndarray, "t objects 4 4"], Float[np.ndarray, "t 4 4"], Float[np.ndarray, "t"]]:
    """Poses of the objects and of the grasp, and the distance of each finger from the middle."""
    carton, grasp, opening = _carry(moments, layout)
    travel = layout.ends - layout.starts
    can_share = _can_progress(moments, layout.begins[1], leave, hide)
    ball_share = coast(moments, layout.begins[2], 50.0)
    shares = np.stack([np.zeros_like(moments), can_share, ball_share, np.zeros_like(moments)], axis=1)
    centers = np.zeros((len(moments), len(NAMES), 3))
    centers[:, :, :2] = layout.starts + shares[..., None] * travel
    centers[:, :, 2] = _HEIGHTS
    yaws = layout.yaws + np.minimum(shares, 1.0) * layout.turns
    poses = rigid(turn(_UP, yaws.ravel()), centers.reshape(-1, 3)).reshape(len(moments), len(NAMES), 4, 4)
    poses[:, 0] = carton
    distance = np.linalg.norm(travel[2])
    axis = np.array([-travel[2, 1], travel[2, 0], 0.0]) / distance
    roll = turn(axis, ball_share * distance / BALL)
    poses[:, 2] = rigid(roll * turn(_UP, layout.yaws[2]), centers[:, 2])
    return poses, grasp, opening


def _can_progress(moments: np.ndarray, begin: float, leave: bool, hide: bool) -> np.ndarray:
    """Fraction of the can's path that it has covered."""
    if leave:
        return 0.026 * np.maximum(moments - 2.0, 0.0)
    if hide:
        return along_keyframes(moments, _INTO_GARAGE, [[0.0], [1.0], [1.0], [0.0]])[:, 0]
    return coast(moments, begin, 20.0)


def _carry(moments: np.ndarray, layout: _Layout) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Poses of the carton and of the grasp near its top, and the fingers' opening; the hand rises after the
    release."""
    start, end = layout.starts[0], layout.ends[0]
    low, high = CARTON[2], CARTON[2] + _LIFT_M
    path = [[*start, low], [*start, high], [*end, high], [*end, low]]
    centers = along_keyframes(moments, _CARRY, path)
    yaw = (
        layout.yaws[0]
        + along_keyframes(moments, _CARRY, [[0], [0], [layout.turns[0]], [layout.turns[0]]])[:, 0]
    )
    tilt = along_keyframes(moments, (12.0, 26.0, 37.0), [[0.0], [0.35], [0.0]])[:, 0]
    carton = rigid(turn(_UP, yaw) * turn([0.0, 1.0, 0.0], tilt), centers)
    rise = along_keyframes(moments, (50.0, 60.0), [[0.0], [0.15]])[:, 0]
    grasp = carton @ rigid(None, np.stack([0 * rise, 0 * rise, CARTON[2] - 0.025 + rise], axis=1))
    closed, opened = CARTON[1], CARTON[1] + 0.022
    opening = along_keyframes(moments, (0.0, 4.0, 47.0, 51.0), [[opened], [closed], [closed], [opened]])[:, 0]
    return carton, grasp, opening


def _viewmats(cameras: int, times: np.ndarray) -> Float[np.ndarray, "t c 4 4"]:
    azimuths = np.deg2rad(np.linspace(-55, 55, cameras) if cameras > 1 else [-30.0])
    heights = np.deg2rad(np.where(np.arange(cameras) % 2 == 0, 36.0, 44.0))
    sway = np.deg2rad(6.0) * np.sin(2 * np.pi * times / 2.0)
    views = [[look_at(_eye(a + s, e), _TARGET) for a, e in zip(azimuths, heights, strict=True)] for s in sway]
    return np.array(views)


def _eye(azimuth: float, elevation: float) -> np.ndarray:
    flat = np.array([np.cos(azimuth), np.sin(azimuth)]) * np.cos(elevation)
    return _TARGET + 0.90 * np.array([*flat, np.sin(elevation)])


def _surroundings(layout: _Layout, leave: bool, hide: bool) -> list[Primitive]:
    """Floor, table and, if the can hides, the garage; all on body 0, the world. The table's top is z = 0."""
    floor = Texture("checker", ((0.46, 0.47, 0.49), (0.54, 0.55, 0.56)), 0.35, seed=1)
    wood = Texture("stripes", ((0.60, 0.43, 0.28), (0.72, 0.55, 0.38)), 0.035, seed=2, grain=0.18)
    length = 1.4 if leave else 0.62  # from the edge behind the robot
    table = Primitive("box", (length, 0.55, 0.02), wood, pose=rigid(None, [length - 0.72, 0.0, -0.02]))
    solids = [Primitive("plane", (), floor, pose=rigid(None, [0.0, 0.0, -0.65])), table]
    return solids + (_garage(layout.starts[1, 1]) if hide else [])


def _garage(y: float) -> list[Primitive]:
    card = Texture("noise", ((0.38, 0.47, 0.36), (0.52, 0.60, 0.46)), 0.08, seed=3)
    long, wide, high = _GARAGE
    wall = _GARAGE_WALL

    def part(size: tuple[float, float, float], x: float, dy: float, z: float) -> Primitive:
        return Primitive("box", size, card, pose=rigid(None, [_GARAGE_X + x, y + dy, z]))

    return [
        part((long, wide, wall), 0.0, 0.0, 2 * high),
        part((long, wall, high), 0.0, wide, high),
        part((long, wall, high), 0.0, -wide, high),
        part((wall, wide, high), long, 0.0, high),
    ]


def _object_primitives(seed: int) -> list[Primitive]:
    first = _FIRST_BODY
    s = 10 * seed
    carton = Texture("label", ((0.86, 0.24, 0.16), (0.97, 0.91, 0.72)), 0.075, seed=s + 4)
    can = Texture("label", ((0.16, 0.42, 0.72), (0.95, 0.96, 0.97)), 0.055, seed=s + 5)
    lid = Texture("noise", ((0.70, 0.71, 0.73), (0.86, 0.86, 0.87)), 0.05, seed=s + 6)
    ball = Texture("checker", ((0.95, 0.75, 0.12), (0.30, 0.16, 0.45)), 0.030, seed=s + 7)
    block = Texture("checker", ((0.24, 0.56, 0.32), (0.80, 0.86, 0.60)), 0.024, seed=s + 8)
    return [
        Primitive("box", CARTON, carton, first),
        Primitive("cylinder", (CAN[0], CAN[1] - 0.006), can, first + 1),
        Primitive("cylinder", (CAN[0] - 0.004, CAN[1]), lid, first + 1),
        Primitive("sphere", (BALL,), ball, first + 2),
        Primitive("box", BLOCK, block, first + 3),
    ]
