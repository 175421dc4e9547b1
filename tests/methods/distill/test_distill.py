"""A field learns from masks, rendered at once or in strips, and is queried in 3D and 2D."""

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from gsjax.engine.drive import drive
from gsjax.methods.distill import (
    Distill,
    DistillConfig,
    DistillWeightsConfig,
    active_table,
    back_projected_cosines,
    distill_loss,
    features_of,
    frozen_views,
    full_table,
    gaussian_cosines,
    init_field,
    label_votes,
    learned_inverse,
    pixel_cosines,
    pixel_features,
    rendered_features,
    teacher_of_maps,
    teacher_of_objects,
    voted_labels,
)
from gsjax.methods.query import EVEN, Prompt, relevancy
from gsjax.rasterize.frozen import paint_shown
from gsjax.scene.feature_grid import FeatureGridConfig, locate
from tests.methods.distill.two_balls import BOOK, DIMENSION, HEIGHT, WIDTH, cameras, painted, two_balls

GRID = FeatureGridConfig(
    levels=4, least_resolution=4, most_resolution=16, log2_entries=10, features=4, hidden=16
)
QUICK = DistillConfig(iterations=120, channels=12, grid=GRID, contrast_patch=8)

features_now = jax.jit(features_of)
rendered_now = jax.jit(rendered_features)
cosines_now = jax.jit(gaussian_cosines)
pixels_now = jax.jit(pixel_cosines)


@pytest.fixture(scope="module", name="two_balls")
def of_two_balls():
    return two_balls()


@pytest.fixture(scope="module")
def problem(two_balls):
    scene, _, masks = two_balls
    return Distill(QUICK).start(scene, cameras(8), teacher_of_objects(masks, [BOOK] * 8))


@pytest.fixture(scope="module")
def result(problem):
    given, run = problem
    *_, last = drive(Distill(QUICK), given, jax.tree.map(copied, run))
    return last.result


@pytest.fixture(scope="module")
def learned(result):
    return result.field


def copied(leaf):
    """A copy of an array that a step would donate."""
    return jnp.array(leaf) if isinstance(leaf, jax.Array) else leaf


@pytest.mark.thorough
def test_rendering_the_hidden_layer_equals_rendering_features(problem):
    given, run = problem
    batch = given.views[0]
    parts = rendered_now(run.params, batch.located)
    image, alphas = painted(batch.view, parts.values, batch.plan)
    some = rendered_now(run.params, batch.located, batch.view.rows)
    np.testing.assert_array_equal(jax.jit(paint_shown)(batch.view, some.values, batch.plan)[0], image)
    of_hidden = parts.channels_of(parts.joined(image, alphas))
    of_features, _ = painted(batch.view, features_now(run.params, batch.located), batch.plan)
    assert parts.values.shape[1] == 16 != of_features.shape[-1]
    np.testing.assert_allclose(of_hidden, of_features, atol=1e-5)


@pytest.mark.thorough
@pytest.mark.parametrize("kind", ["codebook", "maps"])
def test_strips_change_neither_the_loss_nor_its_slope(two_balls, kind):
    scene, _, masks = two_balls
    teacher = teacher_of_objects(masks, [BOOK] * 8)
    if kind == "maps":
        maps = [np.random.default_rng(v).normal(size=(9, 12, DIMENSION)) for v in range(8)]
        teacher = teacher_of_maps(maps, [(HEIGHT, WIDTH)] * 8, teacher.ids)
    found = []
    for megabytes in (256.0, 0.1):
        config = replace(QUICK, strip_megabytes=megabytes, contrast_after=0.0)
        given, run = Distill(config).start(scene, cameras(8), teacher)
        rows = given.views[0].plan.tiles_y
        value = jax.value_and_grad(distill_loss(config), has_aux=True)
        found.append(
            jax.jit(value, static_argnames="step")(run.params, given.views[0], step=0, key=jax.random.key(0))
        )
    assert rows == 5  # too many for 0.1 MiB: a row has 384 pixels of 28 numbers or more
    ((one, aux), slope), ((other, other_aux), other_slope) = found
    assert float(aux["contrast"]) > 0
    np.testing.assert_allclose(one, other, rtol=1e-5)
    for name in aux:
        np.testing.assert_allclose(aux[name], other_aux[name], rtol=1e-4)
    jax.tree.map(lambda a, b: np.testing.assert_allclose(a, b, atol=2e-5), slope, other_slope)


@pytest.mark.thorough
def test_only_active_entries_are_trained_and_the_full_grid_agrees(two_balls):
    scene, *_ = two_balls
    field, located = init_field(jax.random.key(0), QUICK, scene.means, DIMENSION)
    small, near, rows = active_table(field, located)
    assert small.encoding.table.shape[0] < field.encoding.table.shape[0]
    of_all = features_now(field, located)
    np.testing.assert_array_equal(features_now(small, near), of_all)
    again = full_table(small, rows)
    np.testing.assert_array_equal(features_now(again, locate(again.encoding, scene.means)), of_all)


