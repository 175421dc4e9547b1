"""Edits do what they say, change nothing else, and compose like functions."""

from functools import reduce

import equinox as eqx
import jax
import jax.numpy as jnp
import jaxlie
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from gsjax.geometry.joints import Joint, fit_joint
from gsjax.methods.parts import edits
from gsjax.methods.parts.trajectory import gaussians_at, moment, still
from tests.methods.parts.made_up_parts import (
    CENTERS,
    STEP,
    TIMES,
    assert_same,
    hinge,
    jointed,
    motions,
    rows,
    scene_of,
    trajectory,
    whole,
)

seeds = st.integers(0, 10_000)
seen = jax.jit(lambda scene, film, t: gaussians_at(scene, moment(film, t)))
ALL = range(4)
TURN, ARM = jnp.array([0.3, -0.2, 0.5]), jnp.array([0.1, 0.2, -0.3])
LID = hinge([0.0, 0.1, 0.25, 0.5, 0.75, 1.0, 1.1, 1.2, 1.25], axis=(1.0, 0.0, 0.0), point=(0.3, -0.2, 0.1))
DRAWER = Joint("prismatic", np.array([0.0, 1.0, 0.0]), np.zeros(3), 0.4 * TIMES**2)
STILL = hinge(np.zeros(9))

TIME_EDITS = {
    "speed": lambda t, parts: edits.speed(t, parts, 2.0),
    "slower": lambda t, parts: edits.speed(t, parts, 0.3, begin=0.2),
    "backwards": lambda t, parts: edits.speed(t, parts, -1.0, begin=0.25, end=0.75),
    "loop": lambda t, parts: edits.loop(t, parts, 0.125, 0.5),
    "bounce": lambda t, parts: edits.loop(t, parts, 0.25, 0.5, times=1, bounce=True),
    "freeze": lambda t, parts: edits.freeze(t, parts, at=0.5),
    "pause": lambda t, parts: edits.freeze(t, parts, begin=0.3, end=0.6),
}
LOOK_EDITS = {
    "move": lambda t, parts: edits.move(t, parts, jnp.array([0.1, 0.3, -0.2])),
    "rotate": lambda t, parts: edits.rotate(t, parts, TURN, ARM),
    "redirect": lambda t, parts: edits.redirect(t, parts, TURN, at=0.5),
    "amplify": lambda t, parts: edits.amplify(t, parts, 1.5),
    "scale": lambda t, parts: edits.scale(t, parts, 0.5),
    "fade": lambda t, parts: edits.fade(t, parts, 0.3),
}
EDITS = TIME_EDITS | LOOK_EDITS


@pytest.mark.parametrize("edit", EDITS.values(), ids=EDITS)
class TestEveryEdit:
    @pytest.mark.thorough
    def test_changes_its_parts_and_leaves_the_others_to_the_bit(self, edit):
        before = trajectory(1)
        after = edit(before, [1, 3])
        assert_same(after.times, before.times)
        assert_same(rows(after, [0, 2], range(9)), rows(before, [0, 2], range(9)))
        pairs = zip(rows(after, [1, 3], range(9)), rows(before, [1, 3], range(9)), strict=True)
        assert any((new != old).any(axis=0).all() for new, old in pairs)  # of both parts

    def test_does_nothing_to_no_parts(self, edit):
        assert_same(edit(trajectory(2), []), trajectory(2))

    def test_of_several_parts_is_that_of_each(self, edit):
        before = trajectory(3)
        assert_same(edit(before, [3, 1]), edit(edit(before, [1]), [3]), atol=1e-6)

    @pytest.mark.thorough
    def test_gives_the_same_under_jit_and_vmap(self, edit):
        both = [trajectory(4), trajectory(5)]
        stacked = jax.tree.map(lambda *leaves: np.stack(leaves), *both)
        found = jax.jit(jax.vmap(lambda one: edit(one, [1, 2])))(stacked)
        for i, one in enumerate(both):
            assert_same(
                jax.tree.map(lambda leaf, i=i: np.asarray(leaf)[i], found), edit(one, [1, 2]), atol=2e-5
            )

    @pytest.mark.thorough
    def test_gradients_are_finite_also_where_nothing_moves(self, edit):
        slopes = jax.jit(jax.grad(lambda one: sum(x.sum() for x in jax.tree.leaves(edit(one, [1])))))
        for start in (trajectory(6), still(4, jnp.asarray(TIMES))):
            assert all(np.isfinite(leaf).all() for leaf in jax.tree.leaves(slopes(start)))

    def test_names_a_part_that_is_not_there(self, edit):
        with pytest.raises(ValueError, match="parts: expected numbers from 0 to 3, found 4"):
            edit(trajectory(7), [1, 4])


