"""The logic of `gsjax view`'s page, without a browser: rays, colours, cameras, pictures, words."""

import threading
import time

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import gsjax.viz.viewer.drawing
from gsjax.geometry.cameras import look_at
from gsjax.scene.gaussians import gaussians_from_activated
from gsjax.scene.render import plan_render, render
from gsjax.viz.colors import label_color
from gsjax.viz.viewer import Shots, Viewable, moved, pick, words
from gsjax.viz.viewer.cameras import (
    browser_camera,
    extent,
    far_plane,
    first_pose,
    picture_size,
    pose_of,
    scene_up,
    up_direction,
    vertical_fov,
)
from gsjax.viz.viewer.drawing import Drawer, Drawn, picture_of, recolored
from gsjax.viz.viewer.newest import Newest
from gsjax.viz.viewer.page import over, unique
from gsjax.viz.viewer.pick import Picked
from gsjax.viz.viewer.player import Player, frame_pause
from gsjax.viz.viewer.server import free_port, is_loopback
from gsjax.viz.viewer.shot_nodes import shrunk
from gsjax.viz.viewer.splat_nodes import Look, Present, SplatNodes
from gsjax.viz.viewer.splats import Palette, browser_scale, depth_range, splats
from gsjax.viz.viewer.viewable import most_opaque


def cloud(count=24, seed=0, **more):
    """Gaussians of all shapes, about a metre before the camera of `ahead`."""
    rng = np.random.default_rng(seed)
    return gaussians_from_activated(
        np.array([0, 0, 2]) + rng.normal(0, 0.3, (count, 3)),
        rng.normal(size=(count, 4)),
        rng.uniform(0.02, 0.2, (count, 3)),
        rng.uniform(0.3, 0.95, count),
        rng.uniform(0, 1, (count, 3)),
        **more,
    )


def ahead(width=48, height=40, fov=0.6):
    """A camera at the origin that looks along +z, +y down."""
    return browser_camera(np.array([1.0, 0, 0, 0]), np.zeros(3), fov, width, height)


def made(means, quats, scales, opacities, colors):
    """Gaussians from lists."""
    return gaussians_from_activated(*map(np.array, (means, quats, scales, opacities, colors)))


# pick


def brute_force(gaussians, origin, direction):
    """Row and share of what a ray meets: densities sampled along it, one Gaussian at a time."""
    from scipy.spatial.transform import Rotation

    direction = direction / np.linalg.norm(direction)
    ts = np.linspace(0.01, 6, 6_001)
    points = origin + ts[:, None] * direction
    met = []
    for i in range(gaussians.num):
        R = Rotation.from_quat(np.asarray(gaussians.quats)[i], scalar_first=True).as_matrix()
        precision = R @ np.diag(np.exp(-2 * np.asarray(gaussians.log_scales, float)[i])) @ R.T
        d = points - np.asarray(gaussians.means, float)[i]
        alpha = float(gaussians.opacities[i]) * np.exp(-0.5 * np.einsum("ti,ij,tj->t", d, precision, d))
        best = alpha.argmax()
        if 0 < best < len(ts) - 1 and alpha[best] >= 1 / 255:
            met.append((ts[best], i, min(alpha[best], 0.99)))
    shares, through = {}, 1.0
    for _, i, alpha in sorted(met):
        shares[i] = alpha * through
        through *= 1 - alpha
    return max(shares, key=shares.get, default=None), shares, 1 - through


def test_pick_finds_what_brute_force_finds():
    gaussians = cloud()
    rng = np.random.default_rng(1)
    hits = 0
    for _ in range(16):
        origin = rng.normal(0, 0.1, 3)
        direction = np.array([*rng.normal(0, 0.18, 2), 1.0])
        best, shares, stopped = brute_force(gaussians, origin, direction)
        picked = pick(gaussians, origin, 3 * direction)
        assert (picked is not None) == (stopped >= 0.5)
        if picked is not None:
            hits += 1
            assert picked.index == best
            assert picked.share == pytest.approx(shares[best], abs=3e-3)
            assert picked.alpha == pytest.approx(stopped, abs=3e-3)
            unit = direction / np.linalg.norm(direction)
            np.testing.assert_allclose(picked.point, origin + picked.depth * unit, atol=1e-6)
    assert 4 < hits < 16


