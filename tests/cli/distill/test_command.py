"""`gsjax distill` where something is odd: folders, masks, files, encoders, what a resumed run finds."""

import json
import shutil
import warnings
from dataclasses import replace
from pathlib import Path

import cv2
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
import yaml
from rich.console import Console

from gsjax.cli.distill import command as distill
from gsjax.cli.distill import scores as field_scores
from gsjax.cli.distill import teacher as field_teacher
from gsjax.cli.distill.cache import FeatureCache
from gsjax.cli.distill.choice import TeacherChoice
from gsjax.cli.distill.command import Options
from gsjax.cli.distill.results import draw_features, feature_colors
from gsjax.cli.distill.scores import class_maps, classes_of, one_by_one
from gsjax.cli.distill.teacher import Teaching
from gsjax.cli.run import learning
from gsjax.data.errors import DataWarning
from gsjax.data.photographs import Photographs
from gsjax.geometry.cameras import Camera
from gsjax.io.ply import read_ply, write_ply
from gsjax.methods.feature_field import (
    FieldConfig,
    carried,
    frozen_views,
    init_field,
    pixel_cosines,
)
from gsjax.rasterize.frozen import paint, strip_of
from gsjax.scene.feature_grid import FeatureGridConfig
from gsjax.viz.colors import colorize_features, fit_pca_colors
from tests.cli.conftest import first_picture
from tests.perception.test_foundation import clip_folder, needs_foundation, sam_folders  # noqa: F401

SMALL = ("--field.encoding", "table", "--field.channels", 8, "--field.contrast-patch", 4)
QUIET = Console(quiet=True)


@pytest.fixture(scope="module")
def scene(pristine, tmp_path_factory):
    path = tmp_path_factory.mktemp("scene") / "scene.ply"
    write_ply(path, first_picture(pristine)[0])
    return path


@pytest.fixture(autouse=True)
def cache(tmp_path, monkeypatch):
    monkeypatch.setattr("gsjax.cli.distill.cache.user_cache_dir", lambda *a, **k: str(tmp_path / "cache"))


def metrics(out):
    return json.loads((out / "metrics.json").read_text())


@pytest.mark.parametrize("place", ["", "canonical"])
def test_a_field_never_replaces_its_scene(gsjax, pristine, scene, tmp_path, place):
    run = tmp_path / "run"
    (run / place).mkdir(parents=True)
    settings = {"dataset": str(pristine), "frames": "0:1", "test_every": 8, "fit": {}}
    for folder in {run, run / place}:
        (folder / "config.yml").write_text("# gsjax run\n" + yaml.safe_dump(settings))
    file = Path(shutil.copy(scene, run / place / "scene.ply"))
    images = ("--images", pristine, "--frames", "0:1", "--test-every", 0)
    for told in ((run,), (file, *images)):
        for out in {run, run / place}:
            code, said = gsjax("distill", *told, "--out", out, "--overwrite")
            assert code == 2
            assert f"--out {out}: expected a folder for the field alone" in said
    linked = tmp_path / "linked"
    shutil.copytree(run, linked)
    (linked / place / "scene.ply").unlink()
    (linked / place / "scene.ply").symlink_to(scene)
    assert gsjax("distill", linked, "--out", linked / place, "--overwrite")[0] == 2
    assert file.is_file()
    assert (linked / place / "scene.ply").is_symlink()


@pytest.mark.parametrize(
    ("options", "words"),
    [
        (("--features", "clip", "--weights", "nowhere"), ("--weights nowhere", "found nothing there")),
        (("--features", "clip", "--weights", "."), ("--weights", "it lacks config.json")),
        (("--weights", "."), ("--weights", "--features clip", "found auto")),
        (("--sam", "nowhere"), ("--sam nowhere", "found nothing there")),
        (("--scale", 0.01), ("--scale 0.01", "80x60", "1x1")),
        (("--second", "maskclip"), ("--second maskclip", "--features clip", "found auto")),
        (("--level", "small"), ("--level small", "--features FOLDER")),
    ],
)
def test_what_cannot_be_done_is_refused_before_anything_is(
    gsjax, monkeypatch, pristine, scene, tmp_path, options, words
):
    def never(*args):
        raise AssertionError

    monkeypatch.setattr(field_teacher, "_names", never)
    monkeypatch.chdir(tmp_path)
    told = ("--out", "field", "--images", pristine, "--frames", "0:1", "--test-every", 0)
    code, said = gsjax("distill", scene, *told, *options)
    assert code == 2
    for word in words:
        assert word in said, said
    assert not Path("field").exists()


