"""Which blend of rotations deforms a twisting, bending bar as it truly does, and what does it cost?

Handles stand along the bar's axis and move as its cross-sections there do, so what is wrong is the blend's.
"""

from functools import partial
from pathlib import Path
from time import perf_counter
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from scipy.spatial.transform import Rotation

from gsjax.data.simulated.bar import BAR
from gsjax.data.simulated.bent_box import BentBox
from gsjax.scene.gaussians import gaussians_from_activated
from gsjax.scene.handles import HandlePose, skin

POINTS, BEND_DEG, STEP = 4_000, 45.0, 1e-5
TIMED, CALLS = 20_000, 12


def run(options: dict[str, Any], seed: int, folder: Path) -> dict[str, Any]:
    """One blend at one twist, by so many handles."""
    box = BentBox(*BAR, np.deg2rad(options["twist_deg"]), np.deg2rad(BEND_DEG), 0.4)
    points = np.random.default_rng(seed).uniform(-1, 1, (POINTS, 3)) * BAR
    heights = np.linspace(-BAR[2], BAR[2], options["handles"])
    centers = np.stack([0 * heights, 0 * heights, heights], axis=1)
    turns = local_turns(box, centers)
    pose = HandlePose(
        jnp.asarray(turns.as_quat(scalar_first=True), jnp.float32),
        jnp.asarray(box.deform(centers.T).T - centers, jnp.float32),
    )
    weights = hats(points[:, 2], heights)
    moved, quats = map(np.asarray, skinned(points, weights, centers, pose, options["blend"]))
    off = np.linalg.norm(moved - box.deform(points.T).T, axis=1)
    turned = Rotation.from_quat(quats, scalar_first=True)
    wrong = np.rad2deg((local_turns(box, points).inv() * turned).magnitude())
    return {
        "mean_mm": 1000 * off.mean(),
        "worst_mm": 1000 * off.max(),
        "thinnest": thinnest(box, heights, centers, pose, options["blend"]),
        "turn_deg": wrong.mean(),
        "worst_turn_deg": wrong.max(),
        **times(weights, centers, pose, options["blend"]),
    }


def skinned(points, weights, centers, pose, blend):
    """Where points go, and how Gaussians there are turned."""
    count = len(points)
    quats = np.tile([1.0, 0, 0, 0], (count, 1))
    gaussians = gaussians_from_activated(
        points, quats, np.full((count, 3), 0.01), np.full(count, 0.9), np.full((count, 3), 0.5)
    )
    moved = skin(gaussians, jnp.asarray(weights, jnp.float32), jnp.asarray(centers, jnp.float32), pose, blend)
    return moved.means, moved.quats


def local_turns(box: BentBox, points: np.ndarray) -> Rotation:
    """How the bar is turned at points: the rotation nearest to the derivative of where they go."""
    columns = [
        (box.deform((points + STEP * axis).T) - box.deform((points - STEP * axis).T)) / (2 * STEP)
        for axis in np.eye(3)
    ]
    u, _, vt = np.linalg.svd(np.stack(columns, axis=-1).transpose(1, 0, 2))
    return Rotation.from_matrix(u @ vt)


def hats(z: np.ndarray, heights: np.ndarray) -> np.ndarray:
    """Weights that fall evenly from 1 at a handle to 0 at the next."""
    return np.stack([np.interp(z, heights, row) for row in np.eye(len(heights))], axis=1)


def thinnest(box, heights, centers, pose, blend) -> float:
    """How wide the narrowest cross-section is, of its true width (the candy wrapper of linear blending)."""
    levels = np.linspace(-BAR[2], BAR[2], 81)
    corners = np.array([[x, y] for x in (-BAR[0], BAR[0]) for y in (-BAR[1], BAR[1])])
    points = np.concatenate([np.column_stack([corners, np.full(4, z)]) for z in levels])
    moved = np.asarray(skinned(points, hats(points[:, 2], heights), centers, pose, blend)[0]).reshape(
        -1, 4, 3
    )
    true = box.deform(points.T).T.reshape(-1, 4, 3)
    widths = [np.linalg.norm(one - one.mean(1, keepdims=True), axis=-1).mean(1) for one in (moved, true)]
    return float((widths[0] / widths[1]).min())


def times(weights, centers, pose, blend) -> dict[str, float]:
    """Milliseconds for 20,000 Gaussians, by turns with the default blend, over which the ratios are."""
    points, weights = (np.resize(a, (TIMED, a.shape[1])) for a in (np.zeros((1, 3)) + 0.01, weights))
    weights, centers = (jnp.asarray(a, jnp.float32) for a in (weights, centers))

    def total(blend, pose, weights):
        means, quats = skinned(points, weights, centers, pose, blend)
        return jnp.sum(means**2) + jnp.sum(quats**2)

    programs = {name: jax.jit(jax.grad(partial(total, name), (0, 1))) for name in ("quaternion", blend)}
    seconds: dict[str, list[float]] = {name: [] for name in programs}
    for _ in range(CALLS):
        for name, program in programs.items():
            begun = perf_counter()
            jax.block_until_ready(program(pose, weights))
            seconds[name].append(perf_counter() - begun)
    medians = {name: float(np.median(each[2:])) for name, each in seconds.items()}
    return {"gradient_ms": 1000 * medians[blend], "over_quaternion": medians[blend] / medians["quaternion"]}


def figure(rows: list[dict[str, Any]], path: Path) -> None:
    """Errors over the twist, a line for each blend, a column for each number of handles."""
    from matplotlib.figure import Figure

    panels = (
        ("mean_mm", "mean error [mm]"),
        ("turn_deg", "mean turn error [°]"),
        ("thinnest", "narrowest, of 1"),
    )
    handles = sorted({row["handles"] for row in rows})
    drawing = Figure(figsize=(3.4 * len(handles), 8), dpi=100, layout="constrained")
    grid = drawing.subplots(len(panels), len(handles), sharex=True, sharey="row", squeeze=False)
    for line, (key, title) in zip(grid, panels, strict=True):
        for axes, count in zip(line, handles, strict=True):
            for blend in dict.fromkeys(row["blend"] for row in rows):
                mine = [row for row in rows if row["blend"] == blend and row["handles"] == count]
                axes.plot([r["twist_deg"] for r in mine], [r[key] for r in mine], "o-", label=blend, ms=4)
            axes.grid(color="0.9")
        line[0].set_ylabel(title)
    for axes, count in zip(grid[0], handles, strict=True):
        axes.set_title(f"{count} handles")
    for axes in grid[-1]:
        axes.set_xlabel("twist [°]")
    grid[0, 0].legend(frameon=False)
    drawing.savefig(path)
