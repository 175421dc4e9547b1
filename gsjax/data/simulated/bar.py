"""An upright bar that twists and bends on a static base, and a block that slides past it."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from gsjax.data.sequence import Sequence
from gsjax.data.simulated.bent_box import BentBox
from gsjax.data.simulated.motion import along_keyframes, coast, rigid, turn
from gsjax.data.simulated.primitives import Primitive
from gsjax.data.simulated.raycaster import Light, Scene
from gsjax.data.simulated.simulation import check_counts, simulated_sequence, viewmats_around
from gsjax.data.simulated.textures import Texture
from gsjax.geometry.cameras import intrinsics

RATE_HZ = 15.0

_WORLD, _BAR, _BASE, _BLOCK = range(4)  # bodies; labels are the same numbers

# Half sizes, metres; the floor is z = 0, and the bar stands above the origin.
BAR = (0.050, 0.036, 0.250)
BASE = (0.085, 0.070, 0.030)
BLOCK = (0.050, 0.035, 0.060)
_BAR_Z = 2 * BASE[2] + BAR[2]
_TRACKS_M = 0.02  # approximate spacing

# Frames at which the twist starts, is largest, and has relaxed; and between which the bar bends.
_TWISTS = (0.0, 16.0, 28.0)
_BENDS = (3.0, 27.0)

_TARGET = np.array([0.0, 0.0, 0.25])
_LIGHT = Light(position=(1.1, 0.9, 1.9), radius=0.03)


@dataclass(frozen=True)
class _Motion:
    """Random parameters drawn from the seed: twist and bend of the bar, and the block's motion."""

    twist: float  # radians
    bend: float  # radians
    azimuth: float  # radians
    block_from: Float[np.ndarray, "2"]
    block_path: Float[np.ndarray, "2"]
    block_yaw: float
    block_turn: float


def bar(
    seed: int = 0,
    frames: int = 30,
    width: int = 320,
    height: int = 240,
    cameras: int = 8,
    *,
    still: bool = False,
) -> Sequence:
    """A bar that twists and bends, seen from all around: RGB-D, labels, optical flow, exact tracks; 15 Hz.

    Labels are 0 scene, 1 bar, 2 base (never moves), 3 block (slides and turns). The bar starts straight, with
    its foot fixed in the base. Its top twists by 70 to 110 degrees, either way, and untwists by three
    quarters of that; it bends by 45 to 70 degrees in any direction. See `BentBox` for the map. A sequence of
    fewer frames is a prefix of the longer one; after frame 28 everything is at rest.

    The truth has the poses of base and block. The bar has no pose: `tracks` follow points on its sides and
    its top.

    Args:
        seed: seed of the bar's twist and bend, the block's motion, and their patterns.
        frames: number of frames.
        width: pixels.
        height: pixels.
        cameras: number of cameras, in a circle around the bar, alternately lower and higher.
        still: nothing moves.

    Raises:
        ValueError: a count is below 1.
    """
    check_counts(frames=frames, width=width, height=height, cameras=cameras)
    moments = np.zeros(frames) if still else np.arange(frames, dtype=np.float64)
    motion = _draw_motion(seed)
    poses, sizes = _poses(motion, moments), _sizes(motion, moments)
    scene = Scene(
        primitives=_solids(seed),
        labels=np.arange(_BLOCK + 1),
        poses=poses,
        light=_LIGHT,
        Ks=np.broadcast_to(intrinsics(0.95 * width, width, height), (frames, cameras, 3, 3)),
        viewmats=np.broadcast_to(viewmats_around(_TARGET, 1.08, cameras, low=26.0), (frames, cameras, 4, 4)),
        width=width,
        height=height,
        sizes={_BAR: sizes},
    )
    rest = _surface_points()
    tracks = np.stack([BentBox(*size).deform(rest).T for size in sizes]) + poses[:, None, _BAR, :3, 3]
    objects, times = {"base": _BASE, "block": _BLOCK}, np.arange(frames) / RATE_HZ
    return simulated_sequence(f"bar_seed{seed}", scene, times, objects, tracks=tracks)