def test_views_that_are_odd_cost_nothing_but_themselves(gsjax, recording, scene, tmp_path):
    shutil.rmtree(recording / "seg/1")
    (recording / "ims/2/000000.png").write_bytes(b"no picture")
    seen = cv2.imread(str(recording / "seg/2/000001.png"), cv2.IMREAD_UNCHANGED)
    cv2.imwrite(str(recording / "seg/2/000001.png"), np.where(seen == 2, 77, np.where(seen == 3, 0, seen)))
    told = ("--images", recording, "--frames", "0:2", "--eval-cameras", 2, "--features", "closed", *SMALL)
    code, said = gsjax("distill", scene, "--out", tmp_path / "field", *told, "--field.iterations", 2)
    assert code == 0, said
    assert "no mask says anything teach nothing: 1/0, 1/1" in said
    assert said.count("teach nothing") == 1
    found = metrics(tmp_path / "field")
    assert found["views"] == {"taught": 2, "held_out": 2}
    assert [row["cosine"] is None for row in found["scores"]] == [True, False]
    assert any("2/0 was not compared" in n and "ims/2/000000.png" in n for n in found["notes"])
    assert all((tmp_path / "field" / row["picture"]).is_file() for row in found["scores"])


def photographs(labels, names=None):
    """Pictures of noise, with these labels; None where there are none."""
    random, count = np.random.default_rng(0), len(labels)
    pictures = random.integers(0, 256, (count, 12, 16, 3), dtype=np.uint8)
    K = np.array([[16.0, 0, 8], [0, 16.0, 6], [0, 0, 1]])
    return Photographs(
        "noise",
        tuple(f"cam{i}/a.png" for i in range(count)),
        np.tile([16, 12], (count, 1)),
        np.tile(K, (count, 1, 1)),
        np.tile(np.eye(4), (count, 1, 1)),
        load_image=lambda i: pictures[i],
        load_labels=lambda i: None if labels[i] is None else np.repeat(np.repeat(labels[i], 4, 0), 4, 1),
        label_names=names or {},
    )


def taught(shown, indices, asked, folder):
    asked.check()
    return Teaching(shown, indices, asked, FeatureCache(folder / "cache"), QUIET)


THREE, TWO, OTHER = np.array([[0, 0, 1, 2]] * 3), np.array([[0, 0, 1, 1]] * 3), np.array([[0, 5, 1, 1]] * 3)


@pytest.mark.parametrize("features", ["classes", "closed"])
def test_held_out_views_are_asked_about_in_the_terms_of_those_that_taught(tmp_path, features):
    shown = photographs([THREE, TWO, OTHER, None])
    said = taught(shown, [0], TeacherChoice(features), tmp_path)
    assert said.source.names == {1: "background", 2: "object 1", 3: "object 2"}
    alone, others, nobody = (said.of(i) for i in (1, 2, 3))
    assert alone.dimension == others.dimension == said.teacher.dimension
    assert nobody is None
    if features == "classes":
        code = said.source.encoder().embed_text("object 1")
        np.testing.assert_array_equal(others.codebook[others.ids[0][0, 8]], code / np.linalg.norm(code))
        assert others.ids[0][0, 4] == -1  # nobody taught what 5 is
    one_more = taught(photographs([TWO, THREE]), [0], TeacherChoice(features), tmp_path)
    assert one_more.source.names == {1: "background", 2: "foreground"}
    assert one_more.of(1).dimension == one_more.teacher.dimension


