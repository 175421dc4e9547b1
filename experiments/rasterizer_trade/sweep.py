"""What each knob of the rasterizer buys: error of image and gradient against time, one knob at a time.

`simulated/` and `real/` share these scripts: both measure alike, and their tables stay apart. Every time is
also a ratio to the defaults' time in the same cell, whose calls alternate with the knob's, so that what else
the machine does falls on both.
"""

from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from functools import cache
from pathlib import Path
from time import perf_counter
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

import gsjax
from experiments.rasterizer_trade.knobs import Variant, middle, variant_of
from experiments.rasterizer_trade.pareto import SAME
from experiments.rasterizer_trade.pareto import figure as figure  # the runner looks for it here
from experiments.rasterizer_trade.scenes import Scene, load
from gsjax.metrics.image import psnr
from gsjax.optim.compiler import host_options
from gsjax.rasterize.plan import Plan

FAINTEST = 1 / 255  # of alpha: what is covered less is background, which any knob draws alike
ROUNDS, FEWEST_ROUNDS, SECONDS = 40, 8, 5.0  # calls of each kind in a cell, and about how long they may take


class Drawer(NamedTuple):
    """A variant, compiled for one scene."""

    gaussians: dict[str, jax.Array]  # as this variant stores them
    plan: Plan
    forward: Any  # (gaussians, viewmats) -> image, (pairs, overflow, alphas)
    backward: Any  # (gaussians, viewmats, target, mask) -> (loss, the same), gradients


def build(scene: Scene, variant: Variant, base: Plan | None = None) -> Drawer:
    """Plan and compile. Where lists are as under the plan `base`, so is what they need: none is sought."""
    width, height = scene.width // variant.shrink, scene.height // variant.shrink
    Ks = scene.Ks / jnp.array([variant.shrink, variant.shrink, 1.0])[:, None]
    given, options = {}, dict(variant.options)
    colors = scene.gaussians["colors"].astype(variant.dtype)
    if "sh_degree" in options:  # what is not read is not stored
        colors = colors[:, : (options["sh_degree"] + 1) ** 2]
    gaussians = scene.gaussians | {"colors": colors}
    shapes = [gaussians[name] for name in ("means", "quats", "scales", "opacities")]
    if variant.region < 1:
        given["roi"] = jnp.asarray(middle(variant.region, scene.width, scene.height))[None]
    if base is not None and variant.same_lists:
        plan = replace(base, **options)
    else:
        plan = gsjax.plan(*shapes, scene.viewmats, Ks, width, height, **given, **options)
    camera = {"Ks": Ks, "width": width, "height": height}
    if variant.with_reads:
        meta = gsjax.rasterization(**gaussians, viewmats=scene.viewmats, **camera, plan=plan)[2]
        given["reads"] = meta.reads

    def image(gaussians, viewmats, given):
        drawn, alphas, meta = gsjax.rasterization(
            **gaussians, viewmats=viewmats, **camera, plan=plan, **given
        )
        drawn = drawn[0].astype(jnp.float32)
        if variant.shrink > 1:
            drawn = jax.image.resize(drawn, (scene.height, scene.width, 3), "bilinear")
        return drawn, (meta.pairs.sum(), meta.overflow.any(), alphas[0, ..., 0])

    def loss(gaussians, viewmats, given, target, mask):
        drawn, counts = image(gaussians, viewmats, given)
        return jnp.sum(mask[..., None] * (drawn - target) ** 2), counts

    frame = jnp.zeros((scene.height, scene.width, 3))
    arguments = (gaussians, scene.viewmats, given)
    jobs = [(image, *arguments), (jax.value_and_grad(loss, has_aux=True), *arguments, frame, frame[..., 0])]
    with ThreadPoolExecutor(2) as executor:  # side by side, for compiling is most of a cell
        forward, backward = executor.map(lambda job: compiled(*job), jobs)
    return Drawer(
        gaussians,
        plan,
        lambda gaussians, viewmats: forward(gaussians, viewmats, given),
        lambda gaussians, viewmats, *rest: backward(gaussians, viewmats, given, *rest),
    )


def compiled(function, *arguments):
    return jax.jit(function, compiler_options=host_options() or None).lower(*arguments).compile()


def exact_variant(with_sh: bool) -> Variant:
    return Variant((("sh_degree", 3),) if with_sh else ())


@cache
def exact(name: str, seed: int, with_sh: bool) -> Drawer:
    """The defaults, compiled once for all cells of a scene."""
    return build(load(name, seed, with_sh), exact_variant(with_sh))


