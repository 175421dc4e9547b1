"""Films of an edited run of `gsjax parts`, and their folders."""

import re
import shutil
from collections.abc import Callable, Iterable, Iterator
from contextlib import suppress
from dataclasses import replace
from functools import cache, partial
from itertools import chain, count
from pathlib import Path
from time import perf_counter
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from gsjax.engine.ending import completion
from gsjax.engine.files import write_scene
from gsjax.engine.folder import SCRIPT, is_run, read_values
from gsjax.engine.machine import describe as describe_machine
from gsjax.engine.messages import Notes, counted, reason
from gsjax.engine.parts.saved import PartsRun, read_parts_about
from gsjax.geometry.cameras import Camera, resized
from gsjax.io.atomic import atomic_write, write_json
from gsjax.io.parsed import parse_json
from gsjax.io.video import VideoWriter
from gsjax.methods.parts.entries import relative
from gsjax.methods.parts.film import Film, Layer, film_gaussians
from gsjax.methods.parts.limits import Beyond, beyond_captured, describe_beyond
from gsjax.methods.parts.operation import Edit
from gsjax.methods.parts.operations import Composite, label
from gsjax.methods.parts.timeline import LENGTHS, ROUND, LoadScene, Script, apply, parse_script, to_yaml
from gsjax.methods.parts.trajectory import Trajectory
from gsjax.optim.compiler import host_options
from gsjax.scene.gaussians import Gaussians, take
from gsjax.scene.handles import Blend
from gsjax.scene.render import render_with_room

VIDEO = "video.mp4"
"""The video, in the folder of a film."""
_METRICS, _PLY = "metrics.json", "ply"
_THUMBNAIL, _COMPARED = 160, 5  # pixels, and number of moments, for comparing cameras
_CHANGED = 0.05  # smallest difference of colours, 0 to 1, that counts as a change
_NAME = re.compile(r"\w[\w .-]*")  # a folder name that cannot lead out of its parent


class Shot(NamedTuple):
    """A frame of a film.

    Attributes:
        image: the rendered frame.
        gaussians: the Gaussians in it.
        seconds: time to place and render them; None if something was compiled.
    """

    image: Float[np.ndarray, "height width 3"]
    gaussians: Gaussians
    seconds: float | None


Watch = Callable[[Iterable[Shot], int], Iterable[Shot]]
"""(frames of a film, their number) -> the same frames; a KeyboardInterrupt ends the film."""


def edited(script: Script, saved: PartsRun) -> tuple[Film, list[str]]:
    """The film of an edited run, and warnings about it, a sentence each. Points in the script are in the
    coordinates of the data.

    Raises:
        ValueError, OSError: a part or another run does not exist, or the edits cannot be applied.
    """
    origin = saved.recording.judged.origin
    script = relative(script, origin)
    known = cache(partial(read_parts_about, origin=origin))  # each other run is read once
    film = apply(script, saved.layer, saved.names, known)
    recorded, now = saved.layer, film[0].trajectory
    doubts = []
    if not saved.complete:
        frames = len(recorded.trajectory.times)
        doubts.append(f"{saved.path} is a partial run: only {frames} of its frames are there")
    beyond = describe_beyond(_beyond(recorded, now), now.times, saved.names)
    if beyond:  # as one warning: two that differ only in numbers would be taken for repetitions
        doubts.append(". ".join(beyond))
    if idle := _without_effect(script, film, saved, known):
        doubts.append(f"no visible effect: {', '.join(idle)}")
    return film, doubts


def most_changed_camera(film: Film, saved: PartsRun, script: Script) -> int:
    """The id of the camera in which the film differs most from the unedited recording.

    Args:
        film: the edited film.
        saved: the run.
        script: the edits.
    """
    plain = apply(replace(script, edits=(), length=_length_of(script, film, saved)), saved.layer, saved.names)
    moments = _edited_moments(film, plain)
    if not len(moments):
        return saved.camera(None)
    some = np.linspace(0, len(moments) - 1, min(_COMPARED, len(moments)) + 2).round().astype(int)[1:-1]
    sequence = saved.recording.judged
    scale = _THUMBNAIL / max(sequence.width, sequence.height)
    size = [max(1, round(scale * side)) for side in (sequence.width, sequence.height)]
    each = [resized(sequence.camera(0, c), scale, *size) for c in range(sequence.num_cameras)]
    cameras = jax.tree.map(lambda *leaves: jnp.stack(leaves), *each)

    def seen(film: Film) -> Float[np.ndarray, "T C h w 3"]:
        at, plan, images = frames_of(film, saved.blend), None, []
        for t in np.unique(moments[some]).tolist():
            drawn, plan = render_with_room(at(t), cameras, plan)
            images.append(np.asarray(drawn.colors))
        return np.stack(images)

    changed = (np.abs(seen(film) - seen(plain)).max(axis=-1) > _CHANGED).mean(axis=(0, 2, 3))
    return int(sequence.camera_ids[int(changed.argmax())]) if changed.any() else saved.camera(None)


