"""Whether a group is at its estimated pose, and where it is searched for if not."""

from dataclasses import replace

import equinox as eqx
import jax
import jax.numpy as jnp
import jaxlie
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from gsjax import track
from gsjax.geometry.cameras import camera_centers
from gsjax.methods.track import PRESETS, GrowConfig, RefineConfig, first_pose
from gsjax.methods.track.align import coarse_shifts
from gsjax.methods.track.layers import Shown
from gsjax.methods.track.lost import FOUND, LOST, group_confidence, is_found
from gsjax.methods.track.motion import facing
from gsjax.methods.track.points import Points, carry, pixels_of_groups, tone_images
from gsjax.methods.track.recover import (
    Relocation,
    SearchContext,
    depths_of_others,
    guesses_at,
    recover,
    relative_twists,
    unexplained_pixels,
)
from gsjax.methods.track.reference import (
    ReferencePoints,
    all_points_facing,
    points_facing,
    points_last_seen,
    radii,
    reference_points,
)
from gsjax.methods.track.stages.follow import in_search_round

CARTON, GAP = 2, 0.015
SIZE = {"width": 160, "height": 120}

# Compiled once for calls that differ in values alone.
confidence = jax.jit(group_confidence, static_argnums=2)
toned = jax.jit(tone_images, static_argnums=1)
picked = jax.jit(pixels_of_groups, static_argnums=(3, 4))
carried = jax.jit(jax.vmap(carry))
facing_at = jax.jit(points_facing)
last_seen = jax.jit(points_last_seen, static_argnums=3)
referred = jax.jit(reference_points, static_argnums=2)


@pytest.fixture(scope="module")
def carton(table):
    """(images, the points of the carton in them, as one group)."""
    sequence, frames, _ = table(8, 2, **SIZE)
    labels = np.stack([sequence.mask(6, c) for c in range(2)])
    images = toned(frames[6], 0.3)
    labels = np.where(labels == CARTON, 1, 0).astype(np.int32)
    return images, picked(images, labels, images.depths, 1, PRESETS["accurate"].align)


def moved(points: Points, *twist: float) -> Points:
    means, seen = np.asarray(points.means), np.asarray(points.seen)
    center = (means * seen[:, :, None]).sum((1, 3)) / seen.sum((1, 2))[:, None]
    return carried(points, np.float32([twist]), center)


def with_depth(images, depths):
    """The images with the measured depths replaced."""
    pixels = np.array(images.pixels)
    pixels[..., 3] = depths
    return images._replace(pixels=pixels)


@pytest.mark.thorough
def test_a_group_agrees_in_its_place_and_nowhere_else(carton):
    images, points = carton
    here = confidence(points, images, GAP)
    assert here.agreement[0] > 0.95
    assert here.coverage[0] > 0.95
    assert here.conclusive[0]
    for shift in ((0.06, 0.0, 0.0), (0.0, -0.06, 0.0), (0.0, 0.0, 0.06)):
        there = confidence(moved(points, *shift, 0, 0, 0), images, GAP)
        assert there.coverage[0] < FOUND, shift
    assert confidence(moved(points, 0, 0, 0.1, 0, 0, 0), images, GAP).agreement[0] < LOST


@pytest.mark.thorough
def test_an_occluder_is_inconclusive(carton):
    """If something occludes one camera, the other decides; if both are occluded, none does."""
    images, points = carton
    depths = np.array(images.depths)
    depths[0] = 0.2
    one = confidence(points, with_depth(images, depths), GAP)
    assert one.agreement[0] > 0.95
    assert one.conclusive[0]
    seen = np.asarray(points.seen)
    share = seen[0, 1].sum() / seen.sum()
    assert one.coverage[0] == pytest.approx(float(share * one.agreement[0]), rel=1e-3)
    away = confidence(moved(points, 3.0, 0, 0, 0, 0, 0), images, GAP)
    assert not away.conclusive[0]
    assert away.coverage[0] == 0
    both = confidence(points, with_depth(images, 0.2), GAP)
    assert not both.conclusive[0]
    assert both.coverage[0] == 0


