"""`gsjax query`: find what a text means in a run: an object of a tracked run, in every frame; Gaussians where
there is a field (`gsjax distill`); or Gaussians over time in a deforming scene (`gsjax deform`)."""

import math
from dataclasses import dataclass, fields
from pathlib import Path
from time import perf_counter
from typing import Annotated, Any

import tyro
from rich.console import Console

from gsjax.engine.deform.file import NAME as DEFORMATION
from gsjax.engine.deform.file import read_deformation, warn_of_partial
from gsjax.engine.deform.query import DeformQuestion, answer_deformation
from gsjax.engine.distill.query import Question, answer
from gsjax.engine.distill.saved import Whereabouts, field_of, open_field_run, unfinished_field_of
from gsjax.engine.folder import expect_folder, is_run
from gsjax.engine.messages import Notes, describe, stage
from gsjax.engine.options import Common, ObjectText
from gsjax.engine.program import USER_ERRORS
from gsjax.engine.records import read_config, read_record
from gsjax.engine.selected import Changes
from gsjax.engine.track.query import ObjectQuery, ask_for_object

HELP = (
    ' In a run of `gsjax track` a text means an object, as in `gsjax query RUN "red can"`; where there is a '
    "field (`gsjax distill`) Gaussians, as in `gsjax query RUN/field can`; in a run of `gsjax deform` with "
    "names Gaussians over time, as in `gsjax query RUN tool`, and without a text it labels everything. "
    "Where a tracked run has a field too, RUN/field queries the field."
)
_COLOR = (1.0, 0.25, 0.6)
_HIGHEST = 1.0  # highest score: a cosine is from -1 to 1, a share against negatives from 0 to 1
_LISTED = 6  # photographs, at most


@dataclass(frozen=True)
class GaussianOptions:
    """Options of queries for Gaussians: of a field, or of a run of `gsjax deform`."""

    point: Annotated[str | None, tyro.conf.arg(metavar="X,Y")] = None
    """A pixel of --camera, or of --frame, that shows what is looked for."""
    threshold: float | None = None
    """Score above which a Gaussian is selected: a cosine (-1 to 1), or against negatives or names a share
    (0 to 1). Default: 1/2 against these; for a text of the closed vocabulary its own; else the threshold
    that divides the scores best into two classes (Otsu)."""
    color: Annotated[tuple[float, float, float] | None, tyro.conf.arg(metavar="R G B")] = None
    """RGB, 0 to 1, of what was found in recolored.ply (default: pink)."""
    negatives: Annotated[tuple[str, ...] | None, tyro.conf.arg(metavar="TEXT [TEXT ...]")] = None
    """Negatives to compare with. Default for a text: all other classes; with CLIP "object", "things",
    "stuff", "texture"."""
    move: Annotated[tuple[float, float, float] | None, tyro.conf.arg(metavar="X Y Z")] = None
    """Shift along each axis, in the scene's unit, of what was found, for moved.ply (default: not written)."""


@dataclass(frozen=True)
class FieldOptions:
    """Options of queries of a field."""

    image: Path | None = None
    """A picture of what is looked for; with an alpha channel, only its opaque part."""
    scene: Annotated[Path | None, tyro.conf.arg(metavar="PLY")] = None
    """The scene's file, where it is now (default: where it was, or beside the field)."""
    images: Annotated[str | None, tyro.conf.arg(metavar="FOLDER")] = None
    """The photographs, where they are now."""


@dataclass(frozen=True)
class DeformOptions:
    """Options of queries of a run of `gsjax deform`."""

    box: Annotated[str | None, tyro.conf.arg(metavar="X0,Y0,X1,Y1")] = None
    """A box, in pixels of --frame, that shows what is looked for."""
    frame: Annotated[int | None, tyro.conf.arg(metavar="ID")] = None
    """The frame of --point or --box, whose Gaussians are written (default: the first)."""
    frames: Annotated[str | None, tyro.conf.arg(metavar="START:STOP[:STEP]")] = None
    """Frames to draw, as Python slices them (default: the held-out ones)."""


@dataclass(frozen=True)
class TrackOptions(ObjectText):
    """Options of queries of a run of `gsjax track`."""


@dataclass(frozen=True)
class Options(Common):
    """Options of `gsjax query`."""

    run: Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="RUN")]
    """Folder of a run of `gsjax track` or `gsjax deform`; of any run with a field (`gsjax distill`); or that
    holds field.npz. The answer is written to query/ in it, in place of an earlier one."""
    text: Annotated[str | None, tyro.conf.Positional, tyro.conf.arg(metavar="[TEXT]")] = None
    """What is looked for: "red can". Or use --image, --point or --box. Without any of them, everything in a
    run of `gsjax deform` is labelled."""
    camera: Annotated[str | None, tyro.conf.arg(metavar="ID")] = None
    """Camera (or photograph) to show it from, and of a --point. Default: for a tracked run the first held-out
    one, else the first; for a field all."""
    weights: Path | None = None
    """Folder of CLIP's weights, in the layout of Hugging Face; for features of CLIP, where they are now."""
    gaussians: Annotated[GaussianOptions, tyro.conf.OmitArgPrefixes] = GaussianOptions()
    """For a field, or a run of `gsjax deform`."""
    field: Annotated[FieldOptions, tyro.conf.OmitArgPrefixes] = FieldOptions()
    """For a field alone."""
    deform: Annotated[DeformOptions, tyro.conf.OmitArgPrefixes] = DeformOptions()
    """For a run of `gsjax deform` alone."""
    track: Annotated[TrackOptions, tyro.conf.OmitArgPrefixes] = TrackOptions()
    """For a run of `gsjax track` alone, when its objects are looked for and not its field."""


