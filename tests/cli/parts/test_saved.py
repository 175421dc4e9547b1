"""Runs of `gsjax parts` with damaged or inconsistent files: each is refused with a clear error."""

import json

import numpy as np
import pytest

from gsjax.engine.parts.outputs import write_parts
from gsjax.engine.parts.saved import blend_of, read_parts
from tests.cli.parts.test_edit import STEP, scene_and_trajectory, write_run

AGAIN = "; run gsjax parts again with this version of gsjax, or name another folder"


@pytest.fixture
def run(tmp_path):
    return write_run(tmp_path / "run")


def said_of(run):
    with pytest.raises(ValueError) as error:  # noqa: PT011
        read_parts(run)
    said = str(error.value)
    assert said.startswith(str(run))
    assert said.endswith(AGAIN)
    return said.removeprefix(f"{run}/").removesuffix(AGAIN)


def with_nan(array):
    array = np.array(array)
    array[1] = np.nan
    return array


@pytest.mark.parametrize(
    ("name", "change", "says"),
    [
        ("R", lambda R: R[:2], "R: expected the shape [4,3,3,3], found [2,3,3,3]"),
        ("R", lambda R: np.full_like(R, np.nan), "R: expected finite numbers, found 108 of 108 that are not"),
        ("t", with_nan, "t: expected finite numbers, found 9 of 36 that are not"),
        (
            "t",
            lambda t: np.full(t.shape, 1e300),
            "t: expected finite numbers, found 36 of 36 that are not, as float32",
        ),
        ("t", lambda t: t[:, 0], "t: expected the shape [4,3,3], found [4,3]"),
        ("weights", lambda w: w[:, :2], "centres: expected the shape [2,3], found [3,3]"),
        ("weights", lambda w: w[:, 0], "weights: expected the shape [N,P], found [200]"),
        ("weights", lambda w: w > 0, "weights: expected numbers, found bool"),
        ("centres", lambda c: c[:, :2], "centres: expected the shape [3,3], found [3,2]"),
        ("times", lambda t: t.astype(str), "times: expected numbers, found <U"),
        ("times", lambda t: t[:0], "times: expected the shape [T], found [0]"),
        ("times", np.zeros_like, "times: expected seconds that increase, found 0.0 in frame 1 after 0.0"),
        ("anchor", lambda a: 77, "anchor: expected the index of one of 4 frames, 0 to 3, found 77"),
        ("anchor", lambda a: -1, "anchor: expected the index of one of 4 frames, 0 to 3, found -1"),
        ("anchor", lambda a: 0.5, "anchor: expected the index of one of 4 frames, 0 to 3, found 0.5"),
        ("anchor", lambda a: [0, 1], "anchor: expected the shape [], found [2]"),
    ],
)
def test_arrays_that_do_not_fit(run, name, change, says):
    arrays = dict(np.load(run / "parts.npz"))
    np.savez(run / "parts.npz", **arrays | {name: change(arrays[name])})
    assert said_of(run).startswith(f"parts.npz: {says}")


def test_a_file_of_one_array(run):
    with open(run / "parts.npz", "wb") as stream:
        np.save(stream, np.zeros(3))
    assert said_of(run) == "parts.npz: expected an array anchor, found an array without a name"


def test_a_file_cut_off(run):
    sound = (run / "parts.npz").read_bytes()
    (run / "parts.npz").write_bytes(sound[: len(sound) // 2])
    assert said_of(run) == "parts.npz: expected plain arrays, found a file that cannot be read"


def test_a_file_with_flipped_bits(run):
    """Every 17th byte after the first header, one at a time; some break the compressed stream itself."""
    sound = (run / "parts.npz").read_bytes()
    for place in range(60, 400, 17):
        broken = bytearray(sound)
        broken[place] ^= 0xFF
        (run / "parts.npz").write_bytes(broken)
        try:
            read_parts(run)
        except ValueError as error:
            assert "parts.npz: expected" in str(error)  # noqa: PT017


@pytest.mark.parametrize(
    ("change", "says"),
    [
        ({"frames": {"followed": 0}}, "expected 1 to 4 tracked frames, as parts.npz has 4, found 0"),
        ({"frames": {"followed": 5}}, "tracked frames, as parts.npz has 4, found 5"),
        (
            {"frames": {"followed": 2.5}},
            "tracked frames, as parts.npz has 4, found 2.5",
        ),
        ({"parts": [{"part": 1, "name": "a", "true_name": 7}]}, "found 1, 'a' and 7"),
        ({"parts": [{"part": 1, "name": 3}]}, "found 1, 3 and None"),
        ({"parts": [{"part": -1, "name": "a"}]}, "found -1, 'a' and None"),
        ({"parts": [{"part": "1", "name": "a"}]}, "found '1', 'a' and None"),
        ({"parts": 3}, "expected a run's scores, found something else"),
    ],
)
def test_scores_that_do_not_fit(run, change, says):
    metrics = json.loads((run / "metrics.json").read_text())
    (run / "metrics.json").write_text(json.dumps(metrics | change))
    assert said_of(run).startswith("metrics.json: expected ")
    assert says in said_of(run)


def test_how_rotations_were_blended_is_known_without_the_recording(run):
    config = run / "config.yml"
    text = config.read_text()
    assert "blend: quaternion" in text
    config.write_text(text.replace("blend: quaternion", "blend: dual"))
    assert blend_of(run) == "dual"
    config.write_text("parts: 3")
    assert blend_of(run) == "quaternion"
    config.unlink()
    assert blend_of(run) == "quaternion"


def test_parts_that_are_not_there_are_read_again(run):
    arrays = dict(np.load(run / "parts.npz"))
    shown = np.ones((4, 3), np.float32)
    shown[2:, 1] = 0
    np.savez(run / "parts.npz", **arrays, opacities=shown)
    layer, *_ = read_parts(run)
    np.testing.assert_array_equal(layer.trajectory.opacities, shown)
    np.savez(run / "parts.npz", **arrays, opacities=-shown)
    assert said_of(run) == "parts.npz: opacities: expected numbers from 0 to 1, found others"
    np.savez(run / "parts.npz", **arrays, opacities=shown[:2])
    assert said_of(run) == "parts.npz: opacities: expected the shape [4,3], found [2,3]"


def test_times_of_day_are_kept(run):
    """float32 would have the same time for all of them."""
    times = 1.7e9 + STEP * np.arange(4)
    write_parts(run / "parts.npz", *scene_and_trajectory(), 0, times=times)
    np.testing.assert_array_equal(np.load(run / "parts.npz")["times"], times)
    layer, *_ = read_parts(run)
    np.testing.assert_allclose(layer.trajectory.times, STEP * np.arange(4), atol=1e-6)