def test_what_shows_the_background_does_not_show_the_group(carton):
    """A can placed on the front of a garage by mistake agrees with it in depth and nearly in colour."""
    images, points = carton
    usual = confidence(points, images, GAP)
    depths = np.asarray(images.depths)
    behind, unknown = np.where(depths > 0, depths + np.float32(0.05), 0), np.zeros_like(depths)
    for background in (behind, unknown, behind[:, ::2, ::2]):
        assert confidence(points, images, GAP, background).agreement[0] > 0.99 * usual.agreement[0]
    wall = depths + np.float32(GAP / 2)
    before_it = with_depth(images, wall)
    assert confidence(points, before_it, GAP).agreement[0] > 0.99 * usual.agreement[0]
    assert confidence(points, before_it, GAP, wall).agreement[0] == 0
    coarse = confidence(points, before_it, GAP, wall[:, ::2, ::2])
    assert coarse.agreement[0] < FOUND  # on a slope, the neighbouring pixel has another depth
    assert coarse.conclusive[0]


def test_a_card_on_a_table_is_not_lost(carton):
    """A flat object has nearly the depth of the surface on which it lies, so colour decides."""
    images, points = carton
    depths = np.asarray(images.depths)
    under = np.where(depths > 0, depths + np.float32(GAP / 5), 0)
    usual = confidence(points, images, GAP)
    assert confidence(points, images, GAP, under).agreement[0] == pytest.approx(float(usual.agreement[0]))
    other = images._replace(pixels=images.pixels + np.float32([0.5, 0.5, 0.5, 0]))
    assert confidence(points, other, GAP, under).agreement[0] < LOST
    of_others = confidence(points, images, GAP, None, under)  # the exemption is for the background alone
    assert of_others.agreement[0] < LOST
    nothing = np.zeros_like(under)
    assert confidence(points, images, GAP, None, nothing).agreement[0] == pytest.approx(
        float(usual.agreement[0])
    )


def test_a_suspect_is_searched_for_with_all_points_that_face_a_camera(table, started, quick):
    """At its estimated pose it may be occluded; for other groups, the points seen last are used."""
    _, frames, _ = table()
    pose, cameras, count = first_pose(started), frames[0].cameras, started.num_objects
    group = np.asarray(started.labels[: started.num_moving])
    config = replace(quick.align, centers=int(np.bincount(group).max()))
    reference = referred(started, pose, config)
    nothing = np.zeros((2, cameras.height, cameras.width), np.float32)
    unseen = Shown(nothing.astype(np.int32), nothing, nothing > 0)
    assert not np.asarray(last_seen(reference, unseen, cameras, GAP).seen).any()
    images = toned(frames[0], config.shading)
    still, origin = np.zeros((count, 6), np.float32), np.zeros((count, 3), np.float32)
    seen = np.asarray(jax.jit(all_points_facing)(reference, still, origin, images).seen)
    faces = np.asarray(jax.jit(facing)(started, pose, camera_centers(cameras.viewmat)))
    faces = faces[:, : started.num_moving] > 0.5
    for k in range(count):
        np.testing.assert_array_equal(seen[k].sum(-1), faces[:, group == k + 1].sum(-1))
    first = jax.tree.map(lambda a: np.asarray(a)[0], reference)
    around = facing_at(first, np.float32([0, 0, 0, 0, 0, np.pi]), np.float32([0.0, 0.0, 0.1]), images)
    assert (np.asarray(around.seen) != seen[0]).any()  # points that turned away no longer face a camera


def test_without_depth_colour_alone_decides(carton):
    images, points = carton
    images = images._replace(pixels=images.tones)
    assert confidence(points, images, GAP).agreement[0] > 0.95
    assert confidence(moved(points, 0.1, 0.1, 0, 0, 0, 0), images, GAP).agreement[0] < 0.6


def test_unexplained_pixels_are_nearer_than_the_model(carton):
    images, _ = carton
    depths = np.asarray(images.depths)
    model = jnp.full(depths.shape, 0.9)
    strange = (depths > 0) & (depths < 0.9 - GAP)
    assert 0 < strange.mean() < 1
    found = jax.jit(unexplained_pixels, static_argnums=(2, 3, 4))
    for labels, limit in ((0, 0.9 - GAP), (1, 0.8)):  # a group also explains depth that is slightly nearer
        shown = Shown(jnp.full(model.shape, labels, jnp.int32), model, model > 0)
        pixels = found(shown, images, GAP, replace(PRESETS["accurate"].align, max_thickness=0.1), 1)
        z = seen_depths(pixels.means, images)[np.asarray(pixels.seen) > 0]
        assert 0 < z.max() < limit
        nothing = found(shown._replace(covered=model < 0), images, GAP, PRESETS["accurate"].align, 1)
        assert not np.asarray(nothing.seen).any()


def seen_depths(means, images):
    """Depths of points in the camera to which they belong, metres."""
    viewmats = np.asarray(images.cameras.viewmat)
    return np.einsum("ci,cip->cp", viewmats[:, 2, :3], np.asarray(means)) + viewmats[:, 2, 3:]