def test_pick_agrees_with_the_picture():
    """Small Gaussians, one channel each: in a pixel, the rasterizer's largest weight is that of the pick."""
    count = 20
    gaussians = cloud(count, seed=3)
    camera = ahead(24, 24)
    plan = plan_render(gaussians, camera, eps2d=0.0)
    weights = np.asarray(render(gaussians, camera, plan, features=jnp.eye(count)).meta.features[0])
    K = np.asarray(camera.K[0], float)
    same, clear = 0, 0
    for y, x in np.ndindex(24, 24):
        order = np.sort(weights[y, x])
        if weights[y, x].sum() < 0.6 or order[-1] < 1.5 * order[-2]:
            continue
        clear += 1
        ray = np.linalg.inv(K) @ [x + 0.5, y + 0.5, 1.0]
        picked = pick(gaussians, np.zeros(3), ray)
        same += picked is not None and picked.index == weights[y, x].argmax()
    # A picture sorts by the centres' depths and projects to an ellipse; a ray meets the density itself.
    assert clear > 60
    assert same > 0.9 * clear


def test_pick_meets_nothing_behind_or_beside():
    gaussians = cloud(count=3)
    assert pick(gaussians, np.zeros(3), np.array([0, 0, -1.0])) is None
    assert pick(gaussians, np.array([50.0, 0, 0]), np.array([0, 0, 1.0])) is None
    with pytest.raises(ValueError, match="direction"):
        pick(gaussians, np.zeros(3), np.zeros(3))


def test_pick_takes_what_shows_most_not_what_is_first():
    """A faint veil before a wall."""
    gaussians = made(
        [[0, 0, 1], [0, 0, 2.0]], [[1, 0, 0, 0]] * 2, [[1, 1, 0.001]] * 2, [0.2, 0.95], np.zeros((2, 3))
    )
    picked = pick(gaussians, np.zeros(3), np.array([0, 0, 1.0]))
    assert picked is not None
    assert picked.index == 1
    assert picked.share == pytest.approx(0.8 * 0.95, abs=1e-6)
    assert picked.depth == pytest.approx(2.0, abs=1e-6)


# splats


def test_splats_are_the_gaussians_in_another_unit():
    gaussians = cloud()
    scale = browser_scale(gaussians)
    sent = splats(gaussians, scale)
    np.testing.assert_allclose(sent.centers * scale, gaussians.means, rtol=1e-5, atol=1e-6)
    variances = np.linalg.eigvalsh(sent.covariances * scale**2)
    np.testing.assert_allclose(variances, np.sort(np.asarray(gaussians.scales) ** 2, axis=1), rtol=2e-3)


def test_gaussians_of_a_tenth_of_a_millimetre_survive_half_precision():
    gaussians = made(
        np.zeros((2, 3)), [[1, 0, 0, 0]] * 2, np.full((2, 3), 1e-4), [0.5, 0.5], np.zeros((2, 3))
    )
    scale = browser_scale(gaussians)
    halved = splats(gaussians, scale).covariances.astype(np.float16).astype(float) * scale**2
    np.testing.assert_allclose(halved[:, [0, 1, 2], [0, 1, 2]], 1e-8, rtol=1e-2)


def test_the_most_opaque_are_kept_in_their_order():
    gaussians = cloud(40)
    rows = most_opaque(gaussians, 10)
    assert (np.diff(rows) > 0).all()
    rest = np.setdiff1d(np.arange(40), rows)
    opacities = np.asarray(gaussians.opacities)
    assert opacities[rows].min() >= opacities[rest].max()
    assert len(most_opaque(gaussians, 41)) == 40


