"""`gsjax query`: find what a text means in a run: an object of a tracked run, in every frame; Gaussians where
there is a field (`gsjax distill`); or Gaussians over time in a deforming scene (`gsjax deform`)."""

from dataclasses import dataclass, fields
from pathlib import Path
from time import perf_counter
from typing import Annotated, Any, Literal

import numpy as np
import tyro
from jaxtyping import Float
from rich.console import Console

from gsjax.engine.distill.file import FOLDER
from gsjax.engine.distill.saved import Locations, field_of, open_field_run
from gsjax.engine.folder import DEFORMATION, OF_QUERY, expect_folder, expect_replaceable, is_run
from gsjax.engine.messages import Notes, describe, stage
from gsjax.engine.options import Common, ObjectText
from gsjax.engine.program import USER_ERRORS
from gsjax.engine.query import Question, answer
from gsjax.engine.records import kind_of
from gsjax.perception.levels import Level

HELP = (
    ' In a run of `gsjax track` a text means an object, as in `gsjax query RUN "red can"`; where there is a '
    "field (`gsjax distill`) Gaussians, as in `gsjax query RUN/field can`; in a run of `gsjax deform` with "
    "names Gaussians over time, as in `gsjax query RUN tool`, and without a text it labels everything. "
    "Where a tracked run has a field too, RUN/field queries the field."
)
_LISTED = 6  # photographs, at most


@dataclass(frozen=True)
class GaussianOptions:
    """Options of queries for Gaussians: of a field, or of a run of `gsjax deform`."""

    point: Annotated[str | None, tyro.conf.arg(metavar="X,Y")] = None
    """A pixel of --camera, or of --frame, that shows the thing to find."""
    threshold: float | None = None
    """Score above which a Gaussian is selected: a cosine (-1 to 1), or, compared with negatives or names, a
    share (0 to 1). Default: 1/2 for a share; for a text of the closed vocabulary, its own threshold; else
    the one that best divides the scores into two classes (Otsu)."""
    color: Annotated[tuple[float, float, float] | None, tyro.conf.arg(metavar="R G B")] = None
    """RGB, 0 to 1, that recolored.ply gives to what was found (default: pink)."""
    negatives: Annotated[tuple[str, ...] | None, tyro.conf.arg(metavar="TEXT [TEXT ...]")] = None
    """Negatives to compare with. Default for a text: all other classes; with CLIP "object", "things",
    "stuff", "texture"."""
    move: Annotated[tuple[float, float, float] | None, tyro.conf.arg(metavar="X Y Z")] = None
    """Move what was found by this much along each axis, in the scene's unit, and write moved.ply (default:
    not written)."""


@dataclass(frozen=True)
class FieldOptions:
    """Options of queries of a field."""

    image: Path | None = None
    """A picture of the thing to find; with an alpha channel, only its opaque part."""
    top: Annotated[int | None, tyro.conf.arg(metavar="N")] = None
    """Select the N Gaussians with the best scores, instead of those above a threshold."""
    level: Level | Literal["auto"] = "auto"
    """Level to look on, in a field that was distilled with --level each: small for parts, large for things.
    auto: the level that the query fits best; for --point, small."""
    within: Annotated[str | None, tyro.conf.arg(metavar="TEXT")] = None
    """Restrict the search to what this text finds, on the level that it fits best: `handle --within
    drawer`."""
    film: bool = True
    """For the field of a run of `gsjax track`: film what was found over all frames; its positions in all
    frames are written in any case."""
    scene: Annotated[Path | None, tyro.conf.arg(metavar="FILE")] = None
    """Current path of the scene's file, if it was moved (default: its first path, or next to the field)."""
    images: Annotated[str | None, tyro.conf.arg(metavar="FOLDER")] = None
    """Current folder of the photographs, if they were moved."""


@dataclass(frozen=True)
class DeformOptions:
    """Options of queries of a run of `gsjax deform`."""

    box: Annotated[str | None, tyro.conf.arg(metavar="X0,Y0,X1,Y1")] = None
    """A box, in pixels of --frame, that shows the thing to find."""
    frame: Annotated[int | None, tyro.conf.arg(metavar="ID")] = None
    """The frame of --point or --box, whose Gaussians are written (default: the first)."""
    frames: Annotated[str | None, tyro.conf.arg(metavar="START:STOP[:STEP]")] = None
    """Frames to draw, as a Python slice (default: the held-out ones)."""