@pytest.fixture(scope="module")
def one(table, started, quick):
    """(reference points of the carton, their centre, images of the first frame, the carton's pixels)."""
    sequence, (frame, *_), _ = table()
    reference = referred(started, first_pose(started), quick.align)
    mine = jax.tree.map(lambda a: np.asarray(a)[started.label_ids.index(CARTON) - 1], reference)
    center = (mine.means * mine.real).sum(-1) / np.float32(mine.real.sum())
    shown = np.stack([sequence.mask(0, c) == CARTON for c in range(2)])
    return mine, center, toned(frame, quick.align.shading), shown


def strangers_of(images, strange) -> Points:
    found = picked(images, strange.astype(np.int32), images.depths, 1, PRESETS["accurate"].align)
    return jax.tree.map(lambda a: np.asarray(a)[0], found)


@pytest.mark.thorough
def test_guesses_bring_points_to_unexplained_pixels(one):
    reference, center, images, shown = one
    config = PRESETS["accurate"].align
    unexplained, shifts = strangers_of(images, shown), np.asarray(coarse_shifts(config, images))
    guesses, around = jax.jit(guesses_at, static_argnums=5), len(shifts)

    def draw(seed, unexplained=unexplained, config=config):
        return np.asarray(guesses(jax.random.key(seed), shifts, reference, center, unexplained, config))

    drawn = [draw(0), draw(0), draw(1)]
    np.testing.assert_array_equal(drawn[0], drawn[1])
    assert np.abs(drawn[0] - drawn[2]).max() > 0.1
    np.testing.assert_array_equal(drawn[0][:around, :3], shifts[:, :3])
    places = unexplained.means.transpose(0, 2, 1)[unexplained.seen > 0]
    for twist in drawn[0][around : around + 20]:
        reached = np.asarray(facing_at(reference, twist, center, images).means)[0].T[reference.real]
        assert np.linalg.norm(reached[:, None] - places, axis=-1).min() < 1e-5
    nowhere = unexplained._replace(seen=np.zeros_like(unexplained.seen))
    np.testing.assert_array_equal(draw(0, nowhere)[around : 2 * around, :3], shifts[:, :3])
    np.testing.assert_array_equal(draw(0, config=replace(config, max_turn=0.0))[:, 3:], 0)


@pytest.mark.thorough
def test_a_lost_group_is_recovered_over_frames_but_not_at_another_object(one):
    """From 15 cm and 57 degrees off; in each frame the search continues from the last guess."""
    reference, center, images, shown = one
    off = np.float32([0.1, -0.1, 0.05, 0.0, 0.0, 1.0])

    @jax.jit
    def moved_off(reference, off, center):
        return reference._replace(
            means=carry(Points(reference.means, reference.tones, reference.real), off, center).means,
            normals=jnp.einsum("ij,jp->ip", jaxlie.SO3.exp(off[3:]).as_matrix(), reference.normals),
        )

    lost = moved_off(reference, off, center)
    others, config = np.where(shown, np.float32(0), images.depths), PRESETS["accurate"].align
    unexplained = strangers_of(images, shown)
    look = jax.jit(
        lambda seed, guess, around: recover(
            jax.random.key(seed), lost, jnp.asarray(center + off[:3]), guess, around, config, GAP
        )
    )

    def after(frames, others, start=0 * off):
        found = Relocation(start, None, None)
        for seed in range(frames):
            found = look(seed, found.twists, SearchContext(images, None, others, unexplained))
        return found

    found = after(8, others)
    back = np.asarray(facing_at(lost, found.twists, center + off[:3], images).means)[0]
    assert np.linalg.norm(back - reference.means, axis=0)[reference.real].max() < 0.01
    showed = confidence(
        jax.tree.map(lambda a: a[None], facing_at(reference, 0 * off, center, images)), images, GAP
    ).coverage
    assert is_found(jax.tree.map(lambda a: a[None], found.confidence), showed)[0]
    assert is_found(jax.tree.map(lambda a: a[None], found.guess_confidence), showed)[0]
    first = after(1, others)  # after one frame, the guess is still wrong
    assert not is_found(jax.tree.map(lambda a: a[None], first.guess_confidence), showed)[0]
    for explained, there in ((np.zeros_like(others), True), (images.depths, False)):
        from_there = after(1, explained, found.twists)  # not found where other groups explain all depth
        assert is_found(jax.tree.map(lambda a: a[None], from_there.confidence), showed)[0] == there


