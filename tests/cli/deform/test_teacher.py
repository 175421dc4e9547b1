"""What `gsjax deform` learns besides classes of masks: features from files and encoders, and how a scene
that learned them is queried."""

import json
import re
from dataclasses import replace
from pathlib import Path

import hypothesis.strategies as st
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings
from rich.console import Console

from gsjax.cli import main
from gsjax.data import open_sequence
from gsjax.engine.deform.data import deform_data
from gsjax.engine.deform.file import read_deformation, write_deformation
from gsjax.engine.deform.teacher import GROUPS, basis_of, groups_of
from gsjax.engine.messages import Notes
from gsjax.engine.teaching.choice import TeacherChoice
from gsjax.engine.teaching.source import Source
from gsjax.methods.deform import Deform, DeformConfig, Meaning, counted_ids, feature_prompt, text_prompt
from tests.cli.deform.test_command import SCENE, SMALL
from tests.perception.test_clip import clip_folder  # noqa: F401
from tests.perception.test_foundation import needs_foundation

DIMENSION, GRID = 24, (13, 16)
OF_TISSUE, OF_TOOL = np.random.default_rng(0).normal(size=(2, DIMENSION)).astype(np.float32)


def feature_map(t, shape=GRID):
    """A feature map as a model might return it: a vector for tissue and one for the tool, with some noise."""
    mask = open_sequence(SCENE).mask(t, 0)
    rows, columns = (np.arange(n) * m // n for n, m in zip(shape, mask.shape, strict=True))
    tool = mask[np.ix_(rows, columns)] > 0
    noise = 0.05 * np.random.default_rng(t).normal(size=(*shape, DIMENSION))
    return (np.where(tool[..., None], OF_TOOL, OF_TISSUE) + noise).astype(np.float32)


@pytest.fixture(scope="module")
def files(tmp_path_factory):
    folder = tmp_path_factory.mktemp("features")
    for t in range(10):
        np.save(folder / f"{t:06d}.npy", feature_map(t))
    return folder


def told(run, *options):
    return [str(one) for one in ("deform", SCENE, "--out", run, "--tools", "draw", *SMALL, *options)]


@pytest.fixture(scope="module")
def learned(files, tmp_path_factory):
    run = tmp_path_factory.mktemp("learned") / "run"
    assert main(told(run, "--features", files, "--deform.rates.features", 0.03)) == 0
    return run


def query(run, *options):
    assert main(["query", *map(str, (run, *options))]) == 0
    return json.loads((run / "query" / "query.json").read_text())


def data_of(features, folder, channels=4, **asked):
    console = Console(quiet=True)
    given = (TeacherChoice(str(features), **asked), channels, (), notes := Notes(console), console)
    return deform_data(open_sequence(SCENE), 8, "draw", *given), " ".join(notes.all)


@pytest.mark.thorough
def test_feature_files_are_learned_and_judged_on_their_grid(learned):
    found = json.loads((learned / "metrics.json").read_text())
    assert found["features"] == "files"
    assert found["names"] == ["group 1", "group 2"]
    assert [row["f_psnr"] is None for row in found["scores"]] == [False, False]
    assert 0.6 < found["test"]["iou"] <= 1
    assert found["curve"][-1]["feature"] < found["curve"][0]["feature"]
    stored = read_deformation(learned / "deformation.npz")
    assert stored.meaning.basis.shape == (DIMENSION, 4)
    assert stored.scene.gaussians.features.shape[1] == 4


@pytest.mark.thorough
def test_what_files_taught_is_asked_by_place_and_without_a_prompt(learned):
    mask = open_sequence(SCENE).mask(0, 0) > 0
    y, x = (int(np.median(axis)) for axis in np.nonzero(mask))
    found = query(learned, "--point", f"{x},{y}", "--frame", 0)
    assert found["meant"].startswith("group ")
    assert 0 < found["gaussians"] < found["of"]
    assert set(query(learned)["classes"]) <= {f"group {n}" for n in range(1, GROUPS + 1)}


def test_nobody_reads_a_text_in_the_space_of_files(learned, capsys):
    assert main(["query", str(learned), "tool"]) == 2
    said = " ".join(capsys.readouterr().err.split())
    assert re.search("no encoder of their texts.*--point.*or by a name: group 1, group 2", said)


def test_masks_with_embeddings_are_rows_of_one_codebook(tmp_path):
    for t in range(10):
        ids = (open_sequence(SCENE).mask(t, 0) > 0).astype(np.int32)
        np.savez(tmp_path / f"{t:06d}.npz", ids=ids, codebook=np.stack([OF_TISSUE, OF_TOOL]))
    data, said = data_of(tmp_path, tmp_path)
    assert len(data.lesson.codebook) == 2
    assert data.names == ("group 1", "group 2")
    assert "4 channels keep 100.0% of its 24 numbers" in said
    cosine = OF_TISSUE @ OF_TOOL / np.linalg.norm(OF_TISSUE) / np.linalg.norm(OF_TOOL)
    ours = data.lesson.codebook / np.linalg.norm(data.lesson.codebook, axis=1, keepdims=True)
    np.testing.assert_allclose(ours[0] @ ours[1], cosine, atol=1e-6)  # the basis keeps angles


def test_a_map_is_learned_where_it_counts_and_a_held_out_frame_may_lack_one(files, tmp_path):
    for t in (t for t in range(10) if t != 9):
        np.save(tmp_path / f"{t:06d}.npy", feature_map(t))
    data, said = data_of(tmp_path, tmp_path)
    assert sorted(data.taught.held_out) == [1]
    assert "not compared with the teacher: frames 9 (" in said
    ids, codes = data.labels(data.train[3])
    t = data.train[3]
    scale = np.linalg.norm([feature_map(i) for i in data.train], axis=-1).mean()
    np.testing.assert_allclose(codes[ids], feature_map(t) / scale @ data.meaning.basis, atol=1e-5)


@pytest.mark.parametrize(
    ("options", "words"),
    [
        (("--features", "nowhere"), ("--features nowhere", "auto, classes", "maskclip, none, or a folder")),
        (("--features", "clip"), ("--features clip", "--weights PATH too")),
        (("--features", "none", "--masks", "segment"), ("--masks", "which need masks", "found none")),
        (("--features", "maskclip", "--sam", "."), ("--sam", "which need masks", "found maskclip")),
        (("--features", "none", "--weights", "."), ("--weights", "found none")),
        (("--sam", "."), ("--sam", "found auto")),
        (("--features", "classes", "--level", "small"), ("--level small", "LangSplat")),
    ],
)
def test_options_that_contradict_each_other(options, words, tmp_path, capsys):
    assert main(told(tmp_path / "run", *options)) == 2
    said = " ".join(capsys.readouterr().err.split())
    assert all(word in said for word in words), said
    assert not (tmp_path / "run").exists()


def test_files_that_do_not_fit(files, tmp_path):
    with pytest.raises(FileNotFoundError, match="expected features of the image 000000"):
        data_of(tmp_path, tmp_path)
    for t in range(10):
        np.save(tmp_path / f"{t:06d}.npy", feature_map(t, (13, 16) if t else (26, 32)))
    with pytest.raises(
        ValueError, match=r"one grid size in all frames, found \(frames of each\) 16x13 \(7\), 32x26"
    ):
        data_of(tmp_path, tmp_path)
    np.save(tmp_path / "000000.npy", feature_map(0, (16, 13)))
    with pytest.raises(ValueError, match="aspect ratio of 000000, 64x52, found 13x16; are axes swap"):
        data_of(tmp_path, tmp_path)


def test_the_closed_vocabulary_teaches_and_reads(tmp_path):
    """Tissue is pink and the tool grey; a colour's name finds the Gaussians of that colour."""
    data, said = data_of("closed", tmp_path, 16)
    assert "no foundation model" in said
    prompt = text_prompt(data.meaning, "grey")
    scores = np.asarray(prompt.scores(jnp.asarray(data.lesson.codebook, jnp.float32)))
    threshold = prompt.threshold(scores)
    assert threshold.rule == "the encoder's own"
    ids, mask = data.labels(0).ids, open_sequence(SCENE).mask(0, 0)
    assert (scores[ids[mask > 0]] > threshold.value).all()
    assert (scores[ids[mask == 0]] < threshold.value).all()
    with pytest.raises(ValueError, match="--weights"):
        data.meaning.source.encoder(Path("x"))
    assert text_prompt(data.meaning, "Group 2").name == "group 2"  # names of its groups need no encoder
    assert "or one of: group 1, group 2" in data.meaning.hint()


def test_one_kind_of_thing_is_one_group(tmp_path):
    for t in range(10):
        np.savez(tmp_path / f"{t:06d}.npz", ids=np.zeros((52, 64), int), codebook=OF_TISSUE[None] + 0.01 * t)
    data, said = data_of(tmp_path, tmp_path)
    assert data.names == ("group 1",)
    assert "all of it is alike, one group" in said


def test_cells_of_which_a_tool_has_a_part_do_not_count(files):
    seen, console = open_sequence(SCENE), Console(quiet=True)
    given = ("leave-out", TeacherChoice(str(files)), 4, (), Notes(console), console)
    data = deform_data(seen, 8, *given)
    mask = seen.mask(data.train[0], 0) > 0
    cells = mask.reshape(13, 4, 16, 4).any(axis=(1, 3))
    np.testing.assert_array_equal(counted_ids(data.lesson.ids[0], data.frames[0].masks[0]) < 0, cells)
    tool = OF_TOOL @ data.meaning.basis  # which was not learned
    assert np.linalg.norm(tool) < 0.75 * np.linalg.norm(OF_TOOL)
    problem, _ = Deform(DeformConfig(channels=4)).start(data.frames, data.lesson)
    np.testing.assert_array_equal(problem.ids[0] < 0, cells)


def test_files_are_found_by_the_names_of_pictures(tmp_path):
    """Also for some frames of a recording, scaled down."""
    for t in range(10):
        np.save(tmp_path / f"frame-{t:06d}.color.npy", feature_map(t))
        (tmp_path / f"frame-{t:06d}.color.png").touch()
    whole = replace(open_sequence(SCENE), locate=lambda kind, t, c: f"{tmp_path}/frame-{t:06d}.color.png")
    seen = whole.select(frames=range(2, 10)).scaled(0.5)
    console = Console(quiet=True)
    given = ("draw", TeacherChoice(str(tmp_path)), 4, (), Notes(console), console)
    found = deform_data(seen, 8, *given)
    assert sorted(found.taught.held_out) == [1]
    ids, codes = found.labels(0)
    scale = np.linalg.norm([feature_map(2 + i) for i in found.train], axis=-1).mean()
    np.testing.assert_allclose(codes[ids], feature_map(2) / scale @ found.meaning.basis, atol=1e-5)


@pytest.mark.slow
def test_a_run_of_features_goes_on_to_the_same_bits(files, learned, tmp_path, interrupted):
    options = ("--features", files, "--deform.rates.features", 0.03)
    with interrupted(25):
        assert main(told(tmp_path / "run", *options)) == 130
    assert main(told(tmp_path / "run", *options, "--resume")) == 0
    ours, theirs = (read_deformation(run / "deformation.npz") for run in (tmp_path / "run", learned))
    np.testing.assert_array_equal(ours.scene.gaussians.features, theirs.scene.gaussians.features)


@needs_foundation
def test_clip_teaches_and_reads(tmp_path, request, monkeypatch):
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    weights = request.getfixturevalue("clip_folder")
    run = tmp_path / "run"
    assert main(told(run, "--features", "clip", "--weights", weights)) == 0
    assert query(run, "--point", "5,5")["features"] == "clip"
    found = query(run, "a tool", "--threshold", 0.01)
    assert found["against"] == ["object", "things", "stuff", "texture"]
    assert (found["threshold"], found["meant"]) == (0.01, None)
    found = query(run, "a tool", "--negatives", "tissue", "--threshold", 0.01)
    assert found["against"] == ["tissue"]


def test_classes_are_named_and_nothing_else():
    names = ("tissue", "tool")
    meaning = Meaning(Source("classes", dict(enumerate(names, 1))), names, np.eye(2), np.eye(5, 2))
    assert text_prompt(meaning, "Tool").name == "tool"
    with pytest.raises(ValueError, match="--negatives: the name of a class is compared with the other names"):
        text_prompt(meaning, "tool", ("x",))
    with pytest.raises(ValueError, match="no class 'forceps'"):
        text_prompt(meaning, "forceps")


def test_a_place_is_told_apart_from_the_other_names():
    meaning = Meaning(Source("files"), ("a", "b"), np.eye(2), np.eye(5, 2))
    prompt = feature_prompt(meaning, np.array([0.1, 0.9]))
    assert (prompt.name, prompt.negatives) == ("b", ("a",))
    scores = np.asarray(prompt.scores(jnp.array([[1.0, 0], [0.1, 0.9], [0, 0]])))
    assert scores[1] > 0.99 > 0.5 > scores[0]
    np.testing.assert_allclose(scores[2], 0.5)


def test_what_was_asked_for_is_meant_however_alike_the_names_are():
    """As with groups of CLIP features, whose cosines are 0.9: a share among all eight would be only 0.28."""
    codebook = np.sqrt(0.9) * np.eye(9)[[0] * 8] + np.sqrt(0.1) * np.eye(9)[1:]
    names = tuple(f"group {n}" for n in range(1, 9))
    prompt = feature_prompt(Meaning(Source("files"), names, codebook, np.eye(9)), 0.3 * codebook[4])
    scores = np.asarray(prompt.scores(jnp.asarray(codebook)))
    assert prompt.threshold(scores).value == 0.5
    np.testing.assert_array_equal(np.flatnonzero(scores > 0.5), [4])


@settings(deadline=None, max_examples=30)
@given(st.integers(0, 2**31), st.integers(1, 6), st.integers(1, 8), st.integers(1, 5))
def test_a_basis_is_orthonormal_and_keeps_all_where_there_is_room(seed, rank, channels, more):
    rng = np.random.default_rng(seed)
    vectors = rng.normal(size=(rank + more, rank)) @ rng.normal(size=(rank, 12))
    basis, kept = basis_of(np.array_split(vectors, 2), channels)
    gram = basis.T @ basis
    held = min(rank, channels)
    np.testing.assert_allclose(gram, np.diag([1.0] * held + [0.0] * (channels - held)), atol=1e-9)
    ours = vectors @ basis
    np.testing.assert_allclose(kept, (ours**2).sum() / (vectors**2).sum(), rtol=1e-6)
    if channels >= rank:
        np.testing.assert_allclose(ours @ ours.T, vectors @ vectors.T, atol=1e-6)


def test_groups_are_kinds_the_largest_first():
    rng = np.random.default_rng(1)
    kinds = np.eye(5)[np.repeat([0, 2, 4], [30, 50, 10])]
    codes = kinds * rng.uniform(0.5, 2, (90, 1)) + 0.01 * rng.normal(size=(90, 5))
    ones = np.ones(90)
    groups = groups_of(codes, ones)
    np.testing.assert_array_equal(groups.argmax(axis=1), [2, 0, 4])
    heavy = np.where(kinds[:, 4] > 0, 100.0, 1.0)
    np.testing.assert_array_equal(groups_of(codes, heavy).argmax(axis=1), [4, 2, 0])
    np.testing.assert_allclose(groups_of(np.eye(5)[[3, 3, 1]], np.array([1.0, 1, 5])), np.eye(5)[[1, 3]])
    assert len(groups_of(rng.normal(size=(5000, 4)), np.ones(5000))) <= GROUPS


@settings(deadline=None, max_examples=30)
@given(st.integers(0, 2**31), st.integers(1, 5), st.integers(1, 60))
def test_groups_are_as_many_as_there_are_kinds(seed, kinds, each):
    """For orthogonal kinds with 5 % of noise, however few codes there are of each."""
    rng = np.random.default_rng(seed)
    of = np.repeat(np.arange(kinds), each)
    codes = np.eye(8)[of] + 0.02 * rng.normal(size=(len(of), 8))
    groups = groups_of(rng.permutation(codes), np.ones(len(of)))
    assert sorted(groups.argmax(axis=1)) == list(range(kinds))


def test_maps_of_zeros_say_nothing(tmp_path):
    for t in range(10):
        np.save(tmp_path / f"{t:06d}.npy", np.zeros((13, 16, 3), np.float32))
    with pytest.raises(ValueError, match="found zeros alone"):
        data_of(tmp_path, tmp_path)


@pytest.mark.thorough
def test_of_one_name_all_are_that_and_nothing_is_asked(learned, tmp_path, capsys):
    run = tmp_path / "run"
    run.mkdir()
    stored = read_deformation(learned / "deformation.npz")
    alone = replace(stored.meaning, names=("group 1",), codebook=stored.meaning.codebook[:1])
    write_deformation(run / "deformation.npz", replace(stored, meaning=alone))
    (run / "metrics.json").write_text('{"complete": false, "steps": 7}')
    assert query(run)["classes"] == {"group 1": stored.scene.gaussians.num}
    assert "run is a partial run of 7 steps" in " ".join(capsys.readouterr().err.split())
    assert main(["ask", str(run), "where is group 1 in frame 0?"]) == 2
    assert "two things or more to ask about, found group 1 alone" in " ".join(capsys.readouterr().err.split())
