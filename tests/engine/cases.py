"""Small problems of every method, on which tests check the laws that all steps keep."""

from dataclasses import replace
from functools import cache

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from gsjax.data.simulated import tabletop
from gsjax.methods.deform import Deform
from gsjax.methods.distill import Distill, DistillConfig, teacher_of_objects
from gsjax.methods.fit import Fit, FitConfig, StartConfig
from gsjax.methods.parts import PartsConfig, RefineBatch, RefineParams
from gsjax.methods.parts import step as parts_step
from gsjax.methods.track import (
    PLAN,
    PRESETS,
    AlignConfig,
    FeatureBatch,
    GrowConfig,
    Track,
    TrackBatch,
    feature_distiller,
    start_scene,
)
from gsjax.methods.track import StartConfig as TrackStart
from gsjax.scene.feature_grid import FeatureGridConfig
from gsjax.scene.gaussians import Gaussians
from gsjax.scene.handles import at_rest
from gsjax.scene.initialize import gaussians_from_points
from gsjax.scene.render import plan_render
from tests.methods.around import cameras_around
from tests.methods.deform.tissue import CONFIG, tissue
from tests.methods.fit.photographed_blobs import photographed_blobs
from tests.methods.parts.two_boxes import PARTS, batch_of, params_of, shifted, soft, two_boxes

FIT = FitConfig(
    steps=40, cap=120, sh_degree=1, sh_every=20, coarse_until=0.3, start=StartConfig(count=100), seed=1
)

GRID = FeatureGridConfig(
    levels=2, least_resolution=4, most_resolution=8, log2_entries=9, features=2, hidden=8
)


TRACK = replace(
    PRESETS["fast"],
    start=TrackStart(object_pixels=3.0, background_pixels=8.0, max_extent=1.0, iterations=0),
    align=AlignConfig(iterations=1, reach=0.0, turns=(), pixels=16, centers=16),
    grow=GrowConfig(slots=32, candidates=16),
)


@cache
def blobs():
    return photographed_blobs()


def fit_problem(config: FitConfig = FIT):
    """The method with its problem and run."""
    method = Fit(config)
    return method, *method.start(blobs())


def started(make):
    """A step, its run, and the batch of its first step."""
    method, problem, run = make()
    run = method.between(problem, run, 0.9)
    batch, _ = method.batch(problem, run, 0.9)
    return method.step, run, batch


def fit_step_case():
    step, run, batch = started(fit_problem)
    batch = batch._replace(plan=replace(batch.plan, capacity=1024))  # enough for the scene and little more
    sick = batch._replace(progress=jnp.nan)  # not the scene: the rasterizer would cull NaN
    return step, run.params, batch, sick


def deform_step_case():
    """A step of `deform` with deformation, features and a graph."""
    frames, lesson = tissue()
    method = Deform(replace(CONFIG, warmup=0, graph=replace(CONFIG.graph, after=0)))
    problem, run = method.start(frames, lesson)
    run = method.between(problem, run, 0.0)
    batch, _ = method.batch(problem, run, 0.0)
    sick = batch._replace(codebook=batch.codebook * jnp.nan)
    return method.step, run.params, batch, sick


def little_distillation(config: DistillConfig):
    """The step, the run, and the first batch, of one view."""
    random = np.random.default_rng(0)
    means, colors = random.uniform(-0.5, 0.5, (40, 3)), random.uniform(size=(40, 3))
    scene = jax.tree.map(jnp.asarray, gaussians_from_points(means, colors))
    thing = np.indices((24, 32)).sum(axis=0) // 8 % 3
    teacher = teacher_of_objects([thing], [np.eye(3, 5, dtype=np.float32)])
    method = Distill(config)
    return started(lambda: (method, *method.start(scene, cameras_around([0.3], 32, 24), teacher)))


def distill_step_case():
    config = DistillConfig(iterations=20, channels=4, grid=GRID, contrast_after=0.1, contrast_patch=4)
    step, run, batch = little_distillation(config)
    sick = batch._replace(codebook=batch.codebook.at[0, 0].set(jnp.nan))
    return step, run.params, batch, sick


def solve_step_case():
    """The step of `start="solve"`: the vote of one view."""
    step, run, batch = little_distillation(DistillConfig(start="solve", iterations=0))
    batch = batch._replace(is_last=False)  # the last view of a pass changes the state in any case
    codebook = batch.view.codebook.at[0, 0].set(jnp.nan)
    return step, run.params, batch, batch._replace(view=batch.view._replace(codebook=codebook))


def stream_step_case():
    """A step of `parts` on one frame, with an image of a past frame."""
    batch, bodies = batch_of(two_boxes())
    params = params_of(shifted(0.01), soft(bodies), bodies)
    return parts_step(PartsConfig()), params, batch, batch._replace(progress=jnp.nan)


def refine_step_case():
    """A step of `parts` that refines all frames together."""
    given, _ = batch_of(two_boxes())
    scene, rest = given.canonical, at_rest(PARTS)
    poses = jax.tree.map(lambda a: jnp.stack([a, a]), rest)
    params = RefineParams(scene.movable, scene.fixed, poses)
    batch = RefineBatch(
        scene, given.weights, given.now, jnp.int32(1), jnp.int32(0), jnp.int32(0), 0.0, given.plan
    )
    return parts_step(PartsConfig()), params, batch, batch._replace(progress=jnp.nan)


@cache
def little_table():
    """Two frames of one camera, and the scene at the first."""
    sequence = tabletop(0, 2, 48, 36, 1)
    frames = sequence.frame(0), sequence.frame(1)
    return *frames, start_scene(frames[0], sequence.mask(0, 0), 0, TRACK)


def track_step_case():
    first, second, scene = little_table()
    tracker = Track(TRACK)
    shape, run = tracker.start(scene, first)
    plan = run.plans[PLAN]
    plan = replace(plan, near=replace(plan.near, capacity=256))  # enough for the scene and little more
    batch = TrackBatch(second, plan)
    sick = TrackBatch(eqx.tree_at(lambda f: f.images, second, jnp.full_like(second.images, jnp.nan)), plan)
    return tracker.step(shape), run.params, batch, sick, TrackBatch(first, plan)


def features_case():
    first, _, scene = little_table()
    gaussians, plan = scene.gaussians, plan_render(scene.gaussians, first.cameras)
    valid = jnp.ones(first.images.shape[:3])
    prior = jax.random.normal(jax.random.key(0), (gaussians.num, 3))
    known = valid, prior, jnp.ones(gaussians.num), jnp.float32(0.1), plan
    batch = FeatureBatch(gaussians, first.cameras, first.images, *known)
    sick = batch._replace(maps=jnp.full_like(first.images, jnp.nan))
    return feature_distiller(), prior, batch, sick


# Each returns a step, its params, a batch, a batch with a number that is not finite and, if the step needs
# it, a batch that it must see before the others.
STEPS = {
    "fit": fit_step_case,
    "distill": distill_step_case,
    "distill, solved": solve_step_case,
    "deform": deform_step_case,
    "parts, a frame": stream_step_case,
    "parts, all frames": refine_step_case,
    "track": track_step_case,
    "features": features_case,
}

WITHOUT_PLAN = ("distill", "distill, solved")  # they render frozen views


def enlarged(tree):
    """The tree with its Gaussians about fifty times as large."""

    def larger(node):
        return eqx.tree_at(lambda g: g.log_scales, node, node.log_scales + 4) if is_gaussians(node) else node

    def is_gaussians(node):
        return isinstance(node, Gaussians)

    return jax.tree.map(larger, tree, is_leaf=is_gaussians)
