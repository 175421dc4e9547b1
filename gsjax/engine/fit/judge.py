"""Scores of the views of a fitted scene: each is rendered and compared with its photograph."""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from time import perf_counter
from typing import Any

import jax.numpy as jnp
import numpy as np

from gsjax.engine.folder import RunFolder
from gsjax.engine.pictures import PANELS
from gsjax.engine.scores import mean_scores
from gsjax.geometry.cameras import Camera, on_device
from gsjax.io.pictures import write_png
from gsjax.methods.fit import FitConfig
from gsjax.metrics.image import depth_error, psnr, ssim, with_matched_colors
from gsjax.rasterize.plan import Plan
from gsjax.scene.frame import Frame
from gsjax.scene.gaussians import Gaussians
from gsjax.scene.render import Rendered, render_with_room
from gsjax.viz.colors import enlarged, side_by_side

_LEAST_SIDE = 11  # of SSIM's window
_PANEL_HEIGHT = 240  # pixels, at least, so that captions cover little


@dataclass(frozen=True)
class Scores:
    """Scores of views, a row each."""

    rows: list[dict[str, Any]]

    def mean(self) -> dict[str, float | None]:
        """The mean of each score, over the views that have it."""
        return mean_scores(self.rows, ("psnr", "ssim", "depth_mm", "psnr_matched"))


@dataclass(eq=False)
class Judge:
    """Renders the views of photographs and compares the two; views of one size share a compiled program.

    Attributes:
        config: the settings of the fit.
        background: RGB behind the scene; None is black.
        sizes: common sizes of photographs; a smaller photograph is rendered at one of these, whose program
            is already compiled.
        plans: a large enough plan for each size of photograph.
        view_s: seconds that the last view took; infinite until one needed no compiling.
    """

    config: FitConfig
    background: tuple[float, float, float] | None
    sizes: Sequence[tuple[int, int]] = ()
    plans: dict[tuple[int, int], Plan] = field(default_factory=dict)
    view_s: float = field(default=float("inf"), init=False)

    def __call__(
        self, gaussians: Gaussians, frames: Iterable[tuple[str, Frame]], folder: RunFolder | None = None
    ) -> Scores:
        """Score named views; with a folder, also write side-by-side pictures of them there."""
        rows = []
        for name, frame in frames:
            begun, is_known = perf_counter(), self._size(frame.cameras) in self.plans
            seen = self.compare(gaussians, frame)
            row: dict[str, Any] = {"view": name, "psnr": seen.psnr(), "ssim": None, "depth_mm": None}
            if folder is not None:
                row |= {"ssim": seen.ssim(), "depth_mm": seen.depth_mm()}
                if self.config.exposure:  # unknown for a held-out photograph
                    row["psnr_matched"] = seen.psnr_matched()
                path = folder.render("held_out", len(rows))
                write_panel(path, seen)
                row["picture"] = str(path.relative_to(folder.path))
            if is_known:
                self.view_s = perf_counter() - begun
            rows.append(row)
        return Scores(rows)

    def draw(self, gaussians: Gaussians, camera: Camera, plan: Plan | None) -> tuple[Rendered, Plan]:
        """The scene as one camera [1] sees it, rendered as in the fit, and a plan that is large enough.

        Args:
            gaussians: the scene.
            camera: on the host.
            plan: that of an earlier call, or None.
        """
        return render_with_room(
            gaussians,
            on_device(camera),
            plan,
            backgrounds=jnp.array([self.background or (0.0, 0.0, 0.0)]),
            rasterize_mode="antialiased" if self.config.antialiased else "classic",
        )

    def compare(self, gaussians: Gaussians, frame: Frame) -> "Compared":
        """The Gaussians rendered from the camera of `frame`, with its photograph. The frame is on the host
        and has one camera."""
        camera, size = frame.cameras, self._size(frame.cameras)
        at = replace(camera, width=size[0], height=size[1])
        drawn, self.plans[size] = self.draw(gaussians, at, self.plans.get(size))
        colors, depths, alphas = (
            np.asarray(a)[0, : camera.height, : camera.width]
            for a in (drawn.colors, drawn.depths, drawn.alphas)
        )
        image, truth = np.clip(colors, 0, 1), frame.images[0] / 255
        if frame.masks is not None:
            image = np.where(frame.masks[0][..., None], image, truth)
        return Compared(frame, image, truth, depths, alphas > 0.5)

    def _size(self, camera: Camera) -> tuple[int, int]:
        """Width and height at which a camera's view is rendered."""
        width, height = camera.width, camera.height
        larger = [size for size in self.sizes if size[0] >= width and size[1] >= height]
        return min(larger, key=lambda size: size[0] * size[1], default=(width, height))


@dataclass(frozen=True, eq=False)
class Compared:
    """A rendered view and its photograph.

    Attributes:
        frame: the photograph, its mask and its depth.
        image: the render, [H,W,3], 0 to 1; the photograph where its mask excludes pixels.
        truth: the photograph, 0 to 1.
        depth: rendered, [H,W], metres; 0 where nothing is drawn.
        covered: where alpha is above one half, [H,W].
    """

    frame: Frame
    image: np.ndarray
    truth: np.ndarray
    depth: np.ndarray
    covered: np.ndarray

    @property
    def mask(self) -> np.ndarray | None:
        """The pixels that count, [H,W]; None for all."""
        return None if self.frame.masks is None else np.asarray(self.frame.masks[0])

    def psnr(self) -> float:
        """PSNR over the pixels that count, dB."""
        return psnr(self.image, self.truth, self.mask)

    def psnr_matched(self) -> float:
        """PSNR after matching exposure and white balance, dB."""
        return psnr(with_matched_colors(self.image, self.truth, self.mask), self.truth, self.mask)

    def ssim(self) -> float | None:
        """SSIM over the pixels that count; None if the picture is smaller than the window."""
        if min(self.covered.shape) < _LEAST_SIDE:
            return None
        return ssim(self.image, self.truth, self.mask)

    def depth_mm(self) -> float | None:
        """Mean absolute depth error where something is drawn, millimetres; None without measured depth."""
        if self.frame.depths is None:
            return None
        counted = self.covered if self.mask is None else self.covered & self.mask
        return depth_error(self.depth, self.frame.depths[0], counted).mean_abs_mm


def write_panel(path: Path, seen: Compared) -> None:
    """Write the photograph, the render, and their difference, side by side; small ones are enlarged."""
    pair = [enlarged(picture, _PANEL_HEIGHT) for picture in (seen.truth, seen.image)]
    write_png(path, side_by_side(*pair, captions=PANELS))
