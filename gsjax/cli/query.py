"""`gsjax query`: what of a run a text means: an object of a tracked one, in every frame; or, where there is a
field (`gsjax distill`), Gaussians."""

import math
from dataclasses import dataclass, fields
from pathlib import Path
from time import perf_counter
from typing import Annotated, Any, Literal

import tyro
from rich.console import Console

from gsjax.cli.field_query import Changes, Question, answer
from gsjax.cli.field_run import FieldRun, Whereabouts, field_of, open_field_run, unfinished_field_of
from gsjax.cli.messages import USER_ERRORS, Notes, describe, stage
from gsjax.cli.object_query import Asked, ask_for_object
from gsjax.cli.run_folder import is_run
from gsjax.cli.run_records import read_record

HELP = (
    ' Of a run of `gsjax track` a text means an object, as in `gsjax query RUN "red can"`; of whatever has '
    "a field (`gsjax distill`) Gaussians, as in `gsjax query RUN/field can`. Where a tracked run has "
    "a field too, RUN/field asks that by text."
)
_COLOR = (1.0, 0.25, 0.6)
_HIGHEST = 1.0  # of a score: a cosine is within -1 and 1, a share against negatives within 0 and 1
_LISTED = 6  # photographs, at most


@dataclass(frozen=True)
class FieldOptions:
    """What only a field has a use for."""

    image: Path | None = None
    """A picture of what is looked for; of one with an alpha channel what is opaque."""
    point: Annotated[str | None, tyro.conf.arg(metavar="X,Y")] = None
    """A pixel of --camera that shows what is looked for."""
    negatives: Annotated[tuple[str, ...] | None, tyro.conf.arg(metavar="TEXT [TEXT ...]")] = None
    """What it is held against. A text is, of classes, against all others, of CLIP against "object", "things",
    "stuff", "texture", unless given."""
    threshold: float | None = None
    """Score above which a Gaussian is meant: a cosine (-1 to 1), or against negatives a share (0 to 1).
    Unless given, 1/2 against negatives; of a text of the closed vocabulary its own; else where the scores
    part best into two kinds (Otsu)."""
    color: Annotated[tuple[float, float, float] | None, tyro.conf.arg(metavar="R G B")] = None
    """RGB, 0 to 1, of what was found in recolored.ply; pink unless given."""
    move: Annotated[tuple[float, float, float] | None, tyro.conf.arg(metavar="X Y Z")] = None
    """By how much along each axis, in the scene's unit, what was found is moved in moved.ply; not written
    unless given."""
    scene: Annotated[Path | None, tyro.conf.arg(metavar="PLY")] = None
    """The file of its scene, where it is now. Found where it was, or beside the field, unless given."""
    images: Annotated[str | None, tyro.conf.arg(metavar="FOLDER")] = None
    """The photographs, where they are now."""


@dataclass(frozen=True)
class TrackOptions:
    """What only a run of `gsjax track` has a use for."""

    encoder: Literal["closed", "clip"] = "closed"
    """Who understands the text, a closed vocabulary without weights, or CLIP."""
    min_score: float | None = None
    """Cosine below which the text means none of the objects. The encoder's own unless given."""


@dataclass(frozen=True)
class Options:
    """What `gsjax query` is told."""

    run: Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="RUN")]
    """Folder of a run of `gsjax track`; of any run with a field (`gsjax distill`); or that holds field.npz.
    The answer is written to query/ in it, in place of an earlier one."""
    text: Annotated[str | None, tyro.conf.Positional, tyro.conf.arg(metavar="TEXT")] = None
    """What is looked for: "red can". Or say it by --image or --point."""
    camera: Annotated[str | None, tyro.conf.arg(metavar="ID")] = None
    """Camera (or photograph) to show it from, and in which a --point is. Of a tracked run the first held out
    one, else the first; of a field all, unless given."""
    weights: Path | None = None
    """Folder of CLIP's weights, in the layout of Hugging Face; of a field, where they are now."""
    debug: bool = False
    """Show Python's traceback when something fails."""
    field: Annotated[FieldOptions, tyro.conf.OmitArgPrefixes] = FieldOptions()
    """Of a field alone."""
    track: Annotated[TrackOptions, tyro.conf.OmitArgPrefixes] = TrackOptions()
    """Of a run of `gsjax track` alone, where its objects are asked for and not its field."""


def run(options: Options) -> int:
    """Answer, and write query/ into the run folder; returns the exit code.

    Raises:
        ValueError, OSError: there is no such run or encoder, or the text means none of the objects.
    """
    console, field = Console(stderr=True, highlight=False), field_of(options.run)
    # A tracked run answers over time, but not to what only fields can.
    tracked = (options.run / "trajectory.npz").is_file()
    try:
        if field is not None and not (tracked and _for_fields(options) is None):
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


