"""A scene is found again from its photographs; a fit that is resumed goes on to the same bits."""

from dataclasses import replace

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from gsjax.geometry.cameras import Camera, camera_centers, project
from gsjax.methods.fit import (
    Batch,
    FitConfig,
    FitState,
    GrowthConfig,
    Model,
    Observation,
    RatesConfig,
    SplitConfig,
    StartConfig,
    View,
    begin,
    extent_of,
    fit,
    fit_loss,
)
from gsjax.methods.fit.method import _observe, enlarged
from gsjax.methods.fit.model import exposed, refined
from gsjax.methods.fit.start import start_points
from gsjax.optim.densification import is_alive
from gsjax.rasterize.plan import rung
from gsjax.scene.render import plan_render, render
from tests.methods.photographed_blobs import HEIGHT, WIDTH, cameras, photographed_blobs

QUICK = FitConfig(
    steps=60, cap=120, sh_degree=1, sh_every=40, coarse_until=0.3, start=StartConfig(count=100), seed=1
)


@pytest.fixture(scope="module")
def views():
    return photographed_blobs()


def without_depth(views: list[View]) -> list[View]:
    return [view._replace(depth=None) for view in views]


def copied(tree):
    """What a step would give away."""
    return jax.tree.map(lambda leaf: np.array(leaf) if hasattr(leaf, "shape") else leaf, tree)


def picture(gaussians, view: View) -> np.ndarray:
    camera = Camera(
        jnp.asarray(view.viewmat, jnp.float32)[None], jnp.asarray(view.K, jnp.float32)[None], WIDTH, HEIGHT
    )
    return np.asarray(render(gaussians, camera).colors[0])


def psnr(gaussians, view: View) -> float:
    return -10 * np.log10(np.mean((picture(gaussians, view) - view.image / 255) ** 2))


@pytest.mark.slow
@pytest.mark.parametrize(("source", "steps"), [("depth", 60), ("random", 400)])
def test_a_view_that_was_held_out_is_seen_better_and_better(views, source, steps):
    config = replace(QUICK, steps=steps, start=replace(QUICK.start, source=source))
    problem, state = begin(views[1:], config)
    assert problem.start == source
    before = psnr(state.gaussians, views[0])
    shrinks = []
    for fitted in fit(problem, state):
        shrinks.append(fitted.shrink)
        assert not bool(fitted.info["skipped"])
    assert fitted.state.step == config.steps
    assert sorted(set(shrinks), reverse=True) == [4, 2, 1] == list(dict.fromkeys(shrinks))
    assert fitted.state.gaussians.sh_degree == 1
    assert psnr(fitted.state.gaussians, views[0]) > before + 1.5


SPLITTING = replace(
    QUICK,
    steps=45,
    strategy="split",
    cap=9000,
    sh_degree=0,
    coarse_until=0.0,
    start=StartConfig(count=3000),
    split=SplitConfig(every=10, begin=30, end=1.0, pull=-1.0, reset_every=35),
    exposure=True,
    refine_poses=True,
)


@pytest.mark.slow
@pytest.mark.parametrize(
    "config",
    [
        pytest.param(QUICK, id="relocate"),
        pytest.param(SPLITTING, id="split, exposure, poses"),
    ],
)
def test_a_resumed_fit_is_equal_to_the_bit(views, config):
    problem, state = begin(without_depth(views), config)
    for fitted in fit(problem, state):
        if fitted.state.step == 37:
            halfway = copied(fitted.state)  # before the degree changes, or more slots are taken, at 40
    problem, _ = begin(without_depth(views), config)
    arrays = jax.tree.map(jnp.asarray, (halfway.model, halfway.optimizer))
    *_, again = fit(problem, FitState(*arrays, halfway.step, halfway.capacity))
    jax.tree.map(np.testing.assert_array_equal, copied(again.state), copied(fitted.state))


@pytest.mark.slow
def test_splitting_takes_more_slots_as_it_needs_them_up_to_the_cap(views):
    problem, state = begin(without_depth(views), SPLITTING)
    slots = [state.gaussians.num] + [fitted.state.gaussians.num for fitted in fit(problem, state)]
    assert sorted(set(slots)) == [rung(4500), rung(6000), 9000]
    assert slots == sorted(slots)