def read_film(folder: Path) -> tuple[Script, Path]:
    """The edits of a film, and the run it was made from; if that is gone, the run that contains the folder,
    as it does by default.

    Raises:
        ValueError: the edits cannot be read.
        OSError: a file is missing, or the run is gone.
    """
    script = read_edits_of(folder)
    around = folder.absolute().parent.parent
    made_from = Path(read_values(folder / _METRICS, parse_json).get("run", around))
    run = around if is_run(around) and not is_run(made_from) else made_from
    if not is_run(run):
        raise FileNotFoundError(
            f"{folder}: expected the run of this film, {run}, found none there; move the film into its "
            "run, as RUN/edit/NAME"
        )
    return script, run


def read_edits_of(folder: Path) -> Script:
    """The edits of a film.

    Raises:
        ValueError: they cannot be read.
    """
    try:
        return parse_script((folder / SCRIPT).read_text(encoding="utf-8"))
    except ValueError as error:
        raise ValueError(f"{folder / SCRIPT}: {error}") from error


def new_folder(parent: Path, name: str) -> Path:
    """Create a folder of that name, with a number appended if it is taken.

    Raises:
        ValueError: the name is not valid for a folder.
        OSError: no folder can be made in `parent`.
    """
    if not _NAME.fullmatch(name):
        raise ValueError(
            f"film name: expected letters, digits, spaces and any of . _ - after the first, found {name!r}"
        )
    parent.mkdir(parents=True, exist_ok=True)
    for folder in chain([parent / name], (parent / f"{name}_{number}" for number in count(2))):
        with suppress(FileExistsError):
            folder.mkdir()
            return folder
    raise AssertionError


def write_film(
    folder: Path,
    script: Script,
    film: Film,
    saved: PartsRun,
    camera: int,
    notes: Notes,
    *,
    watch: Watch,
    ply: bool = False,
) -> dict[str, Any]:
    """Write a film: its script, video and metrics, which replace an earlier film in the folder.

    Args:
        folder: the folder of the film.
        script: the edits.
        film: the edited film.
        saved: the run.
        camera: id of the camera that films.
        notes: notes on the film.
        watch: shows the progress.
        ply: whether to write the Gaussians of each frame too.

    Returns:
        The contents of its metrics.json. A film that was stopped is not `complete`, but can be watched up to
        that frame.
    """
    for name in (SCRIPT, VIDEO, _METRICS):
        (folder / name).unlink(missing_ok=True)
    shutil.rmtree(folder / _PLY, ignore_errors=True)
    with atomic_write(folder / SCRIPT) as temporary:
        again = replace(script, edits=_from_anywhere(script.edits))
        temporary.write_text(to_yaml(again), encoding="utf-8")
    sequence, origin = saved.recording.judged, saved.recording.judged.origin
    view = sequence.camera(0, sequence.camera_ids.index(camera))
    fps = script.fps or 1 / float(np.median(np.diff(saved.recording.tracked.times)))
    seconds, stopped = [], None
    with VideoWriter(folder / VIDEO, fps) as video:
        try:
            for shot in watch(shots(film, view, saved), len(film[0].trajectory.times)):
                if ply:
                    write_scene(folder / _PLY / f"{len(seconds):06d}.ply", shot.gaussians, origin=origin)
                video.write(shot.image)
                seconds.append(shot.seconds)
        except KeyboardInterrupt as interrupt:
            stopped = interrupt
            after = f"after {counted(len(seconds), 'frame')} by {reason(stopped)}"
            notes.add(f"This film is not complete: it was stopped {after}.")
    warm = [each for each in seconds if each is not None]
    found = {
        "kind": "edit",
        "dataset": sequence.name,
        "run": str(saved.path.absolute()),
        **completion(stopped, report=False),
        "camera": camera,
        "frames": len(seconds),
        "fps": round(fps, 6),
        "seconds": round(len(seconds) / fps, 6),
        "num_gaussians": sum(layer.scene.gaussians.num for layer in film),
        "render_hz": 1 / float(np.median(warm)) if warm else None,
        "machine": describe_machine(),
        "notes": notes.all,
    }
    write_json(folder / _METRICS, found)
    return found


