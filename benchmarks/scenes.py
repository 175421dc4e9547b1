"""Seeded scenes, and their comparison with the float64 reference, shared by tests and benchmarks."""

import dataclasses
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from gsjax.geometry.cameras import look_at
from gsjax.rasterize.binning import bin_gaussians
from gsjax.rasterize.plan import DEFAULT_LIMITS, RENDER_MODES, Limits, Plan, rung
from gsjax.rasterize.projection import project_gaussians
from gsjax.rasterize.rasterization import rasterization
from gsjax.rasterize.reference import rasterization_reference

SIZES = ((64, 56), (80, 64), (73, 51), (49, 81))
# (sh_degree, channels)
PAINTS = ((None, 1), (None, 3), (None, 7), (None, 12), (0, 3), (1, 3), (2, 3), (3, 3))
ARRAYS = ("means", "quats", "scales", "opacities", "colors", "viewmats", "Ks", "backgrounds", "features")
Scene = dict[str, Any]


@dataclasses.dataclass(frozen=True)
class Case:
    """One scene of the exactness suite. Consecutive seeds cycle through all modes."""

    seed: int
    num: int
    width: int
    height: int
    render_mode: str
    rasterize_mode: str
    sh_degree: int | None
    channels: int
    feature_channels: int | None
    limits: Limits = DEFAULT_LIMITS

    @property
    def options(self) -> dict[str, Any]:
        names = ("render_mode", "rasterize_mode", "sh_degree")
        return {name: getattr(self, name) for name in names} | self.limits._asdict()

    @property
    def mode(self) -> str:
        paint = f"{self.channels} channels" if self.sh_degree is None else f"SH {self.sh_degree}"
        features = f" + {self.feature_channels} features" if self.feature_channels else ""
        limits = "" if self.limits == DEFAULT_LIMITS else ", other limits"
        return f"{self.render_mode}, {self.rasterize_mode}, {paint}{features}{limits}"


