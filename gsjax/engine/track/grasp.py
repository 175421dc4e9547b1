"""A run of `gsjax grasp`: the best antipodal grasp of an object named by a text, in every frame of a run."""

import math
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import Annotated

import cv2
import jax
import jax.numpy as jnp
import numpy as np
import tyro
from jaxtyping import Float
from rich.console import Console
from rich.progress import track

from gsjax.engine.folder import replaced_folder
from gsjax.engine.messages import Notes
from gsjax.engine.options import Seeded, checked
from gsjax.engine.pictures import frame_rate, spotlight
from gsjax.engine.recording import Recording
from gsjax.engine.track.query import Answer, ObjectQuery, ask, progress
from gsjax.engine.track.saved import SavedRun
from gsjax.engine.track.views import views
from gsjax.geometry.cameras import project
from gsjax.geometry.rotations import quats_to_matrices
from gsjax.io.atomic import write_npz
from gsjax.io.pictures import write_png
from gsjax.io.video import VideoWriter
from gsjax.methods.grasping import Grasp, Gripper, best_grasp
from gsjax.optim.compiler import host_options
from gsjax.scene.origin import in_world
from gsjax.viz.colors import captioned, label_color

_WRITTEN = ("grasps.npz", "video.mp4", "frame_*.png")
NO_GRASP = 3  # exit code: no frame has a feasible grasp
_FEASIBLE, _INFEASIBLE = (84, 222, 130), (235, 110, 90)


@dataclass(frozen=True)
class Options(Seeded, ObjectQuery):
    """Options of `gsjax grasp`."""

    ignore: Annotated[tuple[str, ...], tyro.conf.arg(metavar="NAME [NAME ...]")] = ("robot",)
    """Objects that are not obstacles, such as the grasping arm; names that the run does not have are ignored
    by default. Without a name, all objects are obstacles."""
    approach: tuple[float, float, float] | None = None
    """Direction of approach in the world: 0 0 -1 is from above if z is up; default: any."""
    max_angle: float = 0.5
    """Largest angle to the direction of approach, radians."""
    samples: int = 512
    """Number of grasps tried in each frame. They move with the object, so every frame tries the same ones."""
    gripper: Gripper = field(default_factory=Gripper)
    """The gripper, in metres; default: a Franka Panda's hand."""

    def __post_init__(self):
        if self.approach is not None and not 0 < math.hypot(*self.approach) < math.inf:
            words = " ".join(f"{x:g}" for x in self.approach)
            raise ValueError(f"--approach: expected a direction, such as 0 0 -1, found {words}")


def run(options: Options) -> int:
    """Find the grasps, and write grasp/ into the run folder; returns the exit code.

    Raises:
        ValueError, OSError: there is no such run or encoder, or no object matches the text.
    """
    options = checked(options)
    console = Console(stderr=True, highlight=False)
    with Notes(console) as notes:
        saved, answer = ask(options, console, notes)
        recording = saved.seen_by(options.camera)
        folder = saved.path / "grasp"
        with replaced_folder(folder, _WRITTEN) as new:
            grasps = find_grasps(options, saved, answer, console)
            _write(new, grasps, options.gripper, saved, answer, recording, console)
    return _report(grasps, answer, folder)


def _write(
    folder: Path,
    grasps: Grasp,
    gripper: Gripper,
    saved: SavedRun,
    answer: Answer,
    recording: Recording,
    console: Console,
) -> None:
    """Write grasps.npz, the video and one of its frames."""
    times = recording.tracked.times[: saved.tracking.num_frames]
    poses = np.array(grasps.pose, np.float64)
    poses[..., :3, 3] = in_world(poses[..., :3, 3], recording.tracked.origin)
    arrays = {"poses": poses, "widths": grasps.width, "scores": grasps.score}
    write_npz(folder / "grasps.npz", {"times": times, **arrays, "feasible": grasps.feasible})
    middle = saved.tracking.num_frames // 2
    with VideoWriter(folder / "video.mp4", frame_rate(times)) as video:
        for view in progress(views(saved.tracking, recording), saved, console):
            picture = spotlight(view.image, view.groups == answer.group, label_color(answer.group))
            camera = recording.tracked.viewmats[view.t, 0], recording.tracked.Ks[view.t, 0]
            now = jax.tree.map(lambda a, t=view.t: a[t], grasps)
            zoom = picture.shape[1] / view.groups.shape[1]
            picture = draw_grasp(picture, now, gripper, *camera, zoom)
            video.write(picture)
            if view.t == middle:
                write_png(folder / f"frame_{recording.tracked.frame_ids[view.t]:06d}.png", picture)


def find_grasps(options: Options, saved: SavedRun, answer: Answer, console: Console) -> Grasp:
    """The best grasp of each frame, stacked, on the host; none is feasible while the object is lost.

    Args:
        options: gripper, samples and direction of approach.
        saved: the run.
        answer: the object.
        console: shows the progress.

    Raises:
        ValueError: the object's Gaussians have no normals.
    """
    scene, means = saved.tracking.scene, saved.tracking.means()
    points = means[:, answer.rows]
    obstacles = means[:, _obstacle_rows(options, saved, answer, means)]
    turns = quats_to_matrices(jnp.asarray(saved.tracking.quats()[:, answer.rows]))
    normals = np.asarray(jnp.einsum("tnij,nj->tni", turns, scene.normals[answer.rows]))
    if not normals.any():
        raise ValueError(
            f"{saved.path}: expected normals of {answer.name}, found none: a run from known shapes has none, "
            "and a grasp needs two sides that face away from each other. Track it from depth images"
        )
    approach = None if options.approach is None else jnp.asarray(options.approach, float)
    how = {"samples": options.samples, "approach": approach, "max_angle": options.max_angle}
    best = jax.jit(partial(best_grasp, gripper=options.gripper, **how), compiler_options=host_options())
    key = jax.random.key(options.seed or 0)
    there, others = np.ones(points.shape[1], bool), np.ones(obstacles.shape[1], bool)
    frames = track(range(len(means)), "grasping", console=console, transient=True)
    found = [jax.device_get(best(key, points[t], normals[t], there, obstacles[t], others)) for t in frames]
    grasps = jax.tree.map(lambda *leaves: np.stack(leaves), *found)
    lost = [False, *(bool(flags[answer.group - 1]) for flags in saved.tracking.lost)]
    return grasps._replace(feasible=grasps.feasible & ~np.array(lost))


