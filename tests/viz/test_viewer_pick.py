"""What a click in the viewer hits, against densely sampled rays, and against the picture."""

import jax.numpy as jnp
import numpy as np
import pytest

from gsjax.scene.render import plan_render, render
from gsjax.viz.viewer import pick
from tests.viz.scenes import ahead, cloud, made


def brute_force(gaussians, origin, direction):
    """The Gaussian that a ray hits, all shares, and the total alpha, from densities sampled along the ray."""
    from scipy.spatial.transform import Rotation

    direction = direction / np.linalg.norm(direction)
    ts = np.linspace(0.01, 6, 6_001)
    points = origin + ts[:, None] * direction
    met = []
    for i in range(gaussians.num):
        R = Rotation.from_quat(np.asarray(gaussians.quats)[i], scalar_first=True).as_matrix()
        precision = R @ np.diag(np.exp(-2 * np.asarray(gaussians.log_scales, float)[i])) @ R.T
        d = points - np.asarray(gaussians.means, float)[i]
        alpha = float(gaussians.opacities[i]) * np.exp(-0.5 * np.einsum("ti,ij,tj->t", d, precision, d))
        best = alpha.argmax()
        if 0 < best < len(ts) - 1 and alpha[best] >= 1 / 255:
            met.append((ts[best], i, min(alpha[best], 0.99)))
    shares, through = {}, 1.0
    for _, i, alpha in sorted(met):
        shares[i] = alpha * through
        through *= 1 - alpha
    return max(shares, key=shares.get, default=None), shares, 1 - through


def test_pick_finds_what_brute_force_finds():
    gaussians = cloud()
    rng = np.random.default_rng(1)
    hits = 0
    for _ in range(16):
        origin = rng.normal(0, 0.1, 3)
        direction = np.array([*rng.normal(0, 0.18, 2), 1.0])
        best, shares, stopped = brute_force(gaussians, origin, direction)
        picked = pick(gaussians, origin, 3 * direction)
        assert (picked is not None) == (stopped >= 0.5)
        if picked is not None:
            hits += 1
            assert picked.index == best
            assert picked.share == pytest.approx(shares[best], abs=3e-3)
            assert picked.alpha == pytest.approx(stopped, abs=3e-3)
            unit = direction / np.linalg.norm(direction)
            np.testing.assert_allclose(picked.point, origin + picked.depth * unit, atol=1e-6)
    assert 4 < hits < 16


@pytest.mark.thorough
def test_pick_agrees_with_the_picture():
    """Small Gaussians, one channel each: in a pixel, the rasterizer's largest weight is that of the pick."""
    count = 20
    gaussians = cloud(count, seed=3)
    camera = ahead(24, 24)
    plan = plan_render(gaussians, camera, eps2d=0.0)
    weights = np.asarray(render(gaussians, camera, plan, features=jnp.eye(count)).meta.features[0])
    K = np.asarray(camera.K[0], float)
    same, clear = 0, 0
    for y, x in np.ndindex(24, 24):
        order = np.sort(weights[y, x])
        if weights[y, x].sum() < 0.6 or order[-1] < 1.5 * order[-2]:
            continue
        clear += 1
        ray = np.linalg.inv(K) @ [x + 0.5, y + 0.5, 1.0]
        picked = pick(gaussians, np.zeros(3), ray)
        same += picked is not None and picked.index == weights[y, x].argmax()
    # A picture sorts by the centres' depths and projects to an ellipse; a ray samples the density itself.
    assert clear > 60
    assert same > 0.9 * clear


def test_pick_hits_nothing_behind_or_beside():
    gaussians = cloud(count=3)
    assert pick(gaussians, np.zeros(3), np.array([0, 0, -1.0])) is None
    assert pick(gaussians, np.array([50.0, 0, 0]), np.array([0, 0, 1.0])) is None
    with pytest.raises(ValueError, match="direction"):
        pick(gaussians, np.zeros(3), np.zeros(3))


def test_pick_takes_what_shows_most_not_what_is_first():
    """A faint veil before a wall."""
    gaussians = made(
        [[0, 0, 1], [0, 0, 2.0]], [[1, 0, 0, 0]] * 2, [[1, 1, 0.001]] * 2, [0.2, 0.95], np.zeros((2, 3))
    )
    picked = pick(gaussians, np.zeros(3), np.array([0, 0, 1.0]))
    assert picked is not None
    assert picked.index == 1
    assert picked.share == pytest.approx(0.8 * 0.95, abs=1e-6)
    assert picked.depth == pytest.approx(2.0, abs=1e-6)
