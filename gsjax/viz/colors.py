"""Pictures from arrays: label colours, depth, error maps, and the panel that shows them side by side.

All pictures are uint8 RGB `[H,W,3]`; colour inputs are floats in 0 to 1 or uint8.
"""

from collections.abc import Mapping, Sequence
from colorsys import hsv_to_rgb
from typing import NamedTuple

import cv2
import matplotlib
import numpy as np
from jaxtyping import Bool, Float, Integer, Num, UInt8

BACKGROUND = (158, 160, 164)  # label 0
INVALID = (38, 40, 44)  # pixels without depth
_INK = (245, 245, 245)
_CHIP = (22, 24, 28)  # behind text
_LARGE_ERROR, _LABEL_WEIGHT = 0.3, 0.65

# Okabe and Ito's colours, then darker ones from Tol's muted scheme: any two neighbours are distinct to
# colour-blind readers, and each is dark enough for a line on white (so yellow comes late and is deepened).
PALETTE = (
    (0, 114, 178),
    (230, 159, 0),
    (0, 158, 115),
    (213, 94, 0),
    (204, 121, 167),
    (86, 180, 233),
    (51, 34, 136),
    (190, 174, 20),
    (136, 34, 85),
    (153, 153, 51),
)
_GOLDEN = (5**0.5 - 1) / 2
_SHADES = ((0.9, 0.8), (0.55, 0.7), (0.75, 0.5))  # saturation and value


def label_color(label: int) -> tuple[int, int, int]:
    """The RGB colour, 0 to 255, of `label` in every picture; 0 is grey. Beyond the palette's ten colours,
    hues advance by the golden ratio, so that labels a hundred apart differ too."""
    if label <= len(PALETTE):
        return BACKGROUND if label == 0 else PALETTE[label - 1]
    red, green, blue = hsv_to_rgb(label * _GOLDEN % 1, *_SHADES[label % len(_SHADES)])
    return round(255 * red), round(255 * green), round(255 * blue)


def colorize_labels(mask: Integer[np.ndarray, "h w"]) -> UInt8[np.ndarray, "h w 3"]:
    """A label image as colours; negative labels (unknown) are near black."""
    labels, inverse = np.unique(mask, return_inverse=True)
    table = np.array([INVALID if label < 0 else label_color(int(label)) for label in labels], np.uint8)
    return table.reshape(-1, 3)[inverse.reshape(mask.shape)]


def colorize_depth(
    depth: Float[np.ndarray, "h w"], near: float | None = None, far: float | None = None
) -> UInt8[np.ndarray, "h w 3"]:
    """Depth in metres as colours, near bright; zero, negative and non-finite depths are near black.

    `near` and `far` default to the 2nd and 98th percentile of the valid depths; pass them to make several
    pictures comparable.
    """
    valid = np.isfinite(depth) & (depth > 0)
    low, high = np.percentile(depth[valid], [2, 98]) if valid.any() else (0.0, 1.0)
    low, high = (low if near is None else near), (high if far is None else far)
    closeness = 1 - np.clip((np.where(valid, depth, low) - low) / max(high - low, 1e-9), 0, 1)
    colors = _apply_colormap("cividis", closeness)
    colors[~valid] = INVALID
    return colors


class PcaColors(NamedTuple):
    """A map from features to colours: the three principal components as red, green and blue."""

    mean: Float[np.ndarray, "d"]
    axes: Float[np.ndarray, "d three"]
    low: Float[np.ndarray, "three"]
    high: Float[np.ndarray, "three"]


def fit_pca_colors(features: Float[np.ndarray, "n d"]) -> PcaColors:
    """Colours that distinguish these features; use one fit for all pictures that are to be compared.

    The colours span the 2nd to the 98th percentile of each component. Non-finite features are ignored, and
    the signs of the axes are fixed, so the same features always have the same colours.

    Raises:
        ValueError: no feature is finite.
    """
    finite = np.asarray(features, np.float64)[np.isfinite(features).all(axis=1)]
    if len(finite) == 0:
        raise ValueError(f"features: expected at least one finite feature, found none among {len(features)}")
    mean = finite.mean(axis=0)
    values, axes = np.linalg.eigh((finite - mean).T @ (finite - mean))
    axes = axes[:, np.argsort(-values)[:3]]
    axes *= np.sign(axes[np.abs(axes).argmax(axis=0), np.arange(axes.shape[1])])
    axes = np.pad(axes, ((0, 0), (0, 3 - axes.shape[1])))  # fewer than three dimensions: the rest is black
    low, high = np.percentile((finite - mean) @ axes, [2, 98], axis=0)
    return PcaColors(mean, axes, low, high)


def colorize_features(features: Float[np.ndarray, "h w d"], pca: PcaColors) -> UInt8[np.ndarray, "h w 3"]:
    """A feature map as colours; non-finite features are near black."""
    known = np.isfinite(features).all(axis=-1)
    components = (np.where(known[..., None], features, 0.0) - pca.mean) @ pca.axes
    shares = (components - pca.low) / np.maximum(pca.high - pca.low, 1e-12)
    picture = to_uint8(np.where(pca.high > pca.low, shares, 0.0))
    picture[~known] = INVALID
    return picture


