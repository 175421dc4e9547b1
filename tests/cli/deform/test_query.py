"""`gsjax query` and `gsjax view` on a run of `gsjax deform`: what they find over time, write and refuse.
The run is made up: a scene before its first step, in which a corner is labelled tool."""

import json
import shutil
from dataclasses import replace

import cv2
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from rich.console import Console

from gsjax.cli import main
from gsjax.cli.deform import Options
from gsjax.data import open_sequence
from gsjax.engine.deform.data import deform_data
from gsjax.engine.deform.file import read_deformation, write_deformation
from gsjax.engine.folder import RunFolder
from gsjax.engine.messages import Notes
from gsjax.engine.teaching.choice import TeacherChoice
from gsjax.engine.teaching.source import Source
from gsjax.engine.viewables import open_viewable
from gsjax.io.ply import read_ply, write_ply
from gsjax.io.video import read_video_frames
from gsjax.methods.deform import Deform, DeformConfig, Kept, Meaning, feature_prompt, with_field
from gsjax.methods.deform.query import most_likely, prompt_probabilities, region_feature
from gsjax.scene.deformation import DeformationConfig
from tests.cli.deform.test_command import SCENE

FAINT = 0.3  # the length of a feature


@pytest.fixture(scope="module")
def taught(tmp_path_factory):
    """A run whose Gaussians in the lower left of frame 1 are tool, and all others tissue."""
    run, console = tmp_path_factory.mktemp("taught") / "run", Console(quiet=True)
    told = ("draw", TeacherChoice("classes"), 4, ())
    data = deform_data(open_sequence(SCENE), 8, *told, Notes(console), console)
    moves = DeformationConfig(resolution=8, time_resolution=4, levels=1)
    config = DeformConfig(channels=4, nodes=48, start_pixels=1.5, deformation=moves)
    method = Deform(config)
    problem, first = method.start(data.frames, data.lesson, timeline=data.timeline())
    scene, moving = with_field(config, problem, first.params)
    layers = jax.tree.map(
        lambda leaf: leaf + 0.02 * jax.random.normal(jax.random.key(1), leaf.shape), scene.field.layers
    )
    scene = eqx.tree_at(lambda s: s.field.layers, scene, layers)
    folder = RunFolder(run)
    folder.write_config(Options(dataset=SCENE, out=run, tools="draw"))
    stored = method.result(problem, first.having(params=scene, kept=Kept(moving)))
    write_ply(folder.scene, stored.at(0.0))
    rows = in_corner(stored, 1).astype(int)
    features = jnp.asarray(FAINT * stored.meaning.codebook[rows], jnp.float32)
    scene = eqx.tree_at(lambda s: s.gaussians.features, stored.scene, features)
    write_deformation(run / "deformation.npz", replace(stored, scene=scene))
    return run


def in_corner(stored, t):
    """Which Gaussians lie in the lower left quarter of a frame's picture."""
    viewmat, K = stored.timeline.viewmats[t], stored.timeline.Ks[t]
    local = np.asarray(stored.at(stored.timeline.times[t]).means) @ viewmat[:3, :3].T + viewmat[:3, 3]
    x, y = (local @ K.T)[:, :2].T / local[:, 2]
    return (x < 32) & (y > 26)


@pytest.fixture
def run(taught, tmp_path):
    return shutil.copytree(taught, tmp_path / "run")


def asked(run):
    return json.loads((run / "query" / "query.json").read_text())


@pytest.mark.thorough
@pytest.mark.parametrize("text", [(), ("tool",)])
def test_an_answer_elsewhere_and_without_pictures(gsjax, taught, tmp_path, text):
    out = tmp_path / "answer"
    code, said = gsjax("query", taught, *text, "--no-pictures", "--out", out)
    assert code == 0, said
    assert f"query {out}: selection.npz, recolored.ply" in said
    assert "video.mp4" not in said
    drawn = json.loads((out / "query.json").read_text())["pixels" if text else "shares"]
    assert drawn is None
    code, said = gsjax("query", taught, *text, "--no-pictures", "--out", out, "--frames", "0:2")
    assert (code, "--frames: expected pictures to draw" in said) == (2, True)
    assert {file.suffix for file in out.iterdir()} == {".json", ".npz", ".ply"}


