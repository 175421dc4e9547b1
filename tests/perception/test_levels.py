"""Nested masks of objects, their parts and the parts of those are assigned to one level each."""

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from gsjax.perception.levels import LEVELS, joined_levels, labels_on_level, labels_on_levels

seeds = st.integers(0, 10_000)


def test_a_thing_its_part_and_the_part_of_that_are_whole_on_their_levels():
    masks = np.zeros((6, 12, 16), bool)
    masks[0, 1:9, 1:11] = True  # a cabinet,
    masks[1, 2:6, 2:8] = True  # its drawer,
    masks[2, 3:5, 3:6] = True  # its handle,
    masks[3, 3, 3:5] = True  # and a screw of the handle
    masks[4, 10:12, 12:16] = True  # a cup beside it
    masks[5] = True  # the picture
    small, medium, large = labels_on_levels(masks, max_fraction=0.6)
    np.testing.assert_array_equal(large, 1 * masks[0] + 5 * masks[4])
    np.testing.assert_array_equal(medium, 2 * masks[1])
    np.testing.assert_array_equal(small, np.where(masks[3], 4, 3 * masks[2]))
    np.testing.assert_array_equal(labels_on_levels(masks, 0.6, min_pixels=3)[0], 3 * masks[2])
    assert not labels_on_levels(np.zeros((0, 6, 8), bool)).any()
    # A level shown alone is filled, where it has no mask, from the next larger, else the next smaller.
    filled = {level: labels_on_level(np.stack([small, medium, large]), level) for level in LEVELS}
    for level, labels in filled.items():
        np.testing.assert_array_equal(labels > 0, masks[0] | masks[4], err_msg=level)
    assert [filled[level][2, 2] for level in LEVELS] == [2, 2, 1]
    assert [filled[level][11, 13] for level in LEVELS] == [5, 5, 5]


@given(seeds)
def test_each_mask_is_on_one_level_and_covers_its_pixels(seed):
    rng = np.random.default_rng(seed)
    masks = rng.random((int(rng.integers(1, 7)), 5, 6)) < rng.uniform(0.1, 0.9)
    labels = labels_on_levels(masks)
    np.testing.assert_array_equal((labels > 0).any(axis=0), masks.any(axis=0))
    assert all(masks[labels[at] - 1][at[1:]] for at in zip(*np.nonzero(labels), strict=True))
    levels = [np.flatnonzero((labels == row + 1).any(axis=(1, 2))) for row in range(len(masks))]
    assert all(len(each) <= 1 for each in levels)


def test_nothing_known_is_nothing_joined():
    rows, codebook, filled = joined_levels([np.full((4, 5), -1)] * 3, [np.zeros((1, 8), np.float32)] * 3)
    assert (rows == -1).all()
    assert not filled.any()
    assert codebook.shape == (0, 24)


@given(seeds)
def test_a_pixel_has_its_embedding_on_each_level_or_that_of_the_next(seed):
    rng = np.random.default_rng(seed)
    counts = rng.integers(1, 5, len(LEVELS))
    books = [rng.normal(size=(count, 2)).astype(np.float32) for count in counts]
    books[0][0] = 0  # zeros: unknown to the encoder
    ids = [rng.integers(-1, count, (4, 5)) for count in counts]
    rows, codebook, filled = joined_levels(ids, books)
    assert codebook.shape[1] == 2 * len(LEVELS)
    assert len(np.unique(codebook, axis=0)) == len(codebook)
    for y, x in np.ndindex(4, 5):
        known = [
            None if one[y, x] < 0 or not book[one[y, x]].any() else book[one[y, x]]
            for one, book in zip(ids, books, strict=True)
        ]
        if all(one is None for one in known):
            assert rows[y, x] == -1
            assert not filled[y, x].any()
            continue
        assert filled[y, x].tolist() == [one is None for one in known]
        for level in range(len(LEVELS)):
            order = (level, *range(level + 1, len(LEVELS)), *range(level)[::-1])
            wanted = next(known[k] for k in order if known[k] is not None)
            np.testing.assert_array_equal(codebook[rows[y, x], 2 * level : 2 * level + 2], wanted)
