"""Thirty blobs on black, photographed by eight cameras around them."""

import jax.numpy as jnp
import numpy as np

from gsjax.geometry.cameras import Camera, intrinsics, look_at
from gsjax.scene.frame import Frame
from gsjax.scene.gaussians import gaussians_from_activated
from gsjax.scene.render import plan_render, render

WIDTH, HEIGHT = 40, 30


def cameras(count: int) -> Camera:
    angles = np.linspace(0, 2 * np.pi, count, endpoint=False)
    eyes = np.stack([3 * np.cos(angles), 3 * np.sin(angles), 1 + 0.5 * np.sin(3 * angles)], axis=-1)
    viewmats = jnp.asarray(np.stack([look_at(eye, np.zeros(3)) for eye in eyes]), jnp.float32)
    Ks = jnp.broadcast_to(jnp.asarray(intrinsics(40.0, WIDTH, HEIGHT), jnp.float32), (count, 3, 3))
    return Camera(viewmats, Ks, WIDTH, HEIGHT)


def photographed_blobs() -> list[Frame]:
    """Eight photographs with depth, each a frame of one camera, on the host."""
    random, count = np.random.default_rng(0), 30
    means, colors = random.uniform(-0.6, 0.6, (count, 3)), random.uniform(size=(count, 3))
    quats, scales = random.normal(size=(count, 4)), random.uniform(0.08, 0.25, (count, 3))
    scene = gaussians_from_activated(means, quats, scales, np.full(count, 0.9), colors)
    eight = cameras(8)
    drawn = render(scene, eight, plan_render(scene, eight))
    images = np.round(255 * np.clip(np.asarray(drawn.colors), 0, 1)).astype(np.uint8)
    depths = np.where(np.asarray(drawn.alphas) > 0.9, np.asarray(drawn.depths), 0)
    viewmats, Ks = np.asarray(eight.viewmat, np.float64), np.asarray(eight.K, np.float64)
    return [
        Frame(images[i : i + 1], depths[i : i + 1], Camera(viewmats[i : i + 1], Ks[i : i + 1], WIDTH, HEIGHT))
        for i in range(8)
    ]