def frames_of(
    film: Film, blend: Blend, order: Int[np.ndarray, "n"] | None = None
) -> Callable[[int], Gaussians]:
    """Returns a function from the index of a frame to the Gaussians of a film in that frame.

    The moment is selected on the host, so that the length of a film is not compiled in.

    Args:
        film: the film.
        blend: how rotations are blended.
        order: rows of the Gaussians in the result (default: all, in their order).
    """
    scenes = tuple(layer.scene for layer in film)
    trajectories = jax.tree.map(np.asarray, tuple(layer.trajectory for layer in film))

    def at(frame: int) -> Gaussians:
        now = jax.tree.map(lambda leaf: leaf[frame : frame + 1], trajectories)
        return _placing()(tuple(map(Layer, scenes, now)), order, blend=blend)

    return at


@cache
def _placing() -> Callable[..., Gaussians]:
    return jax.jit(_placed, static_argnames="blend", compiler_options=host_options())


def _placed(film: Film, order: Int[Array, "n"] | None, blend: Blend) -> Gaussians:
    gaussians = film_gaussians(film, 0, blend)
    return gaussians if order is None else take(gaussians, order)


def shots(film: Film, camera: Camera, saved: PartsRun) -> Iterator[Shot]:
    """The frames of a film from one camera.

    Args:
        film: the film.
        camera: the camera that films.
        saved: the run.
    """
    at = frames_of(film, saved.blend)
    cameras, plan = jax.tree.map(lambda leaf: leaf[None], camera), None
    for t in range(len(film[0].trajectory.times)):
        begun, before = perf_counter(), plan
        gaussians = at(t)
        drawn, plan = render_with_room(gaussians, cameras, plan)
        image = np.clip(np.asarray(drawn.colors[0]), 0, 1)
        yield Shot(image, gaussians, perf_counter() - begun if plan is before else None)


def _from_anywhere(edits: tuple[Edit, ...]) -> tuple[Edit, ...]:
    """The edits with absolute paths of other runs, so that they can be read from any working directory."""
    return tuple(
        replace(edit, from_run=str(Path(edit.from_run).absolute()), edits=_from_anywhere(edit.edits))
        if isinstance(edit, Composite)
        else edit
        for edit in edits
    )


def _beyond(recorded: Layer, now: Trajectory) -> Beyond:
    """`beyond_captured`, padded so that films of similar length share one program."""
    length = len(now.times)
    rows = np.minimum(np.arange(length + -length % ROUND), length - 1)
    longer = jax.tree.map(lambda leaf: jnp.asarray(np.asarray(leaf)[rows]), now)
    return Beyond(*(np.asarray(values)[:length] for values in beyond_captured(recorded, longer)))


def _without_effect(script: Script, film: Film, saved: PartsRun, known: LoadScene) -> list[str]:
    """Labels of the edits without effect: removing one does not change the film, and adding it to the edits
    before it does not either, as with the second of two equal ones."""
    length = _length_of(script, film, saved)

    @cache
    def made(edits: tuple[Edit, ...]) -> Film | None:
        try:
            return apply(replace(script, edits=edits, length=length), saved.layer, saved.names, known)
        except ValueError:  # an edit depends on another
            return None

    def same(*edits: tuple[Edit, ...]) -> bool:
        films = [jax.tree.map(np.asarray, made(each)) for each in edits]
        return all(film is not None for film in films) and bool(eqx.tree_equal(*films))

    edits = script.edits
    return [
        label(k + 1, edit.operation())
        for k, edit in enumerate(edits)
        if same(edits, edits[:k] + edits[k + 1 :]) and same(edits[:k], edits[: k + 1])
    ]


def _length_of(script: Script, film: Film, saved: PartsRun) -> float:
    """The length, seconds, that makes a film with fewer edits as long as this one."""
    recorded = saved.layer.trajectory.times
    step = 1 / script.fps if script.fps else float(np.median(np.diff(recorded)))
    return float(np.clip(float(film[0].trajectory.times[-1]) + step / 2, *LENGTHS))


def _edited_moments(film: Film, plain: Film) -> Int[np.ndarray, "m"]:
    """The moments at which a film differs from the one without edits; all if something was added."""
    both = film[0].trajectory, plain[0].trajectory
    count = min(len(one.times) for one in both)
    if len(film) > 1:
        return np.arange(count)
    pairs = zip(*map(jax.tree.leaves, both), strict=True)
    differ = [(np.asarray(a)[:count] != np.asarray(b)[:count]).reshape(count, -1) for a, b in pairs]
    return np.flatnonzero(np.concatenate(differ, axis=1).any(axis=1))