def test_palettes():
    features = np.random.default_rng(0).normal(size=(24, 5))
    labels = np.arange(24) % 3
    scene = Viewable("x", cloud(features=features), labels)
    assert scene.colorings == ("colour", "depth", "label", "features")
    palette, rows = Palette(scene), np.array([0, 1, 5])
    means = np.asarray(scene.gaussians.means)
    viewmat = np.asarray(ahead().viewmat[0])
    rgb = palette("colour", means, rows, None, None)
    rng = np.random.default_rng(0)  # as in `cloud`
    for shape in ((24, 3), (24, 4)):
        rng.normal(size=shape)
    rng.uniform(size=(24, 3)), rng.uniform(size=24)
    np.testing.assert_allclose(rgb, rng.uniform(0, 1, (24, 3))[rows], atol=1 / 255)
    expected = np.array([label_color(int(label)) for label in labels[rows]]) / 255
    np.testing.assert_allclose(palette("label", means, rows, None, None), expected, atol=1e-6)
    depth = palette("depth", means, np.arange(24), viewmat, (1.0, 3.0)).sum(1)
    order = np.argsort(means[:, 2])
    assert depth[order[0]] == depth.max() > depth[order[-1]] == depth.min()
    assert palette("features", means, rows, None, None).std() > 0


def test_a_scene_offers_only_what_it_has():
    assert Viewable("x", cloud()).colorings == ("colour", "depth")
    assert Viewable("x", cloud(), np.zeros(24, int)).colorings == ("colour", "depth")


class Api:
    """Stands for viser's scene: keeps what is added, counts what is sent."""

    def __init__(self):
        self.nodes, self.sent = {}, []

    def add_gaussian_splats(self, name, centers, covariances, rgbs, opacities, *, scale):
        api = self

        class Node:
            def set_gaussians(self, *arrays):
                api.sent.append(name)
                api.nodes[name] = arrays

            def remove(self):
                del api.nodes[name]

        self.nodes[name] = (centers, covariances, rgbs, opacities)
        self.sent.append(name)
        return Node()


def moving_scene(frames=4, moving=8):
    gaussians = cloud()
    steps = np.linspace(0, 0.6, frames)[:, None, None] * [1.0, 0, 0]
    means = np.asarray(gaussians.means)[None, :moving] + steps
    quats = np.repeat(np.asarray(gaussians.quats)[None, :moving], frames, axis=0)
    times = np.arange(frames) / 10.0
    return Viewable("x", gaussians, motion=moved(gaussians, means.astype(np.float32), quats), times=times)


def now(scene, frame):
    """A frame of a scene, as it is shown."""
    return Present(scene, Palette(scene), frame, scene.at(frame))


def test_only_what_differs_is_sent_again():
    scene, api = moving_scene(), Api()
    nodes = SplatNodes(api, scene, 1000)
    look = Look("colour")
    nodes.show(now(scene, 0), look)
    nodes.show(now(scene, 0), Look("colour"))
    assert api.sent == ["/splats/moving", "/splats/still"]
    nodes.show(now(scene, 2), look)
    assert api.sent[2:] == ["/splats/moving"]
    scale = browser_scale(scene.gaussians)
    there = np.asarray(scene.gaussians.means)[:8] + np.array([0.4, 0, 0])
    np.testing.assert_allclose(api.nodes["/splats/moving"][0] * scale, there, atol=1e-5)
    viewmat = np.asarray(ahead().viewmat[0], float)
    nodes.show(now(scene, 2), Look("depth", viewmat, (1.0, 3.0)))
    nodes.show(now(scene, 2), Look("depth", viewmat.copy(), (1.0, 3.0)))
    assert api.sent[3:] == ["/splats/moving", "/splats/still"]
    nodes.show(now(scene, 2), Look("depth", viewmat + 0.1, (1.0, 3.0)))
    assert api.sent[5:] == ["/splats/moving", "/splats/still"]


def test_thinned_splats_keep_the_moving_ones_apart():
    scene, api = moving_scene(), Api()
    SplatNodes(api, scene, 10).show(now(scene, 0), Look("colour"))
    sizes = {name: len(arrays[0]) for name, arrays in api.nodes.items()}
    assert sum(sizes.values()) == 10
    assert sizes["/splats/moving"] == (most_opaque(scene.gaussians, 10) < 8).sum()


# what is shown


