"""Small problems of every method, for laws that all of them keep."""

from dataclasses import replace
from functools import cache

import equinox as eqx
import jax
import jax.numpy as jnp

from gsjax.data.simulated import tabletop
from gsjax.methods.fit import Fit, FitConfig, StartConfig
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
from gsjax.scene.render import plan_render
from tests.methods.photographed_blobs import photographed_blobs

FIT = FitConfig(
    steps=40, cap=120, sh_degree=1, sh_every=20, coarse_until=0.3, start=StartConfig(count=100), seed=1
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
    """step, params, a batch of the first step, one that is not finite, and one whose plan is too small."""
    method, problem, run = make()
    run = method.between(problem, run, 0.9)
    batch, _ = method.batch(problem, run, 0.9)
    return method.step, run, batch


def fit_step_case():
    step, run, batch = started(fit_problem)
    sick = batch._replace(progress=jnp.nan)  # what the rasterizer is given it culls
    return step, run.params, batch, sick, batch._replace(plan=replace(batch.plan, capacity=16))


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
    batch = TrackBatch(second, plan)
    sick = TrackBatch(eqx.tree_at(lambda f: f.images, second, jnp.full_like(second.images, jnp.nan)), plan)
    tight = batch._replace(plan=replace(plan, near=replace(plan.near, capacity=16)))
    return tracker.step(shape), run.params, batch, sick, tight, lambda params: run.state


def features_case():
    first, _, scene = little_table()
    gaussians, plan = scene.gaussians, plan_render(scene.gaussians, first.cameras)
    valid = jnp.ones(first.images.shape[:3])
    prior = jax.random.normal(jax.random.key(0), (gaussians.num, 3))
    known = valid, prior, jnp.ones(gaussians.num), jnp.float32(0.1), plan
    batch = FeatureBatch(gaussians, first.cameras, first.images, *known)
    sick = batch._replace(maps=jnp.full_like(first.images, jnp.nan))
    return feature_distiller(), prior, batch, sick, batch._replace(plan=replace(plan, capacity=16))


STEPS = {"fit": fit_step_case, "track": track_step_case, "features": features_case}
