"""Stereo depth against the exact depth of a simulated endoscope."""

import cv2
import numpy as np
import pytest

import gsjax
from gsjax.perception.stereo import StereoConfig, stereo_depth


@pytest.fixture(scope="module")
def eyes():
    """Frame 0 of the simulated tissue: images, view matrices, Ks, and the left camera's exact depth."""
    seen = gsjax.open_sequence("simulated:tissue?width=240&height=192&frames=1")
    return seen.image(0, 0), seen.image(0, 1), seen.viewmats[0], seen.Ks[0], seen.depth(0, 0)


def errors(found, true):
    """Errors in millimetres where there is depth, and the fraction of pixels with depth."""
    known = (found > 0) & (true > 0)
    return 1e3 * np.abs(found - true)[known], known.sum() / (true > 0).sum()


def turned(viewmat, turn):
    return np.block([[turn, np.zeros((3, 1))], [np.zeros(3), 1]]) @ viewmat


def about(axis, degrees):
    c, s = np.cos(np.deg2rad(degrees)), np.sin(np.deg2rad(degrees))
    return {
        "x": np.array([[1, 0, 0], [0, c, -s], [0, s, c]]),
        "z": np.array([[c, -s, 0], [s, c, 0], [0, 0, 1]]),
    }[axis]


def seen_turned(image, turn, K):
    """The image of a camera rotated about its centre: the homography K R K^-1."""
    centers = np.array([[1, 0, -0.5], [0, 1, -0.5], [0, 0, 1]])
    warp = centers @ K @ turn @ np.linalg.inv(K) @ np.linalg.inv(centers)
    return cv2.warpPerspective(image, warp, image.shape[1::-1], flags=cv2.INTER_CUBIC)


class TestDepth:
    def test_is_that_of_the_simulation(self, eyes):
        left, right, viewmats, Ks, true = eyes
        off, covered = errors(stereo_depth(left, right, viewmats, Ks), true)
        assert np.median(off) < 0.6  # at 105 mm, where 1/16 pixel is 0.75 mm
        assert np.quantile(off, 0.95) < 3
        assert covered > 0.9

    def test_goes_with_the_unit_of_the_poses(self, eyes):
        left, right, viewmats, Ks, _ = eyes
        far = viewmats.copy()
        far[:, :3, 3] *= 1000
        one, other = (stereo_depth(left, right, poses, Ks) for poses in (viewmats, far))
        np.testing.assert_allclose(other, 1000 * one, rtol=1e-5)

    @pytest.mark.parametrize("turn", [about("z", 3.0), about("x", 1.5)])
    def test_of_an_eye_that_is_turned(self, eyes, turn):
        """The rotated camera's image is rectified."""
        left, right, viewmats, Ks, true = eyes
        askew = np.stack([viewmats[0], turned(viewmats[1], turn)])
        off, covered = errors(stereo_depth(left, seen_turned(right, turn, Ks[1]), askew, Ks), true)
        assert np.median(off) < 0.8
        assert covered > 0.85

    def test_of_eyes_one_above_the_other(self, eyes):
        """Both cameras rotated by 90 degrees: the depth is that of the rotated image."""
        left, right, viewmats, Ks, true = eyes
        quarter, height = about("z", 90.0), left.shape[0]
        K = np.stack([[[k[1, 1], 0, height - k[1, 2]], [0, k[0, 0], k[0, 2]], [0, 0, 1]] for k in Ks])
        poses = np.stack([turned(v, quarter) for v in viewmats])
        found = stereo_depth(*(np.ascontiguousarray(np.rot90(i, -1)) for i in (left, right)), poses, K)
        off, covered = errors(np.rot90(found), true)
        assert np.median(off) < 0.6
        assert covered > 0.9

    def test_of_what_the_other_eye_does_not_see_is_unknown(self, eyes):
        left, right, viewmats, Ks, true = eyes
        found = stereo_depth(left, right, viewmats, Ks)
        shift = Ks[0, 0, 0] * np.linalg.norm(viewmats[1, :3, 3] - viewmats[0, :3, 3]) / true
        unseen = np.arange(left.shape[1]) + 1 < shift
        assert unseen.sum() > 500
        assert (found[unseen] == 0).mean() > 0.99

    def test_of_what_has_no_pattern_is_unknown(self, eyes):
        left, right, viewmats, Ks, _ = eyes
        blank = [image.copy() for image in (left, right)]
        for image in blank:
            image[60:120, 80:180] = 130
        found = stereo_depth(*blank, viewmats, Ks)
        assert (found[70:110, 110:150] == 0).all()
        assert (found[130:180, 110:150] > 0).mean() > 0.9

    def test_of_pictures_of_one_colour_is_unknown(self, eyes):
        _, _, viewmats, Ks, _ = eyes
        grey = np.full((64, 80, 3), 128, np.uint8)
        assert not stereo_depth(grey, grey, viewmats, Ks).any()


def test_what_cannot_be_matched_is_named(eyes):
    left, right, viewmats, Ks, _ = eyes
    with pytest.raises(ValueError, match="right: expected shape"):
        stereo_depth(left, right[1:], viewmats, Ks)
    with pytest.raises(ValueError, match="found both at one place"):
        stereo_depth(left, right, viewmats[[0, 0]], Ks)
    behind = viewmats.copy()
    behind[1] = behind[0]
    behind[1, 2, 3] += 0.01
    with pytest.raises(ValueError, match="found one in front of the other"):
        stereo_depth(left, right, behind, Ks)
    away = np.stack([viewmats[0], turned(viewmats[1], about("x", 120.0))])
    with pytest.raises(ValueError, match="look in similar directions"):
        stereo_depth(left, right, away, Ks)
    with pytest.raises(ValueError, match="block: expected an odd number"):
        StereoConfig(block=4)
    with pytest.raises(ValueError, match="range_share: expected above 0"):
        StereoConfig(range_share=0)
