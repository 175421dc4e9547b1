"""Ablation of a fitted scene: its scores with fewer Gaussians, lower SH degrees, or fewer minutes."""

from collections.abc import Mapping, Sequence
from typing import Any

import equinox as eqx
import jax
import numpy as np
from jaxtyping import Float

from gsjax.engine.fit.judge import Judge
from gsjax.engine.fit.schedule import evaluated
from gsjax.optim.densification import EMPTY_LOGIT
from gsjax.scene.frame import Frame
from gsjax.scene.gaussians import Gaussians

_SHARES = {"half of the Gaussians": 2, "a quarter": 4, "an eighth": 8, "a sixteenth": 16}
_MINUTES = {"after half of the time": 1 / 2, "after a quarter": 1 / 4, "after an eighth": 1 / 8}


def ablate(
    gaussians: Gaussians,
    light: Float[np.ndarray, "n"],
    frames: Sequence[tuple[str, Frame]],
    rows: Sequence[Mapping[str, Any]],
    judge: Judge,
) -> list[dict[str, Any]]:
    """Returns a row per reduced scene: the `part` that is kept, its number of `gaussians`, its `sh_degree`
    (None if it was not logged), and the mean `psnr` of the views. Nothing is fitted again: a fit of that
    size does better.

    Args:
        gaussians: the scene, perhaps with empty slots after it.
        light: from `light_of`; Gaussians with the least light are removed first.
        frames: the held-out views that were evaluated during the fit.
        rows: the logged rows of the fit.
        judge: scores views.
    """

    def row(part: str, scene: Gaussians, count: int, degree: int) -> dict[str, Any]:
        psnr = judge(scene, frames).mean()["psnr"]
        return {"part": part, "gaussians": count, "sh_degree": degree, "psnr": psnr}

    count, degree = len(light), gaussians.sh_degree
    found = [row("all", gaussians, count, degree)]
    order = np.argsort(-light, kind="stable")
    for name, divisor in _SHARES.items():
        kept = -(-count // divisor)
        found.append(row(name, _without_rows(gaussians, order[kept:]), kept, degree))
    for less in reversed(range(degree)):
        found.append(row(f"colours of degree {less}", _lower_degree(gaussians, less), count, less))
    return found + ablate_time(rows)


def ablate_time(rows: Sequence[Mapping[str, Any]]) -> list[dict[str, Any]]:
    """Rows, as in `ablate`, of the whole scene after a fraction of the time: of the last evaluation up to
    then, if there was one."""
    found = []
    for name, share in _MINUTES.items():
        before = [r for r in evaluated(rows) if r["seconds"] <= share * rows[-1]["seconds"]]
        if before:
            alive, psnr = before[-1]["alive"], before[-1]["test_psnr"]
            found.append({"part": name, "gaussians": alive, "sh_degree": None, "psnr": psnr})
    return found


def _without_rows(gaussians: Gaussians, rows: np.ndarray) -> Gaussians:
    """The scene without some rows; their slots stay, so that one compiled program renders all parts."""
    logits = np.array(gaussians.logit_opacities)
    logits[rows] = EMPTY_LOGIT
    return eqx.tree_at(lambda g: g.logit_opacities, gaussians, jax.device_put(logits))


def _lower_degree(gaussians: Gaussians, degree: int) -> Gaussians:
    """The scene with spherical harmonics of a lower degree."""
    shN = np.array(gaussians.shN)
    shN[:, (degree + 1) ** 2 - 1 :] = 0
    return eqx.tree_at(lambda g: g.shN, gaussians, jax.device_put(shN))
