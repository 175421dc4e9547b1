"""The scenes that `gsjax view` opens: any run, a file of Gaussians or a folder of numbered files."""

from dataclasses import fields
from pathlib import Path
from typing import Literal

import equinox as eqx
import jax.numpy as jnp
import numpy as np

from gsjax.data.ordered import open_as_sequence
from gsjax.data.origin import relative_to_origin
from gsjax.data.photographs import Photographs
from gsjax.engine.asking import asking_of
from gsjax.engine.deform.file import read_deformation, read_metadata
from gsjax.engine.deform.query import QueryableScene, probabilities_of
from gsjax.engine.distill.file import NAME
from gsjax.engine.distill.over_time import OverTime, if_same_size
from gsjax.engine.distill.query import QueryableField
from gsjax.engine.distill.saved import UNMOVED, FieldRun, Locations, field_of, open_field_run
from gsjax.engine.distill.scene import with_learned_poses
from gsjax.engine.files import read_drawable, read_frames, reopen
from gsjax.engine.folder import DEFORMATION, SCRIPT, expect_run, is_run
from gsjax.engine.messages import Notes, describe
from gsjax.engine.parts.films import edited, read_film
from gsjax.engine.parts.saved import PartsRun, blend_of, open_parts_run, read_parts
from gsjax.engine.parts.viewer import Filmed, camera_names, editing_of
from gsjax.engine.photographs import photographs_of_run
from gsjax.engine.recording import Recording
from gsjax.engine.records import is_of_live
from gsjax.engine.track.saved import open_run, read_tracking
from gsjax.io.parsed import parse_yaml
from gsjax.io.scenes import is_scene
from gsjax.io.sequences import frame_files
from gsjax.methods.deform import DeformResult
from gsjax.methods.deform.query import most_likely
from gsjax.methods.parts.film import Layer
from gsjax.methods.parts.timeline import Names
from gsjax.scene.handles import Blend
from gsjax.scene.origin import rebased
from gsjax.viz.colors import to_uint8
from gsjax.viz.viewer import Motion, Shots, Viewable, moved

Up = Literal["auto", "x", "y", "z", "-x", "-y", "-z"]
UP = {sign + axis: s * np.eye(3)[i] for sign, s in (("", 1), ("-", -1)) for i, axis in enumerate("xyz")}
"""Directions by their names."""
_SAME_COLOR = 0.1  # of a coefficient: two quantisation steps of the coarsest format
_AGAIN = "reconstruct it again with this version of gsjax"


def open_viewable(
    path: Path, notes: Notes, now: Locations = UNMOVED, *, photographs: bool = True
) -> tuple[Viewable, Path]:
    """The scene at a path, and the folder for screenshots.

    Args:
        path: a run, a field, a film of `gsjax edit`, a file of Gaussians in any format that `read_gaussians`
            reads, or a folder of numbered files, the frames of a moving scene.
        notes: collects warnings.
        now: the current paths of what a field or a fit refers to.
        photographs: whether to open those of a fit or of a deforming run, if they are still there.

    Raises:
        FileNotFoundError: there is no such file, or the folder is no run with a scene.
        ValueError: the file holds no Gaussians, or not what the run wrote; or a path in `now` does not
            apply.
    """
    if is_scene(path / "meta.json"):
        path = path / "meta.json"
    if path.is_file():
        _expect_only((), now, f"{path} is a file")
        gaussians, report = read_drawable(path)
        scene = Viewable(
            path.name,
            gaussians,
            report.labels,
            antialiased=bool(report.antialiased),
            origin=report.origin,
        )
        return scene, path.absolute().parent
    if not path.is_dir():
        raise FileNotFoundError(
            f"{path}: expected a run or a file of Gaussians, found nothing there; check the path"
        )
    if files := frame_files(path):
        _expect_only((), now, f"{path} is a folder of files")
        return _of_files(path, files, notes), path
    if (path / NAME).is_file():
        return _of_field(path, notes, now), path
    if (path / SCRIPT).is_file() and not is_run(path):
        _expect_only((), now, f"{path} is a film of `gsjax edit`")
        return _of_film(path, notes), path
    expect_run(path)
    if (path / DEFORMATION).is_file():
        _expect_only(("weights",), now, f"{path} is a run that deforms")
        return _of_deformation(path, notes, now.weights, photographs), path
    if not (path / "scene.ply").is_file():
        advice = "finish the run with --resume"
        if is_of_live(path):
            advice = "gsjax live keeps no Gaussians, so track the recording with gsjax track"
        raise FileNotFoundError(f"{path}: expected a run with scene.ply, found none; {advice}")
    if (path / "parts.npz").is_file():
        _expect_only((), now, f"{path} is a run of `gsjax parts`")
        if (field := field_of(path)) is not None:
            notes.warn(f"parts cannot be queried; gsjax view {field} shows the scene of its field")
        return _of_parts(path, notes), path
    if (path / "trajectory.npz").is_file():
        return _of_track(path, notes, now), path
    return _of_fit(path, notes, now, photographs), path


