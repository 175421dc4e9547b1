"""The options that commands share: a name means the same in every command."""

import dataclasses
import inspect
from dataclasses import dataclass, field
from importlib import import_module
from itertools import product
from pathlib import Path
from typing import get_args, get_origin, get_type_hints

import pytest
import tyro

from gsjax.cli import COMMANDS
from gsjax.engine.options import (
    Common,
    HeldOutFrames,
    SamWeights,
    Seeded,
    Selection,
    Timed,
    checked,
    preset_options,
)

SHARED = ("frames", "cameras", "eval_cameras", "test_every", "scale", "seed", "minutes", "read")
SHARED += ("dataset", "mask_camera", "masks", "sam", "weights", "encoder", "min_score")
SHARED += ("resume", "overwrite", "cores", "debug")
OWN = {
    ("query", "frames"),  # the frames to draw; the run has chosen its own
    ("fit", "scale"),  # None chooses a moderate size
    ("live", "minutes"),  # of a stream, which otherwise has no end
    ("parts", "masks"),  # of the anchor, in all cameras
    ("distill", "masks"),  # of every photograph
    ("deform", "masks"),  # of every frame
    ("query", "weights"),  # also where the weights are now, for a field that CLIP taught
    ("view", "weights"),  # only where the weights are now
    ("export", "frames"),  # of a scene; a run has chosen its own
    ("export", "overwrite"),  # of a file
}


def options_of(command: str) -> list[type]:
    """The dataclasses of a command's options: one, or one per subcommand."""
    kinds = import_module(COMMANDS[command][0]).Options
    members = [kinds] if isinstance(kinds, type) else get_args(kinds)
    return [get_args(m)[0] if get_origin(m) else m for m in members]


def groups_of(kind: type) -> list[type]:
    """The dataclass, and those nested in it whose options have no prefix."""
    hints = get_type_hints(kind, include_extras=True).values()
    return [kind, *(get_args(h)[0] for h in hints if tyro.conf.OmitArgPrefixes in get_args(h))]


def home_of(kind: type, name: str) -> type:
    """The class that declares a field."""
    return next(c for c in kind.__mro__ if name in inspect.get_annotations(c))


@pytest.mark.parametrize("command", [name for name in COMMANDS if name != "experiment"])
def test_what_commands_share_is_declared_once(command):
    for kind in options_of(command):
        assert issubclass(kind, Common)
        for group, name in product(groups_of(kind), SHARED):
            if (command, name) not in OWN and name in {f.name for f in dataclasses.fields(group)}:
                assert home_of(group, name).__module__ == "gsjax.engine.options", f"gsjax {command}: {name}"


@dataclass(frozen=True)
class Config:
    size: int = 1
    seed: int = 0


@dataclass(frozen=True, kw_only=True)
class Options(Common, Timed, Seeded, HeldOutFrames, Selection):
    first: Config = field(default_factory=Config)
    second: Config = Config(2)


@dataclass(frozen=True, kw_only=True)
class Taught(SamWeights):
    masks: str = "auto"


def test_a_seed_is_that_of_every_configuration():
    assert checked(Options(first=Config(seed=3))).first == Config(seed=3)
    seeded = checked(Options(seed=5, first=Config(seed=3)))
    assert (seeded.first, seeded.second) == (Config(1, 5), Config(2, 5))


@pytest.mark.parametrize(
    ("given", "said"),
    [
        ({"minutes": 0.0}, "--minutes: expected more than 0, found 0.0"),
        ({"minutes": float("nan")}, "--minutes: expected more than 0, found nan"),
        ({"scale": 1.5}, "--scale: expected above 0 and at most 1, found 1.5"),
        ({"test_every": 1}, "--test-every: expected 0 .none., or 2 or more, found 1"),
    ],
)
def test_what_cannot_be_is_said(given, said):
    with pytest.raises(ValueError, match=said):
        checked(Options(**given))


def test_sam_does_not_read_files():
    with pytest.raises(ValueError, match="--sam: expected --masks segment"):
        checked(Taught(sam=Path("sam"), masks="files"))
    assert checked(Taught(masks="files")).masks == "files"


@pytest.mark.parametrize("words", [["--preset", "large"], ["x", "--preset=large"]])
def test_a_preset_changes_the_defaults(words):
    kind, left = preset_options(Options, words, "first", {"large": Config(9)})
    assert (kind().first, kind().second, left) == (Config(9), Config(2), words)
    assert kind(first=Config(4)).first == Config(4)


def test_without_a_known_preset_nothing_changes():
    for words in ([], ["--preset", "unknown"], ["--preset"]):
        assert preset_options(Options, words, "first", {"large": Config(9)}) == (Options, words)
