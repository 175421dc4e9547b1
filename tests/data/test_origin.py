"""Data far from 0 are made relative to an origin, with a warning; near 0 nothing changes."""

from dataclasses import replace

import numpy as np
import pytest
from PIL import Image

from gsjax.data import (
    DataWarning,
    open_photographs,
    open_sequence,
    photographs_of,
    read_panoptic,
    write_panoptic,
)
from gsjax.data.objects import PointModel
from gsjax.data.origin import near_origin, relative_to_origin
from gsjax.data.simulated import tabletop
from gsjax.geometry.cameras import pixels_of
from gsjax.geometry.joints import Joint
from gsjax.scene.origin import FAR, about, cameras_in_world, far_origin, in_world, relative_to
from tests.data import test_transforms
from tests.data.scene_helpers import project_points

PLACES = {
    "UTM": (500_000.0, 5_000_000.0, 300.0),
    "earth-centred": (4_175_000.0, 860_000.0, 4_725_000.0),
    "one axis": (0.0, 0.0, -100_000.0),
    "UTM in kilometres": (500.0, 5_000.0, 0.3),
}


@pytest.mark.parametrize("name", PLACES)
def test_an_origin_is_near_what_lies_far_and_in_round_numbers(name):
    size = 1e-3 if "kilo" in name else 1.0
    places = PLACES[name] + size * np.random.default_rng(0).normal(size=(30, 3))
    origin = far_origin(places)
    assert origin is not None
    assert np.abs(places - origin).max() < 5 * size
    np.testing.assert_allclose(np.round(origin / size) * size, origin, rtol=1e-12)


@pytest.mark.parametrize(
    "places",
    [
        np.zeros((0, 3)),
        np.full((4, 3), np.nan),
        np.array([[3.0, 2, 1]]),  # one camera
    ],
)
def test_what_is_not_far_keeps_its_coordinates(places):
    assert far_origin(places) is None


def test_distance_counts_in_sizes_of_the_scene():
    spread = np.random.default_rng(0).normal(size=(100, 3))
    assert far_origin(spread + np.array([0.5 * FAR, 0, 0])) is None
    assert far_origin(spread + np.array([10 * FAR, 0, 0])) is not None
    assert (
        far_origin(spread + np.array([10 * FAR, 0, 0]), [1e5 * spread]) is None
    )  # its points are all around


def test_cameras_and_places_come_back_as_they_were():
    sequence, origin = tabletop(frames=2, width=32, height=24), np.array(PLACES["UTM"])
    far = cameras_in_world(sequence.viewmats, origin)
    np.testing.assert_allclose(about(far, origin), sequence.viewmats, atol=1e-8)
    points = np.random.default_rng(0).normal(size=(5, 3))
    np.testing.assert_allclose(relative_to(in_world(points, origin), origin), points, atol=1e-8)
    seen = [
        pixels_of(*each, sequence.Ks[0, 0], 32, 24).depths
        for each in ((points, sequence.viewmats[0, 0]), (points + origin, far[0, 0]))
    ]
    np.testing.assert_allclose(*seen, atol=1e-8)


@pytest.mark.parametrize("place", PLACES.values(), ids=PLACES)
@pytest.mark.parametrize("cloud", [True, False])
def test_photographs_far_from_0_are_read_like_those_near_it(tmp_path, place, cloud):
    folder = test_transforms.Folder(tmp_path / "garden")
    if cloud:
        rows = "\n".join(f"{x} {y} {z}" for x, y, z in test_transforms.POINTS)
        header = "ply\nformat ascii 1.0\nelement vertex 3\n"
        header += "".join(f"property double {axis}\n" for axis in "xyz") + "end_header\n"
        (folder.root / "points.ply").write_text(header + rows + "\n")
        folder.meta["ply_file_path"] = "points.ply"
    near = folder.read()
    assert near.origin is None
    for frame in folder.meta["frames"]:
        for row, shift in zip(frame["transform_matrix"], place, strict=False):
            row[3] += shift
    if cloud:
        rows = "\n".join(f"{x:.9f} {y:.9f} {z:.9f}" for x, y, z in test_transforms.POINTS + place)
        (folder.root / "points.ply").write_text(header + rows + "\n")
    with pytest.warns(DataWarning, match=r"coordinates reach .* relative to the origin \(.*put back"):
        far = folder.read()
    assert far.origin is not None
    assert np.abs(far.viewmats[:, :3, 3]).max() < 20
    points = test_transforms.POINTS + place - far.origin
    if cloud:
        assert far.cloud is not None
        np.testing.assert_allclose(far.cloud.points, points, atol=1e-6)
    for i in range(2):
        wanted, found = (
            (viewmat[:3, :3] @ at.T).T + viewmat[:3, 3]
            for viewmat, at in ((near.viewmats[i], test_transforms.POINTS), (far.viewmats[i], points))
        )
        np.testing.assert_allclose(found, wanted, atol=1e-6)
    np.testing.assert_array_equal(far.select([1]).scaled(0.5).origin, far.origin)
    with pytest.warns(DataWarning):
        np.testing.assert_array_equal(open_photographs(folder.root).origin, far.origin)


