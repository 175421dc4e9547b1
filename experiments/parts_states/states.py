"""Parts, motions and joints from two states of a cabinet, each seen by cameras of its own."""

from dataclasses import replace
from pathlib import Path
from time import perf_counter
from typing import Any

import numpy as np

import gsjax
from gsjax.data import Sequence
from gsjax.engine.scores import true_labels_at
from gsjax.geometry.joints import fit_joint
from gsjax.methods.parts.states import States, states_of
from gsjax.methods.parts.states.registration import moved
from gsjax.methods.parts.states.surfaces import pixel_width
from gsjax.metrics.parts import joint_error
from gsjax.metrics.tracking import relative_motion
from gsjax.viz.colors import label_color

OBJECTS = {
    "door and drawer": (1, 1),
    "three doors": (3, 0),
    "two doors and two drawers": (2, 2),
    "four doors and three drawers": (4, 3),
}
NOISE = 0.005  # of the depth, standard deviation
SHOWN = "two doors and two drawers"


def run(options: dict[str, Any], seed: int, folder: Path) -> dict[str, Any]:
    """One object. A part is found if a motion carries its points to within a pixel on average."""
    sequence = recording(options["object"], seed, noisy=options["depth"] != "exact")
    before, after = sequence.frame(0), sequence.frame(1)
    states_of(before, after)  # compiles
    begun = perf_counter()
    found = states_of(before, after)
    seconds = perf_counter() - begun
    truth, points, pixel = sequence.truth, found.surface.points, pixel_width(before)
    labels = true_labels_at(recording(options["object"], seed), 0, points)
    assert truth is not None
    assert labels is not None
    rows, matched = [], set()
    for k, true in enumerate(truth.joints):
        mine = points[labels == truth.label_ids[k]]
        way = relative_motion(truth.poses[:, k], 0)
        gaps = [np.linalg.norm(moved(m, mine) - moved(way[1], mine), axis=-1).mean() for m in found.motions]
        best = int(np.argmin(gaps))
        if best == 0 or gaps[best] > pixel:
            continue
        matched.add(best)
        joint = fit_joint(np.stack([np.eye(4), found.motions[best]]), points[found.labels == best]).joint
        both = ((found.labels == best) & (labels == truth.label_ids[k])).sum()
        either = ((found.labels == best) | (labels == truth.label_ids[k])).sum()
        rows.append({"iou": both / either, "kind": true.kind, "gap_mm": 1000 * gaps[best]})
        if joint is not None:
            rows[-1] |= joint_error(joint, true, mine.mean(0))._asdict()

    def mean(name: str, kind: str | None = None) -> float | None:
        values = [row[name] for row in rows if name in row and kind in (None, row["kind"])]
        values = [value for value in values if value is not None and np.isfinite(value)]
        return float(np.mean(values)) if values else None

    return {
        "true_parts": len(truth.names),
        "found": len(rows),
        "extra": len(found.motions) - 1 - len(matched),
        "axis_deg": mean("axis_deg"),
        "line_mm": mean("line_mm", "revolute"),
        "turn_deg": mean("value_deg", "revolute"),
        "slide_mm": mean("value_mm", "prismatic"),
        "gap_mm": mean("gap_mm"),
        "iou": mean("iou"),
        "search_s": seconds,
    }


def recording(name: str, seed: int, *, noisy: bool = False) -> Sequence:
    """An object in two states, with exact or noisy depth."""
    doors, drawers = OBJECTS[name]
    sequence = gsjax.open_sequence(f"simulated:cabinet?doors={doors}&drawers={drawers}&seed={seed}")
    if not noisy:
        return sequence
    load = sequence.load_depth
    assert load is not None

    def with_noise(t: int, c: int) -> np.ndarray:
        depth = np.asarray(load(t, c))
        random = np.random.default_rng((seed, t, c))
        return (depth * (1 + NOISE * random.normal(size=depth.shape))).astype(np.float32)

    return replace(sequence, load_depth=with_noise)


def figure(rows: list[dict[str, Any]], path: Path) -> None:
    """An object in both states, and the parts that are found of it."""
    from matplotlib.figure import Figure

    sequence = recording(SHOWN, 0)
    found = states_of(sequence.frame(0), sequence.frame(1))
    shown = Figure(figsize=(12, 2.6), layout="constrained")
    axes = shown.subplots(1, 4)
    for t in (0, 1):
        axes[t].imshow(sequence.image(t, _best_view(sequence, t)))
        axes[2 + t].imshow(_labels_in(sequence, found, t))
        axes[t].set_title(("before", "after")[t])
        axes[2 + t].set_title(("parts, before", "moved as was found")[t])
    for one in axes:
        one.axis("off")
    shown.savefig(path, dpi=110)


def _best_view(sequence: Sequence, t: int) -> int:
    """The camera that most of the parts are seen by."""
    return int(np.argmax([(sequence.mask(t, c) > 0).sum() for c in range(sequence.num_cameras)]))


def _labels_in(sequence: Sequence, found: States, t: int) -> np.ndarray:
    """The points in the picture of a state, each in the colour of its part."""
    camera = _best_view(sequence, t)
    points = found.surface.points.copy()
    for k, motion in enumerate(found.motions):
        mine = found.labels == k
        points[mine] = moved(motion, points[mine]) if t else points[mine]
    local = points @ sequence.viewmats[t, camera, :3, :3].T + sequence.viewmats[t, camera, :3, 3]
    pixels = (local / local[:, 2:]) @ sequence.Ks[t, camera].T
    picture = np.full((sequence.height, sequence.width, 3), 255, np.uint8)
    colors = np.array([(190, 190, 190), *(label_color(k) for k in range(1, len(found.motions)))], np.uint8)
    for row in np.argsort(-local[:, 2]):
        x, y = int(pixels[row, 0]), int(pixels[row, 1])
        if local[row, 2] > 0 and 0 <= x < sequence.width - 1 and 0 <= y < sequence.height - 1:
            picture[y : y + 2, x : x + 2] = colors[found.labels[row]]
    return picture
