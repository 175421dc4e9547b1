"""Mistakes that show only when parts of the data are compared."""

import warnings
from dataclasses import replace

import numpy as np
import pytest

from gsjax.data import Cloud, DataWarning, Photographs, open_sequence, photographs_of
from gsjax.data.consistency import check_photographs, check_recording

TABLE = "simulated:tabletop?frames=4&width=96&height=72"


def with_depth_times(sequence, factor):
    return replace(sequence, load_depth=lambda t, c: factor * sequence.depth(t, c))


def silent(check, data):
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        check(data)


@pytest.fixture(scope="module")
def table():
    return open_sequence(TABLE)


@pytest.fixture(scope="module")
def moving():
    """One camera that moves around furniture."""
    around = open_sequence("simulated:articulated?frames=1&width=96&height=72")
    count = around.num_cameras
    return replace(
        around,
        camera_ids=(0,),
        times=np.arange(count) / 10,
        frame_ids=tuple(range(count)),
        Ks=around.Ks.swapaxes(0, 1),
        viewmats=around.viewmats.swapaxes(0, 1),
        load_image=lambda t, c: around.image(0, t),
        load_depth=lambda t, c: around.depth(0, t),
        load_mask=None,
        load_flow=None,
        truth=None,
        locate=None,
    )


def cloud_of(scene):
    """Every seventh point of the depth of all photographs."""
    points = []
    for i in range(scene.num):
        rows, columns = np.nonzero(scene.depth(i))
        z = scene.depth(i)[rows, columns]
        rays = np.stack([columns + 0.5, rows + 0.5, np.ones(len(z))]) * z
        local = np.linalg.inv(scene.Ks[i]) @ rays
        viewmat = scene.viewmats[i]
        points.append(((local.T - viewmat[:3, 3]) @ viewmat[:3, :3])[::7])
    return Cloud(np.concatenate(points), np.full((sum(map(len, points)), 3), 0.5))


@pytest.mark.parametrize(("factor", "says"), [(5.0, "5.0 times too large"), (0.2, "5.0 times too small")])
def test_depth_in_another_unit_than_the_poses(table, moving, factor, says):
    for sequence in (table, table.select(cameras=(0, 1)), moving):
        with pytest.warns(DataWarning, match=rf"depth looks {says}: .*--read.depth-unit-m"):
            check_recording(with_depth_times(sequence, factor))
        silent(check_recording, sequence)


@pytest.mark.parametrize(("factor", "says"), [(5.0, "5.0 times too large"), (0.01, "100.0 times too small")])
def test_depth_in_another_unit_than_the_points(moving, factor, says):
    scene = photographs_of(moving)
    right = replace(scene, cloud=cloud_of(scene))
    silent(check_photographs, right)
    for cloud in (right.cloud, None):
        wrong = replace(scene, cloud=cloud, load_depth=lambda i: (factor * scene.depth(i)).astype(np.float32))
        with pytest.warns(DataWarning, match=rf"depth looks {says}"):
            check_photographs(wrong)


def test_depth_that_cannot_be_judged(table):
    """Noise, a single static camera, and unreadable depth, which is reported only when it is used."""
    noise = np.random.default_rng(0)

    def fail(t, c):
        raise OSError("gone")

    for load in (lambda t, c: noise.uniform(0.5, 5.0, (72, 96)).astype(np.float32), fail):
        silent(check_recording, replace(table, load_depth=load))
    silent(check_recording, with_depth_times(table.select(cameras=(0,)), 5.0))


def placed(viewmats, **more):
    count = len(viewmats)
    return Photographs(
        name="garden",
        names=tuple(f"{i}" for i in range(count)),
        sizes=np.tile([64, 48], (count, 1)),
        Ks=np.tile([[60.0, 0, 32], [0, 60, 24], [0, 0, 1]], (count, 1, 1)),
        viewmats=viewmats,
        load_image=lambda i: np.zeros((48, 64, 3), np.uint8),
        **more,
    )