@dataclass(frozen=True)
class TrackOptions(ObjectText):
    """Options of queries of a run of `gsjax track`."""


@dataclass(frozen=True)
class Options(Common):
    """Options of `gsjax query`."""

    run: Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="RUN")]
    """Folder of a run of `gsjax track` or `gsjax deform`; of any run with a field (`gsjax distill`); or any
    folder with field.npz."""
    text: Annotated[str | None, tyro.conf.Positional, tyro.conf.arg(metavar="[TEXT]")] = None
    """The thing to find: "red can". Or use --image, --point or --box. Without any of them, everything in a
    run of `gsjax deform` is labelled."""
    camera: Annotated[str | None, tyro.conf.arg(metavar="ID")] = None
    """Camera (or photograph) to show the result from, and that --point refers to. Default: for a tracked run
    the first held-out camera or, without one, the first; for a field, all."""
    out: Annotated[Path | None, tyro.conf.arg(metavar="FOLDER")] = None
    """Folder of the answer, which replaces an earlier one (default: query/ in RUN)."""
    pictures: bool = True
    """Draw what was found, in pictures and films, which takes most of the time."""
    weights: Path | None = None
    """Folder of CLIP's weights, in Hugging Face's layout. For CLIP features: where the weights are now, if
    they were moved."""
    gaussians: Annotated[GaussianOptions, tyro.conf.OmitArgPrefixes] = GaussianOptions()
    """For a field, or a run of `gsjax deform`."""
    field: Annotated[FieldOptions, tyro.conf.OmitArgPrefixes] = FieldOptions()
    """Only for a field."""
    deform: Annotated[DeformOptions, tyro.conf.OmitArgPrefixes] = DeformOptions()
    """Only for a run of `gsjax deform`."""
    track: Annotated[TrackOptions, tyro.conf.OmitArgPrefixes] = TrackOptions()
    """Only for a run of `gsjax track` whose objects, not its field, are queried."""


def run(options: Options) -> int:
    """Answer, and write the folder of the answer; returns the exit code.

    Raises:
        ValueError, OSError: there is no such run or encoder, or no object matches the text.
    """
    expect_folder(options.run)
    _expect_place(options.out)
    console, field = Console(stderr=True, highlight=False), field_of(options.run)
    # A tracked run is queried over time, but cannot answer queries that need a field.
    tracked = (options.run / "trajectory.npz").is_file()
    needs_field = _given(options.gaussians, options.field)
    try:
        if (options.run / DEFORMATION).is_file():
            _query_deformation(options, console)
            return 0
        _expect_none_of(f"is for a run of `gsjax deform`, which {options.run} is not", options.deform)
        if field is not None and (needs_field or not tracked):
            _query_field(options, field, console)
            return 0
        if field is None and not tracked:
            _expect_track(options.run)
        _query_objects(options, console)
    except USER_ERRORS as error:
        folder = _folder(options)
        if not (folder / "query.json").is_file():
            raise
        raise ValueError(f"{describe(error)} ({folder} still has an earlier answer)") from error
    return 0


def _folder(options: Options) -> Path:
    """The folder of the answer."""
    return options.run / "query" if options.out is None else options.out


def _expect_place(out: Path | None) -> None:
    """Raises a ValueError if writing an answer there would destroy something else."""
    if out is None or not out.exists():
        return
    if out.resolve() in (here := Path.cwd().resolve(), *here.parents):
        raise ValueError(f"--out {out}: expected a folder of its own, found the current one; name another")
    try:
        expect_replaceable(out, OF_QUERY)
    except FileExistsError as error:
        raise ValueError(
            f"--out {out}: expected a new folder, or one with an earlier answer, found other files; "
            "name another"
        ) from error


def _given(*groups: Any) -> list[str]:
    """The names of the options in these groups that are given."""
    options = [(field, getattr(group, field.name)) for group in groups for field in fields(group)]
    return [field.name.replace("_", "-") for field, value in options if value != field.default]


