"""The timed programs: forward, its stages, forward+backward, and the JVP of a pose, on changing inputs."""

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from benchmarks.timing import perturbed_means, perturbed_viewmat, pose_tangent
from benchmarks.workloads import Scene
from gsjax.rasterize.binning import bin_gaussians
from gsjax.rasterize.plan import Plan
from gsjax.rasterize.projection import project_gaussians
from gsjax.rasterize.rasterization import rasterization

PERTURBATION = 1e-4
POOL = 6  # inputs, one for each tangent of a pose
TRAINED = ("means", "quats", "scales", "opacities", "colors", "features")
FORWARD, BACKWARD, JVP = "forward", "forward+backward", "jvp"
PROJECTING, BINNING = "projection", "projection+binning"


def make_pool(scene: Scene, size: int = POOL, relative: float = PERTURBATION) -> list[dict[str, Any]]:
    """Inputs of `size` calls, each with slightly perturbed means and camera, and a tangent of the pose.

    Args:
        scene: the scene to perturb.
        size: number of inputs; calls cycle through them.
        relative: standard deviation of the perturbation, relative.
    """
    rng = np.random.default_rng(0)
    means, viewmat = np.asarray(scene.means), np.asarray(scene.viewmat)
    shared = {name: getattr(scene, name) for name in TRAINED[1:]}
    pool = []
    for i in range(size):
        moved = perturbed_viewmat(viewmat, rng, relative)
        own = {
            "means": perturbed_means(means, rng, relative),
            "viewmats": moved[None],
            "tangents": pose_tangent(moved, i % 6)[None],
        }
        pool.append({**shared, **{name: jnp.asarray(a) for name, a in own.items()}})
    return jax.block_until_ready(pool)


def make_programs(scene: Scene, plans: dict[str, Plan]) -> dict[str, Callable]:
    """`program(inputs, reads) -> (result, (reads, pairs, overflow))`, by name."""

    def draw(inputs, reads, derivative="reverse"):
        plan = plans[derivative]
        arrays = [inputs[name] for name in TRAINED[:5]]
        colors, alphas, meta = rasterization(
            *arrays,
            inputs["viewmats"],
            scene.K[None],
            plan.width,
            plan.height,
            plan=plan,
            features=inputs["features"],
            reads=reads,
        )
        images = (colors, alphas) if meta.features is None else (colors, alphas, meta.features)
        return images, (meta.reads, meta.pairs, meta.overflow)

    def loss(trained, inputs, reads):
        (colors, alphas, *features), info = draw({**inputs, **trained}, reads)
        return jnp.sum(colors**2) + jnp.sum(alphas) + sum(jnp.sum(f**2) for f in features), info

    def backward(inputs, reads):
        trained = {name: inputs[name] for name in TRAINED if inputs[name] is not None}
        (value, info), gradients = jax.value_and_grad(loss, has_aux=True)(trained, inputs, reads)
        return (value, gradients), info

    def push(inputs, reads):
        def image(viewmats):
            return draw({**inputs, "viewmats": viewmats}, reads, "forward")

        images, tangents, info = jax.jvp(image, (inputs["viewmats"],), (inputs["tangents"],), has_aux=True)
        return (images, tangents), info

    return {FORWARD: draw, BACKWARD: backward, JVP: push}


def make_stages(scene: Scene, plan: Plan) -> dict[str, Callable]:
    """The first stages of a forward call by themselves, as programs like those of `make_programs`."""

    def project(inputs):
        usable = jnp.ones(len(scene.means), bool)
        arrays = [inputs[name] for name in TRAINED[:4]]
        return project_gaussians(*arrays, usable, inputs["viewmats"][0], scene.K, plan)

    def projected(inputs, reads):
        found = project(inputs)
        return found, (reads, jnp.zeros(1, int), jnp.zeros(1, bool))

    def binned(inputs, reads):
        found = bin_gaussians(project(inputs), None, plan)
        return found, (reads, found.pairs, found.overflow)

    return {PROJECTING: projected, BINNING: binned}
