"""Text queries for objects without a language model: by colour, outline, size, and names given by the user.

The vocabulary is closed: it holds the words listed here and the given names, and any other word is an error.
For free-form language use CLIP.
"""

import re
from collections.abc import Mapping

import cv2
import numpy as np
from jaxtyping import Bool, Float, Int, Num
from skimage.color import rgb2lab

from gsjax.perception.codebook import plain_name
from gsjax.perception.pictures import unit_floats

COLORS = ("black", "white", "grey", "red", "orange", "yellow", "green", "blue", "purple", "pink", "brown")
"""The basic colour terms of English (Berlin and Kay, 1969)."""
OUTLINES = ("round", "long")
SIZES = ("largest", "smallest")
ASPECTS = {"color": COLORS, "outline": OUTLINES, "size": SIZES}

_SYNONYMS = {
    **{"gray": "grey", "silver": "grey", "violet": "purple", "magenta": "pink", "cyan": "blue"},
    **{"ball": "round", "sphere": "round", "circular": "round", "spherical": "round"},
    **{"elongated": "long", "thin": "long", "stick": "long"},
    **{"biggest": "largest", "big": "largest", "large": "largest"},
    **{"tiniest": "smallest", "tiny": "smallest", "small": "smallest", "little": "smallest"},
}
_NUMBERED = re.compile(r"object \d+")  # a placeholder, not a name
_SILENT = frozenset(
    [
        *("a", "an", "the", "this", "that", "it", "one", "object", "thing", "item", "of", "my", "me"),
        *("please", "pick", "up", "grab", "grasp", "take", "get", "find", "show"),
    ]
)

_FULL_ROUND, _NOT_ROUND = 0.93, 0.80  # fraction of the smallest enclosing circle that an outline fills
_FULL_LONG, _NOT_LONG = 2.5, 1.5  # aspect ratio of the smallest enclosing rectangle


class ClosedVocabulary:
    """Vectors of objects and of text, composed of aspects: colour, outline, size, and, if given, name.

    Each aspect is a unit vector with one axis per word, one for "none of these", and one for "any". An object
    has both its own description d and "any" in each aspect, (d, 1); a text has the words that it names, or
    "any" in an aspect in which it names none. So a text that fully describes an object has a cosine of
    1/sqrt(2) with it, whichever aspects it names, and each wrong aspect reduces the cosine by an equal share.

    Outlines cannot distinguish a box from a can (from above both have four to six corners); only names can.

    Attributes:
        min_score: lowest cosine of a match; up to three quarters of one aspect may be missing.
    """

    def __init__(self, names: Mapping[int, str] | None = None, sizes: bool = True):
        """
        Args:
            names: the name of each label that has one, such as "can" or "milk carton".
            sizes: whether size is one of the aspects. Disable it to compare objects of several images,
                because relative size depends on the other objects in the image.

        Raises:
            ValueError: two labels have the same name.
        """
        self._names = {label: plain_name(name) for label, name in sorted((names or {}).items())}
        if len(set(self._names.values())) < len(self._names):
            raise ValueError(f"names: expected distinct names, found {list(self._names.values())}")
        self._aspects = {name: words for name, words in ASPECTS.items() if sizes or name != "size"}
        if self._names:
            self._aspects["name"] = tuple(self._names.values())
        self.min_score = (1 - 0.75 / len(self._aspects)) / np.sqrt(2)

    @property
    def words(self) -> dict[str, tuple[str, ...]]:
        """The words of each aspect, without synonyms."""
        return dict(self._aspects)

    def embed_objects(
        self, image: Num[np.ndarray, "H W 3"], labels: Int[np.ndarray, "H W"], count: int
    ) -> Float[np.ndarray, "count D"]:
        """A unit vector for each of the labels 1 to `count`; zeros for a label without pixels.

        Args:
            image: RGB, uint8 or floats 0 to 1.
            labels: label of each pixel, 0 for background.
            count: the largest label to embed.
        """
        areas = np.bincount(labels[labels >= 0].ravel(), minlength=count + 1)[1 : count + 1]
        colors = color_words(image)
        width = sum(len(words) + 2 for words in self._aspects.values())
        rows = []
        for label, area in enumerate(areas, start=1):
            if area == 0:
                rows.append(np.zeros(width))
                continue
            mask = labels == label
            described = {
                "color": np.bincount(colors[mask], minlength=len(COLORS)).astype(float),
                "outline": _outline(mask),
                "size": np.array([area / areas.max(), areas[areas > 0].min() / area]),
            }
            if self._names:
                described["name"] = np.array([float(label == named) for named in self._names])
            parts = [np.append(_filled(described[aspect]), 1.0) for aspect in self._aspects]
            rows.append(np.concatenate(parts) / np.sqrt(2 * len(parts)))
        return np.reshape(rows, (count, width))

    def embed_text(self, text: str) -> Float[np.ndarray, "D"]:
        """The unit vector of a query: the words that it names, and "any" in aspects in which it names none.

        Raises:
            ValueError: a word is not in the vocabulary, or no word distinguishes objects.
        """
        named, unknown = self._parse(text)
        if unknown or not named:
            problem = (
                f"no word {unknown[0]!r}" if unknown else f"no word in {text!r} that tells objects apart"
            )
            listed = "; ".join(f"{aspect}s: {', '.join(words)}" for aspect, words in self._aspects.items())
            named_by_number = all(_NUMBERED.fullmatch(name) for name in self._names.values())
            advice = (
                '. No object has a name here: ask by colour or outline, as in "the blue one"'
                * named_by_number
            )
            raise ValueError(f"the closed vocabulary has {problem}. It has {listed}{advice}")
        parts = []
        for aspect, words in self._aspects.items():
            part = np.array([float((aspect, word) in named) for word in words] + [0.0, 0.0])
            part[-1] = float(not part.any())
            parts.append(part / np.linalg.norm(part))
        return np.concatenate(parts) / np.sqrt(len(parts))

    def _parse(self, text: str) -> tuple[set[tuple[str, str]], list[str]]:
        """The (aspect, word) pairs named in a text, and its words that are not in the vocabulary."""
        rest = f" {plain_name(text)} "
        named = set()
        # Names first, longest first: "red bull" must not match a colour, nor "object 12" match "object 1".
        for name in sorted(self._names.values(), key=len, reverse=True):
            if f" {name} " in rest:
                named.add(("name", name))
                rest = rest.replace(f" {name} ", " ")
        unknown = []
        for word in rest.split():
            known = _SYNONYMS.get(word, word)
            meant = {(aspect, known) for aspect, words in self._aspects.items() if known in words}
            if not meant and word not in _SILENT:  # "milk" may stand for "milk carton"
                meant = {("name", name) for name in self._names.values() if word in name.split()}
                unknown += [] if meant else [word]
            named |= meant
        return named, unknown