@pytest.mark.thorough
@given(seeds, st.permutations(sorted(EDITS)))
def test_edits_of_different_parts_commute_to_the_bit(seed, order):
    steps = [(EDITS[name], [part]) for name, part in zip(order, (1, 2, 3), strict=False)]
    there = reduce(lambda t, step: step[0](t, step[1]), steps, trajectory(seed))
    back = reduce(lambda t, step: step[0](t, step[1]), steps[::-1], trajectory(seed))
    assert_same(there, back)


class TestDuring:
    def test_holds_from_begin_until_end(self):
        share = edits.during(jnp.asarray(TIMES), 0.25, 0.625)
        np.testing.assert_array_equal(share, [0, 0, 1, 1, 1, 0, 0, 0, 0])
        np.testing.assert_array_equal(edits.during(jnp.asarray(TIMES)), np.ones(9))

    def test_comes_and_goes_smoothly_within_its_bounds(self):
        times = jnp.linspace(0, 10, 1001)
        share = np.asarray(edits.during(times, 2.0, 8.0, ease=2.0))
        assert (share[times <= 2.0 - 1e-3] == 0).all()
        assert (share[times >= 8.0] == 0).all()
        assert (share[(times >= 4.0) & (times <= 6.0 - 1e-3)] == 1).all()
        np.testing.assert_allclose(share[300], 0.5, atol=1e-3)
        assert (np.diff(share[200:400]) >= 0).all()
        assert np.abs(np.diff(share)).max() < 0.01  # steepest in the middle: 1.5 / 2 s

    @pytest.mark.parametrize("name", ["move", "rotate", "redirect", "amplify", "scale", "fade"])
    def test_outside_its_time_an_edit_changes_nothing_to_the_bit(self, name):
        arguments = {"move": (ARM,), "rotate": (TURN, ARM), "redirect": (TURN,), "fade": (0.1,)}
        share = edits.during(jnp.asarray(TIMES), 0.25, 0.75, ease=0.25)
        edited = getattr(edits, name)(trajectory(3), [1], *arguments.get(name, (2.0,)), share=share)
        outside, within = [0, 1, 2, 6, 7, 8], [3, 4, 5]
        assert_same(rows(edited, [1], outside), rows(trajectory(3), [1], outside))
        fully = getattr(edits, name)(trajectory(3), [1], *arguments.get(name, (2.0,)))
        assert_same(rows(edited, [1], [4]), rows(fully, [1], [4]))
        changed = zip(rows(edited, [1], within), rows(trajectory(3), [1], within), strict=True)
        assert any((new != old).any(axis=-1).all() for new, old in changed)


@pytest.fixture
def room(x64):
    """A background, a lid and a drawer."""
    return jointed([STILL, LID, DRAWER], CENTERS, TIMES)


