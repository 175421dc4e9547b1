"""`gsjax.engine.verbs.parts`: from a sequence as opened to editable parts."""

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from gsjax.data import Sequence
from gsjax.engine.checkpoint import load, save
from gsjax.engine.verbs import parts
from gsjax.methods.parts import DiscoverConfig, PartsConfig, RefineConfig, StreamConfig
from gsjax.scene.feature_grid import FeatureGridConfig
from tests.methods.parts.moving_boxes import Box, MovingBoxes, linear

FRAMES, HELD_OUT = 3, 7
CONFIG = PartsConfig(
    discover=DiscoverConfig(most_parts=2, lift_iterations=3),
    stream=StreamConfig(iterations=3, coarse=0.0),
    refine=RefineConfig(iterations=2),
    grid=FeatureGridConfig(2, 4, 16, 8, 2, 8),
)


@pytest.fixture(scope="module")
def boxes():
    turning = Box((0, 0, 0.05), (0.12, 0.08, 0.1), linear(FRAMES, (0, 0, 0.3)), linear(FRAMES, (0, 0.1, 0)))
    return MovingBoxes([turning])


@pytest.fixture(scope="module")
def sequence(boxes):
    Ks, viewmats = (np.asarray(a, np.float64) for a in (boxes.cameras.K, boxes.cameras.viewmat))
    return Sequence(
        name="boxes",
        camera_ids=(5, 6, HELD_OUT),
        width=boxes.cameras.width,
        height=boxes.cameras.height,
        times=1.7e9 + boxes.times,  # of day
        frame_ids=tuple(range(FRAMES)),
        Ks=np.tile(Ks, (FRAMES, 1, 1, 1)),
        viewmats=np.tile(viewmats, (FRAMES, 1, 1, 1)),
        load_image=boxes.image,
    )


@pytest.fixture(scope="module")
def segmenter(boxes):
    """A segmenter that returns the true masks of the canonical frame."""
    masks = boxes.masks(boxes.bodies)

    def segment(image, depth, K):
        return next(masks[c] for c in range(3) if (boxes.image(0, c) == image).all())

    return segment


@pytest.mark.thorough
def test_a_discovery_is_stored_and_goes_on_to_the_same_bits(boxes, sequence, segmenter, tmp_path):
    given = {"eval_cameras": [HELD_OUT], "anchor": 0, "gaussians": boxes.gaussians, "segmenter": segmenter}
    steps = []
    for now in parts(sequence, CONFIG, **given):
        steps.append(float(now.info["loss"]))
        if now.step == 4:
            save(tmp_path / "run.npz", now)
    assert len(steps) == 3 * (FRAMES - 1) + 2
    assert np.isfinite(steps).all()
    loaded = load(tmp_path / "run.npz")
    assert loaded.result.done.tolist() == [True, True, False]  # step 4 is within the last frame
    assert len(loaded.result.layer.trajectory.times) == 2
    *_, again = parts(sequence, loaded.method.config, eval_cameras=[HELD_OUT], after=loaded)
    for a, b in zip(jax.tree.leaves(again.result), jax.tree.leaves(now.result), strict=True):
        np.testing.assert_array_equal(a, b)
    np.testing.assert_allclose(now.result.trajectory.times, boxes.times, atol=1e-6)
    assert now.result.weights.shape == (boxes.gaussians.num, now.result.scene.num_parts)
    assert sorted(now.result.joints()) == list(range(1, now.result.scene.num_parts))


@pytest.mark.thorough
def test_custom_losses_are_told_the_frame_the_camera_and_the_progress(sequence, boxes, segmenter):
    def centroid(image):
        """The relative centroid of brightness, which resizing and exposure hardly change."""
        shares = [(jnp.arange(size) + 0.5) / size for size in image.shape[:2]]
        return jnp.stack([shares[0] @ image.sum((1, 2)), shares[1] @ image.sum((0, 2))]) / image.sum()

    tracked = sequence.select(cameras=[5, 6])
    pictures = jnp.asarray([tracked.frame(t).colors for t in range(FRAMES)], jnp.float32)
    centroids = jax.vmap(jax.vmap(centroid))(pictures)

    def elsewhere(scene, rendered, frame, *, index, camera):
        distances = jnp.linalg.norm(centroids - centroid(frame.images[0]), axis=-1)
        return 1.0 * (distances.argmin() != index * 2 + camera)

    def done(scene, rendered, frame, *, progress):
        return 1.0 * progress

    given = {"eval_cameras": [HELD_OUT], "anchor": 0, "gaussians": boxes.gaussians, "segmenter": segmenter}
    told = [now.info["extra"] for now in parts(sequence, CONFIG, extra_losses=(elsewhere, done), **given)]
    assert not any(one["elsewhere"] for one in told)
    steps = [np.arange(3) / 3] * (FRAMES - 1) + [np.arange(2) / 2]
    np.testing.assert_allclose([one["done"] for one in told], np.concatenate(steps), atol=1e-6)


def test_a_camera_to_hold_out_that_is_not_there_is_named(sequence):
    with pytest.raises(ValueError, match=r"eval_cameras: expected ids of cameras, \[5, 6, 7\], found 9"):
        parts(sequence, CONFIG, eval_cameras=[9])


@pytest.mark.thorough
def test_gaussians_need_their_frame_named(boxes, sequence):
    with pytest.raises(ValueError, match="anchor: expected the frame that the given Gaussians show"):
        parts(sequence, CONFIG, gaussians=boxes.gaussians)


@pytest.mark.thorough
def test_one_camera_is_refused(boxes, sequence, segmenter):
    given = {"anchor": 0, "gaussians": boxes.gaussians, "segmenter": segmenter}
    with pytest.raises(ValueError, match="cameras: expected at least 2, synchronised, found 1"):
        parts(sequence, replace(CONFIG, seed=1), eval_cameras=[6, HELD_OUT], **given)
