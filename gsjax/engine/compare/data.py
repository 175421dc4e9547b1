"""What runs must share to be compared, and the scores that are compared for each command."""

from typing import Any

from gsjax.engine.deform.results import SCORES as DEFORM
from gsjax.engine.distill.results import SCORES as DISTILL
from gsjax.engine.fit.results import SCORES as FIT
from gsjax.engine.messages import counted
from gsjax.engine.parts.results import SCORES as PARTS
from gsjax.engine.records import Kind
from gsjax.engine.summary import Metrics, Score
from gsjax.engine.track.results import SCORES as TRACK

SCORES: dict[Kind, tuple[Score, ...]] = {
    "fit": FIT,
    "track": TRACK,
    "parts": PARTS,
    "distill": DISTILL,
    "deform": DEFORM,
}
"""The cards of each command's report."""
_OF_PIXELS = ("psnr_masked", "ssim", "depth_mm", "psnr_other", "f_psnr", "iou", "tracks_mm")
_TEACHER = ("features", "masks", "level", "sam", "weights")
MUST_SHARE: dict[Kind, dict[tuple[str, ...], tuple[str, ...]]] = {
    "deform": {
        ("tools", "tool_values"): _OF_PIXELS,
        ("depth",): ("depth_mm",),
        _TEACHER: ("f_psnr", "iou"),
        ("deform.channels",): ("f_psnr",),
    },
    "distill": {(*_TEACHER, "snap"): ("cosine",)},
}
"""For each command, settings that runs must share, and the scores that cannot be compared otherwise."""


def data_of(kind: Kind, found: Metrics) -> tuple[Any, ...]:
    """What runs of the same dataset must share to be compared: the size of pictures, then the frames and
    cameras of a recording, or the numbers of training and held-out views or frames."""
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
    """Describes a dataset and its `data_of`, for a note; `data` is None for a run without metrics yet."""
    if data is None:
        return dataset
    size = f"{dataset} at {data[0]}x{data[1]}"
    if len(data) == 2:
        return size
    if isinstance(data[2], str):  # the views or frames that it was scored on, and their numbers
        return f"{size}, " + ", ".join(f"{count} {name.replace('_', ' ')}" for name, count in data[3])
    (first, last, count), (tracked, held_out) = data[2:]
    by = f", scored on {[*held_out]}" if held_out else ""
    return f"{size}, {counted(count, 'frame')} {first} to {last}, cameras {[*tracked]}{by}"
