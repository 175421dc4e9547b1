"""Does a deformation field find where each point of a shirt goes between two pictures with depth?"""

from dataclasses import dataclass, replace
from itertools import islice
from pathlib import Path
from time import perf_counter
from typing import Any

import cv2
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool, Float, UInt8

from experiments.shared.deforming import Reconstructed, drawn, one_frame
from experiments.shared.recordings import recorded
from experiments.shared.timing import run_through
from gsjax.data.resizing import area_resized, nearest_resized
from gsjax.engine.drive import drive
from gsjax.methods.deform import Deform, DeformConfig
from gsjax.metrics.image import psnr
from gsjax.metrics.tracking import carried_points
from gsjax.perception.optical_flow import DisFlow
from gsjax.scene.frame import Frame

SCALE = 0.25  # of the pictures that are learned from
CONFIG = DeformConfig(warmup=150, iterations=650, start_pixels=1.8, nodes=512)
COARSE = ((1 / 16, 200), (1 / 8, 200), (1 / 4, 100))  # scales and steps before the rest at SCALE
SMALL = 0.25  # of the pictures that DIS is given, which follows about a tenth of the width
WITHIN_MM = 50.0


@dataclass(frozen=True, eq=False)
class Pair:
    """Two RGB-D pictures of one camera, and the true scene flow of what moves.

    Attributes:
        images: RGB.
        depths: metres, 0 where unknown.
        K: pixel centres at +0.5.
        flow: metres, from the first to the second in the camera's frame, where `known`.
        known: which pixels of the first picture lie on the shirt and have a true flow and depth.
    """

    images: tuple[UInt8[np.ndarray, "h w 3"], UInt8[np.ndarray, "h w 3"]]
    depths: tuple[Float[np.ndarray, "h w"], Float[np.ndarray, "h w"]]
    K: Float[np.ndarray, "3 3"]
    flow: Float[np.ndarray, "h w 3"]
    known: Bool[np.ndarray, "h w"]

    @property
    def start(self) -> Float[np.ndarray, "n 3"]:
        """Points of the known pixels in the first picture."""
        return lifted(self.depths[0], self.K)[self.known]

    def frame(self, t: int, scale: float) -> Frame:
        """One picture, scaled down."""
        height, width = (round(side * scale) for side in self.depths[0].shape)

        def size(*_: int) -> tuple[int, int]:
            return width, height

        K = self.K * np.array([[width / self.depths[0].shape[1]], [height / self.depths[0].shape[0]], [1]])
        image = area_resized(lambda t: self.images[t], size)(t)
        return one_frame(image, np.eye(4), K, float(t), nearest_resized(lambda t: self.depths[t], size)(t))


def pair(name: str = "deepdeform") -> Pair:
    """The pair in the format of NeuralTracking's example data: depth in uint16 millimetres, and flow as three
    int32 (width, height, channels) before float32 planes."""
    (root,) = sorted((recorded(name) / "train").iterdir())
    images = tuple(cv2.imread(str(p))[..., ::-1] for p in sorted((root / "color").iterdir()))
    depths = tuple(
        cv2.imread(str(p), cv2.IMREAD_UNCHANGED).astype(np.float32) / 1000
        for p in sorted((root / "depth").iterdir())
    )
    K = np.loadtxt(root / "intrinsics.txt")[:3, :3]
    K[:2, 2] += 0.5
    (path,) = (root / "scene_flow").iterdir()
    width, height, channels = np.fromfile(path, np.int32, 3)
    flow = np.fromfile(path, np.float32, offset=12).reshape(channels, height, width).transpose(1, 2, 0)
    (path,) = (root / "mask").iterdir()
    shirt = cv2.imread(str(path), cv2.IMREAD_UNCHANGED) > 0
    return Pair(images, depths, K, flow, np.isfinite(flow).all(-1) & shirt & (depths[0] > 0))


def lifted(depth: Float[np.ndarray, "h w"], K: Float[np.ndarray, "3 3"]) -> Float[np.ndarray, "h w 3"]:
    """Points in the camera's frame."""
    columns, rows = np.meshgrid(np.arange(depth.shape[1]) + 0.5, np.arange(depth.shape[0]) + 0.5)
    return np.stack([columns, rows, np.ones_like(rows)], axis=-1) @ np.linalg.inv(K).T * depth[..., None]