@pytest.mark.slow
def test_exposure_is_learned_where_photographs_differ_in_it(views):
    gains = np.linspace(0.6, 1.0, len(views))
    dimmed = [
        v._replace(image=np.round(g * v.image).astype(np.uint8)) for g, v in zip(gains, views, strict=True)
    ]
    config = replace(QUICK, steps=300, sh_degree=0, coarse_until=0.0, rates=RatesConfig(exposures=3e-3))
    told = {}
    for exposure in (False, True):
        problem, state = begin(dimmed, replace(config, exposure=exposure))
        *_, fitted = fit(problem, state)
        told[exposure] = np.mean(
            [
                float(np.abs(seen_as(fitted.state.model, v, i) - v.image / 255).mean())
                for i, v in enumerate(dimmed)
            ]
        )
    assert told[True] < 0.85 * told[False]
    maps = fitted.state.model.exposures
    found = np.asarray(1 + (maps - maps.mean(0))[:, np.arange(3), np.arange(3)].mean(-1))
    assert np.corrcoef(found, gains)[0, 1] > 0.9


def seen_as(model: Model, view: View, number: int) -> np.ndarray:
    drawn = jnp.asarray(picture(model.gaussians, view))[None]
    return np.asarray(
        drawn if model.exposures is None else exposed(drawn, model.exposures, jnp.int32(number))
    )[0]


@pytest.mark.slow
def test_cameras_that_stand_elsewhere_than_was_said_are_found(views):
    random = np.random.default_rng(3)
    twists = np.concatenate([random.normal(size=(8, 3)) * 0.02, random.normal(size=(8, 3)) * 0.01], axis=1)
    off = [v._replace(viewmat=moved(v, twists.mean(0) - twists, i, 3.3)) for i, v in enumerate(views)]
    config = replace(QUICK, steps=250, sh_degree=0, coarse_until=0.0, refine_poses=True)
    problem, state = begin(off, replace(config, rates=RatesConfig(twists=2e-3)))
    *_, fitted = fit(problem, state)
    found = [
        v._replace(viewmat=moved(v, fitted.state.model.twists, i, problem.extent.radius))
        for i, v in enumerate(off)
    ]

    def pixels_off(others):
        points = jnp.asarray(random.uniform(-0.6, 0.6, (50, 3)))
        seen = [
            [project(points, jnp.asarray(v.viewmat), jnp.asarray(v.K))[0] for v in pair]
            for pair in zip(others, views, strict=True)
        ]
        return np.mean([np.abs(a - b).mean() for a, b in seen])

    # Turns and shifts of a camera look much alike; where the scene is seen is what can be known.
    assert pixels_off(found) < 0.4 * pixels_off(off)


def moved(view: View, twists, number: int, radius: float) -> np.ndarray:
    viewmat, twists = jnp.asarray(view.viewmat, jnp.float32)[None], jnp.asarray(twists, jnp.float32)
    return np.asarray(refined(viewmat, twists, jnp.int32(number), radius)[0])


def test_a_turned_camera_stays_where_it_is_and_twists_of_all_move_none(views):
    viewmats = jnp.asarray(np.stack([v.viewmat for v in views[:2]]))
    twists = jnp.array([[0.1, -0.2, 0.3, 0, 0, 0], [-0.1, 0.2, -0.3, 0, 0, 0.0]])
    turned = refined(viewmats, twists, jnp.int32(0), 2.0)
    np.testing.assert_allclose(camera_centers(turned), camera_centers(viewmats), atol=1e-6)
    assert float(jnp.abs(turned - viewmats).max()) > 0.05
    alike = jnp.broadcast_to(twists[:1], (2, 6))
    np.testing.assert_allclose(refined(viewmats, alike, jnp.int32(1), 2.0), viewmats, atol=1e-6)


@pytest.mark.slow
def test_slots_fill_up_to_the_cap_and_no_further(views):
    growth = replace(QUICK.growth, every=5, begin=5, factor=1.5, opacity_cost=0.0)
    config = replace(QUICK, growth=growth, start=StartConfig(source="depth", count=40, opacity=0.5))
    problem, state = begin(views, config)
    first = int(is_alive(state.gaussians).sum())
    counts = [
        int(is_alive(fitted.state.gaussians).sum()) for fitted in fit(problem, state, share=lambda i: i / 40)
    ]
    assert first == 40
    assert max(counts) == config.cap


