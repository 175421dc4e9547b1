"""Flaws added to masks have the requested kind and frequency, and are reproducible from the seed."""

import numpy as np
import pytest

from gsjax.data.simulated.flawed_masks import Flaws, flawed_masks

NONE = Flaws(outline=0, merged=0.0, split=0.0, missing=0.0, smallest=0)
CODES = np.eye(5, 16)[np.array([0, 1, 2, 3, 4])]


def masks(count=12):
    """Four squares, one of them a speck, in each picture."""
    one = np.zeros((60, 80), np.int64)
    one[5:25, 5:25], one[5:25, 26:46], one[30:55, 50:75], one[40:43, 10:13] = 1, 2, 3, 4
    return [one.copy() for _ in range(count)]


def test_no_flaws_is_the_truth():
    found = flawed_masks(masks(), CODES, 0, NONE)
    for label, true in zip(found.labels, masks(), strict=True):
        np.testing.assert_array_equal(label, true)
    for rows in found.embeddings:
        np.testing.assert_allclose(rows, CODES)
    assert not found.notes


@pytest.mark.parametrize("seed", [0, 1, 2])
def test_the_same_seed_has_the_same_flaws(seed):
    one, other = flawed_masks(masks(), CODES, seed), flawed_masks(masks(), CODES, seed)
    another = flawed_masks(masks(), CODES, seed + 10)
    assert all((a == b).all() for a, b in zip(one.labels, other.labels, strict=True))
    assert any((a != b).any() for a, b in zip(one.labels, another.labels, strict=True))


@pytest.mark.parametrize("seed", range(5))
def test_each_thing_is_missing_in_a_third_of_the_views_and_a_speck_in_all(seed):
    found = flawed_masks(masks(), CODES, seed, Flaws(outline=0, merged=0.0, split=0.0))
    for k in (1, 2, 3):
        assert sum((label == k).any() for label in found.labels) == 8
    assert not any((label == 4).any() for label in found.labels)
    for label, true in zip(found.labels, masks(), strict=True):
        assert set(np.unique(label[(true > 0) & (label != true)])) <= {-1}
        np.testing.assert_array_equal(label[true == 0], 0)


def test_flaws_have_the_requested_frequency_even_for_few_views():
    counts = np.zeros(2)
    for seed in range(100):
        notes = " ".join(flawed_masks(masks(2), CODES, seed, Flaws(outline=0, missing=0.0)).notes)
        counts += notes.count("merged"), notes.count("split")
    assert (np.abs(counts / 200 - 0.2) < 0.08).all()  # standard deviation 0.03


def test_nothing_is_missing_everywhere():
    found = flawed_masks(masks(2), CODES, 0, Flaws(outline=0, merged=0.0, split=0.0, missing=1.0))
    for k in (1, 2, 3):
        assert any((label == k).any() for label in found.labels)


def test_merged_things_share_a_mask_and_a_mixed_embedding():
    found = flawed_masks(masks(10), CODES, 3, Flaws(outline=0, merged=0.2, split=0.0, missing=0.0))
    merged = [v for v, label in enumerate(found.labels) if len(np.unique(label[label > 0])) < 3]
    assert len(merged) == 2  # of ten; the speck is missing in all
    for v in merged:
        rows, present = found.embeddings[v], np.unique(found.labels[v])
        mixed = [k for k in present if k > 0 and 0.1 < (rows[k] @ CODES.T).max() < 0.99]
        assert len(mixed) == 1
        np.testing.assert_allclose(np.linalg.norm(rows[mixed[0]]), 1, rtol=1e-5)


def test_a_split_thing_has_a_piece_that_resembles_another():
    found = flawed_masks(
        masks(10), CODES, 1, Flaws(outline=0, merged=0.0, split=0.2, missing=0.0, smallest=0)
    )
    split = [v for v in range(10) if len(found.embeddings[v]) == 6]
    assert len(split) == 2
    for v in split:
        cosines = np.sort(found.embeddings[v][5] @ CODES.T)
        np.testing.assert_allclose(cosines[-2:], np.array([0.4, 0.6]) / np.hypot(0.4, 0.6), rtol=1e-5)
        assert (found.labels[v] == 5).any()


def test_outlines_are_off_by_no_more_than_the_limit():
    import cv2

    found = flawed_masks(masks(), CODES, 0, Flaws(outline=3, merged=0.0, split=0.0, missing=0.0))
    true = (masks()[0] == 3).astype(np.uint8)
    kernel = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (3, 3))
    largest, least = cv2.dilate(true, kernel, iterations=4), cv2.erode(true, kernel, iterations=4)
    sizes = set()
    for label in found.labels:
        ours = label == 3
        assert not (ours & (largest == 0)).any()
        assert (ours | (least == 0)).all()
        sizes.add(int(ours.sum()))
    assert len(sizes) > 3
