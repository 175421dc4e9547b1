import cv2
import numpy as np
import pytest

from gsjax.data import DataError
from gsjax.data.lens import Lens, intrinsics_matrix, scaled_intrinsics, undistort
from tests.data.dots import draw, inside, offset

WIDTH, HEIGHT = 240, 180
K = np.array([[190.0, 0, 124], [0, 184, 87], [0, 0, 1]])
LENSES = {
    "barrel": Lens(K, (-0.25, 0.06, 0.0, 0.0)),
    "pincushion": Lens(K, (0.2, 0.05, 0.0, 0.0)),
    "tangential, 5": Lens(K, (-0.2, 0.05, 0.004, -0.003, 0.01)),
    "rational, 8": Lens(K, (0.1, 0.02, 0.002, 0.001, 0.0, 0.3, 0.05, 0.01)),
    "fisheye": Lens(K, (-0.03, 0.02, -0.01, 0.002), fisheye=True),
    "fisheye of zeros": Lens(K, (0.0, 0.0, 0.0, 0.0), fisheye=True),
    "wide fisheye": Lens(
        np.diag([0.45, 0.45, 1]) @ K + np.array([[0, 0, 68], [0, 0, 50], [0, 0, 0]]), (0.02, 0, 0, 0), True
    ),
}
each_lens = pytest.mark.parametrize("lens", LENSES.values(), ids=LENSES)


def photographed(lens, rays):
    """Pixels of points (x, y, 1) in the distorted photograph, by OpenCV, whose pixel centres are integers."""
    own, coeffs = lens.K - np.array([[0, 0, 0.5], [0, 0, 0.5], [0, 0, 0]]), np.array(lens.coeffs)
    rays, still = np.array(rays, float).reshape(-1, 1, 3), np.zeros(3)
    if lens.fisheye:
        pixels, _ = cv2.fisheye.projectPoints(rays, still, still, own, coeffs)
    else:
        pixels, _ = cv2.projectPoints(rays, still, still, own, coeffs)
    return pixels.reshape(-1, 2) + 0.5


@each_lens
def test_dots_of_a_distorted_photograph_are_where_the_pinhole_camera_sees_them(lens):
    ideal, undistorted = undistort(lens, WIDTH, HEIGHT)
    targets = [(x, y) for x in range(15, WIDTH, 30) for y in range(15, HEIGHT, 30)]
    rays = [np.linalg.inv(ideal) @ [x, y, 1] for x, y in targets]
    picture = undistorted(draw(WIDTH, HEIGHT, photographed(lens, rays)), cv2.INTER_LINEAR)
    assert picture.shape == (HEIGHT, WIDTH, 3)
    assert max(offset(picture, target) for target in targets) < 0.2  # wide lenses stretch dots
    assert np.median([offset(picture, target) for target in targets]) < 0.13


@each_lens
def test_the_view_has_no_blank_pixels_and_is_the_largest_such(lens):
    ideal, undistorted = undistort(lens, WIDTH, HEIGHT)
    assert (undistorted(np.full((HEIGHT, WIDTH), 255, np.uint8), cv2.INTER_LINEAR) == 255).all()
    x, y = np.linspace(0.5, WIDTH - 0.5, 41), np.linspace(0.5, HEIGHT - 0.5, 31)
    border = [(a, b) for a in x for b in y if a in x[[0, -1]] or b in y[[0, -1]]]
    pixels = photographed(lens, [np.linalg.inv(ideal) @ [a, b, 1] for a, b in border])
    gaps = np.concatenate([pixels, [WIDTH, HEIGHT] - pixels], axis=1)
    assert gaps.min() > -0.5
    widest = np.rad2deg(np.arctan(ideal[0, 2] / ideal[0, 0]))
    assert gaps.min() < 3 or widest == pytest.approx(70, abs=1)


def test_a_lens_that_sees_more_than_a_right_angle_keeps_its_axis():
    lens = Lens(np.array([[60.0, 0, 110], [0, 60, 95], [0, 0, 1]]), (0.01, 0, 0, 0), fisheye=True)
    ideal, _ = undistort(lens, WIDTH, HEIGHT)
    np.testing.assert_allclose(ideal[:2, 2], [110, 95], atol=1e-9)
    seen = np.rad2deg(np.arctan((WIDTH - 110) / ideal[0, 0]))
    assert 60 < seen < 70.5
    np.testing.assert_allclose(ideal[0, 0], ideal[1, 1])


