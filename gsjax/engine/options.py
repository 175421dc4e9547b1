"""Options that commands share: each has one name, one meaning and one help text. A command's `Options`
inherits those that it uses, and adds its own."""

import dataclasses
from collections.abc import Mapping
from dataclasses import dataclass, field, is_dataclass, make_dataclass, replace
from itertools import pairwise
from pathlib import Path
from typing import Annotated, Any, Literal, TypeVar

import tyro

from gsjax.data import ReadOptions

AnyOptions = TypeVar("AnyOptions")
Ids = Annotated[tuple[int, ...], tyro.conf.arg(metavar="ID [ID ...]")]
Frames = Annotated[str, tyro.conf.arg(metavar="START:STOP[:STEP]", help_behavior_hint="(default: all)")]

RESUME_MAY_CHANGE = ("out", "minutes", "resume", "overwrite", "cores", "debug")
"""Options that do not affect what is computed, so that a run may be resumed with others."""


@dataclass(frozen=True, kw_only=True)
class Common:
    """Options of every command."""

    cores: int | None = None
    """Number of processor cores to use (the highest-numbered ones); default: all. The tracker's update
    times vary least on 1. To run two programs at once, give each its own cores with taskset."""
    debug: bool = False
    """Show Python's traceback when something fails."""


@dataclass(frozen=True, kw_only=True)
class Overwriting:
    """Options of commands that write a folder."""

    overwrite: bool = False
    """Replace what an earlier run left in the same folder, and what was made from it since: a field,
    films."""


@dataclass(frozen=True, kw_only=True)
class Resuming(Overwriting):
    """Options of commands that can be stopped and resumed."""

    resume: bool = False
    """Resume the unfinished run in this folder; repeat the options that it was started with."""


@dataclass(frozen=True, kw_only=True)
class Timed:
    """Options of commands that learn step by step."""

    minutes: float | None = None
    """Time for the whole command, reading, compiling, scores and report included. The first run on a machine
    compiles for a minute or so; later ones find the compiled programs. With --resume, earlier steps count."""


@dataclass(frozen=True, kw_only=True)
class Seeded:
    """Options of commands that draw random numbers."""

    seed: int | None = None
    """Random seed, which replaces those of the settings, such as --fit.seed; default: 0."""


@dataclass(frozen=True, kw_only=True)
class Reading:
    """Options of commands that read a dataset."""

    read: ReadOptions = field(default_factory=ReadOptions)
    """Details that the layout of the data leaves open."""


@dataclass(frozen=True, kw_only=True)
class Selection(Reading):
    """The part of a recording to use."""

    frames: Frames = ":"
    """Frames, or photographs, to use, as a Python slice: 0:60, 0:60:2, :30; 4:5 is the fifth alone."""
    cameras: Ids = ()
    """Ids of the cameras to use; default: all that are not held out."""
    scale: float = 1.0
    """Size of the pictures (width and height) relative to the original, for example 0.5; time is
    proportional to the number of pixels."""


@dataclass(frozen=True, kw_only=True)
class HeldOut:
    """What is held out for evaluation."""

    eval_cameras: Ids = ()
    """Ids of cameras to hold out: they are used for evaluation only."""


@dataclass(frozen=True, kw_only=True)
class HeldOutFrames(HeldOut):
    """As `HeldOut`, where frames or photographs may be held out too."""

    test_every: int = 8
    """Hold out every N-th photograph or frame for evaluation, if the data has no split; 0 holds out none."""


@dataclass(frozen=True, kw_only=True)
class FirstMasks:
    """Options of commands that track the objects of a first mask."""

    mask_camera: Annotated[int | None, tyro.conf.arg(metavar="ID")] = None
    """Id of the tracked camera whose first mask names the objects; default: the first that has masks (with a
    picture of your own, the first)."""
    masks: Literal["auto", "files", "segment"] | Path = "auto"
    """Source of the first mask: the files, a segmenter without weights, or (auto) the first available; or a
    picture of your own, of that camera's first tracked frame: a label for each pixel, 0 for background."""