def test_a_name_is_found_and_deleted_in_every_frame(gsjax, run):
    code, said = gsjax("query", run, "Tool", "--move", 0, 0, 0.01)
    assert code == 0, said
    told, folder = asked(run), run / "query"
    stored = read_deformation(run / "deformation.npz")
    corner = in_corner(stored, 1)
    assert (told["gaussians"], told["of"], told["frame"]) == (corner.sum(), len(corner), 0)
    assert (told["against"], told["best_score"]) == (["tissue"], pytest.approx(1, abs=1e-4))
    assert sorted(told["pixels"]) == ["000000", "000001", "000009"]  # the first, and those held out
    found = np.load(folder / "selection.npz")
    np.testing.assert_array_equal(found["indices"], np.flatnonzero(corner))
    first = stored.at(0.0)
    for name, kept in (("object", corner), ("without", ~corner)):
        np.testing.assert_allclose(read_ply(folder / f"{name}.ply")[0].means, first.means[kept])
    assert read_ply(folder / "recolored.ply")[0].num == read_ply(folder / "moved.ply")[0].num == len(corner)
    # The mask is found from the features rendered at each pixel.
    mask = cv2.imread(str(folder / "masks" / "000001.png"), cv2.IMREAD_UNCHANGED) > 0
    quarter = np.zeros_like(mask)
    quarter[26:, :32] = True
    assert (mask & quarter).sum() / (mask | quarter).sum() > 0.75
    # The scene, without the tool, the tool alone, recoloured, and moved; deleted regions are black.
    panels = cv2.imread(str(folder / "frames" / "000001.png"))
    assert panels.shape == (3 * 260, 2 * 320, 3)
    scene, without, alone = (panels[50 + y : 260 + y, x : x + 320] for y, x in ((0, 0), (0, 320), (260, 0)))
    assert without[150:190, 20:100].mean() < 0.2 * scene[150:190, 20:100].mean()
    assert alone[:40, 220:300].mean() < 0.2 * scene[:40, 220:300].mean()
    np.testing.assert_allclose(without[:40, 220:300], scene[:40, 220:300], atol=3)
    assert len(read_video_frames(folder / "video.mp4")) == 10


@pytest.mark.thorough
def test_a_point_and_a_box_mean_what_is_rendered_there(gsjax, run):
    """The mean feature of a box means the class it is most like, and is compared with the other class."""
    for option, where, meant in (
        ("--point", "8,44", "tool"),
        ("--point", "50.5,8", "tissue"),
        ("--box", "4,34,20,48", "tool"),
    ):
        code, said = gsjax("query", run, option, where, "--frame", 1, "--frames", "1:2")
        assert code == 0, said
        assert asked(run)["meant"] == meant
        corner = in_corner(read_deformation(run / "deformation.npz"), 1)
        wanted = corner if meant == "tool" else ~corner
        found = np.zeros(len(corner), bool)
        found[np.load(run / "query" / "selection.npz")["indices"]] = True
        assert (found == wanted).mean() > 0.95
        assert list(asked(run)["pixels"]) == ["000001"]


def test_without_a_prompt_all_are_named(gsjax, run):
    code, said = gsjax("query", run)
    assert code == 0, said
    corner, told = in_corner(read_deformation(run / "deformation.npz"), 1), asked(run)
    assert told["classes"] == {"tissue": (~corner).sum(), "tool": corner.sum()}
    gaussians, report = read_ply(run / "query" / "recolored.ply")
    np.testing.assert_array_equal(report.labels, 1 + corner)
    assert len(np.unique(gaussians.sh0[:, 0], axis=0)) == 2
    labels = cv2.imread(str(run / "query" / "masks" / "000001.png"), cv2.IMREAD_UNCHANGED)
    assert set(np.unique(labels)) <= {0, 1, 2}
    assert told["shares"]["000001"]["tool"] == pytest.approx((labels == 2).mean())
    assert (labels[30:50, 4:24] == 2).mean() > 0.95
    assert (labels[4:20, 40:60] == 1).mean() > 0.95