def _of_files(path: Path, files: list[Path], notes: Notes) -> Viewable:
    """The scene whose frames are files, in order, in the coordinates of the first."""
    read = read_frames(files)
    first, report = next(read)
    frames = [first, *(rebased(there, known.origin, report.origin) for there, known in read)]
    still = all(eqx.tree_equal(each, first) for each in frames[1:])
    colors = np.asarray(first.sh0)
    if max(np.abs(np.asarray(each.sh0) - colors).max() for each in frames) > _SAME_COLOR:
        notes.warn("colours change from frame to frame; all are shown in those of the first")
    return Viewable(
        path.absolute().name,
        first,
        report.labels,
        motion=Motion(len(frames), 0 if still else first.num, frames.__getitem__),
        antialiased=bool(report.antialiased),
        origin=report.origin,
    )


def _expect_only(used: tuple[str, ...], now: Locations, because: str) -> None:
    """Raises a ValueError if a path is given that does not apply."""
    unused = [f.name for f in fields(now) if f.name not in used and getattr(now, f.name) is not None]
    if unused:
        raise ValueError(f"--{unused[0]}: {because}, to which it does not apply; leave it out")


def _of_field(path: Path, notes: Notes, now: Locations) -> Viewable:
    """The scene of a field, with its photographs if they are still there."""
    run = open_field_run(path, notes, now)
    folder = path.absolute()
    return Viewable(
        f"{folder.parent.name}, {folder.name}",
        run.gaussians,
        run.labels,
        shots=None if run.photographs is None else _shots_of(run.photographs),
        antialiased=run.rasterize_mode == "antialiased",
        unit=run.unit,
        origin=run.origin,
        asking=asking_of(QueryableField(run)),
    )


def _field_of_run(path: Path, notes: Notes, now: Locations, used: tuple[str, ...] = ()) -> FieldRun | None:
    """The field of a run's scene, if it has one that can be queried; `used` are paths that the run uses."""
    folder = field_of(path)
    if folder is None:
        _expect_only(used, now, f"{path} has no field")
        return None
    _expect_only((*used, "weights"), now, f"{path} is a run with its scene")
    try:
        run = open_field_run(folder, notes, now, photographs=False)
    except (ValueError, OSError) as error:
        notes.warn(f"its field cannot be queried: {describe(error)}")
        return None
    if not run.file.samefile(path / "scene.ply"):
        notes.warn(f"its field belongs to another scene, {run.file}; gsjax view {folder} shows it")
        return None
    return run


def _of_fit(path: Path, notes: Notes, now: Locations, shown: bool) -> Viewable:
    """The scene of a run of `gsjax fit`, with its field, and its photographs if they are still there."""
    field, config = _field_of_run(path, notes, now, used=("images",)), path / "config.yml"
    if field is None:
        gaussians, report = read_drawable(path / "scene.ply")
        labels, origin = report.labels, report.origin
    else:
        gaussians, labels, origin = field.gaussians, field.labels, field.origin
    try:
        settings = parse_yaml(config.read_text(encoding="utf-8"))
        antialiased = bool(settings["fit"]["antialiased"])
        behind = settings["fit"]["background"]
        shots, photographs = None, None
        try:
            if shown:
                photographs = with_learned_poses(photographs_of_run(settings, now.images), path)
                photographs = relative_to_origin(photographs, origin)
                shots = _shots_of(photographs)
        except (ValueError, OSError) as error:
            notes.warn(f"its photographs are not shown: {describe(error)}")
    except (ValueError, KeyError, TypeError, AttributeError) as error:
        raise ValueError(f"{config}: expected the settings of a fit, found others ({error})") from error
    background = photographs.background if photographs is not None and behind == "data" else None
    if background is None:
        background = (1.0, 1.0, 1.0) if behind == "white" else (0.0, 0.0, 0.0)
    return Viewable(
        path.absolute().name,
        gaussians,
        labels,
        shots=shots,
        background=background,
        antialiased=antialiased,
        origin=origin,
        asking=None if field is None else asking_of(QueryableField(field)),
    )


def _of_deformation(path: Path, notes: Notes, weights: Path | None, shown: bool) -> Viewable:
    """The scene of a run of `gsjax deform` over time, with its photographs if the recording is still there;
    it can be queried if its features have a meaning."""
    result = read_deformation(path / DEFORMATION)
    kind = None if result.meaning is None else result.meaning.source.kind
    if weights is not None and kind in (None, "classes", "closed"):
        raise ValueError(f"--weights: {path} has no CLIP features; leave it out")
    first, labels, asking, times = result.at(0.0), None, None, result.timeline.times
    origin, background = read_metadata(path / DEFORMATION)
    if result.meaning is not None and first.features is not None:
        asking = asking_of(QueryableScene(path, result, weights, origin, background))
        likely = probabilities_of(first.features, jnp.asarray(result.meaning.codebook, jnp.float32))
        labels = 1 + np.asarray(most_likely(likely))
    return Viewable(
        path.absolute().name,
        first,
        labels,
        dict(enumerate(result.names, 1)),
        motion=Motion(len(times), first.num, lambda frame: result.at(times[frame])),
        times=times * result.timeline.seconds,
        shots=_shots_of_deformation(path, result, notes) if shown else None,
        unit="m" if result.timeline.metric else "",
        background=background or (0.0, 0.0, 0.0),
        origin=origin,
        asking=asking,
    )


