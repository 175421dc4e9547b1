"""What photographs teach: names of labels, outlines, features from files; and which teach nothing."""

import warnings
from dataclasses import replace

import numpy as np
import pytest
from rich.console import Console

from gsjax.data.errors import DataWarning
from gsjax.data.photographs import Photographs
from gsjax.engine.teaching import teaching as field_teacher
from gsjax.engine.teaching.cache import FeatureCache
from gsjax.engine.teaching.choice import TeacherChoice
from gsjax.engine.teaching.teaching import Teaching
from gsjax.perception.masks import Detections
from gsjax.perception.sam import SamSegmenter

QUIET = Console(quiet=True)


def photographs(labels, names=None):
    """Photographs of noise with these labels; None for a photograph without labels."""
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


def taught(shown, indices, asked):
    asked.check()
    return Teaching(shown, indices, asked, FeatureCache(), QUIET)


THREE, TWO, OTHER = np.array([[0, 0, 1, 2]] * 3), np.array([[0, 0, 1, 1]] * 3), np.array([[0, 5, 1, 1]] * 3)


@pytest.mark.parametrize("features", ["classes", "closed"])
def test_held_out_views_are_asked_about_in_the_terms_of_those_that_taught(features):
    shown = photographs([THREE, TWO, OTHER, None])
    said = taught(shown, [0], TeacherChoice(features))
    assert said.source.names == {1: "background", 2: "object 1", 3: "object 2"}
    alone, others, nobody = (said.of(i) for i in (1, 2, 3))
    assert alone.dimension == others.dimension == said.teacher.dimension
    assert nobody is None
    if features == "classes":
        code = said.source.encoder().embed_text("object 1")
        np.testing.assert_array_equal(others.codebook[others.ids[0][0, 8]], code / np.linalg.norm(code))
        assert others.ids[0][0, 4] == -1  # what 5 is was not taught
    one_more = taught(photographs([TWO, THREE]), [0], TeacherChoice(features))
    assert one_more.source.names == {1: "background", 2: "foreground"}
    named = taught(photographs([THREE], {1: "Background", 2: "cup"}), [0], TeacherChoice(features))
    assert named.source.names == {1: "unlabelled", 2: "Background", 3: "cup"}
    alike = taught(photographs([THREE], {1: "cup", 2: "Cup"}), [0], TeacherChoice(features))
    assert alike.source.names == {1: "background", 2: "cup (1)", 3: "Cup (2)"}
    assert one_more.of(1).dimension == one_more.teacher.dimension


def test_outlines_can_be_put_on_edges():
    true = np.zeros((12, 16), int)
    true[3:9, 4:12] = 1
    off = np.roll(true, 1, axis=1)  # by a pixel
    shown = replace(
        photographs([TWO]),
        load_image=lambda i: np.uint8(200 * true[..., None] + 30).repeat(3, 2),
        load_labels=lambda i: off,
    )
    choices = [TeacherChoice("classes", snap=pixels) for pixels in (0, 2)]
    as_they_are, snapped = (taught(shown, [0], choice).teacher for choice in choices)
    thing = {k: t.ids[0] == t.ids[0][6, 8] for k, t in (("off", as_they_are), ("on", snapped))}
    np.testing.assert_array_equal(thing["off"], off == 1)
    assert (
        ((thing["on"] & true).sum() / (thing["on"] | true).sum())
        > 0.9
        > (off & true).sum() / (off | true).sum()
    )
    with pytest.raises(ValueError, match="--snap: expected 0 or more pixels, found -1"):
        TeacherChoice(snap=-1).check()


def test_numbers_of_labels_cost_nothing(monkeypatch):
    from gsjax.perception.codebook import ClassCodebook

    counts, embed = [], ClassCodebook.embed_objects

    def counted(self, image, labels, count):
        counts.append(count)
        return embed(self, image, labels, count)

    monkeypatch.setattr(ClassCodebook, "embed_objects", counted)
    large = np.array([[0, 26003, 7, 7]] * 3, np.int32)
    said = taught(photographs([large, THREE], {26003: "car", 7: "road"}), [0], TeacherChoice())
    assert said.source.names == {1: "background", 8: "road", 26004: "car"}
    code = ClassCodebook({1: "car"}).embed_text("car")
    np.testing.assert_allclose(said.teacher.codebook[said.teacher.ids[0][0, 4]], code, atol=1e-6)
    assert (said.of(1).ids[0] >= 0).sum() == 96  # the background, the only label with a name
    assert counts == [3, 5]


def test_weights_are_read_once_however_many_pictures_there_are(tmp_path, monkeypatch):
    weights, digested = tmp_path / "sam", []
    weights.mkdir()
    monkeypatch.setattr(
        "gsjax.perception.sam.load_sam", lambda path: lambda image, depth, K: image[..., 0] // 64
    )
    monkeypatch.setattr(field_teacher, "folder_digest", lambda path: digested.append(path) or "digest")
    said = taught(photographs([None] * 3), [0, 1, 2], TeacherChoice("closed", sam=weights))
    assert (said.masks, digested) == ("sam", [weights])


