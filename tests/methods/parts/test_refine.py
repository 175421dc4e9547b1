"""Refinement on all frames together, on a box with full ground truth."""

from dataclasses import replace

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from gsjax.engine.drive import drive
from gsjax.methods.parts import (
    DiscoverConfig,
    Parts,
    PartsConfig,
    RefineConfig,
    RefineParams,
    begin,
    choose_anchor,
    moved_pixels,
    refine_step,
)
from gsjax.methods.parts.pictures import Problem, order_of_pictures, stored_frame
from gsjax.optim.method import Run
from gsjax.scene.feature_grid import FeatureGridConfig
from gsjax.scene.handles import HandlePose
from tests.methods.parts.moving_boxes import Box, MovingBoxes, linear

FRAMES = 3
_BRIGHTER = 0.05  # added to the coefficients of degree 0
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
    """A run whose box is off by a pixel in all frames but the first, and whose floor is too bright."""
    found = choose_anchor(boxes.image, FRAMES, boxes.num_cameras, 0)
    moved = moved_pixels(boxes.image, found, boxes.num_cameras)
    masks = boxes.masks(boxes.bodies)
    start = begin(boxes, boxes.gaussians, found, moved, CONFIG, None, jax.random.key(0), masks)
    _, run = Parts(CONFIG).start(boxes, start)
    motions, center = boxes.boxes[0].motions(), np.asarray(start.canonical.centers)[1]
    quats, translations = run.kept.quats.copy(), run.kept.translations.copy()
    quats[:, 1] = Rotation.from_matrix(motions[:, :3, :3]).as_quat(scalar_first=True)
    translations[:, 1] = motions[:, :3, :3] @ center + motions[:, :3, 3] - center
    translations[1:, 1, 0] += float(start.canonical.pixel)
    bright = eqx.tree_at(lambda g: g.sh0, start.canonical.fixed, start.canonical.fixed.sh0 + _BRIGHTER)
    canonical = run.kept.canonical._replace(fixed=bright)
    kept = run.kept._replace(
        canonical=canonical, quats=quats, translations=translations, found=np.arange(FRAMES), frame=2
    )
    return run.having(kept=kept)


def refined(boxes, astray, config):
    """`info` of each refinement step, and the parameters after it."""
    method, problem, kept = Parts(config), Problem(boxes), astray.kept
    poses = HandlePose(jnp.asarray(kept.quats), jnp.asarray(kept.translations))
    params = jax.tree.map(jnp.copy, RefineParams(kept.canonical.movable, kept.canonical.fixed, poses))
    run = Run(params, refine_step(config).init(params), method.steps_of_frames(problem), kept=kept)
    infos, after = [], []
    for now in drive(method, problem, run):
        infos.append(jax.device_get(now.info))
        after.append(jax.device_get(now.run.params))
    return infos, after


def off_mm(boxes, astray, translations):
    """Position error of the box in each frame, millimetres."""
    center = np.asarray(astray.kept.canonical.centers)[1]
    motions = boxes.boxes[0].motions()
    true = motions[:, :3, :3] @ center + motions[:, :3, 3] - center
    return 1000 * np.linalg.norm(translations[:, 1] - true, axis=1)


@pytest.mark.thorough
def test_frames_are_loaded_once_while_there_is_room(boxes, monkeypatch):
    loaded: list[int] = []
    problem, order = Problem(boxes), [0, 2, 1, 2, 0, 1, 1, 2]
    frames = [boxes.frame(t) for t in range(FRAMES)]
    brighter = frames[0].images.at[0, 0, 0].set(1.003)  # above 1, as in resampled images
    frames[0] = eqx.tree_at(lambda frame: frame.images, frames[0], brighter)
    monkeypatch.setattr(MovingBoxes, "frame", lambda self, t: loaded.append(t) or frames[t])
    for t in order:
        pictures = np.round(255 * np.minimum(np.asarray(frames[t].images), 1))
        np.testing.assert_array_equal(stored_frame(problem, t).images, pictures)
    assert loaded == [0, 2, 1]
    one = sum(leaf.nbytes for leaf in jax.tree.leaves(stored_frame(problem, 0)))
    monkeypatch.setattr("gsjax.methods.parts.pictures._ROOM", 2 * one)
    problem.stored.clear()
    loaded.clear()
    for t in order:
        stored_frame(problem, t)
    assert loaded == [0, 2, 1, 2, 1, 2]  # the first stays, and the newest


@pytest.mark.slow
def test_colours_and_poses_come_back(boxes, astray):
    infos, after = refined(boxes, astray, CONFIG)
    losses = np.array([info["loss"] for info in infos])
    assert len(losses) == 60
    assert losses[-9:].mean() < 0.6 * losses[:9].mean()
    assert not any(info["skipped"] for info in infos)
    poses = after[-1].poses
    assert off_mm(boxes, astray, astray.kept.translations)[1:].min() > 14  # a pixel
    assert off_mm(boxes, astray, poses.translations).max() < 6
    np.testing.assert_array_equal(poses.quats[0], astray.kept.quats[0])  # the canonical pose stays
    np.testing.assert_array_equal(poses.translations[0], 0)
    np.testing.assert_array_equal(poses.translations[:, 0], 0)  # the background stands still
    brighter = after[-1].fixed.sh0 - np.asarray(astray.kept.canonical.fixed.sh0) + _BRIGHTER
    assert abs(np.median(brighter)) < 0.8 * _BRIGHTER  # it falls by 0.0025 a step at most


@pytest.mark.thorough
def test_the_papers_scene_stays(boxes, astray):
    assert refined(boxes, astray, replace(CONFIG, refine=RefineConfig(iterations=0))) == ([], [])


@pytest.mark.thorough
def test_the_result_is_what_was_refined(boxes, astray):
    config = replace(CONFIG, refine=RefineConfig(iterations=2))
    run = astray.having(step=Parts(config).steps_of_frames(Problem(boxes)))
    *_, now = drive(Parts(config), Problem(boxes), run)
    moved = now.result.scene.gaussians.sh0[astray.kept.order]
    movable, fixed, _ = now.run.params
    np.testing.assert_array_equal(moved, jnp.concatenate([movable.sh0, fixed.sh0]))
    assert now.result.done.all()


@pytest.mark.parametrize(("cameras", "each"), [(3, 4), (27, 2), (6, 3)])
def test_pictures_are_used_equally_often(cameras, each):
    frames = (0, 2, 3, 7)
    order = order_of_pictures(0, frames, cameras, each * len(frames) * cameras)
    times = {(t, c): order.count((t, c)) for t in frames for c in range(cameras)}
    assert sum(times.values()) == len(order)
    assert max(times.values()) - min(times.values()) <= 1 + (cameras > 4)  # the last round is partial
    assert order != order_of_pictures(1, frames, cameras, len(order))


def test_by_default_each_picture_has_two_steps(boxes):
    method = Parts(replace(CONFIG, refine=RefineConfig()))
    assert method.steps_of_refinement(Problem(boxes)) == 400  # the minimum, for few pictures
    still = linear(150, (0, 0, 0))
    longer = MovingBoxes([Box((0, 0, 0.05), (0.12, 0.08, 0.1), still, still)])
    assert method.steps_of_refinement(Problem(longer)) == 2 * 150 * longer.num_cameras > 400


def test_settings_without_meaning_are_refused():
    with pytest.raises(ValueError, match=r"refine\.iterations: expected at least 0, found -1"):
        RefineConfig(iterations=-1)
    with pytest.raises(ValueError, match=r"refine\.rate: expected at least 0, found nan"):
        RefineConfig(rate=float("nan"))
