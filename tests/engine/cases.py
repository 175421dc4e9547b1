"""Small problems of every method, for laws that all of them keep."""

from dataclasses import replace
from functools import cache

import jax.numpy as jnp

from gsjax.methods.fit import Fit, FitConfig, StartConfig
from tests.methods.photographed_blobs import photographed_blobs

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


STEPS = {"fit": fit_step_case}
