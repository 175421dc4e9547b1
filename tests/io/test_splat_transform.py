"""Every format as PlayCanvas's splat-transform has it: it reads what we write, and we read what it writes.

Skipped without it: `npm install -g @playcanvas/splat-transform`, or GSJAX_SPLAT_TRANSFORM=FOLDER/bin/cli.mjs.
"""

import os
import shutil
import subprocess
from pathlib import Path

import pytest

from gsjax.io.ply import read_ply
from gsjax.io.scenes import read_gaussians, write_gaussians
from tests.io.scenes_to_write import ROUNDING, assert_alike, flat, ksplat, make_scene

PROGRAM = os.environ.get("GSJAX_SPLAT_TRANSFORM") or shutil.which("splat-transform")
pytestmark = pytest.mark.skipif(
    PROGRAM is None or shutil.which("node") is None, reason="splat-transform is not installed"
)


def convert(source: Path, target: Path, *options: str) -> None:
    """Convert a file by splat-transform."""
    command = ["node", PROGRAM, "-w", *options, source, target]
    done = subprocess.run(command, capture_output=True, text=True, timeout=300)
    assert done.returncode == 0, done.stdout + done.stderr
    assert target.is_file()


@pytest.mark.parametrize("degree", range(4))
@pytest.mark.parametrize("ending", ROUNDING)
def test_it_reads_what_we_write(tmp_path, ending, degree):
    scene = make_scene(300, degree)
    write_gaussians(tmp_path / f"ours{ending}", scene)
    convert(tmp_path / f"ours{ending}", tmp_path / "theirs.ply")
    theirs, _ = read_ply(tmp_path / "theirs.ply")
    assert_alike(scene if ROUNDING[ending].degree else flat(scene), theirs, ROUNDING[ending])


@pytest.mark.parametrize("degree", range(4))
@pytest.mark.parametrize("ending", ROUNDING)
def test_we_read_what_it_writes(tmp_path, ending, degree):
    scene = make_scene(300, degree)
    write_gaussians(tmp_path / "ours.ply", scene)
    convert(tmp_path / "ours.ply", tmp_path / f"theirs{ending}")
    back, _ = read_gaussians(tmp_path / f"theirs{ending}")
    assert_alike(scene if ROUNDING[ending].degree else flat(scene), back, ROUNDING[ending], times=2)


@pytest.mark.parametrize("level", range(3))
def test_both_read_the_same_ksplat(tmp_path, level):
    (tmp_path / "a.ksplat").write_bytes(ksplat(level, make_scene(45, 2), 2))
    convert(tmp_path / "a.ksplat", tmp_path / "theirs.ply")
    theirs, _ = read_ply(tmp_path / "theirs.ply")
    assert_alike(read_gaussians(tmp_path / "a.ksplat")[0], theirs, ROUNDING[".ply"], times=10)
