"""Masks of things, of their parts and of the parts of these, on a level each."""

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from gsjax.perception.levels import LEVELS, joined_levels, labels_on_levels

seeds = st.integers(0, 10_000)


def test_a_thing_its_part_and_the_part_of_that():
    masks = np.zeros((4, 6, 8), bool)
    masks[0, 1:5, 1:7] = True  # a cabinet,
    masks[1, 2:4, 2:6] = True  # its drawer
    masks[2, 2:3, 3:4] = True  # and the handle of that
    masks[3] = True  # the picture
    small, medium, large = labels_on_levels(masks, max_fraction=0.6)
    assert (small[2, 3], medium[2, 3], large[2, 3]) == (3, 2, 1)
    assert (small[3, 3], medium[3, 3], large[3, 3]) == (2, 1, 1)
    assert (small[1, 1], medium[1, 1], large[1, 1]) == (1, 1, 1)
    assert (small[0, 0], medium[0, 0], large[0, 0]) == (0, 0, 0)
    assert not labels_on_levels(np.zeros((0, 6, 8), bool)).any()


@given(seeds)
def test_each_level_holds_a_mask_that_covers_the_pixel_and_none_is_smaller_than_the_level_below(seed):
    rng = np.random.default_rng(seed)
    masks = rng.random((int(rng.integers(1, 7)), 5, 6)) < 0.5
    labels = labels_on_levels(masks)
    areas = np.append(masks.sum((1, 2)), 0)
    covered = masks.any(axis=0)
    for level in labels:
        np.testing.assert_array_equal(level > 0, covered)
        assert all(masks[level[y, x] - 1, y, x] for y, x in zip(*np.nonzero(covered), strict=True))
    assert (np.diff(areas[labels - 1], axis=0) >= 0).all()


@given(seeds)
def test_a_pixel_has_its_embedding_on_each_level_or_that_of_the_next(seed):
    rng = np.random.default_rng(seed)
    counts = rng.integers(1, 5, len(LEVELS))
    books = [rng.normal(size=(count, 2)).astype(np.float32) for count in counts]
    books[0][0] = 0  # one that the encoder does not know
    ids = [rng.integers(-1, count, (4, 5)) for count in counts]
    rows, codebook = joined_levels(ids, books)
    assert codebook.shape[1] == 2 * len(LEVELS)
    assert len(np.unique(codebook, axis=0)) == len(codebook)
    for y, x in np.ndindex(4, 5):
        known = [
            None if one[y, x] < 0 or not book[one[y, x]].any() else book[one[y, x]]
            for one, book in zip(ids, books, strict=True)
        ]
        if all(one is None for one in known):
            assert rows[y, x] == -1
            continue
        for level in range(len(LEVELS)):
            order = (level, *range(level + 1, len(LEVELS)), *range(level)[::-1])
            wanted = next(known[k] for k in order if known[k] is not None)
            np.testing.assert_array_equal(codebook[rows[y, x], 2 * level : 2 * level + 2], wanted)
