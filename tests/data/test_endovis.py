"""EndoVis 2017 and 2018: a stereo pair and three dots, drawn as the calibration defines them."""

import json
import warnings

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from gsjax.data import DataError, DataWarning, ReadOptions, open_sequence, photographs_of, read_endovis
from gsjax.data.endovis import _find_labels
from tests.data import dots

WIDTH, HEIGHT, FRAMES = 96, 72, 3
POINTS = np.array([[0.01, 0.005, 0.12], [-0.012, 0.006, 0.10], [0.004, -0.01, 0.14]])
F, C = (100.0, 102.0), ((46.5, 35.5), (49.5, 36.5))  # pixel centres at integers, as in the calibration
OMEGA, T_MM = (0.01, -0.02, 0.005), (-4.5, 0.1, 0.05)
CALIBRATION = f"""Width: {WIDTH}\t// pixels
Height: {HEIGHT}
Camera-0-F: {F[0]} {F[1]}       // left camera x,y focal dist in pixels
Camera-0-C: {C[0][0]} {C[0][1]}
Camera-0-Alpha: 0.0
Camera-0-K: -0.0001 0.0002 0.0 0.0 0.0
Camera-1-F: {F[0]} {F[1]}
Camera-1-C: {C[1][0]} {C[1][1]}
Camera-1-Alpha: 0.0
Camera-1-K: 0.0 0.0 0.0 0.0 0.0
Extrinsic-Omega: {OMEGA[0]} {OMEGA[1]} {OMEGA[2]}   // left to right camera rotation
Extrinsic-T: {T_MM[0]} {T_MM[1]} {T_MM[2]}
"""


def seen_by(eye):
    """The points as pixels of an eye, centres at +0.5."""
    points = POINTS if eye == 0 else Rotation.from_rotvec(OMEGA).apply(POINTS) + np.array(T_MM) / 1000
    return points[:, :2] / points[:, 2:] * F + C[eye] + 0.5


def write_frames(root, border=(0, 0)):
    for eye, name in enumerate(("left_frames", "right_frames")):
        image = dots.draw(WIDTH, HEIGHT, seen_by(eye))
        framed = np.pad(image, ((border[1],) * 2, (border[0],) * 2, (0, 0)))
        for t in range(FRAMES):
            dots.save(root / f"{name}/frame{t:03d}.png", framed)


@pytest.fixture
def folder(tmp_path):
    root = tmp_path / "instrument_dataset_1"
    write_frames(root)
    (root / "camera_calibration.txt").write_text(CALIBRATION)
    return root


def add_instruments(root):
    """A needle driver on the left with all its parts, and forceps on the right in the last frame."""
    left = np.zeros((HEIGHT, WIDTH), np.uint8)
    left[:10, :20], left[10:20, :20], left[20:30, :20] = 10, 20, 30
    right = np.zeros_like(left)
    right[:, 80:] = 10
    for t in range(FRAMES):
        dots.save(root / f"ground_truth/Large_Needle_Driver_Left_labels/frame{t:03d}.png", left)
        last = right if t == FRAMES - 1 else np.zeros_like(right)
        dots.save(root / f"ground_truth/Maryland_Bipolar_Forceps_labels/frame{t:03d}.png", last)


COLORS = {"background-tissue": (0, 0, 0), "instrument-shaft": (0, 255, 0), "covered-kidney": (24, 55, 125)}
CLASSES = [{"name": name, "color": color, "classid": i} for i, (name, color) in enumerate(COLORS.items())]


def add_colors(root):
    image = np.zeros((HEIGHT, WIDTH, 3), np.uint8)
    image[:10], image[50:] = COLORS["instrument-shaft"], COLORS["covered-kidney"]
    for t in range(FRAMES):
        dots.save(root / f"labels/frame{t:03d}.png", image)
    (root.parent / "labels.json").write_text(json.dumps(CLASSES))


def farthest(sequence):
    return max(
        dots.offset(sequence.image(1, c), dots.project(sequence.Ks[1, c], sequence.viewmats[1, c], point))
        for c in (0, 1)
        for point in POINTS
    )