def case(seed: int, num: int | None = None) -> Case:
    """The case of a seed. 40 seeds combine 5 render modes with 8 kinds of colours, 80 cover the rest."""
    sh_degree, channels = PAINTS[seed % len(PAINTS)]
    drawn = int(np.random.default_rng(seed + 1000).integers(500, 5001))
    width, height = SIZES[seed // 2 % len(SIZES)]
    return Case(
        seed=seed,
        num=drawn if num is None else num,
        width=width,
        height=height,
        render_mode=RENDER_MODES[seed % len(RENDER_MODES)],
        rasterize_mode=("classic", "antialiased")[seed // 5 % 2],
        sh_degree=sh_degree,
        channels=channels,
        feature_channels=(None, 5)[seed // 8 % 2],
        limits=(DEFAULT_LIMITS, Limits(3 / 255, 0.999, 1e-3))[seed // 16 % 2],
    )


def make_scene(case: Case) -> Scene:
    """Arrays of one scene and one camera, as float64 numpy arrays whose values are exact in float32.

    Gaussians range from a fraction of a pixel to a few pixels, opacities from 0.002 to 1; the camera is
    off-centre and skewed, and some centres lie outside the image. Depths are stratified to avoid ties. About
    350 Gaussians crowd one tile.
    """
    rng = np.random.default_rng(case.seed)
    n, width, height = case.num, case.width, case.height
    viewmat = look_at(np.array([2.5, 0.6, 0.8]), np.zeros(3))
    focal = 0.9 * width
    K = np.array([[focal, 0.5, 0.48 * width], [0.0, 1.1 * focal, 0.53 * height], [0.0, 0.0, 1.0]])
    depths = 1.5 + 2 * (rng.permutation(n) + rng.uniform(0.2, 0.8, n)) / n
    pixels = rng.uniform([-0.15 * width, -0.15 * height], [1.15 * width, 1.15 * height], (n, 2))
    crowd = min(n * 7 // 10, 350)
    pixels[:crowd] = rng.uniform(16, 24, (crowd, 2))
    y = (pixels[:, 1] - K[1, 2]) / K[1, 1]
    x = (pixels[:, 0] - K[0, 2] - K[0, 1] * y) / K[0, 0]
    local = np.stack([x, y, np.ones(n)], axis=-1) * depths[:, None]
    sigma = np.exp(rng.uniform(np.log(0.2), np.log(2.2), (n, 3)))  # pixels
    bases = () if case.sh_degree is None else ((case.sh_degree + 1) ** 2,)
    colors = rng.normal(size=(n, *bases, case.channels)) * 0.4 + (0.0 if bases else 0.5)
    scene = {
        "means": (local - viewmat[:3, 3]) @ viewmat[:3, :3],
        "quats": rng.normal(size=(n, 4)) * rng.uniform(0.2, 3.0, (n, 1)),
        "scales": sigma * depths[:, None] / focal,
        "opacities": rng.uniform(0.02, 0.999, n) * rng.uniform(0.1, 1.0, n),
        "colors": colors,
        "viewmats": viewmat[None],
        "Ks": K[None],
        "backgrounds": rng.uniform(size=(1, case.channels)) if "RGB" in case.render_mode else None,
        "features": rng.normal(size=(n, case.feature_channels)) if case.feature_channels else None,
    }
    return {k: None if v is None else np.float64(np.float32(v)) for k, v in scene.items()}


def cast(scene: Scene, dtype) -> Scene:
    return {k: None if v is None else jax.device_put(np.asarray(v, dtype)) for k, v in scene.items()}


def draw(scene: Scene, case: Case, **options: Any):
    """Render a scene: (colors, alphas, features or None), and meta."""
    colors, alphas, meta = rasterization(**scene, width=case.width, height=case.height, **options)
    return (colors, alphas, meta.features), meta


def _draw_reference(scene: Scene, case: Case):
    background = scene["backgrounds"]
    result = rasterization_reference(
        *(scene[name] for name in ARRAYS[:5]),
        scene["viewmats"][0],
        scene["Ks"][0],
        case.width,
        case.height,
        background=None if background is None else background[0],
        features=scene["features"],
        **case.options,
    )
    images = (result.colors, result.alphas, result.features)
    return jax.tree.map(lambda a: a[None], images), result.doubtful[None, ..., None]


def _weighted(images, weights, certain):
    """A scalar whose gradient is the random cotangents `weights`, zeroed at doubtful pixels."""
    terms = jax.tree.map(lambda a, w: jnp.sum(a * jnp.where(certain, w, 0).astype(a.dtype)), images, weights)
    return sum(jax.tree.leaves(terms))


@partial(jax.jit, static_argnames="case")
def _reference(scene: Scene, weights, case: Case):
    def objective(scene):
        images, doubtful = _draw_reference(scene, case)
        return _weighted(images, weights, ~doubtful), (images, doubtful)

    gradients, (images, doubtful) = jax.grad(objective, has_aux=True)(scene)
    return images, doubtful, gradients


@partial(jax.jit, static_argnames=("case", "plan"))
def _ours(scene: Scene, weights, certain, case: Case, plan):
    def objective(scene):
        images, meta = draw(scene, case, plan=plan)
        return _weighted(images, weights, certain), (images, meta)

    gradients, (images, meta) = jax.grad(objective, has_aux=True)(scene)
    return images, meta, gradients


@partial(jax.jit, static_argnames="plan")
def longest_list(scene: Scene, plan):
    """Length of the longest tile list of the first camera."""
    usable = jnp.ones(scene["means"].shape[0], bool)
    gaussians = (scene[name] for name in ARRAYS[:4])
    projected = project_gaussians(*gaussians, usable, scene["viewmats"][0], scene["Ks"][0], plan)
    return bin_gaussians(projected, None, plan).counts.max()


def relative_error(got, want, where=True) -> float:
    """max |got - want| / max |want|."""
    got, want = np.float64(got), np.float64(want)
    if not np.isfinite(got).all():
        return float("inf")
    scale = np.abs(np.where(where, want, 0)).max(initial=0.0)
    difference = np.abs(np.where(where, got - want, 0)).max(initial=0.0)
    return float(difference / scale) if scale > 0 else float(difference)


def compare(case: Case, dtypes=("float64", "float32")) -> dict[str, Any]:
    """Compare images and all gradients with the reference; requires 64-bit types to be enabled.

    Returns:
        The fraction of doubtful pixels, the longest list, and per dtype the relative error of each array.
    """
    scene = make_scene(case)
    exact = cast(scene, np.float64)
    shapes, _ = jax.eval_shape(partial(_draw_reference, case=case), exact)
    rng = np.random.default_rng(case.seed + 5)
    weights = jax.tree.map(lambda s: jnp.asarray(rng.normal(size=s.shape)), shapes)
    want_images, doubtful, want = _reference(exact, weights, case)
    certain = ~np.asarray(doubtful)
    result: dict[str, Any] = {"doubtful_share": float(doubtful.mean())}
    # Ample and known in advance; gsjax.plan would compile another program.
    ample = Plan(case.width, case.height, capacity=rung(8 * case.num), **case.options)
    for dtype in dtypes:
        inputs = cast(scene, np.dtype(dtype))
        if "longest_list" not in result:
            result["longest_list"] = int(longest_list(inputs, ample))
        images, meta, got = _ours(inputs, weights, certain, case, ample)
        if bool(meta.overflow.any()):
            raise RuntimeError(f"{case}: {meta.needed} pairs do not fit {ample.capacity}")
        errors = {}
        for name, a, b in zip(("color", "alpha", "feature"), images, want_images, strict=True):
            if a is not None:
                errors[f"{name} image"] = relative_error(a, b, certain)
        errors |= {k: relative_error(got[k], want[k]) for k in ARRAYS if want[k] is not None}
        result[dtype] = errors
    return result