def highlight(
    image: Num[np.ndarray, "h w 3"], mask: Bool[np.ndarray, "h w"], color: tuple[int, int, int]
) -> UInt8[np.ndarray, "h w 3"]:
    """An object in its own colours with an outline in `color`, the rest grey and dim.

    Args:
        image: uint8, or floats 0 to 1.
        mask: pixels of the object.
        color: RGB of the outline, 0 to 255.
    """
    image = to_uint8(image)
    dim = np.broadcast_to(image.mean(axis=-1, keepdims=True) * 0.6, image.shape).astype(np.uint8)
    picture = np.where(mask[..., None], image, dim)
    contours, _ = cv2.findContours(mask.astype(np.uint8), cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_NONE)
    thick = 1 + image.shape[0] // 400
    return cv2.drawContours(np.ascontiguousarray(picture), contours, -1, color, thick, cv2.LINE_AA)


def heat(values: Float[np.ndarray, "h w"]) -> UInt8[np.ndarray, "h w 3"]:
    """Values as colours, from 0 (dark) to 1 (bright)."""
    return _apply_colormap("inferno", np.clip(np.nan_to_num(values), 0, 1))


def with_heat_scale(
    picture: UInt8[np.ndarray, "h w 3"], low: float, high: float, marked: float
) -> UInt8[np.ndarray, "h w 3"]:
    """A picture made by `heat`, with a colour scale along its right side that is labelled at both ends and at
    one marked value.

    Args:
        picture: made from values scaled so that `low` is 0 and `high` is 1.
        low, high: the values that 0 and 1 stand for.
        marked: the value to mark; ignored if it lies outside the scale.
    """
    height, width = picture.shape[:2]
    thick, top = max(4, height // 30), height // 5
    bottom, left = height - top, width - 2 * thick
    picture = picture.copy()
    shares = np.linspace(1, 0, bottom - top)[:, None].repeat(thick, axis=1)
    picture[top:bottom, left : left + thick] = heat(shares)
    cv2.rectangle(picture, (left - 1, top - 1), (left + thick, bottom), _INK, 1)
    rows = {top: high, bottom: low}
    if low <= marked <= high:
        row = round(bottom - (marked - low) / max(high - low, 1e-9) * (bottom - top))
        cv2.line(picture, (left - thick // 2, row), (left + thick, row), _INK, 1 + height // 400)
        rows = {at: value for at, value in rows.items() if abs(at - row) > height // 10} | {row: marked}
    for row, value in rows.items():
        _write(picture, f"{value:.2f}", (left - thick, row))
    return picture


def error_heatmap(a: Num[np.ndarray, "h w c"], b: Num[np.ndarray, "h w c"]) -> UInt8[np.ndarray, "h w 3"]:
    """Mean absolute difference over the channels, black where equal and brightest from 0.3 (of 1) on.

    Pixels that are not finite in one of the images cannot be compared and are shown as no error.
    """
    error = np.abs(_to_float(a) - _to_float(b)).mean(axis=-1)
    return heat(error / _LARGE_ERROR)


def to_uint8(image: Num[np.ndarray, "h w 3"]) -> UInt8[np.ndarray, "h w 3"]:
    """A colour image in 0 to 1 (clipped, NaN black) or already uint8, as uint8."""
    if image.dtype == np.uint8:
        return image
    return np.round(np.clip(np.nan_to_num(image, nan=0.0), 0, 1) * 255).astype(np.uint8)


def side_by_side(
    image: Num[np.ndarray, "h w 3"],
    render: Num[np.ndarray, "h w 3"],
    error: UInt8[np.ndarray, "h w 3"] | None = None,
    labels: Integer[np.ndarray, "h w"] | None = None,
    captions: Sequence[str] = ("input", "render", "error", "labels"),
) -> UInt8[np.ndarray, "rows cols 3"]:
    """One panel: input, render, error and labels, each with a caption; width and height are even, as video
    codecs require.

    Args:
        image, render: colours.
        error: a picture of the error (default: the `error_heatmap` of the two).
        labels: rendered labels, laid over the dimmed input, with their numbers; left out if None.
        captions: one per picture; extra ones are ignored.
    """
    image, render = to_uint8(image), to_uint8(render)
    pictures = [image, render, error_heatmap(image, render) if error is None else error]
    if labels is not None:
        pictures.append(numbered(overlay_labels(image, labels), labels))
    columns = 2 if len(pictures) == 4 and image.shape[1] > 1.2 * image.shape[0] else len(pictures)
    return in_rows(dict(zip(captions, pictures, strict=False)), columns)


def enlarged(picture: Num[np.ndarray, "h w 3"], least_height: int) -> UInt8[np.ndarray, "H W 3"]:
    """A picture enlarged by an integer factor until it has at least `least_height` rows."""
    times = max(1, -(-least_height // len(picture)))
    return to_uint8(picture).repeat(times, 0).repeat(times, 1)


def in_rows(
    pictures: Mapping[str, Num[np.ndarray, "h w 3"]], columns: int, least_height: int = 0
) -> UInt8[np.ndarray, "rows cols 3"]:
    """Captioned pictures in rows; even-sized, as video codecs want. All must have one size once enlarged.

    Args:
        pictures: caption to colours.
        columns: number of pictures per row.
        least_height: minimum height of a picture in pixels; smaller ones are enlarged by an integer factor.
    """
    framed = [captioned(enlarged(picture, least_height), text) for text, picture in pictures.items()]
    framed += [np.zeros_like(framed[0])] * (-len(framed) % columns)
    rows = [np.concatenate(framed[i : i + columns], axis=1) for i in range(0, len(framed), columns)]
    panel = np.concatenate(rows, axis=0)
    return np.pad(panel, ((0, panel.shape[0] % 2), (0, panel.shape[1] % 2), (0, 0)))


def overlay_labels(
    image: Num[np.ndarray, "h w 3"], labels: Integer[np.ndarray, "h w"]
) -> UInt8[np.ndarray, "h w 3"]:
    """Labels as colours over a grey copy of the image, so that the shapes below still show; labels <= 0 stay
    grey."""
    grey = to_uint8(image).mean(axis=-1, keepdims=True) * 0.75
    inside: Bool[np.ndarray, "h w 1"] = (labels > 0)[..., None]
    mixed = np.where(inside, _LABEL_WEIGHT * colorize_labels(labels) + (1 - _LABEL_WEIGHT) * grey, grey)
    return np.broadcast_to(mixed, (*labels.shape, 3)).astype(np.uint8)


def numbered(
    picture: UInt8[np.ndarray, "h w 3"], labels: Integer[np.ndarray, "h w"]
) -> UInt8[np.ndarray, "h w 3"]:
    """The picture with the number of each label above 0 where the label is widest, if there is room for it.

    Args:
        picture: colours.
        labels: label of each pixel.
    """
    picture, scale = picture.copy(), max(len(picture) / 650, 0.36)
    for label in np.unique(labels[labels > 0]).tolist():
        inside = np.pad((labels == label).astype(np.uint8), 1)  # the picture's edge is an edge of the label
        _, widest, _, (x, y) = cv2.minMaxLoc(cv2.distanceTransform(inside, cv2.DIST_L2, 3))
        (wide, high), _ = cv2.getTextSize(str(label), cv2.FONT_HERSHEY_SIMPLEX, scale, 1)
        if widest < 0.5 * high:
            continue
        origin = (x - 1 - wide // 2, y - 1 + high // 2)
        for color, thickness in ((_CHIP, 3), (_INK, 1)):
            where = (picture, str(label), origin, cv2.FONT_HERSHEY_SIMPLEX, scale, color)
            cv2.putText(*where, thickness, cv2.LINE_AA)
    return picture


def _to_float(image: np.ndarray) -> np.ndarray:
    return image.astype(np.float32) / 255 if image.dtype == np.uint8 else image.astype(np.float32)


def _apply_colormap(name: str, values: np.ndarray) -> np.ndarray:
    return matplotlib.colormaps[name](values, bytes=True)[..., :3].copy()


def captioned(picture: UInt8[np.ndarray, "h w 3"], text: str) -> UInt8[np.ndarray, "h w 3"]:
    """The picture with its caption on a dark chip in the upper left corner, sized by the picture's height; a
    caption that is too wide loses its beginning."""
    picture = picture.copy()
    _write(picture, text)
    return picture


def _write(picture: UInt8[np.ndarray, "h w 3"], text: str, beside: tuple[int, int] | None = None) -> None:
    """Draw text on a dark chip, in place: in the upper left corner, or left of `beside` (column, row)."""
    scale = max(len(picture) / 650, 0.42)
    pad = round(5 * scale) + 2
    while True:
        (text_width, text_height), baseline = cv2.getTextSize(text, cv2.FONT_HERSHEY_SIMPLEX, scale, 1)
        if text_width + 2 * pad <= picture.shape[1] or len(text) <= 4:
            break
        text = "..." + text[4:]
    wide, high = text_width + 2 * pad, text_height + baseline + 2 * pad
    left, top = (0, 0) if beside is None else (max(beside[0] - wide, 0), max(beside[1] - high // 2, 0))
    chip = picture[top : top + high, left : left + wide]
    chip[:] = (0.25 * chip + 0.75 * np.array(_CHIP)).astype(np.uint8)
    origin = (left + pad, top + pad + text_height)
    cv2.putText(picture, text, origin, cv2.FONT_HERSHEY_SIMPLEX, scale, _INK, 1, cv2.LINE_AA)