def target_of(scene: Scene, drawer: Drawer, seed: int) -> jax.Array:
    """What the loss compares with: the same Gaussians with other colours and half a size out of place."""
    rng, moved = np.random.default_rng(seed + 1), dict(scene.gaussians)
    for name, by in (("means", 0.5 * scene.gaussians["scales"]), ("colors", 0.2)):
        noise = jnp.asarray(rng.normal(size=moved[name].shape), jnp.float32)
        moved[name] = moved[name] + by * noise
    return drawer.forward(moved, scene.viewmats)[0]


def cosine(gradients: dict[str, jax.Array], wanted: dict[str, jax.Array]) -> float:
    """Of all arrays as one vector, each in units of its exact norm: else one kind would drown the others."""
    inner = squares = 0.0
    for name, want in wanted.items():
        want, got = np.float64(want), np.zeros(want.shape)
        read = tuple(map(slice, gradients[name].shape))  # harmonics that are not stored get no gradient
        got[read] = gradients[name]
        norm = np.linalg.norm(want)
        inner += np.sum(got * want) / norm**2
        squares += np.sum(got**2) / norm**2
    return float(inner / np.sqrt(squares * len(wanted)))


def timed(scene: Scene, drawers: tuple[Drawer, Drawer], target, mask, seed: int) -> np.ndarray:
    """Milliseconds [rounds, drawer, forward or both]; calls alternate, and no two see the same input."""
    rng, rounds, begun = np.random.default_rng(seed + 2), [], perf_counter()
    extent = float(jnp.std(scene.gaussians["means"]))
    while len(rounds) <= FEWEST_ROUNDS or (len(rounds) <= ROUNDS and perf_counter() - begun < SECONDS):
        shake = 1e-4 * extent * rng.normal(size=(4, 3)).astype(np.float32)
        round_ms = np.zeros((2, 2))
        for which in (0, 1) if len(rounds) % 2 else (1, 0):
            drawer = drawers[which]
            moved = drawer.gaussians | {"means": drawer.gaussians["means"] + shake[which]}
            viewmats = scene.viewmats.at[:, :3, 3].add(shake[2 + which])
            for kind, arguments in enumerate(((), (target, mask))):
                call = (drawer.forward, drawer.backward)[kind]
                jax.block_until_ready((moved, viewmats))
                start = perf_counter()
                jax.block_until_ready(call(moved, viewmats, *arguments))
                round_ms[which, kind] = 1e3 * (perf_counter() - start)
        rounds.append(round_ms)
    return np.array(rounds[1:])  # the first call of a program is not like the others


def run(options: dict[str, Any], seed: int, folder: Path) -> dict[str, Any]:
    """Error and time of one value of one knob; the defaults are measured once."""
    with_sh = options["knob"] == "sh_degree"
    return measure(options["scene"], seed, with_sh, variant_of(options["knob"], options["value"]))


@cache
def measure(name: str, seed: int, with_sh: bool, variant: Variant) -> dict[str, Any]:
    scene, default, plain = load(name, seed, with_sh), exact(name, seed, with_sh), exact_variant(with_sh)
    mine = default if variant == plain else build(scene, variant, default.plan)
    # What roi leaves out nobody wanted: it is not compared.
    wanted = middle(variant.region, scene.width, scene.height)
    mask, target = jnp.asarray(wanted, jnp.float32), target_of(scene, default, seed)
    images, pairs, coverage, gradients = [], [], [], []
    for drawer in (default, mine):
        image, (count, overflow, alphas) = drawer.forward(drawer.gaussians, scene.viewmats)
        _, gradient = drawer.backward(drawer.gaussians, scene.viewmats, target, mask)
        if overflow:
            raise RuntimeError("the plan overflowed: nothing was drawn")
        images.append(np.asarray(image))
        pairs.append(int(count))
        coverage.append(np.asarray(alphas))
        gradients.append(gradient)
    ms = timed(scene, (default, mine), target, mask, seed)
    low, ratios, high = np.percentile(ms[:, 1] / ms[:, 0], (25, 50, 75), axis=0)
    doubt = 1.57 * (high - low) / np.sqrt(len(ms))  # of a median (McGill, Tukey and Larsen 1978)
    return {
        "psnr": min(SAME, psnr(images[1], images[0], wanted & (coverage[0] > FAINTEST))),
        "gradient_cosine": cosine(gradients[1], gradients[0]),
        "forward_ratio": ratios[0],
        "forward_doubt": doubt[0],
        "both_ratio": ratios[1],
        "both_doubt": doubt[1],
        "default_both_ms": np.median(ms[:, 0, 1]),
        "pairs": pairs[1],
        "is_default": variant == plain,
        "rounds": len(ms),
    }
