"""The Python verb `distill`, and the files that keep its ticks and its result."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from gsjax.data import open_sequence, photographs_of
from gsjax.engine.checkpoint import load, save, write_field
from gsjax.engine.distill.file import read_field
from gsjax.engine.teaching.choice import TeacherChoice
from gsjax.engine.verbs import distill
from gsjax.methods.distill import DistillConfig, Teacher, teacher_of_objects
from gsjax.scene.feature_grid import FeatureGridConfig
from tests.cli.conftest import first_picture

GRID = FeatureGridConfig(
    levels=2, least_resolution=4, most_resolution=8, log2_entries=9, features=4, hidden=16
)
SMALL = DistillConfig(iterations=4, channels=8, grid=GRID, contrast_patch=4)


@pytest.fixture(scope="module")
def shown(pristine):
    """A scene, and photographs of it."""
    sequence = open_sequence(str(pristine)).select(frames=slice(0, 1))
    return jax.tree.map(jnp.asarray, first_picture(pristine)[0]), photographs_of(sequence)


@pytest.mark.thorough
def test_a_scene_and_photographs_make_a_field_that_answers_and_goes_on(shown, tmp_path, monkeypatch):
    scene, photographs = shown
    for now in distill(scene, photographs, "classes", SMALL):
        if now.step == 2:
            save(tmp_path / "run.npz", now)
    scores = np.asarray(now.result.query("can"))
    assert scores.shape == (scene.num,)
    assert ((scores >= 0) & (scores <= 1)).all()  # against all other classes
    before = load(tmp_path / "run.npz")
    assert before.result.source == now.result.source
    assert np.isfinite(before.result.query("can")).all()
    *_, again = distill(scene, photographs, "classes", SMALL, after=before)
    assert again.step == 4
    np.testing.assert_array_equal(again.result.query("can"), scores)
    write_field(tmp_path / "field.npz", now.result)
    read = read_field(tmp_path / "field.npz")
    assert (read.source, dict(read.scene)) == (now.result.source, now.result.scene)
    for one, other in zip(read.at(scene.means), now.result.placed, strict=True):
        jax.tree.map(np.testing.assert_array_equal, one, other)

    def interrupted(stream, **arrays):
        stream.write(b"half of it")
        raise KeyboardInterrupt

    monkeypatch.setattr(np, "savez_compressed", interrupted)
    with pytest.raises(KeyboardInterrupt):  # the earlier file stays
        write_field(tmp_path / "field.npz", before.result)
    assert [file.name for file in tmp_path.glob("*field*")] == ["field.npz"]
    assert len(read_field(tmp_path / "field.npz").field.lift) == len(now.result.field.lift)


@pytest.mark.thorough
def test_features_on_three_levels_are_learned_together(shown, pristine, tmp_path):
    """Files in LangSplat's layout, with levels of single objects, of can and carton together, and of all."""
    scene, photographs = shown
    codes = np.linalg.qr(np.random.default_rng(0).normal(size=(20, 20)))[0].astype(np.float32)
    groups = [list(range(8)), [0, 1, 2, 2, 3, 4, 5, 6], [0, 1, 1, 1, 1, 1, 1, 1]]
    starts = np.cumsum([0, *(max(group) + 1 for group in groups)])
    for i, name in enumerate(photographs.names):
        labels = photographs.labels(i).astype(int)
        rows = [np.array(group)[labels] + start for group, start in zip(groups, starts, strict=False)]
        file = tmp_path / name
        file.parent.mkdir(parents=True, exist_ok=True)
        np.save(file.with_name(f"{file.stem}_s.npy"), np.stack([rows[0], *rows]))
        np.save(file.with_name(f"{file.stem}_f.npy"), codes[: starts[-1]])
    teacher = TeacherChoice(str(tmp_path), level="each")
    config = DistillConfig(start="solve", iterations=0)
    *_, now = distill(scene, photographs, teacher, config)
    result = now.result
    assert result.levels == ("small", "medium", "large")
    labels = first_picture(pristine)[1]
    for group, start, level in zip(groups, starts, result.levels, strict=False):
        for label in (2, 3):
            wanted = np.array(group)[labels] == group[label]
            others = [code for code in range(start, start + max(group) + 1) if code != start + group[label]]
            vectors = codes[[start + group[label], *others]]
            assert result.best_level(vectors) == level
            found = np.asarray(result.scores(vectors) > 0.5)
            assert (found & wanted).sum() / (found | wanted).sum() > 0.7
            np.testing.assert_array_equal(result.scores(vectors), result.scores(vectors, level))
    write_field(tmp_path / "field.npz", result)
    assert read_field(tmp_path / "field.npz").levels == result.levels
    with pytest.raises(ValueError, match="level: expected small, medium, large, found huge"):
        result.scores(codes[:1], "huge")
    with pytest.raises(ValueError, match=r"expected queries \[q, 20\], .* found \[1, 60\]"):
        result.scores(np.ones((1, 60)))


@pytest.mark.thorough
def test_a_teacher_of_ones_own_needs_an_encoder_for_texts_alone(shown):
    scene, photographs = shown
    masks = [photographs.labels(i).astype(int) for i in range(photographs.num)]
    codes = np.eye(8, 16, dtype=np.float32)
    teacher = teacher_of_objects(masks, [codes] * photographs.num)
    assert isinstance(teacher, Teacher)
    ticks = distill(scene, photographs, teacher, SMALL)
    next(ticks)
    assert np.isfinite(ticks.result.scores(codes[[3, 2]])).all()
    with pytest.raises(ValueError, match="no encoder of their texts is known"):
        ticks.result.query("can")
