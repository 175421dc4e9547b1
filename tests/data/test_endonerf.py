"""EndoNeRF's layout: a moving stereo endoscope and three dots, drawn as the format defines them."""

import json
import warnings

import cv2
import numpy as np
import pytest

from gsjax.data import (
    DataError,
    DataWarning,
    ReadOptions,
    open_photographs,
    open_sequence,
    photographs_of,
    read_endonerf,
)
from gsjax.data.ordered import open_as_sequence
from gsjax.geometry.cameras import look_at
from tests.data import dots
from tests.data.test_poses_bounds import HEIGHT, WIDTH, K, row

FRAMES, BASELINE_M, UNIT_M = 4, 0.01, 0.0001
POINTS = np.array([[0.01, 0.005, 0.0], [-0.012, 0.006, 0.008], [0.004, -0.01, -0.01]])
LEFT = [look_at(np.array([0.004 * t, -0.08, 0.01 + 0.004 * t]), np.zeros(3)) for t in range(FRAMES)]
# The other eye is to the right: in its view everything lies further left.
RIGHT = [np.array([[1, 0, 0, -BASELINE_M], [0, 1, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]]) @ v for v in LEFT]
DEPTH = np.linspace(500, 1000, HEIGHT * WIDTH).reshape(HEIGHT, WIDTH).astype(np.uint16)
META = {"fps": 25, "baseline_m": BASELINE_M, "depth_unit_m": UNIT_M}


def tool_mask(t):
    """The tool, a moving column."""
    mask = np.zeros((HEIGHT, WIDTH), bool)
    mask[:, 10 * t : 10 * t + 8] = True
    return mask


def build_eye(root, viewmats, kind="png"):
    for t, viewmat in enumerate(viewmats):
        image = dots.draw(WIDTH, HEIGHT, [dots.project(K, viewmat, point) for point in POINTS])
        dots.save(root / f"images/frame-{t + 3:06d}.color.{kind}", image)
        dots.save(root / f"masks/frame-{t + 3:06d}.mask.{kind}", 255 * tool_mask(t).astype(np.uint8))
        dots.save(root / f"depth/frame-{t + 3:06d}.depth.png", DEPTH)


@pytest.fixture
def folder(tmp_path):
    root = tmp_path / "pulling"
    build_eye(root, LEFT)
    build_eye(root / "right", RIGHT)
    rows = [[*row(viewmat, "endonerf")[:15], 0.05, 0.1] for viewmat in LEFT]
    np.save(root / "poses_bounds.npy", np.array(rows))
    (root / "meta.json").write_text(json.dumps(META))
    return root


def write_meta(root, **changes):
    meta = {key: value for key, value in (META | changes).items() if value is not None}
    (root / "meta.json").write_text(json.dumps(meta))


def each(root, name, edit):
    """Edits every picture of a folder."""
    for path in (root / name).iterdir():
        dots.save(path, edit(cv2.imread(str(path), cv2.IMREAD_UNCHANGED)))


def test_both_eyes_see_what_was_drawn(folder):
    sequence = read_endonerf(folder)
    assert (sequence.name, sequence.camera_ids, sequence.frame_ids) == ("pulling", (0, 1), (3, 4, 5, 6))
    np.testing.assert_allclose(sequence.times, np.arange(FRAMES) / 25)
    np.testing.assert_allclose(sequence.viewmats, np.stack([LEFT, RIGHT], 1), atol=1e-12)
    farthest = max(
        dots.offset(sequence.image(t, c), dots.project(sequence.Ks[t, c], sequence.viewmats[t, c], point))
        for t in range(FRAMES)
        for c in (0, 1)
        for point in POINTS
    )
    assert farthest < 0.06
    np.testing.assert_allclose(sequence.depth(1, 0), DEPTH * UNIT_M, rtol=1e-6)
    for c in (0, 1):
        np.testing.assert_array_equal(sequence.mask(2, c), tool_mask(2))
    assert sequence.where("mask", 2, 1) == str(folder / "right/masks/frame-000005.mask.png")


def test_frames_in_a_folder_of_another_name_are_still_a_recording(folder):
    for root in (folder, folder / "right"):
        (root / "images").rename(root / "frames")
    sequence = open_as_sequence(str(folder), ReadOptions(images="frames"))
    assert (sequence.layout, sequence.has_masks, sequence.has_depth) == ("EndoNeRF", True, True)


def test_the_tool_label_has_a_name(folder):
    assert photographs_of(read_endonerf(folder)).label_names == {1: "tool"}


@pytest.mark.parametrize("name", ["pose_bounds.npy", "poses_bounds.npy"])
def test_names_that_releases_use(folder, name):
    for path in sorted((folder / "masks").iterdir()):
        dots.save(
            folder / f"gt_masks/{path.stem}.jpg", 255 * tool_mask(int(path.stem[6:12]) - 3).astype(np.uint8)
        )
        path.unlink()
    (folder / "masks").rmdir()
    (folder / "poses_bounds.npy").rename(folder / name)
    sequence = read_endonerf(folder)
    np.testing.assert_array_equal(sequence.mask(1, 0), tool_mask(1))  # black in a JPEG is not exactly 0


