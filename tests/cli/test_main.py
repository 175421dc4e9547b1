"""The entry point of the command line: help, unknown commands, `gsjax info`, errors and warnings."""

import os
import re
import subprocess
import sys
import warnings
from dataclasses import replace

import equinox as eqx
import numpy as np
import pytest
from rich.console import Console

from gsjax.cli import COMMANDS, main
from gsjax.data import DataWarning
from gsjax.engine.messages import Notes, describe
from gsjax.io.ply import write_ply
from gsjax.methods.track import PRESETS, TrackConfig
from gsjax.scene.gaussians import gaussians_from_activated


@pytest.fixture
def say(capfd):
    def call(*arguments: str) -> tuple[int, str, str]:
        code = main(arguments)
        return code, *capfd.readouterr()

    return call


@pytest.mark.parametrize("arguments", [(), ("--help",), ("-h",)])
def test_help_names_every_command(say, arguments):
    code, out, _ = say(*arguments)
    assert code == 0
    assert all(f"gsjax {name}" in out for name in COMMANDS)


def test_version(say):
    assert say("--version")[1].startswith("gsjax 0.")


def test_unknown_command(say):
    code, _, err = say("trakc")
    assert code == 2
    assert "no command 'trakc'; did you mean track? There are: info, poses, " in err
    assert "no command 'xyz'; there are: info, poses, " in say("xyz")[2]


@pytest.mark.thorough
@pytest.mark.parametrize("arguments", [["--version"], ["track", "--help"]])
def test_it_ends_quietly_where_nobody_reads(arguments):
    reads, writes = os.pipe()
    os.close(reads)
    ended = subprocess.run(
        [sys.executable, "-m", "gsjax.cli", *arguments], stdout=writes, stderr=subprocess.PIPE
    )
    os.close(writes)
    assert (ended.returncode, ended.stderr) == (0, b"")


@pytest.mark.parametrize("command", list(COMMANDS))
def test_every_option_is_explained(say, capfd, command):
    with pytest.raises(SystemExit) as stopped:
        say(command, "--help")
    assert stopped.value.code == 0
    out = capfd.readouterr().out
    opens = {"track": "DATASET", "info": "DATASET", "query": "RUN [TEXT]", "grasp": "RUN TEXT"}
    assert opens.get(command, "") in out
    # An option without help: its value, two spaces or a new line, then directly its default.
    assert not re.findall(r"│ --[\w.-]+(?: \S+)*(?:  +|\s*│\n│\s+)\((?:default|required)", out)
    if command == "track":
        assert "--track.refine.iterations" in out


def test_missing_option_is_named(say, capfd):
    with pytest.raises(SystemExit) as stopped:
        say("track", "simulated:tabletop")
    assert stopped.value.code == 2
    assert "--out" in capfd.readouterr().err


def test_debug_shows_where_it_failed(tmp_path):
    with pytest.raises(FileNotFoundError, match="expected a dataset, a run or a file"):
        main(["info", str(tmp_path / "nowhere"), "--debug"])


def test_info_of_a_ply_file_says_what_it_holds_and_what_is_odd(say, tmp_path):
    means, quats = np.arange(12.0).reshape(4, 3), np.eye(4)[:1].repeat(4, 0)
    gaussians = gaussians_from_activated(means, quats, np.full((4, 3), 0.1), np.full(4, 0.5), np.ones((4, 3)))
    gaussians = eqx.tree_at(lambda g: g.means, gaussians, gaussians.means.at[0, 1].set(np.nan))
    file, origin = tmp_path / "scene.ply", np.array([5e5, 5e6, 0])
    write_ply(file, gaussians, labels=np.array([7, 0, 2, 2]), origin=origin, antialiased=True)
    code, out, err = say("info", str(file))
    assert code == 0
    for said in ("3 of 4", "degree 0", "antialiased", "0, 2", "(500006, 5000007, 8)", "500003"):
        assert said in out, out
    assert "1 of 4 Gaussians cannot be drawn" in err
    assert "coordinates reach 5e+06" in err
    code, _, err = say("info", str(file), "--picture", "cameras.png")
    assert code == 2
    assert "--picture: draws the cameras of a dataset, found none" in err


def test_info_of_a_file_that_is_no_scene_says_so(say, tmp_path):
    (tmp_path / "scene.ply").write_bytes(b"ply")
    code, _, err = say("info", str(tmp_path / "scene.ply"))
    assert code == 2
    assert "expected a PLY file, which starts with 'ply'" in err


def test_info_says_what_is_there(say):
    code, out, _ = say("info", "simulated:tabletop?frames=3&width=80&height=60")
    assert code == 0
    for said in (
        "3: 0, 1, 2 (fixed)",
        "80 x 60",
        "3, numbered 0 to 2",
        "30.0 Hz",
        "carton (label 2)",
        "robot  carton  can  ball",
    ):
        assert said in out, out


def test_info_of_a_bare_recording(say, pristine, tmp_path):
    for name in ("train_meta.json", "ims"):
        (tmp_path / name).symlink_to(pristine / name)
    code, out, _ = say("info", str(tmp_path))
    assert code == 0
    for what in ("depth", "masks", "truth", "shapes"):
        assert [what, "none"] in [line.split() for line in out.splitlines()]


def test_errors_of_the_system_read_as_sentences(tmp_path):
    with pytest.raises(OSError, match="No such file") as caught:
        (tmp_path / "gone").read_text()
    assert describe(caught.value) == f"{tmp_path / 'gone'}: no such file or directory"
    with pytest.raises(FileNotFoundError) as caught:
        raise FileNotFoundError(2, "No such file or directory")  # as os.getcwd does in a folder that is gone
    assert describe(caught.value).startswith("the working directory: expected a folder, found that it was")
    assert describe(ValueError("two\n  lines")) == "two lines"
    assert describe(ValueError()) == "ValueError"


def test_each_kind_of_warning_is_shown_once_and_counted(capfd):
    with Notes(Console(stderr=True)) as notes:
        for frame in range(3):
            warnings.warn(f"frame {frame} is empty", DataWarning, stacklevel=1)
        warnings.warn("another library's own", DeprecationWarning, stacklevel=1)
        notes.add("a note")
    said = capfd.readouterr().err
    assert said == "warning: frame 0 is empty\n"
    assert notes.all == ["a note", "Warning: frame 0 is empty (and 2 more like it)"]


def test_a_preset_is_where_the_trackers_settings_begin(monkeypatch, tmp_path):
    chosen = []
    monkeypatch.setattr("gsjax.cli.track.run", lambda options: chosen.append(options) or 0)
    command = ["track", "simulated:tabletop", "--out", str(tmp_path / "run")]
    for more in ([], ["--preset", "accurate"], ["--preset=accurate", "--track.align.iterations", "3"]):
        assert main([*command, *more]) == 0
    fast, accurate, changed = (options.track for options in chosen)
    assert fast == TrackConfig() == PRESETS["fast"]
    assert accurate == PRESETS["accurate"]
    assert changed == replace(accurate, align=replace(accurate.align, iterations=3))
