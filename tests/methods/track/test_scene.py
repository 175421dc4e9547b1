"""The first frame: labels lifted from one view, discs that face their camera, and helpful errors."""

import warnings

import equinox as eqx
import jax.numpy as jnp
import numpy as np
import pytest

from gsjax.geometry.cameras import camera_centers
from gsjax.methods.track import TrackConfig, first_pose, start_scene
from gsjax.methods.track.config import StartConfig
from gsjax.methods.track.motion import facing
from gsjax.methods.track.scene import labelled_cloud, scene_from_cloud

START = StartConfig(iterations=0)


@pytest.fixture(scope="module")
def cloud(table):
    _, frames, mask = table()
    return labelled_cloud(frames[0], mask, 0, START)


@pytest.fixture(scope="module")
def scene(cloud):
    return scene_from_cloud(cloud, START)


def test_points_of_the_masks_camera_have_its_labels(table, cloud):
    _, frames, mask = table()
    known = np.asarray(frames[0].depths[0]) > 0
    assert len(cloud.points) == int((np.asarray(frames[0].depths) > 0).sum())
    np.testing.assert_array_equal(cloud.labels[: known.sum()], mask[known])


def test_the_other_cameras_points_inherit_labels(table, cloud):
    sequence, frames, _ = table()
    known = np.asarray(frames[0].depths) > 0
    others, truth = cloud.labels[known[0].sum() :], sequence.mask(0, 1)[known[1]]
    assert (others == truth).mean() > 0.95


def test_what_can_move_comes_first_and_groups_are_the_masks_values(table, scene):
    _, _, mask = table()
    labels = np.asarray(scene.labels)
    assert set(scene.label_ids) == {0, *np.unique(mask).tolist()}
    assert scene.label_ids == tuple(sorted(scene.label_ids))
    assert scene.num_objects == len(scene.label_ids) - 1
    assert (labels[: scene.num_moving] > 0).all()
    assert (labels[scene.num_moving :] == 0).all()


def test_values_of_the_mask_may_have_gaps(table):
    _, frames, mask = table()
    sparse = np.where(mask == 5, 40, 0)
    assert scene_from_cloud(labelled_cloud(frames[0], sparse, 0, START), START).label_ids == (0, 40)


def test_a_pixel_that_flies_off_an_edge_makes_nothing_large(cloud, scene):
    """Depth cameras have such pixels: a point half a metre behind the carton does not split it into parts."""
    points = cloud.points.copy()
    points[np.flatnonzero(cloud.labels == 2)[0]] += 0.5
    flown = scene_from_cloud(cloud._replace(points=points), START)
    assert flown.label_ids == scene.label_ids


@pytest.mark.thorough
def test_depth_that_is_off_in_single_pixels_makes_no_groups_and_nothing_large(table):
    """Regression test: with 5 % of the depths off by up to a factor of ten, 8 groups became 14, and objects
    were lost."""
    _, frames, mask = table()
    random, depths = np.random.default_rng(0), np.asarray(frames[0].depths)
    off = random.uniform(size=depths.shape) < 0.05
    wrong = np.where(off, depths * 10 ** random.uniform(-1, 1, depths.shape), depths).astype(np.float32)
    told, given = (
        start_scene(
            eqx.tree_at(lambda f: f.depths, frames[0], jnp.asarray(d)), mask, 0, TrackConfig(start=START)
        )
        for d in (depths, wrong)
    )
    assert given.label_ids == told.label_ids
    for value in set(told.label_ids[1:]):
        points = [np.asarray(s.gaussians.means)[values_of(s) == value] for s in (told, given)]
        low, high = points[0].min(0) - 0.02, points[0].max(0) + 0.02
        assert ((points[1] > low) & (points[1] < high)).all(1).mean() > 0.98


def test_objects_of_a_few_gaussians_are_told_of(table):
    """Regression test: such objects could drift by 166 mm without a warning."""
    _, frames, mask = table()
    coarse = TrackConfig(start=StartConfig(iterations=0, object_pixels=60.0))
    with pytest.warns(
        UserWarning, match=r"object \d has \d+.*expected 12 or more; lower start.object_pixels"
    ):
        start_scene(frames[0], mask, 0, coarse)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        start_scene(frames[0], mask, 0, TrackConfig(start=START))


def values_of(scene):
    """The mask's value of each Gaussian, which parts of one object share."""
    return np.asarray(scene.label_ids)[np.asarray(scene.labels)]


def test_normals_point_to_a_camera(table, scene):
    _, frames, _ = table()
    share = facing(scene, first_pose(scene), camera_centers(frames[0].cameras.viewmat))
    assert (np.abs(scene.normals).max(axis=1) == 1).all()
    assert float(share[:, : scene.num_moving].max(0).min()) >= 0.5 - 1e-3


def test_a_mask_of_a_camera_that_is_not_there_is_refused(table):
    _, frames, mask = table()
    with pytest.raises(ValueError, match="mask_camera: expected 0 to 1, found 9"):
        labelled_cloud(frames[0], mask, 9, START)


@pytest.mark.usefixtures("as_users_run")
def test_no_mask_is_refused_in_words(table):
    with pytest.raises(ValueError, match=r"mask: expected labels .*, found None"):
        labelled_cloud(table()[1][0], None, 0, START)


def test_bad_input_says_what_is_wrong(table):
    _, frames, mask = table()
    first = frames[0]
    with pytest.raises(ValueError, match=r"mask: expected shape .* to match images"):
        labelled_cloud(first, mask[:-1], 0, START)
    with pytest.raises(ValueError, match="mask: expected an object, found none"):
        scene_from_cloud(labelled_cloud(first, 0 * mask, 0, START), START)
    blind = eqx.tree_at(lambda f: f.depths, first, None, is_leaf=lambda x: x is None)
    with pytest.raises(ValueError, match="depths: expected those of the first frame, found None"):
        labelled_cloud(blind, mask, 0, START)
    empty = eqx.tree_at(lambda f: f.depths, first, jnp.zeros_like(first.depths))
    with (
        pytest.warns(UserWarning, match="no pixel is positive"),
        pytest.raises(ValueError, match="depths: expected positive values in the first frame"),
    ):
        labelled_cloud(empty, mask, 0, START)
