"""The benchmark of start-up times; that a second start compiles nothing is tested in tests/cli/run."""

import json

import jax.numpy as jnp
import pytest

from benchmarks import starts
from gsjax.cli import main
from gsjax.io.ply import write_ply
from gsjax.scene.gaussians import Gaussians


def record(seconds):
    stages = dict.fromkeys(("imported_s", "tracing_s", "lowering_s", "compiling_s"), 1.0)
    return stages | {"first_s": None, "process_s": seconds, "programs": 5, "cache_hits": 3}


def test_every_start_is_written_and_a_field_gets_its_scene(monkeypatch, tmp_path, capfd):
    calls = []

    def measured(name, out, cache, label):
        calls.append((name, label))
        return record(float(len(calls)))

    monkeypatch.setattr(starts, "measure", measured)
    assert main(["bench", "--starts", "--only", "distill", "track", "--out", str(tmp_path)]) == 0
    both = ("cold", "warm")
    assert calls == [(name, label) for name in ("track", "fit", "distill") for label in both]
    found = json.loads((tmp_path / "starts.json").read_text())
    assert found["starts"]["distill"]["warm"]["process_s"] == 6.0
    assert found["machine"]
    assert "distill  cold   –" in capfd.readouterr().out


@pytest.mark.parametrize(
    ("options", "says"),
    [
        (("--only", "garden"), "--only: expected commands of track, live, fit"),
        (("--quick",), "--quick: does not apply to --starts; leave it out"),
        (("--repeats", "3"), "--repeats: does not apply to --starts; leave it out"),
    ],
)
def test_options_of_the_suite_are_not_those_of_starts(options, says, tmp_path, capfd):
    assert main(["bench", "--starts", *options, "--out", str(tmp_path)]) == 2
    assert says in " ".join(capfd.readouterr().err.split())


@pytest.mark.thorough
def test_a_viewer_ends_with_its_page_and_is_recorded(monkeypatch, tmp_path):
    one = (jnp.zeros((1, 3)), jnp.eye(1, 4), jnp.zeros((1, 3)), jnp.zeros(1), jnp.zeros((1, 1, 3)))
    write_ply(tmp_path / "scene.ply", Gaussians(*one))
    monkeypatch.setitem(starts.COMMANDS, "view", ("view", str(tmp_path / "scene.ply"), "--port", "0"))
    found = starts.measure("view", tmp_path, tmp_path / "cache", "cold")
    assert 0 < found["first_s"] < found["process_s"]
    assert found["exit_code"] == 0
