"""Direct alignment finds a known motion of a textured object, and leaves unseen groups where they are."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from gsjax.methods.track.align import (
    _normal_equations,
    _residuals,
    align,
    ball_grid,
    bilinear,
    pixel_position,
    rotation_hypotheses,
)
from gsjax.methods.track.points import Points, carry
from tests.methods.track.carton import CONFIG, SIZE, error, gap, see

# Compiled once for calls that differ in values alone.
found_by = jax.jit(align, static_argnums=4)
carried = jax.jit(carry)
residuals = jax.jit(_residuals, static_argnums=2)
normal_equations = jax.jit(_normal_equations, static_argnums=4)


def run(points, center, sight, config=CONFIG):
    """(the twist found from a start at rest, the positions to which it carries the points)."""
    found = found_by(np.zeros(6, np.float32), points, center, sight, config)
    return found, np.asarray(carried(points, found, center).means)


def without_depth(sight):
    return sight._replace(pixels=sight.tones)


@pytest.mark.thorough
def test_a_known_motion_is_found_and_agrees_better(moved):
    points, center, sight, then, _ = moved
    before = error(points, np.asarray(points.means), then)
    _, means = run(points, center, sight)
    assert error(points, means, then) < min(1.5e-3, before), before
    assert gap(points._replace(means=jnp.asarray(means)), sight) < gap(points, sight)


@pytest.mark.thorough
def test_colour_alone_finds_it_too(moved):
    points, center, sight, then, _ = moved
    _, means = run(points, center, without_depth(sight))
    assert error(points, means, then) < 4e-3


@pytest.mark.parametrize("depth", [True, False])
def test_a_group_that_nobody_sees_stands_still(moved, depth):
    points, center, sight, _, _ = moved
    unseen = points._replace(seen=jnp.zeros(points.seen.shape))
    found, _ = run(unseen, center, sight if depth else without_depth(sight))
    np.testing.assert_allclose(found, 0, atol=1e-6)
    assert gap(unseen, sight) == 0


def test_disagreement_is_nothing_for_a_perfect_fit_and_half_outside_the_picture(moved, table):
    points = moved[0]
    _, frames, _ = table(8, 2, **SIZE)
    assert gap(points, see(frames[6])) < 1e-3
    away = points._replace(means=jnp.asarray(points.means + np.float32([0.0, 50.0, 0.0])[:, None]))
    np.testing.assert_allclose(gap(away, see(frames[6])), 0.5, atol=1e-6)


def test_bilinear_reads_between_pixel_centres_and_knows_its_slope():
    image = np.float32(np.mgrid[0:4, 0:5].transpose(1, 2, 0) + 0.5)  # (row, column) of centres
    places = np.float32([[2.3, 1.7], [0.5, 0.5], [4.5, 3.5]])
    read = jax.device_get(
        jax.jit(lambda image, *at: bilinear(image, pixel_position(*at, 5, 4)))(image, *places.T)
    )
    np.testing.assert_allclose(read.values.T, places[:, ::-1], atol=2e-3)
    np.testing.assert_allclose(read.slopes, np.tile([[[0], [1]], [[1], [0]]], 3), atol=1e-6)
    np.testing.assert_allclose(read.nearest.T, [[1.5, 2.5], [0.5, 0.5], [3.5, 4.5]])


@pytest.mark.parametrize("depth", [True, False])
def test_gradients_of_residuals_are_those_of_finite_differences(moved, depth):
    points, _, sight, _, _ = moved
    sight = sight if depth else without_depth(sight)
    # Not at pixel centres, where a bilinear image has kinks.
    one = Points(*(np.asarray(a)[..., :20] for a in points))
    one = one._replace(means=one.means + np.float32(1.3e-3))
    gradients = np.asarray(residuals(one, sight, CONFIG).gradients)
    small = np.float32(2e-5)
    for axis in range(3):
        step = small * np.eye(3, dtype=np.float32)[axis][:, None]
        ahead, behind = (
            np.asarray(residuals(one._replace(means=one.means + s * step), sight, CONFIG).values, np.float64)
            for s in (1, -1)
        )
        slope = (ahead - behind) / (2 * small)
        # Depth jumps at edges, on which few points lie.
        close = np.isclose(slope, gradients[:, axis], rtol=0.05, atol=2.0)
        assert close.mean() > 0.9


@pytest.mark.thorough
@pytest.mark.parametrize("depth", [True, False])
def test_normal_equations_are_those_of_differentiation(moved, depth):
    """J^T W J and J^T W r, as assembled by hand, against the Jacobian of forward-mode differentiation."""
    points, center, sight, _, _ = moved
    sight = sight if depth else without_depth(sight)
    still = np.zeros(6, np.float32)
    fit = normal_equations(still, points, center, sight, CONFIG)

    def values(twist):
        return _residuals(carry(points, twist, center), sight, CONFIG).values

    jacobian, base = jax.device_get((jax.jit(jax.jacfwd(values))(still), residuals(points, sight, CONFIG)))
    squared = base.values**2
    squared[:, :3] = squared[:, :3].mean(1, keepdims=True)
    counts = base.counts[:, [0, 0, 0, 1][: squared.shape[1]]]  # the colour channels share one
    weights = np.asarray(points.seen)[:, None] * counts / (1 + squared) ** 2
    expected = np.einsum("cdpi,cdp,cdpj->ij", jacobian, weights, jacobian)
    np.testing.assert_allclose(fit.hessian, expected, rtol=1e-3, atol=1e-3 * np.abs(expected).max())
    expected = np.einsum("cdpi,cdp,cdp->i", jacobian, weights, base.values)
    np.testing.assert_allclose(fit.gradient, expected, rtol=1e-3, atol=1e-3 * np.abs(expected).max())


@pytest.mark.thorough
def test_many_starts_at_once_are_each_alone(moved):
    points, center, sight, _, _ = moved
    starts = np.float32(0.004 * np.random.default_rng(0).normal(size=(3, 6)))
    together = jax.vmap(lambda start: found_by(start, points, center, sight, CONFIG))(starts)
    alone = np.stack([found_by(start, points, center, sight, CONFIG) for start in starts])
    np.testing.assert_allclose(together, alone, atol=2e-4)


def test_a_ball_grid_holds_the_origin_and_nothing_outside():
    grid = ball_grid(0.045, 0.015)
    assert (np.linalg.norm(grid, axis=1) <= 0.045).all()
    assert (np.abs(grid).sum(1) == 0).sum() == 1
    assert len(grid) == 123


@pytest.mark.thorough
def test_turn_hypotheses_hold_the_start_and_turns_about_its_own_axes():
    twist = np.float32([0.1, 0.2, 0.3, 0.0, 0.0, 0.4])
    turned = jax.jit(rotation_hypotheses, static_argnums=2)
    hypotheses = np.asarray(turned(twist, np.eye(3, dtype=np.float32), (0.2, 0.6)))
    assert hypotheses.shape == (13, 6)
    np.testing.assert_allclose(hypotheses[0], twist, atol=1e-6)
    np.testing.assert_allclose(hypotheses[:, :3], np.tile(twist[:3], (13, 1)))
    about_z = [float(h[5]) for h in hypotheses if np.allclose(h[3:5], 0, atol=1e-6)]
    np.testing.assert_allclose(sorted(about_z), [-0.2, 0.2, 0.4, 0.6, 1.0], atol=1e-5)
