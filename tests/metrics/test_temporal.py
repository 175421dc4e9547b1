"""Temporal consistency of videos whose motion is known for every pixel."""

import math

import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.ndimage import gaussian_filter

from gsjax.data.simulated.articulated import articulated
from gsjax.metrics.image import psnr, ssim
from gsjax.metrics.perceptual import LpipsWeights, lpips
from gsjax.metrics.temporal import (
    Flows,
    along_flow,
    between_neighbors,
    flow_warp_error,
    t_lpips,
    t_ssim,
    temporal_scores,
    unit_frames,
    video_flows,
)
from gsjax.perception.optical_flow import DisFlow

seeds = st.integers(0, 10_000)
FRAMES, HEIGHT, WIDTH, STEP = 4, 24, 32, 2


def panned(seed=0, step=STEP):
    """A window that moves left over a pattern by whole pixels, so that its content moves right."""
    rng = np.random.default_rng(seed)
    pattern = gaussian_filter(rng.uniform(size=(HEIGHT, WIDTH + step * FRAMES, 3)), (1, 1, 0))
    starts = step * np.arange(FRAMES)[::-1]
    return np.stack([pattern[:, start : start + WIDTH] for start in starts])


def flows_to_the_right(step=STEP):
    forward = np.zeros((FRAMES - 1, HEIGHT, WIDTH, 2))
    forward[..., 0] = step
    return Flows(forward, -forward)


def network(seed=0):
    """AlexNet with random weights."""
    rng, convolutions, before = np.random.default_rng(seed), [], 3
    for channels, size in ((64, 11), (192, 5), (384, 3), (256, 3), (256, 3)):
        kernel = rng.normal(size=(channels, before, size, size)) / math.sqrt(before * size * size / 2)
        convolutions.append((jnp.asarray(kernel, float), jnp.zeros(channels)))
        before = channels
    heads = tuple(jnp.asarray(rng.uniform(size=len(bias)), float) for _, bias in convolutions)
    return LpipsWeights("AlexNet", tuple(convolutions), heads)


@given(seeds)
def test_along_the_true_flow_nothing_changes(seed):
    video, flows = panned(seed), flows_to_the_right()
    found = flow_warp_error(video, flows)
    assert found.error == pytest.approx(0, abs=1e-12)
    assert found.share == pytest.approx(1 - STEP / WIDTH)  # pixels that leave on the right are not compared
    assert along_flow(ssim, video, flows) == pytest.approx(1)
    assert t_ssim(video) < 0.9


@given(seeds, st.floats(0.1, 0.9), st.floats(-0.2, 0.2))
def test_the_error_is_one_of_contrast_and_not_of_brightness(seed, contrast, brightness):
    video, still = panned(seed), Flows(*np.zeros((2, FRAMES - 1, HEIGHT, WIDTH, 2)))
    plain = np.abs(np.diff(video, axis=0)).mean()
    assert flow_warp_error(video, still) == pytest.approx((plain, 1.0))
    assert flow_warp_error(contrast * video + brightness, still).error == pytest.approx(contrast * plain)


def test_flicker_is_as_large_as_it_is():
    video = panned() / 2
    video[1::2] += 0.25
    assert flow_warp_error(video, flows_to_the_right()).error == pytest.approx(0.25)


def test_what_a_mask_hides_counts_neither_where_it_was_nor_where_it_goes():
    video, masks = panned(), np.ones((FRAMES, HEIGHT, WIDTH), bool)
    video[2, 5:9, 10:14] = 1.0
    masks[2, 5:9, 10:14] = False
    assert flow_warp_error(video, flows_to_the_right()).error > 1e-3
    found = flow_warp_error(video, flows_to_the_right(), masks)
    assert found.error == pytest.approx(0, abs=1e-12)
    # In the last pair the 16 hidden pixels are outside the mask; in the one before they count, but are not
    # compared.
    masked = 3 * HEIGHT * WIDTH - 16
    assert found.share == pytest.approx((masked - 16 - 3 * STEP * HEIGHT) / masked)
    assert along_flow(psnr, video, flows_to_the_right(), masks) > 100
    nothing = flow_warp_error(video, flows_to_the_right(), np.zeros_like(masks))
    assert math.isnan(nothing.error)
    assert math.isnan(nothing.share)


def test_neighbours_are_compared_where_both_masks_are_true():
    video, masks = panned(), np.zeros((FRAMES, HEIGHT, WIDTH), bool)
    masks[1, :12], masks[2, 6:] = True, True
    both = np.zeros((HEIGHT, WIDTH), bool)
    both[6:12] = True
    expected = psnr(video[2], video[1], both)  # the other pairs of masks do not overlap
    assert between_neighbors(psnr, video, masks) == pytest.approx(expected)
    assert math.isnan(between_neighbors(psnr, video, np.zeros_like(masks)))


@given(seeds)
def test_backwards_a_video_is_as_steady(seed):
    video = panned(seed)
    assert t_ssim(video[::-1]) == pytest.approx(t_ssim(video))
    assert t_ssim(video) == pytest.approx(np.mean([ssim(video[t], video[t + 1]) for t in range(FRAMES - 1)]))


