"""How well views of a fitted scene are seen: each is drawn, and compared with its photograph."""

from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import jax.numpy as jnp
import numpy as np

from gsjax.engine.folder import RunFolder
from gsjax.engine.pictures import PANELS
from gsjax.engine.scores import mean_scores
from gsjax.geometry.cameras import on_device
from gsjax.io.pictures import write_png
from gsjax.methods.fit import FitConfig
from gsjax.metrics.image import depth_error, psnr, ssim, with_matched_colors
from gsjax.rasterize.plan import Plan
from gsjax.scene.frame import Frame
from gsjax.scene.gaussians import Gaussians
from gsjax.scene.render import render_with_room
from gsjax.viz.colors import side_by_side

_LEAST_SIDE = 11  # of SSIM's window
_PANEL_HEIGHT = 240  # pixels, at least, so that captions hide little


@dataclass(frozen=True)
class Scores:
    """How views are seen, one row each."""

    rows: list[dict[str, Any]]

    def mean(self) -> dict[str, float | None]:
        """Over the views that have a number."""
        return mean_scores(self.rows, ("psnr", "ssim", "depth_mm", "psnr_matched"))


@dataclass(eq=False)
class Judge:
    """Draws photographs' views and compares. What one judge draws is drawn by the same programs.

    Attributes:
        config: of the fit.
        background: RGB behind the scene; black where None.
        plans: by the size of the photograph: what held a view.
    """

    config: FitConfig
    background: tuple[float, float, float] | None
    plans: dict[tuple[int, ...], Plan] = field(default_factory=dict)

    def __call__(
        self, gaussians: Gaussians, frames: Sequence[tuple[str, Frame]], folder: RunFolder | None = None
    ) -> Scores:
        """Scores of views, by their names; with a folder, pictures are written side by side there."""
        rows = []
        for name, frame in frames:
            seen = self.compare(gaussians, frame)
            row: dict[str, Any] = {"view": name, "psnr": seen.psnr(), "ssim": None, "depth_mm": None}
            if folder is not None:
                row |= {"ssim": seen.ssim(), "depth_mm": seen.depth_mm()}
                if self.config.exposure:  # which that of a photograph never fitted cannot be known
                    row["psnr_matched"] = seen.psnr_matched()
                path = folder.render("held_out", len(rows))
                write_panel(path, seen)
                row["picture"] = str(path.relative_to(folder.path))
            rows.append(row)
        return Scores(rows)

    def compare(self, gaussians: Gaussians, frame: Frame) -> "Compared":
        """A view as it is drawn beside its photograph.

        Args:
            gaussians: the scene.
            frame: of one camera, on the host.
        """
        size = frame.images.shape
        mode = "antialiased" if self.config.antialiased else "classic"
        behind = jnp.array([self.background or (0.0, 0.0, 0.0)])
        drawn, self.plans[size] = render_with_room(
            gaussians,
            on_device(frame.cameras),
            self.plans.get(size),
            backgrounds=behind,
            rasterize_mode=mode,
        )
        image, truth = np.clip(np.asarray(drawn.colors[0]), 0, 1), frame.images[0] / 255
        if frame.masks is not None:
            image = np.where(frame.masks[0][..., None], image, truth)
        depth, covered = np.asarray(drawn.depths[0]), np.asarray(drawn.alphas[0]) > 0.5
        return Compared(frame, image, truth, depth, covered)


@dataclass(frozen=True, eq=False)
class Compared:
    """A view as it is drawn, and as it was photographed.

    Attributes:
        frame: the photograph, its mask and its depth.
        image: drawn, [H,W,3], 0 to 1; where the photograph does not count, it stands here too.
        truth: the photograph, 0 to 1.
        depth: drawn, [H,W], metres; 0 where nothing is drawn.
        covered: where more than half of the light comes from Gaussians, [H,W].
    """

    frame: Frame
    image: np.ndarray
    truth: np.ndarray
    depth: np.ndarray
    covered: np.ndarray

    @property
    def mask(self) -> np.ndarray | None:
        """The pixels that count, [H,W]; None if all do."""
        return None if self.frame.masks is None else self.frame.masks[0]

    def psnr(self) -> float:
        """Where the photograph counts, dB."""
        return psnr(self.image, self.truth, self.mask)

    def psnr_matched(self) -> float:
        """The same, exposure and white balance apart."""
        return psnr(with_matched_colors(self.image, self.truth, self.mask), self.truth, self.mask)

    def ssim(self) -> float | None:
        """Where the photograph counts; None where it is smaller than the window."""
        if min(self.covered.shape) < _LEAST_SIDE:
            return None
        return ssim(self.image, self.truth, self.mask)

    def depth_mm(self) -> float | None:
        """How far depth is off, where something is drawn; None where none was measured."""
        if self.frame.depths is None:
            return None
        counted = self.covered if self.mask is None else self.covered & self.mask
        return depth_error(self.depth, self.frame.depths[0], counted).mean_abs_mm


def write_panel(path: Path, seen: Compared) -> None:
    """Writes the photograph, what is drawn, and how they differ, side by side; small ones enlarged."""
    times = -(-_PANEL_HEIGHT // len(seen.image))
    pair = [picture.repeat(times, 0).repeat(times, 1) for picture in (seen.truth, seen.image)]
    write_png(path, side_by_side(*pair, captions=PANELS))