def _for_fields(options: Options) -> str | None:
    """An option that only a field has a use for, if one is given."""
    given = options.field
    return next((field.name for field in fields(given) if getattr(given, field.name) is not None), None)


def _expect_track(path: Path) -> None:
    """Raises a ValueError where a run has no field (yet), and is none of `gsjax track` either."""
    unfinished = unfinished_field_of(path)
    if unfinished is not None:
        raise ValueError(
            f"{unfinished}: expected field.npz, found none yet: it is still being distilled, or was killed; "
            "then gsjax distill goes on with --resume"
        )
    if not is_run(path):
        return
    try:
        kind = read_record(path).kind
    except ValueError:
        kind = "another"
    if kind != "track":
        raise ValueError(f"{path}: expected a field, found none; gsjax distill {path} makes one")


def _ask_field(options: Options, field: Path, console: Console) -> int:
    """Answer by a field."""
    begun = perf_counter()
    question, changes = _question(options), Changes(options.field.color or _COLOR, options.field.move)
    folder = options.run / "query"
    with Notes(console) as notes:
        with stage(console, "reading the field"):
            now = Whereabouts(options.field.scene, options.field.images, options.weights)
            found = open_field_run(field, notes, now)
        told = answer(found, question, changes, folder, notes, console)
    _print(question, found, told, perf_counter() - begun)
    print(f"scene     {found.file}")
    print(f"query     {folder}: selection.npz, object.ply{', overview.png' if told['pixels'] else ''}")
    return 0


def _print(question: Question, run: FieldRun, told: dict[str, Any], seconds: float) -> None:
    """What was found, in a few lines."""
    unit = f" {run.unit}" if run.unit else ""
    meant = f", {told['meant']!r}" if told["meant"] else ""
    against = f", against {', '.join(told['against'][:_LISTED])}" if told["against"] else ""
    rows = {
        "found": f"{question.words}{meant}: {told['gaussians']:,} of {told['of']:,} Gaussians",
        "centre": ", ".join(f"{x:.3f}" for x in told["center"]) + unit,
        "size": " x ".join(f"{x:.3f}" for x in told["size"]) + unit,
        "score": f"above {told['threshold']:.2f} ({told['rule']}), {told['best_score']:.2f} at best{against}",
    }
    if pixels := told["pixels"]:
        unseen = [name for name, count in pixels.items() if not count]
        more = ", ..." if len(unseen) > _LISTED else ""
        rows["seen"] = f"in {len(pixels) - len(unseen)} of {len(pixels)} photographs" + (
            f"; not in {', '.join(unseen[:_LISTED])}{more}" if unseen else ""
        )
    rows["time"] = f"{seconds:.1f} s, of which the query took {1e3 * told['query_seconds']:.1f} ms"
    for name, words in rows.items():
        print(f"{name:<10}{words}")


def _question(options: Options) -> Question:
    """What is asked of a field, checked.

    Raises:
        ValueError: not one of text, --image and --point, or options that a field has no use for.
    """
    asked = options.field
    ways = [options.text is not None, asked.image is not None, asked.point is not None]
    if sum(ways) != 1:
        raise ValueError(
            f"expected one of TEXT, --image and --point, found {sum(ways) or 'none'}; "
            f"gsjax query {options.run} can"
        )
    if options.track != TrackOptions():
        raise ValueError(
            "--encoder, --min-score: a field knows who made its features; leave them out (--threshold)"
        )
    point = None
    if asked.point is not None:
        try:
            x, y = (float(part) for part in asked.point.split(","))
        except ValueError:
            raise ValueError(f"--point: expected X,Y in pixels, found {asked.point!r}") from None
        point = (x, y)
        if options.camera is None:
            raise ValueError("--point: expected --camera too, the photograph that it is in, found none")
    if asked.color is not None and any(not 0 <= value <= 1 for value in asked.color):
        raise ValueError(f"--color: expected three numbers of 0 to 1, found {_spaced(asked.color)}")
    if asked.move is not None and not all(map(math.isfinite, asked.move)):
        raise ValueError(f"--move: expected three finite numbers, found {_spaced(asked.move)}")
    if asked.threshold is not None and not -math.inf < asked.threshold < _HIGHEST:
        raise ValueError(
            f"--threshold: expected a finite number below {_HIGHEST:g}, which no score is above, found "
            f"{asked.threshold:g}"
        )
    return Question(options.text, asked.image, point, options.camera, asked.negatives, asked.threshold)


def _spaced(numbers: tuple[float, ...]) -> str:
    return " ".join(f"{number:g}" for number in numbers)


def _asked(options: Options) -> Asked:
    """What is asked of a tracked run, checked.

    Raises:
        ValueError: it cannot be asked of one.
    """
    if (name := _for_fields(options)) is not None:
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
    return Asked(
        options.run, options.text, camera, told.encoder, options.weights, told.min_score, options.debug
    )
