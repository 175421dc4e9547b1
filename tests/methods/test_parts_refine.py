"""All frames together, on boxes of which all is known."""

from dataclasses import replace

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from gsjax.methods.parts import (
    DiscoverConfig,
    PartsConfig,
    RefineConfig,
    begin,
    choose_anchor,
    first_parts,
    moved_pixels,
    refine,
)
from gsjax.scene.feature_grid import FeatureGridConfig
from tests.methods.moving_boxes import Box, MovingBoxes, linear

FRAMES = 3
_BRIGHTER = 0.05  # of the first harmonic
CONFIG = PartsConfig(
    discover=DiscoverConfig(most_parts=2, lift_iterations=9),
    refine=RefineConfig(iterations=60, rate=0.3),
    grid=FeatureGridConfig(4, 4, 32, 12, 2, 16),
)


@pytest.fixture(scope="module")
def boxes():
    turning = Box((0, 0, 0.05), (0.12, 0.08, 0.1), linear(FRAMES, (0, 0, 0.3)), linear(FRAMES, (0, 0.06, 0)))
    return MovingBoxes([turning])


@pytest.fixture(scope="module")
def astray(boxes):
    """The box is followed, but for a pixel, and the floor is too bright."""
    found = choose_anchor(boxes.image, FRAMES, boxes.num_cameras, 0)
    moved = moved_pixels(boxes.image, found, boxes.num_cameras)
    masks = boxes.masks(boxes.bodies)
    start = begin(boxes, boxes.gaussians, found, moved, CONFIG, None, jax.random.key(0), masks)
    parts = first_parts(start, FRAMES, CONFIG)
    motions, center = boxes.boxes[0].motions(), np.asarray(start.canonical.centers)[1]
    quats, translations = parts.quats.copy(), parts.translations.copy()
    quats[:, 1] = Rotation.from_matrix(motions[:, :3, :3]).as_quat(scalar_first=True)
    translations[:, 1] = motions[:, :3, :3] @ center + motions[:, :3, 3] - center
    translations[1:, 1, 0] += float(start.canonical.pixel)
    bright = eqx.tree_at(lambda g: g.sh0, start.canonical.fixed, start.canonical.fixed.sh0 + _BRIGHTER)
    canonical = parts.canonical._replace(fixed=bright)
    found = np.arange(FRAMES)
    return parts._replace(canonical=canonical, quats=quats, translations=translations, found=found)


def off_mm(boxes, parts):
    """Of the box in each frame."""
    center = np.asarray(parts.canonical.centers)[1]
    motions = boxes.boxes[0].motions()
    true = motions[:, :3, :3] @ center + motions[:, :3, 3] - center
    return 1000 * np.linalg.norm(parts.translations[:, 1] - true, axis=1)


@pytest.mark.slow
def test_colours_and_poses_come_back(boxes, astray):
    steps = list(refine(boxes, astray, CONFIG))
    losses = np.array([float(step.loss) for step in steps])
    assert len(losses) == 60
    assert losses[-9:].mean() < 0.6 * losses[:9].mean()
    assert not any(bool(step.skipped) for step in steps)
    parts = steps[-1].parts
    assert off_mm(boxes, astray)[1:].min() > 14  # a pixel
    assert off_mm(boxes, parts).max() < 6
    np.testing.assert_array_equal(parts.quats[0], astray.quats[0])  # canonical is canonical
    np.testing.assert_array_equal(parts.translations[0], 0)
    np.testing.assert_array_equal(parts.translations[:, 0], 0)  # the background stands still
    brighter = np.asarray(parts.canonical.fixed.sh0 - astray.canonical.fixed.sh0) + _BRIGHTER
    assert abs(np.median(brighter)) < 0.8 * _BRIGHTER  # it falls by 0.0025 a step at most


def test_the_same_again_to_the_bit_and_one_may_stop_after_any_step(boxes, astray):
    config = replace(CONFIG, refine=RefineConfig(iterations=4))
    once, again = ([step.parts for step in refine(boxes, astray, config)] for _ in range(2))
    for step in (0, 3):
        for a, b in zip(jax.tree.leaves(once[step]), jax.tree.leaves(again[step]), strict=True):
            np.testing.assert_array_equal(a, b)
    first = next(refine(boxes, astray, config)).parts
    np.testing.assert_array_equal(first.canonical.fixed.sh0, once[0].canonical.fixed.sh0)


def test_the_papers_scene_stays(boxes, astray):
    assert list(refine(boxes, astray, replace(CONFIG, refine=RefineConfig(iterations=0)))) == []


def test_a_frame_of_nan_changes_nothing(boxes, astray):
    class Broken(MovingBoxes):
        def frame(self, t):
            frame = super().frame(t)
            return frame if t != 1 else eqx.tree_at(lambda f: f.images, frame, frame.images * jnp.nan)

    steps = list(refine(Broken(boxes.boxes), astray, replace(CONFIG, refine=RefineConfig(iterations=12))))
    skipped = [bool(step.skipped) for step in steps]
    assert 0 < sum(skipped) < 12
    after = steps[-1].parts
    np.testing.assert_array_equal(after.translations[1], astray.translations[1])
    assert all(np.isfinite(leaf).all() for leaf in jax.tree.leaves(after))


def test_settings_without_meaning_are_refused():
    with pytest.raises(ValueError, match=r"refine\.iterations: expected at least 0, found -1"):
        RefineConfig(iterations=-1)
    with pytest.raises(ValueError, match=r"refine\.rate: expected at least 0, found nan"):
        RefineConfig(rate=float("nan"))
