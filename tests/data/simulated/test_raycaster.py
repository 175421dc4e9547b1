"""The ray-caster against closed forms, its light and textures, and keyframe motions."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from gsjax.data.simulated import Light, Primitive, Scene, Texture, simulated_sequence
from gsjax.data.simulated.motion import along_keyframes, between, coast, rigid
from gsjax.data.simulated.primitives import intersect, normals
from gsjax.data.simulated.textures import albedo
from gsjax.geometry.cameras import intrinsics

GREY = Texture("noise", ((0.5, 0.5, 0.5), (0.5, 0.5, 0.5)), 0.1, grain=0.0)
WIDTH, HEIGHT = 48, 36
LIGHT = Light((1.0, -1.0, 3.0))
SOLIDS = [
    Primitive("box", (0.3, 0.2, 0.5), GREY),
    Primitive("sphere", (0.4,), GREY),
    Primitive("cylinder", (0.3, 0.4), GREY),
]
seeds = st.integers(0, 10_000)


def single(primitive, pose, light=LIGHT, extra=(), size=(WIDTH, HEIGHT)):
    """One primitive of label 1 at `pose`, and a camera at the origin that looks along the world's +z axis."""
    width, height = size
    poses = np.stack([np.eye(4), pose])[None]
    moved = Primitive(primitive.shape, primitive.size, primitive.texture, body=1)
    scene = Scene(
        primitives=(moved, *extra),
        labels=np.array([0, 1]),
        poses=poses,
        light=light,
        Ks=intrinsics(width, width, height)[None, None],
        viewmats=np.eye(4)[None, None],
        width=width,
        height=height,
    )
    return simulated_sequence("single", scene, np.zeros(1), {"thing": 1})


def pixel_rays(width=WIDTH, height=HEIGHT):
    """Ray directions [H,W,3] of the camera of `single`, with z = 1."""
    x, y = np.meshgrid(np.arange(width) + 0.5, np.arange(height) + 0.5)
    return np.stack([(x - width / 2) / width, (y - height / 2) / width, np.ones_like(x)], -1)


def random_pose(rng, distance):
    offset = np.array([*rng.uniform(-0.3, 0.3, 2), distance])
    return rigid(Rotation.random(rng=rng), offset)


# Depth against closed forms


@given(seeds)
def test_depth_of_a_plane(seed):
    rng = np.random.default_rng(seed)
    tilt = Rotation.from_euler("xy", rng.uniform(-0.3, 0.3, 2)) * Rotation.from_euler(
        "x", np.pi
    )  # faces the camera
    pose = rigid(tilt, np.array([0.0, 0.0, rng.uniform(1, 3)]))
    normal = pose[:3, 2]
    expected = (normal @ pose[:3, 3]) / (pixel_rays() @ normal)
    np.testing.assert_allclose(single(Primitive("plane", (), GREY), pose).depth(0, 0), expected, rtol=1e-6)


@given(seeds)
def test_depth_of_a_sphere(seed):
    rng = np.random.default_rng(seed)
    pose, rays = random_pose(rng, rng.uniform(1, 3)), pixel_rays()
    center, radius = pose[:3, 3], 0.4
    a, b, c = (rays**2).sum(-1), rays @ center, center @ center - radius**2
    hit = b * b > a * c
    expected = np.where(hit, (b - np.sqrt(np.maximum(b * b - a * c, 0))) / a, 0)
    sequence = single(SOLIDS[1], pose)
    np.testing.assert_allclose(sequence.depth(0, 0), expected, rtol=1e-6)
    np.testing.assert_array_equal(sequence.mask(0, 0), hit.astype(int))