def run(options: dict[str, Any], seed: int, folder: Path) -> dict[str, Any]:
    """The scene flow of the shirt's pixels, against the true one."""
    data, variant, begun = pair(), options["variant"], perf_counter()
    found: dict[str, Any] = {}
    if variant == "nothing moves":
        moved = np.zeros_like(data.start)
    elif variant.startswith("DIS"):
        moved = by_optical_flow(data, SMALL if "small" in variant else 1.0)
    else:
        learned = by_field(data, seed, COARSE if "small" in variant else ())
        moved = carried(learned, data)
        second = data.frame(1, SCALE)
        found["psnr_second"] = psnr(drawn(learned, second)[0], second.images[0] / 255.0)
        found["gaussians"] = learned.run.params.gaussians.num
    minutes = (perf_counter() - begun) / 60
    off = 1e3 * np.linalg.norm(moved - data.flow[data.known], axis=1)
    return found | {
        "median_mm": float(np.median(off)),
        "p95_mm": float(np.quantile(off, 0.95)),
        "mean_mm": float(off.mean()),
        "within_50": float((off < WITHIN_MM).mean()),
        "pixels": int(data.known.sum()),
        "minutes": minutes,
        "quantiles_mm": np.quantile(off, np.linspace(0, 1, 51)).tolist(),
    }


def by_optical_flow(data: Pair, scale: float) -> Float[np.ndarray, "n 3"]:
    """Pixels moved by dense optical flow, at the second picture's depth there, or at their own depth where
    that is unknown or outside."""
    height, width = data.known.shape
    size = (round(width * scale), round(height * scale))
    images = (cv2.resize(image, size, interpolation=cv2.INTER_AREA) for image in data.images)
    flow = cv2.resize(DisFlow()(*images), (width, height)) / scale
    rows, columns = np.nonzero(data.known)
    x, y = (np.stack([columns, rows], axis=1) + 0.5 + flow[data.known]).T
    inside = (x >= 0) & (x < width) & (y >= 0) & (y < height)
    there = data.depths[1][np.where(inside, y, 0).astype(int), np.where(inside, x, 0).astype(int)]
    z = np.where(inside & (there > 0), there, data.depths[0][data.known])
    rays = np.stack([x, y, np.ones_like(x)], axis=1) @ np.linalg.inv(data.K).T
    return rays * z[:, None] - data.start


def by_field(data: Pair, seed: int, coarse: tuple[tuple[float, int], ...]) -> Reconstructed:
    """A scene fitted to the first picture, then to both; optionally to smaller pictures of both in
    between."""
    config = replace(CONFIG, seed=seed)
    method, total = Deform(config), config.warmup + config.iterations
    problem, run = method.start([data.frame(t, SCALE) for t in (0, 1)])
    parts = [(problem, run.plans, config.warmup)]
    for scale, steps in coarse:
        smaller, other = method.start([data.frame(t, scale) for t in (0, 1)])
        smaller = smaller._replace(radius=problem.radius, bounds=problem.bounds)
        parts.append((smaller, other.plans, parts[-1][2] + steps))
    times = []
    for part, plans, last in [*parts, (problem, run.plans, total)]:
        ticks = drive(method, part, run.having(plans=plans))
        times.append(run_through(islice(ticks, last - run.step)))
        run = ticks.run
    return Reconstructed(config, problem, run, *np.sum(times, axis=0).tolist())


def carried(found: Reconstructed, data: Pair) -> Float[np.ndarray, "n 3"]:
    """Displacement of the Gaussians around each pixel's point between the two times."""
    at = jax.jit(lambda scene, moving, time: scene.at(time, moving).means)
    means = [np.asarray(at(found.run.params, found.run.kept.moving, jnp.asarray(t))) for t in (0.0, 1.0)]
    return carried_points(data.start, np.stack(means))[1] - data.start


def figure(rows: list[dict[str, Any]], path: Path) -> None:
    """Cumulative distribution of the errors over pixels."""
    from matplotlib.figure import Figure

    from experiments.shared.plots import BLUE, GREEN, GREY, ORANGE, PURPLE, SKY

    drawing = Figure(figsize=(6.4, 4), dpi=100, layout="constrained")
    axes = drawing.subplots()
    for row, color in zip(rows, (GREY, GREEN, PURPLE, ORANGE, SKY, BLUE), strict=False):
        shares = np.linspace(0, 1, len(row["quantiles_mm"]))
        axes.plot(np.maximum(row["quantiles_mm"], 1), shares, color=color, label=row["variant"])
    axes.set(xscale="log", xlim=(1, 1000), ylim=(0, 1), xlabel="scene flow is off by less than [mm]")
    axes.set_ylabel("share of the shirt's pixels")
    axes.grid(alpha=0.3)
    axes.legend(fontsize=8)
    drawing.savefig(path, format="png")
