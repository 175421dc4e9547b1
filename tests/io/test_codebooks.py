"""Codebooks and palettes represent few values exactly and many closely."""

import numpy as np

from gsjax.io.codebooks import codebook, nearest, palette


def test_a_codebook_of_few_values_is_exact():
    values = np.array([3.0, -1, 3, 7])
    book = codebook(values)
    assert len(book) == 256
    np.testing.assert_array_equal(book[nearest(book, values)], values)


def test_a_codebook_is_near_to_many_values():
    values = np.concatenate([np.random.default_rng(0).normal(size=20000), [30.0, -30.0]])
    book = codebook(values)
    errors = np.abs(book[nearest(book, values)] - values)
    assert np.sqrt(np.mean(errors**2)) < 0.015
    assert errors.max() < 0.5


def test_a_palette_is_exact_of_few_and_near_to_many():
    rng = np.random.default_rng(0)
    few = rng.normal(size=(50, 9))
    entries, labels = palette(few, 64)
    np.testing.assert_array_equal(entries[labels], few)
    many = rng.normal(size=(40, 9))[rng.integers(0, 40, 3000)] + rng.normal(0, 1e-3, (3000, 9))
    entries, labels = palette(many, 256)
    assert len(entries) <= 256
    assert np.abs(entries[labels] - many).max() < 0.01
    same, labels = palette(np.ones((300, 2)), 256)
    np.testing.assert_array_equal(same[labels], np.ones((300, 2)))
