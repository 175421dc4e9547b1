"""What runs of each command are compared by, and what makes two of them comparable."""

from collections.abc import Callable, Mapping
from typing import Any, Literal, NamedTuple

from gsjax.engine.records import Kind
from gsjax.engine.track.results import MOVED_MM

Metrics = Mapping[str, Any]


class Aspect(NamedTuple):
    """What runs are compared by.

    Attributes:
        head, unit, decimals: of its column.
        key: in comparison.json.
        better: which of two numbers is better; None if neither.
        of: what must be the same for two numbers to be compared: the views, the data, or the machine too.
        value: metrics.json -> the number, or None. Scores of a fit's views are means over those that all runs
            have in common, and not taken by this.
    """

    head: str
    key: str
    unit: str
    decimals: int | None
    better: Literal["more", "less"] | None
    of: Literal["views", "data", "machine"]
    value: Callable[[Metrics], Any] = lambda found: None


def _at(*names: str) -> Callable[[Metrics], Any]:
    """The entry of metrics.json at a path; None if there is none."""

    def value(found: Metrics) -> Any:
        node: Any = found
        for name in names:
            node = node.get(name) if isinstance(node, Mapping) else None
        return node

    return value


def _minutes(found: Metrics) -> float:
    """Of steps and of compiling them."""
    seconds = found["seconds"]
    return (seconds.get("steps", 0.0) + seconds.get("compile", 0.0)) / 60


def _largest_error(found: Metrics) -> float | None:
    """The largest centroid error of objects that moved far enough to tell."""
    errors = [
        scored["centroid_error_mm"]
        for scored in found["objects"].values()
        if scored["centroid_error_mm"] is not None and scored["moved_mm"] > MOVED_MM
    ]
    return max(errors, default=None)


def _lowest_iou(found: Metrics) -> float | None:
    return min((value for value in found["iou"].values() if value is not None), default=None)


def _mean_of_parts(key: str) -> Callable[[Metrics], float | None]:
    def value(found: Metrics) -> float | None:
        values = [row[key] for row in found["parts"] if row.get(key) is not None]
        return sum(values) / len(values) if values else None

    return value


