import warnings

import numpy as np
import pytest

from gsjax.data import (
    DataError,
    DataWarning,
    PointModel,
    ReadOptions,
    Sequence,
    Truth,
    check_depth,
    open_sequence,
)
from gsjax.data.photographs import photographs_of

FRAMES, CAMERAS, WIDTH, HEIGHT = 4, 2, 6, 5


def make(**changes):
    """A sequence whose images, depths and masks encode (t, c), to show which one was loaded."""
    K = np.array([[10.0, 0, 3], [0, 10.0, 2.5], [0, 0, 1]])

    def load_image(t, c):
        image = np.full((HEIGHT, WIDTH, 3), 10 * t + c, np.uint8)
        image[0, 0] = 255
        return image

    fields = {
        "name": "toy",
        "camera_ids": (7, 3),
        "width": WIDTH,
        "height": HEIGHT,
        "times": np.arange(FRAMES) / 30,
        "frame_ids": (10, 20, 30, 40),
        "Ks": np.broadcast_to(K, (FRAMES, CAMERAS, 3, 3)),
        "viewmats": np.broadcast_to(np.eye(4), (FRAMES, CAMERAS, 4, 4)),
        "load_image": load_image,
        "load_depth": lambda t, c: np.full((HEIGHT, WIDTH), 1 + t + 0.1 * c, np.float32),
        "load_mask": lambda t, c: np.full((HEIGHT, WIDTH), 10 * t + c, np.uint8) if c == 0 else None,
        "load_flow": lambda t, u, c: np.full((HEIGHT, WIDTH, 2), 100.0 * t + 10 * u + c),
    }
    return Sequence(**fields | changes)


def poses(frames=FRAMES, count=CAMERAS):
    return np.tile(np.eye(4), (frames, count, 1, 1))


def test_frames_are_loaded_as_declared():
    sequence = make()
    assert (sequence.num_frames, sequence.num_cameras) == (FRAMES, CAMERAS)
    assert sequence.has_depth
    assert sequence.has_masks
    assert sequence.has_flow
    assert sequence.image(2, 1)[1, 1, 0] == 21
    assert sequence.depth(2, 1)[0, 0] == np.float32(3.1)
    assert sequence.mask(2, 0).dtype == np.int32
    assert sequence.mask(2, 1) is None
    assert sequence.flow(1, 1)[0, 0, 0] == 121


def test_nothing_is_kept_between_calls():
    calls = []

    def load_image(t, c):
        calls.append((t, c))
        return np.arange(HEIGHT * WIDTH * 3, dtype=np.uint8).reshape(HEIGHT, WIDTH, 3)

    sequence = make(load_image=load_image)
    assert calls == []
    sequence.image(0, 0)
    sequence.image(0, 0)
    assert calls == [(0, 0), (0, 0)]


def test_optional_images_may_be_absent():
    sequence = make(load_depth=None, load_mask=None, load_flow=None)
    assert [sequence.has_depth, sequence.has_masks, sequence.has_flow] == [False] * 3
    assert sequence.depth(0, 0) is None
    assert sequence.mask(0, 0) is None
    assert sequence.flow(0, 0) is None
    assert sequence.select(slice(1, 3)).depth(0, 0) is None


def test_camera_follows_its_frame():
    viewmats = poses()
    viewmats[2, 1, :3, 3] = 1, 2, 3
    camera = make(viewmats=viewmats).camera(2, 1)
    assert (camera.width, camera.height) == (WIDTH, HEIGHT)
    np.testing.assert_allclose(camera.viewmat[:3, 3], [1, 2, 3])
    np.testing.assert_allclose(camera.K[0], [10, 0, 3])


def test_select_takes_positions_and_camera_ids():
    truth = Truth(("a",), np.array([2]), np.tile(np.eye(4), (FRAMES, 1, 1, 1)) * 1.0)
    truth.poses[:, 0, 0, 3] = np.arange(FRAMES)
    part = make(truth=truth, locate=lambda kind, t, c: f"{kind}{t}{c}").select([1, 3], [3])
    assert part.frame_ids == (20, 40)
    assert part.camera_ids == (3,)
    assert part.image(1, 0)[1, 1, 0] == 31
    assert part.flow(0, 0)[0, 0, 0] == 131  # from frame 1 to frame 3
    assert part.locate("mask", 1, 0) == "mask31"
    np.testing.assert_array_equal(part.truth.poses[:, 0, 0, 3], [1, 3])
    again = part.select(slice(1, None), [3])
    assert again.frame_ids == (40,)
    assert again.image(0, 0)[1, 1, 0] == 31