def run(options: Options) -> int:
    """Answer, and write query/ into the run folder; returns the exit code.

    Raises:
        ValueError, OSError: there is no such run or encoder, or the text means none of the objects.
    """
    expect_folder(options.run)
    console, field = Console(stderr=True, highlight=False), field_of(options.run)
    # A tracked run answers over time, but not the queries that need a field.
    tracked = (options.run / "trajectory.npz").is_file()
    needs_field = _first_given(options.gaussians, options.field) is not None
    try:
        if (options.run / DEFORMATION).is_file():
            return _ask_deformation(options, console)
        if (name := _first_given(options.deform)) is not None:
            raise ValueError(f"--{name}: is for a run of `gsjax deform`, which {options.run} is not")
        if field is not None and not (tracked and not needs_field):
            return _ask_field(options, field, console)
        if field is None and not tracked:
            _expect_track(options.run)
        ask_for_object(_asked(options), console)
    except USER_ERRORS as error:
        folder = options.run / "query"
        if not (folder / "query.json").is_file():
            raise
        raise ValueError(f"{describe(error)} ({folder} still has an earlier answer)") from error
    return 0


def _first_given(*groups: Any) -> str | None:
    """The first option of some groups that is given, if one is."""
    given = ((field.name, getattr(group, field.name)) for group in groups for field in fields(group))
    return next((name for name, value in given if value is not None), None)


def _expect_track(path: Path) -> None:
    """Raises a ValueError where a run has no field (yet), and is not a run of `gsjax track` either."""
    unfinished = unfinished_field_of(path)
    if unfinished is not None:
        raise ValueError(
            f"{unfinished}: expected field.npz, found none yet: it is still being distilled, or was killed; "
            "then gsjax distill goes on with --resume"
        )
    if not is_run(path):
        return
    if "deform" in read_config(path / "config.yml"):
        raise ValueError(
            f"{path}: expected {DEFORMATION}, found none yet: it is still being reconstructed, or "
            "was killed; then gsjax deform goes on with --resume"
        )
    try:
        kind = read_record(path).kind
    except ValueError:
        kind = "another"
    if kind != "track":
        raise ValueError(f"{path}: expected a field, found none; gsjax distill {path} makes one")


def _ask_field(options: Options, field: Path, console: Console) -> int:
    """Query a field."""
    begun = perf_counter()
    question, changes = _question(options), _changes(options)
    folder = options.run / "query"
    with Notes(console) as notes:
        with stage(console, "reading the field"):
            now = Whereabouts(options.field.scene, options.field.images, options.weights)
            found = open_field_run(field, notes, now)
        told = answer(found, question, changes, folder, notes, console)
    _print(question.words, found.unit, "photographs", told, perf_counter() - begun)
    print(f"scene     {found.file}")
    print(f"query     {folder}: selection.npz, object.ply{', overview.png' if told['pixels'] else ''}")
    return 0


def _ask_deformation(options: Options, console: Console) -> int:
    """Answer by what a deforming scene has learned."""
    begun, folder = perf_counter(), options.run / "query"
    question, changes = _question_of_deformation(options), _changes(options)
    with Notes(console) as notes:
        with stage(console, "reading the scene"):
            result = read_deformation(options.run / DEFORMATION)
        warn_of_partial(options.run, notes)
        told = answer_deformation(options.run, result, question, changes, folder, notes, console)
    if "classes" in told:
        found = ", ".join(f"{name}: {count:,}" for name, count in told["classes"].items())
        print(f"{'found':<10}{found} of {told['of']:,} Gaussians, in frame {told['frame']}")
    else:
        _print(question.words, "m" if result.timeline.metric else "", "frames", told, perf_counter() - begun)
    print(f"query     {folder}: selection.npz, recolored.ply, frames/, masks/, video.mp4")
    return 0


def _print(words: str, unit: str, seen_in: str, told: dict[str, Any], seconds: float) -> None:
    """What was found, in a few lines."""
    meant = f", {told['meant']!r}" if told["meant"] and told["meant"] != told["text"] else ""
    against = f", against {', '.join(told['against'][:_LISTED])}" if told["against"] else ""
    unit = f" {unit}" if unit else ""
    rows = {
        "found": f"{words}{meant}: {told['gaussians']:,} of {told['of']:,} Gaussians",
        "centre": ", ".join(f"{x:.3f}" for x in told["center"]) + unit,
        "size": " x ".join(f"{x:.3f}" for x in told["size"]) + unit,
        "score": f"above {told['threshold']:.2f} ({told['rule']}), {told['best_score']:.2f} at best{against}",
    }
    if pixels := told["pixels"]:
        unseen = [name for name, count in pixels.items() if not count]
        more = ", ..." if len(unseen) > _LISTED else ""
        rows["seen"] = f"in {len(pixels) - len(unseen)} of {len(pixels)} {seen_in}" + (
            f"; not in {', '.join(unseen[:_LISTED])}{more}" if unseen else ""
        )
    rows["time"] = f"{seconds:.1f} s, of which the query took {1e3 * told['query_seconds']:.1f} ms"
    for name, row in rows.items():
        print(f"{name:<10}{row}")


