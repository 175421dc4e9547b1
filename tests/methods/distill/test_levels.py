"""Embeddings missing from one level of a view are filled in from other views: an object of two parts, which
some views lack."""

from dataclasses import replace

import numpy as np
import pytest

from gsjax.engine.drive import drive
from gsjax.engine.teaching.source import Source
from gsjax.methods.distill import PRESETS, Distill, frozen_views, teacher_of_objects
from gsjax.methods.distill import levels as of_levels
from gsjax.methods.distill.levels import complete_teacher
from tests.methods.distill.two_balls import cameras, two_balls

NAMES = ("small", "large")
CODES = np.linalg.qr(np.random.default_rng(2).normal(size=(8, 8)))[0][:4].astype(np.float32)
NOTHING, ONE, OTHER, THING = range(4)  # rows of the codes; the two balls together are the thing
LACKING = {0: (1, 2), 3: (1,), 6: (2,)}  # by view: the balls for which it has no small mask


@pytest.fixture(scope="module")
def scene():
    return two_balls()


def lesson(masks, lacking):
    """A teacher on two levels, in which small masks that views lack are filled in from the large ones."""
    combinations = [(NOTHING, NOTHING), (ONE, THING), (OTHER, THING), (THING, THING)]
    codebook = np.stack([np.concatenate([CODES[k] for k in pair]) for pair in combinations])
    missing = [np.isin(mask, lacking.get(v, ())) for v, mask in enumerate(masks)]
    ids = [np.where(gone, 3, mask) for gone, mask in zip(missing, masks, strict=True)]
    filled = [np.stack([gone, np.zeros_like(gone)], axis=-1) for gone in missing]
    return teacher_of_objects(ids, [codebook] * len(ids), filled)


def embeddings_of(teacher, v):
    return teacher.codebook[np.maximum(teacher.ids[v], 0)].reshape(*teacher.ids[v].shape, 2, -1)


@pytest.mark.thorough
def test_other_views_tell_what_a_view_lacks(scene):
    gaussians, _, masks = scene
    given, true = lesson(masks, LACKING), lesson(masks, {})
    found = complete_teacher(given, frozen_views(gaussians, cameras(8)), gaussians.num)
    assert found.filled is None
    for v in range(8):
        same = np.isclose(embeddings_of(found, v), embeddings_of(true, v), atol=1e-5).all(axis=(-1, -2))
        known = ~given.filled[v].any(axis=-1)
        assert same[known].all()
        assert same[~known].mean() > 0.95 if (~known).any() else True


@pytest.mark.thorough
def test_what_no_view_has_on_a_level_stays_that_of_the_next(scene):
    gaussians, _, masks = scene
    given = lesson(masks, {v: (1,) for v in range(8)})
    found = complete_teacher(given, frozen_views(gaussians, cameras(8)), gaussians.num)
    for v in range(8):
        same = np.isclose(embeddings_of(found, v), embeddings_of(given, v), atol=1e-5).all(axis=(-1, -2))
        assert same.mean() > 0.95  # not at outlines, where the ball's Gaussians reach into the background


@pytest.mark.thorough
def test_many_kinds_are_clustered_and_drawn_a_few_at_a_time(scene, monkeypatch):
    """Each view has embeddings of its own, close to the codes."""
    gaussians, _, masks = scene
    given = lesson(masks, LACKING)
    random = np.random.default_rng(5)
    rows = [given.codebook + 0.01 * random.normal(size=given.codebook.shape) for _ in masks]
    given = teacher_of_objects(given.ids, rows, given.filled)
    monkeypatch.setattr(of_levels, "_KINDS", 6)
    monkeypatch.setattr(of_levels, "_AT_ONCE", 4)
    found = complete_teacher(given, frozen_views(gaussians, cameras(8)), gaussians.num)
    for v, gone in LACKING.items():
        small = embeddings_of(found, v)[..., 0, :]
        nearest = (small @ CODES.T).argmax(axis=-1)
        for ball in gone:
            assert (nearest[masks[v] == ball] == ball).mean() > 0.9


@pytest.mark.thorough
def test_a_query_finds_parts_that_some_views_lack(scene):
    gaussians, labels, masks = scene
    given = lesson(masks, LACKING)
    method = Distill(PRESETS["solve"])
    start = method.start(gaussians, cameras(8), given, source=Source("files", levels=NAMES))
    *_, last = drive(method, *start)
    for wanted, level in (((ONE,), "small"), ((OTHER,), "small"), ((ONE, OTHER), "large")):
        asked = wanted[0] if level == "small" else THING
        vectors = CODES[[asked, *(row for row in range(4) if row != asked)]]
        assert last.result.best_level(vectors) == level
        found = np.asarray(last.result.scores(vectors)) > 0.5
        assert (found == np.isin(labels, wanted)).mean() > 0.95
    # Without completion, views that lack the parts teach that these are the whole thing.
    start = method.start(gaussians, cameras(8), given._replace(filled=None), source=start[0].source)
    *_, raw = drive(method, *start)
    one = CODES[[ONE, NOTHING, OTHER, THING]]
    cosines = [np.asarray(now.result.cosines(one, "small"))[labels == 1, 0].mean() for now in (raw, last)]
    assert cosines[1] > cosines[0] + 0.02
    assert replace(last.result, source=None).levels == ()
