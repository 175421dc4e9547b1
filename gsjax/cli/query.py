"""`gsjax query`: what of a run a text means: an object of a tracked one, in every frame; or, where there is a
field (`gsjax distill`), Gaussians."""

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal

import tyro
from rich.console import Console

from gsjax.cli.field_query import Question, answer
from gsjax.cli.field_run import field_of, open_field_run
from gsjax.cli.messages import Notes
from gsjax.cli.object_query import Asked, ask_for_object
from gsjax.io.atomic import write_json


@dataclass(frozen=True)
class Options:
    """What `gsjax query` is told."""

    run: Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="RUN")]
    """Folder of a run of `gsjax track`, or of any run with a field (`gsjax distill`), or of such a field."""
    text: Annotated[str | None, tyro.conf.Positional, tyro.conf.arg(metavar="TEXT")] = None
    """What is looked for: "red can". Or say it by --image or --point."""
    camera: Annotated[str | None, tyro.conf.arg(metavar="ID")] = None
    """Camera (or photograph) to show it from, and in which a --point is. Of a tracked run the first held out
    one, else the first; of a field all, unless given."""
    image: Path | None = None
    """Of a field: a picture of what is looked for; of one with an alpha channel what is opaque."""
    point: Annotated[str | None, tyro.conf.arg(metavar="X,Y")] = None
    """Of a field: a pixel of --camera that shows what is looked for."""
    negatives: Annotated[tuple[str, ...] | None, tyro.conf.arg(metavar="TEXT [TEXT ...]")] = None
    """Of a field: what the text is held against. Of classes all others, of CLIP "object", "things",
    "stuff", "texture", unless given."""
    threshold: float | None = None
    """Of a field: score from which on a Gaussian is meant. 1/2 against negatives, else where the scores part
    best into two kinds (Otsu), unless given."""
    color: tuple[float, float, float] = (1.0, 0.25, 0.6)
    """Of a field: RGB, 0 to 1, of what was found in recolored.ply."""
    move: Annotated[tuple[float, float, float] | None, tyro.conf.arg(metavar="X Y Z")] = None
    """Of a field: metres by which what was found is moved in moved.ply; not written unless given."""
    encoder: Literal["closed", "clip"] = "closed"
    """Of a tracked run: who understands the text, a closed vocabulary without weights, or CLIP."""
    weights: Path | None = None
    """Folder of CLIP's weights, in the layout of Hugging Face; of a field, where they are now."""
    min_score: float | None = None
    """Of a tracked run: cosine below which the text means none of the objects. The encoder's own unless
    given."""
    debug: bool = False
    """Show Python's traceback when something fails."""


def run(options: Options) -> int:
    """Answer, and write query/ into the run folder; returns the exit code.

    Raises:
        ValueError, OSError: there is no such run or encoder, or the text means none of the objects.
    """
    console, field = Console(stderr=True, highlight=False), field_of(options.run)
    tracked = (options.run / "trajectory.npz").is_file()  # which answers over time, unless by sight
    if field is not None and not (tracked and options.image is None and options.point is None):
        return _ask_field(options, field, console)
    ask_for_object(_asked(options), console)
    return 0


def _ask_field(options: Options, field: Path, console: Console) -> int:
    """Answer by a field."""
    question = _question(options)
    with Notes(console) as notes:
        with console.status("reading the field"):
            found = open_field_run(field, notes)
        folder = options.run / "query"
        told = answer(found, question, folder, options.color, options.move, notes, console)
        write_json(folder / "query.json", told | {"features": found.stored.source.kind, "notes": notes.all})
    unseen = [name for name, pixels in told["pixels"].items() if not pixels]
    hidden = f"; not seen by {', '.join(unseen[:6])}{', ...' if len(unseen) > 6 else ''}" if unseen else ""
    score = f"score above {told['threshold']:.2f}: {told['rule']}"
    print(f"{told['gaussians']:,} of {told['of']:,} Gaussians ({score}){hidden}")
    print(f"asked in {1e3 * told['query_seconds']:.1f} ms")
    print(f"query   {folder}")
    return 0


def _question(options: Options) -> Question:
    """What is asked of a field, checked.

    Raises:
        ValueError: not one of text, --image and --point, or options that a field has no use for.
    """
    ways = [options.text is not None, options.image is not None, options.point is not None]
    if sum(ways) != 1:
        raise ValueError(
            f"expected one of TEXT, --image and --point, found {sum(ways) or 'none'}; "
            f'gsjax query {options.run} "red can"'
        )
    if options.encoder != "closed" or options.min_score is not None:
        raise ValueError(
            "--encoder, --min-score: a field knows who made its features; leave them out (--threshold)"
        )
    point = None
    if options.point is not None:
        try:
            x, y = (float(part) for part in options.point.split(","))
        except ValueError:
            raise ValueError(f"--point: expected X,Y in pixels, found {options.point!r}") from None
        point = (x, y)
        if options.camera is None:
            raise ValueError("--point: expected --camera too, the photograph that it is in, found none")
    if any(not 0 <= value <= 1 for value in options.color):
        raise ValueError(f"--color: expected three numbers of 0 to 1, found {options.color}")
    return Question(
        options.text,
        options.image,
        point,
        options.camera,
        options.negatives,
        options.threshold,
        options.weights,
    )


def _asked(options: Options) -> Asked:
    """What is asked of a tracked run, checked.

    Raises:
        ValueError: it cannot be asked of one.
    """
    for name in ("image", "point", "negatives", "threshold", "move"):
        if getattr(options, name) is not None:
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
    shared = (options.encoder, options.weights, options.min_score, options.debug)
    return Asked(options.run, options.text, camera, *shared)
