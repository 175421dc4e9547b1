from dataclasses import replace

import jax.numpy as jnp
import numpy as np
import pytest

from gsjax.data import Cloud, DataError, Photographs, open_sequence, photographs_of
from gsjax.data.ordered import sequence_of
from gsjax.geometry.cameras import intrinsics, look_at, project
from tests.data import dots

SIZES = np.array([[64, 48], [48, 64], [65, 49]])
POINT = np.array([0.1, -0.15, 0.2])


def photographs(**changes):
    """Three photographs of one dot, each of its own size; the second has neither mask nor depth."""
    Ks = np.stack([intrinsics(60.0 + i, *size) for i, size in enumerate(SIZES.tolist())])
    viewmats = np.stack([look_at(np.array([2.0 - i, -2, i]), np.zeros(3)) for i in range(3)])

    def depth(i):
        width, height = SIZES[i]
        return None if i == 1 else np.full((height, width), 1.0 + i, np.float32)

    fields = dict(
        name="three",
        names=("a", "b", "c"),
        sizes=SIZES,
        Ks=Ks,
        viewmats=viewmats,
        load_image=lambda i: dots.draw(*SIZES[i], [dots.project(Ks[i], viewmats[i], POINT)]),
        load_mask=lambda i: None if i == 1 else depth(i) > 1.5,
        load_depth=depth,
        times=np.array([0.0, 0.5, 2.0]),
        splits=("train", "test", "val"),
        locate=lambda kind, i: f"{kind}s/{'abc'[i]}.png",
    )
    return Photographs(**(fields | changes))


def test_a_point_is_where_the_camera_says():
    for scene in (photographs(), photographs().scaled(0.5), photographs().select([2, 0]).scaled(0.7)):
        for i in range(scene.num):
            camera = scene.camera(i)
            pixel, _ = project(jnp.asarray(POINT, jnp.float32), camera.viewmat, camera.K)
            assert (camera.width, camera.height) == tuple(scene.sizes[i])
            assert dots.offset(scene.image(i), np.asarray(pixel)) < 0.05


def test_frames_follow_the_numbers_in_their_names_and_a_superscript_is_none():
    some = photographs(names=("1²10", "1²9", "1²8"), sizes=np.tile(SIZES[:1], (3, 1)), times=None)
    np.testing.assert_array_equal(sequence_of(some).viewmats[:, 0], some.viewmats[::-1])


def test_a_selection_in_another_order():
    some = photographs().select([2, 1])
    assert (some.num, some.names, some.splits) == (2, ("c", "b"), ("val", "test"))
    assert some.times.tolist() == [2.0, 0.5]
    assert some.image(0).shape == (49, 65, 3)
    assert (some.depth(0) == 3).all()
    assert some.mask(0).all()
    assert some.depth(1) is None
    assert some.mask(1) is None
    assert some.where("image", 0) == "images/c.png"
    assert some.select([1]).where("mask", 0) == "masks/b.png"
    bare = photographs(load_mask=None, load_depth=None, times=None, splits=None, locate=None).select([1])
    assert (bare.mask(0), bare.depth(0), bare.times, bare.splits) == (None, None, None, None)
    assert bare.where("image", 0) == "three, image b"
    with pytest.raises(ValueError, match="three: expected at least one photograph, found none"):
        photographs().select([])
    mask = np.array([False, True, True])
    assert photographs().select(mask).names == photographs().select([1, 2]).names
    with pytest.raises(ValueError, match=r"a mask of length 3, found a mask of \(2,\)"):
        photographs().select(mask[:2])


def test_smaller_colours_are_means_and_depths_and_masks_are_not():
    image = np.zeros((48, 64, 3), np.uint8)
    image[::4, ::4] = 160  # one of the 16 pixels of each new one
    rising = np.arange(64, dtype=np.float32) + np.zeros((48, 1), np.float32) + 1
    scene = photographs(
        load_image=lambda i: image, load_depth=lambda i: rising, load_mask=lambda i: rising > 32
    )
    quarter, third = scene.scaled(0.25), scene.scaled(1 / 3)
    assert (quarter.image(0) == 10).all()
    assert (quarter.mask(0) == (np.arange(16) >= 8)).all()
    assert quarter.mask(0).dtype == bool
    assert third.sizes.tolist()[0] == [21, 16]
    middles = (np.arange(21) + 0.5) * 64 / 21
    assert np.abs(third.depth(0)[0] - 0.5 - middles).max() <= 0.5 + 1e-6  # depth is 1 + the column
    assert scene.scaled(1.0) is scene
    assert photographs().scaled(0.5).mask(1) is None
    assert photographs().scaled(0.001).sizes.min() == 1


@pytest.mark.parametrize("scale", [0.0, -0.5, 1.5, float("nan")])
def test_invalid_scales_are_refused(scale):
    with pytest.raises(ValueError, match="scale must be above 0 and at most 1, got"):
        photographs().scaled(scale)


def test_depth_that_is_not_finite_is_invalid():
    bad = np.full((48, 64), 2.0)
    bad[0, :3] = np.nan, 1e300, -1
    depth = photographs(load_depth=lambda i: bad).depth(0)
    assert depth[0, :4].tolist() == [0, 0, 0, 2]