def test_lpips_of_neighbours_is_the_mean_over_pairs():
    weights, video = network(), np.random.default_rng(0).uniform(size=(3, 31, 33, 3))
    expected = (lpips(weights, video[1], video[0]) + lpips(weights, video[2], video[1])) / 2
    assert t_lpips(weights, video) == pytest.approx(expected)
    assert t_lpips(weights, video[:1].repeat(3, axis=0)) == pytest.approx(0, abs=1e-6)


def test_a_video_that_stands_still_is_steadiest_and_the_gap_to_the_truth_says_so():
    truth = panned()
    frozen = truth[:1].repeat(FRAMES, axis=0)
    shaky = np.clip(truth + np.random.default_rng(0).normal(0, 0.02, truth.shape), 0, 1)
    scores = {name: temporal_scores(video, truth) for name, video in (("frozen", frozen), ("shaky", shaky))}
    assert scores["frozen"]["t_ssim"] == pytest.approx(1)
    assert scores["frozen"]["t_ssim"] > scores["shaky"]["t_ssim"]
    assert scores["frozen"]["t_ssim_gap"] > 4 * scores["shaky"]["t_ssim_gap"] > 0
    assert scores["frozen"]["t_ssim_gap"] == pytest.approx(1 - t_ssim(truth))


def test_what_was_not_given_is_absent_and_the_truth_has_no_gap():
    truth = panned()
    alone = temporal_scores(truth)
    assert [name for name, score in alone.items() if score is not None] == ["t_ssim"]
    assert set(alone) == {
        *("t_ssim", "t_lpips", "flow_warp_error", "flow_warp_share", "warped_ssim", "warped_lpips")
    }
    scores = temporal_scores(truth, truth, optical_flow=DisFlow())
    assert (scores["t_lpips"], scores["t_lpips_gap"], scores["warped_lpips_gap"]) == (None, None, None)
    assert {scores[f"{name}_gap"] for name in ("t_ssim", "flow_warp_error", "warped_ssim")} == {0.0}
    assert scores["flow_warp_error"] < np.abs(np.diff(truth, axis=0)).mean() / 4
    assert "flow_warp_share_gap" not in scores


def test_with_weights_there_is_lpips():
    rng = np.random.default_rng(0)
    pattern = gaussian_filter(rng.uniform(size=(32, 40, 3)), (1, 1, 0))
    video = np.stack([pattern[:, 4 - 2 * t : 36 - 2 * t] for t in range(3)])
    scores = temporal_scores(video, optical_flow=DisFlow(), lpips_weights=network())
    assert 0 <= scores["warped_lpips"] < scores["t_lpips"]


def test_bytes_and_floats_mean_the_same():
    as_bytes = np.round(255 * panned()).astype(np.uint8)
    assert t_ssim(as_bytes) == pytest.approx(t_ssim(as_bytes / 255.0))
    assert len(list(unit_frames(as_bytes))) == FRAMES
    assert next(unit_frames(as_bytes)).max() <= 1


@pytest.mark.thorough
def test_flows_of_a_simulated_scene_explain_its_motion():
    """Forward and backward flow come from the scene, and moving pixels are compared too."""
    sequence = articulated(0, frames=9, width=120, height=90, cameras=1)
    video = np.stack([sequence.image(t, 0) for t in (5, 6, 7)])
    pairs = ((5, 6), (6, 7))
    flows = Flows(
        np.stack([sequence.load_flow(t, u, 0) for t, u in pairs]),
        np.stack([sequence.load_flow(u, t, 0) for t, u in pairs]),
    )
    moving = np.stack([np.linalg.norm(sequence.flow(t, 0), axis=-1) > 0.3 for t in (5, 6, 7)])
    still = Flows(*np.zeros((2, 2, 90, 120, 2)))
    explained, plain = flow_warp_error(video, flows, moving), flow_warp_error(video, still, moving)
    assert explained.error < plain.error / 2
    assert 0.1 < explained.share < 1
    estimated = video_flows(video, DisFlow())
    assert estimated.forward.shape == flows.forward.shape
    assert flow_warp_error(video, estimated).share > 0.5


@pytest.mark.thorough
def test_shapes_that_do_not_fit_are_named():
    video, flows = panned(), flows_to_the_right()
    with pytest.raises(ValueError, match=r"video: expected at least two frames, found 1"):
        t_ssim(video[:1])
    with pytest.raises(ValueError, match=r"video: expected shape \[T, H, W, 3\], found \(4, 24, 32\)"):
        t_ssim(video[..., 0])
    with pytest.raises(ValueError, match="video: expected uint8 or floats 0 to 1, found int64"):
        t_ssim(np.zeros(video.shape, np.int64))
    with pytest.raises(ValueError, match=r"masks: expected shape \(4, 24, 32\) to match video, found \(3,"):
        t_ssim(video, np.ones((3, HEIGHT, WIDTH), bool))
    with pytest.raises(ValueError, match=r"flows.backward: expected shape \(3, 24, 32, 2\)"):
        flow_warp_error(video, flows._replace(backward=flows.backward[1:]))
    with pytest.raises(ValueError, match=r"truth: expected shape \(4, 24, 32, 3\) to match video"):
        temporal_scores(video, video[1:])
