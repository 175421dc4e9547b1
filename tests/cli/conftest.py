"""A tiny recording for tests to corrupt, and a stand-in for the tracker, to test the code around it."""

import json
import shutil
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, contextmanager
from dataclasses import asdict, replace
from pathlib import Path

import cv2
import jax.numpy as jnp
import numpy as np
import pytest

from gsjax.cli import main
from gsjax.data import open_sequence, write_panoptic
from gsjax.data.simulated import tabletop
from gsjax.engine import progress
from gsjax.engine.checkpoint import write_field
from gsjax.engine.distill.scene import SceneOptions
from gsjax.engine.drive import Tick
from gsjax.engine.folder import RunFolder, plain
from gsjax.engine.records import digest
from gsjax.engine.teaching.source import Source
from gsjax.engine.track import loop, run
from gsjax.geometry.cameras import OPENGL_TO_OPENCV
from gsjax.methods.distill import DistillResult, FeatureField
from gsjax.methods.track import PLAN, Kept, Track, Tracked, first_pose, start_scene
from gsjax.optim.method import Run
from gsjax.scene.gaussians import Gaussians
from gsjax.scene.initialize import gaussians_from_points, points_from_rgbd


@pytest.fixture(scope="session")
def pristine(tmp_path_factory) -> Path:
    """Four frames of the built-in scene, 80x60, three cameras, as a Panoptic folder."""
    folder = tmp_path_factory.mktemp("recording") / "table"
    folder.mkdir()
    write_panoptic(tabletop(frames=4, width=80, height=60), folder)
    return folder


@pytest.fixture(scope="session")
def photographs(tmp_path_factory) -> Path:
    """Nine photographs of the built-in table, 48x36, and one that is listed but missing."""
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
def interrupted(monkeypatch) -> Callable[[int], AbstractContextManager]:
    """`with interrupted(25): ...` is Ctrl-C after the 25th step that a run takes within the block."""

    @contextmanager
    def after(count: int) -> Iterator[None]:
        heard = []

        def raise_if_interrupted():  # after each step
            heard.append(1)
            if len(heard) == count:
                raise KeyboardInterrupt

        with monkeypatch.context() as patch:
            patch.setattr(progress, "raise_if_interrupted", raise_if_interrupted)
            yield

    return after


@pytest.fixture
def recording(pristine, tmp_path) -> Path:
    """A copy of `pristine` to corrupt."""
    return Path(shutil.copytree(pristine, tmp_path / "table"))


def unfitted(frame, mask, mask_camera, config, before_fit):
    """`start_scene` without the optimisation, and without a rehearsal before it."""
    start = replace(config.start, iterations=0)
    return start_scene(frame, mask, mask_camera, replace(config, start=start))


def still_tick(scene, step: int, info: dict, seconds: float = 0.01) -> Tick:
    """The tick of a tracker whose objects are where they were at first."""
    run = Run(Tracked(scene, first_pose(scene)), None, step, {PLAN: None}, Kept(1))
    return Tick(Track(), None, run, info, seconds, 0.0)


def standing_still(scene, first, frames, config, **how):
    """`track` for objects that never move."""
    for t, _ in enumerate(frames, 1):
        seen = np.ones(scene.num_objects, bool)
        info = {"visible": seen, "lost": ~seen, "turn_known": seen, "looked_for": ~seen}
        info["agrees"] = seen.astype(np.float32)
        yield still_tick(scene, t, info | {"joined": 0, "skipped": False})


@pytest.fixture
def still(monkeypatch):
    """Replaces tracking by `standing_still`, which compiles nothing; returns that function."""
    monkeypatch.setattr(run, "start_scene", unfitted)
    monkeypatch.setattr(loop, "track", standing_still)
    return standing_still


@pytest.fixture
def gsjax_track(tmp_path, capfd):
    """Runs `gsjax track` in this process, into tmp_path/run; returns the exit code and its output."""

    def call(dataset, *options: str) -> tuple[int, str]:
        code = main(["track", str(dataset), "--out", str(tmp_path / "run"), *options])
        out, err = capfd.readouterr()
        assert "Traceback" not in out + err
        return code, out + err

    return call


@pytest.fixture
def gsjax(capfd):
    """Runs a command in this process; returns the exit code and its output, with whitespace collapsed."""

    def call(*arguments) -> tuple[int, str]:
        capfd.readouterr()
        code = main([str(argument) for argument in arguments])
        said = "".join(capfd.readouterr())
        assert "Traceback" not in said
        return code, " ".join(said.split())

    return call


LABELS = {0: "background", 1: "robot", 2: "carton", 3: "can", 4: "ball", 5: "block"}
"""The labels of the recording's masks."""


def first_picture(pristine: Path) -> tuple[Gaussians, np.ndarray]:
    """A Gaussian for every other pixel of all cameras' first pictures, and the label of each."""
    sequence, points, colors, labels = open_sequence(str(pristine)), [], [], []
    for c in range(sequence.num_cameras):
        depth, pose = sequence.depth(0, c), (sequence.viewmats[0, c], sequence.Ks[0, c])
        found = points_from_rgbd(sequence.image(0, c), depth, *pose, stride=2)
        seen = cv2.imread(str(pristine / "seg" / str(c) / "000000.png"), cv2.IMREAD_UNCHANGED)
        labels.append(seen[::2, ::2][depth[::2, ::2] > 0].astype(np.int32))
        points.append(found[0])
        colors.append(found[1])
    return gaussians_from_points(np.concatenate(points), np.concatenate(colors)), np.concatenate(labels)


def write_made_field(
    folder: Path, scene: Path, images: Path | None, source: Source, labels: np.ndarray, vectors: np.ndarray
) -> Path:
    """Writes a field without distilling it: each Gaussian has the row `vectors[label]`; returns `folder`."""
    photographs = None
    if images is not None:
        told = SceneOptions(scene, str(images), frames="0:1", test_every=0)
        photographs = plain(asdict(told))
        RunFolder(folder).write_config(told)
    known, places = np.unique(labels, return_inverse=True)
    field = FeatureField(jnp.eye(len(known))[places], jnp.asarray(vectors[known].T, jnp.float32))
    about = {"file": str(scene), "sha256": digest(scene), "num_gaussians": len(labels)}
    about["photographs"] = photographs
    folder.mkdir(parents=True, exist_ok=True)
    write_field(folder / "field.npz", DistillResult(field, None, source, about))
    return folder
