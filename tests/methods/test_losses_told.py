"""Custom losses that ask for the index of the photograph or frame, and for the progress of the run."""

from dataclasses import replace
from functools import partial

import jax.numpy as jnp
import numpy as np
import pytest

from gsjax.engine.drive import drive
from gsjax.losses.extra import extra_terms
from gsjax.methods.deform import Deform, DeformConfig
from gsjax.methods.fit import Fit, FitConfig, StartConfig
from gsjax.scene.deformation import DeformationConfig
from tests.methods.fit.photographed_blobs import photographed_blobs

FIT = FitConfig(steps=9, cap=60, sh_degree=0, coarse_until=0.0, start=StartConfig(count=50))
TINY = DeformationConfig(resolution=16, time_resolution=6, levels=1, channels=4, hidden=16)


@pytest.fixture(scope="module")
def photographs():
    return photographed_blobs()


def losses_of(photographs):
    """Losses that return how far the frame differs from the photograph with the given index; the index; and
    the progress."""
    images = jnp.stack([jnp.asarray(frame.colors[0], jnp.float32) for frame in photographs])

    def elsewhere(scene, rendered, frame, *, index):
        return jnp.abs(frame.images[0] - images[index]).max()

    def which(scene, rendered, frame, *, index):
        return 1.0 * index

    def done(scene, rendered, frame, *, index, progress):
        return progress + 0.0 * index

    return elsewhere, which, done


@pytest.mark.thorough
def test_a_fit_tells_the_photograph_and_the_progress(photographs):
    method = Fit(FIT, losses_of(photographs))
    told = [now.info["extra"] for now in drive(method, *method.start(photographs))]
    assert max(float(one["elsewhere"]) for one in told) < 1e-6
    assert {int(one["which"]) for one in told} == set(range(8))  # all of them in eight steps
    np.testing.assert_allclose([one["done"] for one in told], np.arange(9) / 9, atol=1e-6)


@pytest.mark.thorough
def test_a_deforming_scene_tells_the_frame_and_the_progress(photographs):
    over_time = [replace(frame, time=np.asarray(i / 7)) for i, frame in enumerate(photographs)]
    config = DeformConfig(start_pixels=2.0, warmup=9, iterations=0, deformation=TINY, warmup_frames="all")
    method = Deform(config, losses_of(photographs))
    told = [now.info["extra"] for now in drive(method, *method.start(over_time))]
    assert max(float(one["elsewhere"]) for one in told) < 1e-6
    assert {int(one["which"]) for one in told} == set(range(8))
    np.testing.assert_allclose([one["done"] for one in told], np.arange(9) / 9, atol=1e-6)


def given(scene, rendered, frame, *, progress):
    return jnp.asarray(progress)


def test_they_are_given_what_they_ask_for_and_no_more():
    def has_its_own(scene, rendered, frame, *, progress=0.25):
        return jnp.asarray(progress)

    def bound(scene, rendered, frame, *, weight, progress):
        return weight * progress

    losses = given, has_its_own, partial(bound, weight=3.0)
    terms = extra_terms(losses, None, None, None, index=2, progress=0.5)
    assert {name: float(value) for name, value in terms.items()} == {
        "given": 0.5,
        "has_its_own": 0.25,
        "bound": 1.5,
    }
    (fixed,) = extra_terms((partial(given, progress=0.75),), None, None, None, progress=0.5).values()
    assert float(fixed) == 0.75


@pytest.mark.parametrize(
    ("told", "says"),
    [
        ({}, "given asks for progress by keyword, and nothing is given here"),
        ({"index": 1, "camera": 2}, "given asks for progress by keyword, and only camera and index is given"),
    ],
)
def test_what_nobody_tells_is_said(told, says):
    with pytest.raises(ValueError, match=says):
        extra_terms((given,), None, None, None, **told)