@pytest.mark.parametrize("solid", SOLIDS, ids=lambda solid: solid.shape)
@given(seed=seeds)
def test_hits_lie_on_the_surface_and_are_the_first(solid, seed):
    """The solid's implicit function is zero at a hit, and positive before it and along a miss."""
    rng = np.random.default_rng(seed)
    origin = Rotation.random(rng=rng).apply([0, 0, 2.0])
    directions = (rng.normal(size=(200, 3)) * 0.3 - origin).T
    s = intersect(solid, origin, directions)
    hit = np.isfinite(s)
    assert hit.any()
    assert not hit.all()
    along = np.linspace(0, 1, 400)
    end = np.where(hit, s * (1 - 1e-9), 2.0)
    before = origin[:, None, None] + directions[:, :, None] * (end[:, None] * along)
    assert (outside(solid, before) > -1e-9).all()
    at = origin[:, None] + directions[:, hit] * s[hit]
    np.testing.assert_allclose(outside(solid, at), 0, atol=1e-9)


def outside(solid, points):
    """Implicit function: positive outside the solid, zero on its surface, negative inside."""
    match solid.shape:
        case "sphere":
            return np.linalg.norm(points, axis=0) - solid.size[0]
        case "cylinder":
            return np.maximum(
                np.hypot(points[0], points[1]) - solid.size[0], np.abs(points[2]) - solid.size[1]
            )
    half = np.array(solid.size).reshape(3, *[1] * (points.ndim - 1))
    return (np.abs(points) - half).max(0)


@pytest.mark.parametrize("solid", SOLIDS, ids=lambda solid: solid.shape)
def test_normals_are_gradients_of_the_surface(solid):
    rng = np.random.default_rng(0)
    origin = np.array([1.0, -1.5, 1.2])
    directions = (rng.normal(size=(300, 3)) * 0.1 - origin).T
    s = intersect(solid, origin, directions)
    points = origin[:, None] + (directions * s)[:, np.isfinite(s)]
    assert points.shape[1] > 100
    step = 1e-6
    gradient = [
        (outside(solid, points + step * e[:, None]) - outside(solid, points - step * e[:, None])) / (2 * step)
        for e in np.eye(3)
    ]
    smooth = np.linalg.norm(gradient, axis=0) > 0.99  # not astride an edge
    assert smooth.mean() > 0.9
    np.testing.assert_allclose(normals(solid, points)[:, smooth], np.array(gradient)[:, smooth], atol=1e-5)


def test_a_camera_inside_or_before_a_solid_sees_nothing_of_it():
    assert not single(SOLIDS[0], rigid(None, [0.0, 0.0, 0.1])).mask(0, 0).any()
    assert not single(SOLIDS[1], rigid(None, [0.0, 0.0, -2.0])).mask(0, 0).any()


@given(seeds)
def test_a_solid_that_reaches_behind_the_camera_is_not_clipped(seed):
    """The pixels that a long box covers do not depend on the window in which it is traced."""
    rng = np.random.default_rng(seed)
    box = Primitive("box", (0.05, 0.05, 3.0), GREY)
    pose = rigid(Rotation.from_euler("xy", rng.uniform(-0.2, 0.2, 2)), np.array([0.3, 0.2, 2.0]))
    local = pose[:3, :3].T @ pixel_rays().reshape(-1, 3).T
    expected = intersect(box, pose[:3, :3].T @ -pose[:3, 3], local).reshape(HEIGHT, WIDTH)
    np.testing.assert_array_equal(single(box, pose).mask(0, 0) > 0, np.isfinite(expected))