@pytest.mark.parametrize(
    ("kind", "loaded", "says"),
    [
        (
            "image",
            np.zeros((48, 65, 3), np.uint8),
            r"shape \(48, 64, 3\) of uint8, found shape \(48, 65, 3\)",
        ),
        ("image", np.zeros((48, 64, 4), np.uint8), r".*found shape \(48, 64, 4\) of uint8"),
        ("image", np.zeros((48, 64, 3)), r".*found shape \(48, 64, 3\) of float64"),
        ("mask", np.zeros((48, 64), np.uint8), r"shape \(48, 64\) of bool, found shape \(48, 64\) of uint8"),
        ("depth", np.zeros((48, 64), int), r"shape \(48, 64\) of floats, found shape \(48, 64\) of int64"),
        ("depth", np.zeros((24, 32)), r".*found shape \(24, 32\)"),
    ],
)
def test_loaders_that_give_something_else(kind, loaded, says):
    scene = photographs(**{f"load_{kind}": lambda i: loaded})
    for which in (scene, scene.select([0]), scene.scaled(0.5)):
        with pytest.raises(DataError, match=rf"{kind}s/a.png: expected {says}"):
            getattr(which, kind)(0)


@pytest.mark.parametrize(
    ("field", "value", "says"),
    [
        ("names", (), "three: expected at least one photograph, found none"),
        ("sizes", SIZES[:2], r"sizes must have shape \(3, 2\), got \(2, 2\)"),
        ("Ks", np.eye(3), r"Ks must have shape \(3, 3, 3\)"),
        ("Ks", np.full((3, 3, 3), np.nan), "K of a is .*must be finite"),
        ("viewmats", np.eye(4), r"viewmats must have shape \(3, 4, 4\)"),
        ("viewmats", np.stack([np.eye(4), np.diag([1, 1, -1, 1]), np.eye(4)]), "viewmat of b: .*reflection"),
        ("viewmats", np.tile(2 * np.eye(4), (3, 1, 1)), "viewmat of a: its last row is"),
        ("times", np.zeros(2), r"times must have shape \(3,\)"),
        ("splits", ("train",), r"splits must have shape \(3,\)"),
    ],
)
def test_fields_that_do_not_fit(field, value, says):
    with pytest.raises(ValueError, match=says):
        replace(photographs(), **{field: value})


def test_clouds_have_one_colour_per_point():
    assert Cloud(np.zeros((0, 3)), np.zeros((0, 3))).points.shape == (0, 3)
    with pytest.raises(ValueError, match=r"colors must have shape \(2, 3\), got \(1, 3\)"):
        Cloud(np.zeros((2, 3)), np.zeros((1, 3)))
    with pytest.raises(ValueError, match="colors: expected RGB from 0 to 1, found uint8"):
        Cloud(np.zeros((2, 3)), np.full((2, 3), 255, np.uint8))
    with pytest.raises(ValueError, match="background: expected RGB from 0 to 1, found"):
        photographs(background=(255.0, 255.0, 255.0))
    with pytest.raises(ValueError, match=r"points must have shape \(2, 3\), got \(2, 2\)"):
        Cloud(np.zeros((2, 2)), np.zeros((2, 3)))


def test_a_recording_as_photographs():
    sequence = open_sequence("simulated:tabletop?frames=2&cameras=3&width=32&height=24")
    scene = photographs_of(sequence)
    assert scene.num == 6
    assert scene.names[4] == f"{sequence.camera_ids[1]}/{sequence.frame_ids[1]}"
    np.testing.assert_array_equal(scene.times, np.repeat(sequence.times, 3))
    np.testing.assert_array_equal(scene.viewmats[4], sequence.viewmats[1, 1])
    np.testing.assert_array_equal(scene.image(4), sequence.image(1, 1))
    np.testing.assert_array_equal(scene.depth(4), sequence.depth(1, 1))
    assert scene.where("depth", 4) == sequence.where("depth", 1, 1)
    assert photographs_of(sequence.select([0])).times is None


def test_labels_are_read_selected_and_downscaled_without_mixing():
    labels = [np.arange(w * h).reshape(h, w) % 7 for w, h in SIZES.tolist()]
    found = photographs(load_labels=lambda i: None if i == 1 else labels[i], label_names={3: "cup"})
    np.testing.assert_array_equal(found.labels(0), labels[0])
    assert found.labels(1) is None
    np.testing.assert_array_equal(found.select([2, 0]).labels(0), labels[2])
    small = found.scaled(0.5)
    assert small.labels(0).shape == tuple(small.sizes[0][::-1])
    assert set(np.unique(small.labels(0))) <= set(range(7))
    assert photographs().labels(0) is None
    with pytest.raises(DataError, match="integers"):
        photographs(load_labels=lambda i: labels[i].astype(float)).labels(0)


def test_a_recordings_labels_and_names_come_along(tmp_path):
    from gsjax.data.simulated import tabletop

    sequence = tabletop(frames=2, width=48, height=36)
    found = photographs_of(sequence)
    np.testing.assert_array_equal(found.labels(1), sequence.mask(0, 1))
    assert "can" in found.label_names.values()
