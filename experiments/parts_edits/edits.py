"""Does each edit move what it should and leave every other pixel unchanged, and at what frame rate?"""

from dataclasses import replace
from pathlib import Path
from time import perf_counter
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from experiments.shared.discoveries import Options, canonical_of, run_parts
from experiments.shared.recordings import recorded
from gsjax.engine.folder import is_finished
from gsjax.engine.parts.saved import PartsRun, open_parts_run, read_parts
from gsjax.geometry.cameras import Camera
from gsjax.io.video import VideoWriter
from gsjax.methods.parts import Moment, gaussians_at, moment
from gsjax.methods.parts.film import Film, film_gaussians
from gsjax.methods.parts.limits import beyond_captured
from gsjax.methods.parts.timeline import Script, apply, parse_op
from gsjax.metrics.edit_judge import (
    Finding,
    place_is_clean,
    requested_displacement,
    requested_motion_is_seen,
    rest_stays,
)
from gsjax.optim.compiler import host_options
from gsjax.scene.handles import rigid_motions
from gsjax.scene.render import plan_render, render, render_with_room

HELD_OUT, ANCHOR = (3, 8), 0
EDITS = {
    "isolate": "isolate:parts=laptop_lid",
    "freeze": "freeze:parts=laptop_lid,at=0.5",
    "speed": "speed:parts=drawer,factor=2",
    "loop": "loop:parts=laptop_lid,from=0.3,to=0.7,times=2,bounce=true",
    "ghost": "ghost:parts=[drawer, laptop_lid],opacity=0.1",
    "fade": "fade:parts=box",
    "echo": "echo:parts=drawer,copies=3,every=0.1",
    "composite": "composite:parts=box,from_run={run},place={{scale: 0.7, to: [0.0, 0.0, 0.25]}}",
    "scale": "scale:parts=box,factor=0.5",
    "move": "move:parts=box,by=[0, 0, 0.15]",
    "rotate": "rotate:parts=box,axis=[0, 0, 1],degrees=45",
    "redirect": "redirect:parts=drawer,axis=[0, 0, 1],degrees=30",
    "amplify": "amplify:parts=laptop_lid,factor=1.3",
}


class Seen(NamedTuple):
    """A film from one camera: colours, depth and alpha of each frame, the pixels of edited parts, and the
    rate."""

    colors: np.ndarray
    depths: np.ndarray
    alphas: np.ndarray
    edited: np.ndarray
    hz: float


def run(options: dict[str, Any], seed: int, folder: Path) -> dict[str, Any]:
    """One edit of the parts discovered in articulated_0, rendered in the camera that shows most of the parts
    that it names."""
    saved = open_parts_run(_discovered(folder))
    before_film, film, concerned, named = films(saved, options["edit"])
    camera = camera_of(saved, named)
    before, after = (seen(one, camera, concerned, saved) for one in (before_film, film))
    with VideoWriter(folder / "before_after.mp4", 15.0) as video:
        for pair in zip(before.colors, after.colors, strict=True):
            video.write(np.concatenate(pair, axis=1))
    moves = _as_requested(before, after, before_film, film, camera, concerned)
    vacated = before.edited & ~after.edited
    # Compared with itself: the true background is unknown, so holes count and ghosts cannot.
    clean = place_is_clean(after.colors, after.alphas, after.colors, vacated)
    beyond = beyond_captured(saved.layer, film[0].trajectory)
    touched, apart = before.edited | after.edited, np.abs(after.colors - before.colors).max(-1)
    return {
        "rest": rest_stays(before.colors, after.colors, touched, tolerance=0.0).score,
        "rest_most": float(apart[~touched].max(initial=0.0)),
        "touched": float(touched.mean()),
        "changed": float((apart > 0.04).mean()),
        "moves": moves.score,
        "clean": clean.score,
        "pixels": moves.reason,
        "beyond_mm": 1000 * float(beyond.metres.max()),
        "hz": after.hz,
        "hz_over_before": after.hz / before.hz,
        "gaussians": sum(layer.scene.gaussians.num for layer in film),
    }


def films(saved: PartsRun, name: str) -> tuple[Film, Film, list[int], list[int]]:
    """The film before an edit, the film after it of the same length, the parts that it concerns and changes
    (isolating one freezes all others, but static parts do not change), and the parts that it names."""
    edit = parse_op(EDITS[name].format(run=saved.path))
    trajectory = saved.layer.trajectory
    length = float(trajectory.times[-1] - trajectory.times[0] + trajectory.times[1] - trajectory.times[0])
    before = apply(Script(length=length), saved.layer, saved.names)
    after = apply(Script(edits=(edit,), length=length), saved.layer, saved.names, read_parts)
    parts = [saved.names[part] if isinstance(part, str) else part for part in edit.parts]
    shown = [replace(film[0].trajectory, times=None) for film in (before, after)]
    pairs = list(zip(*map(jax.tree.leaves, shown), strict=True))
    ends = [float(trajectory.times[-1] - trajectory.times[0])] * trajectory.num_parts
    concerned = [
        part
        for part in edit.affected(trajectory, parts, ends)
        if any((a[:, part] != b[:, part]).any() for a, b in pairs)
    ]
    return before, after, concerned, parts