class TestPlace:
    @given(seeds)
    def test_move_shifts_what_is_seen(self, seed):
        scene, shift = whole(scene_of(seed, parts=4), 1), jnp.array([0.1, -0.2, 0.3])
        edited = edits.move(trajectory(seed), [1], shift)
        before, after = (seen(scene, t, 5) for t in (trajectory(seed), edited))
        np.testing.assert_allclose(after.means, before.means + shift, atol=1e-5)

    @pytest.mark.thorough
    @pytest.mark.usefixtures("x64")
    @given(seeds)
    def test_rotate_turns_what_is_seen_about_the_handle_or_another_point_of_the_part(self, seed):
        scene, turn = whole(scene_of(seed, parts=4), 1), Rotation.from_rotvec(np.asarray(TURN))
        for arm in (jnp.zeros(3), ARM):
            point = scene.centers[1] + arm  # attached to the part, as its Gaussians are
            marked = eqx.tree_at(lambda s: s.gaussians.means, scene, scene.gaussians.means.at[0].set(point))
            one = trajectory(seed)
            one = eqx.tree_at(lambda t: t.scales, one, jnp.ones_like(one.scales))
            edited = edits.rotate(one, [1], TURN, arm)
            before, after = (seen(marked, t, 5) for t in (one, edited))
            pivot = np.asarray(before.means[0])
            expected = pivot + turn.apply(np.asarray(before.means) - pivot)
            np.testing.assert_allclose(after.means, expected, atol=1e-6)
            turned = turn * Rotation.from_quat(np.asarray(before.quats), scalar_first=True)
            found = Rotation.from_quat(np.asarray(after.quats), scalar_first=True)
            np.testing.assert_allclose((found * turned.inv()).magnitude(), 0, atol=1e-6)

    def test_rotating_about_a_hinge_opens_the_lid_further(self, room):
        arm = jnp.asarray(LID.point - CENTERS[1])
        edited = edits.rotate(room, [1], jnp.array([0.4, 0.0, 0.0]), arm)
        expected = hinge(LID.values + 0.4, LID.axis, LID.point).motions()
        np.testing.assert_allclose(motions(edited, CENTERS, 1), expected, atol=1e-6)

    def test_turns_about_one_axis_add_up(self, room):
        twice = edits.rotate(edits.rotate(room, [1], 0.3 * TURN), [1], 0.7 * TURN)
        assert_same(twice, edits.rotate(room, [1], TURN), atol=1e-6)

    def test_redirect_turns_the_hinge_and_not_the_lid(self, room):
        """Rotating by 90 degrees about the vertical through the handle moves the hinge to another edge."""
        edited = edits.redirect(room, [1], jnp.array([0.0, 0.0, np.pi / 2]))
        found = motions(edited, CENTERS, 1)
        np.testing.assert_allclose(found[0], np.eye(4), atol=1e-6)
        joint = fit_joint(found, CENTERS[1] + np.asarray(scene_of(0).gaussians.means)).joint
        np.testing.assert_allclose(joint.axis, [0, 1, 0], atol=1e-5)
        np.testing.assert_allclose(joint.values, LID.values, atol=1e-5)
        turned = Rotation.from_rotvec([0, 0, np.pi / 2]).apply(LID.point - CENTERS[1]) + CENTERS[1]
        np.testing.assert_allclose(np.cross(joint.point - turned, joint.axis), 0, atol=1e-5)

    def test_redirect_about_a_point_of_the_hinge_replaces_its_axis(self, room):
        arm = jnp.asarray(LID.point - CENTERS[1])
        edited = edits.redirect(room, [1], jnp.array([0.0, 0.0, np.pi / 2]), arm)
        expected = hinge(LID.values, (0.0, 1.0, 0.0), LID.point).motions()
        np.testing.assert_allclose(motions(edited, CENTERS, 1), expected, atol=1e-6)

    def test_redirect_sends_a_drawer_another_way(self, room):
        edited = edits.redirect(room, [2], jnp.array([0.0, 0.0, -np.pi / 2]))
        expected = Joint("prismatic", np.array([1.0, 0.0, 0.0]), np.zeros(3), DRAWER.values).motions()
        np.testing.assert_allclose(motions(edited, CENTERS, 2), expected, atol=1e-6)

    @pytest.mark.thorough
    @pytest.mark.usefixtures("x64")
    @given(seeds, st.integers(0, 8))
    def test_redirect_and_amplify_leave_the_part_where_it_is_at_one_time(self, seed, index):
        one = trajectory(seed)
        for edited in (
            edits.redirect(one, [1], TURN, ARM, at=index * STEP),
            edits.amplify(one, [1], -3.0, at=index * STEP),
        ):
            before = jaxlie.SO3(one.poses.quats[index, 1])
            apart = (before.inverse() @ jaxlie.SO3(edited.poses.quats[index, 1])).log()
            np.testing.assert_allclose(apart, 0, atol=1e-6)
            expected = one.poses.translations[index, 1]
            np.testing.assert_allclose(edited.poses.translations[index, 1], expected, atol=1e-6)

    @pytest.mark.thorough
    @pytest.mark.parametrize("factor", [0.0, 0.3, 1.7, -1.0])
    def test_amplify_stays_on_hinges_and_rails(self, room, factor):
        edited = edits.amplify(room, [1, 2], factor)
        lid = hinge(factor * LID.values, LID.axis, LID.point).motions()
        drawer = Joint("prismatic", DRAWER.axis, DRAWER.point, factor * DRAWER.values).motions()
        np.testing.assert_allclose(motions(edited, CENTERS, 1), lid, atol=1e-6)
        np.testing.assert_allclose(motions(edited, CENTERS, 2), drawer, atol=1e-6)

    @pytest.mark.parametrize("sign", [1.0, -1.0])
    def test_amplify_knows_more_than_half_a_turn(self, sign):
        """Also when the part returns, and whatever the signs of the quaternions."""
        with jax.enable_x64(True):
            angles = sign * np.array([0.5, 1.5, 2.9, 4.0, 5.5, 4.5, 3.3, 2.0, 0.5])
            faucet = jointed([hinge(angles, LID.axis, LID.point)], CENTERS[1:2], TIMES)
            edited = edits.amplify(faucet, [0], 0.5)
            expected = hinge(angles[0] + 0.5 * (angles - angles[0]), LID.axis, LID.point).motions()
            np.testing.assert_allclose(motions(edited, CENTERS[1:2], 0), expected, atol=1e-5)

    def test_amplifications_multiply_and_1_is_nothing(self, room):
        twice = edits.amplify(edits.amplify(room, [1, 2], 0.5), [1, 2], 3.0)
        once = edits.amplify(room, [1, 2], 1.5)
        for p in (1, 2):
            np.testing.assert_allclose(motions(twice, CENTERS, p), motions(once, CENTERS, p), atol=1e-6)
        assert_same(edits.amplify(room, [1, 2], 1.0), room)