def _draw_motion(seed: int) -> _Motion:
    rng = np.random.default_rng(seed)
    azimuth, side = rng.uniform(-np.pi, np.pi), rng.choice([-1.0, 1.0])
    bearing = azimuth + side * rng.uniform(1.0, 2.1)  # the block slides where the bar does not hide it
    course = bearing + rng.choice([-1.0, 1.0]) * np.pi / 2  # past the base
    length = rng.uniform(0.20, 0.28)
    heading = np.array([np.cos(course), np.sin(course)])
    nearest = rng.uniform(0.18, 0.21) * np.array([np.cos(bearing), np.sin(bearing)])
    return _Motion(
        twist=rng.choice([-1.0, 1.0]) * np.deg2rad(rng.uniform(70, 110)),
        bend=np.deg2rad(rng.uniform(45, 70)),
        azimuth=azimuth,
        block_from=nearest - length / 2 * heading,
        block_path=length * heading,
        block_yaw=rng.uniform(-np.pi, np.pi),
        block_turn=rng.choice([-1.0, 1.0]) * rng.uniform(0.6, 1.2),
    )


def _poses(motion: _Motion, moments: Float[np.ndarray, "t"]) -> Float[np.ndarray, "t bodies 4 4"]:
    """Body-to-world transforms; the bar's is that of its centre at rest."""
    rest = np.array([[0.0, 0.0, 0.0], [0.0, 0.0, _BAR_Z], [0.0, 0.0, BASE[2]], [0.0, 0.0, BLOCK[2]]])
    poses = np.broadcast_to(rigid(None, rest), (len(moments), len(rest), 4, 4)).copy()
    share = coast(moments, 5.0, 20.0)
    poses[:, _BLOCK, :2, 3] = motion.block_from + share[:, None] * motion.block_path
    yaws = motion.block_yaw + share * motion.block_turn
    poses[:, _BLOCK, :3, :3] = turn((0.0, 0.0, 1.0), yaws).as_matrix()
    return poses


def _sizes(motion: _Motion, moments: Float[np.ndarray, "t"]) -> Float[np.ndarray, "t 6"]:
    """The parameters of the `BentBox` in each frame."""
    twists = along_keyframes(moments, _TWISTS, [[0.0], [motion.twist], [0.25 * motion.twist]])
    bends = along_keyframes(moments, _BENDS, [[0.0], [motion.bend]])
    same = np.broadcast_to(BAR, (len(moments), 3))
    return np.concatenate([same, twists, bends, np.full_like(bends, motion.azimuth)], axis=1)


def _surface_points() -> Float[np.ndarray, "3 n"]:
    """A grid of points on the sides and top of the bar at rest, in its own frame; none lies on an edge."""
    faces = [(axis, sign) for axis in (0, 1) for sign in (-1, 1)] + [(2, 1)]
    points = []
    for axis, sign in faces:
        u, v = (i for i in range(3) if i != axis)
        grid = np.meshgrid(_middles(BAR[u]), _middles(BAR[v]), indexing="ij")
        face = np.full((3, grid[0].size), sign * BAR[axis])
        face[u], face[v] = grid[0].ravel(), grid[1].ravel()
        points.append(face)
    return np.concatenate(points, axis=1)


def _middles(half: float) -> Float[np.ndarray, "n"]:
    """The midpoints of equal intervals from -half to half."""
    count = max(round(2 * half / _TRACKS_M), 1)
    return half * ((2 * np.arange(count) + 1) / count - 1)


def _solids(seed: int) -> tuple[Primitive, ...]:
    """One solid per body, in the order of the bodies."""
    s = 20 * seed
    floor = Texture("checker", ((0.44, 0.45, 0.47), (0.56, 0.57, 0.58)), 0.12, seed=1)
    skin = Texture("checker", ((0.42, 0.17, 0.42), (0.98, 0.80, 0.36)), 0.036, seed=s + 2, grain=0.6)
    steel = Texture("stripes", ((0.30, 0.33, 0.38), (0.48, 0.51, 0.55)), 0.03, seed=s + 3)
    print_ = Texture("label", ((0.14, 0.38, 0.62), (0.94, 0.95, 0.90)), 0.07, seed=s + 4)
    straight = (0.0, 0.0, 0.0)
    return (
        Primitive("plane", (), floor, _WORLD),
        Primitive("bent box", (*BAR, *straight), skin, _BAR),
        Primitive("box", BASE, steel, _BASE),
        Primitive("box", BLOCK, print_, _BLOCK),
    )
