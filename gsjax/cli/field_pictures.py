"""Pictures of what a query found: the photograph, the heat of the scores, and the scene without, alone,
recoloured, moved."""

from pathlib import Path
from typing import TYPE_CHECKING, Any

import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool

from gsjax.cli.field_run import FieldRun
from gsjax.cli.outputs import write_png
from gsjax.geometry.cameras import Camera
from gsjax.methods.feature_field import frozen_views
from gsjax.rasterize.frozen import paint
from gsjax.scene.gaussians import Gaussians
from gsjax.scene.render import render_with_room
from gsjax.scene.selection import shifted, tinted, without
from gsjax.viz.colors import heat, highlight, in_rows, to_uint8

if TYPE_CHECKING:
    from gsjax.cli.field_query import Selection

_MARK = (255, 70, 160)
_PANEL_HEIGHT = 240  # pixels, at least


def telling_view(masks: list[Bool[np.ndarray, "h w"]]) -> int:
    """Which mask has the largest share of its picture."""
    return int(np.argmax([mask.mean() for mask in masks]))


def draw_overview(
    path: Path,
    run: FieldRun,
    v: int,
    mask: Bool[np.ndarray, "h w"],
    found: "Selection",
    color: Any,
    move: Any,
) -> None:
    """Writes a picture of one camera: what was found in the photograph, how all Gaussians scored, and the
    scene with and without it."""
    assert run.views is not None
    photographs, gaussians = run.views.photographs, run.gaussians
    camera, there = photographs.camera(v), jnp.asarray(found.selected)
    view, plan = frozen_views(gaussians, [camera], run.rasterize_mode)[0]
    scores = np.nan_to_num(found.scores)
    low, high = np.percentile(scores, 1), max(scores.max(), np.percentile(scores, 1) + 1e-6)
    shares = np.clip((scores - low) / (high - low), 0, 1)
    drawn, _ = paint(view, jnp.asarray(shares[:, None], jnp.float32), plan)

    def rendered(scene: Gaussians) -> np.ndarray:
        if not scene.num:
            return np.zeros((camera.height, camera.width, 3), np.uint8)
        one = Camera(camera.viewmat[None], camera.K[None], camera.width, camera.height, camera.near)
        image = render_with_room(scene, one, None, rasterize_mode=run.rasterize_mode)[0].colors[0]
        return to_uint8(np.clip(np.asarray(image), 0, 1))

    panels = {
        "found": highlight(photographs.image(v), mask, _MARK),
        "scores": heat(np.asarray(drawn[..., 0])),
        "the object alone": rendered(without(gaussians, ~there)),
        "without it": rendered(without(gaussians, there)),
        "recoloured": rendered(tinted(gaussians, there, jnp.asarray(color))),
    }
    if move is not None:
        panels["moved"] = rendered(shifted(gaussians, there, jnp.asarray(move)))
    write_png(path, in_rows(panels, 3, _PANEL_HEIGHT))