def _expect_none_of(reason: str, *groups: Any) -> None:
    """Raises a ValueError with the reason if an option in these groups is given."""
    if given := _given(*groups):
        raise ValueError(f"--{given[0]}: {reason}")


def _expect_track(path: Path) -> None:
    """Raises a ValueError where a run has no field (yet), and is not a run of `gsjax track` either."""
    for folder in (path, path / FOLDER):
        if kind_of(folder) == "distill":
            raise ValueError(
                f"{folder}: expected field.npz, found none yet: it is still being distilled, or was killed; "
                "if killed, continue it with gsjax distill --resume"
            )
    if kind_of(path) == "deform":
        raise ValueError(
            f"{path}: expected {DEFORMATION}, found none yet: it is still being reconstructed, or "
            "was killed; if killed, continue it with gsjax deform --resume"
        )
    if is_run(path) and kind_of(path) != "track":
        raise ValueError(f"{path}: expected a field, found none; gsjax distill {path} makes one")


def _query_field(options: Options, path: Path, console: Console) -> None:
    """Query a field."""
    # Each kind of run imports only what it needs: all together are slow to import.
    from gsjax.engine.distill.query import QueryableField

    begun, folder = perf_counter(), _folder(options)
    question = _question(options)
    if not options.pictures and options.camera is not None and question.point is None:
        raise ValueError("--camera: expected --point, or pictures to draw, found neither; leave it out")
    ways = sum(way is not None for way in (question.text, question.image, question.point))
    if ways != 1:
        raise ValueError(
            f"expected one of TEXT, --image and --point, found {ways or 'none'}; "
            f'for example gsjax query {options.run} "can"'
        )
    _expect_none_of("a field knows the encoder of its features; leave it out (--threshold)", options.track)
    if question.point is not None and question.camera is None:
        raise ValueError("--point: expected --camera too, found none; name the photograph that it is in")
    with Notes(console) as notes:
        with stage(console, "reading the field"):
            now = Locations(options.field.scene, options.field.images, options.weights)
            found = open_field_run(path, notes, now)
        over_time = None
        if found.file.with_name("trajectory.npz").is_file():
            from gsjax.engine.distill.over_time import over_time_of

            over_time = over_time_of(found, notes)
        scene = QueryableField(found, over_time, films=options.field.film)
        info = answer(scene, question, folder, notes, console)
    _print(question, found.unit, "photographs", info, perf_counter() - begun)
    print(f"scene     {found.file}")
    written = ("selection.npz", "object.ply", "overview.png", "over_time.npz", "video.mp4")
    print(f"query     {folder}: {', '.join(file for file in written if (folder / file).is_file())}")


def _query_deformation(options: Options, console: Console) -> None:
    """Query a scene that deforms, or label all of it."""
    from gsjax.engine.deform.file import read_deformation, read_metadata, warn_of_partial
    from gsjax.engine.deform.query import QueryableScene, label_everything

    begun, folder = perf_counter(), _folder(options)
    reason = "a run of `gsjax deform` has no use for it; leave it out"
    _expect_none_of(reason, options.field, options.track)
    question = _question(options)
    if question.camera is not None:
        raise ValueError(f"--camera: {reason}")
    if not options.pictures and question.frames is not None:
        raise ValueError("--frames: expected pictures to draw, found --no-pictures; leave one out")
    ways = sum(way is not None for way in (question.text, question.point, question.box))
    if ways > 1:
        raise ValueError("expected at most one of TEXT, --point and --box, found more")
    for option, value in (("negatives", question.negatives), ("weights", options.weights)):
        if question.text is None and value is not None:
            raise ValueError(f"--{option}: expected a TEXT too, found none; leave out --{option} or give one")
    with Notes(console) as notes:
        with stage(console, "reading the scene"):
            file = options.run / DEFORMATION
            result, beside = read_deformation(file), read_metadata(file)
        warn_of_partial(options.run, notes)
        scene = QueryableScene(options.run, result, options.weights, *beside)
        if ways:
            info = answer(scene, question, folder, notes, console)
        else:
            info = label_everything(scene, question, folder, notes, console)
    if ways:
        _print(question, "m" if result.timeline.metric else "", "frames", info, perf_counter() - begun)
    else:
        found = ", ".join(f"{name}: {count:,}" for name, count in info["classes"].items())
        print(f"{'found':<10}{found} of {info['of']:,} Gaussians, in frame {info['frame']}")
    drawn = ", frames/, masks/, video.mp4" if question.pictures else ""
    print(f"query     {folder}: selection.npz, recolored.ply{drawn}")


