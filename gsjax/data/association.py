"""Association by time of streams with independent timestamps: cameras, depth, poses."""

import warnings
from collections.abc import Mapping
from pathlib import Path

import numpy as np
from jaxtyping import Float, Int

from gsjax.data.errors import DataError, DataWarning


def associate(
    path: Path, streams: Mapping[str, Float[np.ndarray, "..."]], max_skew: float
) -> Int[np.ndarray, "frames streams"]:
    """For each usable frame of the first stream, the item of every stream that is nearest in time.

    A frame is usable if each stream has an item within `max_skew` of it; other frames are left out, with a
    DataWarning that counts them. An item may be used for two frames if it is near enough to both.

    Args:
        path: name of the recording in messages.
        streams: the times of each stream, [n], seconds, by name. The first stream defines the frames.
        max_skew: largest time difference, seconds. An object at 1 m/s is displaced by at most as many metres.

    Returns:
        Indices into the streams, one column per stream; the first column increases.

    Raises:
        DataError: a stream is empty, its times do not increase, or no frame is usable.
        ValueError: `max_skew` is negative or NaN.
    """
    if not max_skew >= 0:
        raise ValueError(f"max_skew: expected seconds, 0 or more, found {max_skew}")
    for name, times in streams.items():
        _check_order(path, name, times)
    first = next(iter(streams.values()))
    nearest = np.stack([nearest_in_time(first, times) for times in streams.values()], axis=1)
    skews = np.stack([abs(t[i] - first) for t, i in zip(streams.values(), nearest.T, strict=True)], axis=1)
    far = skews > max_skew
    usable, limit = ~far.any(axis=1), f"within {1e3 * max_skew:.4g} ms"
    if not usable.any():
        t, s = np.unravel_index(np.argmax(far), far.shape)
        expected = f"a frame with an item of every stream {limit}"
        nearest_item = f"the nearest {list(streams)[s]} is {skews[t, s]:.4g} s away"
        found = f"none: at {first[t]:.3f} s {nearest_item}"
        raise DataError(path, expected, found, "Check that all times use one clock, or raise max_skew.")
    if not usable.all():
        missed = zip(streams, far.sum(axis=0), skews.max(axis=0), strict=True)
        gaps = [f"{count} without {name} (up to {1e3 * w:.0f} ms off)" for name, count, w in missed if count]
        message = f"{path}: {np.sum(~usable)} of {len(usable)} frames are left out: {', '.join(gaps)} {limit}"
        warnings.warn(message, DataWarning, stacklevel=3)
    return nearest[usable]


def nearest_in_time(
    times: Float[np.ndarray, "frames"], own: Float[np.ndarray, "stream"]
) -> Int[np.ndarray, "frames"]:
    """Index of the item nearest to each time in a stream of increasing times; the earlier one in a tie."""
    after = np.clip(np.searchsorted(own, times), 1, max(1, len(own) - 1))
    before = after - 1
    after = np.minimum(after, len(own) - 1)
    return np.where(own[after] - times < times - own[before], after, before)


def _check_order(path: Path, name: str, times: np.ndarray) -> None:
    if len(times) == 0:
        raise DataError(path, f"times of {name}", "none", "Remove that stream.")
    bad = ~np.isfinite(times)
    bad[1:] |= ~(np.diff(times) > 0)
    if bad.any():
        i = int(np.argmax(bad))
        before = f" after {times[i - 1]} s" if i else ""
        found = f"frame {i} is at {times[i]} s{before}"
        advice = "Sort the frames and drop duplicates."
        raise DataError(path, f"times of {name} that increase", found, advice)