def test_the_nearer_solid_hides_the_other():
    front = Primitive("sphere", (0.1,), GREY, body=0, pose=rigid(None, [0.0, 0.0, 1.0]))
    sequence = single(SOLIDS[1], rigid(None, [0.0, 0.0, 2.0]), extra=(front,))
    mask, depth = sequence.mask(0, 0), sequence.depth(0, 0)
    middle = (HEIGHT // 2, WIDTH // 2)
    assert mask[middle] == 0
    assert depth[middle] == pytest.approx(0.9, abs=1e-3)
    assert mask.sum() > 0
    assert (depth[mask == 1] > 1.5).all()


# Light


def test_a_shadow_is_where_it_should_be():
    """A ball over a plane: dark exactly where the line to the lamp meets the ball."""
    lamp, center, radius = np.array([0.6, -0.4, -1.0]), np.array([0.1, 0.0, 1.2]), 0.15
    wall = Primitive("plane", (), GREY)
    ball = Primitive("sphere", (radius,), GREY, body=0, pose=rigid(None, center))
    facing = rigid(Rotation.from_euler("x", np.pi), np.array([0.0, 0.0, 2.0]))
    dim = Light(tuple(lamp), ambient=(0.0, 0.0, 0.0))
    sequence = single(wall, facing, dim, extra=(ball,), size=(160, 120))
    on_wall = sequence.mask(0, 0) == 1
    points = pixel_rays(160, 120) * 2.0
    rays = points - lamp
    t = np.clip((rays @ (center - lamp)) / (rays**2).sum(-1), 0, 1)
    distance = np.linalg.norm(lamp + t[..., None] * rays - center, axis=-1)
    bright = sequence.image(0, 0)[..., 0] > 0
    clear = on_wall & (np.abs(distance - radius) > 0.02)  # away from the shadow's edge
    assert (clear & (distance < radius)).sum() > 100
    np.testing.assert_array_equal(bright[clear], (distance > radius)[clear])


def test_brightness_follows_lambert():
    lamp = np.array([0.5, 0.2, 0.0])
    facing = rigid(Rotation.from_euler("x", np.pi), np.array([0.0, 0.0, 2.0]))
    light = Light(tuple(lamp), color=(1.0, 1.0, 1.0), ambient=(0.0, 0.0, 0.0))
    image = single(Primitive("plane", (), GREY), facing, light).image(0, 0)[..., 0] / 255
    to_lamp = lamp - pixel_rays() * 2.0
    expected = 0.5 * (-to_lamp[..., 2] / np.linalg.norm(to_lamp, axis=-1)) ** (1 / 2.2)
    np.testing.assert_allclose(image, expected, atol=0.004)


@pytest.mark.parametrize("kind", ["noise", "checker", "stripes", "label"])
def test_textures_are_colours_that_vary_and_repeat_by_seed(kind):
    points = np.random.default_rng(0).uniform(-0.1, 0.1, (3, 2000))
    colors = (0.9, 0.2, 0.1), (0.1, 0.3, 0.8)
    first = albedo(Texture(kind, colors, 0.05, seed=1), points)
    assert first.shape == (3, 2000)
    assert 0 <= first.min() < first.max() <= 1
    assert first[0].std() > 0.05
    np.testing.assert_array_equal(first, albedo(Texture(kind, colors, 0.05, seed=1), points))
    assert not np.allclose(first, albedo(Texture(kind, colors, 0.05, seed=2), points))


# Motion


def test_motions_pass_their_keyframes_at_rest():
    frames = np.linspace(-5, 25, 301)
    path = along_keyframes(frames, (0.0, 10.0, 20.0), [[0.0, 0.0], [1.0, 0.0], [1.0, 2.0]])
    np.testing.assert_allclose(
        path[[0, 50, 150, 250, 300]], [[0, 0], [0, 0], [1, 0], [1, 2], [1, 2]], atol=1e-12
    )
    speed = np.linalg.norm(np.diff(path, axis=0), axis=1) / 0.1
    assert speed.max() == pytest.approx(2 * 1.875 / 10, rel=1e-3)
    slide = coast(frames, 2.0, 10.0)
    assert slide[0] == 0
    assert slide[-1] == 1
    assert np.diff(slide).max() <= 0.2 * 0.1 + 1e-12


def test_a_link_lies_between_its_ends():
    ends = np.random.default_rng(0).normal(size=(2, 5, 3))
    ends[:, 0, :2] = 0  # upright
    poses = between(ends[0], ends[1])
    half = np.linalg.norm(ends[1] - ends[0], axis=1) / 2
    np.testing.assert_allclose(poses[:, :3, 3] + half[:, None] * poses[:, :3, 2], ends[1], atol=1e-12)
    np.testing.assert_allclose(np.linalg.det(poses[:, :3, :3]), 1)