def test_masks_of_sam_teach_on_all_levels_or_on_one(tmp_path, monkeypatch):
    """A thing and its part, which is on the middle level and, as nothing is smaller, also on the smallest."""
    weights = tmp_path / "sam"
    weights.mkdir()
    monkeypatch.setattr(field_teacher, "folder_digest", lambda path: "digest")
    masks, segmented = np.zeros((2, 12, 16), bool), []
    masks[0, 2:10, 2:14], masks[1, 4:8, 4:8] = True, True

    class Found(SamSegmenter):
        def find(self, image):
            segmented.append(1)
            return Detections(np.zeros((2, 4)), np.ones(2), masks)

    monkeypatch.setattr("gsjax.perception.sam.load_sam", lambda path: Found(None, None, None, min_pixels=1))
    shown = photographs([None] * 2)
    taught_by = {
        level: taught(shown, [0, 1], TeacherChoice("closed", sam=weights, level=level))
        for level in ("default", "small", "medium", "large", "each")
    }
    ids = {level: said.teacher.ids[0] for level, said in taught_by.items()}
    for level, parts in {"default": 2, "small": 2, "medium": 2, "large": 1, "each": 2}.items():
        np.testing.assert_array_equal(ids[level] >= 0, masks[0])
        assert len(np.unique(ids[level][masks[0]])) == parts, level
    assert taught_by["each"].source.levels == ("small", "medium", "large")
    assert taught_by["small"].source.levels == ()
    each, one = (taught_by[level].teacher for level in ("each", "small"))
    assert each.dimension == 3 * one.dimension
    part, rest = (each.codebook[ids["each"][y, 5]].reshape(3, -1) for y in (5, 9))
    assert not np.allclose(part[1], part[2])
    np.testing.assert_allclose(part[0], part[1])
    np.testing.assert_allclose(rest, np.stack([part[2]] * 3))
    assert len(segmented) == 2 * 2  # of each photograph once for default, and once for all levels
    assert taught_by["each"].of(1).dimension == each.dimension
    masks[:] = False  # in another photograph nothing is found
    taught_by["each"]._photographs = replace(shown, load_image=lambda i: np.zeros((12, 16, 3), np.uint8))
    assert taught_by["each"].of(1) is None
    for options, words in (
        (
            {"features": "clip", "weights": weights, "sam": weights, "second": "maskclip"},
            "maps of patches",
        ),
        ({"features": "maskclip", "weights": weights, "sam": weights}, "maps of patches"),
        ({"features": "closed"}, "expected --features FOLDER, with LangSplat's files, or --sam"),
    ):
        with pytest.raises(ValueError, match=f"--level each: {words}"):
            TeacherChoice(**options, level="each").check()
    with pytest.raises(ValueError, match="--level each: a scene that deforms has"):
        TeacherChoice("closed", sam=weights, level="each").check(optional=True)


def test_features_of_files_are_found_by_all_photographs(tmp_path):
    shown, maps = photographs([None] * 3), np.random.default_rng(0).normal(size=(3, 3, 4, 5))
    np.save(tmp_path / "level_0.npy", maps)  # LERF's layout: the maps of all pictures, in order
    said = taught(shown, [0, 2], TeacherChoice(str(tmp_path)))
    cosines = np.einsum("hwd,hwd->hw", said.teacher.maps[1], maps[2]) / np.linalg.norm(maps[2], axis=-1)
    np.testing.assert_allclose(cosines, np.linalg.norm(said.teacher.maps[1], axis=-1), rtol=1e-5)
    assert said.of(1).maps[0].shape == (3, 4, 5)
    (tmp_path / "level_0.npy").unlink()
    for i in (0, 2):
        (tmp_path / f"cam{i}").mkdir()
        np.save(tmp_path / f"cam{i}/a.npy", maps[i])
    said = taught(shown, [0, 2], TeacherChoice(str(tmp_path)))  # held-out ones need not be there
    with pytest.raises(FileNotFoundError, match=r"cam1/a\.png"):
        said.of(1)
    (tmp_path / "cam1").mkdir()
    np.save(tmp_path / "cam1/a.npy", maps[1, ..., :2])
    with pytest.raises(ValueError, match=r"cam1/a\.npy: expected features of 5 numbers .* found 2"):
        said.of(1)
    np.save(tmp_path / "cam2/a.npy", maps[2, :, :1])
    with pytest.raises(ValueError, match=r"cam2/a\.npy: expected features .* cam2/a\.png, 16x12, found 1x3"):
        taught(shown, [0, 2], TeacherChoice(str(tmp_path)))


def test_photographs_without_masks_are_named():
    with pytest.warns(DataWarning, match=r"teach nothing: cam1/a\.png, cam3/a\.png$"):
        said = taught(photographs([THREE, None, TWO, None]), [0, 1, 2, 3], TeacherChoice())
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        assert said.of(1) is None