def test_outlines_can_be_put_on_edges(tmp_path):
    true = np.zeros((12, 16), int)
    true[3:9, 4:12] = 1
    off = np.roll(true, 1, axis=1)  # by a pixel
    shown = replace(
        photographs([TWO]),
        load_image=lambda i: np.uint8(200 * true[..., None] + 30).repeat(3, 2),
        load_labels=lambda i: off,
    )
    choices = [TeacherChoice("classes", snap=pixels) for pixels in (0, 2)]
    as_they_are, snapped = (taught(shown, [0], choice, tmp_path).teacher for choice in choices)
    thing = {k: t.ids[0] == t.ids[0][6, 8] for k, t in (("off", as_they_are), ("on", snapped))}
    np.testing.assert_array_equal(thing["off"], off == 1)
    assert (
        ((thing["on"] & true).sum() / (thing["on"] | true).sum())
        > 0.9
        > (off & true).sum() / (off | true).sum()
    )
    with pytest.raises(ValueError, match="--snap: expected 0 or more pixels, found -1"):
        TeacherChoice(snap=-1).check()


def test_numbers_of_labels_cost_nothing(tmp_path, monkeypatch):
    from gsjax.perception.codebook import ClassCodebook

    counts, embed = [], ClassCodebook.embed_objects

    def counted(self, image, labels, count):
        counts.append(count)
        return embed(self, image, labels, count)

    monkeypatch.setattr(ClassCodebook, "embed_objects", counted)
    large = np.array([[0, 26003, 7, 7]] * 3, np.int32)
    said = taught(photographs([large, THREE], {26003: "car", 7: "road"}), [0], TeacherChoice(), tmp_path)
    assert said.source.names == {1: "background", 8: "road", 26004: "car"}
    code = ClassCodebook({1: "car"}).embed_text("car")
    np.testing.assert_allclose(said.teacher.codebook[said.teacher.ids[0][0, 4]], code, atol=1e-6)
    assert (said.of(1).ids[0] >= 0).sum() == 96  # the background, which alone has a name
    assert counts == [3, 5]


def test_weights_are_read_once_however_many_pictures_there_are(tmp_path, monkeypatch):
    weights, digested = tmp_path / "sam", []
    weights.mkdir()
    monkeypatch.setattr(
        "gsjax.perception.sam.load_sam", lambda path: lambda image, depth, K: image[..., 0] // 64
    )
    monkeypatch.setattr(field_teacher, "folder_digest", lambda path: digested.append(path) or "digest")
    said = taught(photographs([None] * 3), [0, 1, 2], TeacherChoice("closed", sam=weights), tmp_path)
    assert (said.masks, digested) == ("sam", [weights])


def test_features_of_files_are_found_by_all_photographs(tmp_path):
    shown, maps = photographs([None] * 3), np.random.default_rng(0).normal(size=(3, 3, 4, 5))
    np.save(tmp_path / "level_0.npy", maps)  # LERF's: those of all pictures, in order
    said = taught(shown, [0, 2], TeacherChoice(str(tmp_path)), tmp_path)
    cosines = np.einsum("hwd,hwd->hw", said.teacher.maps[1], maps[2]) / np.linalg.norm(maps[2], axis=-1)
    np.testing.assert_allclose(cosines, np.linalg.norm(said.teacher.maps[1], axis=-1), rtol=1e-5)
    assert said.of(1).maps[0].shape == (3, 4, 5)
    (tmp_path / "level_0.npy").unlink()
    for i in (0, 2):
        (tmp_path / f"cam{i}").mkdir()
        np.save(tmp_path / f"cam{i}/a.npy", maps[i])
    said = taught(shown, [0, 2], TeacherChoice(str(tmp_path)), tmp_path)  # held-out ones need not be there
    with pytest.raises(FileNotFoundError, match=r"cam1/a\.png"):
        said.of(1)
    (tmp_path / "cam1").mkdir()
    np.save(tmp_path / "cam1/a.npy", maps[1, ..., :2])
    with pytest.raises(ValueError, match=r"cam1/a\.npy: expected features of 5 numbers .* found 2"):
        said.of(1)
    np.save(tmp_path / "cam2/a.npy", maps[2, :, :1])
    with pytest.raises(ValueError, match=r"cam2/a\.npy: expected features .* cam2/a\.png, 16x12, found 1x3"):
        taught(shown, [0, 2], TeacherChoice(str(tmp_path)), tmp_path)


