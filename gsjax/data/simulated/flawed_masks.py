"""Corruption of true masks by the typical errors of a segmenter: inaccurate outlines, and things that are
merged, split or missing."""

from dataclasses import dataclass
from typing import NamedTuple

import cv2
import numpy as np
from jaxtyping import Bool, Float, Int, Integer

_CLOSE = 3  # pixels between things that a segmenter may merge
_OWN_SHARE = 0.6  # share of its own embedding in that of a split-off piece; the rest is another thing's


@dataclass(frozen=True)
class Flaws:
    """Frequency and size of the flaws.

    Attributes:
        outline: largest number of pixels by which a thing is eroded or dilated.
        merged: fraction of the pictures in which two things are merged.
        split: fraction of the pictures in which a thing is split in two.
        missing: fraction of the pictures that show a thing in which it is missing.
        smallest: things with fewer pixels are always missing, as segmenters drop specks.
    """

    outline: int = 3
    merged: float = 0.2
    split: float = 0.2
    missing: float = 1 / 3
    smallest: int = 40


class FlawedMasks(NamedTuple):
    """Masks of V pictures as a segmenter might produce them, and embeddings as an encoder of masks might.

    Attributes:
        labels: [H,W] for each picture; 0 is the background, -1 is in no mask.
        embeddings: embeddings of the labels 0 to n, [n+1,D] for each picture.
        notes: descriptions of the flaws.
    """

    labels: list[Int[np.ndarray, "..."]]
    embeddings: list[Float[np.ndarray, "..."]]
    notes: list[str]


def flawed_masks(
    masks: list[Integer[np.ndarray, "..."]],
    codebook: Float[np.ndarray, "classes d"],
    seed: int,
    flaws: Flaws | None = None,
) -> FlawedMasks:
    """Corrupt masks of true labels 0 to K.

    A mask has the embedding of its label. Merged things have the mean of their embeddings, weighted by pixel
    count, as from an encoder of crops. The smaller piece of a split thing has an embedding almost halfway
    to another thing's, since half of a thing may look like something else. No thing is missing in all of the
    pictures that show enough of it.

    Args:
        masks: labels of each picture, [H,W].
        codebook: embeddings of the labels 0 to K.
        seed: random seed.
        flaws: frequency and size of the flaws; default: `Flaws()`.
    """
    flaws, random = flaws or Flaws(), np.random.default_rng(seed)
    count, things = len(masks), range(1, len(codebook))
    missing = np.zeros((count, len(codebook)), bool)
    for k in things:
        pixels = np.array([(mask == k).sum() for mask in masks])
        missing[:, k] = pixels < flaws.smallest
        shown = np.flatnonzero(~missing[:, k])
        number = min(int(flaws.missing * len(shown) + random.uniform()), max(len(shown) - 1, 0))
        missing[random.permutation(shown)[:number], k] = True
    # Stochastic rounding, so that the fractions hold on average over seeds even for few pictures.
    merged, split = (
        set(random.permutation(count)[: int(share * count + random.uniform())].tolist())
        for share in (flaws.merged, flaws.split)
    )
    labels, embeddings, notes = [], [], []
    for v, mask in enumerate(masks):
        found, rows = _outlined(mask, missing[v], flaws, random), np.array(codebook)
        if lost := [k for k in things if missing[v, k] and (mask == k).any()]:
            notes.append(f"picture {v}: {lost} missing")
        if v in merged and (pair := _neighbours(found, random)) is not None:
            one, other = pair
            sizes = np.array([(found == one).sum(), (found == other).sum()])
            rows[one] = _unit(sizes @ rows[[one, other]])
            found[found == other] = one
            notes.append(f"picture {v}: {one} and {other} merged")
        if v in split and (present := [k for k in things if (found == k).sum() > 1]):
            whole = int(random.choice(present))
            other = int(random.choice([k for k in range(len(codebook)) if k != whole]))
            found[_smaller_piece(found == whole, random)] = len(rows)
            mixed = _OWN_SHARE * rows[whole] + (1 - _OWN_SHARE) * np.asarray(codebook)[other]
            rows = np.concatenate([rows, _unit(mixed)[None]])
            notes.append(f"picture {v}: {whole} split, with one piece almost as similar to {other}")
        labels.append(found)
        embeddings.append(rows.astype(np.float32))
    return FlawedMasks(labels, embeddings, notes)


def _outlined(mask, missing: Bool[np.ndarray, "k"], flaws: Flaws, random) -> Int[np.ndarray, "h w"]:
    """Each thing eroded or dilated by some pixels, small ones painted over large ones, missing ones left
    out."""
    most, found = flaws.outline, np.where(missing[mask], -1, 0).astype(np.int64)
    sizes = np.bincount(mask.ravel(), minlength=len(missing))
    for k in np.argsort(-sizes):
        pixels = int(random.integers(-most, most + 1))
        if k == 0 or missing[k] or not sizes[k]:
            continue
        change = cv2.erode if pixels < 0 else cv2.dilate
        kernel = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (2 * abs(pixels) + 1,) * 2)
        grown = change((mask == k).astype(np.uint8), kernel) > 0
        found[grown if grown.any() else mask == k] = k
    return found


def _neighbours(labels, random) -> tuple[int, int] | None:
    """A random pair of things that touch or nearly touch; None if there is none."""
    kernel, pairs = np.ones((2 * _CLOSE + 1,) * 2, np.uint8), []
    for k in np.unique(labels[labels > 0]):
        near = np.unique(labels[cv2.dilate((labels == k).astype(np.uint8), kernel) > 0])
        pairs += [(int(k), int(other)) for other in near if other > k]
    return pairs[random.integers(len(pairs))] if pairs else None


def _smaller_piece(mask: Bool[np.ndarray, "h w"], random) -> Bool[np.ndarray, "h w"]:
    """The part of the mask beyond a line in a random direction, a quarter to a half of it."""
    rows, columns = np.nonzero(mask)
    angle = random.uniform(0, 2 * np.pi)
    along = np.cos(angle) * columns + np.sin(angle) * rows
    beyond = along > np.quantile(along, random.uniform(0.5, 0.75))
    piece = np.zeros_like(mask)
    piece[rows[beyond], columns[beyond]] = True
    return piece


def _unit(vector: np.ndarray) -> np.ndarray:
    return vector / max(float(np.linalg.norm(vector)), 1e-12)