@pytest.mark.parametrize(
    ("told", "words"),
    [
        (("scalpel",), "no class 'scalpel'; this scene can be queried by its names only: tissue, tool"),
        (("tool", "--point", "3,3"), "at most one of TEXT, --point and --box"),
        (("--point", "64,3"), "--point: expected 0 <= X < 64 and 0 <= Y < 52"),
        (("--box", "9,9,3,3"), "--box: expected"),
        (("--box", "9,9,3"), "--box: expected X0,Y0,X1,Y1 in pixels, found '9,9,3'"),
        (("tool", "--frame", 10), "--frame: expected one of 0 to 9, found 10"),
        (("tool", "--frames", "20:"), "--frames: 20: selects no frame of the run, which has 10"),
        (("tool", "--threshold", 1), "--threshold: expected a finite number below 1"),
        (("tool", "--threshold", 0.99999), "best score"),
        (("tool", "--camera", 1), "--camera: a run of `gsjax deform` has no use for it"),
        (("tool", "--negatives", "tissue"), "--negatives: the name of a class is compared with"),
        (("--point", "3,3", "--negatives", "tissue"), "--negatives: expected a TEXT too"),
        (("tool", "--image", "x.png"), "--image: a run of `gsjax deform` has no use for it"),
        (("tool", "--min-score", 0.1), "--min-score: a run of `gsjax deform` has no use for it"),
    ],
)
def test_what_is_asked_is_checked(gsjax, taught, told, words):
    code, said = gsjax("query", taught, *told)
    assert code == 2
    assert words in said
    assert not (taught / "query").exists()


def test_a_run_without_names_and_one_without_a_scene(gsjax, run):
    stored = read_deformation(run / "deformation.npz")
    scene = eqx.tree_at(lambda s: s.gaussians.features, stored.scene, None)
    write_deformation(run / "deformation.npz", replace(stored, scene=scene, meaning=None))
    code, said = gsjax("query", run, "tool")
    assert code == 2
    assert "reconstruct it with --tools draw" in said
    scene, _ = open_viewable(run, Notes(Console(quiet=True)))
    assert scene.asking is None
    assert scene.labels is None
    (run / "deformation.npz").unlink()
    code, said = gsjax("query", run, "tool")
    assert code == 2
    assert "continue it with gsjax deform --resume" in said


def test_a_run_is_seen_over_time_and_asked(run):
    scene, folder = open_viewable(run, notes := Notes(Console(quiet=True)))
    stored, asking = read_deformation(run / "deformation.npz"), scene.asking
    corner = in_corner(stored, 1)
    assert folder == run
    assert not notes.all
    assert (scene.num_frames, scene.num_moving) == (10, len(corner))
    np.testing.assert_allclose(scene.times, np.arange(10) / 15, atol=1e-9)
    np.testing.assert_array_equal(scene.at(7).means, stored.at(stored.timeline.times[7]).means)
    assert [scene.name_of(int(np.flatnonzero(rows)[0])) for rows in (corner, ~corner)] == ["tool", "tissue"]
    np.testing.assert_array_equal(scene.shots.load_image(3, 0), open_sequence(SCENE).image(3, 0))
    np.testing.assert_array_equal(scene.shots.viewmats[3, 0], stored.timeline.viewmats[3])
    for found in (asking.ask("tool", 4), asking.like(int(np.flatnonzero(corner)[0]), 4)):
        np.testing.assert_array_equal(found.scores > found.threshold, corner)
    with pytest.raises(ValueError, match="no class 'spoon'"):
        asking.ask("spoon", 0)
    path = asking.save(corner, "tool object", 4)
    assert path == run / "extracted" / "tool_object_frame_4.ply"
    np.testing.assert_allclose(read_ply(path)[0].means, stored.at(stored.timeline.times[4]).means[corner])