def test_photographs_without_masks_are_named(tmp_path):
    with pytest.warns(DataWarning, match=r"teach nothing: cam1/a\.png, cam3/a\.png$"):
        said = taught(photographs([THREE, None, TWO, None]), [0, 1, 2, 3], TeacherChoice(), tmp_path)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        assert said.of(1) is None


@pytest.mark.parametrize("encoding", ["grid", "table"])
def test_a_picture_of_features_needs_three_numbers_a_pixel(scene, encoding):
    gaussians = read_ply(scene)[0]
    gaussians = jax.tree.map(lambda a: jnp.asarray(a[::40]), gaussians)
    grid = FeatureGridConfig(levels=2, most_resolution=16, log2_entries=8, hidden=8)
    field, located = init_field(
        jax.random.key(0), FieldConfig(channels=6, encoding=encoding, grid=grid), gaussians.means, 4
    )
    K = jnp.array([[40.0, 0, 20], [0, 40.0, 16], [0, 0, 1]])
    back = jnp.eye(4).at[2, 3].set(3.0)
    cameras = [Camera(back, K, 40, 32), Camera(back.at[2, 3].set(2.0), K, 40, 32)]
    colors, pca = feature_colors(field, located)
    parts = carried(field, located)
    ones = jnp.ones(len(parts.values))
    known = fit_pca_colors(np.asarray(parts.channels_of(parts.joined(parts.values, ones))))
    wanted = frozen_views(gaussians, cameras)
    kinds = set()
    for frozen, (view, plan) in zip(one_by_one(gaussians, cameras, "classic"), wanted, strict=True):
        image, alphas = paint(view, parts.values, plan)
        channels = np.asarray(parts.channels_of(parts.joined(image, alphas)))
        alphas = np.asarray(alphas)[..., None]
        assert (alphas > 0.5).any()
        mean = np.where(alphas > 0.5, channels / np.maximum(alphas, 0.5), np.nan)
        found = draw_features(colors, frozen, pca).astype(int)
        assert np.abs(found - colorize_features(mean, known)).max() <= 1
        kinds.add((frozen[1], *(len(a) for a in frozen[0])))
    assert len(kinds) == 1  # one program for both


def test_classes_of_a_picture_are_found_strip_by_strip(scene, monkeypatch):
    gaussians = jax.tree.map(lambda a: jnp.asarray(a[::20]), read_ply(scene)[0])
    grid = FeatureGridConfig(levels=2, most_resolution=32, log2_entries=8, hidden=8)
    field, located = init_field(jax.random.key(0), FieldConfig(channels=6, grid=grid), gaussians.means, 4)
    field = eqx.tree_at(lambda f: f.encoding.table, field, 1e5 * field.encoding.table)
    codes, rows = np.random.default_rng(0).normal(size=(5, 4)).astype(np.float32), []
    K = jnp.array([[40.0, 0, 20], [0, 40.0, 30], [0, 0, 1]])
    frozen = frozen_views(gaussians, [Camera(jnp.eye(4).at[2, 3].set(3.0), K, 40, 60)])[0]

    def told(view, plan, first, count):
        rows.append(count)
        return strip_of(view, plan, first, count)

    monkeypatch.setattr(field_scores, "strip_of", told)
    asked = (field, located, frozen, codes, classes_of(field, located, codes))
    whole, strips = class_maps(*asked), class_maps(*asked, strip_megabytes=0.1)
    assert rows == [frozen[1].tiles_y, 3] == [8, 3]
    cosines, alphas = jax.jit(lambda: pixel_cosines(field, located, *frozen, jnp.asarray(codes)))()
    np.testing.assert_array_equal(whole[0], np.where(alphas > 0.5, cosines.argmax(-1), -1))
    for one, other in zip(whole, strips, strict=True):
        np.testing.assert_array_equal(one, other)
        assert len(np.unique(one)) > 3


