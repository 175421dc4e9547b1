"""The ray-caster against closed forms, and the built-in scene against its own poses."""

import time

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from gsjax.data.simulated import Light, Primitive, Scene, Texture, simulated_sequence, tabletop
from gsjax.data.simulated.motion import along_keyframes, between, coast, rigid
from gsjax.data.simulated.primitives import intersect, normals
from gsjax.data.simulated.textures import albedo
from gsjax.geometry.cameras import intrinsics, look_at

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
    """One primitive of label 1 at `pose`, seen by a camera at the origin that looks along +z of the world."""
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
    """Directions [H,W,3] with z = 1 of the camera of `single`."""
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
    """The solid's implicit function, positive outside, is zero at a hit, positive before it and on a miss."""
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
    """Positive outside of the solid, zero on its surface, negative inside."""
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
    """The pixels that a long box covers do not depend on the rectangle in which it is looked for."""
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


def test_a_stick_lies_between_its_ends():
    ends = np.random.default_rng(0).normal(size=(2, 5, 3))
    ends[:, 0, :2] = 0  # upright
    poses = between(ends[0], ends[1])
    half = np.linalg.norm(ends[1] - ends[0], axis=1) / 2
    np.testing.assert_allclose(poses[:, :3, 3] + half[:, None] * poses[:, :3, 2], ends[1], atol=1e-12)
    np.testing.assert_allclose(np.linalg.det(poses[:, :3, :3]), 1)


# The built-in scene


@pytest.fixture(scope="module")
def scene():
    return tabletop(seed=0, frames=60, width=160, height=120)


def world_points(sequence, t, c, mask):
    y, x = np.nonzero(mask)
    pixels = np.stack([x + 0.5, y + 0.5, np.ones(len(x))])
    view = sequence.viewmats[t, c]
    local = np.linalg.inv(sequence.Ks[t, c]) @ pixels * sequence.depth(t, c)[y, x].astype(np.float64)
    return view[:3, :3].T @ (local - view[:3, 3:]), x, y


def test_it_is_what_its_description_says(scene):
    assert scene.truth.names == ("carton", "can", "ball", "block")
    assert scene.truth.label_ids.tolist() == [2, 3, 4, 5]
    assert scene.truth.robot == 1
    assert (scene.num_frames, scene.num_cameras) == (60, 3)
    np.testing.assert_allclose(np.diff(scene.times), 1 / 30)
    for c in range(3):
        assert set(np.unique(scene.mask(0, c))) == {0, 1, 2, 3, 4, 5}
    assert scene.image(0, 0).std() > 20


@pytest.mark.parametrize("seed", range(8))
@pytest.mark.parametrize("option", [None, "hide"])
def test_objects_move_as_far_as_promised(seed, option):
    poses = tabletop(seed=seed, width=32, height=24, **({option: True} if option else {})).truth.poses
    steps = np.linalg.norm(np.diff(poses[..., :3, 3], axis=0), axis=-1).max(0)
    turns = np.swapaxes(poses[:-1, :, :3, :3], -1, -2) @ poses[1:, :, :3, :3]
    angles = np.degrees(Rotation.from_matrix(turns.reshape(-1, 3, 3)).magnitude()).reshape(59, 4).max(0)
    assert (steps <= 0.0301).all()
    assert (angles <= 15).all()
    assert (steps[:3] > 0.004).all()
    assert (angles[:3] > 2).all()
    assert steps[3] == 0
    assert poses[:, 0, 2, 3].max() - poses[0, 0, 2, 3] > 0.15  # lifted


@pytest.mark.parametrize("name", ["carton", "can", "ball", "block"])
def test_depth_labels_and_poses_agree(scene, name):
    """Pixels of an object, taken back into its own frame, lie on its surface in every frame."""
    k = scene.truth.names.index(name)
    solids = {
        "carton": [Primitive("box", (0.045, 0.028, 0.065), GREY)],
        "can": [Primitive("cylinder", (0.034, 0.049), GREY), Primitive("cylinder", (0.030, 0.055), GREY)],
        "ball": [Primitive("sphere", (0.036,), GREY)],
        "block": [Primitive("box", (0.034, 0.034, 0.030), GREY)],
    }[name]
    for t, c in ((0, 0), (10, 1), (22, 2), (59, 1)):
        points, _, _ = world_points(scene, t, c, scene.mask(t, c) == scene.truth.label_ids[k])
        pose = scene.truth.poses[t, k]
        local = pose[:3, :3].T @ (points - pose[:3, 3:])
        distance = np.min([np.abs(outside(solid, local)) for solid in solids], axis=0)
        assert distance.size > 20
        assert distance.max() < 1e-6


def flow_by_poses(sequence, t, c, k):
    """Pixels that object k moves from frame t to the next, from its depth and its poses."""
    points, x, y = world_points(sequence, t, c, sequence.mask(t, c) == sequence.truth.label_ids[k])
    motion = sequence.truth.poses[t + 1, k] @ np.linalg.inv(sequence.truth.poses[t, k])
    view = sequence.viewmats[t + 1, c] @ motion
    image = sequence.Ks[t + 1, c] @ (view[:3, :3] @ points + view[:3, 3:])
    return (image[:2] / image[2]).T - np.stack([x + 0.5, y + 0.5], 1)


@pytest.mark.parametrize("moving", [False, True])
def test_flow_moves_points_by_their_poses(moving):
    scene = tabletop(seed=2, frames=14, width=160, height=120, moving_cameras=moving)
    for t, c in ((2, 0), (12, 1)):
        flow = scene.flow(t, c)
        for k, label in enumerate(scene.truth.label_ids):
            expected = flow_by_poses(scene, t, c, k)
            np.testing.assert_allclose(flow[scene.mask(t, c) == label], expected, atol=1e-4)
        still = np.abs(flow[scene.mask(t, c) == 0]).max()
        assert (still > 0.1) == moving