def camera_of(saved: PartsRun, parts: list[int]) -> Camera:
    """The camera in which most pixels show these parts halfway through their motion."""
    judged, layer = saved.recording.judged, saved.layer
    marks = jnp.isin(layer.scene.labels, jnp.array(parts)).astype(jnp.float32)[:, None]
    now = moment(layer.trajectory, len(layer.trajectory.times) // 2)
    gaussians = gaussians_at(layer.scene, now, saved.blend)
    cameras = [jax.tree.map(lambda a: a[None], judged.camera(0, c)) for c in range(judged.num_cameras)]
    drawn = [render(gaussians, camera, plan_render(gaussians, camera), features=marks) for camera in cameras]
    return cameras[int(np.argmax([np.asarray(each.features).sum() for each in drawn]))]


def seen(film: Film, camera: Camera, concerned: list[int], saved: PartsRun) -> Seen:
    """A film from one camera. Pixels count as edited where the concerned parts, or another layer, have any
    share."""
    of = [layer.scene.weights[:, jnp.array(concerned, int)].max(-1, initial=0) > 0 for layer in film[:1]]
    of += [jnp.ones(layer.scene.gaussians.num, bool) for layer in film[1:]]
    marks = jnp.concatenate(of).astype(jnp.float32)[:, None]
    placed = jax.jit(film_gaussians, static_argnames="blend", compiler_options=host_options())
    plan, found, seconds = None, [], []
    for t in range(len(film[0].trajectory.times)):
        begun, was = perf_counter(), plan
        gaussians = placed(film, jnp.asarray(t), blend=saved.blend)
        drawn, plan = render_with_room(gaussians, camera, plan)
        jax.block_until_ready(drawn.colors)
        if plan is was:
            seconds.append(perf_counter() - begun)
        marked = render(gaussians, camera, plan, features=marks)
        assert marked.features is not None
        edited = marked.features[..., 0] > 0
        found.append(
            [np.asarray(a[0]) for a in (drawn.colors.clip(0, 1), drawn.depths, drawn.alphas, edited)]
        )
    return Seen(*map(np.stack, zip(*found, strict=True)), 1 / float(np.median(seconds)))


def _as_requested(
    before: Seen, after: Seen, before_film: Film, film: Film, camera: Camera, concerned: list[int]
) -> Finding:
    """Whether parts that the edit moved are seen where it should have put them."""
    requested = np.full((*before.edited.shape, 2), np.nan)
    scene, viewmat, K = before_film[0].scene, np.asarray(camera.viewmat[0]), np.asarray(camera.K[0])
    labels = np.eye(scene.num_parts, dtype=np.float32)[np.asarray(scene.labels)]
    for t in range(len(requested)):
        was, now = (moment(one[0].trajectory, t) for one in (before_film, film))
        plan = plan_render(gaussians := gaussians_at(scene, was), camera)
        shown = np.asarray(render(gaussians, camera, plan, features=jnp.asarray(labels)).features)[0]
        for part in concerned:
            if float(now.opacities[part]) < 1 or float(now.scales[part]) != 1:
                continue  # its former place does not determine how it should look
            first, second = (_rigid(scene.centers[part], at, part) for at in (was, now))
            motion = second @ np.linalg.inv(first)
            if np.abs(motion - np.eye(4)).max() > 1e-6:
                mine = shown[..., part] > 0.9
                shift = requested_displacement(before.depths[t], after.depths[t], mine, motion, viewmat, K)
                requested[t] = np.where(np.isfinite(shift), shift, requested[t])
    return requested_motion_is_seen(before.colors, after.colors, requested)


def _rigid(center: Any, at: Moment, part: int) -> np.ndarray:
    """The motion of a part from the canonical scene to a moment."""
    rotations, offsets = rigid_motions(center[None], jax.tree.map(lambda a: a[part : part + 1], at.pose))
    motion = np.eye(4)
    motion[:3, :3], motion[:3, 3] = rotations[0], offsets[0]
    return motion


def _discovered(folder: Path) -> Path:
    """A run of `gsjax parts`, made once for all edits."""
    path = folder.parent / "discovered"
    if not is_finished(path):
        options = Options(str(recorded("articulated_0")), path, eval_cameras=HELD_OUT, anchor=ANCHOR)
        run_parts(replace(options, overwrite=True, scene=canonical_of(options, folder)))
    return path


def figure(rows: list[dict[str, Any]], path: Path) -> None:
    """Share of unchanged pixels, share of requested motion seen, and frame rate: a bar for each edit."""
    from matplotlib.figure import Figure

    panels = (
        ("rest", "the rest, the same to the bit"),
        ("moves", "parts that are where they were asked to be"),
        ("hz", "frames a second"),
    )
    drawing = Figure(figsize=(13, 1.0 + 0.32 * len(rows)), dpi=100, layout="constrained")
    names = [row["edit"] for row in rows]
    for axes, (key, title) in zip(drawing.subplots(1, len(panels), sharey=True), panels, strict=True):
        bars = axes.barh(names, [row[key] or 0.0 for row in rows], color="#4c8cc4")
        axes.bar_label(bars, ["–" if row[key] is None else f"{row[key]:.3g}" for row in rows], padding=3)
        axes.set(title=title)
        axes.margins(x=0.2)
    drawing.axes[0].invert_yaxis()
    drawing.savefig(path, format=path.suffix.removeprefix(".") or "png")
