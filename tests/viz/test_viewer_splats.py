"""What the viewer sends to a browser: splats in a scaled unit, their colours, and only what differs."""

import numpy as np

from gsjax.viz.colors import label_color
from gsjax.viz.viewer import Viewable
from gsjax.viz.viewer.splat_nodes import Appearance, Displayed, SplatNodes
from gsjax.viz.viewer.splats import Palette, browser_scale, splats
from gsjax.viz.viewer.viewable import most_opaque
from tests.viz.scenes import Api, ahead, cloud, made, moving_scene


def test_splats_are_the_gaussians_in_another_unit():
    gaussians = cloud()
    scale = browser_scale(gaussians)
    sent = splats(gaussians, scale)
    np.testing.assert_allclose(sent.centers * scale, gaussians.means, rtol=1e-5, atol=1e-6)
    variances = np.linalg.eigvalsh(sent.covariances * scale**2)
    np.testing.assert_allclose(variances, np.sort(np.asarray(gaussians.scales) ** 2, axis=1), rtol=2e-3)


def test_gaussians_of_a_tenth_of_a_millimetre_survive_half_precision():
    gaussians = made(
        np.zeros((2, 3)), [[1, 0, 0, 0]] * 2, np.full((2, 3), 1e-4), [0.5, 0.5], np.zeros((2, 3))
    )
    scale = browser_scale(gaussians)
    halved = splats(gaussians, scale).covariances.astype(np.float16).astype(float) * scale**2
    np.testing.assert_allclose(halved[:, [0, 1, 2], [0, 1, 2]], 1e-8, rtol=1e-2)


def test_the_most_opaque_are_kept_in_their_order():
    gaussians = cloud(40)
    rows = most_opaque(gaussians, 10)
    assert (np.diff(rows) > 0).all()
    rest = np.setdiff1d(np.arange(40), rows)
    opacities = np.asarray(gaussians.opacities)
    assert opacities[rows].min() >= opacities[rest].max()
    assert len(most_opaque(gaussians, 41)) == 40


def test_palettes():
    features = np.random.default_rng(0).normal(size=(24, 5))
    labels = np.arange(24) % 3
    scene = Viewable("x", cloud(features=features), labels)
    assert scene.colorings == ("colour", "depth", "label", "features")
    palette, rows = Palette(scene), np.array([0, 1, 5])
    means = np.asarray(scene.gaussians.means)
    viewmat = np.asarray(ahead().viewmat[0])
    rgb = palette("colour", means, rows, None, None)
    rng = np.random.default_rng(0)  # as in `cloud`
    for shape in ((24, 3), (24, 4)):
        rng.normal(size=shape)
    rng.uniform(size=(24, 3)), rng.uniform(size=24)
    np.testing.assert_allclose(rgb, rng.uniform(0, 1, (24, 3))[rows], atol=1 / 255)
    expected = np.array([label_color(int(label)) for label in labels[rows]]) / 255
    np.testing.assert_allclose(palette("label", means, rows, None, None), expected, atol=1e-6)
    depth = palette("depth", means, np.arange(24), viewmat, (1.0, 3.0)).sum(1)
    order = np.argsort(means[:, 2])
    assert depth[order[0]] == depth.max() > depth[order[-1]] == depth.min()
    assert palette("features", means, rows, None, None).std() > 0


def test_a_scene_offers_only_what_it_has():
    assert Viewable("x", cloud()).colorings == ("colour", "depth")
    assert Viewable("x", cloud(), np.zeros(24, int)).colorings == ("colour", "depth")


def now(scene, frame):
    """A frame of a scene, as it is displayed."""
    return Displayed(scene, Palette(scene), frame, scene.at(frame))


def test_only_what_differs_is_sent_again():
    scene, api = moving_scene(), Api()
    nodes = SplatNodes(api, scene, 1000)
    look = Appearance("colour")
    nodes.show(now(scene, 0), look)
    nodes.show(now(scene, 0), Appearance("colour"))
    assert api.sent == ["/splats/moving", "/splats/still"]
    nodes.show(now(scene, 2), look)
    assert api.sent[2:] == ["/splats/moving"]
    scale = browser_scale(scene.gaussians)
    there = np.asarray(scene.gaussians.means)[:8] + np.array([0.4, 0, 0])
    np.testing.assert_allclose(api.nodes["/splats/moving"][0] * scale, there, atol=1e-5)
    viewmat = np.asarray(ahead().viewmat[0], float)
    nodes.show(now(scene, 2), Appearance("depth", viewmat, (1.0, 3.0)))
    nodes.show(now(scene, 2), Appearance("depth", viewmat.copy(), (1.0, 3.0)))
    assert api.sent[3:] == ["/splats/moving", "/splats/still"]
    nodes.show(now(scene, 2), Appearance("depth", viewmat + 0.1, (1.0, 3.0)))
    assert api.sent[5:] == ["/splats/moving", "/splats/still"]


def test_thinned_splats_keep_the_moving_ones_apart():
    scene, api = moving_scene(), Api()
    SplatNodes(api, scene, 10).show(now(scene, 0), Appearance("colour"))
    sizes = {name: len(arrays[0]) for name, arrays in api.nodes.items()}
    assert sum(sizes.values()) == 10
    assert sizes["/splats/moving"] == (most_opaque(scene.gaussians, 10) < 8).sum()