def test_masks_of_either_polarity(folder):
    each(folder, "masks", lambda mask: 255 - mask)
    with pytest.warns(DataWarning, match=r"masks: in 4 of 4 frames .* half .*--read.tool black"):
        white = read_endonerf(folder)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        black = read_endonerf(folder, tool="black")
    np.testing.assert_array_equal(black.mask(3, 0), tool_mask(3))
    np.testing.assert_array_equal(white.mask(3, 0), 1 - tool_mask(3))


def test_masks_of_zeros_and_ones(folder):
    each(folder, "masks", lambda mask: mask // 255)
    np.testing.assert_array_equal(read_endonerf(folder).mask(3, 0), tool_mask(3))


def test_a_tool_that_is_near_in_a_few_frames_is_no_inverted_mask(folder):
    for t in (0, 1):
        dots.save(folder / f"masks/frame-{t + 3:06d}.mask.png", np.full((HEIGHT, WIDTH), 255, np.uint8))
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        read_endonerf(folder)


@pytest.mark.parametrize(("tool", "value"), [("white", 255), ("black", 0)])
def test_masks_with_only_tool_are_refused(folder, tool, value):
    each(folder, "masks", lambda mask: np.full_like(mask, value))
    other = {"white": "black", "black": "white"}[tool]
    says = rf"masks: expected masks with a {tool} tool .*only tool in all 4 .*--read.tool {other}"
    with pytest.raises(DataError, match=says):
        read_endonerf(folder, tool=tool)


def test_depth_percentiles(folder):
    depth = read_endonerf(folder, depth_percentiles=(10, 60)).depth(0, 0)
    kept = depth > 0
    assert abs(kept.mean() - 0.5) < 0.01
    assert (DEPTH[kept].min(), DEPTH[kept].max()) == pytest.approx((550, 800), abs=1)
    each(folder, "depth", lambda image: np.where(image < 900, 0, image))
    few = read_endonerf(folder, depth_percentiles=(50, 100)).depth(0, 0)  # 0 is invalid, so it is not counted
    assert few[few > 0].min() == pytest.approx(950 * UNIT_M, rel=1e-3)


def test_the_sources_of_the_depth_unit(folder):
    """An option takes precedence over truth.npz, over meta.json, over millimetres."""
    for written, given, unit in ((None, None, 0.001), (2e-4, None, 2e-4), (2e-4, 3e-4, 3e-4)):
        write_meta(folder, depth_unit_m=written)
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            assert read_endonerf(folder, depth_unit_m=given).depth(0, 0)[0, 0] == pytest.approx(500 * unit)
    np.savez(folder / "truth.npz", depth_unit_m=1e-4)
    assert read_endonerf(folder).depth(0, 0)[0, 0] == pytest.approx(0.05)
    np.savez(folder / "truth.npz", depth_unit_m=[1e-4, 1.0])
    with pytest.raises(
        DataError, match=r"truth.npz: expected depth_unit_m to be one number above 0, found \["
    ):
        read_endonerf(folder)


def test_poses_in_another_unit_than_depth(folder):
    rows = np.load(folder / "poses_bounds.npy")
    rows[:, [3, 8, 13, 15, 16]] *= 1000
    np.save(folder / "poses_bounds.npy", rows)
    with pytest.warns(DataWarning, match=r"poses_bounds.npy: its bounds are 50 and 100 m.*set pose_unit_m"):
        read_endonerf(folder)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        sequence = read_endonerf(folder, pose_unit_m=0.001)
    np.testing.assert_allclose(sequence.viewmats[:, 0], LEFT, atol=1e-12)
    rows[:] = rows[0]
    np.save(folder / "poses_bounds.npy", rows)  # a static camera, as in EndoNeRF's own recordings
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        read_endonerf(folder)


def test_the_baseline_option_takes_precedence(folder):
    sequence = read_endonerf(folder, baseline_m=0.02)
    eyes = -np.swapaxes(sequence.viewmats[..., :3, :3], -1, -2) @ sequence.viewmats[..., :3, 3:]
    x_axes = sequence.viewmats[:, 0, 0, :3]
    np.testing.assert_allclose((eyes[:, 1] - eyes[:, 0])[..., 0], 0.02 * x_axes, atol=1e-15)
    write_meta(folder, baseline_m=None)
    with pytest.warns(DataWarning, match=r"right: the right eye is left out: .*--read.baseline-m"):
        assert read_endonerf(folder).camera_ids == (0,)


def test_a_right_eye_without_masks_and_depth(folder):
    for name in ("masks", "depth"):
        for path in (folder / "right" / name).iterdir():
            path.unlink()
        (folder / "right" / name).rmdir()
    sequence = read_endonerf(folder)
    assert (sequence.mask(0, 1), sequence.depth(0, 1)) == (None, None)
    assert sequence.image(0, 1).shape == (HEIGHT, WIDTH, 3)
    assert sequence.depth(0, 0) is not None


def test_truth(folder):
    assert read_endonerf(folder).truth is None
    vertices = np.random.default_rng(0).normal(size=(FRAMES, 5, 3))
    np.savez(folder / "truth.npz", verts=vertices)
    truth = read_endonerf(folder).truth
    assert truth.names == ()
    np.testing.assert_array_equal(truth.tracks, vertices)
    tool = np.tile(np.eye(4), (FRAMES, 1, 1))
    tool[2, 0, 3] = 5
    np.savez(folder / "truth.npz", verts=vertices, T_w_tool=tool)
    truth = read_endonerf(folder).select(frames=[1, 2]).truth
    assert (truth.names, truth.label_ids.tolist(), truth.poses[1, 0, 0, 3]) == (("tool",), [1], 5)
    np.testing.assert_array_equal(truth.tracks, vertices[1:3])
    for arrays in ({"verts": vertices[:2]}, {"verts": vertices, "T_w_tool": tool[:2]}):
        np.savez(folder / "truth.npz", **arrays)
        with pytest.raises(DataError, match=r"truth.npz: expected .* of shape \(4, .*Regenerate the file"):
            read_endonerf(folder)


@pytest.mark.parametrize(
    ("options", "says"),
    [
        ({"depth_unit_m": 0}, "depth_unit_m: expected metres above 0, found 0"),
        ({"pose_unit_m": -1}, "pose_unit_m: expected metres above 0, found -1"),
        ({"baseline_m": np.inf}, "baseline_m: expected metres above 0, found inf"),
        ({"depth_percentiles": (9, 3)}, "depth_percentiles: expected two in 0 to 100.* found 9 and 3"),
        ({"depth_percentiles": (0, 101)}, "found 0 and 101"),
    ],
)
def test_invalid_options_are_refused(folder, options, says):
    with pytest.raises(ValueError, match=says):
        read_endonerf(folder, **options)


def test_it_is_a_recording_and_photographs_too(folder):
    """`gsjax fit` reads the left eye's frames as photographs; other commands open it as a sequence."""
    assert open_sequence(folder).num_cameras == 2
    assert open_photographs(folder).num == FRAMES
    wrong = open_sequence(folder, ReadOptions(axes="llff"))
    assert np.abs(wrong.viewmats[0, 0] - LEFT[0]).max() > 0.5
    options = ReadOptions(tool="black", depth_percentiles=(10, 60), pose_unit_m=1.0, baseline_m=0.02)
    with pytest.warns(DataWarning, match="inverted"):
        sequence = open_sequence(folder, options)
    assert np.mean(sequence.depth(0, 0) > 0) < 0.6
    assert sequence.viewmats[0, 1, 0, 3] - sequence.viewmats[0, 0, 0, 3] == pytest.approx(-0.02)


def test_axes_are_required_for_an_ambiguous_layout(folder):
    for path in (folder / "depth").iterdir():
        path.unlink()
    (folder / "depth").rmdir()
    with pytest.raises(ValueError, match=r"does not state the meaning of its columns; set axes"):
        open_sequence(folder)
    sequence = open_sequence(folder, ReadOptions(axes="endonerf"))
    assert (sequence.depth(0, 0), sequence.has_masks) == (None, True)


def test_the_tissue(shared_data):
    """Vertices visible to either eye lie at the depth in its files; the right eye's own pose file agrees with
    the baseline."""
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        sequence = open_sequence(shared_data / "tissue_0")
    own = np.load(shared_data / "tissue_0/right/poses_bounds.npy")[:, :15].reshape(-1, 3, 5)
    eyes = -np.swapaxes(sequence.viewmats[..., :3, :3], -1, -2) @ sequence.viewmats[..., :3, 3:]
    np.testing.assert_allclose(eyes[:, 1, :, 0], own[:, :, 3], atol=1e-12)
    for t, c in ((0, 0), (30, 1)):
        viewmat = sequence.viewmats[t, c]
        local = sequence.truth.tracks[t] @ viewmat[:3, :3].T + viewmat[:3, 3]
        x, y, z = (local @ sequence.Ks[t, c].T).T
        shown = (x >= 0) & (y >= 0) & (x < z * sequence.width) & (y < z * sequence.height)
        x, y, z = (x / z)[shown].astype(int), (y / z)[shown].astype(int), z[shown]
        off = np.abs(sequence.depth(t, c)[y, x] - z)[sequence.mask(t, c)[y, x] == 0]
        assert np.median(off) < 2e-4
