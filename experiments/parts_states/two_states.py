"""Two states of an object that opens: which parts moved, about which axes, and how far off are both?"""

from collections.abc import Callable
from functools import partial
from pathlib import Path
from time import perf_counter
from typing import Any

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from scipy.spatial import KDTree

from experiments.parts_states.partnet import partnet
from experiments.shared.recordings import recorded
from gsjax.data import Sequence
from gsjax.data.simulated import cabinet
from gsjax.engine.scores import true_labels_at
from gsjax.geometry.joints import Joint, fit_joint
from gsjax.methods.parts.states import states_of
from gsjax.methods.parts.states.registration import moved
from gsjax.methods.parts.states.surfaces import pixel_width, surface_of
from gsjax.metrics.parts import joint_error, match_parts
from gsjax.scene.frame import Frame

OBJECTS: dict[str, Callable[..., Sequence]] = {
    "PartNet 40147": lambda seed: partnet(recorded("partnet_mobility") / "40147", seed),
    "PartNet 41083": lambda seed: partnet(recorded("partnet_mobility") / "41083", seed),
    "cabinet, 1 door, 1 drawer": partial(cabinet, 1, 1),
    "cabinet, 2 doors": partial(cabinet, 2, 0),
    "cabinet, 2 drawers": partial(cabinet, 0, 2),
    "cabinet, 2 doors, 2 drawers": partial(cabinet, 2, 2),
}
NOISE = {"exact": 0.0, "0.5 % noise": 0.005}
AVERAGED = ("axis_deg", "line_mm", "travel_deg", "travel_mm", "point_mm", "chamfer_mm", "iou")
PANELS = (
    ("axis_deg", "angle between the axes [deg]", 1e-3),
    ("point_mm", "points after the motion off [mm]", 1e-2),
)
PRINTED = {"ArtGS": 0.05, "DTA": 0.13, "PARIS": 11.14}  # mean angles of their synthetic objects, degrees
FOUND_IOU = 0.5  # overlap from which a part counts as found, if its points come less than a pixel off


def run(options: dict[str, Any], seed: int, folder: Path) -> dict[str, Any]:
    """The parts of one object, and how far each is off."""
    sequence = OBJECTS[options["object"]](seed=seed)
    random = np.random.default_rng(seed)
    states = [noisy(sequence.frame(t), NOISE[options["depth"]], random) for t in range(2)]
    begun = perf_counter()
    found = states_of(*states, seed)
    seconds = perf_counter() - begun
    truth, points = sequence.truth, found.surface.points
    real, (exact, exactly) = true_labels_at(sequence, 0, points), true_surface(sequence)
    assert truth is not None
    assert real is not None
    match = match_parts(found.labels, real)
    parts = {}
    for name, label, joint in zip(truth.names, truth.label_ids.tolist(), truth.joints, strict=True):
        number = match.found.get(label, 0)
        if number and match.ious[label] >= FOUND_IOU:
            mine, its = points[found.labels == number], exact[exactly == label]
            scores = part_scores(found.motions[number], mine, its, joint) | {"iou": match.ious[label]}
            if scores["point_mm"] < 1000 * pixel_width(states[0]):
                parts[name] = scores
    return {
        "found": len(parts),
        "true_parts": len(truth.names),
        "extra": len(found.motions) - 1 - len(parts),
        "right_kind": sum(part["right_kind"] for part in parts.values()),
        **{key: mean_of(parts, key) for key in AVERAGED},
        "still_chamfer_mm": chamfer_mm(points[found.labels == 0], exact[exactly == 0]),
        "parts": parts,
        "compute_seconds": seconds,
    }


def noisy(frame: Frame, noise: float, random: np.random.Generator) -> Frame:
    """A frame whose depth is off by normal errors, relative to it."""
    depths = np.asarray(frame.depths)
    off = depths * (1 + noise * random.normal(size=depths.shape))
    return eqx.tree_at(lambda f: f.depths, frame, jnp.asarray(off, jnp.float32))


