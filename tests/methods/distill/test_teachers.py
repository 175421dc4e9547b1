"""Target features of pixels reach the loss unchanged, from masks and from maps."""

from dataclasses import replace
from functools import partial

import cv2
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from gsjax.engine.drive import drive
from gsjax.geometry.cameras import Camera
from gsjax.methods.distill import (
    Distill,
    DistillConfig,
    DistillWeightsConfig,
    distill_loss,
    frozen_views,
    init_field,
    teacher_of_maps,
    teacher_of_objects,
    with_maps,
)
from gsjax.methods.distill.teacher import max_rows, view_codebook
from gsjax.methods.distill.update import strip_rows
from gsjax.methods.distill.views import resized_rows
from gsjax.rasterize.frozen import paint
from gsjax.scene.feature_grid import FeatureGridConfig
from gsjax.scene.gaussians import gaussians_from_activated
from tests.methods.around import cameras_around

WIDTH, HEIGHT, DIMENSION = 48, 36, 24
GRID = FeatureGridConfig(
    levels=2, least_resolution=4, most_resolution=8, log2_entries=9, features=4, hidden=16
)
QUICK = DistillConfig(iterations=60, channels=12, grid=GRID, contrast_patch=8)
BOOK = np.linalg.qr(np.random.default_rng(0).normal(size=(DIMENSION, 6)))[0].T.astype(np.float32)


def cameras(count: int) -> list[Camera]:
    return cameras_around(np.linspace(0, 2, count), WIDTH, HEIGHT)


@pytest.fixture(scope="module")
def scene():
    random = np.random.default_rng(1)
    return gaussians_from_activated(
        random.uniform(-0.8, 0.8, (60, 3)),
        random.normal(size=(60, 4)),
        np.full((60, 3), 0.15),
        np.full(60, 0.9),
        random.uniform(size=(60, 3)),
    )


