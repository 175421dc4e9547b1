"""What readers and writers of Gaussians share: error, report, limits on sizes, values as files store them."""

import os
import warnings
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool, Float, Int, UInt8

from gsjax.io.brief import brief
from gsjax.scene.gaussians import SH_SIZES, Gaussians, take, valid_rows

REST_SIZES = tuple(size - 1 for size in SH_SIZES)
"""Coefficients of a colour channel besides the constant one, by degree."""
AGAIN = "It may be cut off or damaged: copy or export it again"
SH_C0 = 0.5 / np.sqrt(np.pi)
_SMALL = 1 << 26
_MOST_EXPANSION = 64
_LEAST_OPACITY = 1e-6


class SceneError(ValueError):
    """A file does not hold Gaussians; the message has the path, what was expected and found, and advice."""

    def __init__(self, path: str | os.PathLike, expected: str, found: str, advice: str):
        super().__init__(f"{path}: expected {expected}, found {brief(found)}. {advice}")


@dataclass(frozen=True)
class SceneReport:
    """Contents of a file besides the returned Gaussians.

    Attributes:
        format: what the file is, in words.
        stored: number of Gaussians in the file.
        culled: number of those left out because of a NaN, a zero quaternion, or an infinity without meaning.
        extra: properties that were not read.
        rows: row in the file of each returned Gaussian, [N].
        labels: int32 label of each returned Gaussian, [N]; None if the file has no labels.
        antialiased: whether the scene is to be drawn antialiased; None if the file does not say.
        invisible: number of those left out because their opacity is 0, a logit of -inf.
        origin: what was subtracted from the means because they lie far from 0, where float32 is too coarse;
            None if they are as in the file.
        places: positions of the returned Gaussians as in the file, float64 [N,3]; None if they are as
            returned.
    """

    format: str
    stored: int
    culled: int
    extra: tuple[str, ...]
    rows: Int[np.ndarray, "N"]
    labels: Int[np.ndarray, "N"] | None = None
    antialiased: bool | None = None
    invisible: int = 0
    origin: Float[np.ndarray, "3"] | None = None
    places: Float[np.ndarray, "N 3"] | None = field(default=None, repr=False)


class Columns(NamedTuple):
    """Gaussians on the host as files store them, float64.

    Attributes:
        means: centres, [N,3].
        quats: unit quaternions w x y z, [N,4].
        log_scales: logarithms of the scales, [N,3].
        opacities: 0 to 1, [N].
        colors: RGB, 0 to 1 where it can be shown, [N,3].
        rest: spherical harmonics without the constant one, [N,K-1,3]; K-1 may be 0.
    """

    means: Float[np.ndarray, "N 3"]
    quats: Float[np.ndarray, "N 4"]
    log_scales: Float[np.ndarray, "N 3"]
    opacities: Float[np.ndarray, "N"]
    colors: Float[np.ndarray, "N 3"]
    rest: Float[np.ndarray, "N rest 3"]


def columns_of(gaussians: Gaussians) -> Columns:
    """The values of Gaussians that can all be drawn."""
    means, quats, log_scales, logits, sh0 = (
        np.asarray(value, np.float64)
        for value in (
            gaussians.means,
            gaussians.quats,
            gaussians.log_scales,
            gaussians.logit_opacities,
            gaussians.sh0[:, 0],
        )
    )
    rest = np.zeros((gaussians.num, 0, 3)) if gaussians.shN is None else np.asarray(gaussians.shN, np.float64)
    quats = quats / np.linalg.norm(quats, axis=1, keepdims=True)
    opacities = 0.5 * (1 + np.tanh(logits / 2))  # a sigmoid that cannot overflow
    return Columns(means, quats, log_scales, opacities, sh0 * SH_C0 + 0.5, rest)