def test_all_that_is_known_of_a_recording_moves_with_it():
    plain, place = tabletop(frames=2, width=32, height=24), np.array(PLACES["UTM"])
    assert plain.truth is not None
    names, poses = plain.truth.names, plain.truth.poses
    joint = Joint("revolute", np.array([0.0, 0, 1]), np.array([0.1, 0.2, 0]), np.zeros(2))
    tracks = np.random.default_rng(0).normal(size=(2, 5, 3))
    truth = replace(plain.truth, joints=(joint,) * len(names), tracks=tracks)
    shape, plane = [np.ones((1, n)) for n in (3, 4, 3)], np.array([0.0, 0, 1, -0.5])
    model = PointModel("can", *shape, np.ones(1), np.ones((1, 3)), 3, poses[0, 0], plane)
    near = replace(plain, truth=truth, models=(model,))
    far = replace(relative_to_origin(near, -place), origin=None)  # as if it had been recorded there
    with pytest.warns(DataWarning, match="relative to the origin"):
        found = near_origin(lambda: far)()
    moved = found.truth
    assert found.origin is not None
    assert moved is not None
    shift = found.origin - place
    np.testing.assert_allclose(moved.poses[..., :3, 3], poses[..., :3, 3] - shift, atol=1e-6)
    np.testing.assert_allclose(moved.tracks, tracks - shift, atol=1e-6)
    for each in moved.joints:
        assert each is not None
        np.testing.assert_allclose(each.point, joint.point - shift, atol=1e-6)
    there = found.models[0]
    assert there.pose is not None
    np.testing.assert_allclose(there.pose[:3, 3], poses[0, 0, :3, 3] - shift, atol=1e-6)
    np.testing.assert_allclose(there.plane, [0, 0, 1, -0.5 + shift[2]], atol=1e-6)
    _, depths = project_points(found, 0, 0, tracks[0] - shift)
    np.testing.assert_allclose(depths, project_points(near, 0, 0, tracks[0])[1], atol=1e-6)
    np.testing.assert_array_equal(found.select(frames=[1]).scaled(0.5).origin, found.origin)
    np.testing.assert_array_equal(photographs_of(found).origin, found.origin)
    back = relative_to_origin(found, None)
    assert back.origin is None
    np.testing.assert_allclose(back.viewmats, far.viewmats, atol=1e-6)


def test_a_recording_of_another_layout_is_moved_too(tmp_path):
    """TUM RGB-D with a trajectory from a satellite receiver."""
    tmp_path = tmp_path / "freiburg1"
    for kind, mode, value in (("rgb", "RGB", (90, 80, 70)), ("depth", "I;16", 5000)):
        (tmp_path / kind).mkdir(parents=True)
        for t in range(2):
            picture = Image.new(mode, (640, 480), value)
            picture.putpixel((0, 0), (0, 0, 0) if mode == "RGB" else 0)
            picture.save(tmp_path / kind / f"{t}.png")
        (tmp_path / f"{kind}.txt").write_text("".join(f"{t}.0 {kind}/{t}.png\n" for t in range(2)))
    x, y, z = PLACES["UTM"]
    rows = "".join(f"{t}.0 {x + 0.1 * t} {y} {z} 0 0 0 1\n" for t in range(2))
    (tmp_path / "groundtruth.txt").write_text(rows)
    with pytest.warns(DataWarning, match="relative to the origin"):
        sequence = open_sequence(tmp_path)
    assert sequence.origin is not None
    assert np.abs(sequence.viewmats[..., :3, 3]).max() < 1
    write_panoptic(sequence, tmp_path / "converted")
    with pytest.warns(DataWarning, match="relative to the origin"):
        converted = read_panoptic(tmp_path / "converted")
    np.testing.assert_allclose(
        relative_to_origin(converted, None).viewmats, relative_to_origin(sequence, None).viewmats, atol=1e-6
    )
