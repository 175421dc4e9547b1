"""Quantisation: codebooks of numbers, and palettes of vectors."""

import numpy as np
from jaxtyping import Float, Int, UInt8

_SIZE, _ROUNDS = 256, 8


def codebook(values: Float[np.ndarray, "*n"]) -> Float[np.ndarray, "256"]:
    """A codebook of 256 ascending numbers that approximate the values (Lloyd's algorithm).

    Args:
        values: at least one finite number.
    """
    ordered = np.sort(values, axis=None)
    book = np.sort(palette(ordered[:, None], _SIZE)[0][:, 0])
    if len(book) < _SIZE or len(ordered) == _SIZE:
        return np.concatenate([book, np.full(_SIZE - len(book), book[-1])])
    sums = np.concatenate([[0.0], np.cumsum(ordered - ordered[0])])
    for _ in range(_ROUNDS):
        ends = np.searchsorted(ordered, (book[1:] + book[:-1]) / 2)
        starts, ends = np.concatenate([[0], ends]), np.concatenate([ends, [len(ordered)]])
        counts = ends - starts
        middles = (sums[ends] - sums[starts]) / np.maximum(counts, 1) + ordered[0]
        book = np.sort(np.where(counts > 0, middles, book))
    return book


def nearest(book: Float[np.ndarray, "256"], values: Float[np.ndarray, "*n"]) -> UInt8[np.ndarray, "*n"]:
    """The index of the entry of an ascending codebook that is nearest to each value.

    Args:
        book: the codebook.
        values: any finite numbers.
    """
    return np.searchsorted((book[1:] + book[:-1]) / 2, values).astype(np.uint8)


def palette(
    rows: Float[np.ndarray, "N D"], most: int
) -> tuple[Float[np.ndarray, "K D"], Int[np.ndarray, "N"]]:
    """At most `most` vectors, and the index of the one that represents each row.

    If there are no more rows than that, each represents itself. Otherwise cells of rows are split in two,
    those with the largest sum of squares first, at the mean of the coordinate that varies most, and each cell
    is represented by its mean.

    Args:
        rows: the vectors.
        most: largest number of entries.
    """
    if len(rows) <= most:
        return rows, np.arange(len(rows))
    labels, count = np.zeros(len(rows), np.int64), 1
    while count < most:
        means, squares, _ = _moments(rows, labels, count)
        errors = squares.sum(axis=1)
        # At least half of the cells, so that there are few rounds.
        split = max(int(np.sum(errors > 0.5 * errors.mean())), (count + 1) // 2)
        chosen = np.argsort(-errors, kind="stable")[: min(split, most - count)]
        chosen = chosen[errors[chosen] > 0]
        if not chosen.size:
            break
        renamed = np.full(count, -1)
        renamed[chosen] = count + np.arange(chosen.size)
        axis = np.argmax(squares, axis=1)
        above = np.take_along_axis(rows, axis[labels][:, None], axis=1)[:, 0] > means[labels, axis[labels]]
        moving = above & (renamed[labels] >= 0)
        labels = np.where(moving, renamed[labels], labels)
        count += chosen.size
    means, _, sizes = _moments(rows, labels, count)
    used = sizes > 0
    return means[used], (np.cumsum(used) - 1)[labels]


def _moments(rows: np.ndarray, labels: np.ndarray, count: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Mean, sum of squared differences from it, and number of rows, of each cell; [count,D] and [count]."""
    sizes = np.bincount(labels, minlength=count)
    many = np.maximum(sizes, 1)[:, None]

    def totals(values: np.ndarray) -> np.ndarray:
        return np.stack([np.bincount(labels, column, minlength=count) for column in values.T], axis=1)

    means = totals(rows) / many
    return means, np.maximum(totals(rows**2) - many * means**2, 0), sizes