def _obstacle_rows(options: Options, saved: SavedRun, answer: Answer, means: np.ndarray) -> np.ndarray:
    """The Gaussians that a gripper near the object could hit.

    Raises:
        ValueError: an object to ignore is not in the run.
    """
    groups = {name: group for group, name in saved.names.items()}
    unknown = [name for name in options.ignore if name not in groups]
    if unknown and options.ignore != Options.ignore:
        raise ValueError(f"--ignore: {saved.path} has no object {unknown[0]!r}; it has {', '.join(groups)}")
    labels = np.asarray(saved.tracking.scene.labels)
    passed = [groups[name] for name in options.ignore if name in groups]
    chosen = ~np.isin(labels, [answer.group, *passed])
    own, hand = means[:, answer.rows], options.gripper
    centers = own.mean(axis=1, keepdims=True)
    width = max(hand.palm_width, hand.max_width + 2 * hand.finger_thickness)
    depth = max(hand.palm_depth, hand.finger_depth)
    extent = math.hypot(hand.finger_height + hand.palm_height + hand.tip, width / 2, depth / 2)
    # The hand lies within `extent` of the tool's origin, and that within `extent` of the object.
    reach = np.linalg.norm(own - centers, axis=-1).max() + 2 * extent
    near = (np.linalg.norm(means - centers, axis=-1) < reach).any(axis=0)
    solid = np.asarray(saved.tracking.scene.gaussians.opacities) > 0.5
    return np.flatnonzero(chosen & near & solid)


def draw_grasp(
    picture: np.ndarray,
    grasp: Grasp,
    gripper: Gripper,
    viewmat: Float[np.ndarray, "4 4"],
    K: Float[np.ndarray, "3 3"],
    zoom: float = 1.0,
) -> np.ndarray:
    """The picture with the closed gripper drawn in: fingers, palm and wrist; green if the grasp is feasible.

    Args:
        picture: [H,W,3], uint8.
        grasp: one grasp, in the world.
        gripper: its dimensions.
        viewmat, K: of the camera, for the picture before it was enlarged.
        zoom: factor by which it was enlarged.
    """
    half, back = float(grasp.width) / 2, gripper.tip - gripper.finger_height
    wrist = back - gripper.palm_height
    corners = [(0, 0, wrist), (0, 0, back), (0, -half, gripper.tip), (0, -half, back), (0, half, back)]
    corners += [(0, half, gripper.tip), (0, -half, 0), (0, half, 0)]
    color = _FEASIBLE if grasp.feasible else _INFEASIBLE
    words = f"score {grasp.score:.2f}   {1e3 * grasp.width:.0f} mm" if grasp.feasible else "no feasible grasp"
    picture = captioned(picture, words)
    pixels, depths = project(
        jnp.asarray(np.array(corners, float) @ grasp.pose[:3, :3].T + grasp.pose[:3, 3], float),
        jnp.asarray(viewmat, float),
        jnp.asarray(K, float),
    )
    if not (np.asarray(depths) > 1e-3).all():  # behind the camera, or not finite
        return picture
    # In 1/16 pixels; OpenCV has pixel centres at integers.
    points = np.round(16 * (zoom * np.asarray(pixels) - 0.5)).astype(np.int32)
    lines, pads, thick = [points[:2], points[2:6]], points[6:], max(2, round(picture.shape[0] / 160))
    for shade, width in (((20, 22, 26), 2 * thick), (color, thick)):
        picture = cv2.polylines(picture, lines, False, shade, width, cv2.LINE_AA, shift=4)
    for pad in pads:
        picture = cv2.circle(picture, pad.tolist(), 24 * thick, (255, 255, 255), -1, cv2.LINE_AA, shift=4)
    return picture


def _report(grasps: Grasp, answer: Answer, folder: Path) -> int:
    """Print the result; returns the exit code."""
    feasible = grasps.feasible
    if not feasible.any():
        print(
            f"{answer.name}: no feasible grasp in any of {len(feasible)} frames; the narrowest of the best "
            f"is {1e3 * grasps.width.min():.0f} mm wide, and its score is {grasps.score.max():.2f} at best. "
            "More --samples, a wider --gripper.max-width or another --approach may help"
        )
    else:
        widths = 1e3 * grasps.width[feasible]
        low, high = round(widths.min()), round(widths.max())
        print(
            f"{answer.name}: a feasible grasp in {feasible.sum()} of {len(feasible)} frames, "
            f"mean score {grasps.score[feasible].mean():.2f}, "
            f"{low if low == high else f'{low} to {high}'} mm wide"
        )
    print(f"grasp   {folder}")
    return 0 if feasible.any() else NO_GRASP
