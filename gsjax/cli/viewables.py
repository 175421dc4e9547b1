"""What `gsjax view` opens: a run of any kind, or a PLY file."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import yaml

from gsjax.cli.editing import Filmed, camera_names, editing_of
from gsjax.cli.field_file import NAME
from gsjax.cli.field_run import field_of, open_field_run
from gsjax.cli.field_view import asking_of
from gsjax.cli.messages import Notes
from gsjax.cli.parts_run import blend_of, open_parts_run, read_parts
from gsjax.cli.photographs import photographs_of_run
from gsjax.cli.recording import Recording
from gsjax.cli.run_folder import expect_run
from gsjax.cli.saved_run import open_run, read_tracking
from gsjax.data.photographs import Photographs
from gsjax.io.ply import read_ply
from gsjax.scene.gaussians import Gaussians
from gsjax.viz.colors import to_uint8
from gsjax.viz.viewer import Shots, Viewable, moved


def open_viewable(path: Path, notes: Notes) -> tuple[Viewable, Path]:
    """What there is to see, and the folder that screenshots belong to.

    Raises:
        FileNotFoundError: there is no such file, or the folder is no run with a scene.
        ValueError: the file holds no Gaussians, or something else than a run writes.
    """
    if path.is_file():
        if path.suffix.lower() != ".ply":
            raise ValueError(f"{path}: expected a PLY file or the folder of a run, found another file")
        gaussians, labels = _read(path, notes)
        return Viewable(path.name, gaussians, labels), path.absolute().parent
    if not path.is_dir():
        raise FileNotFoundError(f"{path}: expected a run or a PLY file, found nothing there; check the path")
    expect_run(path)
    if (path / NAME).is_file():
        return _of_field(path, notes), path
    if not (path / "scene.ply").is_file():
        raise FileNotFoundError(
            f"{path}: expected a run with scene.ply, found none: it is not finished, or of a command that "
            "keeps no scene; let it finish (--resume goes on)"
        )
    if (path / "parts.npz").is_file():
        return _of_parts(path, notes), path
    if (path / "trajectory.npz").is_file():
        return _of_track(path, notes), path
    return _asked(_of_fit(path, notes), path, notes), path


def _asked(scene: Viewable, path: Path, notes: Notes) -> Viewable:
    """With what its field, if it has one, can be asked."""
    folder = field_of(path)
    if folder is None:
        return scene
    try:
        run = open_field_run(folder, notes)
        if run.gaussians.num != scene.gaussians.num:
            raise ValueError("it is of another scene")
        return replace(scene, asking=asking_of(run))
    except (ValueError, OSError) as error:
        notes.warn(f"its field cannot be asked: {error}")
        return scene


def _of_field(path: Path, notes: Notes) -> Viewable:
    """The scene of a field, with the photographs that taught it where they still are."""
    run = open_field_run(path, notes)
    antialiased = run.rasterize_mode == "antialiased"
    title = f"{path.absolute().parent.name}, {path.name}"
    shots = None if run.views is None else _shots_of(run.views.photographs)
    return Viewable(title, run.gaussians, shots=shots, antialiased=antialiased, asking=asking_of(run))


def _of_fit(path: Path, notes: Notes) -> Viewable:
    """The scene of a run of `gsjax fit`, with its photographs where they still are."""
    gaussians, labels = _read(path / "scene.ply", notes)
    config = path / "config.yml"
    try:
        settings = yaml.safe_load(config.read_text(encoding="utf-8"))
        antialiased = bool(settings["fit"]["antialiased"])
        behind = settings["fit"]["background"]
        shots, photographs = None, None
        try:
            photographs = photographs_of_run(settings)
            shots = _shots_of(photographs)
        except (ValueError, OSError) as error:
            notes.warn(f"its photographs are not shown: {error}")
    except (yaml.YAMLError, KeyError, TypeError, AttributeError) as error:
        raise ValueError(f"{config}: expected the settings of a fit, found others ({error})") from error
    background = photographs.background if photographs is not None and behind == "data" else None
    if background is None:
        background = (1.0, 1.0, 1.0) if behind == "white" else (0.0, 0.0, 0.0)
    title = path.absolute().name
    return Viewable(title, gaussians, labels, shots=shots, background=background, antialiased=antialiased)


def _of_track(path: Path, notes: Notes) -> Viewable:
    """The scene of a run of `gsjax track` over time, with its cameras where its recording still is."""
    names: dict[int, str] = {}
    shots, times = None, None
    try:
        saved = open_run(path)
    except ValueError as error:
        tracking = read_tracking(path)  # what is damaged there is an error
        notes.warn(f"its recording is not shown: {error}")
    else:
        tracking, names = saved.tracking, saved.names
        recording = saved.recording.judged
        shots, times = _shots_of_recording(saved.recording), recording.times[: tracking.num_frames]
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
    )


def _of_parts(path: Path, notes: Notes) -> Viewable:
    """The scene of a run of `gsjax parts` over time, with its cameras where its recording still is."""
    layer, names = read_parts(path)
    saved, shots = None, None
    try:
        saved = open_parts_run(path)
    except ValueError as error:
        notes.warn(f"its recording is not shown, and nothing can be edited: {error}")
    else:
        if saved.complete:
            shots = _shots_of_recording(saved.recording)
        else:
            notes.warn("it is a partial run: only the frames that were followed are there, and no cameras")
    times, blend = np.asarray(layer.trajectory.times), blend_of(path) if saved is None else saved.blend
    filmed = Filmed(path.absolute().name, names, blend, times - times[0], shots)
    return filmed.viewable((layer,), None if saved is None else editing_of(saved, filmed))


def _read(path: Path, notes: Notes) -> tuple[Gaussians, np.ndarray | None]:
    """The Gaussians of a file, and their labels.

    Raises:
        ValueError: it holds none.
    """
    gaussians, report = read_ply(path)
    if report.culled:
        notes.warn(f"{path}: {report.culled} of {report.stored} Gaussians cannot be drawn and are left out")
    if gaussians.num == 0:
        raise ValueError(f"{path}: expected Gaussians, found none that can be drawn")
    return gaussians, report.labels


def _shots_of(photographs: Photographs) -> Shots:
    return Shots(
        photographs.names,
        photographs.viewmats[None],
        photographs.Ks[None],
        photographs.sizes,
        load_image=lambda _, v: photographs.image(v),
    )


def _shots_of_recording(recording: Recording) -> Shots:
    sequence, names = recording.judged, camera_names(recording)
    return Shots(
        tuple(names),
        sequence.viewmats,
        sequence.Ks,
        np.tile([sequence.width, sequence.height], (len(names), 1)),
        load_image=lambda t, v: to_uint8(np.asarray(sequence.image(t, v))),
    )
