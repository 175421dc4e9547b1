"""What each part of a fitted scene is worth: how well it is seen with fewer Gaussians, colours or minutes."""

from typing import Any

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from gsjax.engine.fit.results import Curve, Plans, judge
from gsjax.methods.fit import Problem, View
from gsjax.optim.densification import EMPTY_LOGIT
from gsjax.scene.gaussians import Gaussians

_SHARES = {"half of the Gaussians": 2, "a quarter": 4, "an eighth": 8, "a sixteenth": 16}
_MINUTES = {"after half of the time": 1 / 2, "after a quarter": 1 / 4, "after an eighth": 1 / 8}


def parts(
    problem: Problem,
    gaussians: Gaussians,
    light: Float[np.ndarray, "n"],
    views: list[tuple[str, View]],
    curve: Curve,
    plans: Plans,
) -> list[dict[str, Any]]:
    """What is left (`part`) of the scene, of how many `gaussians` and which `sh_degree` (None: was not
    written down), and the mean `psnr` of the views then. Nothing is fitted again: a fit for less does better.

    Args:
        problem: what was fitted.
        gaussians: the scene.
        light: of `light_of`; who sends least is left out first.
        views: held-out ones, those that the curve was judged by.
        curve: how the fit went on.
        plans: as `judge` has it.
    """

    def row(part: str, scene: Gaussians, count: int, degree: int) -> dict[str, Any]:
        psnr = judge(problem, scene, views, plans=plans).mean()["psnr"]
        return {"part": part, "gaussians": count, "sh_degree": degree, "psnr": psnr}

    count, degree = gaussians.num, gaussians.sh_degree
    rows = [row("all", gaussians, count, degree)]
    order = np.argsort(-light, kind="stable")
    for name, divisor in _SHARES.items():
        kept = -(-count // divisor)
        rows.append(row(name, _emptied(gaussians, order[kept:]), kept, degree))
    for less in reversed(range(degree)):
        rows.append(row(f"colours of degree {less}", _plainer(gaussians, less), count, less))
    return rows + parts_of_time(curve)


def parts_of_time(curve: Curve) -> list[dict[str, Any]]:
    """The same after a part of the time: at the last look before it, where there was one."""
    rows = []
    for name, share in _MINUTES.items():
        before = [r for r in curve.looks() if r["seconds"] <= share * curve.rows[-1]["seconds"]]
        if before:
            alive, psnr = before[-1]["alive"], before[-1]["test_psnr"]
            rows.append({"part": name, "gaussians": alive, "sh_degree": None, "psnr": psnr})
    return rows


def _emptied(gaussians: Gaussians, rows: np.ndarray) -> Gaussians:
    """Without some: their slots stay, so that one program draws all parts."""
    logits = jnp.asarray(gaussians.logit_opacities).at[rows].set(EMPTY_LOGIT)
    return eqx.tree_at(lambda g: g.logit_opacities, gaussians, logits)


def _plainer(gaussians: Gaussians, degree: int) -> Gaussians:
    """With no colours of a higher degree of the spherical harmonics."""
    shN = jnp.asarray(gaussians.shN).at[:, (degree + 1) ** 2 - 1 :].set(0)
    return eqx.tree_at(lambda g: g.shN, gaussians, shN)