def test_a_run_goes_on_with_what_it_was_begun_with_or_not_at_all(
    gsjax, monkeypatch, recording, scene, tmp_path
):
    file, out = Path(shutil.copy(scene, tmp_path / "scene.ply")), tmp_path / "field"
    told = (
        "distill",
        file,
        "--out",
        out,
        "--images",
        recording,
        "--frames",
        "0:1",
        "--test-every",
        0,
        *SMALL,
    )
    told += ("--field.iterations", 20)
    steps = []

    def hear():
        steps.append(1)
        if len(steps) == 5:
            raise KeyboardInterrupt

    with monkeypatch.context() as patch:
        patch.setattr(learning, "hear", hear)
        assert gsjax(*told)[0] == 130
    before, mask = (out / "field.npz").read_bytes(), recording / "seg/0/000000.png"
    gaussians = read_ply(file)[0]
    write_ply(file, replace(gaussians, means=gaussians.means + 0.01))
    code, said = gsjax(*told, "--resume")
    assert code == 2
    assert f"--resume: {file}: expected what the run in {out} was begun with" in said
    shutil.copy(scene, file)
    kept = mask.read_bytes()
    cv2.imwrite(str(mask), cv2.imread(str(mask), cv2.IMREAD_UNCHANGED)[:, ::-1])
    code, said = gsjax(*told, "--resume")
    assert code == 2
    assert "--resume: what is said of photographs, and their poses" in said
    assert (out / "field.npz").read_bytes() == before
    mask.write_bytes(kept)
    assert gsjax(*told, "--resume")[0] == 0


def test_a_run_is_told_by_what_paths_mean_not_by_how_they_are_typed(monkeypatch, tmp_path):
    monkeypatch.chdir(tmp_path)
    for name in ("features", "clip", "sam"):
        (tmp_path / name).mkdir()

    def settings(base):
        told = Options(base / "scene.ply", features=str(base / "features"), sam=base / "sam")
        asked = TeacherChoice(told.features, sam=told.sam)
        return distill._settings(told, asked)

    assert settings(Path()) == settings(tmp_path)
    asked = TeacherChoice("clip", weights=Path("clip"))
    named = distill._settings(Options(Path("run"), features="clip", weights=Path("clip")), asked)
    assert (named.features, named.weights) == ("clip", tmp_path / "clip")


@pytest.fixture
def encoders(request, monkeypatch):
    """Tiny CLIP and SAM of random weights, and what tells `gsjax distill` of them."""
    from gsjax.perception import sam

    def unsure(path, load=sam.load_sam):
        return replace(load(path), points_per_side=4, min_score=-9.0, min_stability=-1.0, min_pixels=1)

    monkeypatch.setattr(sam, "load_sam", unsure)
    clip = ("--weights", request.getfixturevalue("clip_folder"))
    return {
        "clip": ("--features", "clip", *clip),
        "second": ("--features", "clip", "--second", "maskclip", *clip),
        "maskclip": ("--features", "maskclip", *clip),
        "sam": ("--features", "closed", "--sam", request.getfixturevalue("sam_folders")[1]),
    }


@needs_foundation
@pytest.mark.parametrize(
    ("name", "kind", "masks", "dimension"),
    [
        ("clip", "clip", "files", 12),
        ("second", "clip", "files", 12),
        ("maskclip", "maskclip", "none", 12),
        ("sam", "closed", "sam", 17),
    ],
)
def test_foundation_models_teach(gsjax, pristine, scene, tmp_path, encoders, name, kind, masks, dimension):
    told = ("--images", pristine, "--frames", "0:1", "--eval-cameras", 2, *SMALL, "--field.iterations", 40)
    code, said = gsjax("distill", scene, "--out", tmp_path / name, *told, *encoders[name])
    assert code == 0, said
    found = metrics(tmp_path / name)
    assert (found["features"], found["masks"], found["dimension"]) == (kind, masks, dimension)
    assert ("MaskCLIP" in found["features_are"] or "patches" in found["features_are"]) == (
        name in ("second", "maskclip")
    )
    assert found["curve"][-1]["cos"] < found["curve"][0]["cos"]
    assert found["test"]["cosine"] > 0.3
    if kind == "clip":
        code, said = gsjax("query", tmp_path / name, "red can", "--threshold", -1)
        assert code == 0, said
