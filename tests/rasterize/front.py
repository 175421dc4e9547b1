"""A few Gaussians in front of a camera, drawn by the rasterizer and the float64 reference, with gradients."""

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np

from benchmarks.scenes import ARRAYS, relative_error
from gsjax.rasterize.plan import Plan, rung
from gsjax.rasterize.rasterization import rasterization
from gsjax.rasterize.reference import rasterization_reference

GAUSSIANS = ARRAYS[:5]
FAINT = 1e-17
TRAINED = (*GAUSSIANS, "viewmats", "Ks", "backgrounds")


@partial(jax.jit, static_argnames="plan")
def drawn(scene, weights, plan):
    """Returns the image with expected depth and alpha, the gradient for cotangent `weights`, and meta."""

    def objective(scene):
        image, alphas, meta = rasterization(**scene, width=plan.width, height=plan.height, plan=plan)
        image = jnp.concatenate([image, alphas], axis=-1)[0]
        return jnp.vdot(image, weights[..., : image.shape[-1]]), (image, meta)

    gradient, (image, meta) = jax.grad(objective, has_aux=True)(scene)
    return image, gradient, meta


@partial(jax.jit, static_argnames="plan")
def reference(scene, weights, plan):
    """The same from the float64 reference, with a mask of pixels that depend on rounding instead of meta."""

    def objective(scene):
        result = rasterization_reference(
            *(scene[name] for name in GAUSSIANS),
            scene["viewmats"][0],
            scene["Ks"][0],
            plan.width,
            plan.height,
            background=scene["backgrounds"][0],
            render_mode=plan.render_mode,
        )
        image = jnp.concatenate([result.colors, result.alphas], axis=-1)
        return jnp.vdot(image, weights), (image, result.doubtful)

    gradient, (image, doubtful) = jax.grad(objective, has_aux=True)(scene)
    return image, gradient, doubtful


def scene_before(width=33, height=17, num=12, focal=30.0, depth=2.0, seed=0):
    """A camera at the origin looking along z, and Gaussians a few pixels wide in front of it; float32."""
    rng = np.random.default_rng(seed)
    depths = depth * (1 + 0.5 * (rng.permutation(num) + 0.5) / num)
    pixels = rng.uniform([0, 0], [width, height], (num, 2)) - [width / 2, height / 2]
    scene = {
        "means": np.concatenate([pixels * depths[:, None] / focal, depths[:, None]], axis=1),
        "quats": rng.normal(size=(num, 4)),
        "scales": rng.uniform(0.5, 3.0, (num, 3)) * depth / focal,
        "opacities": rng.uniform(0.2, 0.9, num),
        "colors": rng.uniform(size=(num, 3)),
        "viewmats": np.eye(4)[None],
        "Ks": np.array([[[focal, 0, width / 2], [0, focal, height / 2], [0, 0, 1]]]),
        "backgrounds": np.full((1, 3), 0.3),
    }
    return {k: np.float32(v) for k, v in scene.items()}


def plan_for(width=33, height=17, num=12):
    return Plan(width, height, rung(num * ((width + 7) // 8) * ((height + 7) // 8) * 2), render_mode="RGB+ED")


def cotangent(width=33, height=17):
    return np.float32(np.random.default_rng(1).normal(size=(height, width, 5)))


def gradient_error(gradient, slope, names=TRAINED):
    # Where the true gradient is 1e-20 (the rotation of a point), no digit in float32 is meaningful.
    meaningful = [
        k for k in names if np.abs(slope[k]).max() > FAINT or not np.abs(gradient[k]).max() <= FAINT
    ]
    return max(relative_error(gradient[k], slope[k]) for k in meaningful)