def test_smaller_colours_are_means_and_the_rest_is_not():
    def load_image(t, c):
        image = np.zeros((HEIGHT, WIDTH, 3), np.uint8)
        image[::2, ::2] = 200  # one of the four pixels under each new one
        return image

    rising = np.arange(WIDTH, dtype=np.float32) + np.ones((4, 1), np.float32)
    sequence = make(
        height=4,
        load_image=lambda t, c: load_image(t, c)[:4],
        load_depth=lambda t, c: rising if c == 0 else None,
        load_mask=lambda t, c: (rising > 4).astype(np.int32),
        load_flow=lambda t, u, c: np.stack([rising, np.full_like(rising, 2)], -1),
    )
    half = sequence.scaled(0.5)
    assert (half.width, half.height) == (3, 2)
    assert half.image(1, 0).dtype == np.uint8
    assert (half.image(1, 0) == 50).all()
    assert half.depth(0, 0)[0].tolist() == [2.0, 4.0, 6.0]
    assert half.depth(0, 1) is None
    assert half.mask(0, 0)[0].tolist() == [0, 0, 1]
    np.testing.assert_array_equal(half.flow(0, 0)[0], [[1, 1], [2, 1], [3, 1]])  # half the pixels
    K = np.array(sequence.Ks[0, 0])
    np.testing.assert_allclose(half.Ks[0, 0], np.diag([0.5, 0.5, 1]) @ K)
    assert half.frame(0).images.shape == (2, 2, 3, 3)
    assert sequence.scaled(1.0) is sequence
    assert half.select(cameras=[3]).image(0, 0).shape == (2, 3, 3)
    bare = make(load_depth=None, load_mask=None, load_flow=None).scaled(0.5)
    assert [bare.has_depth, bare.has_masks, bare.has_flow] == [False] * 3


def test_smaller_float_pictures_have_lost_what_is_not_finite():
    def load_image(t, c):
        image = np.full((HEIGHT, WIDTH, 3), 0.5, np.float32)
        image[0, 0], image[2, 2] = np.nan, 0.0
        return image

    with pytest.warns(DataWarning, match="1 pixels are not finite; they become black"):
        small = make(load_image=load_image, float_images=True).scaled(0.5).image(0, 0)
    assert small.dtype == np.uint8
    assert small[1, 2].tolist() == [128, 128, 128]


@pytest.mark.parametrize("scale", [0.0, -1.0, 1.5, float("nan")])
def test_invalid_scales_are_refused(scale):
    with pytest.raises(ValueError, match="scale must be above 0 and at most 1, got"):
        make().scaled(scale)


def test_select_swaps_cameras():
    swapped = make().select(cameras=[3, 7])
    assert swapped.camera_ids == (3, 7)
    assert swapped.image(0, 0)[1, 1, 0] == 1


@pytest.mark.parametrize(
    ("frames", "cameras", "says"),
    [
        (slice(None), [5], r"no camera 5; it has \[7, 3\]"),
        ([0, 4], None, "no frame 4"),
        ([-1], None, "no frame -1"),
        (slice(2, 2), None, "no frame in"),
        ([2, 1], None, "increase"),
        (slice(None), [], "at least one camera"),
        (slice(None), [7, 7], "differ"),
    ],
)
def test_select_names_what_does_not_exist(frames, cameras, says):
    with pytest.raises(ValueError, match=says):
        make().select(frames, cameras)


def test_one_frame_is_a_sequence():
    assert make().select([2]).num_frames == 1


@pytest.mark.parametrize(("t", "c"), [(4, 0), (0, 2), (-1, 0)])
def test_indices_out_of_range_are_errors(t, c):
    with pytest.raises(IndexError, match="4 frames and 2 cameras"):
        make().image(t, c)


def test_flow_of_the_last_frame_is_an_error():
    with pytest.raises(IndexError):
        make().flow(3, 0)
    with pytest.raises(IndexError):
        make().flow(-1, 0)  # would be the flow from the last frame to the first