def test_flow_of_a_selection_spans_the_frames_left_out(scene):
    part = scene.select([0, 10, 20])
    flow = part.flow(0, 0)[part.mask(0, 0) == 3]
    np.testing.assert_allclose(flow, flow_by_poses(part, 0, 0, k=1), atol=1e-4)
    assert np.linalg.norm(flow, axis=1).min() > 5


def test_flow_warps_one_image_onto_the_next(scene):
    """Brightness is kept, as far as shadows do not move."""
    first, second = scene.image(4, 1).astype(float).mean(-1), scene.image(5, 1).astype(float).mean(-1)
    can = scene.mask(4, 1) == 3
    y, x = np.nonzero(can)
    target = np.floor(np.stack([x, y], 1) + 0.5 + scene.flow(4, 1)[can]).astype(int)
    kept = scene.mask(5, 1)[target[:, 1], target[:, 0]] == 3
    warped = np.abs(second[target[kept, 1], target[kept, 0]] - first[y[kept], x[kept]])
    unmoved = np.abs(second[y[kept], x[kept]] - first[y[kept], x[kept]])
    assert np.mean(warped) < 0.6 * np.mean(unmoved)


def test_where_nothing_is_seen():
    sequence = single(SOLIDS[1], rigid(None, [0.0, 0.0, 3.0]))
    scene = Scene(
        primitives=(SOLIDS[1],),
        labels=np.array([1]),
        poses=np.tile(rigid(None, [0.0, 0.0, 3.0]), (2, 1, 1, 1)),
        light=Light((1.0, 0.0, 0.0)),
        Ks=np.tile(intrinsics(WIDTH, WIDTH, HEIGHT), (2, 1, 1, 1)),
        viewmats=np.tile(np.eye(4), (2, 1, 1, 1)),
        width=WIDTH,
        height=HEIGHT,
    )
    moving = simulated_sequence("two frames", scene, np.arange(2.0), {"ball": 0})
    empty = sequence.mask(0, 0) == 0
    assert (sequence.depth(0, 0)[empty] == 0).all()
    assert (sequence.image(0, 0)[0, 0] == 0).all()
    flow = moving.flow(0, 0)
    np.testing.assert_array_equal(np.isnan(flow[..., 0]), empty)
    np.testing.assert_allclose(flow[~empty], 0, atol=1e-9)


def test_seeds_decide_and_fewer_frames_are_the_beginning(scene):
    short = tabletop(seed=0, frames=3, width=160, height=120)
    np.testing.assert_array_equal(short.truth.poses, scene.truth.poses[:3])
    np.testing.assert_array_equal(short.image(2, 1), scene.image(2, 1))
    assert not np.array_equal(tabletop(seed=1, frames=1).truth.poses[0], scene.truth.poses[0])


def test_one_frame_one_camera_one_pixel():
    sequence = tabletop(frames=1, cameras=1, width=1, height=1)
    assert sequence.depth(0, 0).shape == (1, 1)


def test_a_still_scene():
    sequence = tabletop(frames=20, width=64, height=48, still=True)
    np.testing.assert_array_equal(sequence.image(0, 0), sequence.image(19, 0))
    np.testing.assert_allclose(sequence.flow(0, 0), 0, atol=1e-9)


@pytest.mark.parametrize("seed", range(3))
def test_the_can_leaves_all_views(seed):
    sequence = tabletop(seed=seed, frames=60, width=160, height=120, leave=True)
    seen = [[(sequence.mask(t, c) == 3).any() for c in range(3)] for t in (0, 59)]
    assert seen == [[True] * 3, [False] * 3]


@pytest.mark.parametrize("seed", range(3))
def test_the_can_is_hidden_and_comes_back(seed):
    sequence = tabletop(seed=seed, frames=60, width=160, height=120, hide=True)
    seen = [[(sequence.mask(t, c) == 3).any() for c in range(3)] for t in (0, 20, 59)]
    assert seen == [[True] * 3, [False] * 3, [True] * 3]


def test_cameras_may_move():
    sequence = tabletop(frames=10, width=64, height=48, moving_cameras=True)
    assert not np.allclose(sequence.viewmats[0], sequence.viewmats[9])
    assert np.allclose(tabletop(frames=2, width=64, height=48).viewmats[0], sequence.viewmats[0])


def test_the_caller_may_write_into_an_image(scene):
    before = scene.image(0, 0)
    before[:] = 0
    assert scene.image(0, 0).any()


@pytest.mark.parametrize("name", ["frames", "width", "height", "cameras"])
def test_counts_must_be_positive(name):
    with pytest.raises(ValueError, match=f"{name} must be at least 1, got 0"):
        tabletop(**{name: 0})


def test_a_frame_is_rendered_fast():
    sequence = tabletop(frames=4, width=320, height=240)
    sequence.image(0, 0)  # the noise is made once
    durations = []
    for t in range(1, 4):
        start = time.thread_time()
        sequence.image(t, 0), sequence.depth(t, 0), sequence.mask(t, 0)
        durations.append(time.thread_time() - start)
    assert min(durations) < 0.6  # it is 0.1 s without the checks of annotations


def test_cameras_look_at_the_table(scene):
    eye = -scene.viewmats[0, 0, :3, :3].T @ scene.viewmats[0, 0, :3, 3]
    np.testing.assert_allclose(look_at(eye, np.array([-0.03, 0.0, 0.04])), scene.viewmats[0, 0], atol=1e-12)