def test_both_eyes_see_what_was_drawn(folder):
    sequence = read_endovis(folder)
    assert (sequence.camera_ids, sequence.frame_ids, sequence.has_depth) == ((0, 1), (0, 1, 2), False)
    np.testing.assert_allclose(sequence.times, [0, 0.5, 1])
    np.testing.assert_array_equal(sequence.viewmats[:, 0], np.tile(np.eye(4), (FRAMES, 1, 1)))
    assert farthest(sequence) < 0.06


def test_black_borders_stay_and_move_the_principal_point(folder):
    write_frames(folder, border=(30, 10))
    sequence = read_endovis(folder)
    assert (sequence.width, sequence.height) == (WIDTH + 60, HEIGHT + 20)
    assert farthest(sequence) < 0.06


def test_downscaled_frames(folder):
    text = CALIBRATION.replace(f"Width: {WIDTH}", f"Width: {2 * WIDTH}").replace(
        f"Height: {HEIGHT}", f"Height: {2 * HEIGHT}"
    )
    (folder / "camera_calibration.txt").write_text(text)
    sequence = read_endovis(folder)
    np.testing.assert_allclose(sequence.Ks[0, 0], [[50, 0, 23.5], [0, 51, 18], [0, 0, 1]])
    (folder / "camera_calibration.txt").write_text(CALIBRATION.replace(f"Width: {WIDTH}", "Width: 200"))
    with pytest.raises(DataError, match=r"camera_calibration.txt: expected 200x72 pixels .*found 96x72"):
        read_endovis(folder)


def test_instruments_have_the_numbers_of_the_challenge(folder):
    add_instruments(folder)
    sequence = read_endovis(folder)
    last = sequence.mask(FRAMES - 1, 0)
    assert (last[5, 5], last[25, 5], last[5, 90], last[60, 40]) == (3, 3, 1, 0)
    assert set(np.unique(sequence.mask(0, 0))) == {0, 3}
    assert sequence.mask(0, 1) is None
    names = photographs_of(sequence).label_names
    assert (names[1], names[3]) == ("bipolar forceps", "large needle driver")


def test_parts_of_instruments(folder):
    add_instruments(folder)
    sequence = read_endovis(folder, labels="parts")
    mask = sequence.mask(FRAMES - 1, 0)
    assert (mask[5, 5], mask[15, 5], mask[25, 5], mask[5, 90], mask[60, 40]) == (10, 20, 30, 10, 0)
    assert sequence.label_names[20] == "wrist"


def test_colours_have_the_numbers_and_names_of_labels_json(folder):
    add_colors(folder)
    sequence = read_endovis(folder)
    np.testing.assert_array_equal(sequence.mask(2, 0)[[0, 30, 60], 7], [1, 0, 2])
    assert sequence.label_names == {1: "instrument-shaft", 2: "covered-kidney"}
    with_alpha = [{"name": c["name"], "color": [*c["color"], 255]} for c in CLASSES]
    (folder / "labels.json").write_text(
        json.dumps({"classes": with_alpha})
    )  # as in the challenge's test data
    (folder.parent / "labels.json").unlink()
    np.testing.assert_array_equal(read_endovis(folder).mask(2, 0)[[0, 30, 60], 7], [1, 0, 2])


def test_colours_without_a_name_are_counted(folder):
    add_colors(folder)
    image = np.zeros((HEIGHT, WIDTH, 3), np.uint8)
    image[0, :9], image[1] = (1, 2, 3), COLORS["covered-kidney"]
    dots.save(folder / "labels/frame001.png", image)
    sequence = read_endovis(folder)
    with pytest.warns(
        DataWarning, match=r"frame001.png: 9 pixels in colours not listed in labels.json are left"
    ):
        mask = sequence.mask(1, 0)
    assert (mask[0, 0], mask[1, 0]) == (0, 2)


def test_frames_without_labels_are_counted(folder):
    add_colors(folder)
    (folder / "labels/frame001.png").unlink()
    with pytest.warns(
        DataWarning, match=r"labels: 1 of 3 frames are left out of the labels: .* frame001.png"
    ):
        sequence = read_endovis(folder)
    assert sequence.mask(1, 0) is None
    assert sequence.mask(2, 0) is not None


