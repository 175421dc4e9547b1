"""Photographs of many sizes are padded to few, and the padding does not count."""

from dataclasses import replace

import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from gsjax.engine.drive import drive
from gsjax.geometry.cameras import Camera
from gsjax.methods.fit import Fit, FitConfig, GrowthConfig, StartConfig, light_of
from gsjax.methods.fit.padding import common_sizes, padded, sizes_of, with_common_sizes
from gsjax.methods.fit.update import _pull_of
from gsjax.scene.frame import Frame

CONFIG = FitConfig(
    steps=8,
    cap=60,
    sh_degree=0,
    coarse_until=0.0,
    growth=GrowthConfig(noise=0.0),
    start=StartConfig(count=60),
)


def photograph(width, height, seed=0):
    random = np.random.default_rng(seed)
    viewmat = np.eye(4)
    viewmat[:3, 3] = [0.05 * seed, 0.0, 3.0]
    K = np.array([[30.0, 0, width / 2], [0, 30.0, height / 2], [0, 0, 1]])
    image = random.integers(0, 255, (1, height, width, 3), np.uint8)
    return Frame(image, None, Camera(viewmat[None], K[None], width, height))


@given(st.lists(st.tuples(st.integers(1, 4000), st.integers(1, 4000)), min_size=1, max_size=200))
def test_every_photograph_fits_into_one_of_two_sizes(sizes):
    sizes = np.array(sizes)
    found = common_sizes(sizes)
    assert (found >= sizes).all()
    assert len(np.unique(found, axis=0)) <= 2
    assert (found.max(0) == sizes.max(0)).all()


def test_near_sizes_are_joined_and_upright_and_lying_ones_are_not():
    near = np.array([[640, 480], [641, 480], [640, 482], [638, 479]])
    assert (common_sizes(near) == [641, 482]).all()
    both = np.array([[640, 480], [480, 640], [638, 480]])
    assert (common_sizes(both) == [[640, 480], [480, 640], [640, 480]]).all()
    assert (common_sizes(near[:1]) == near[:1]).all()


def test_thirty_sizes_waste_little():
    sizes = np.random.default_rng(0).integers((230, 420), (310, 540), (30, 2))
    assert common_sizes(sizes).prod(1).sum() < 1.45 * sizes.prod(1).sum()


def test_a_hundred_sizes_and_a_large_one_waste_little():
    near = np.random.default_rng(0).integers((1000, 700), (1080, 760), (100, 2))
    sizes = np.concatenate([near, [[1600, 1200]]])
    assert common_sizes(sizes).prod(1).sum() < 1.15 * sizes.prod(1).sum()


def test_what_is_padded_does_not_count():
    frame = photograph(16, 12)
    wide = padded(frame, np.array([20, 15]))
    assert (wide.cameras.width, wide.cameras.height, wide.images.shape) == (20, 15, (1, 15, 20, 3))
    assert wide.masks[0, :12, :16].all()
    assert wide.masks.sum() == 16 * 12
    assert padded(frame, np.array([16, 12])).masks.all()  # all frames have the same structure
    same, none = with_common_sizes([frame, frame])
    assert (same, none) == ([frame, frame], None)


@pytest.mark.thorough
def test_a_padded_photograph_gives_the_steps_of_the_photograph():
    """Its loss, PSNR and Gaussians are those without padding."""
    frame, method = photograph(32, 24), Fit(CONFIG)
    wide = padded(frame, np.array([48, 40]))
    problem, run = method.start([frame])
    assert problem.shares is None
    other, second = method.start([frame])
    other = other._replace(frames=[wide], shares=np.array([[32 / 48, 24 / 40]]))
    for a, b in zip(drive(method, problem, run), drive(method, other, second), strict=True):
        assert float(a.info["psnr"]) == pytest.approx(float(b.info["psnr"]), abs=2e-3)
    ours, theirs = a.run.params.gaussians.means, b.run.params.gaussians.means
    assert float(jnp.median(jnp.abs(ours - theirs))) < 1e-5
    # SSIM's windows reach over the border into the padding, where there is no error.
    assert float(a.info["loss"]) == pytest.approx(float(b.info["loss"]), rel=5e-2)


@pytest.mark.slow
def test_padding_does_not_pull_gaussians_apart():
    """The pull by which `split` divides Gaussians is in units of half the photograph, without its padding."""
    frame, method = photograph(32, 24), Fit(replace(CONFIG, strategy="split", dssim_weight=0.0, steps=1))
    problem, run = method.start([frame])
    other, second = method.start([frame])
    wide = padded(frame, np.array([48, 40]))
    other = other._replace(frames=[wide], shares=np.array([[32 / 48, 24 / 40]]))
    (alone,), (there,) = (list(drive(method, *both)) for both in ((problem, run), (other, second)))
    ours, theirs = (_pull_of(tick.run.state).total for tick in (alone, there))
    assert float(ours.sum()) > 0
    np.testing.assert_allclose(theirs, ours, rtol=1e-3, atol=1e-3 * float(ours.max()))


@pytest.mark.thorough
def test_many_sizes_share_the_programs_of_one():
    frames = [photograph(32 - i % 2, 24 - i % 3 // 2, i) for i in range(6)]
    problem, run = Fit(CONFIG).start(frames)
    assert sizes_of(problem.frames) == [(32, 24)]
    own = np.array([(32 - i % 2, 24 - i % 3 // 2) for i in range(6)])
    np.testing.assert_allclose(problem.shares, own / [32, 24])
    assert all(frame.masks is not None for frame in problem.frames)
    compiled = [now.compile_seconds > 0.05 for now in drive(Fit(replace(CONFIG, steps=8)), problem, run)]
    assert sum(compiled[1:]) == 0


@pytest.mark.thorough
def test_pixels_that_do_not_count_may_be_nan_and_depth_endless():
    frames, counts = [photograph(32, 24, i) for i in range(3)], np.ones((1, 24, 32), bool)
    counts[0, :, :7] = False
    depths = np.full(counts.shape, 3.0)
    depths[0, :3], depths[0, 3:6] = np.nan, 1e300
    for i, frame in enumerate(frames):
        images = np.where(counts[..., None], frame.colors, np.nan)
        frames[i] = replace(frame, images=images, depths=depths, masks=counts)
    config = replace(CONFIG, depth_weight=1.0, coarse_until=0.6, start=StartConfig(source="random", count=60))
    method = Fit(config)
    assert not any(now.info["skipped"] for now in drive(method, *method.start(frames)))


@pytest.mark.slow
def test_light_in_the_padding_is_no_light():
    frame = photograph(32, 24)
    gaussians = Fit(CONFIG).start([frame])[1].params.gaussians
    alone, wide = (light_of(gaussians, [f]) for f in (frame, padded(frame, np.array([48, 40]))))
    np.testing.assert_allclose(wide, alone, atol=1e-5)
