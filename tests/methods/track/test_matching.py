"""Template matching: the score follows its formula, peaks are sub-pixel, and several cameras yield one
translation."""

import jax.numpy as jnp
import numpy as np
import pytest

from gsjax.geometry.cameras import Camera, intrinsics, look_at, project
from gsjax.methods.track.config import MatchConfig
from gsjax.methods.track.matching import Template, TemplateMatch, correlate, lift, match_templates
from gsjax.scene.frame import Frame

WIDTH, HEIGHT = 64, 48
CONFIG = MatchConfig(patch=20, radius=8)
EYES = ([0.9, -0.3, 0.6], [0.2, 0.9, 0.7])


def slow_correlation(template, mask, search):
    """The formula in the module's docstring, evaluated position by position."""
    patch, places = len(template), len(search) - len(template) + 1
    m, total = mask[..., None], mask.sum()
    centred = template - (m * template).sum((0, 1)) / total
    scores = np.zeros((places, places))
    for y in range(places):
        for x in range(places):
            window = search[y : y + patch, x : x + patch]
            contrast = (m * window**2).sum() - ((m * window).sum((0, 1)) ** 2).sum() / total
            scores[y, x] = (m * centred * window).sum() / np.sqrt((m * centred**2).sum() * contrast)
    return scores


def correlation(template, mask, search):
    return np.asarray(correlate(*(jnp.asarray(a, jnp.float32) for a in (template, mask, search))))


@pytest.fixture(scope="module")
def patches():
    rng = np.random.default_rng(0)
    search = rng.uniform(size=(15, 15, 3))
    template = search[3:11, 5:13] + 0.02 * rng.normal(size=(8, 8, 3))
    return template, rng.uniform(size=(8, 8)) * (rng.uniform(size=(8, 8)) > 0.3), search


@pytest.mark.thorough
def test_the_score_is_the_formula(patches):
    np.testing.assert_allclose(correlation(*patches), slow_correlation(*patches), atol=2e-3)
    assert np.unravel_index(correlation(*patches).argmax(), (8, 8)) == (3, 5)


def test_gain_and_offset_of_the_image_hardly_matter(patches):
    template, mask, search = patches
    changed = correlation(template, mask, 0.6 * search + np.array([0.1, 0.3, 0.2]))
    np.testing.assert_allclose(changed, correlation(*patches), atol=5e-3)


def test_what_lies_outside_the_mask_does_not_matter(patches):
    template, mask, search = patches
    painted = np.where(mask[..., None] > 0, template, 5.0)
    np.testing.assert_allclose(correlation(painted, mask, search), correlation(*patches), atol=1e-4)


def test_patches_without_contrast_score_nothing(patches):
    template, mask, search = patches
    assert np.abs(correlation(template, mask, np.full_like(search, 0.4))).max() < 1e-2
    assert np.isfinite(correlation(template, 0 * mask, search)).all()


def blob(center, color=(1.0, 0.6, 0.2), sigma=3.0):
    x, y = np.arange(WIDTH) + 0.5, np.arange(HEIGHT)[:, None] + 0.5
    value = np.exp(-0.5 * ((x - center[0]) ** 2 + (y - center[1]) ** 2) / sigma**2)
    return (0.1 + 0.8 * value[..., None] * np.array(color)).astype(np.float32), value


def cameras(count: int) -> Camera:
    viewmats = [look_at(np.array(eye), np.zeros(3)) for eye in EYES[:count]]
    K = jnp.asarray(intrinsics(60.0, WIDTH, HEIGHT), jnp.float32)
    return Camera(jnp.asarray(np.array(viewmats), jnp.float32), jnp.stack([K] * count), WIDTH, HEIGHT)


def frame(images=None, depths=None, count=1) -> Frame:
    images = jnp.zeros((count, HEIGHT, WIDTH, 3)) if images is None else jnp.asarray(images)
    return Frame(images, None if depths is None else jnp.asarray(depths, jnp.float32), cameras(count))


@pytest.mark.thorough
@pytest.mark.parametrize("shift", [(0.0, 0.0), (3.3, -2.4), (-5.25, 4.5)])
def test_the_peak_of_a_shifted_blob_is_sub_pixel(shift):
    start = np.array([31.0, 25.0])
    color, value = blob(start)
    image, _ = blob(start + shift)
    depths = np.full((1, HEIGHT, WIDTH), 1.1, np.float32)
    template = Template(
        jnp.asarray(color)[None],
        jnp.asarray(depths),
        jnp.asarray(value > 0.1, jnp.float32)[None, ..., None],
    )
    match = match_templates(
        template,
        frame(image[None], depths + 0.02),
        CONFIG,
    )
    np.testing.assert_allclose(match.shift[0, 0], shift, atol=0.1)
    np.testing.assert_allclose(match.origin[0, 0], start, atol=0.1)
    np.testing.assert_allclose(match.depth_change[0, 0], 0.02, atol=1e-4)
    assert match.measured[0, 0]
    assert match.score[0, 0] > 0.98