@pytest.mark.parametrize("options", [ReadOptions(K=(100, 102, 47, 36)), ReadOptions(baseline_m=0.004)])
def test_options_that_the_calibration_states_too_are_refused(folder, options):
    with pytest.raises(
        ValueError, match=r"camera_calibration.txt: it states what .*--read.K.*remove the file"
    ):
        open_sequence(folder, options)


def test_without_a_calibration(folder):
    (folder / "camera_calibration.txt").unlink()
    with pytest.raises(ValueError, match=r"there is no camera_calibration.txt. Give K \(--read.K\)"):
        read_endovis(folder)
    with pytest.warns(DataWarning, match=r"right_frames: the right eye is left out.*--read.baseline-m"):
        alone = open_sequence(folder, ReadOptions(K=(100, 102, 47, 36)))
    assert alone.camera_ids == (0,)
    np.testing.assert_allclose(alone.Ks[1, 0], [[100, 0, 47], [0, 102, 36], [0, 0, 1]])
    both = open_sequence(folder, ReadOptions(K=(100, 102, 47, 36), baseline_m=0.004))
    np.testing.assert_allclose(both.viewmats[0, 1, :3, 3], [-0.004, 0, 0])
    np.testing.assert_array_equal(both.Ks[:, 0], both.Ks[:, 1])
    with pytest.raises(ValueError, match="baseline_m: expected metres above 0, found -1"):
        read_endovis(folder, K=(100, 102, 47, 36), baseline_m=-1)


def test_a_lens_that_distorts(folder):
    text = CALIBRATION.replace("Camera-0-K: -0.0001", "Camera-0-K: -0.25")
    (folder / "camera_calibration.txt").write_text(text)
    with pytest.warns(
        DataWarning, match=r"camera_calibration.txt: lens distortion of 4.* pixels .* not corrected"
    ):
        read_endovis(folder)


@pytest.mark.parametrize(
    ("old", "new", "says"),
    [
        ("Camera-0-F: 100.0 102.0", "Camera-0-F: 0 102.0", r"focal lengths above 0 after Camera-0-F:"),
        ("Camera-0-F: 100.0 102.0", "Camera-0-F: 100.0", r"2 numbers after Camera-0-F:, found '100.0'"),
        ("Camera-1-C: 49.5", "Camera-1-C: left", r"2 numbers after Camera-1-C:, found 'left 36.5'"),
        ("Extrinsic-T: -4.5", "Extrinsic-T: nan", r"3 numbers after Extrinsic-T:, found 'nan 0.1 0.05'"),
        ("Height: 72", "", r"1 number after Height:, found no such line"),
        ("Extrinsic-Omega: 0.01", "Extrinsic-Omega: 0.01 0", r"3 numbers after Extrinsic-Omega:"),
    ],
)
def test_faults_of_a_calibration(folder, old, new, says):
    assert old in CALIBRATION
    (folder / "camera_calibration.txt").write_text(CALIBRATION.replace(old, new))
    with pytest.raises(DataError, match=rf"camera_calibration.txt: expected {says}"):
        read_endovis(folder)


def test_a_calibration_of_one_eye(folder):
    text = "\n".join(line for line in CALIBRATION.splitlines() if not line.startswith("Extrinsic"))
    (folder / "camera_calibration.txt").write_text(text)
    with pytest.warns(DataWarning, match=r"right eye is left out: .* add Extrinsic-T and Extrinsic-Omega"):
        assert read_endovis(folder).camera_ids == (0,)


def test_labels_must_be_instruments_or_parts(folder):
    with pytest.raises(ValueError, match="labels: expected 'instruments' or 'parts', found 'tools'"):
        _find_labels(folder, [], (1, 1), "tools")  # type checkers reject it, as do annotations under test


@pytest.mark.thorough
def test_it_is_recognised_and_a_folder_of_several_is_refused(folder):
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        assert open_sequence(folder).num_cameras == 2
    with pytest.raises(DataError, match=r"expected frames, found 1 sequences \(instrument_dataset_1, .*Give"):
        open_sequence(folder.parent)
