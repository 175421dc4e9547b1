"""Is a scene of known Gaussians recovered from its photographs?"""

from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from experiments.shared.recordings import recorded
from gsjax.engine.drive import drive
from gsjax.geometry.cameras import Camera, intrinsics, look_at
from gsjax.methods.fit import Fit, FitConfig, GrowthConfig
from gsjax.metrics.image import psnr, ssim
from gsjax.scene.frame import Frame
from gsjax.scene.gaussians import Gaussians, gaussians_from_activated
from gsjax.scene.initialize import spacing_scales
from gsjax.scene.render import plan_render, render

WIDTH, HEIGHT = 324, 210
SEEN, UNSEEN = 24, 8
HALF_SIZE = 0.5  # of the cube of the garden that is used, in its own units
JUDGED_EVERY = 500


def garden(count: int, seed: int) -> Gaussians:
    """Gaussians at points of the garden with their colours, stretched and rotated at random."""
    stored, random = np.load(recorded("garden_points") / "test_garden.npz"), np.random.default_rng(seed)
    inside = np.flatnonzero((np.abs(stored["means3d"]) <= HALF_SIZE).all(1))
    chosen = random.choice(inside, count, replace=False)
    points, colors = stored["means3d"][chosen].astype(np.float64), stored["colors"][chosen] / 255
    scales = spacing_scales(points)[:, None] * random.uniform(0.3, 1.2, (count, 3))
    quats, opacities = random.normal(size=(count, 4)), random.uniform(0.5, 0.95, count)
    return gaussians_from_activated(points, quats, scales, opacities, colors)


def cameras() -> list[Float[np.ndarray, "4 4"]]:
    """Poses all around the scene, at alternating heights; every fourth is held out."""
    angles = np.arange(SEEN + UNSEEN) * 2 * np.pi / (SEEN + UNSEEN)
    heights = np.where(np.arange(len(angles)) % 2, 0.55, 0.9)
    eyes = np.stack([1.3 * np.cos(angles), 1.3 * np.sin(angles), heights], axis=-1)
    return [look_at(eye, np.array([0.0, 0.0, 0.1])) for eye in eyes]


def picture(scene: Gaussians, viewmat: np.ndarray, K: np.ndarray) -> np.ndarray:
    """RGB, 0 to 1."""
    camera = Camera(*(jnp.asarray(a, jnp.float32)[None] for a in (viewmat, K)), WIDTH, HEIGHT)
    return np.clip(np.asarray(render(scene, camera, plan_render(scene, camera)).colors[0]), 0, 1)


def run(options: dict[str, Any], seed: int, folder: Path) -> dict[str, Any]:
    """PSNR of held-out views of a fit to photographs of the known scene, rounded to 8 bits; it starts from
    points that are off by a third of their spacing."""
    truth, viewmats = garden(options["count"], seed), cameras()
    K = intrinsics(0.75 * WIDTH, WIDTH, HEIGHT)
    photographs = [np.round(255 * picture(truth, v, K)).astype(np.uint8) for v in viewmats]
    apart = np.arange(len(viewmats)) % 4 == 3
    frames = [
        Frame(image[None], None, Camera(viewmat[None], K[None], WIDTH, HEIGHT))
        for image, viewmat, away in zip(photographs, viewmats, apart, strict=True)
        if not away
    ]
    means = np.asarray(truth.means, np.float64)
    random = np.random.default_rng(seed + 1)
    off = means + random.normal(size=means.shape) * spacing_scales(means)[:, None] / 3
    colors = np.clip(0.5 + 0.2820948 * np.asarray(truth.sh0[:, 0]), 0, 1)
    config = FitConfig(steps=options["steps"], cap=round(1.2 * options["count"]), sh_degree=0, seed=seed)
    if options["growth"] == "none":  # the number is known: no relocation, no noise, no costs
        still = GrowthConfig(begin=config.steps, noise=0.0, opacity_cost=0.0, scale_cost=0.0)
        config = replace(config, growth=still, cap=options["count"])
    method = Fit(config)
    problem, run = method.start(frames, (off, colors))
    unseen = [
        (viewmat, image) for viewmat, image, away in zip(viewmats, photographs, apart, strict=True) if away
    ]
    curve, seconds = [], 0.0
    for now in drive(method, problem, run):
        seconds += now.seconds + now.compile_seconds
        if now.step % JUDGED_EVERY == 0 or now.step == config.steps:
            found = now.result
            drawn = [picture(found, viewmat, K) for viewmat, _ in unseen]
            scores = [psnr(image, truth / 255) for image, (_, truth) in zip(drawn, unseen, strict=True)]
            curve.append((seconds / 60, float(np.mean(scores))))
    both = np.concatenate([unseen[0][1], np.round(255 * drawn[0]).astype(np.uint8)], axis=1)
    cv2.imwrite(str(folder / "unseen.png"), both[..., ::-1])
    return {
        "psnr": np.mean(scores),
        "worst_psnr": min(scores),
        "ssim": np.mean([ssim(image, truth / 255) for image, (_, truth) in zip(drawn, unseen, strict=True)]),
        "gaussians": found.num,
        "minutes": seconds / 60,
        "curve": curve,
    }


def figure(rows: list[dict[str, Any]], path: Path) -> None:
    """PSNR of unseen views over minutes."""
    from matplotlib.figure import Figure

    drawing = Figure(figsize=(7, 4), layout="constrained")
    axes = drawing.subplots()
    for row in rows:
        minutes, scores = zip(*row["curve"], strict=True)
        axes.plot(minutes, scores, marker=".", label=f"{row['count']:,} Gaussians, growth: {row['growth']}")
    axes.axhline(40, color="0.6", lw=1, ls=":")
    axes.set_xlabel("minutes")
    axes.set_ylabel("PSNR of unseen views [dB]")
    axes.grid(color="0.9")
    axes.legend(frameon=False)
    drawing.savefig(path, dpi=120)
