"""The points of groups: their pixels, their tones, and the keyframe that stores them."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from gsjax.methods.track.points import (
    Points,
    carry_keyframe,
    faded,
    first_keyframe,
    first_members,
    join,
    pixels_of_groups,
    renewed,
    tones,
)
from tests.methods.track.carton import CONFIG, SIZE, see


def test_only_pixels_of_the_group_are_picked(moved, table):
    points, labels = moved[0], np.asarray(moved[4])
    _, frames, _ = table(8, 2, **SIZE)
    sight = see(frames[6])
    for c in range(2):
        chosen = np.asarray(points.seen)[c] > 0
        assert chosen.sum() == min(CONFIG.pixels, (labels[c] == 1).sum())
        theirs = np.asarray(sight.tones)[c][labels[c] == 1]
        found = np.asarray(points.tones)[c].T[chosen]
        assert {tuple(row) for row in found} <= {tuple(row) for row in theirs}
        assert len(np.unique(np.asarray(points.means)[c].T[chosen], axis=0)) == chosen.sum()  # no pixel twice


def test_a_camera_without_depth_gives_pixels_at_the_models_depth(moved, table):
    _, frames, _ = table(8, 2, **SIZE)
    labels = moved[4]
    depths = np.array(frames[6].depths)
    depths[1] = 0.0
    blind = eqx.tree_at(lambda f: f.depths, frames[6], jnp.asarray(depths))
    picked = jax.jit(pixels_of_groups, static_argnums=(3, 4))
    points = jax.device_get(picked(see(blind), labels, frames[6].depths, 1, CONFIG))
    np.testing.assert_array_equal(points.seen[0], moved[0].seen)
    np.testing.assert_allclose(points.means[0], moved[0].means)


members = jax.jit(first_members, static_argnums=(1, 2))


# Few sizes, as each is compiled.
@given(
    st.sampled_from([1, 13, 300]).flatmap(lambda n: st.lists(st.integers(-1, 6), min_size=n, max_size=n)),
    st.sampled_from([(1, 1), (3, 40), (5, 7)]),
)
def test_the_first_members_of_a_group_are_distinct_members_and_as_many_as_there_are(groups, sizes):
    num, per_group = sizes
    rows, real = map(np.asarray, members(np.array(groups, np.int32), num, per_group))
    assert rows.shape == real.shape == (num, per_group)
    for group in range(1, num + 1):
        found = rows[group - 1][real[group - 1]]
        assert len(set(found)) == len(found) == min(per_group, groups.count(group))
        assert all(groups[row] == group for row in found)


def test_join_holds_the_points_of_both(moved):
    points = moved[0]
    both = jax.device_get(jax.jit(join)(points, points._replace(means=points.means + 1)))
    count = points.seen.shape[-1]
    assert both.seen.shape == (2, 2 * count)
    np.testing.assert_array_equal(both.means[..., :count] + 1, both.means[..., count:])


def test_a_keyframe_is_carried_and_renewed_where_a_group_has_turned():
    def pixels(value):
        images = np.full((2, 1, 3, 3), value, np.float32)
        return Points(images, images, np.ones((2, 1, 3), np.float32))

    @jax.jit
    def next_keyframe(keyframe, twists, centers, pixels):
        keyframe = renewed(carry_keyframe(keyframe, twists, centers), pixels, 0.5)
        return keyframe, faded(keyframe, 0.5)

    keyframe, centers = jax.jit(first_keyframe)(pixels(1.0)), np.ones((2, 3), np.float32)
    twists = np.zeros((2, 6), np.float32)
    twists[:, 0], twists[0, 5] = 0.1, 0.3  # the first group turns by 0.3
    for turn, expected in ((0.3, [1.0, 1.0]), (0.6, [2.0, 1.0])):
        keyframe, later = jax.device_get(next_keyframe(keyframe, twists, centers, pixels(2.0)))
        np.testing.assert_allclose(keyframe.points.tones[:, 0, 0, 0], expected, err_msg=str(turn))
        count = later.seen[:, 0, 0]
        np.testing.assert_allclose(count, [0.4 if turn == 0.3 else 1.0, 1.0], rtol=1e-5)
    # The second group is carried twice; the first is renewed in the second step, so its points are new.
    np.testing.assert_allclose(keyframe.points.means[1, 0, :, 0], [1.2, 1.0, 1.0], rtol=1e-6)
    np.testing.assert_allclose(keyframe.points.means[0, 0, :, 0], [2.0, 2.0, 2.0])
    np.testing.assert_allclose(keyframe.turned, [[1, 0, 0, 0], [1, 0, 0, 0]], atol=1e-6)


def test_tones_forget_the_light_and_keep_the_colour():
    red, white = np.float32([0.8, 0.2, 0.2]), np.float32([0.7, 0.7, 0.7])
    toned = jax.jit(tones, static_argnums=1)
    gap = lambda a, b, shading: np.abs(np.subtract(toned(a, shading), toned(b, shading))).mean()  # noqa: E731
    assert gap(red, 0.7 * red, 0.3) < 0.5 * gap(red, 0.7 * red, 1.0)
    assert gap(red, white, 0.3) > 4 * gap(red, 0.7 * red, 0.3)
    assert np.isfinite(toned(np.float32([0.0, -1.0, 1e6]), 0.3)).all()