def _changes(options: Options) -> Changes:
    """The changes to what was found, checked."""
    color, move = options.gaussians.color, options.gaussians.move
    if color is not None and any(not 0 <= value <= 1 for value in color):
        raise ValueError(f"--color: expected three numbers of 0 to 1, found {_spaced(color)}")
    if move is not None and not all(map(math.isfinite, move)):
        raise ValueError(f"--move: expected three finite numbers, found {_spaced(move)}")
    return Changes(color or _COLOR, move)


def _numbers(option: str, text: str, wanted: str) -> tuple[float, ...]:
    """Numbers with commas between them, as many as `wanted` ("X,Y") names.

    Raises:
        ValueError: it is none of these.
    """
    try:
        found = tuple(float(part) for part in text.split(","))
    except ValueError:
        found = ()
    if len(found) != wanted.count(",") + 1:
        raise ValueError(f"{option}: expected {wanted} in pixels, found {text!r}")
    return found


def _question_of_deformation(options: Options) -> DeformQuestion:
    """What is asked of a scene that deforms, checked.

    Raises:
        ValueError: more than one of text, point and box, or options that such a scene has no use for.
    """
    asked, deform = options.gaussians, options.deform
    others = {"camera": options.camera, **vars(options.field)}
    others |= {n: v for n, v in vars(options.track).items() if v != getattr(TrackOptions(), n)}
    if unused := [name for name, value in others.items() if value is not None]:
        name = unused[0].replace("_", "-")
        raise ValueError(f"--{name}: a run of `gsjax deform` has no use for it; leave it out")
    if sum(way is not None for way in (options.text, asked.point, deform.box)) > 1:
        raise ValueError("expected at most one of TEXT, --point and --box, found more")
    if options.text is None and (asked.negatives is not None or options.weights is not None):
        option = "negatives" if asked.negatives is not None else "weights"
        raise ValueError(f"--{option}: expected a TEXT too, which it is for; found none")
    point = None if asked.point is None else _numbers("--point", asked.point, "X,Y")
    box = None if deform.box is None else _numbers("--box", deform.box, "X0,Y0,X1,Y1")
    told = (asked.threshold, asked.negatives, options.weights)
    return DeformQuestion(options.text, point, box, deform.frame, deform.frames, *told)


def _question(options: Options) -> Question:
    """The query of a field, checked.

    Raises:
        ValueError: not one of text, --image and --point, or options that do not apply to a field.
    """
    asked, image = options.gaussians, options.field.image
    ways = [options.text is not None, image is not None, asked.point is not None]
    if sum(ways) != 1:
        raise ValueError(
            f"expected one of TEXT, --image and --point, found {sum(ways) or 'none'}; "
            f"gsjax query {options.run} can"
        )
    if options.track != TrackOptions():
        raise ValueError(
            "--encoder, --min-score: a field knows who made its features; leave them out (--threshold)"
        )
    point = None if asked.point is None else _numbers("--point", asked.point, "X,Y")
    if point is not None and options.camera is None:
        raise ValueError("--point: expected --camera too, the photograph that it is in, found none")
    if asked.threshold is not None and not -math.inf < asked.threshold < _HIGHEST:
        raise ValueError(
            f"--threshold: expected a finite number below {_HIGHEST:g}, which no score is above, found "
            f"{asked.threshold:g}"
        )
    return Question(options.text, image, point, options.camera, asked.negatives, asked.threshold)


def _spaced(numbers: tuple[float, ...]) -> str:
    return " ".join(f"{number:g}" for number in numbers)


def _asked(options: Options) -> ObjectQuery:
    """What is asked of a tracked run, checked.

    Raises:
        ValueError: it cannot be asked of one.
    """
    if (name := _first_given(options.gaussians, options.field)) is not None:
        raise ValueError(
            f"--{name}: {options.run} has no field that could be asked so; gsjax distill {options.run} "
            "makes one"
        )
    if options.text is None:
        raise ValueError(
            f'expected a TEXT that says which object, found none; gsjax query {options.run} "can"'
        )
    camera = None
    if options.camera is not None:
        if not options.camera.lstrip("-").isdigit():
            raise ValueError(f"--camera: expected the id of a camera, a number, found {options.camera!r}")
        camera = int(options.camera)
    told = options.track
    return ObjectQuery(
        run=options.run,
        text=options.text,
        camera=camera,
        encoder=told.encoder,
        weights=options.weights,
        min_score=told.min_score,
        debug=options.debug,
    )