def test_frames_move_the_first_gaussians_only():
    scene = moving_scene()
    assert scene.num_frames == 4
    later = scene.at(3)
    np.testing.assert_allclose(later.means[:8], scene.gaussians.means[:8] + np.array([0.6, 0, 0]), atol=1e-6)
    np.testing.assert_array_equal(later.means[8:], scene.gaussians.means[8:])
    assert later.features is None


@pytest.mark.parametrize(
    ("change", "says"),
    [
        ({"labels": np.zeros(3, int)}, r"labels: got shape \(3,\), want \(24,\)"),
        ({"times": np.zeros(2)}, r"times: got shape \(2,\), want \(1,\)"),
    ],
)
def test_bad_scenes_are_refused(change, says):
    with pytest.raises(ValueError, match=says):
        Viewable("x", cloud(), **change)


def test_bad_motions_are_refused():
    with pytest.raises(ValueError, match=r"\[T,M,3\], T from 1 on, M to 24"):
        moved(cloud(), np.zeros((2, 25, 3)), np.zeros((2, 25, 4)))
    with pytest.raises(ValueError, match="quats: got shape"):
        moved(cloud(), np.zeros((2, 5, 3)), np.zeros((2, 4, 4)))


def test_what_cannot_be_drawn_is_refused():
    broken = cloud()
    means = broken.means.at[0, 0].set(jnp.nan)
    with pytest.raises(ValueError, match="NaN"):
        Viewable("x", made(means, broken.quats, broken.scales, [0.5] * 24, means))
    with pytest.raises(ValueError, match="found none"):
        Viewable("x", cloud(0))
    with pytest.raises(ValueError, match="Ks: got shape"):
        Shots(("a",), np.eye(4)[None, None], np.zeros((1, 2, 3, 3)), np.array([[4, 3]]))


# cameras


def shots_around(up, count=6, height=0.6):
    """Level cameras on a circle about the origin; 640x480, vertical field of view 2 atan(1/2)."""
    up = np.asarray(up, float)
    side = np.eye(3)[np.abs(up).argmin()]
    other = np.cross(up, side)
    angles = np.linspace(0, 2 * np.pi, count, endpoint=False)
    eyes = 3 * (np.cos(angles)[:, None] * side + np.sin(angles)[:, None] * other) + height * up
    viewmats = np.stack([look_at(eye, np.zeros(3), up) for eye in eyes])
    K = np.array([[480.0, 0, 320], [0, 480, 240], [0, 0, 1]])
    names = tuple(f"{i}.jpg" for i in range(count))
    return Shots(names, viewmats[None], np.tile(K, (1, count, 1, 1)), np.tile([640, 480], (count, 1)))


@pytest.mark.parametrize("up", [[0, 0, 1], [0, -1, 0], [0.6, 0, 0.8]])
def test_up_is_where_level_cameras_say(up):
    found = up_direction(shots_around(up, height=1.5).viewmats[0])
    np.testing.assert_allclose(found, up, atol=1e-6)


def test_cameras_that_look_one_way_say_up_by_their_pictures():
    viewmats = np.stack([look_at(np.array([x, 0.1, 2.0]), np.array([x, 0.0, 0])) for x in (-0.1, 0, 0.1)])
    up = up_direction(viewmats)
    assert up @ -viewmats[0, 1, :3] > 0.97


def test_a_scene_says_what_is_up():
    assert scene_up(Viewable("x", cloud())).tolist() == [0, 0, 1]
    assert scene_up(Viewable("x", cloud(), up=np.array([0, -2.0, 0]))).tolist() == [0, -1, 0]


def test_it_is_looked_at_from_where_a_photograph_was_taken():
    rng = np.random.default_rng(0)
    ball = made(
        rng.normal(0, 0.2, (300, 3)), rng.normal(size=(300, 4)), np.full((300, 3), 0.1), [0.9] * 300,
        np.zeros((300, 3)),
    )  # fmt: skip
    scene = Viewable("x", ball, shots=shots_around([0, 0, 1]))
    pose = first_pose(scene)
    to_world = np.linalg.inv(scene.shots.viewmats[0, 0])
    np.testing.assert_allclose(pose.position, to_world[:3, 3], atol=1e-9)
    assert np.linalg.norm(pose.target) < 0.6  # the ball's near side, not the camera
    assert pose.up.tolist() == [0, 0, 1]
    assert pose.fov == pytest.approx(2 * np.arctan(0.5))
    assert far_plane(ball, pose) == 1000