@each_lens
def test_masks_and_depths_are_not_mixed(lens):
    _, undistorted = undistort(lens, WIDTH, HEIGHT)
    depth = np.where(np.arange(WIDTH) < 124, 1.0, 3.0) * np.ones((HEIGHT, 1))
    moved = undistorted(depth.astype(np.float32), cv2.INTER_NEAREST)
    assert set(np.unique(moved)) == {1.0, 3.0}


def test_nearest_takes_the_nearest():
    """Depth that rises by 1 per column reveals which pixel was taken: never one farther than half a pixel."""
    lens = LENSES["barrel"]
    ideal, undistorted = undistort(lens, WIDTH, HEIGHT)
    taken = undistorted(
        np.arange(WIDTH, dtype=np.float32) * np.ones((HEIGHT, 1), np.float32), cv2.INTER_NEAREST
    )
    targets = [(x + 0.5, y + 0.5) for x in range(10, WIDTH, 13) for y in range(10, HEIGHT, 13)]
    expected = photographed(lens, [np.linalg.inv(ideal) @ [x, y, 1] for x, y in targets])[:, 0]
    found = np.array([taken[int(y), int(x)] + 0.5 for x, y in targets])
    assert np.abs(found - expected).max() < 0.55


@pytest.mark.parametrize("coeffs", [(), (0.0, 0.0, 0.0, 0.0)])
def test_a_pinhole_camera_is_left_alone(coeffs):
    ideal, undistorted = undistort(Lens(K, coeffs), WIDTH, HEIGHT)
    picture = draw(WIDTH, HEIGHT, [(30, 40)])
    assert undistorted(picture, cv2.INTER_LINEAR) is picture
    np.testing.assert_array_equal(ideal, K)


def test_a_smaller_copy_has_the_same_rays():
    half = scaled_intrinsics(K, (WIDTH, HEIGHT), (120, 90), "a.png")
    np.testing.assert_allclose(half @ [0.1, -0.2, 1], np.array([0.5, 0.5, 1]) * (K @ [0.1, -0.2, 1]))
    odd = scaled_intrinsics(K, (WIDTH, HEIGHT), (80, 59), "a.png")  # a rounded size is not another shape
    np.testing.assert_allclose(odd[1] / K[1].clip(1e-9), [0, 59 / 180, 59 / 180], atol=1e-12)


@pytest.mark.parametrize(
    ("calibrated", "actual", "says"),
    [
        (
            (240, 180),
            (240, 160),
            r"a.png: expected 240x180 pixels or a downscaled copy, found 240x160\. Give",
        ),
        ((240, 180), (90, 120), r"found 90x120\. .*rotated by 90 degrees"),
        ((0, 180), (240, 180), r"a.png: expected a width and a height above 0, found 0x180"),
        ((-240, -180), (240, 180), r"found -240x-180"),
    ],
)
def test_photographs_of_another_shape(calibrated, actual, says):
    with pytest.raises(DataError, match=says) as raised:
        scaled_intrinsics(K, calibrated, actual, "a.png")
    assert ("rotated" in str(raised.value)) == (actual == (90, 120))


def test_dots_know_where_they_are():
    picture = draw(WIDTH, HEIGHT, [(30.3, 40.6)])
    assert offset(picture, (30.3, 40.6)) < 0.02
    assert offset(picture, (30.8, 40.6)) == pytest.approx(0.5, abs=0.05)
    assert offset(picture, (100, 100)) == np.inf
    assert inside((7, 7), WIDTH, HEIGHT)
    assert not inside((7, HEIGHT - 5), WIDTH, HEIGHT)


def test_intrinsics_as_a_matrix_or_as_four_numbers():
    K = [[60.0, 0, 32], [0, 61, 24], [0, 0, 1]]
    np.testing.assert_array_equal(intrinsics_matrix((60, 61, 32, 24)), K)
    np.testing.assert_array_equal(intrinsics_matrix(np.array(K)), K)
    with pytest.raises(ValueError, match=r"K must be 3x3 or fx, fy, cx, cy; got shape \(2,\)"):
        intrinsics_matrix(np.zeros(2))
