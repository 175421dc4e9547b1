"""Behaviour cloning on the tracked pose of an object, on images, and on the true pose."""

import json
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np

from experiments.policies.bins import HORIZON, Bins
from experiments.policies.demonstrations import HOME
from experiments.policies.learning import CHUNK, act, trained, vector_of
from experiments.policies.sight import Tracking, small


@cache
def world() -> Bins:
    return Bins()


def run(options: dict[str, Any], seed: int, folder: Path) -> dict[str, Any]:
    """One rollout of the policy that sees `options["sees"]`, trained from the seed `options["trained"]`."""
    seen, bins = options["sees"], world()
    policy = trained(HOME, seen, options["trained"])
    bins.begin(seed)
    tracking, first, errors, chunk, start = Tracking(bins), None, [], [], bins.can()
    periods = 0
    while periods < HORIZON and not bins.success():
        periods += 1
        pose, images = bins.can(), np.zeros((0, 1, 1, 3), np.float32)
        if seen == "tracked Gaussians":  # in every period, so that motions between frames stay small
            pose = tracking.see(*bins.cameras.images(bins.data))
            offset = np.linalg.inv(start) @ (first if first is not None else pose)
            errors.append(1e3 * float(np.linalg.norm((bins.can() @ offset - pose)[:3, 3])))
        first = pose if first is None else first
        if not chunk:
            if seen == "images":
                images = small(bins.cameras.images(bins.data)[0]).astype(np.float32) / 255
            vector = vector_of(seen, bins.feel().vector(), pose, first)
            chunk = list(np.asarray(act(policy, vector.astype(np.float32), images)))
        bins.move(chunk.pop(0), guarded=True)
    made = json.loads((HOME / "demonstrations.json").read_text())
    return {
        "success": float(bins.success()),
        "lifted": float(bins.lifted),
        "periods": periods,
        "error_mm": float(np.median(errors)) if errors else None,
        "chunk": CHUNK,
        "demonstrations": made["kept"],
        "tried": made["tried"],
    }


def figure(rows: list[dict[str, Any]], path: Path) -> None:
    """Success rates of the policies."""
    from experiments.shared.plots import draw_policies

    draw_policies(rows, path)