def color_words(image: Num[np.ndarray, "H W 3"]) -> Int[np.ndarray, "H W"]:
    """The index in `COLORS` of each pixel's colour, by lightness, saturation and hue in CIELAB.

    Saturation is chroma over the length of (lightness, chroma), which shading changes little.
    """
    lightness, a, b = np.moveaxis(rgb2lab(unit_floats(image)), -1, 0)
    chroma = np.hypot(a, b)
    saturation = chroma / np.maximum(np.hypot(lightness, chroma), 1e-9)
    hue = np.rad2deg(np.arctan2(b, a)) % 360
    bounds = [0, 45, 72, 110, 190, 308, 335, 360]
    hues = ["red", "orange", "yellow", "green", "blue", "purple", "pink"]
    found = np.array([COLORS.index(word) for word in hues])[np.searchsorted(bounds, hue, side="right") - 1]
    found[(hue >= 45) & (hue < 85) & (lightness < 58)] = COLORS.index("brown")
    found[((hue < 30) | (hue >= 335)) & (lightness >= 65)] = COLORS.index("pink")
    plain = saturation < 0.2
    found[plain] = COLORS.index("grey")
    found[plain & (lightness > 65)] = COLORS.index("white")
    found[(lightness < 10) | (plain & (lightness < 25))] = COLORS.index("black")
    return found


def _outline(mask: Bool[np.ndarray, "H W"]) -> Float[np.ndarray, "2"]:
    """How round and how elongated a mask's outline is, each 0 to 1."""
    contours, _ = cv2.findContours(mask.astype(np.uint8), cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_NONE)
    contour = max(contours, key=len)[:, 0]
    # Corners of pixels rather than centres: half a pixel matters for a small mask.
    corners = np.concatenate([contour + offset for offset in ((0, 0), (1, 0), (0, 1), (1, 1))])
    corners = corners.astype(np.float32)
    _, radius = cv2.minEnclosingCircle(corners)
    sides = np.sort(cv2.minAreaRect(corners)[1])
    hull = cv2.contourArea(cv2.convexHull(corners))
    fill, ratio = hull / (np.pi * radius**2), sides[1] / max(sides[0], 1e-9)
    return np.clip(
        [
            (fill - _NOT_ROUND) / (_FULL_ROUND - _NOT_ROUND),
            (ratio - _NOT_LONG) / (_FULL_LONG - _NOT_LONG),
        ],
        0.0,
        1.0,
    )


def _filled(parts: Float[np.ndarray, "n"]) -> Float[np.ndarray, "n+1"]:
    """A unit vector: the parts, followed by the remainder to length 1; longer vectors are shortened first."""
    length = np.linalg.norm(parts)
    parts = parts / max(length, 1.0)
    return np.append(parts, np.sqrt(max(0.0, 1 - np.sum(parts**2))))
