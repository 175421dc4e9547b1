"""Small problems of every method, for laws that all of them keep."""

from dataclasses import replace
from functools import cache

import jax
import jax.numpy as jnp

from gsjax.methods.fit import Fit, FitConfig, StartConfig
from gsjax.methods.parts import PartsConfig, RefineBatch, RefineParams
from gsjax.methods.parts import step as parts_step
from gsjax.scene.handles import at_rest
from tests.methods.photographed_blobs import photographed_blobs
from tests.methods.two_boxes import PARTS, batch_of, params_of, shifted, soft, two_boxes

FIT = FitConfig(
    steps=40, cap=120, sh_degree=1, sh_every=20, coarse_until=0.3, start=StartConfig(count=100), seed=1
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


def stream_step_case():
    """A frame of parts, with a picture of the past."""
    batch, bodies = batch_of(two_boxes())
    params = params_of(shifted(0.01), soft(bodies), bodies)
    small = replace(batch.plan, capacity=16)
    tight = batch._replace(plan=small, past_plan=small)
    return parts_step(PartsConfig()), params, batch, batch._replace(progress=jnp.nan), tight


def refine_step_case():
    """All frames of parts together."""
    given, _ = batch_of(two_boxes())
    scene, rest = given.canonical, at_rest(PARTS)
    poses = jax.tree.map(lambda a: jnp.stack([a, a]), rest)
    params = RefineParams(scene.movable, scene.fixed, poses)
    batch = RefineBatch(scene, given.weights, given.now, jnp.int32(1), jnp.int32(0), 0.0, given.plan)
    tight = batch._replace(plan=replace(batch.plan, capacity=16))
    return parts_step(PartsConfig()), params, batch, batch._replace(progress=jnp.nan), tight


STEPS = {
    "fit": fit_step_case,
    "parts, a frame": stream_step_case,
    "parts, all frames": refine_step_case,
}