def test_without_photographs_it_is_seen_whole():
    gaussians = cloud(200)
    pose = first_pose(Viewable("x", gaussians, up=np.array([0, -1.0, 0])))
    middle, _ = extent(gaussians)
    np.testing.assert_allclose(pose.target, middle)
    view = look_at(pose.position, pose.target, pose.up)
    local = np.asarray(gaussians.means) @ view[:3, :3].T + view[:3, 3]
    inside = np.abs(local[:, :2]).max(1) < np.tan(pose.fov / 2) * local[:, 2]
    assert inside.mean() > 0.75
    assert pose.position @ [0, -1, 0] > middle @ [0, -1, 0]


def test_the_browsers_camera_sees_what_the_photographs_saw():
    shots = shots_around([0, 0, 1])
    from scipy.spatial.transform import Rotation

    pose = pose_of(shots, 0, 2, 3.0)
    wxyz = Rotation.from_matrix(shots.viewmats[0, 2, :3, :3].T).as_quat(scalar_first=True)
    camera = browser_camera(wxyz, pose.position, pose.fov, 640, 480)
    np.testing.assert_allclose(camera.viewmat[0], shots.viewmats[0, 2], atol=1e-6)
    np.testing.assert_allclose(camera.K[0], shots.Ks[0, 2], atol=1e-3)
    np.testing.assert_allclose(pose.target, pose.position + 3 * shots.viewmats[0, 2, 2, :3])
    assert vertical_fov(shots.Ks[0, 2], 480) == pytest.approx(pose.fov)


def test_pictures_have_about_the_windows_shape():
    assert picture_size(320, (1600, 920)) == (320, 184)
    assert picture_size(320, (1601, 925)) == (320, 184)
    assert picture_size(160, (0, 0)) == (160, 160)
    assert picture_size(160, (100, 5000)) == (160, 480)
    assert picture_size(160, (5000, 10)) == (160, 8)


def test_the_scale_of_depth_is_of_what_is_seen():
    means = np.array([[0, 0, 1.0], [0, 0, 2], [0, 0, 3], [50, 0, 4], [0, 0, -5]])
    near, far = depth_range(means, np.eye(4), 1.0, 1.0)
    assert (near, far) == pytest.approx((1.04, 2.96))
    assert depth_range(-means[:3], np.eye(4), 1.0, 1.0) is None


# our picture


def counted(monkeypatch):
    """How often the program that draws was traced."""
    traces = []

    def draw(*arguments, **options):
        traces.append(arguments)
        return render(*arguments, **options)

    monkeypatch.setattr(gsjax.viz.viewer.drawing, "render", draw)
    return traces


def test_moving_compiles_nothing_unless_a_plan_grows(monkeypatch):
    """From far away few tiles are touched, from near by all: that asks for another plan."""
    traces, drawer = counted(monkeypatch), Drawer((0.2, 0.4, 0.6))
    gaussians = cloud(400)

    def at(x, z, turn=0.0):
        quat = np.array([1.0, turn, 0, 0]) / np.hypot(1.0, turn)
        return browser_camera(quat, np.array([x, 0, z]), 0.5, 96, 96)

    drawer(gaussians, at(0, -300.0))
    drawer(gaussians, at(0.1, -290.0))
    assert len(traces) == 1
    drawer(gaussians, at(0, 0.9))
    assert len(traces) == 2
    (plans,) = drawer._plans.values()
    (plan,) = plans.values()
    reference = jax.jit(
        lambda camera: render(gaussians, camera, plan, backgrounds=jnp.array([[0.2, 0.4, 0.6]]))
    )
    for camera in (at(0, 0.9), at(-0.2, 0.5, 0.05), at(0, -300.0)):
        drawn, expected = drawer(gaussians, camera), reference(camera)
        assert not expected.meta.overflow.any()
        np.testing.assert_allclose(drawn.colors, expected.colors[0], atol=2e-5)
        np.testing.assert_allclose(drawn.alphas, expected.alphas[0], atol=2e-5)
        assert (drawn.depths[drawn.alphas <= 0.5] == 0).all()
        assert (drawn.depths[drawn.alphas > 0.5] > 0).all()
    assert len(traces) == 2