def true_surface(sequence: Sequence) -> tuple[np.ndarray, np.ndarray]:
    """Points of the first state that cameras see, about a pixel apart, and their true labels."""
    frame = sequence.frame(0)
    points = surface_of(frame, pixel_width(frame)).points
    return points, true_labels_at(sequence, 0, points)


def part_scores(motion: np.ndarray, mine: np.ndarray, its: np.ndarray, true: Joint) -> dict[str, Any]:
    """How far a part that was found is off.

    Args:
        motion: that was found, [4, 4].
        mine, its: points that were labelled as the part, and those that are of it, [n, 3].
        true: its joint.
    """
    motions, middle = true.motions(), its.mean(0)
    real = motions[1] @ np.linalg.inv(motions[0])
    fitted = fit_joint(np.stack([np.eye(4), motion]), its)
    scores = {"point_mm": 1000 * float(np.linalg.norm(moved(motion, its) - moved(real, its), axis=-1).mean())}
    scores["chamfer_mm"], scores["right_kind"] = chamfer_mm(mine, its), fitted.kind == true.kind
    if fitted.joint is not None:
        error = joint_error(fitted.joint, true, middle)
        known = {"axis_deg": error.axis_deg, "line_mm": error.line_mm}
        known |= {"travel_deg": 2 * error.value_deg, "travel_mm": 2 * error.value_mm}
        scores |= {key: value for key, value in known.items() if np.isfinite(value)}
    return scores


def chamfer_mm(one: np.ndarray, other: np.ndarray) -> float | None:
    """The mean of both mean distances to the nearest point of the other set; None if one is empty."""
    if not len(one) or not len(other):
        return None
    ways = [KDTree(b).query(a)[0].mean() for a, b in ((one, other), (other, one))]
    return 1000 * float(np.mean(ways))


def mean_of(parts: dict[str, dict[str, Any]], key: str) -> float | None:
    """Mean over the parts that have a value; None if none has."""
    values = [part[key] for part in parts.values() if part.get(key) is not None]
    return float(np.mean(values)) if values else None


def figure(rows: list[dict[str, Any]], path: Path) -> None:
    """Axes and motions: a dot for each part, a column for each object and kind of depth."""
    from matplotlib.figure import Figure

    objects, kinds = (list(dict.fromkeys(row[key] for row in rows)) for key in ("object", "depth"))
    drawing = Figure(figsize=(2.1 * len(objects), 4.2), dpi=100, layout="constrained")
    panels = drawing.subplots(1, 2)
    for axes, (key, label, floor) in zip(panels, PANELS, strict=True):
        for row in rows:
            kind = kinds.index(row["depth"])
            column = objects.index(row["object"]) + 0.3 * (kind - (len(kinds) - 1) / 2)
            column += 0.07 * (row["seed"] - 1)
            values = [part[key] for part in row["parts"].values() if part.get(key) is not None]
            places = column * np.ones(len(values))
            axes.plot(places, np.maximum(values, floor), "o", color=f"C{kind}", markersize=4, alpha=0.7)
            missed = floor * 1.35 ** -np.arange(1, 1 + row["true_parts"] - row["found"])
            axes.plot(column * np.ones(len(missed)), missed, "x", color=f"C{kind}", markersize=5)
        axes.set(yscale="log", ylabel=label)
        axes.set_xticks(range(len(objects)), [name.replace(", ", ",\n") for name in objects], fontsize=7)
        axes.grid(axis="y", linewidth=0.3)
    for system, degrees in PRINTED.items():
        panels[0].axhline(degrees, color="#888888", linewidth=0.8, linestyle=":")
        panels[0].text(
            len(objects) - 0.5, degrees, system, fontsize=7, color="#666666", va="bottom", ha="right"
        )
    for kind, name in enumerate(kinds):
        panels[1].plot([], [], "o", color=f"C{kind}", label=f"depth: {name}")
    panels[1].legend(fontsize=8, frameon=False)
    drawing.savefig(path, format=path.suffix.removeprefix(".") or "png")