@pytest.mark.thorough
def test_it_learns_the_label_of_each_gaussian(two_balls, learned, problem):
    _, labels, _ = two_balls
    cosines = np.asarray(cosines_now(learned, problem[0].views[0].located, BOOK))
    assert (cosines[:, 1:].argmax(1) + 1 == labels).mean() > 0.97
    assert np.median(cosines[np.arange(160), labels]) > 0.7


class Numerals:
    """An encoder that embeds the text "2" as row 2 of the codebook."""

    min_score = 0.5

    def embed_objects(self, image, labels, count):
        raise NotImplementedError

    def embed_text(self, text):
        return BOOK[int(text)]


@pytest.mark.thorough
def test_the_result_scores_its_gaussians_and_others(two_balls, result, problem):
    scene, *_ = two_balls
    vectors = BOOK[[2, 1]]
    want = relevancy(cosines_now(result.field, problem[0].views[0].located, vectors))
    np.testing.assert_allclose(result.scores(vectors), want, atol=1e-6)
    assert result.features().shape == (160, 12)
    some = replace(result, means=scene.means[::2])
    np.testing.assert_allclose(some.scores(vectors), want[::2], atol=1e-6)
    reader = Numerals()
    np.testing.assert_array_equal(result.query("2", negatives=("1",), encoder=reader), result.scores(vectors))
    np.testing.assert_array_equal(result.query("2", encoder=reader), result.scores(BOOK[2:]))
    with pytest.raises(ValueError, match="encoder: expected one that reads texts"):
        result.query("can")
    for wrong in (BOOK[:, :7], BOOK[0]):
        with pytest.raises(ValueError, match=r"expected queries \[q, 24\], as long as this field's features"):
            result.scores(wrong)
    with pytest.raises(ValueError, match="means: expected the centres"):
        replace(result, means=None).features()


def test_2d_and_3d_agree_and_occluded_objects_are_selected_whole(two_balls, learned, problem):
    scene, labels, masks = two_balls
    given = problem[0]
    # Camera 6 looks along y: one ball is behind the other.
    hidden = [v for v, mask in enumerate(masks) if (mask == 2).sum() < 0.3 * (mask == 1).sum()]
    assert hidden
    query = BOOK[[2, 0, 1]]
    scores = relevancy(cosines_now(learned, given.views[0].located, query))
    selected = np.asarray(scores > EVEN)
    assert (selected == (labels == 2)).mean() > 0.97
    for v, (view, plan) in enumerate(frozen_views(scene, cameras(8))):
        parts = rendered_now(learned, given.views[0].located, view.rows)
        of_pixels, alphas = pixels_now(learned, parts, view, plan, query)
        flat = (np.asarray(relevancy(of_pixels)) > 0.5) & (np.asarray(alphas) > 0.5)
        solid = np.asarray(painted(view, np.float32(selected)[:, None], plan)[0])[..., 0] > 0.5
        true = masks[v] == 2
        for found in (flat, solid):
            assert (found & true).sum() >= 0.8 * (found | true).sum() or v in hidden
        assert (solid & ~true).sum() < 0.1 * true.sum() + 20


@pytest.mark.thorough
def test_a_vector_for_each_gaussian_learns_too_and_weights_of_zero_cost_nothing(two_balls):
    scene, labels, masks = two_balls
    config = replace(QUICK, encoding="table", weights=DistillWeightsConfig(contrast=0.0, tv=0.0))
    given, run = Distill(config).start(scene, cameras(8), teacher_of_objects(masks, [BOOK] * 8))
    *_, last = drive(Distill(config), given, run)
    assert set(last.info) == {"rec", "cos", "loss", "skipped", "overflow", "needed"}
    cosines = np.asarray(last.result.cosines(BOOK))
    seen = np.abs(cosines[np.arange(160), labels]) > 0.5
    assert seen.mean() > 0.5
    assert full_table(last.result.field, last.result.rows) is last.run.params


def test_inverses_rank_gaussians_as_the_exact_query_does(learned, problem):
    located = problem[0].views[0].located
    query = BOOK[1:]
    exact = np.asarray(cosines_now(learned, located, query))
    features = features_now(learned, located)
    inverse, losses = learned_inverse(learned.lift, features, jax.random.key(0), 300, 256)
    assert losses[-1] < 0.2 * losses[0]
    for back in (jnp.linalg.pinv(learned.lift), inverse):
        found = np.asarray(jax.jit(back_projected_cosines)(learned, located, query, back))
        for of_found, of_exact in zip(found.T, exact.T, strict=True):
            assert np.corrcoef(of_found, of_exact)[0, 1] > 0.95