@pytest.mark.slow
def test_scenes_of_fewer_gaussians_compile_nothing(monkeypatch):
    """Nor does one of a few more, once there was one of more; and their pictures are their own."""
    traces, drawer = counted(monkeypatch), Drawer()
    for count, compiled in ((100, 1), (60, 1), (120, 2), (140, 2), (100, 2), (1, 2)):
        gaussians = cloud(count)
        drawn = drawer(gaussians, ahead())
        assert len(traces) == compiled
        alone = render(gaussians, ahead(), plan_render(gaussians, ahead()))
        np.testing.assert_allclose(drawn.colors, alone.colors[0], atol=1e-5)
        np.testing.assert_allclose(drawn.alphas, alone.alphas[0], atol=1e-5)


def test_pictures_of_what_was_drawn():
    drawn = Drawn(np.full((2, 2, 3), 0.5, np.float32), np.ones((2, 2)), np.array([[0, 1.0], [0.5, 2]]))
    assert (picture_of(drawn, "colour", None) == 128).all()
    assert picture_of(drawn, "alpha", None)[..., 1].tolist() == [[0, 255], [128, 255]]
    near, far = (picture_of(drawn, "depth", ends)[0, 0].sum() for ends in ((1.0, 2.0), (0.5, 1.0)))
    assert near > far


def test_recoloured_gaussians_have_that_colour_from_all_sides():
    gaussians = cloud(shN=np.ones((24, 3, 3)))
    red = recolored(gaussians, np.tile([1.0, 0, 0], (24, 1)))
    assert red.sh_degree == 0
    drawn = Drawer()(red, ahead())
    np.testing.assert_allclose(drawn.colors[..., 0], drawn.alphas, atol=1e-5)
    assert np.abs(drawn.colors[..., 1:]).max() < 1e-5


# threads


def test_what_was_asked_for_while_busy_is_done_once():
    begun, go, done, runs = threading.Event(), threading.Event(), threading.Event(), []

    def work():
        runs.append(len(runs))
        begun.set()
        if len(runs) == 1:
            assert go.wait(30)
        else:
            done.set()

    worker = Newest(work)
    worker.ask()
    assert begun.wait(30)
    for _ in range(5):
        worker.ask()
    go.set()
    assert done.wait(30)
    worker.close()
    worker.ask()
    assert runs == [0, 1]


def test_what_never_settles_is_done_at_last():
    done = threading.Event()
    worker = Newest(done.set, settle_s=60.0, patience_s=0.2)
    worker.ask()
    for _ in range(2000):
        worker.ask()
        if done.wait(0.01):
            break
    assert done.is_set()
    worker.close()


# playing


def test_play_stop_play_at_once_is_one_player():
    """The first has not heard yet that it is to stop when the second begins."""
    waits, told = [], []

    def pause():
        waits.append(threading.current_thread())
        return 0.3

    player = Player(lambda: None, pause, told.append)
    for _ in range(3):
        player.toggle()
    assert told == [True, False, True]
    until = time.monotonic() + 30
    while len(set(waits)) < 2 or sum(thread.is_alive() for thread in set(waits)) > 1:
        assert time.monotonic() < until, "two play"
        time.sleep(0.01)
    player.close()
    for thread in set(waits):
        thread.join(30)
        assert not thread.is_alive()
    player.toggle()
    assert told == [True, False, True]


# words


