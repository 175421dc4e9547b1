"""A tiny recording for tests to corrupt, and a tracker that stands still, to test what is around it."""

import json
import shutil
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest

from gsjax.cli import loop, main, track
from gsjax.data import write_panoptic
from gsjax.data.simulated import tabletop
from gsjax.geometry.cameras import OPENGL_TO_OPENCV
from gsjax.methods.object_tracker import Tracked, first_pose, start_scene


@pytest.fixture(scope="session")
def pristine(tmp_path_factory) -> Path:
    """Four frames of the built-in scene, 80x60, three cameras, as a Panoptic folder."""
    folder = tmp_path_factory.mktemp("recording") / "table"
    folder.mkdir()
    write_panoptic(tabletop(frames=4, width=80, height=60), folder)
    return folder


@pytest.fixture(scope="session")
def photographs(tmp_path_factory) -> Path:
    """Nine photographs of the built-in table, 48x36, and one that is listed and not there."""
    folder = tmp_path_factory.mktemp("photographs") / "table"
    (folder / "images").mkdir(parents=True)
    frames = []
    for t in range(3):
        sequence = tabletop(frames=4, width=48, height=36)
        for c in range(3):
            name = f"images/{t}{c}.png"
            assert cv2.imwrite(str(folder / name), sequence.image(t, c)[..., ::-1])
            pose = np.linalg.inv(sequence.viewmats[t, c]) @ OPENGL_TO_OPENCV
            K = sequence.Ks[t, c]
            own = {"fl_x": K[0, 0], "fl_y": K[1, 1], "cx": K[0, 2], "cy": K[1, 2]}
            frames.append({"file_path": name, "transform_matrix": pose.tolist(), **own})
    frames.append({"file_path": "images/lost.png", "transform_matrix": np.eye(4).tolist()})
    (folder / "transforms.json").write_text(json.dumps({"frames": frames}))
    return folder


@pytest.fixture
def recording(pristine, tmp_path) -> Path:
    """A copy of it to corrupt."""
    return Path(shutil.copytree(pristine, tmp_path / "table"))


def unfitted(frame, mask, mask_camera, config):
    """`start_scene` without the optimisation."""
    start = replace(config.start, iterations=0)
    return start_scene(frame, mask, mask_camera, replace(config, start=start))


def standing_still(scene, first, frames, config, **how):
    """`track` for objects that never move."""
    for _ in frames:
        seen = np.ones(scene.num_objects, bool)
        info = {"visible": seen, "lost": ~seen, "turn_known": seen, "joined": 0, "skipped": False}
        yield Tracked(scene, first_pose(scene), None, info, 0.01, 0.0, None, 0)


@pytest.fixture
def still(monkeypatch):
    """Tracking is replaced by standing still, which compiles nothing; that is given."""
    monkeypatch.setattr(track, "start_scene", unfitted)
    monkeypatch.setattr(loop, "track", standing_still)
    return standing_still


@pytest.fixture
def gsjax_track(tmp_path, capfd):
    """Runs `gsjax track` in this process, into tmp_path/run; returns the exit code and what was said."""

    def call(dataset, *options: str) -> tuple[int, str]:
        code = main(["track", str(dataset), "--out", str(tmp_path / "run"), *options])
        out, err = capfd.readouterr()
        assert "Traceback" not in out + err
        return code, out + err

    return call


@pytest.fixture
def gsjax(capfd):
    """Runs a command in this process; returns the exit code and what was said, spaces as one."""

    def call(*arguments) -> tuple[int, str]:
        capfd.readouterr()
        code = main([str(argument) for argument in arguments])
        said = "".join(capfd.readouterr())
        assert "Traceback" not in said
        return code, " ".join(said.split())

    return call
