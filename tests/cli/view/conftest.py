"""Things to view, a fit, a tracked scene and a PLY file, and `gsjax view` to run on them."""

from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from rich.console import Console

from gsjax.cli import main
from gsjax.cli.fit import Options as FitOptions
from gsjax.engine.folder import RunFolder
from gsjax.engine.messages import Notes
from gsjax.engine.track.loop import Tracking
from gsjax.engine.track.outputs import write_tracking
from gsjax.engine.track.run import Options as TrackOptions
from gsjax.io.ply import write_ply
from gsjax.methods.fit import FitConfig
from gsjax.methods.track import Pose, TrackedScene
from gsjax.scene.gaussians import gaussians_from_activated


def some(count=30):
    rng = np.random.default_rng(0)
    return gaussians_from_activated(
        rng.normal(size=(count, 3)),
        rng.normal(size=(count, 4)),
        rng.uniform(0.05, 0.1, (count, 3)),
        rng.uniform(0.2, 0.9, count),
        rng.uniform(size=(count, 3)),
    )


@pytest.fixture
def ply(tmp_path) -> Path:
    write_ply(tmp_path / "things.ply", some(), labels=np.arange(30) % 2)
    return tmp_path / "things.ply"


@pytest.fixture
def fitted(photographs, tmp_path) -> Path:
    """What a fit of the photographs leaves, except for its pictures."""
    folder = RunFolder(tmp_path / "fitted")
    folder.write_config(FitOptions(str(photographs), folder.path, fit=FitConfig(antialiased=True)))
    folder.write_metrics({"kind": "fit", "complete": True})
    write_ply(folder.scene, some())
    return folder.path


@pytest.fixture
def tracked(recording, tmp_path) -> Path:
    """What tracking leaves, except for its pictures: 12 of 30 Gaussians, of two objects, shift by 1 cm per
    frame. Camera 2 is held out."""
    gaussians, labels = some(), np.where(np.arange(30) < 12, 1 + np.arange(30) % 2, 0)
    scene = TrackedScene(gaussians, jnp.zeros((12, 3)), jnp.asarray(labels), (0, 2, 3), 12)
    means, quats = gaussians.means[:12], gaussians.quats[:12]
    poses = jax.device_get([Pose(means + 0.01 * t, quats) for t in range(4)])
    seen = [np.ones(2, bool)] * 3
    tracking = Tracking(scene, poses, update_s=[0.0] * 4, lost=[~known for known in seen], turn_known=seen)
    folder = RunFolder(tmp_path / "tracked")
    folder.write_config(TrackOptions(str(recording), folder.path, cameras=(0, 1), eval_cameras=(2,)))
    write_tracking(folder, tracking, np.arange(4) / 10)
    objects = {"carton": {"label": 2}, "can": {"label": 3}}
    folder.write_metrics({"mask": {"camera": 0, "source": "files"}, "objects": objects, "complete": True})
    return folder.path


@pytest.fixture
def notes():
    with Notes(Console(stderr=True)) as notes:
        yield notes


@pytest.fixture
def view(capfd, monkeypatch):
    """Runs the command with an immediate Ctrl-C; returns the exit code and output, whitespace collapsed."""

    def interrupted(self):
        raise KeyboardInterrupt

    monkeypatch.setattr("gsjax.viz.viewer.Viewer.wait", interrupted)

    def call(*arguments) -> tuple[int, str]:
        capfd.readouterr()
        code = main(["view", *map(str, arguments)])
        said = "".join(capfd.readouterr())
        assert "Traceback" not in said
        return code, " ".join(said.split())

    return call


@pytest.fixture
def export(capfd):
    """Runs the command; returns the exit code and its output, with whitespace collapsed."""

    def call(*arguments) -> tuple[int, str]:
        capfd.readouterr()
        code = main(["export", *map(str, arguments)])
        said = "".join(capfd.readouterr())
        assert "Traceback" not in said
        return code, " ".join(said.split())

    return call