def test_a_pick_is_told_in_full():
    scene = Viewable("x", cloud(), np.full(24, 2), {2: "can|*top*"}, unit="m")
    told = words.described(scene, Picked(7, 1.2345, np.zeros(3), 0.61, 0.9), 0)
    x, y, z = np.asarray(scene.gaussians.means)[7]
    assert f"| centre | {x:.3f}, {y:.3f}, {z:.3f} m |" in told
    assert "| Gaussian | 7 of 24 |" in told
    assert r"| label | can\|\*top\* (2) |" in told
    assert f"| opacity | {float(scene.gaussians.opacities[7]):.2f} |" in told
    assert "| distance | 1.23 m |" in told
    assert "| share of colour | 61 % |" in told
    assert "label" not in words.described(Viewable("x", cloud()), Picked(7, 1, np.zeros(3), 1, 1), 0)
    assert "Nothing there" in words.described(scene, None, 0)


def test_legends_name_what_colours_mean():
    scene = Viewable("x", cloud(), np.arange(24) % 3, {1: "<b>mug</b>"}, unit="m")
    html = words.legend(scene, "label", None, [0, 1, 2])
    assert "&lt;b&gt;mug&lt;/b&gt;" in html
    assert "<b>" not in html
    assert "background" in html
    assert "object 2" in html
    assert "rgb({}, {}, {})".format(*label_color(1)) in html
    assert "and 6 more" in words.legend(scene, "label", None, range(30))
    assert "bright: 0.5 m away, dark: 2.25 m" in words.legend(scene, "depth", (0.5, 2.25))
    assert words.legend(scene, "colour", (0.5, 2.25)) == ""


def test_the_heading_says_what_there_is():
    scene = moving_scene()
    assert "**24** Gaussians, SH degree 0, 4 frames." in words.heading(scene, 24)
    assert "the 10 most opaque" in words.heading(scene, 10)
    assert words.moment(scene, 2) == "0.20 s of 0.30 s"
    assert "photographs" in words.heading(Viewable("x", cloud(), shots=shots_around([0, 0, 1])), 24)


# the rest of the page


def test_names_that_repeat_are_numbered():
    assert unique(("a", "b")) == ("a", "b")
    assert unique(("a", "b", "a")) == ("0: a", "1: b", "2: a")


def test_playing_keeps_the_recordings_time_within_reason():
    assert frame_pause(np.arange(5) / 5) == pytest.approx(0.2)
    assert frame_pause(np.arange(5) / 1000) == pytest.approx(1 / 12)
    assert frame_pause(np.arange(5) * 60.0) == 1
    assert frame_pause(None) == pytest.approx(1 / 12)


def test_a_transparent_picture_lies_over_the_background():
    clear = np.zeros((2, 2, 4), np.uint8)
    clear[0, 0] = (10, 20, 30, 255)
    found = over(clear, (1.0, 0.0, 0.5))
    assert found[0, 0].tolist() == [10, 20, 30]
    assert found[1, 1].tolist() == [255, 0, 128]
    assert over(clear[..., :3], (1.0, 1.0, 1.0)) is not None


def test_thumbnails():
    assert shrunk(np.zeros((300, 400, 3), np.uint8), 100).shape == (75, 100, 3)
    assert shrunk(np.zeros((30, 40, 3), np.uint8), 100).shape == (30, 40, 3)


# where it listens


def test_loopback():
    assert all(map(is_loopback, ("127.0.0.1", "::1", "localhost", "127.9.9.9")))
    assert not any(map(is_loopback, ("0.0.0.0", "192.168.1.5", "::", "example.org")))


def test_a_port_in_use_is_said_and_the_next_one_taken(monkeypatch):
    import socket

    with socket.socket() as busy:
        busy.bind(("127.0.0.1", 0))
        busy.listen()
        port = busy.getsockname()[1]
        with pytest.raises(OSError, match=f"port {port}: cannot listen there on 127.0.0.1"):
            free_port("127.0.0.1", port)
        monkeypatch.setattr("gsjax.viz.viewer.server.PORT", port)
        assert port < free_port("127.0.0.1", None) < port + 50
    assert free_port("127.0.0.1", 0) > 0
    with pytest.raises(ValueError, match="port: expected"):
        free_port("127.0.0.1", 70_000)
    with pytest.raises(OSError, match="no address of this machine"):
        free_port("no-such-host.invalid", None)