class TestLook:
    def test_scale_and_fade_are_factors(self):
        one = trajectory(0)
        edited = edits.fade(edits.scale(edits.scale(one, [1], 2.0), [1], 0.25), [1, 2], 0.5)
        np.testing.assert_allclose(edited.scales, one.scales * np.array([1, 0.5, 1, 1]), rtol=1e-6)
        np.testing.assert_allclose(edited.opacities, one.opacities * np.array([1, 0.5, 0.5, 1]), rtol=1e-6)

    def test_scale_grows_by_equal_factors(self):
        share = jnp.linspace(0, 1, 9)
        edited = edits.scale(still(2, jnp.asarray(TIMES)), [1], 16.0, share)
        np.testing.assert_allclose(edited.scales[:, 1], 2 ** np.linspace(0, 4, 9), rtol=1e-5)

    def test_ghost_shows_only_these(self):
        one = trajectory(1)
        edited = edits.ghost(one, [1, 2])
        np.testing.assert_array_equal(edited.opacities[:, [0, 3]], 0)
        np.testing.assert_array_equal(edited.opacities[:, [1, 2]], one.opacities[:, [1, 2]])
        assert_same(edits.ghost(edited, [1, 2]), edited)
        faint = edits.ghost(one, [1], 0.1).opacities
        np.testing.assert_allclose(faint, one.opacities * np.array([0.1, 1, 0.1, 0.1]), rtol=1e-6)

    @pytest.mark.parametrize(
        ("delay", "indices", "there"),
        [(0.25, [0, 0, 0, 1, 2, 3, 4, 5, 6], slice(2, 9)), (-0.25, [2, 3, 4, 5, 6, 7, 8, 8, 8], slice(0, 9))],
    )
    def test_echo_is_a_faint_copy_at_another_time(self, delay, indices, there):
        one = trajectory(2)
        copy = edits.echo(one, [1], delay, 0.5)
        assert_same(copy.times, one.times)
        assert_same(jax.tree.map(lambda leaf: np.asarray(leaf)[indices], one.poses), copy.poses)
        assert not copy.opacities[:, [0, 2, 3]].any()
        expected = np.zeros(9)
        expected[there] = 0.5 * np.asarray(one.opacities)[indices, 1][there]
        np.testing.assert_allclose(copy.opacities[:, 1], expected, rtol=1e-6)