def test_a_run_whose_recording_is_gone(run):
    config = run / "config.yml"
    config.write_text(config.read_text().replace(SCENE, "/nowhere/recording"))
    scene, _ = open_viewable(run, notes := Notes(Console(quiet=True)))
    assert any("its photographs are not shown" in note for note in notes.all)
    assert scene.shots.load_image is None
    assert scene.asking is not None


def test_features_that_change_are_those_of_the_frame(run):
    """All Gaussians are tissue, and the deformation field adds the difference to tool."""
    stored = read_deformation(run / "deformation.npz")
    tissue, tool = stored.meaning.codebook
    field = stored.scene.field
    config = replace(field.config, feature=True)
    width = field.layers[-1].weight.shape[0] + stored.meaning.codebook.shape[1]
    last = eqx.tree_at(
        lambda layer: (layer.weight, layer.bias),
        field.layers[-1],
        (
            jnp.zeros((width, field.layers[-1].weight.shape[1])),
            jnp.zeros(width).at[-len(tool) :].set(tool - tissue),
        ),
    )
    scene = stored.scene.gaussians
    scene = eqx.tree_at(
        lambda g: g.features, scene, jnp.tile(jnp.asarray(tissue, jnp.float32), (scene.num, 1))
    )
    changed = eqx.tree_at(lambda f: f.layers, field, (*field.layers[:-1], last))
    changed = replace(changed, config=config)
    moved = replace(stored, scene=replace(stored.scene, gaussians=scene, field=changed))
    assert moved.meaning_changes
    write_deformation(run / "deformation.npz", moved)
    assert main(["query", str(run), "tool", "--frames", "0:1"]) == 0
    assert asked(run)["gaussians"] == scene.num


def test_nothing_is_most_likely_where_all_are_equally_likely():
    likely = jnp.array([[0.2, 0.8], [0.6, 0.4], [0.5, 0.5]])
    np.testing.assert_array_equal(most_likely(likely), [1, 0, -1])


def test_the_prompt_of_a_feature_has_the_other_names_as_negatives():
    rng = np.random.default_rng(0)
    codebook = np.linalg.qr(rng.normal(size=(6, 6)))[0][:3]
    meaning = Meaning(Source("files"), ("a", "b", "c"), codebook, np.eye(6))
    prompt = feature_prompt(meaning, 0.2 * (codebook[2] + 0.4 * codebook[0]))
    assert (prompt.name, prompt.negatives) == ("c", ("a", "b"))
    np.testing.assert_allclose(prompt.vectors[1:], codebook[:2], atol=1e-12)
    likely = prompt_probabilities(jnp.asarray(codebook), jnp.asarray(prompt.vectors))
    np.testing.assert_array_equal(most_likely(likely), [1, 2, 0])


def test_a_region_is_the_mean_of_its_pixels():
    drawn, alphas = np.random.default_rng(0).normal(size=(5, 7, 2)), np.ones((5, 7))
    np.testing.assert_allclose(region_feature(drawn, alphas, (2.9, 1.2, 2.9, 1.2)), drawn[1, 2])
    np.testing.assert_allclose(region_feature(drawn, alphas, (1, 0, 3.5, 4)), drawn[:, 1:4].mean(axis=(0, 1)))
    for box, words in (((0, 0, 7, 1), "0 <= X < 7"), ((0, 3, 1, 1), "found 0,3 to 1,1")):
        with pytest.raises(ValueError, match=words):
            region_feature(drawn, alphas, box)
    with pytest.raises(ValueError, match="found empty ones"):
        region_feature(drawn, 0.1 * alphas, (0, 0, 2, 2))