def spoil(index, value):
    matrices = poses()
    matrices[(2, 1, *index)] = value
    return matrices


@pytest.mark.parametrize(
    ("viewmats", "says"),
    [
        (
            spoil((0, 0), 2.0),
            r"viewmat of camera 3 in frame 30: R is not a rotation: \|R\^T R - I\| reaches 3",
        ),
        (spoil((0, 0), -1.0), "camera 3 in frame 30: R is a reflection"),
        (spoil((0, 0), np.nan), "camera 3 in frame 30: it contains NaN"),
        (spoil((1, 3), np.inf), "camera 3 in frame 30: it contains NaN or infinity"),
        (spoil((3, 3), 0.0), "camera 3 in frame 30: its last row is"),
    ],
)
def test_a_pose_that_is_not_a_rigid_motion_is_named(viewmats, says):
    with pytest.raises(ValueError, match=says) as caught:
        make(viewmats=viewmats)
    assert "world-to-camera" in str(caught.value)


def test_a_rotation_of_few_digits_passes():
    viewmats = poses()
    viewmats[0, 0, 0, 1] = 1e-3
    make(viewmats=viewmats)


@pytest.mark.parametrize(
    ("changes", "says"),
    [
        ({"Ks": np.zeros((FRAMES, CAMERAS, 3, 3))}, "K of camera 7 in frame 10"),
        ({"viewmats": poses(count=3)}, r"viewmats must have shape \(4, 2, 4, 4\), got \(4, 3, 4, 4\)"),
        ({"times": np.array([0.0, 1, 1, 2])}, "frame 2 is at 1.0 s after 1.0 s"),
        ({"times": np.array([0.0, np.nan, 1, 2])}, "frame 1 is at nan s"),
        ({"times": np.zeros(0), "frame_ids": ()}, "at least one frame"),
        ({"camera_ids": (3, 3)}, "differ"),
        ({"frame_ids": (1, 2)}, "frame_ids must have shape"),
        ({"frame_ids": (1, 2, 2, 3)}, r"frame_ids must differ from each other, got 2 more than once"),
    ],
)
def test_a_sequence_that_disagrees_with_itself_is_refused(changes, says):
    with pytest.raises(ValueError, match=says):
        make(**changes)


def test_truth_must_be_rigid_and_of_the_same_length():
    bad = poses(FRAMES, 2)
    bad[3, 1] *= 2
    with pytest.raises(ValueError, match="pose of object b in frame 3"):
        Truth(("a", "b"), np.array([2, 3]), bad)
    with pytest.raises(ValueError, match="label_ids"):
        Truth(("a", "b"), np.array([2]), poses(FRAMES, 2))
    with pytest.raises(ValueError, match=r"truth.poses"):
        make(truth=Truth(("a",), np.array([2]), poses(3, 1)))


def test_a_point_model_checks_its_shapes():
    fields = {"means": np.zeros((5, 3)), "quats": np.zeros((5, 4)), "scales": np.ones((5, 3))}
    fields |= {"opacities": np.ones(5), "colors": np.ones((5, 3))}
    PointModel("block", **fields)
    with pytest.raises(ValueError, match=r"block: colors must have shape \(5, 3\), got \(4, 3\)"):
        PointModel("block", **fields | {"colors": np.ones((4, 3))})
    with pytest.raises(ValueError, match="block: plane"):
        PointModel("block", **fields, plane=np.zeros(3))


@pytest.mark.parametrize(
    ("changes", "kind", "says"),
    [
        (
            {"load_image": lambda t, c: np.zeros((3, 6, 3), np.uint8)},
            "image",
            r"shape \(5, 6, 3\) of uint8",
        ),
        ({"load_image": lambda t, c: np.zeros((5, 6, 3))}, "image", "float64"),
        (
            {"load_depth": lambda t, c: np.zeros((5, 6), np.uint16)},
            "depth",
            "found shape .* of uint16. Give metres",
        ),
        ({"load_mask": lambda t, c: np.zeros((4, 6), np.uint8)}, "mask", r"found shape \(4, 6\)"),
        ({"load_mask": lambda t, c: np.zeros((5, 6))}, "mask", "of integers"),
    ],
)
def test_the_result_of_a_loader_is_checked(changes, kind, says):
    with pytest.raises(DataError, match=f"toy, {kind} of camera 7 in frame 20: .*{says}"):
        getattr(make(**changes), kind)(1, 0)


