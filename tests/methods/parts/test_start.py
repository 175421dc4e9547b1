"""From pictures to pieces: the anchor, changed pixels, masks in all views, lifted labels, weights."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from gsjax.geometry.cameras import Camera, intrinsics
from gsjax.methods.parts.anchor import Anchor, choose_anchor, difference_image, moved_pixels
from gsjax.methods.parts.config import DiscoverConfig, PartsConfig
from gsjax.methods.parts.discover import begin
from gsjax.methods.parts.lift import label_votes, lift_masks, pixel_votes, render_features
from gsjax.methods.parts.masks import (
    masks_from_labels,
    moving_segments,
    propagate_masks,
    view_order,
)
from gsjax.methods.parts.sizes import coarse_factor, pixel_width
from gsjax.methods.parts.stream import skinning_weights
from gsjax.methods.parts.weights import fit_field_to_weights, new_field, weights_of
from gsjax.scene.feature_grid import FeatureGridConfig
from gsjax.scene.frame import one_camera
from gsjax.scene.render import plan_render
from tests.methods.parts.moving_boxes import Box, MovingBoxes, linear

FRAMES = 5


def pictures(at, noise=0.0, size=48):
    """load(t, c) -> a picture of a square at column at[t] on grey, with noise."""

    def load(t, c):
        rng = np.random.default_rng((t, c))
        picture = np.full((size, size, 3), 90.0)
        picture[10:26, at[t] : at[t] + 16] = (220, 40, 40)
        return np.clip(picture + rng.normal(0, 255 * noise, picture.shape), 0, 255).astype(np.uint8)

    return load


@pytest.fixture(scope="module")
def boxes():
    first = Box(
        (-0.12, 0.0, 0.05), (0.12, 0.08, 0.1), linear(FRAMES, (0, 0, 0.4)), linear(FRAMES, (0, 0.1, 0))
    )
    second = Box(
        (0.14, -0.02, 0.04), (0.08, 0.1, 0.08), linear(FRAMES, (0, 0, 0)), linear(FRAMES, (0, -0.1, 0))
    )
    return MovingBoxes([first, second])


def test_the_anchor_differs_most_from_all_others():
    at = [0, 2, 4, 6, 30]
    anchor = choose_anchor(pictures(at), 5, 2)
    assert (anchor.frame, anchor.farthest) == (4, 0)
    assert anchor.differences[4] == 0
    with pytest.warns(UserWarning, match="anchor"):
        assert choose_anchor(pictures(at), 5, 2, 0).frame == 0


def test_a_poor_anchor_is_warned_about():
    """The square moves only in the last frame, so frame 0 differs from few of the others."""
    at = [4, 4, 4, 4, 4, 30]
    with pytest.warns(UserWarning, match="anchor: frame 0 differs from the others by .* frame 5 by"):
        choose_anchor(pictures(at), 6, 1, 0)


def test_anchors_that_cannot_be():
    with pytest.raises(
        ValueError, match="frames: expected at least 2, between which something moves, found 1"
    ):
        choose_anchor(pictures([0]), 1, 1)
    with pytest.raises(ValueError, match="anchor: expected a frame from 0 to 1, found 2"):
        choose_anchor(pictures([0, 9]), 2, 1, 2)


@pytest.mark.parametrize("noise", [0.0, 0.02])
def test_what_changed_is_where_it_is_and_where_it_goes(noise):
    load = pictures([0, 8, 24], noise)
    anchor = choose_anchor(load, 3, 1, 0)
    moved = moved_pixels(load, anchor, 1)[0].any(0)
    assert moved[12:24, 18:38].all()
    assert moved[12:24, 2:14].all()
    assert moved[40:].mean() < 0.01
    pair = moved_pixels(load, anchor._replace(farthest=1), 1, frames=1)[0, 0]
    assert pair[12:24, 18:22].all()
    assert pair[12:24, 30:38].mean() < 0.01


@pytest.mark.parametrize("width", [96, 1280])
def test_noise_is_no_motion_at_any_size(width):
    def load(t, c):
        rng = np.random.default_rng(t)
        return np.clip(rng.normal(128, 0.1 * 255, (width * 9 // 16, width, 3)), 0, 255).astype(np.uint8)

    anchor = Anchor(1, 0, np.ones(3))
    with pytest.raises(ValueError, match="expected something that moves"):
        moved_pixels(load, anchor, 1)


def test_a_difference_is_that_of_colours():
    a, b = np.zeros((2, 2, 3)), np.ones((2, 2, 3))
    np.testing.assert_allclose(difference_image(a, b), 1.0)


def test_segments_count_by_the_share_that_changed():
    segments = np.repeat([0, 1, 2, 4], 10)[None]
    moved = np.zeros((1, 40), bool)
    moved[0, :10] = moved[0, 10:12] = moved[0, 20:24] = True
    np.testing.assert_array_equal(np.unique(moving_segments(segments, moved)), [0, 2])


def test_labels_of_all_views_count_by_what_changed_in_all():
    """Label 1 is the largest; a label counts if enough of its pixels changed over all views together."""
    labels = np.array([[[7, 7, 7, 7], [3, 3, 5, -1]], [[7, 7, 5, 5], [5, 5, 5, 3]]])
    moved = labels == 7
    moved[0, 1, :2] = True  # two of three pixels of 3, none of 5
    np.testing.assert_array_equal(
        masks_from_labels(labels, moved, 9), [[[1, 1, 1, 1], [2, 2, 0, 0]], [[1, 1, 0, 0], [0, 0, 0, 2]]]
    )
    np.testing.assert_array_equal(masks_from_labels(labels, moved, 1), labels == 7)
    assert not masks_from_labels(labels, np.zeros_like(moved), 9).any()


def test_views_are_taken_around():
    angles = np.deg2rad([0, 180, 40, 300, 80, 130])
    centers = np.stack([np.cos(angles), np.sin(angles), np.ones(6)], -1)
    viewmats = np.tile(np.eye(4), (6, 1, 1))
    viewmats[:, :3, 3] = -centers
    order = view_order(viewmats, 0, np.zeros(3))
    assert order[:2] == [0, 2]
    assert sorted(order) == list(range(6))
    assert order[order.index(1) - 1] == 5  # from 130 to 180 degrees, not from 300


def test_numbers_pass_from_view_to_view():
    """A segment that the previous view shows keeps its number there; the others get new ones."""
    segments = {0: np.repeat([1, 2, 0], 4)[None], 1: np.repeat([3, 0, 1, 2], 3)[None]}
    pictures = [np.full((1, 12, 3), c) for c in range(2)]

    def known(c, last, mask):
        assert (c, last) == (1, 0)
        return np.where(np.arange(12) < 3, mask[0, 4], -1)[None]

    moved = np.ones((2, 1, 12), bool)
    geometry = np.zeros((2, 1, 12)), np.tile(np.eye(3), (2, 1, 1))

    def segmenter(picture, depth, K):
        return segments[picture[0, 0, 0]]

    masks = propagate_masks(pictures, *geometry, moved, [0, 1], segmenter, known, 4, 9)
    assert masks[1, 0, 0] == masks[0, 0, 4] > 0
    assert len(set(masks[1, 0].tolist()) - {0}) == 3
    assert masks.max() == 4
    few = propagate_masks(pictures, *geometry, moved, [0, 1], segmenter, known, 2, 9)
    assert few.max() == 2  # only the two largest remain
    assert few[1, 0, 0] == few[0, 0, 4] == 1
    assert (masks[1, 0, 3:6] == 0).all()


@pytest.mark.thorough
def test_masks_are_lifted_to_what_shows_them(boxes):
    masks = boxes.masks(boxes.bodies)
    plan = plan_render(boxes.gaussians, boxes.cameras, headroom=1.3)
    logits, losses = lift_masks(boxes.gaussians, boxes.cameras, plan, masks, 4, iterations=9)
    seen = label_votes(boxes.gaussians, boxes.cameras, plan, masks, 4).sum(-1) > 0.2
    found = np.asarray(logits).argmax(-1)
    assert (found == boxes.bodies)[seen].mean() > 0.93
    assert (found != 3).all()
    assert losses[-3:].mean() < losses[:3].mean()


@pytest.mark.thorough
def test_votes_are_shares_of_pixels(boxes):
    plan = plan_render(boxes.gaussians, boxes.cameras, headroom=1.3)
    masks = boxes.masks(boxes.bodies)
    total = label_votes(boxes.gaussians, boxes.cameras, plan, masks, 3)
    assert (total >= 0).all()
    pixels = masks.size  # a pixel gives at most one vote in total
    assert 0.2 * pixels < total.sum() <= pixels * (1 + 1e-5)


@pytest.mark.thorough
def test_many_labels_are_voted_for_and_drawn_like_few(boxes):
    plan = plan_render(boxes.gaussians, boxes.cameras, headroom=1.3)
    view, count = one_camera(boxes.cameras, 0), 70  # more than are rendered at once
    labels = np.random.default_rng(0).integers(-1, count, boxes.masks(boxes.bodies).shape[1:])
    votes = label_votes(boxes.gaussians, view, plan, labels[None], count)
    for some in (np.arange(3), np.arange(60, 70)):
        values = (labels[None, ..., None] == some).astype(np.float32)
        np.testing.assert_allclose(
            votes[:, some], pixel_votes(boxes.gaussians, view, plan, values), atol=1e-6
        )
    features = np.random.default_rng(1).random((boxes.gaussians.num, count), np.float32)
    drawn = render_features(boxes.gaussians, view, plan, features)
    values = np.random.default_rng(2).random(drawn.shape, np.float32)
    there = (pixel_votes(boxes.gaussians, view, plan, values) * features).sum()
    assert there == pytest.approx((drawn * values).sum(), rel=1e-4)  # they are adjoint
    assert not label_votes(boxes.gaussians, view, plan, np.full_like(labels, -1)[None], 3).any()


@pytest.mark.parametrize(
    ("width", "height", "factor"),
    [(64, 48, 2), (160, 120, 2), (320, 180, 2), (320, 240, 2), (640, 360, 4), (640, 480, 4), (1920, 1080, 8)],
)
def test_larger_pictures_are_followed_at_the_same_size(width, height, factor):
    camera = Camera(np.eye(4)[None], intrinsics(60, width, height)[None], width, height)
    assert coarse_factor(width, height) == factor
    if factor == 2:
        return
    small = Camera(camera.viewmat, camera.K.copy(), 2 * width // factor, 2 * height // factor)
    small.K[:, :2] *= 2 / factor
    points = np.array([[0.0, 0.0, 2.0]])
    assert pixel_width(points, camera) == pytest.approx(pixel_width(points, small))


@pytest.mark.parametrize("kind", ["grid", "table", "simplex"])
def test_a_field_has_weights_of_living_parts_only(kind):
    rng = np.random.default_rng(0)
    means = jnp.asarray(rng.uniform(-1, 1, (200, 3)), jnp.float32)
    wanted = jnp.asarray(np.eye(4)[(np.asarray(means)[:, 0] > 0).astype(int)], jnp.float32)
    alive = jnp.array([True, True, False, False])
    config = PartsConfig(weights=kind, grid=FeatureGridConfig(4, 4, 16, 10, 2, 16))
    field, located = new_field(jax.random.key(0), config, means, 4)
    field, losses = fit_field_to_weights(field, located, wanted, alive, 60)
    if kind == "grid":
        assert losses[-1] < 0.1 * losses[0]
    found = np.asarray(jax.jit(weights_of)(field, located, alive))
    np.testing.assert_allclose(found.sum(-1), 1, rtol=1e-5)
    assert (found[:, 2:] == 0).all()
    assert (found.argmax(-1) == np.asarray(wanted).argmax(-1)).mean() > 0.97


@pytest.mark.thorough
def test_a_pixel_is_as_wide_as_depth_over_focal_length(boxes):
    middle = np.array([[0.0, 0.0, 0.03]])
    eyes = np.linalg.inv(np.asarray(boxes.cameras.viewmat))[:, :3, 3]
    away = np.linalg.norm(eyes - middle, axis=1)
    assert pixel_width(middle, boxes.cameras) == pytest.approx(np.median(away) / (0.95 * 64), rel=1e-4)


@pytest.mark.thorough
def test_a_start_knows_its_pieces(boxes):
    config = PartsConfig(
        discover=DiscoverConfig(most_parts=3, lift_iterations=6), grid=FeatureGridConfig(4, 4, 32, 10, 2, 16)
    )
    anchor = choose_anchor(boxes.image, FRAMES, 3, 0)
    masks = boxes.masks(boxes.bodies)
    moved = moved_pixels(boxes.image, anchor, 3)
    start = begin(boxes, boxes.gaussians, anchor, moved, config, None, jax.random.key(0), masks)
    order, count = start.order, start.canonical.movable.num
    np.testing.assert_array_equal(np.sort(order), np.arange(boxes.gaussians.num))
    means = np.concatenate([start.canonical.movable.means, start.canonical.fixed.means])
    np.testing.assert_array_equal(means, np.asarray(boxes.gaussians.means)[order])
    assert start.canonical.alive.tolist() == [True, True, True, False]
    weights = np.asarray(jax.jit(skinning_weights)(start.field, start.canonical))
    np.testing.assert_allclose(weights.sum(-1), 1, rtol=1e-5)
    assert (weights[:, 3] == 0).all()
    bodies = boxes.bodies[order[:count]]
    assert (weights.argmax(-1) == bodies)[bodies > 0].mean() > 0.85
    assert np.isin(np.flatnonzero(boxes.bodies > 0), order[:count]).mean() > 0.97
    for part in (1, 2):
        middle = np.asarray(boxes.gaussians.means)[boxes.bodies == part].mean(0)
        assert np.linalg.norm(start.canonical.centers[part] - middle) < 0.02
    # The neighbours of a Gaussian are nearby, and it is none of them.
    near = means[np.asarray(start.canonical.neighbors)] - means[:count, None]
    assert np.linalg.norm(near, axis=-1).max() < 0.08
    assert (np.asarray(start.canonical.neighbors) != np.arange(count)[:, None]).all()


@pytest.mark.thorough
def test_one_camera_and_stillness_are_refused(boxes):
    anchor = choose_anchor(boxes.image, FRAMES, 3, 0)
    one = MovingBoxes(boxes.boxes, cameras=1)
    moved = moved_pixels(boxes.image, anchor, 1)
    with pytest.raises(ValueError, match="cameras: expected at least 2, synchronised, found 1"):
        begin(one, one.gaussians, anchor, moved, PartsConfig(), None, jax.random.key(0))
    two = MovingBoxes(boxes.boxes, cameras=2)
    with pytest.raises(ValueError, match="segmenter, masks: expected one of them, found none"):
        begin(two, two.gaussians, anchor, np.repeat(moved, 2, 0), PartsConfig(), None, jax.random.key(0))
    load = pictures([3, 3, 3])
    with pytest.raises(
        ValueError, match=r"expected something that moves, found 0.000% of the pixels of frame 0"
    ):
        moved_pixels(load, choose_anchor(load, 3, 1), 1)