ASPECTS: dict[Kind, tuple[Aspect, ...]] = {
    "fit": (
        Aspect("PSNR", "psnr", "dB", 2, "more", "views"),
        Aspect("SSIM", "ssim", "", 3, "more", "views"),
        Aspect("MS-SSIM", "ms_ssim", "", 3, "more", "views"),
        Aspect("LPIPS", "lpips", "", 3, "less", "views"),
        Aspect("depth", "depth_mm", "mm", 1, "less", "views"),
        Aspect("Gaussians", "num_gaussians", "", None, "less", "data"),
        Aspect("time", "minutes", "min", 1, "less", "machine"),
        Aspect("steps", "steps", "", None, None, "data"),
    ),
    "track": (
        Aspect("centroid error", "centroid_error_mm", "mm", 2, "less", "data", _largest_error),
        Aspect("lowest IoU", "iou", "", 3, "more", "data", _lowest_iou),
        Aspect("PSNR", "psnr", "dB", 2, "more", "data", _at("tracked", "psnr")),
        Aspect("PSNR held out", "psnr_held_out", "dB", 2, "more", "data", _at("held_out", "psnr")),
        Aspect("SSIM held out", "ssim_held_out", "", 3, "more", "data", _at("held_out", "ssim")),
        Aspect("rate", "update_hz", "Hz", 2, "more", "machine", _at("update_hz")),
        Aspect("Gaussians", "num_gaussians", "", None, "less", "data", _at("gaussians", "all")),
        Aspect("frames", "frames", "", None, None, "data", _at("frames", "tracked")),
    ),
    "parts": (
        Aspect("ARI", "ari", "", 3, "more", "data", _at("ari")),
        Aspect("mean IoU", "iou", "", 3, "more", "data", _mean_of_parts("iou")),
        Aspect("point error", "point_error_mm", "mm", 2, "less", "data", _mean_of_parts("point_error_mm")),
        Aspect("PSNR", "psnr", "dB", 2, "more", "data", _at("tracked", "psnr")),
        Aspect("PSNR held out", "psnr_held_out", "dB", 2, "more", "data", _at("held_out", "psnr")),
        Aspect("SSIM held out", "ssim_held_out", "", 3, "more", "data", _at("held_out", "ssim")),
        Aspect("parts", "num_parts", "", None, None, "data", _at("num_parts")),
        Aspect("Gaussians", "num_gaussians", "", None, "less", "data", _at("num_gaussians")),
        Aspect("a frame", "update_s", "s", 2, "less", "machine", _at("update_s", "median")),
    ),
    "distill": (
        Aspect("cosine", "cosine", "", 3, "more", "data", _at("test", "cosine")),
        Aspect("mIoU 2D", "miou_2d", "", 3, "more", "data", _at("test", "miou_2d")),
        Aspect("mIoU 3D", "miou_3d", "", 3, "more", "data", _at("test", "miou_3d")),
        Aspect(
            "boundary mIoU 3D", "mboundary_iou_3d", "", 3, "more", "data", _at("test", "mboundary_iou_3d")
        ),
        Aspect("numbers trained", "trained", "", None, "less", "data", _at("trained")),
        Aspect("time", "minutes", "min", 1, "less", "machine", _minutes),
        Aspect("steps", "steps", "", None, None, "data", _at("steps")),
    ),
    "deform": (
        Aspect("PSNR masked", "psnr_masked", "dB", 2, "more", "data", _at("test", "psnr_masked")),
        Aspect("SSIM", "ssim", "", 3, "more", "data", _at("test", "ssim")),
        Aspect("depth", "depth_mm", "mm", 2, "less", "data", _at("test", "depth_mm")),
        Aspect("f-PSNR", "f_psnr", "dB", 2, "more", "data", _at("test", "f_psnr")),
        Aspect("IoU", "iou", "", 3, "more", "data", _at("test", "iou")),
        Aspect("tracks", "tracks_mm", "mm", 2, "less", "data", _at("tracks", "median_mm")),
        Aspect("drawn at", "fps", "Hz", 1, "more", "machine", _at("test", "fps")),
        Aspect("Gaussians", "num_gaussians", "", None, "less", "data", _at("num_gaussians")),
        Aspect("time", "minutes", "min", 1, "less", "machine", _minutes),
        Aspect("steps", "steps", "", None, None, "data", _at("steps")),
    ),
}
"""Scores of a track are as the cards of its report have them; those of parts are means over parts whose truth
is known."""


def data_of(kind: Kind, found: Metrics) -> tuple[Any, ...]:
    """What runs of the same dataset must share to be compared: the size of pictures, then frames and cameras
    of a recording, how many views there were of a field, or how many frames were held out."""
    if kind == "fit":
        return tuple(found["size"])
    if kind == "distill":
        return (*found["size"], found["judged_by"], tuple(sorted(found["views"].items())))
    if kind == "deform":
        return (*found["size"], found["judged_by"], tuple(sorted(found["frames"].items())))
    image, frames = found["image"], found["frames"]
    cameras = tuple(found["tracked_cameras"]), tuple(found["held_out_cameras"])
    count = frames["tracked"] if kind == "track" else frames["asked"]
    return image["width"], image["height"], (frames["first_id"], frames["last_id"], count), cameras


def data_in_words(dataset: str, data: tuple[Any, ...] | None) -> str:
    """The same for a note; `data` is None for a run that has not got so far."""
    if data is None:
        return dataset
    size = f"{dataset} at {data[0]}x{data[1]}"
    if len(data) == 2:
        return size
    if isinstance(data[2], str):  # by what it was judged, and how many there were
        return f"{size}, " + ", ".join(f"{count} {name.replace('_', ' ')}" for name, count in data[3])
    (first, last, count), (tracked, held_out) = data[2:]
    by = f", judged by {[*held_out]}" if held_out else ""
    return f"{size}, {count} frames {first} to {last}, cameras {[*tracked]}{by}"
