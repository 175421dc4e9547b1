"""A sheet of tissue that breathes and is pulled by a tool, seen by a stereo endoscope that hardly moves."""

from dataclasses import dataclass
from typing import get_args

import numpy as np
from jaxtyping import Float

from gsjax.data.sequence import Sequence
from gsjax.data.simulated.motion import along_keyframes, rigid, turn
from gsjax.data.simulated.primitives import Primitive
from gsjax.data.simulated.raycaster import Light, Scene
from gsjax.data.simulated.sheet import Sheet
from gsjax.data.simulated.simulation import check_counts, simulated_sequence
from gsjax.data.simulated.textures import Pattern, Texture
from gsjax.geometry.cameras import intrinsics, look_at

RATE_HZ = 15.0
BASELINE_M = 0.0045

_TISSUE, _TOOL = range(2)  # bodies; labels are the same numbers

_BREATH_FRAMES, _SWAY_FRAMES = 30.0, 40.0
# Frames at which the tool touches, has pulled farthest, stops holding, has released, and is away.
_TOUCH, _PULLED, _HOLD, _RELEASE, _AWAY = 3.0, 14.0, 17.0, 27.0, 33.0
_COMES_FROM_M, _GOES_TO_M = 0.010, 0.030

# Metres: the endoscope's target and position, and the grid of tracked points.
_TARGET, _EYE = np.array([0.002, 0.0, 0.004]), np.array([-0.006, -0.022, 0.105])
_LAMP = np.array([0.006, 0.008, 0.0])  # relative to the lens
_SWAY = 0.003
_TRACKED, _TRACKS_M = 0.056, 0.004

# The tool: a shaft, a wrist, and two jaws. Its origin is the tip, and z points along the shaft, away from it.
_SHAFT, _WRIST, _JAW = (0.0040, 0.060), 0.0042, (0.0011, 0.0022, 0.0060)
_JAWS_OPEN = 0.14  # radians, each
_PRESSED_M = 0.0012


@dataclass(frozen=True)
class _Motion:
    """Random parameters drawn from the seed."""

    relief: Float[np.ndarray, "2 6"]  # bumps of the sheet, see `Sheet`
    breath: Float[np.ndarray, "6"]
    pull: Float[np.ndarray, "6"]
    shaft: Float[np.ndarray, "3"]  # direction from which the shaft comes


def tissue(
    seed: int = 0,
    frames: int = 40,
    width: int = 320,
    height: int = 256,
    *,
    still: bool = False,
    pull: float = 1.0,
    pattern: Pattern = "vessels",
) -> Sequence:
    """Tissue that breathes and is pulled by a tool: stereo RGB-D, masks, flow, exact tracks; 15 Hz.

    Labels are 0 tissue and 1 tool. Camera 0 is the left eye and camera 1 the right one, 4.5 mm beside it;
    both sway by some millimetres, 0.1 m above the tissue. Breathing lifts the tissue by 3 mm every 2 s. The
    tool touches it in frame 3, has pulled it by 14 to 18 mm in frame 14, releases it between frames 17 and 27
    and leaves. A sequence of fewer frames is a prefix of the longer one.

    The truth has the poses of the tool. `tracks` follow 841 points of the tissue, 4 mm apart at rest, whether
    or not the tool occludes them. The lamp is beside the lens. All surfaces are Lambertian: the appearance of
    a point does not depend on the viewpoint.

    Args:
        seed: seed of the relief, the pull, the direction of the tool, and the patterns.
        frames: number of frames.
        width: pixels.
        height: pixels.
        still: nothing moves.
        pull: how far the tool pulls, relative to the above; 0 to 3.
        pattern: what the tissue looks like.

    Raises:
        ValueError: a count is below 1, the pull is not 0 to 3, or there is no such pattern.
    """
    check_counts(frames=frames, width=width, height=height)
    if not 0 <= pull <= 3:
        raise ValueError(f"pull: expected 0 to 3, found {pull}")
    if pattern not in get_args(Pattern):
        raise ValueError(f"pattern: expected one of {', '.join(get_args(Pattern))}, found {pattern!r}")
    moments = np.zeros(frames) if still else np.arange(frames, dtype=np.float64)
    motion = _draw_motion(seed, pull)
    bumps = _bumps(motion, moments)
    poses = np.stack(
        [np.broadcast_to(np.eye(4), (frames, 4, 4)), _tool_poses(motion, moments, bumps)], axis=1
    )
    scene = Scene(
        primitives=_solids(seed, pattern),
        labels=np.array([_TISSUE, _TOOL]),
        poses=poses,
        light=Light(
            position=tuple(_EYE + _LAMP),
            radius=0.002,
            color=(0.96, 0.93, 0.88),
            ambient=(0.10, 0.09, 0.09),
        ),
        Ks=np.broadcast_to(intrinsics(0.86 * width, width, height), (frames, 2, 3, 3)),
        viewmats=_viewmats(moments),
        width=width,
        height=height,
        sizes={_TISSUE: bumps},
    )
    tracks = np.stack([Sheet(tuple(now)).deform(_grid()).T for now in bumps])
    times = np.arange(frames) / RATE_HZ
    return simulated_sequence(f"tissue_seed{seed}", scene, times, {"tool": _TOOL}, tracks=tracks)