@given(st.integers(0, 2**31))
def test_relative_twists_lead_to_the_same_place(seed):
    rng = np.random.default_rng(seed)
    again, there = by_two_ways(
        np.float32(0.8 * rng.normal(size=(2, 6))), np.float32(rng.normal(size=(1, 3, 5)))
    )
    np.testing.assert_allclose(again, there, atol=1e-4)


@jax.jit
def by_two_ways(twists, means):
    points = Points(means, jnp.zeros((1, 3, 5)), jnp.ones((1, 5)))
    center = jnp.array([0.3, -0.2, 0.5])
    there = carry(points, twists[0], center).means
    moved = carry(points, twists[1], center)
    return carry(moved, relative_twists(twists[0], twists[1]), center + twists[1, :3]).means, there


def test_radii_ignore_padding():
    means = np.zeros((2, 3, 4), np.float32)
    means[0, 0], means[1, 2, 0] = [3.0, 5.0, 1.0, 9.0], 7.0
    real = np.array([[True, True, False, False], [False] * 4])
    reference = ReferencePoints(means, means, means, real)
    found = jax.jit(radii)(reference, np.float32([[4.0, 2.0, 0.0], [0.0, 0.0, 0.0]]))
    np.testing.assert_allclose(found, [5**0.5, 0.0], rtol=1e-6)


def test_depths_of_others_are_those_of_groups_not_in_doubt(carton):
    images, _ = carton
    labels = np.zeros(images.depths.shape, np.int32)
    labels[0, 0, :3] = [0, 1, 2]
    shown = Shown(labels, np.full(labels.shape, 0.7, np.float32), labels > 0)
    found = jax.jit(depths_of_others)(shown, np.array([False, True]))
    np.testing.assert_allclose(np.asarray(found)[0, 0, :3], [0.0, 0.7, 0.0])


@pytest.mark.thorough
def test_groups_in_doubt_take_turns_of_two_frames_in_a_row():
    turns = np.array([in_search_round(jnp.int32(count), 3) for count in range(8)])
    np.testing.assert_array_equal(turns[:, 0], [True, True, False, False] * 2)
    np.testing.assert_array_equal(turns[:, 1], ~turns[:, 0])
    np.testing.assert_array_equal(turns[:, 2], turns[:, 0])


@pytest.mark.parametrize("redraw", ["moving", "all"])
@pytest.mark.slow
def test_an_object_that_is_elsewhere_is_reported_lost_until_it_is_found(table, started, quick, redraw):
    """In the scene, the carton is 12 cm off, which is out of reach of a search from there."""
    _, frames, _ = table()
    config = replace(
        quick, redraw=redraw, matching=False, refine=RefineConfig(iterations=0), grow=GrowConfig(slots=0)
    )
    group = started.label_ids.index(CARTON)
    mine = np.asarray(started.labels) == group
    away = np.where(mine[:, None], [0.0, 0.12, 0.0], 0.0)
    wrong = eqx.tree_at(lambda s: s.gaussians.means, started, started.gaussians.means + away)
    true = np.asarray(started.gaussians.means)[mine].mean(0)
    for update in track(wrong, frames[0], [frames[0]] * 15, config):
        lost = np.asarray(update.info["lost"])
        place = np.asarray(update.result.pose.means)[mine[: started.num_moving]].mean(0)
        is_there = np.linalg.norm(place - true) < 0.01
        assert is_there or lost[group - 1]
    assert is_there
    assert not lost.any()


@pytest.mark.slow
def test_without_depth_a_vanished_object_is_reported_lost_and_stays(table, started, quick):
    """Colour tells that it is gone, but without depth there are no other places to search."""
    sequence, frames, _ = table()
    config = replace(
        quick, redraw="moving", matching=False, refine=RefineConfig(iterations=0), grow=GrowConfig(slots=0)
    )
    config = replace(config, align=replace(config.align, iterations=1, everywhere=1))
    gone = np.stack([sequence.mask(0, c) == CARTON for c in range(2)])[..., None]
    first = replace(frames[0], depths=None)
    without = replace(first, images=jnp.where(gone, jnp.array([0.0, 0.1, 1.0]), first.images))
    updates = list(track(started, first, [first, without, without], config))
    group = started.label_ids.index(CARTON)
    assert [bool(u.info["lost"][group - 1]) for u in updates] == [False, True, True]
    mine = np.asarray(started.labels[: started.num_moving]) == group
    before, after = (
        np.asarray(p.means)[mine].mean(0) for p in (first_pose(started), updates[-1].result.pose)
    )
    assert np.linalg.norm(after - before) < 0.05