SLOPES = {
    "speed": lambda t, x: edits.speed(t, [1], x),
    "backwards": lambda t, x: edits.speed(t, [1], -x),
    "begin": lambda t, x: edits.speed(t, [1], 0.5, begin=0.3 * x),
    "end": lambda t, x: edits.speed(t, [1], 2.0, begin=0.1, end=0.8 * x),
    "freeze": lambda t, x: edits.freeze(t, [1], at=0.55 * x),
    "move": lambda t, x: edits.move(t, [1], x * jnp.array([0.1, 0.3, -0.2])),
    "rotate": lambda t, x: edits.rotate(t, [1], x * np.asarray(TURN, float), jnp.asarray(ARM, float)),
    "redirect": lambda t, x: edits.redirect(t, [1], x * np.asarray(TURN, float)),
    "amplify": lambda t, x: edits.amplify(t, [1], x),
    "scale": lambda t, x: edits.scale(t, [1, 2], x),
    "fade": lambda t, x: edits.fade(t, [1], 0.3 * x),
    "ghost": lambda t, x: edits.ghost(t, [1], 0.3 * x),
    "echo": lambda t, x: edits.echo(t, [1], 0.21 * x, 0.5),
    "share": lambda t, x: edits.scale(t, [1], 2.0, share=edits.during(t.times, 0.2 * x, 0.9, 0.15)),
}


@pytest.mark.thorough
@pytest.mark.usefixtures("x64")
@pytest.mark.parametrize("edit", SLOPES.values(), ids=SLOPES)
def test_each_number_of_an_edit_has_its_slope_under_jit(edit):
    """Regression test: gradients of fade, ghost and scale failed, and those of speed and scale under jit."""
    one, scene = trajectory(0), scene_of(0, parts=4)
    one, scene = jax.tree.map(lambda leaf: jnp.asarray(leaf, float), (one, scene))
    to = jax.random.normal(jax.random.key(0), (9, 7, 7))

    @jax.jit
    def seen_of(x):
        def at(t):
            gaussians = gaussians_at(scene, moment(edit(one, x), t))
            columns = (gaussians.means, gaussians.scales, gaussians.opacities[:, None])
            return jnp.concatenate(columns, axis=1)

        return jnp.vdot(to, jax.vmap(at)(jnp.arange(9))[:, :7])

    slope, h = jax.jit(jax.grad(seen_of))(0.9), 1e-6
    np.testing.assert_allclose(slope, (seen_of(0.9 + h) - seen_of(0.9 - h)) / (2 * h), rtol=1e-4, atol=1e-7)
    assert abs(slope) > 1e-6


@pytest.mark.thorough
def test_edits_compose_and_differentiate_as_one_function():
    """As a user would combine them: slowed down, amplified, and moved elsewhere for a while."""
    scene = scene_of(0, parts=4)

    @jax.jit
    def means(factor, shift):
        one = edits.speed(trajectory(0), [1], 0.5)
        one = edits.amplify(one, [1], factor)
        one = edits.move(one, [1, 2], shift, edits.during(one.times, 0.2, 0.9, 0.1))
        return jax.vmap(lambda t: gaussians_at(scene, moment(one, t)).means)(jnp.arange(9)).sum()

    slopes = jax.jit(jax.grad(means, argnums=(0, 1)))(1.5, jnp.ones(3))
    near = [(means(1.5 + h, jnp.ones(3)) - means(1.5 - h, jnp.ones(3))) / (2 * h) for h in (0.05,)]
    np.testing.assert_allclose(slopes[0], near[0], rtol=2e-2)
    assert (slopes[1] > 0).all()
