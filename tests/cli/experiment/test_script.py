"""What makes a row stale, and scripts that are shared."""

import importlib
import os
import re
import subprocess
import sys
from pathlib import Path

import pytest

from gsjax.engine.experiments import script
from gsjax.engine.experiments.script import forget_scripts
from gsjax.engine.experiments.sweep import experiment_names, read_experiment
from tests.cli.experiment.toys import SCRIPT, calls, results


@pytest.mark.parametrize("change", ["script", "helper", "version"])
def test_a_stale_cell_is_reported_and_runs_again(toy, gsjax, change):
    folder = toy()
    gsjax("run", "toy")
    calls()
    folder = toy(SCRIPT + "# another\n") if change == "script" else toy(version=1 + (change == "version"))
    if change == "helper":
        (folder / "helper.py").write_text("FACTOR = 2\n")
    _, out, _ = gsjax("list")
    assert "0 of 4" in out
    assert "4 stale" in out
    assert "Stale: 4 of 4 cells" in gsjax("table", "toy")[1]
    gsjax("run", "toy", "--only", "size=320", "mode=fast")
    assert calls() == ["320 fast 0"]
    _, out, _ = gsjax("table", "toy")
    assert "Stale: 3 of 4 cells" in out
    assert len(set(r["script"] for r in results(folder)["rows"])) == 2
    gsjax("run", "toy")
    assert len(calls()) == 3
    assert "stale" not in gsjax("list")[1]


def test_a_figure_drawn_otherwise_leaves_the_rows_as_they_are(toy, gsjax):
    drawn = "\f\ndef figure(rows, path):\n    path.write_text({!r})\n"
    folder = toy(SCRIPT + drawn.format("one"), figure={"caption": "c"})
    gsjax("run", "toy")
    calls()
    toy(SCRIPT + drawn.format("another"), figure={"caption": "c"})
    assert "4 of 4" in gsjax("list")[1]
    gsjax("run", "toy")
    assert calls() == []
    assert (folder / "figure.png").read_text() == "another"
    toy(SCRIPT.replace("/ 10", "/ 5") + drawn.format("another"), figure={"caption": "c"})
    assert "4 stale" in gsjax("list")[1]


ROOT = Path(__file__).resolve().parents[3] / "experiments"
IMPORTS = """
from gsjax.engine.recording import open_recording
from experiments.shared.recordings import recorded
from gsjax.scene import (  # several
    Gaussians,
    Tags,
)
import gsjax.losses, gsjax
"""
LATE = "\ndef late():\n    from gsjax.cli.{} import follow  # noqa\n    return follow\n"


@pytest.mark.parametrize("where", ["sweep.py", "helper.py"])
def test_where_a_module_of_gsjax_or_of_experiments_stands_changes_no_fingerprint(toy, where):
    folder, text = toy(), SCRIPT + LATE.format("track.loop")

    def fingerprint(text: str) -> str:
        (folder / where).write_text(text)
        return read_experiment(Path("experiments"), "toy", Path("runs")).fingerprint

    plain = fingerprint(text)
    assert fingerprint(IMPORTS.lstrip() + text) == plain
    assert fingerprint(SCRIPT + LATE.format("track_loop")) == plain
    for other in (
        "import gsjax, os",  # not gsjax alone
        "import gsjaxlike",
        "import benchmarks",
        "import experiments.shared.recordings as recordings",
        "from gsjax.metrics.image import psnr as score",  # another function `as score` would run as well
        "from .gsjax import x",
        "import gsjax; SIZE = 3",
        "SIZE = 3; import gsjax",
        '"""\nimport gsjax\n"""',
        "# import gsjax",
    ):
        assert fingerprint(f"{other}\n{text}") != plain


def test_what_stands_beside_experiments_is_not_forgotten(toy):
    folder = toy("import factor\n" + SCRIPT)
    (folder / "factor.py").write_text("FACTOR = 1\n")
    read_experiment(Path("experiments"), "toy", Path("runs")).load()
    elsewhere = Path("experiments/.venv/lib")
    elsewhere.mkdir(parents=True)
    (elsewhere / "installed.py").touch()
    sys.path.append(str(elsewhere.resolve()))
    try:
        importlib.import_module("installed")
        forget_scripts(Path("experiments"))
        assert "installed" in sys.modules
        assert str(elsewhere.resolve()) in sys.path
        assert "factor" not in sys.modules
        assert str(folder.resolve()) not in sys.path
    finally:
        sys.modules.pop("installed", None)
        sys.path.remove(str(elsewhere.resolve()))


@pytest.mark.thorough
def test_a_script_imports_what_is_shared_and_scripts_of_other_folders(toy, gsjax):
    """By names relative to the folder that holds the root, which may hold helpers too."""
    folder = toy(
        "from experiments.shared.factors import FACTOR\nfrom experiments.other.sweep import MORE\n"
        "from beside_root import MOST\n"
        + SCRIPT.replace("/ 10 + seed", "* FACTOR * MORE * MOST")
        + "\nassert __name__ == 'experiments.toy.sweep'\n"
    )
    for path, text in {
        "shared/factors.py": "FACTOR = 2\n",
        "other/sweep.py": "from experiments.shared.factors import FACTOR\nMORE = 10 * FACTOR\n",
        "../beside_root.py": "MOST = 100\n",
    }.items():
        (folder.parent / path).parent.mkdir(exist_ok=True)
        (folder.parent / path).write_text(text)
    done = subprocess.run(
        [sys.executable, "-P", "-m", "gsjax.cli", "experiment", "run", "toy"],  # -P: as a console script
        env={**os.environ, "PYTHONPATH": str(ROOT.parent)},
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 0, done.stderr
    assert results(folder)["rows"][0]["result"]["ms"] == 320 * 2 * 20 * 100
    before = read_experiment(Path("experiments"), "toy", Path("runs")).made_with
    (folder.parent / "shared/factors.py").write_text("FACTOR = 3\n")
    script._hash_of.cache_clear()
    assert read_experiment(Path("experiments"), "toy", Path("runs")).made_with != before


def test_two_experiments_share_a_script(toy, gsjax):
    """Helpers are found beside the script, not beside the config."""
    folder = toy("from factor import FACTOR\n" + SCRIPT, script="../shared/sweep.py")
    shared = folder.parent / "shared"
    shared.mkdir()
    (folder / "sweep.py").rename(shared / "sweep.py")
    (shared / "factor.py").write_text("FACTOR = 1\n")
    other = folder.parent / "other"
    other.mkdir()
    (other / "config.yaml").write_text((folder / "config.yaml").read_text())
    assert [gsjax("run", name)[0] for name in ("toy", "other")] == [0, 0]
    assert results(folder)["rows"][0]["result"] == results(other)["rows"][0]["result"]


@pytest.mark.parametrize("name", experiment_names(ROOT))
def test_every_experiment_of_this_repository_can_be_loaded(name, tmp_path):
    """A script may name settings that are gone or refused, which otherwise only a run would show."""
    try:
        read_experiment(ROOT, name, tmp_path).load()
    except ValueError as error:
        missing = re.search(r"No module named '(\w+)", str(error))
        if missing is None or missing[1] in ("gsjax", "experiments", "benchmarks"):
            raise
        pytest.skip(f"{error}")