def test_cameras_that_look_away_from_each_other(table, moving):
    inwards = moving.viewmats[:, 0]
    outwards = np.diag([1.0, -1, -1, 1]) @ inwards  # OpenGL's axes
    silent(check_photographs, placed(inwards))
    with pytest.warns(DataWarning, match=r"all 10 photographs look away from each other.*give poses in the"):
        check_photographs(placed(outwards))
    turned = replace(table, viewmats=np.diag([1.0, -1, -1, 1]) @ table.viewmats, load_depth=None)
    with pytest.warns(DataWarning, match=r"all 3 cameras look away from each other"):
        check_recording(turned)


@pytest.mark.parametrize(
    ("given", "says"),
    [
        (np.linalg.inv, "from the camera to the world;"),
        (lambda right: np.diag([1.0, -1, -1, 1]) @ right, "in OpenGL's axes;"),
        (
            lambda right: np.linalg.inv(right) @ np.diag([1.0, -1, -1, 1]),
            "from the camera to the world, in OpenGL",
        ),
    ],
)
def test_poses_that_mean_something_else(table, given, says):
    with warnings.catch_warnings(record=True) as found:
        warnings.simplefilter("always")
        check_recording(replace(table, viewmats=given(table.viewmats)))
    assert any(f"if their poses are {says}" in str(one.message) for one in found)


def test_points_that_no_camera_sees(moving):
    scene = photographs_of(moving)
    cloud = cloud_of(scene)
    away = replace(scene, load_depth=None, cloud=replace(cloud, points=cloud.points + 100))
    with pytest.warns(DataWarning, match=r"of 10 photographs look away from all points"):
        check_photographs(away)


def test_inverted_masks(moving):
    """Masks must leave some of the points in view or, without points, more than a few of the pixels."""
    scene = replace(photographs_of(moving), load_depth=None)
    for cloud in (cloud_of(photographs_of(moving)), None):
        row = np.arange(72)[:, None] < (2 if cloud is None else 71)
        masks = {"right": np.broadcast_to(row, (72, 96)), "none": np.zeros((72, 96), bool)}
        silent(check_photographs, replace(scene, cloud=cloud, load_mask=lambda i, m=masks: m["right"]))
        with pytest.warns(DataWarning, match=r"masks hide 100.0% of the .*black is left out: are they"):
            check_photographs(replace(scene, cloud=cloud, load_mask=lambda i, m=masks: m["none"]))
        some = replace(scene, cloud=cloud, load_mask=lambda i, m=masks: None if i == 0 else m["none"])
        silent(check_photographs, some)  # the first has no mask, so all of it counts


def test_cameras_at_one_place(table):
    viewmats = table.viewmats.copy()
    viewmats[..., :3, 3] = 0
    with pytest.warns(DataWarning, match=r"all 3 cameras stand at one place.*give poses"):
        check_recording(replace(table, viewmats=viewmats, load_depth=None))
    with pytest.warns(DataWarning, match=r"garden: all 3 photographs stand at one place"):
        check_photographs(placed(viewmats[0]))
    silent(check_photographs, placed(viewmats[0, :1]))


@pytest.mark.parametrize(
    ("times", "jumps"),
    [
        ([0, 0.1, 0.2, 60.2, 60.3], True),
        ([0, 0.1, 0.3, 0.4, 1.0], False),
        ([0, 9], False),
        ([0, 1, 40, 90], False),
    ],
)
def test_a_clock_that_jumps(table, times, jumps):
    count = len(times)
    sequence = replace(
        table,
        times=np.array(times, float),
        frame_ids=tuple(range(7, 7 + count)),
        Ks=table.Ks[[0] * count],
        viewmats=table.viewmats[[0] * count],
        load_depth=None,
        truth=None,
    )
    if not jumps:
        silent(check_recording, sequence)
        return
    with pytest.warns(DataWarning, match=r"time jumps by 60 s between frames 9 and 10, where 0.1 s is usual"):
        check_recording(sequence)


def test_a_picture_of_several_frames(table, tmp_path):
    files = [tmp_path / f"{t}.png" for t in (0, 1, 1, 2)]
    for file in files:
        file.touch()
    listed = replace(table, load_depth=None, locate=lambda kind, t, c: str(files[t]))
    with pytest.warns(DataWarning, match=r"1 pictures are listed for several frames, such as .*1.png"):
        check_recording(listed)