def gaussians_of(columns: Columns) -> Gaussians:
    """The inverse of `columns_of`, float32; opacities of 0 and 1 get finite logits."""
    opacities = np.clip(columns.opacities, _LEAST_OPACITY, 1 - _LEAST_OPACITY)
    sh0 = (columns.colors - 0.5) / SH_C0

    def as_array(value: np.ndarray):
        with np.errstate(invalid="ignore", over="ignore"):  # `drawable` leaves these out
            return jnp.asarray(value.astype(np.float32))

    return Gaussians(
        as_array(columns.means),
        as_array(columns.quats),
        as_array(columns.log_scales),
        as_array(np.log(opacities) - np.log1p(-opacities)),
        as_array(sh0[:, None, :]),
        shN=as_array(columns.rest) if columns.rest.shape[1] else None,
    )


def drawable(
    path: str | os.PathLike,
    format: str,
    gaussians: Gaussians,
    *,
    invisible: Bool[np.ndarray, "stored"] | None = None,
    labels: Int[np.ndarray, "stored"] | None = None,
    places: Float[np.ndarray, "stored 3"] | None = None,
    **known: Any,
) -> tuple[Gaussians, SceneReport]:
    """The Gaussians that can be drawn, and the report; warns of those that are left out.

    Args:
        path: the file.
        format: what it is, in words.
        gaussians: all its Gaussians.
        invisible: which of them have an opacity of 0.
        labels: one for each.
        places: position of each as in the file.
        **known: other fields of the report.
    """
    valid = valid_rows(gaussians)
    unseen = np.zeros(len(valid), bool) if invisible is None else invisible & valid
    rows = np.flatnonzero(valid & ~unseen)
    report = SceneReport(
        format=format,
        stored=gaussians.num,
        culled=int(np.sum(~valid)),
        extra=known.pop("extra", ()),
        rows=rows,
        labels=None if labels is None else labels[rows].astype(np.int32),
        invisible=int(unseen.sum()),
        places=None if places is None else places[rows],
        **known,
    )
    left_out = []
    if report.culled:
        left_out.append(f"{report.culled} of {report.stored} Gaussians cannot be drawn (NaN, no rotation)")
    if report.invisible:
        left_out.append(f"{report.invisible} of {report.stored} Gaussians are invisible (opacity 0)")
    if left_out:
        warnings.warn(f"{path}: {' and '.join(left_out)} and are left out", UserWarning, stacklevel=1)
    return (gaussians if rows.size == gaussians.num else take(gaussians, rows)), report


def expect_room(path: Path, size: int, stored: int, what: str) -> None:
    """Refuse data that would unpack to an unreasonable size, before anything of that size is allocated.

    Args:
        path: the file, for the error.
        size: bytes that it claims to unpack to.
        stored: bytes that it takes in the file.
        what: what is unpacked, for the error.

    Raises:
        SceneError: more than 64 MiB, and more than 64 times what is stored.
    """
    if size > max(_SMALL, _MOST_EXPANSION * stored):
        raise SceneError(
            path, f"{what} of a size in keeping with its file", f"{size} bytes from {stored}", AGAIN
        )


def spatial_order(means: Float[np.ndarray, "N 3"]) -> Int[np.ndarray, "N"]:
    """Rows along a space-filling (Morton) curve: neighbours in the list are neighbours in space."""
    low = means.min(axis=0)
    extent = np.maximum(means.max(axis=0) - low, np.finfo(np.float64).tiny)
    cells = ((means - low) / extent * 0xFFFF).astype(np.uint64)
    codes = np.zeros(len(means), np.uint64)
    for bit in range(16):
        for axis in range(3):
            codes |= (cells[:, axis] >> np.uint64(bit) & np.uint64(1)) << np.uint64(3 * bit + axis)
    return np.argsort(codes, kind="stable")


def to_bytes(fractions: Float[np.ndarray, "*n"]) -> UInt8[np.ndarray, "*n"]:
    """Fractions 0 to 1, rounded to the nearest of 256 steps, uint8; others are clipped."""
    return np.round(np.clip(fractions, 0, 1) * 255).astype(np.uint8)