def test_what_a_mask_leaves_out_has_no_slope_and_costs_nothing(views):
    view = views[0]
    _, state = begin([view], QUICK)
    mask = np.zeros((HEIGHT, WIDTH), bool)
    mask[:, : WIDTH // 2] = True
    camera = Camera(
        jnp.asarray(view.viewmat, jnp.float32)[None], jnp.asarray(view.K, jnp.float32)[None], WIDTH, HEIGHT
    )
    plan = plan_render(state.gaussians, camera)
    loss = fit_loss(replace(QUICK, growth=replace(QUICK.growth, opacity_cost=0.0, scale_cost=0.0)), 1.0)

    def of(image):
        seen = Observation(jnp.asarray(image)[None], jnp.asarray(mask)[None], None, camera, jnp.int32(0))
        batch = Batch(seen, jnp.zeros((1, 3)), plan)
        return jax.jit(jax.value_and_grad(lambda g: loss(g, batch, step=0, key=None)[0]))(state.model)

    garbled = view.image.copy()
    garbled[:, WIDTH // 2 + 12 :] = (
        255 - garbled[:, WIDTH // 2 + 12 :]
    )  # further off than SSIM's windows reach
    value, slope = of(view.image)
    other, other_slope = of(garbled)
    np.testing.assert_allclose(other, value, rtol=1e-5)
    jax.tree.map(lambda a, b: np.testing.assert_allclose(a, b, atol=1e-6), other_slope, slope)


def test_more_coefficients_and_slots_draw_the_same_and_keep_what_adam_knows(views):
    problem, state = begin(views, QUICK)
    *_, fitted = fit(problem, state, share=lambda i: i / 3)
    model, optimizer = fitted.state.model, fitted.state.optimizer
    wider, known = enlarged(problem, model, optimizer, 2, QUICK.cap + 30)
    assert wider.gaussians.sh_degree == 2
    assert wider.gaussians.num == QUICK.cap + 30
    np.testing.assert_allclose(
        picture(wider.gaussians, views[0]), picture(model.gaussians, views[0]), atol=1e-6
    )
    before = {jax.tree_util.keystr(p): leaf for p, leaf in jax.tree_util.tree_leaves_with_path(optimizer)}
    after = {jax.tree_util.keystr(p): leaf for p, leaf in jax.tree_util.tree_leaves_with_path(known)}
    assert before.keys() < after.keys()
    for path, leaf in before.items():
        np.testing.assert_array_equal(after[path][tuple(slice(0, size) for size in leaf.shape)], leaf)
    assert enlarged(problem, wider, known, 1, 10)[0] is wider  # never back


def test_masks_that_leave_nothing_are_refused(views):
    nothing = np.zeros((HEIGHT, WIDTH), bool)
    with pytest.raises(ValueError, match="are they inverted"):
        begin([view._replace(mask=nothing) for view in views], QUICK)


def test_poison_in_a_photograph_cannot_be_and_in_a_gaussian_skips_the_step(views):
    problem, state = begin(views, QUICK)
    sick = eqx.tree_at(lambda s: s.model.gaussians.sh0, state, state.gaussians.sh0.at[3].set(jnp.nan))
    (fitted, *_) = fit(problem, sick, share=lambda i: i / 1)
    assert bool(fitted.info["skipped"])
    assert np.isfinite(np.asarray(fitted.state.gaussians.means)).all()


def test_an_extent_is_that_of_the_cameras_and_where_they_look():
    eight = np.asarray(cameras(8).viewmat, np.float64)
    found = extent_of(eight)
    np.testing.assert_allclose(found.focus, 0, atol=0.02)
    assert 3.0 < found.radius < 3.6
    alone = extent_of(eight[:1])
    assert np.isfinite(alone.focus).all()
    assert alone.radius > 0
    ahead = np.tile(np.eye(4), (5, 1, 1))
    ahead[:, 0, 3] = np.linspace(-1, 1, 5)  # side by side, along parallel axes
    found = extent_of(ahead)
    assert np.isfinite(found.focus).all()
    assert found.focus[2] > 0
    turning = np.tile(np.eye(4), (4, 1, 1))  # all at one place, where their axes meet
    angles = np.array([-0.3, -0.1, 0.1, 0.3])
    turning[:, 0, 0], turning[:, 0, 2] = np.cos(angles), np.sin(angles)
    turning[:, 2, 0], turning[:, 2, 2] = -np.sin(angles), np.cos(angles)
    found = extent_of(turning)
    assert found.radius == 1.0
    np.testing.assert_allclose(found.focus, [0, 0, np.cos(angles).mean()], atol=1e-6)


def test_starts_that_the_data_does_not_have_are_refused(views):
    for source in ("cloud", "depth"):
        config = StartConfig(source=source, count=10)
        with pytest.raises(ValueError, match=r"start.source: the data has no .*; use"):
            start_points(without_depth(views), None, config, 0)
    with pytest.raises(ValueError, match="at least one photograph"):
        begin([], QUICK)
    cloud = (np.zeros((3, 3)), np.full((3, 3), 0.5))
    assert start_points(views, cloud, StartConfig(), 0)[2] == "cloud"


def test_points_that_no_photograph_shows_are_no_start(views):
    random = np.random.default_rng(0)
    points, colors = random.uniform(-0.5, 0.5, (50, 3)), np.full((50, 3), 0.5)
    away = points + np.array([0, 0, 1e6])
    with pytest.warns(UserWarning, match="of the data's 50 points the photographs show 0"):
        assert start_points(views, (away, colors), StartConfig(count=10), 0)[2] == "depth"
    with pytest.warns(UserWarning, match="axes and the unit"):
        assert start_points(views, (away, colors), StartConfig(source="cloud"), 0)[2] == "cloud"
    some = np.concatenate([away, points])
    assert start_points(views, (some, np.full((100, 3), 0.5)), StartConfig(), 0)[2] == "cloud"


def test_points_in_another_unit_than_the_poses_are_told(views):
    points, colors = np.random.default_rng(0).uniform(-0.5, 0.5, (50, 3)), np.full((50, 3), 0.5)
    with pytest.warns(UserWarning, match=r"so far away .* are they in the unit of the poses"):
        start_points(views, (1e3 * points, colors), StartConfig(), 0)
    same_place = [view._replace(viewmat=views[0].viewmat) for view in views]
    start_points(same_place, (points, colors), StartConfig(), 0)  # says nothing: a warning fails the test


@pytest.mark.parametrize(
    ("kind", "name", "value", "says"),
    [
        (FitConfig, "steps", 0, "steps: expected at least 1, found 0"),
        (FitConfig, "sh_degree", 4, "sh_degree: expected at least 0 and at most 3, found 4"),
        (FitConfig, "dssim_weight", 1.5, "dssim_weight: expected"),
        (FitConfig, "prune", -0.1, "prune: expected"),
        (StartConfig, "count", 0, "start.count: expected at least 1"),
        (StartConfig, "opacity", 2.0, "start.opacity: expected"),
        (StartConfig, "scale", float("nan"), "start.scale: expected"),
        (RatesConfig, "means", -1.0, "rates.means: expected"),
        (GrowthConfig, "every", 0, "growth.every: expected"),
        (GrowthConfig, "factor", 0.9, "growth.factor: expected"),
        (SplitConfig, "every", 0, "split.every: expected"),
        (SplitConfig, "reset_every", 0, "split.reset_every: expected"),
    ],
)
def test_settings_without_meaning_are_refused(kind, name, value, says):
    with pytest.raises(ValueError, match=says):
        kind(**{name: value})


def test_another_background_than_that_of_the_data_is_refused(views):
    with pytest.raises(ValueError, match="leave it at data"):
        begin(views, replace(QUICK, background="random"), background=(1.0, 1.0, 1.0))


def test_depth_that_knows_nothing_is_no_start(views):
    blind = [view._replace(depth=np.zeros_like(view.depth)) for view in views]
    assert start_points(blind, None, StartConfig(count=10), 0)[2] == "random"
    with pytest.raises(ValueError, match="the data has no depth"):
        start_points(blind, None, StartConfig(source="depth"), 0)


def test_photographs_with_and_without_masks_and_depth_share_one_program(views):
    ones = np.ones((HEIGHT, WIDTH), bool)
    holed = ones.copy()
    holed[0, 0] = False  # which is gone in a smaller picture
    mixed = [
        view._replace(mask=[None, ones, holed][i % 3], depth=view.depth if i % 2 else None)
        for i, view in enumerate(views)
    ]
    kinds = {
        jax.tree.structure(_observe(view, i, shrink, (True, True)))
        for i, view in enumerate(mixed)
        for shrink in (1,)
    }
    assert len(kinds) == 1
    problem, state = begin(
        mixed, replace(QUICK, sh_degree=0, coarse_until=0.0, growth=GrowthConfig(begin=99))
    )
    compiling = [fitted.compile_seconds > 0 for fitted in fit(problem, state, share=lambda i: i / 12)]
    assert sum(compiling) == 1


@pytest.mark.slow
def test_few_grow_too(views):
    growth = replace(QUICK.growth, every=5, begin=5, opacity_cost=0.0)
    config = replace(
        QUICK, growth=growth, start=StartConfig(source="depth", count=4, opacity=0.9), sh_degree=0
    )
    problem, state = begin(views[:4], config)
    *_, fitted = fit(problem, state, share=lambda i: i / 16)
    assert int(fitted.info["alive"]) > 4