@dataclass(frozen=True, kw_only=True)
class SamWeights:
    """Options of commands that can segment with SAM."""

    sam: Path | None = None
    """Folder of SAM's weights (such as facebook/sam-vit-base), to segment with SAM instead of the segmenter
    without weights. Requires the extra `foundation`."""


@dataclass(frozen=True, kw_only=True)
class ClipWeights:
    """Options of commands that can use CLIP."""

    weights: Path | None = None
    """Folder of the weights of CLIP, or of SigLIP, in the layout of Hugging Face."""


@dataclass(frozen=True, kw_only=True)
class ObjectText:
    """How a text is matched to an object of a tracked run."""

    encoder: Literal["closed", "clip"] = "closed"
    """Text encoder: a closed vocabulary without weights, or CLIP."""
    min_score: float | None = None
    """Cosine similarity below which the text matches none of the objects; default: the encoder's own."""


@dataclass(frozen=True)
class DatasetAndOut:
    """The dataset, and the folder of the run."""

    dataset: Annotated[str, tyro.conf.Positional, tyro.conf.arg(metavar="DATASET")]
    """Folder of a recording or of photographs, or a built-in scene such as simulated:tabletop."""
    out: Path
    """Folder for the run: a new one, or that of an earlier run with --resume or --overwrite."""


@dataclass(frozen=True, kw_only=True)
class OfRecording(Common, Resuming, HeldOut, Selection, DatasetAndOut):
    """Options of commands that make a run from a recording."""


@dataclass(frozen=True, kw_only=True)
class OfDataset(Common, Resuming, Timed, Seeded, HeldOutFrames, Selection, DatasetAndOut):
    """Options of commands that train on a dataset and write a run."""


def checked(options: AnyOptions) -> AnyOptions:
    """The options, with `--seed` copied into each configuration that has a seed.

    Raises:
        ValueError: a shared option is out of range.
    """
    expect_positive(options, "minutes")
    test_every = getattr(options, "test_every", 0)
    scale = getattr(options, "scale", 1.0)
    if scale is not None and not 0 < scale <= 1:
        raise ValueError(f"--scale: expected above 0 and at most 1, found {scale}")
    if test_every < 0 or test_every == 1:
        raise ValueError(f"--test-every: expected 0 (none), or 2 or more, found {test_every}")
    if getattr(options, "sam", None) is not None and getattr(options, "masks", None) == "files":
        raise ValueError("--sam: expected --masks segment, as SAM is a segmenter; found --masks files")
    if (seed := getattr(options, "seed", None)) is None:
        return options
    nested = {f.name: getattr(options, f.name) for f in dataclasses.fields(options)}
    seeded = {n: replace(c, seed=seed) for n, c in nested.items() if is_dataclass(c) and hasattr(c, "seed")}
    return replace(options, **seeded)


def expect_positive(options: Any, *names: str) -> None:
    """Raises ValueError if one of these options is given and not above 0."""
    for name in names:
        value = getattr(options, name, None)
        if value is not None and not value > 0:
            raise ValueError(f"--{name.replace('_', '-')}: expected more than 0, found {value}")


def preset_options(
    kind: type[AnyOptions], arguments: list[str], name: str, presets: Mapping[str, Any]
) -> tuple[type[AnyOptions], list[str]]:
    """The options, with the defaults of the preset that is named, if any.

    Args:
        kind: the command's options.
        arguments: those of the command line.
        name: the field that holds the configuration.
        presets: configurations by the names that `--preset` takes.

    Returns:
        The class of options, and the arguments to parse.
    """
    named = [word for before, word in pairwise(arguments) if before == "--preset"]
    named += [a.removeprefix("--preset=") for a in arguments if a.startswith("--preset=")]
    if not named or named[-1] not in presets:  # tyro reports an unknown one
        return kind, arguments
    chosen = presets[named[-1]]
    changed = (name, type(chosen), field(default=chosen, kw_only=True))
    return make_dataclass("Options", [changed], bases=(kind,), frozen=True), arguments