def test_cameras_that_do_not_change_are_given_once():
    K, viewmats = np.diag([10.0, 10.0, 1.0]), poses(1)[0]
    viewmats[1, 0, 3] = 0.5
    fixed = make(Ks=np.stack([K, 2 * K / [1, 1, 2]]), viewmats=viewmats)
    assert fixed.viewmats.shape == (FRAMES, CAMERAS, 4, 4)
    np.testing.assert_array_equal(fixed.viewmats[3], viewmats)
    np.testing.assert_array_equal(fixed.Ks[2, 0], K)
    with pytest.raises(ValueError, match=r"Ks must have shape \(4, 2, 3, 3\), got \(3, 3\)"):
        make(Ks=K)


def test_messages_name_the_file_where_it_is_known():
    sequence = make(
        load_mask=lambda t, c: np.zeros((4, 6), int), locate=lambda kind, t, c: f"a/{kind}/{t}.png"
    )
    with pytest.raises(DataError, match=r"a/mask/3.png: expected"):
        sequence.mask(3, 0)


def test_an_empty_image_warns():
    with pytest.warns(DataWarning, match="frame 10: the image is empty"):
        make(load_image=lambda t, c: np.zeros((HEIGHT, WIDTH, 3), np.uint8)).image(0, 0)


def test_float_pixels_that_are_not_finite_turn_black_and_lose_their_depth():
    image = np.linspace(0, 1, HEIGHT * WIDTH * 3).reshape(HEIGHT, WIDTH, 3)
    image[1, 2, 0] = np.nan
    sequence = make(load_image=lambda t, c: image, float_images=True)
    with pytest.warns(DataWarning, match="1 pixels are not finite"):
        loaded = sequence.image(0, 0)
    assert loaded.dtype == np.uint8
    assert (loaded[1, 2] == 0).all()
    assert loaded[-1, -1, -1] == 255
    depth = sequence.depth(0, 0)
    assert depth[1, 2] == 0
    assert (depth > 0).sum() == HEIGHT * WIDTH - 1


def test_depth_that_is_not_finite_is_invalid():
    cleaned = check_depth(np.array([[np.nan, np.inf, -1.0], [1.0, 1e10, 1e300]]), "depth")
    np.testing.assert_array_equal(cleaned, np.array([[0, 0, 0], [1, 0, 0]], np.float32))
    assert cleaned.dtype == np.float32


def test_depth_without_a_valid_pixel_warns():
    with pytest.warns(DataWarning, match="frame 10: no pixel has a valid depth"):
        depth = make(load_depth=lambda t, c: np.zeros((HEIGHT, WIDTH))).depth(0, 0)
    assert (depth == 0).all()


@pytest.mark.parametrize("scale", [1000.0, 0.001])
def test_depth_in_the_wrong_unit_is_an_error(scale):
    with pytest.raises(DataError, match=r"depth of camera 7 in frame 10: .*depth_unit_m"):
        make(load_depth=lambda t, c: np.full((HEIGHT, WIDTH), scale)).depth(0, 0)


@pytest.mark.parametrize("median", [0.03, 1.0, 40.0])
def test_usual_depth_passes_without_a_warning(median):
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        check_depth(np.full((3, 4), median), "depth")


def test_the_near_distance_is_kept_by_everything_derived_from_a_sequence():
    sequence = make(near=0.4)
    assert sequence.select(cameras=[3]).scaled(0.5).camera(0, 0).near == 0.4
    assert sequence.frame(1).cameras.near == 0.4
    assert photographs_of(sequence).camera(0).near == 0.4
    read = ReadOptions(near=0.3)
    assert open_sequence("simulated:articulated?width=48&height=36&cameras=2", read).near == 0.3
    with pytest.raises(ValueError, match="near: expected 0 or more, found -1"):
        ReadOptions(near=-1)


def test_frames_are_selected_by_a_mask_too():
    sequence = make()
    mask = np.array([False, True, True, False])
    assert sequence.select(mask).frame_ids == sequence.select([1, 2]).frame_ids
    with pytest.raises(ValueError, match=r"a mask of length 4, found a mask of \(2,\)"):
        sequence.select(mask[:2])