def test_the_pseudo_inverse_is_exact_up_to_a_factor_for_orthonormal_columns(learned, problem):
    located, query = problem[0].views[0].located, BOOK[1:]
    turning = jnp.linalg.qr(learned.lift)[0]  # columns of length 1, at right angles
    field = replace(learned, lift=turning)
    exact = np.asarray(cosines_now(field, located, query))
    found = np.asarray(jax.jit(back_projected_cosines)(field, located, query, jnp.linalg.pinv(turning)))
    shown = np.linalg.norm(turning.T @ query.T, axis=0)  # how much of each query the field can show at all
    np.testing.assert_allclose(found * shown, exact, atol=1e-5)


def test_a_threshold_names_its_rule():
    scores = np.concatenate([np.full(50, 0.1), np.full(10, 0.8)])
    alone, against = Prompt(BOOK[:1]), Prompt(BOOK[:2], ("a ball",))
    assert alone.threshold(scores, 0.3) == against.threshold(scores, 0.3) == (0.3, "given")
    assert against.threshold(scores) == (0.5, "better than each negative")
    assert against._replace(rule="nearest name").threshold(scores) == (0.5, "nearest name")
    assert alone._replace(min_score=0.2).threshold(scores) == (0.2, "the encoder's own")
    value, rule = alone.threshold(scores)
    assert 0.1 <= value < 0.8
    assert rule == "Otsu"
    assert alone.threshold(np.full(9, 0.4)).value == np.inf  # nothing separates them
    assert alone.threshold(np.full(9, np.nan)).value == np.inf


def test_the_share_is_a_half_where_query_and_negative_match_equally():
    cosines = jnp.array([[0.4, 0.4, 0.1], [0.9, 0.1, 0.2], [0.1, 0.9, 0.9]])
    shares = relevancy(cosines)
    np.testing.assert_allclose(shares[0], 0.5)
    assert shares[1] > 0.99
    assert shares[2] < 0.01
    np.testing.assert_array_equal(relevancy(cosines[:, :1]), cosines[:, 0])


def test_a_teacher_of_other_views_is_refused(two_balls):
    scene, _, masks = two_balls
    teacher = teacher_of_objects(masks, [BOOK] * 8)
    with pytest.raises(ValueError, match="expected ids of 3 views, found 8"):
        Distill(QUICK).start(scene, cameras(3), teacher)
    small = teacher_of_objects([mask[:-1] for mask in masks], [BOOK] * 8)
    with pytest.raises(ValueError, match="expected 48x36 pixels in view 0 like its camera, found 48x35"):
        Distill(QUICK).start(scene, cameras(8), small)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"iterations": 0}, "iterations: expected at least 1"),
        ({"contrast_pool": 3}, r"contrast_pool: expected one of \(1, 2, 4, 8\), found 3"),
        ({"contrast_after": 1.5}, "contrast_after: expected at least 0 and at most 1"),
    ],
)
def test_settings_out_of_range_are_refused(change, message):
    with pytest.raises(ValueError, match=message):
        replace(QUICK, **change)


def test_votes_are_the_light_that_gaussians_send_to_labels(two_balls):
    scene, _, masks = two_balls
    view, plan = frozen_views(scene, cameras(8))[0]
    ids, voted = masks[0], jax.jit(label_votes, static_argnums=3)
    votes = np.zeros((scene.num, 3))
    np.add.at(votes, np.asarray(view.rows), np.asarray(voted(view, plan, ids, 3)))
    # The contribution of single Gaussians to the image.
    for row in (3, 90, 150):
        alone = np.float32(np.arange(scene.num) == row)[:, None]
        own = np.asarray(painted(view, alone, plan)[0])[..., 0]
        for label in range(3):
            np.testing.assert_allclose(votes[row, label], own[ids == label].sum(), atol=1e-4)
    none = np.asarray(voted(view, plan, np.full_like(ids, -1), 3))
    assert not none.any()


def test_a_majority_of_true_masks_is_the_truth(two_balls):
    scene, labels, masks = two_balls
    found, votes = voted_labels(frozen_views(scene, cameras(8)), masks, 3, scene.num)
    seen = votes > 0
    assert seen.mean() > 0.9
    assert (found[seen] == labels[seen]).mean() > 0.97


def test_pixels_features_are_what_their_cosines_are_of(problem, learned):
    given, _ = problem
    batch = given.views[0]
    parts = rendered_now(learned, batch.located, batch.view.rows)
    cosines, alphas = jax.device_get(pixels_now(learned, parts, batch.view, batch.plan, BOOK))
    y, x = np.unravel_index(alphas.argmax(), alphas.shape)
    pixels = np.array([[x, y]], np.int32)
    features, there = jax.device_get(
        jax.jit(pixel_features)(learned, batch.located, batch.view, batch.plan, pixels)
    )
    np.testing.assert_allclose(there[0], alphas[y, x], rtol=1e-6)
    unit = features[0] / np.linalg.norm(features[0])
    np.testing.assert_allclose(unit @ BOOK.T, cosines[y, x], atol=1e-4)