def _print(question: Question, unit: str, seen_in: str, info: dict[str, Any], seconds: float) -> None:
    """Print what was found, in a few lines."""
    meant = f", {info['meant']!r}" if info["meant"] and info["meant"] != info["text"] else ""
    meant += f", on level {info['level']}" if info["level"] else ""
    against = f", against {', '.join(info['against'][:_LISTED])}" if info["against"] else ""
    unit = f" {unit}" if unit else ""
    least = "above" if question.top is None else "at least"
    rows = {
        "found": f"{question.words}{meant}: {info['gaussians']:,} of {info['of']:,} Gaussians",
        "centre": _place(info["center"], unit, info["frame"]),
        "size": " x ".join(f"{x:.3f}" for x in info["size"]) + unit,
        "score": f"{least} {info['threshold']:.3f} ({info['rule']}), {info['best_score']:.3f} at best"
        + against,
    }
    if (last := info["at_last"]) is not None and last["frame"] != info["frame"]:
        rows["at last"] = _place(last["center"], unit, last["frame"])
    if pixels := info["pixels"]:
        unseen = [name for name, count in pixels.items() if not count]
        more = ", ..." if len(unseen) > _LISTED else ""
        rows["seen"] = f"in {len(pixels) - len(unseen)} of {len(pixels)} {seen_in}" + (
            f"; not in {', '.join(unseen[:_LISTED])}{more}" if unseen else ""
        )
    rows["time"] = f"{seconds:.1f} s, of which the query took {1e3 * info['query_seconds']:.1f} ms"
    for name, row in rows.items():
        print(f"{name:<10}{row}")


def _place(center: Float[np.ndarray, "3"], unit: str, frame: int | None) -> str:
    """A position as text, with the frame that it is in."""
    return ", ".join(f"{x:.3f}" for x in center) + unit + ("" if frame is None else f" in frame {frame}")


def _question(options: Options) -> Question:
    """The question, for a run of any kind."""
    gaussians, deform = options.gaussians, options.deform
    return Question(
        text=options.text,
        image=options.field.image,
        point=_numbers("--point", gaussians.point, "X,Y"),
        box=_numbers("--box", deform.box, "X0,Y0,X1,Y1"),
        camera=options.camera,
        frame=deform.frame,
        frames=deform.frames,
        level=None if options.field.level == "auto" else options.field.level,
        within=options.field.within,
        threshold=gaussians.threshold,
        top=options.field.top,
        negatives=gaussians.negatives,
        color=gaussians.color or Question.color,
        move=gaussians.move,
        pictures=options.pictures,
    )


def _numbers(option: str, text: str | None, wanted: str) -> Any:
    """Numbers with commas between them, as many as `wanted` ("X,Y") names; None without a text.

    Raises:
        ValueError: the text is not of this form.
    """
    if text is None:
        return None
    try:
        found = tuple(float(part) for part in text.split(","))
    except ValueError:
        found = ()
    if len(found) != wanted.count(",") + 1:
        raise ValueError(f"{option}: expected {wanted} in pixels, found {text!r}")
    return found


def _query_objects(options: Options, console: Console) -> None:
    """Query a tracked run for an object."""
    from gsjax.engine.track.query import ObjectQuery, answer_query

    _expect_none_of(
        f"{options.run} has no field that could be queried so; gsjax distill {options.run} makes one",
        options.gaussians,
        options.field,
    )
    if options.text is None:
        raise ValueError(
            f'expected a TEXT that names the object, found none; for example gsjax query {options.run} "can"'
        )
    camera = options.camera
    if camera is not None and not camera.lstrip("-").isdigit():
        raise ValueError(f"--camera: expected the id of a camera, a number, found {camera!r}")
    query = ObjectQuery(
        run=options.run,
        text=options.text,
        camera=None if camera is None else int(camera),
        weights=options.weights,
        debug=options.debug,
        **vars(options.track),
    )
    answer_query(query, console, _folder(options), pictures=options.pictures)