def _draw_motion(seed: int, pull: float) -> _Motion:
    rng = np.random.default_rng(seed)
    side = rng.choice([-1.0, 1.0])
    hill, hollow = rng.uniform(-0.030, 0.030, 2), rng.uniform(-0.035, 0.035, 2)
    azimuth = rng.uniform(0.15, 0.85)
    toward = np.array([side * np.cos(azimuth), np.sin(azimuth), 0.0])
    grasped = rng.uniform([-0.010, -0.010], [0.010, 0.006])
    length = pull * rng.uniform(0.014, 0.018)
    return _Motion(
        relief=np.array([[*hill, 0.030, 0.0, 0.0, 0.010], [*hollow, 0.026, 0.0, 0.0, -0.007]]),
        breath=np.array([*hill, 0.045, 0.0006, 0.0010, 0.003]),
        pull=np.array([*grasped, 0.019, *(length * (0.3 * toward + [0, 0, 1]))]),
        shaft=(0.62 * toward + [0.0, 0.0, 0.8]) / np.hypot(0.62, 0.8),
    )


def _bumps(motion: _Motion, moments: Float[np.ndarray, "t"]) -> Float[np.ndarray, "t 24"]:
    """The bumps of the sheet in each frame."""
    breath = 0.5 - 0.5 * np.cos(2 * np.pi * moments / _BREATH_FRAMES)
    pulled = along_keyframes(moments, (_TOUCH, _PULLED, _HOLD, _RELEASE), [[0.0], [1.0], [1.0], [0.0]])
    bumps = np.broadcast_to(
        np.stack([*motion.relief, motion.breath, motion.pull]), (len(moments), 4, 6)
    ).copy()
    bumps[:, 2, 3:] *= breath[:, None]
    bumps[:, 3, 3:] *= pulled
    return bumps.reshape(len(moments), -1)


def _tool_poses(
    motion: _Motion, moments: Float[np.ndarray, "t"], bumps: Float[np.ndarray, "t 24"]
) -> Float[np.ndarray, "t 4 4"]:
    """Poses of the tool: the tip follows the pulled tissue; before and after that it is retracted along the
    shaft."""
    grasped = np.array([[*motion.pull[:2], 0.0]]).T
    held = np.stack([Sheet(tuple(now)).deform(grasped)[:, 0] for now in bumps])
    away = along_keyframes(
        moments, (0.0, _TOUCH, _RELEASE, _AWAY), [[_COMES_FROM_M], [0.0], [0.0], [_GOES_TO_M]]
    )
    z = motion.shaft
    x = np.cross([0.0, 0.0, 1.0], z)
    x /= np.linalg.norm(x)
    poses = rigid(None, held + (away - _PRESSED_M) * z)
    poses[:, :3, :3] = np.stack([x, np.cross(z, x), z], axis=1)
    return poses


def _viewmats(moments: Float[np.ndarray, "t"]) -> Float[np.ndarray, "t 2 4 4"]:
    """View matrices of the left and the right eye, which have the same orientation."""
    phase = 2 * np.pi * moments / _SWAY_FRAMES
    sway = np.stack([np.sin(phase), np.cos(phase) - 1, 0.5 * np.sin(2 * phase)], axis=1)
    left = np.array([look_at(_EYE + _SWAY * offset, _TARGET, np.array([0.0, 1.0, 0.0])) for offset in sway])
    right = left.copy()
    right[:, 0, 3] -= BASELINE_M
    return np.stack([left, right], axis=1)


def _grid() -> Float[np.ndarray, "3 n"]:
    line = np.arange(-_TRACKED, _TRACKED + _TRACKS_M / 2, _TRACKS_M)
    x, y = np.meshgrid(line, line, indexing="ij")
    return np.stack([x.ravel(), y.ravel(), np.zeros(x.size)])


def _solids(seed: int, pattern: Pattern) -> tuple[Primitive, ...]:
    """The tissue, then the parts of the tool."""
    s = 20 * seed
    flesh = Texture(pattern, ((0.90, 0.62, 0.60), (0.50, 0.12, 0.17)), 0.030, seed=s + 1, grain=0.35)
    steel = Texture("stripes", ((0.34, 0.36, 0.40), (0.55, 0.58, 0.62)), 0.006, seed=s + 2)
    bright = Texture("noise", ((0.70, 0.72, 0.76), (0.86, 0.87, 0.90)), 0.004, seed=s + 3)
    wrist = 2 * _JAW[2]
    jaws = [
        rigid(turn((0.0, 1.0, 0.0), side * _JAWS_OPEN), [side * 0.0016, 0.0, _JAW[2]]) for side in (-1.0, 1.0)
    ]
    still = (0.0, 0.0, 1.0, 0.0, 0.0, 0.0)
    return (
        Primitive("sheet", 4 * still, flesh, _TISSUE),
        Primitive("cylinder", _SHAFT, steel, _TOOL, rigid(None, [0.0, 0.0, wrist + _SHAFT[1]])),
        Primitive("sphere", (_WRIST,), bright, _TOOL, rigid(None, [0.0, 0.0, wrist])),
        *(Primitive("box", _JAW, bright, _TOOL, jaw) for jaw in jaws),
    )
