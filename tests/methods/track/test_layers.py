"""Moving Gaussians rendered over a stored background match a rendering of the whole scene."""

import equinox as eqx
import jax.numpy as jnp
import numpy as np
import pytest

from gsjax.geometry.cameras import Camera
from gsjax.methods.track import first_pose, render_labels
from gsjax.methods.track.layers import (
    Backdrop,
    background_of,
    draw_backdrop,
    keep_backdrop,
    moving_of,
    plan_moving,
    seen_from,
    show_moving,
    shown_by,
)
from gsjax.rasterize.rasterization import rasterization
from gsjax.scene.gaussians import gaussians_from_activated
from gsjax.scene.render import plan_render

GAP = 0.015


@pytest.fixture(scope="module")
def plans(table, started):
    cameras = table()[1][0].cameras
    moving = moving_of(started, first_pose(started))
    return (
        plan_render(started.gaussians, cameras, headroom=2.0),
        plan_render(background_of(started), cameras, headroom=2.0),
        plan_moving(moving, cameras, 2.0),
    )


@pytest.fixture(scope="module")
def both(table, started, plans):
    """(the whole scene as rendered, moving Gaussians rendered over the backdrop, the backdrop)."""
    whole_plan, still_plan, moving_plan = plans
    frame, pose = table()[1][0], first_pose(started)
    whole = shown_by(render_labels(started, pose, frame, whole_plan))
    backdrop, needed = draw_backdrop(started, frame.cameras, still_plan)
    assert 0 < needed <= still_plan.capacity
    shown, needed = show_moving(started, pose, backdrop, moving_plan)
    assert 0 < needed <= moving_plan.capacity
    return whole, shown, backdrop


@pytest.mark.thorough
def test_layers_show_what_the_whole_scene_shows(both, started):
    whole, shown, _ = both
    assert set(np.unique(whole.labels)) == set(range(started.num_objects + 1))
    agree = np.asarray(whole.labels) == np.asarray(shown.labels)
    assert agree.mean() > 0.97  # the two may differ along outlines
    assert (np.asarray(whole.covered) == np.asarray(shown.covered)).mean() > 0.98
    inside = agree & (np.asarray(whole.labels) > 0)
    assert np.median(np.abs(whole.depths - shown.depths)[inside]) < 2e-3


@pytest.mark.thorough
@pytest.mark.parametrize("more", [0.0, 2.5, 9.0])
def test_what_the_plan_leaves_out_changes_hardly_a_label(both, started, more):
    """With opacities as fitted, and raised to 0.99 and 1: single opaque Gaussians must still be drawn."""
    _, _, backdrop = both
    opaque = eqx.tree_at(
        lambda s: s.gaussians.logit_opacities, started, started.gaussians.logit_opacities + more
    )
    pose, moving = first_pose(opaque), moving_of(opaque, first_pose(opaque))
    exact, _ = show_moving(
        opaque, pose, backdrop, plan_render(moving, backdrop.cameras, headroom=2.0, sh_degree=None)
    )
    shown, _ = show_moving(opaque, pose, backdrop, plan_moving(moving, backdrop.cameras, 2.0))
    drawn = np.asarray((exact.labels > 0) | (shown.labels > 0))
    agree = np.asarray(exact.labels) == np.asarray(shown.labels)
    assert agree[drawn].mean() > 0.97
    apart = np.abs(exact.depths - shown.depths)[agree & drawn]
    assert np.quantile(apart, 0.9) < 5e-3  # half a pixel of this small table


@pytest.mark.thorough
@pytest.mark.parametrize("opacity", [0.5, 0.9, 0.99, 1.0])
def test_a_single_gaussian_in_front_of_another_is_drawn_at_almost_its_depth(opacity):
    means = jnp.array([[0.0, 0.0, 0.6], [0.0, 0.0, 0.9]])
    quats, ones = jnp.tile(jnp.eye(4)[0], (2, 1)), jnp.ones((2, 3))
    two = gaussians_from_activated(means, quats, 0.05 * ones, jnp.array([opacity, 0.99]), ones)
    K = jnp.array([[50.0, 0, 8.5], [0, 50.0, 8.5], [0, 0, 1]])
    camera = Camera(jnp.eye(4)[None], K[None], 17, 17)
    args = (two.means, two.quats, two.scales, two.opacities, ones[:, :1], camera.viewmat, camera.K, 17, 17)

    def at_the_middle(plan):
        images, alphas, _ = rasterization(*args, plan=plan, render_mode="RGB+ED")
        return float(images[0, 8, 8, 1]), float(alphas[0, 8, 8, 0])

    exact, _ = at_the_middle(plan_render(two, camera, sh_degree=None))
    depth, alpha = at_the_middle(plan_moving(two, camera, 2.0))
    assert abs(depth - exact) <= 0.1 * 0.3
    assert alpha > 0.89


@pytest.mark.thorough
def test_cameras_see_the_same_gaussians_in_both(both, started, table):
    whole, shown, _ = both
    cameras, pose = table()[1][0].cameras, first_pose(started)
    own = started.labels[: started.num_moving]
    a, b = (np.asarray(seen_from(pose.means, own, s, cameras, GAP)) for s in (whole, shown))
    assert 0.1 < a.mean() < 0.9
    assert (a == b).mean() > 0.97


@pytest.mark.thorough
def test_what_stands_in_front_hides_what_moves(both, started, plans):
    _, _, backdrop = both
    wall = backdrop._replace(
        depths=jnp.full_like(backdrop.depths, 0.1), alphas=jnp.ones_like(backdrop.alphas)
    )
    hidden, _ = show_moving(started, first_pose(started), wall, plans[2])
    assert not hidden.labels.any()
    np.testing.assert_array_equal(hidden.depths, wall.depths)
    assert hidden.covered.all()


@pytest.mark.thorough
def test_the_backdrop_is_drawn_again_only_when_a_camera_moves(both, started, plans, table):
    _, _, backdrop = both
    cameras = table()[1][0].cameras
    marked = backdrop._replace(depths=backdrop.depths + 7.0)  # distinguishes a stored one from a new one
    kept, needed = keep_backdrop(marked, started, cameras, plans[1])
    np.testing.assert_array_equal(kept.depths, marked.depths)
    assert needed == 0
    moved: Camera = eqx.tree_at(lambda c: c.viewmat, cameras, cameras.viewmat.at[0, 0, 3].add(0.01))
    drawn, needed = keep_backdrop(marked, started, moved, plans[1])
    expected: Backdrop = draw_backdrop(started, moved, plans[1])[0]
    np.testing.assert_allclose(drawn.depths, expected.depths, rtol=1e-4)
    np.testing.assert_array_equal(drawn.cameras.viewmat, moved.viewmat)
    assert needed > 0
