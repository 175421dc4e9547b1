"""What commands are told alike: an option has one name, one meaning and one line of help, whichever command
it is given to. A command's `Options` inherits what it has a use for, and adds its own."""

import dataclasses
from collections.abc import Mapping
from dataclasses import dataclass, field, is_dataclass, make_dataclass, replace
from itertools import pairwise
from pathlib import Path
from typing import Annotated, Any, Literal, TypeVar

import tyro

from gsjax.data import ReadOptions

Told = TypeVar("Told")
Ids = Annotated[tuple[int, ...], tyro.conf.arg(metavar="ID [ID ...]")]
Frames = Annotated[str, tyro.conf.arg(metavar="START:STOP[:STEP]")]

RESUME_MAY_CHANGE = ("out", "minutes", "resume", "overwrite", "cores", "debug")
"""On what is computed: a run may be resumed with others."""


@dataclass(frozen=True, kw_only=True)
class Common:
    """What every command has."""

    cores: int | None = None
    """How many of the processor's cores to use, for everything; the tracker's updates are steadiest on 1. All
    unless given. They are the last ones: for two programs at once, taskset each to its own."""
    debug: bool = False
    """Show Python's traceback when something fails."""


@dataclass(frozen=True, kw_only=True)
class Overwriting:
    """What those have that write a folder of their own."""

    overwrite: bool = False
    """Replace what an earlier run left in the same folder, and what was made of it since: a field, films."""


@dataclass(frozen=True, kw_only=True)
class Resuming(Overwriting):
    """What those have that may be stopped and go on."""

    resume: bool = False
    """Go on with the unfinished run in the same folder, given the same options."""


@dataclass(frozen=True, kw_only=True)
class Timed:
    """What those have that learn step by step."""

    minutes: float | None = None
    """Stop after so many minutes of steps, compiling included; what was learned by then is scored and
    written. The first run on a machine compiles for a minute or so; programs are kept for later ones."""


@dataclass(frozen=True, kw_only=True)
class Seeded:
    """What those have that draw at random."""

    seed: int | None = None
    """Of all that is random; 0 unless given."""


@dataclass(frozen=True, kw_only=True)
class Reading:
    """How a dataset is read."""

    read: ReadOptions = field(default_factory=ReadOptions)
    """What the layout of the data leaves open."""


@dataclass(frozen=True, kw_only=True)
class Selection(Reading):
    """Which part of a recording is looked at."""

    frames: Frames = ":"
    """Which frames, or photographs, as Python slices them: 0:60, 0:60:2, :30; 4:5 is the fifth alone."""
    cameras: Ids = ()
    """Ids of the cameras to look through. All that are not held out, unless given."""
    scale: float = 1.0
    """Look at pictures at this fraction of their size (width and height), as in 0.5; time goes with the
    number of pixels."""


@dataclass(frozen=True, kw_only=True)
class HeldOut:
    """What is kept from the method, to judge it by."""

    eval_cameras: Ids = ()
    """Ids of cameras that are held out: only judged, in the end."""


@dataclass(frozen=True, kw_only=True)
class HeldOutFrames(HeldOut):
    """The same where frames, or photographs, may be held out too."""

    test_every: int = 8
    """Hold out every N-th photograph or frame, to judge by, where the data has no split; 0 holds out none."""


@dataclass(frozen=True, kw_only=True)
class FirstMasks:
    """What those have that follow what a first mask names."""

    mask_camera: Annotated[int | None, tyro.conf.arg(metavar="ID")] = None
    """Id of the tracked camera whose first mask names the objects. The first that has masks, unless given."""
    masks: Literal["auto", "files", "segment"] = "auto"
    """Who makes the first mask: the files, a segmenter without weights, or (auto) the first there is."""


@dataclass(frozen=True, kw_only=True)
class SamWeights:
    """What those have that may let SAM segment."""

    sam: Path | None = None
    """Folder of SAM's weights (as of facebook/sam-vit-base): let it segment, and not the segmenter that needs
    none. Takes the extra `foundation`."""


@dataclass(frozen=True, kw_only=True)
class ClipWeights:
    """What those have that may ask CLIP."""

    weights: Path | None = None
    """Folder of CLIP's weights, in the layout of Hugging Face."""


@dataclass(frozen=True, kw_only=True)
class ObjectText:
    """How a text is understood that means an object of a tracked run."""

    encoder: Literal["closed", "clip"] = "closed"
    """Who understands the text: a closed vocabulary without weights, or CLIP."""
    min_score: float | None = None
    """Cosine below which the text means none of the objects. The encoder's own unless given."""


@dataclass(frozen=True)
class OneDataset:
    """From what."""

    dataset: Annotated[str, tyro.conf.Positional, tyro.conf.arg(metavar="DATASET")]
    """Folder of a recording or of photographs, or a built-in scene such as simulated:tabletop."""


@dataclass(frozen=True)
class DatasetAndOut(OneDataset):
    """From what, to where."""

    out: Path
    """Folder for the run: a new one, or that of an earlier run with --resume or --overwrite."""


@dataclass(frozen=True, kw_only=True)
class OfRecording(Common, Resuming, HeldOut, Selection, DatasetAndOut):
    """What those have that make a run of a recording."""


@dataclass(frozen=True, kw_only=True)
class OfDataset(Common, Resuming, Timed, Seeded, HeldOutFrames, Selection, DatasetAndOut):
    """What those have that make a run of a dataset by learning, step by step."""


def checked(options: Told) -> Told:
    """The options, with `--seed` in each configuration that has one.

    Raises:
        ValueError: one that commands share cannot be.
    """
    expect_positive(options, "minutes")
    test_every = getattr(options, "test_every", 0)
    scale = getattr(options, "scale", 1.0)
    if not 0 < scale <= 1:
        raise ValueError(f"--scale: expected above 0 and at most 1, found {scale}")
    if test_every < 0 or test_every == 1:
        raise ValueError(f"--test-every: expected 0 (none) or 2 and more, found {test_every}")
    if getattr(options, "sam", None) is not None and getattr(options, "masks", None) == "files":
        raise ValueError("--sam: expected --masks segment, for SAM is a segmenter; found --masks files")
    if (seed := getattr(options, "seed", None)) is None:
        return options
    nested = {f.name: getattr(options, f.name) for f in dataclasses.fields(options)}
    seeded = {n: replace(c, seed=seed) for n, c in nested.items() if is_dataclass(c) and hasattr(c, "seed")}
    return replace(options, **seeded)


def expect_positive(options: Any, *names: str) -> None:
    """Raises ValueError where one of these options is given, and not above 0."""
    for name in names:
        value = getattr(options, name, None)
        if value is not None and not value > 0:
            raise ValueError(f"--{name.replace('_', '-')}: expected more than 0, found {value}")


def preset_options(
    kind: type[Told], arguments: list[str], name: str, presets: Mapping[str, Any]
) -> tuple[type[Told], list[str]]:
    """The options whose configuration is that of the preset that is named, where one is.

    Args:
        kind: the command's options.
        arguments: what is given on the command line.
        name: of the field that is the configuration.
        presets: configurations, by the names that `--preset` has for them.

    Returns:
        The options, and the arguments to parse.
    """
    named = [word for before, word in pairwise(arguments) if before == "--preset"]
    named += [a.removeprefix("--preset=") for a in arguments if a.startswith("--preset=")]
    if not named or named[-1] not in presets:  # tyro says what there is
        return kind, arguments
    chosen = presets[named[-1]]
    changed = (name, type(chosen), field(default=chosen, kw_only=True))
    return make_dataclass("Options", [changed], bases=(kind,), frozen=True), arguments