@pytest.mark.thorough
def test_an_object_that_no_pixel_shows_is_not_found():
    color, _ = blob((30.0, 20.0))
    nothing = jnp.zeros((1, HEIGHT, WIDTH, 1))
    now = frame(color[None])
    match = match_templates(
        Template(jnp.asarray(color)[None], jnp.ones((1, HEIGHT, WIDTH)), nothing), now, CONFIG
    )
    move, found = lift(match, now, CONFIG)
    assert match.score[0, 0] == 0
    assert not found[0]
    np.testing.assert_allclose(move, 0, atol=1e-6)


START = np.array([[0.02, -0.01, 0.03]])


def seen_to_move(moves, measured: bool, score=0.9) -> tuple[TemplateMatch, Frame]:
    """What a perfect matcher reports when camera c sees START move by `moves[c]`."""
    count = len(moves)
    views = cameras(count)
    before, after = [], []
    for c, move in enumerate(moves):
        before.append(project(jnp.asarray(START, jnp.float32), views.viewmat[c], views.K[c]))
        after.append(project(jnp.asarray(START + move, jnp.float32), views.viewmat[c], views.K[c]))
    origin, depth = (jnp.stack(a) for a in zip(*before, strict=True))
    place, new_depth = (jnp.stack(a) for a in zip(*after, strict=True))
    scores = jnp.broadcast_to(jnp.asarray(score), (count,))[:, None]
    match = TemplateMatch(
        score=scores,
        shift=place - origin,
        origin=origin,
        depth=depth,
        depth_change=jnp.where(measured, new_depth - depth, 0.0),
        measured=jnp.full((count, 1), measured),
    )
    return match, frame(count=count)


MOVE = np.array([0.02, 0.03, -0.015])


@pytest.mark.thorough
@pytest.mark.parametrize(("count", "measured"), [(1, True), (2, True), (2, False)])
def test_one_camera_with_depth_or_two_without_fix_the_translation(count, measured):
    move, found = lift(*seen_to_move([MOVE] * count, measured), CONFIG)
    assert found[0]
    np.testing.assert_allclose(move[0], MOVE, atol=1e-3)


def test_one_camera_without_depth_moves_the_object_across_its_image_only():
    match, now = seen_to_move([MOVE], measured=False)
    move, _ = lift(match, now, CONFIG)
    there = jnp.asarray(START + np.asarray(move), jnp.float32)
    place, _ = project(there, now.cameras.viewmat[0], now.cameras.K[0])
    np.testing.assert_allclose(place[0], match.origin[0, 0] + match.shift[0, 0], atol=0.1)
    ray = START[0] + MOVE - np.array(EYES[0])
    assert abs(np.dot(move[0], ray / np.linalg.norm(ray))) < 1e-3


def test_of_cameras_that_disagree_the_best_is_believed():
    wrong = np.array([-0.12, 0.1, 0.1])
    move, _ = lift(*seen_to_move([wrong, MOVE], True, jnp.array([0.6, 0.9])), CONFIG)
    np.testing.assert_allclose(move[0], MOVE, atol=1e-3)


def test_how_far_cameras_may_disagree_does_not_depend_on_their_scores():
    wrong = MOVE + np.array([0.1, 0.0, 0.0])
    move, _ = lift(*seen_to_move([wrong, MOVE], True, jnp.array([0.35, 0.4])), CONFIG)
    np.testing.assert_allclose(move[0], MOVE, atol=2e-3)


def test_a_poor_match_moves_nothing():
    match, now = seen_to_move([MOVE], True, score=0.2)
    assert not lift(match, now, CONFIG)[1][0]


@pytest.mark.parametrize("blind", [0, 1])
def test_a_camera_that_does_not_see_the_object_does_not_spoil_the_others(blind):
    match, now = seen_to_move([MOVE, MOVE], True)
    unseen = {"score": 0.0, "depth": 0.0, "depth_change": 0.0, "measured": False, "origin": 0.0, "shift": 0.0}
    match = match._replace(**{name: getattr(match, name).at[blind].set(v) for name, v in unseen.items()})
    move, found = lift(match, now, CONFIG)
    assert found[0]
    np.testing.assert_allclose(move[0], MOVE, atol=1e-3)


@pytest.mark.thorough
def test_what_the_picture_does_not_show_of_a_template_does_not_count():
    """A blob has moved along the border; with replicated border pixels, it would seem to stand still."""
    start, shift = np.array([1.0, 20.0]), np.array([0.0, 5.0])
    (color, value), (image, _) = blob(start), blob(start + shift)
    depths = jnp.full((1, HEIGHT, WIDTH), 1.1)
    weights = jnp.asarray(value > 0.1, jnp.float32)[None, ..., None]
    match = match_templates(Template(jnp.asarray(color)[None], depths, weights), frame(image[None]), CONFIG)
    np.testing.assert_allclose(match.shift[0, 0], shift, atol=0.3)
