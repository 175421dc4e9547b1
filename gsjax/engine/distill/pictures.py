"""Pictures of the result of a query: masks, and the photograph, a heat map of the scores, and the scene
without what was found, it alone, recoloured, moved.

All are drawn by one program for each size of picture, with one colour a Gaussian, for compiling takes longer
than drawing. What is not to be seen is hidden, not left out, so the number of Gaussians is the same.
"""

from collections.abc import Sequence
from pathlib import Path

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float
from rich.console import Console
from rich.progress import track

from gsjax.engine.distill.saved import FieldRun, short_names
from gsjax.engine.messages import Notes, describe
from gsjax.engine.query import Changes, Selection, write_mask
from gsjax.geometry.cameras import Camera, camera_centers
from gsjax.geometry.spherical_harmonics import evaluate_sh
from gsjax.io.pictures import write_png
from gsjax.optim.compiler import host_options
from gsjax.scene.gaussians import Gaussians
from gsjax.scene.selection import hidden
from gsjax.viz.colors import enlarged, heat, highlight, in_rows, to_uint8, with_heat_scale
from gsjax.viz.viewer.drawing import Drawer, recolored

_MARK = (255, 70, 160)
_PANEL_HEIGHT = 240  # pixels, at least
_MOST = 0.5  # share of a pixel's light above which it shows the object
_WORDS = {"recolored": "recoloured", "moved": "moved"}


def draw(
    folder: Path,
    run: FieldRun,
    which: Sequence[int],
    found: Selection,
    changes: Changes,
    notes: Notes,
    console: Console,
) -> dict[str, int]:
    """Writes masks/CAMERA.png for each camera, and overview.png of the one that shows most.

    Args:
        folder: for the pictures.
        run: the field and its scene.
        which: indices of its photographs.
        found: the result of the query; a pixel shows the selected Gaussians if more than half of its light is
            theirs.
        changes: changes to them.
        notes: receives warnings of photographs that cannot be read.
        console: shows the progress.

    Returns:
        Number of pixels in each mask.
    """
    photographs, selected, scores = run.photographs, found.selected, found.scores
    drawer = Drawer(antialiased=run.rasterize_mode == "antialiased", compiler_options=host_options())
    assert photographs is not None
    names, pixels = short_names(photographs.names), {}
    low, high = _ends(scores)
    shares = np.clip((np.nan_to_num(scores) - low) / max(high - low, 1e-6), 0, 1)
    painted = np.stack([selected, shares, np.zeros(len(scores))], axis=1).astype(np.float32)
    values = _painted(run.gaussians, painted)
    best: tuple[float, int, np.ndarray] | None = None
    for v in track(which, "drawing", console=console, transient=True):
        drawn = drawer(values, _one(photographs.camera(v))).colors
        mask = drawn[..., 0] > _MOST
        pixels[names[v]] = write_mask(folder, names[v], mask)
        if best is None or mask.mean() > best[0]:
            best = (float(mask.mean()), v, drawn)
    assert best is not None
    _, v, drawn = best
    camera, there = _one(photographs.camera(v)), jnp.asarray(selected)
    shown = {"the object alone": hidden(run.gaussians, ~there)}
    if not selected.all():
        shown["without it"] = hidden(run.gaussians, there)
    shown |= {_WORDS[name]: scene for name, scene in changes.of(run.gaussians, selected).items()}
    behind_is = "photograph"
    try:
        behind = photographs.image(v)
    except (ValueError, OSError) as error:
        notes.warn(f"overview.png shows a render in place of a photograph: {describe(error)}")
        behind_is, behind = "scene", to_uint8(drawer(_seen_from(run.gaussians, camera), camera).colors)
    threshold = found.threshold.value
    scale = enlarged(heat(drawn[..., 1]), _PANEL_HEIGHT)
    panels = {
        f"found in view {names[v]}": highlight(behind, drawn[..., 0] > _MOST, _MARK),
        f"scores; found above {threshold:.2f}": with_heat_scale(scale, low, high, threshold),
    }
    for words, scene in shown.items():
        panels[words] = to_uint8(drawer(_seen_from(scene, camera), camera).colors)
    if len(panels) % 2:  # two rows, and no place in them is empty
        panels = {behind_is: behind, **panels}
    write_png(folder / "overview.png", in_rows(panels, len(panels) // 2, _PANEL_HEIGHT))
    return pixels


def _one(camera: Camera) -> Camera:
    """A batch of one."""
    return Camera(camera.viewmat[None], camera.K[None], camera.width, camera.height, camera.near)


def _ends(scores: Float[np.ndarray, "n"]) -> tuple[float, float]:
    """The least and largest score, without a few outliers at the lower end."""
    scores = np.nan_to_num(scores)
    return float(np.percentile(scores, 1)), float(scores.max())


def _seen_from(gaussians: Gaussians, camera: Camera) -> Gaussians:
    """The scene with the colours that one camera sees, the same from all sides."""
    return _painted(gaussians, np.asarray(_colors(gaussians, camera)))


@jax.jit
def _colors(gaussians: Gaussians, camera: Camera) -> Float[Array, "n 3"]:
    toward = gaussians.means - camera_centers(camera.viewmat)[0]
    return jnp.maximum(evaluate_sh(gaussians.sh_degree, gaussians.sh, toward), 0)


def _painted(gaussians: Gaussians, colors: Float[np.ndarray, "n 3"]) -> Gaussians:
    """The scene with one colour a Gaussian and no features."""
    return eqx.tree_at(lambda g: g.features, recolored(gaussians, colors), None, is_leaf=lambda x: x is None)