def halves(one: int, other: int) -> np.ndarray:
    """The mask of a view: one object on the left, another on the right, unknown at the top."""
    mask = np.full((HEIGHT, WIDTH), one, np.int64)
    mask[:, WIDTH // 2 :], mask[:4] = other, -1
    return mask


def objects():
    return teacher_of_objects([halves(0, 1), halves(2, 5), halves(3, 4)], [BOOK] * 3)


def maps(seed: int = 0):
    random = np.random.default_rng(seed)
    return teacher_of_maps([random.normal(size=(9, 12, DIMENSION)) for _ in range(3)], [(HEIGHT, WIDTH)] * 3)


@partial(jax.jit, static_argnums=0)
def loss_of(config, params, batch, step=0):
    return distill_loss(config)(params, batch, step=step, key=jax.random.key(0))


@pytest.mark.slow
def test_a_view_keeps_what_it_shows_of_the_codebook_and_that_is_as_good(scene):
    teacher = objects()
    assert max_rows(teacher) == 2
    for v in range(3):
        ids, book = view_codebook(teacher, v, 4)
        assert book.shape == (4, DIMENSION)
        np.testing.assert_array_equal(ids < 0, teacher.ids[v] < 0)
        np.testing.assert_array_equal(book[ids[ids >= 0]], teacher.codebook[teacher.ids[v][ids >= 0]])
    config = replace(QUICK, contrast_after=0.0)
    problem, run = Distill(config).start(scene, cameras(3), teacher)
    whole = problem.views[1]._replace(ids=jnp.asarray(teacher.ids[1]), codebook=jnp.asarray(teacher.codebook))
    assert len(whole.codebook) == 6 > len(problem.views[1].codebook) == 2
    of_all = loss_of(config, run.params, whole)[1]
    for name, value in loss_of(config, run.params, problem.views[1])[1].items():
        np.testing.assert_allclose(value, of_all[name], rtol=1e-5)


def test_views_that_show_all_or_nothing_of_the_codebook():
    full = teacher_of_objects([np.arange(6).reshape(2, 3)], [BOOK])
    ids, book = view_codebook(full, 0, 6)
    np.testing.assert_allclose(book[ids], full.codebook[full.ids[0]])
    empty = full._replace(ids=[np.full((2, 3), -1)])
    ids, book = view_codebook(empty, 0, 2)
    assert (ids == -1).all()
    assert not book.any()


@pytest.mark.thorough
@pytest.mark.parametrize("weight", [0.0, 0.5, 2.0])
def test_masks_with_maps_give_the_weighted_mean_of_both_losses(scene, weight):
    weights = DistillWeightsConfig(map=weight, contrast=0.0, tv=0.0)
    config, both, found = replace(QUICK, weights=weights), with_maps(objects(), maps()), []
    for teacher in (objects(), maps(), both):
        problem, run = Distill(config).start(scene, cameras(3), teacher)
        found.append(loss_of(config, run.params, problem.views[0])[1])
    of_objects, of_maps, of_both = found
    known = (HEIGHT - 4) * WIDTH
    share = weight * HEIGHT * WIDTH / (known + weight * HEIGHT * WIDTH)
    for name in ("rec", "cos"):
        want = (1 - share) * of_objects[name] + share * of_maps[name]
        np.testing.assert_allclose(of_both[name], want, rtol=1e-5)


def test_teachers_that_do_not_match_are_refused():
    with pytest.raises(ValueError, match="expected one with masks and one with maps"):
        with_maps(maps(), objects())
    other = teacher_of_maps([np.ones((9, 12, 5))] * 3, [(HEIGHT, WIDTH)] * 3)
    with pytest.raises(ValueError, match="expected features of dimension 24 as the objects have, found 5"):
        with_maps(objects(), other)
    fewer = maps()._replace(maps=maps().maps[:2])
    with pytest.raises(ValueError, match="expected maps of 3 views, found 2"):
        with_maps(objects(), fewer)


def test_a_teacher_with_maps_of_other_views_is_refused(scene):
    few = with_maps(objects(), maps())._replace(maps=maps().maps[:2])
    with pytest.raises(ValueError, match="teacher: expected maps of 3 views, found 2"):
        Distill(QUICK).start(scene, cameras(3), few)


@pytest.mark.parametrize("size", [(9, 12), (5, 7), (36, 48), (50, 70)])
def test_maps_are_stretched_as_opencv_does(scene, size):
    problem, _ = Distill(QUICK).start(scene, cameras(3), objects())
    plan = problem.views[0].plan
    features = np.random.default_rng(2).normal(size=(*size, 3)).astype(np.float32)
    want = cv2.resize(features, (WIDTH, HEIGHT), interpolation=cv2.INTER_LINEAR)
    compiled = jax.jit(resized_rows, static_argnums=2)
    np.testing.assert_allclose(compiled(features, 0, HEIGHT, plan), want, atol=1e-4)
    np.testing.assert_allclose(compiled(features, 8, 4, plan), want[8:12], atol=1e-4)


@pytest.mark.thorough
def test_the_length_of_an_encoders_vectors_does_not_matter(scene):
    found = []
    for factor in (1.0, 1e6, 1e-6):
        teacher = teacher_of_objects(objects().ids, [np.float32(factor) * BOOK] * 3)
        np.testing.assert_allclose(np.linalg.norm(teacher.codebook, axis=1).mean(), 1, rtol=1e-5)
        method = Distill(replace(QUICK, iterations=4))
        *_, last = drive(method, *method.start(scene, cameras(3), teacher))
        found.append(float(last.info["loss"]))
    np.testing.assert_allclose(found, found[0], rtol=1e-3)
    long = teacher_of_maps([1e4 * one for one in maps().maps], [(HEIGHT, WIDTH)] * 3)
    np.testing.assert_allclose(long.maps[0], maps().maps[0], rtol=1e-5)


@pytest.mark.thorough
def test_it_learns_from_maps(scene):
    """From maps of the scene itself, divided into three stripes by height."""
    labels = np.digitize(np.asarray(scene.means)[:, 2], [-0.25, 0.25])
    stripes = []
    for view, plan in frozen_views(scene, cameras(3)):
        shares = np.asarray(jax.jit(paint)(view, np.eye(3, dtype=np.float32)[labels], plan)[0])
        stripes.append(BOOK[shares.argmax(-1)] + 0.0)
    teacher = teacher_of_maps(stripes, [(HEIGHT, WIDTH)] * 3)
    method = Distill(replace(QUICK, iterations=150))
    problem, run = method.start(scene, cameras(3), teacher)
    *_, last = drive(method, problem, run)
    cosines = np.asarray(last.result.cosines(BOOK[:3]))
    shown = np.unique(np.concatenate([view.view.rows for view in problem.views]))
    assert (cosines.argmax(1) == labels)[shown].mean() > 0.85


@pytest.mark.thorough
def test_the_contrast_counts_from_its_step_on(scene):
    config = replace(QUICK, iterations=10, contrast_after=0.5)
    problem, run = Distill(config).start(scene, cameras(3), objects())
    values = [
        float(loss_of(config, run.params, problem.views[0], step)[1]["contrast"]) for step in (0, 4, 5, 9)
    ]
    assert values[:2] == [0, 0]
    assert values[2] == values[3] > 0


def test_strips_count_the_memory_of_the_teacher(scene):
    config = replace(QUICK, strip_megabytes=0.4)
    few, _ = Distill(config).start(scene, cameras(3), objects())
    many = few.views[0]._replace(codebook=jnp.zeros((500, DIMENSION)))
    wide = few.views[0]._replace(map=np.zeros((9, 12, 512), np.float32))
    assert strip_rows(config, 16, few.views[0]) == few.views[0].plan.tiles_y
    assert strip_rows(config, 16, many) == strip_rows(config, 16, wide) == 1


def test_a_few_gaussians_far_out_do_not_make_cells_coarse():
    means = np.random.default_rng(0).uniform(-1, 1, (1000, 3)).astype(np.float32)
    near, _ = init_field(jax.random.key(0), QUICK, jnp.asarray(means), DIMENSION)
    low, high = np.array(near.encoding.bounds)
    assert (low < means.min(0)).all()
    assert (high > means.max(0)).all()
    means[:5] = [[1e6, 0, 0], [-1e6, 0, 0], [0, 1e6, 0], [0, 0, -1e6], [50, 0, 0]]
    far, located = init_field(jax.random.key(0), QUICK, jnp.asarray(means), DIMENSION)
    assert np.ptp(np.array(far.encoding.bounds), axis=0).max() < 4.2  # metres
    assert np.isfinite(located.weights).all()


@pytest.mark.thorough
@pytest.mark.usefixtures("x64")
@pytest.mark.parametrize("megabytes", [256.0, 0.1])
def test_gradients_are_those_of_central_differences(scene, megabytes):
    @jax.jit
    def wide(tree):
        return jax.tree.map(lambda a: a.astype(np.float64) if a.dtype == np.float32 else a, tree)

    config = replace(QUICK, contrast_after=0.0, strip_megabytes=megabytes)
    problem, run = Distill(config).start(wide(scene), cameras(3), with_maps(objects(), maps()))
    batch, random = wide(problem.views[0]), np.random.default_rng(1)
    field = jax.tree.map(lambda a: np.asarray(a) + 0.1 * random.normal(size=a.shape), wide(run.params))
    loss = jax.jit(lambda f: distill_loss(config)(f, batch, step=0, key=jax.random.key(0))[0])
    slope = jax.jit(jax.grad(loss))(field)
    for pick in ("table", "layers", "lift"):
        along = jax.tree_util.tree_map_with_path(
            lambda path, a, pick=pick: random.normal(size=a.shape) * (pick in str(path)), field
        )
        want = sum(np.vdot(s, d) for s, d in zip(*map(jax.tree.leaves, (slope, along)), strict=True))
        ahead, behind = (
            loss(jax.tree.map(lambda a, d, step=step: a + step * d, field, along)) for step in (1e-6, -1e-6)
        )
        np.testing.assert_allclose((ahead - behind) / 2e-6, want, rtol=1e-4)


THREE = BOOK[:3]


def mask_of(*labels):
    return np.array([labels])


@pytest.mark.parametrize(
    ("masks", "embeddings", "message"),
    [
        ([], [], "masks: expected those of at least one view, found none"),
        ([mask_of(0, 1)], [], "embeddings: expected those of 1 views, found 0"),
        ([mask_of(0.5, 1)], [THREE], r"masks of view 0: expected integers \[H,W\], found float64 \[1, 2\]"),
        ([mask_of(0, 3)], [THREE], "expected a row for each of the labels 0 to 3, found 3 rows"),
        (
            [mask_of(0, 1)] * 2,
            [THREE, THREE[:, :7]],
            r"embeddings of view 1: expected \[labels, 24\] as of view 0",
        ),
        ([mask_of(0, 1)], [THREE * np.nan], "found NaN or infinity in rows"),
        ([mask_of(0, 0)], [THREE * 0], "found none that has an embedding"),
    ],
)
def test_invalid_masks_and_embeddings_are_refused(masks, embeddings, message):
    with pytest.raises(ValueError, match=message):
        teacher_of_objects(masks, embeddings)


def test_objects_with_equal_embeddings_are_one_object_and_a_view_without_masks_is_warned_of():
    rows = np.stack([np.zeros(4), np.eye(4)[0], np.eye(4)[1], np.eye(4)[0]]).astype(np.float32)
    with pytest.warns(UserWarning, match="views without any mask are not used: 1 of 2"):
        teacher = teacher_of_objects([mask_of(0, 1, 2, 3, -1), mask_of(0, 0, 0, 0, 0)], [rows, rows])
    one, two = teacher.ids[0][0, 1], teacher.ids[0][0, 2]
    np.testing.assert_array_equal(teacher.ids[0][0], [-1, one, two, one, -1])
    np.testing.assert_array_equal(teacher.codebook[one], np.eye(4)[0])
    assert len(teacher.codebook) == 2


@pytest.mark.thorough
@pytest.mark.parametrize(
    ("maps", "message"),
    [
        ([np.zeros((3, 4, 5))], "maps: expected those of 2 views, found 1"),
        ([np.zeros((3, 4, 5)), np.zeros((3, 4, 6))], r"maps of view 1: expected \[h, w, 5\], found float64"),
        ([np.zeros((3, 4, 5)), np.full((3, 4, 5), np.inf)], "maps of view 1: expected finite numbers"),
        (
            [np.zeros((30, 40, 5)), np.zeros((40, 30, 5))],
            "expected the aspect ratio of its view, 48x36",
        ),
    ],
)
def test_maps_that_do_not_fit_are_refused(maps, message):
    with pytest.raises(ValueError, match=message):
        teacher_of_maps(maps, [(HEIGHT, WIDTH)] * 2)