def _of_track(path: Path, notes: Notes, now: Locations) -> Viewable:
    """The scene of a run of `gsjax track` over time, with its cameras if the recording is still there; it can
    be queried if it has a field."""
    field, asking = _field_of_run(path, notes, now), None
    names: dict[int, str] = {}
    shots, times, saved = None, None, None
    try:
        saved = open_run(path)
    except (ValueError, OSError) as error:  # an OSError if it is not scored yet
        tracking, origin = read_tracking(path)  # an error if that is damaged too
        notes.warn(f"its recording is not shown: {describe(error)}")
    else:
        tracking, names = saved.tracking, saved.names
        recording = saved.recording.judged
        origin = recording.origin
        shots, times = _shots_of_recording(saved.recording), recording.times[: tracking.num_frames]
    if field is not None:
        over_time = if_same_size(field, OverTime(tracking, origin, saved), notes)
        asking = None if over_time is None else asking_of(QueryableField(field, over_time))
    count = tracking.scene.num_moving
    return Viewable(
        path.absolute().name,
        tracking.scene.gaussians,
        np.asarray(tracking.scene.labels),
        names,
        motion=moved(tracking.scene.gaussians, tracking.means()[:, :count], tracking.quats()),
        times=times,
        shots=shots,
        unit="m",
        origin=origin,
        asking=asking,
    )


def _of_parts(path: Path, notes: Notes) -> Viewable:
    """The scene of a run of `gsjax parts` over time, with its cameras if the recording is still there."""
    layer, names, origin = read_parts(path)
    saved = None
    try:
        saved = open_parts_run(path)
    except (ValueError, OSError) as error:
        notes.warn(f"its recording is not shown, and nothing can be edited: {error}")
    else:
        if not saved.complete:
            notes.warn("a partial run: it has only the frames that were followed, and no cameras")
    blend = blend_of(path) if saved is None else saved.blend
    filmed = _filmed(path, layer, names, blend, origin, saved)
    return filmed.viewable((layer,), None if saved is None else editing_of(saved, filmed))


def _of_film(path: Path, notes: Notes) -> Viewable:
    """The edited scene of a film, over the time of the film; its photographs are those of the recording."""
    script, run = read_film(path)
    saved = open_parts_run(run)
    film, doubts = edited(script, saved)
    for doubt in doubts:
        notes.warn(doubt)
    origin = saved.recording.judged.origin
    return _filmed(path, saved.layer, saved.names, saved.blend, origin, saved).viewable(film)


def _filmed(
    path: Path, layer: Layer, names: Names, blend: Blend, origin: np.ndarray | None, saved: PartsRun | None
) -> Filmed:
    """What the films of a run have in common, with its cameras if it is complete."""
    times = np.asarray(layer.trajectory.times)
    shots = None if saved is None or not saved.complete else _shots_of_recording(saved.recording)
    return Filmed(path.absolute().name, names, blend, times - times[0], shots, origin)


def _shots_of(photographs: Photographs) -> Shots:
    return Shots(
        photographs.names,
        photographs.viewmats[None],
        photographs.Ks[None],
        photographs.sizes,
        lambda _, v: photographs.image(v),
        photographs.near,
    )


def _shots_of_recording(recording: Recording) -> Shots:
    sequence, names = recording.judged, camera_names(recording)
    return Shots(
        tuple(names),
        sequence.viewmats,
        sequence.Ks,
        np.tile([sequence.width, sequence.height], (len(names), 1)),
        lambda t, v: to_uint8(np.asarray(sequence.image(t, v))),
        sequence.near,
    )


def _shots_of_deformation(path: Path, result: DeformResult, notes: Notes) -> Shots:
    """The camera in all frames, with its photographs if these are still there."""
    load = None
    try:
        sequence = reopen(path / "config.yml", _AGAIN, opened=open_as_sequence)[0].judged
        found = (sequence.num_frames, sequence.width, sequence.height)
        if found != (wanted := (len(result.timeline.times), *result.timeline.size)):
            raise ValueError(f"expected frames, width and height {wanted} as in the run, found {found}")
        load = lambda t, _: sequence.image(t, 0)  # noqa: E731
    except (ValueError, OSError) as error:
        notes.warn(f"its photographs are not shown: {describe(error)}")
    sizes = np.array([result.timeline.size])
    viewmats, Ks = result.timeline.viewmats[:, None], result.timeline.Ks[:, None]
    return Shots(("camera",), viewmats, Ks, sizes, load, result.timeline.near)
