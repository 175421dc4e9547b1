"""True masks, spoiled as a segmenter's are: outlines off, things run together, in pieces, or overlooked."""

from dataclasses import dataclass
from typing import NamedTuple

import cv2
import numpy as np
from jaxtyping import Bool, Float, Int, Integer

_CLOSE = 3  # pixels between things that a segmenter may run together
_LIKE_ITSELF = 0.6  # of half of a thing; the rest is like another


@dataclass(frozen=True)
class Flaws:
    """How often masks are spoiled, and by how much.

    Attributes:
        outline: largest number of pixels by which a thing is eroded or grown.
        merged: share of the pictures in which two things are one.
        split: share of the pictures in which one thing is two.
        missing: share of the pictures in which a thing that is there is overlooked.
        smallest: a thing with fewer pixels is always overlooked, as segmenters drop specks.
    """

    outline: int = 3
    merged: float = 0.2
    split: float = 0.2
    missing: float = 1 / 3
    smallest: int = 40


class FlawedMasks(NamedTuple):
    """What a segmenter might have said of V pictures, and what an encoder of each mask.

    Attributes:
        labels: [H,W] a picture, 0 the background, -1 in no mask.
        embeddings: of the labels 0 to n, [n+1,D] a picture.
        said: what was done, in words.
    """

    labels: list[Int[np.ndarray, "..."]]
    embeddings: list[Float[np.ndarray, "..."]]
    said: list[str]


def flawed_masks(
    masks: list[Integer[np.ndarray, "..."]],
    codebook: Float[np.ndarray, "classes d"],
    seed: int,
    flaws: Flaws | None = None,
) -> FlawedMasks:
    """Masks of true labels 0 to K, with flaws.

    A mask has the embedding of its label. Two things in one mask have the mean of theirs, by their pixels, as
    an encoder of crops would say; of one that is two, the smaller piece has one almost halfway to another
    thing's, for half of a thing looks like something else. Nothing is overlooked in all pictures that show
    enough of it.

    Args:
        masks: labels of each picture, [H,W].
        codebook: of the labels 0 to K.
        seed: of all that is random.
        flaws: how much; the defaults unless given.
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
    # Of few pictures a share is no whole number: then by chance, so that it holds over seeds.
    merged, split = (
        set(random.permutation(count)[: int(share * count + random.uniform())].tolist())
        for share in (flaws.merged, flaws.split)
    )
    labels, embeddings, said = [], [], []
    for v, mask in enumerate(masks):
        found, rows = _outlined(mask, missing[v], flaws, random), np.array(codebook)
        if overlooked := [k for k in things if missing[v, k] and (mask == k).any()]:
            said.append(f"picture {v}: {overlooked} overlooked")
        if v in merged and (pair := _neighbours(found, random)) is not None:
            one, other = pair
            sizes = np.array([(found == one).sum(), (found == other).sum()])
            rows[one] = _unit(sizes @ rows[[one, other]])
            found[found == other] = one
            said.append(f"picture {v}: {one} and {other} are one")
        if v in split and (there := [k for k in things if (found == k).sum() > 1]):
            whole = int(random.choice(there))
            other = int(random.choice([k for k in range(len(codebook)) if k != whole]))
            found[_smaller_piece(found == whole, random)] = len(rows)
            mixed = _LIKE_ITSELF * rows[whole] + (1 - _LIKE_ITSELF) * np.asarray(codebook)[other]
            rows = np.concatenate([rows, _unit(mixed)[None]])
            said.append(f"picture {v}: {whole} is two, one of which looks almost as much like {other}")
        labels.append(found)
        embeddings.append(rows.astype(np.float32))
    return FlawedMasks(labels, embeddings, said)


def _outlined(mask, missing: Bool[np.ndarray, "k"], flaws: Flaws, random) -> Int[np.ndarray, "h w"]:
    """Each thing eroded or grown by some pixels, small ones over large ones; what is missing is left out."""
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
    """Two things that touch, or nearly; none where there are no such."""
    kernel, pairs = np.ones((2 * _CLOSE + 1,) * 2, np.uint8), []
    for k in np.unique(labels[labels > 0]):
        near = np.unique(labels[cv2.dilate((labels == k).astype(np.uint8), kernel) > 0])
        pairs += [(int(k), int(other)) for other in near if other > k]
    return pairs[random.integers(len(pairs))] if pairs else None


def _smaller_piece(mask: Bool[np.ndarray, "h w"], random) -> Bool[np.ndarray, "h w"]:
    """What lies beyond a line in a random direction, a quarter to a half of the mask."""
    rows, columns = np.nonzero(mask)
    angle = random.uniform(0, 2 * np.pi)
    along = np.cos(angle) * columns + np.sin(angle) * rows
    beyond = along > np.quantile(along, random.uniform(0.5, 0.75))
    piece = np.zeros_like(mask)
    piece[rows[beyond], columns[beyond]] = True
    return piece


def _unit(vector: np.ndarray) -> np.ndarray:
    return vector / max(float(np.linalg.norm(vector)), 1e-12)
