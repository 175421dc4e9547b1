"""A box that twists and bends: the laws of its map, rays that meet it, and the built-in scene."""

import time

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.ndimage import binary_dilation, map_coordinates
from scipy.spatial.distance import pdist
from scipy.spatial.transform import Rotation

from gsjax.data import Truth, open_sequence
from gsjax.data.simulated import Light, Primitive, Scene, Texture, bar, simulated_sequence
from gsjax.data.simulated.bent_box import BentBox
from gsjax.data.simulated.motion import rigid
from gsjax.data.simulated.primitives import deformed, intersect, normals
from gsjax.geometry.cameras import intrinsics, look_at

CHECKED = Texture("checker", ((0.9, 0.2, 0.1), (0.1, 0.3, 0.8)), 0.05)
SIZE = (0.05, 0.036, 0.25)
LAMP = (0.8, -0.4, 1.5)
BAR, BASE, BLOCK = 1, 2, 3
seeds = st.integers(0, 10_000)


def bent(seed):
    """Some bent box, and random numbers to go on with."""
    rng = np.random.default_rng(seed)
    half = rng.uniform([0.02, 0.02, 0.15], [0.06, 0.06, 0.30])
    return BentBox(*half, rng.uniform(-2.5, 2.5), rng.uniform(0, 1.5), rng.uniform(-4, 4)), rng


def edges(box):
    return np.array([[box.half_x], [box.half_y], [box.half_z]])


def inside(box, rng, count=200):
    return rng.uniform(-1, 1, (3, count)) * edges(box)


def beyond(box, points):
    """How far points [...,3,n] lie outside of the body, in coordinates at rest; negative inside."""
    rest = np.moveaxis(points, -2, 0)
    return (np.abs(box.undo(rest.reshape(3, -1))) - edges(box)).max(0).reshape(rest.shape[1:])


def on_surface(box, rng, count):
    points = inside(box, rng, count)
    axis = rng.integers(0, 3, count)
    points[axis, np.arange(count)] = (edges(box)[axis, 0]) * rng.choice([-1, 1], count)
    return points


# The map


@given(seeds)
def test_there_and_back(seed):
    box, rng = bent(seed)
    rest = 1.3 * inside(box, rng)
    np.testing.assert_allclose(box.undo(box.deform(rest)), rest, atol=1e-12)


@given(seeds)
def test_no_twist_and_no_bend_is_no_deformation(seed):
    _, rng = bent(seed)
    box = BentBox(*SIZE, 0.0, 0.0, rng.uniform(-4, 4))
    rest = inside(box, rng)
    np.testing.assert_allclose(box.deform(rest), rest, atol=1e-9)
    np.testing.assert_allclose(box.undo(rest), rest, atol=1e-9)


@given(seeds)
def test_a_twist_turns_about_the_axis_evenly(seed):
    box, rng = bent(seed)
    box = BentBox(box.half_x, box.half_y, box.half_z, box.twist, 0.0, box.azimuth)
    rest = inside(box, rng)
    points = box.deform(rest)
    np.testing.assert_allclose(points[2], rest[2], atol=1e-9)
    angles = box.twist * (rest[2] + box.half_z) / (2 * box.half_z)
    turned = Rotation.from_rotvec(angles[:, None] * [0, 0, 1]).apply(rest.T).T
    np.testing.assert_allclose(points[:2], turned[:2], atol=1e-9)


@given(seeds)
def test_a_bend_keeps_the_centre_line_as_long_as_it_was(seed):
    """It is an arc in the plane of the azimuth, upright at the foot, and the top leans by `bend`."""
    box, _ = bent(seed)
    heights = np.linspace(-box.half_z, box.half_z, 2001)
    line = box.deform(np.stack([0 * heights, 0 * heights, heights]))
    pieces = np.diff(line, axis=1)
    lengths = np.linalg.norm(pieces, axis=0)
    np.testing.assert_allclose(lengths, 2 * box.half_z / 2000, rtol=1e-6)
    across = -np.sin(box.azimuth) * line[0] + np.cos(box.azimuth) * line[1]
    np.testing.assert_allclose(across, 0, atol=1e-9)
    np.testing.assert_allclose(line[:, 0], [0, 0, -box.half_z], atol=1e-12)
    lean = np.arccos(pieces[2, [0, -1]] / lengths[[0, -1]])
    np.testing.assert_allclose(lean, [0, box.bend], atol=2e-3)
    towards = np.cos(box.azimuth) * line[0, -1] + np.sin(box.azimuth) * line[1, -1]
    assert towards == pytest.approx((1 - np.cos(box.bend)) * 2 * box.half_z / box.bend, rel=1e-6)


@given(seeds)
def test_cross_sections_stay_rigid_and_the_foot_stays(seed):
    box, rng = bent(seed)
    section = inside(box, rng, 20)
    section[2] = rng.uniform(-1, 1) * box.half_z
    np.testing.assert_allclose(pdist(box.deform(section).T), pdist(section.T), atol=1e-9)
    section[2] = -box.half_z
    np.testing.assert_allclose(box.deform(section), section, atol=1e-9)


def jacobians(box, rest, step=1e-6):
    """dx/dX at points [3,n] by central differences, [n,3,3]."""
    columns = [
        (box.deform(rest + step * e[:, None]) - box.deform(rest - step * e[:, None])) / (2 * step)
        for e in np.eye(3)
    ]
    return np.stack(columns, 1).transpose(2, 0, 1)


@given(seeds)
def test_the_volume_stays(seed):
    box, _ = bent(seed)
    nodes, weights = np.polynomial.legendre.leggauss(6)
    grid = np.stack(np.meshgrid(nodes, nodes, nodes, indexing="ij")).reshape(3, -1)
    shares = np.einsum("i,j,k->ijk", weights, weights, weights).ravel() / 8
    growth = np.linalg.det(jacobians(box, grid * edges(box)))
    assert growth.min() > 0
    assert growth @ shares == pytest.approx(1, abs=1e-8)
    assert growth.max() - growth.min() > 0.3 * min(box.half_x, box.half_y) * box.bend / box.half_z


@given(seeds)
def test_normals_are_perpendicular_to_what_lies_in_the_surface(seed):
    box, rng = bent(seed)
    solid = Primitive("bent box", (*edges(box)[:, 0], box.twist, box.bend, box.azimuth), CHECKED)
    rest = on_surface(box, rng, 60)
    found = normals(solid, box.deform(rest))
    np.testing.assert_allclose(np.linalg.norm(found, axis=0), 1)
    faces = np.abs(np.abs(rest) - edges(box)).argmin(0)
    for tangents, axis, normal, point in zip(jacobians(box, rest), faces, found.T, rest.T, strict=True):
        np.testing.assert_allclose(normal @ np.delete(tangents, axis, 1), 0, atol=1e-8)
        assert normal @ tangents[:, axis] * np.sign(point[axis]) > 0  # outwards


@given(seeds)
def test_directions_go_back_as_points_do(seed):
    box, rng = bent(seed)
    rest, directions = inside(box, rng), rng.normal(size=(3, 200))
    forth = np.einsum("nij,jn->in", jacobians(box, rest), box.undo_directions(rest, directions))
    np.testing.assert_allclose(forth, directions, atol=1e-7)


@given(seeds)
def test_a_ray_that_advances_does_not_enter(seed):
    box, rng = bent(seed)
    points = box.deform(1.5 * inside(box, rng, 400))
    directions = rng.normal(size=(3, 400))
    directions /= np.linalg.norm(directions, axis=0)
    steps = box.advance(points, directions)
    np.testing.assert_array_equal(steps > 0, beyond(box, points) > 0)
    along = np.linspace(0, 1, 50)[:, None, None]
    assert beyond(box, points + along * (steps * directions))[:, steps > 0].min() > -1e-12
    assert (steps > 0.005)[beyond(box, points) > 0.01].mean() > 0.7  # so they are not needlessly short
    assert box.advance(1.5 * directions, directions).min() > 0.1


@given(seeds)
def test_its_extents_hold_it(seed):
    box, rng = bent(seed)
    surface = box.deform(on_surface(box, rng, 2000))
    assert (np.abs(surface) <= box.half_extents[:, None]).all()


@pytest.mark.parametrize(
    ("bend", "says"), [(-0.1, "turn the azimuth"), (3.2, "got 3.2"), (np.nan, "got nan")]
)
def test_bends_that_cannot_be(bend, says):
    with pytest.raises(ValueError, match=f"bend must be from 0 to 3.14 .*{says}"):
        BentBox(*SIZE, 0.0, bend, 0.0)
    with pytest.raises(ValueError, match=r"bend must be from 0 to 1.33 for this box, got 1.5"):
        BentBox(0.12, 0.16, 0.2, 0.0, 1.5, 0.0)


# Rays


@given(seeds)
def test_hits_lie_on_the_surface_and_are_the_first(seed):
    box, rng = bent(seed)
    solid = Primitive("bent box", (*edges(box)[:, 0], box.twist, box.bend, box.azimuth), CHECKED)
    origin = Rotation.random(rng=rng).apply([0, 0, 1.2])
    directions = box.deform(1.5 * inside(box, rng, 150)) - origin[:, None]
    s = intersect(solid, origin, directions)
    hit = np.isfinite(s)
    assert 10 < hit.sum() < 150
    np.testing.assert_allclose(beyond(box, origin[:, None] + (directions * s)[:, hit]), 0, atol=1e-9)
    along = np.linspace(0, 1, 400)[:, None, None]
    end = np.where(hit, s * (1 - 1e-9), 2.0)
    assert beyond(box, origin[:, None] + along * (end * directions)).min() > -1e-9


def test_a_ray_from_inside_meets_nothing():
    solid = Primitive("bent box", (*SIZE, 1.0, 1.0, 0.0), CHECKED)
    middle = deformed(solid, np.zeros((3, 1)))[:, 0]
    assert not np.isfinite(intersect(solid, middle, np.eye(3))).any()


def beside(solid, sizes=None, ball=0.06):
    """Two frames in which `solid` stands on a floor and casts a shadow on it and on a ball of that radius."""
    things = Primitive("plane", (), CHECKED), solid, Primitive("sphere", (ball,), CHECKED, 2)
    poses = np.tile(rigid(None, np.array([[0.0, 0, 0], [0, 0, 0.25], [-0.2, 0.1, 0.06]])), (2, 1, 1, 1))
    scene = Scene(
        primitives=things,
        labels=np.arange(3),
        poses=poses,
        light=Light(LAMP),
        Ks=np.tile(intrinsics(150, 160, 120), (2, 1, 1, 1)),
        viewmats=np.tile(look_at(np.array([0.5, -0.9, 0.8]), np.array([0.0, 0, 0.2])), (2, 1, 1, 1)),
        width=160,
        height=120,
        sizes=sizes or {},
    )
    return simulated_sequence("beside", scene, np.arange(2.0), {"ball": 2})


def test_a_box_that_is_not_deformed_is_drawn_as_a_box():
    box = beside(Primitive("box", SIZE, CHECKED, 1))
    straight = beside(Primitive("bent box", (*SIZE, 0.0, 0.0, 0.4), CHECKED, 1))
    np.testing.assert_array_equal(straight.mask(0, 0), box.mask(0, 0))
    np.testing.assert_allclose(straight.depth(0, 0), box.depth(0, 0), atol=1e-6)
    differ = (straight.image(0, 0) != box.image(0, 0)).any(-1)
    assert (box.mask(0, 0) == 1).sum() > 900
    assert differ.mean() < 1e-3  # a sample of an edge may fall to the other side


def test_sizes_of_frames_take_the_place_of_a_primitives_own():
    straight, twisted = (*SIZE, 0.0, 0.0, 0.0), (*SIZE, 1.0, 0.8, 0.5)
    changing = beside(Primitive("bent box", straight, CHECKED, 1), {1: np.array([straight, twisted])})
    for t, size in enumerate((straight, twisted)):
        own = beside(Primitive("bent box", size, CHECKED, 1))
        np.testing.assert_array_equal(changing.image(t, 0), own.image(t, 0))
        np.testing.assert_array_equal(changing.depth(t, 0), own.depth(t, 0))


def test_what_is_bent_casts_its_shadow():
    """A point of the floor is darker exactly where the line to the lamp passes through the body."""
    box, nothing = BentBox(0.10, 0.05, 0.25, 1.2, 1.0, 2.0), Primitive("sphere", (1e-3,), CHECKED, 1)
    size = (*edges(box)[:, 0], box.twist, box.bend, box.azimuth)
    solid = Primitive("bent box", size, CHECKED, 1)
    sequence, empty = beside(solid, ball=1e-3), beside(nothing, ball=1e-3)
    y, x = np.nonzero(~binary_dilation((sequence.mask(0, 0) > 0) | (empty.mask(0, 0) > 0)))
    camera = np.linalg.inv(empty.viewmats[0, 0])
    rays = camera[:3, :3] @ np.linalg.inv(empty.Ks[0, 0]) @ np.stack([x + 0.5, y + 0.5, np.ones(len(x))])
    middle = np.array([[0.0], [0.0], [box.half_z]])  # of the body's frame
    points = camera[:3, 3:] + rays * empty.depth(0, 0)[y, x] - middle
    way = np.array(LAMP)[:, None] - middle - points
    nearest = np.min([beyond(box, points + share * way) for share in np.linspace(0, 1, 400)], axis=0)
    images = [s.image(0, 0)[y, x].astype(float).mean(-1) for s in (empty, sequence)]
    clear = np.abs(nearest) > 0.012  # away from the shadow's edge
    assert (clear & (nearest < 0)).sum() > 150
    np.testing.assert_array_equal((images[0] - images[1] > 5)[clear], nearest[clear] < 0)


def test_above_the_horizon_there_is_no_floor():
    floor, up = Primitive("plane", (), CHECKED), np.array([[0.0, 1, 1], [1, 1, 1], [0.5, 0, -0.5]])
    np.testing.assert_allclose(intersect(floor, np.array([0.0, 0, 2]), up), [np.inf, np.inf, 4.0])


# The built-in scene


@pytest.fixture(scope="module")
def scene():
    return bar()


def looked_at(sequence, t, c, points):
    """Pixels (x, y) and depths of world points [V,3] before camera c."""
    view, K = sequence.viewmats[t, c], sequence.Ks[t, c]
    local = points @ view[:3, :3].T + view[:3, 3]
    pixels = local @ K.T
    return pixels[:, :2] / pixels[:, 2:], local[:, 2]


def between_pixels(image, pixels):
    return map_coordinates(image.astype(np.float64), (pixels - 0.5).T[::-1], order=1, mode="nearest")


def only_bar_around(sequence, t, c, pixels):
    """Whether no pixel within two of each place shows anything but the bar."""
    other = binary_dilation(sequence.mask(t, c) != BAR, np.ones((5, 5)))
    return between_pixels(other, pixels) == 0


def test_it_is_what_its_description_says(scene):
    assert (scene.num_frames, scene.num_cameras, scene.width, scene.height) == (30, 8, 320, 240)
    np.testing.assert_allclose(np.diff(scene.times), 1 / 15)
    assert scene.truth.names == ("base", "block")
    assert scene.truth.label_ids.tolist() == [BASE, BLOCK]
    assert scene.truth.tracks.shape == (30, 470, 3)
    assert scene.truth.tracks.dtype == np.float64
    base, block = scene.truth.poses[:, 0], scene.truth.poses[:, 1]
    assert (base == base[0]).all()
    assert np.linalg.norm(block[-1, :3, 3] - block[0, :3, 3]) > 0.19
    for c in range(8):
        for t in (0, 29):
            mask = scene.mask(t, c)
            assert (mask == BAR).sum() > 1500
            border = np.concatenate([mask[0], mask[-1], mask[:, 0], mask[:, -1]])
            assert not border.any()  # nothing that moves leaves the picture


@pytest.mark.parametrize("t", [0, 29])
def test_depth_agrees_with_tracks(scene, t):
    """Nothing of the bar is seen behind one of its points, and almost all of them are seen by some camera."""
    seen = np.zeros(scene.truth.tracks.shape[1], bool)
    for c in range(8):
        pixels, depths = looked_at(scene, t, c, scene.truth.tracks[t])
        behind = between_pixels(scene.depth(t, c), pixels) - depths
        inner = only_bar_around(scene, t, c, pixels)
        assert inner.mean() > 0.35
        assert behind[inner].max() < 1e-3
        at = np.abs(behind) < 1e-3
        assert (at & inner).mean() > 0.1
        seen |= at
    assert seen.mean() > (0.99 if t == 0 else 0.8)  # the lower side of the bent bar faces the floor


@pytest.mark.parametrize(("t", "c"), [(10, 1), (16, 4), (20, 6)])
def test_flow_agrees_with_tracks(scene, t, c):
    (now, depths), (then, _) = (looked_at(scene, u, c, scene.truth.tracks[u]) for u in (t, t + 1))
    at = np.abs(between_pixels(scene.depth(t, c), now) - depths) < 5e-4
    at &= only_bar_around(scene, t, c, now)
    assert at.sum() > 50
    flow = np.stack([between_pixels(scene.flow(t, c)[..., i], now) for i in range(2)], 1)
    assert np.linalg.norm((then - now)[at], axis=1).max() > 1
    error = np.linalg.norm(flow - (then - now), axis=1)[at]
    assert np.median(error) < 0.01
    assert error.max() < 0.15


def test_the_pattern_sticks_to_the_bar(scene):
    """Brightness moves with the flow: far better explained by it than by a bar that stays."""
    t, c = 12, 1
    first, second = scene.image(t, c).astype(float).mean(-1), scene.image(t + 1, c).astype(float).mean(-1)
    y, x = np.nonzero((scene.mask(t, c) == BAR) & (scene.mask(t + 1, c) == BAR))
    places = np.stack([x + 0.5, y + 0.5], 1)
    warped = np.abs(between_pixels(second, places + scene.flow(t, c)[y, x]) - first[y, x])
    unmoved = np.abs(second[y, x] - first[y, x])
    assert np.mean(warped) < 0.35 * np.mean(unmoved)


@pytest.mark.parametrize("seed", range(6))
def test_tracks_move_as_far_as_promised(seed):
    tracks = bar(seed, width=8, height=6, cameras=1).truth.tracks
    straight = tracks[0] - [0, 0, 0.31]
    assert np.abs(straight).max(0) == pytest.approx([0.05, 0.036, 0.25], abs=1e-9)
    assert np.linalg.norm(np.diff(tracks, axis=0), axis=-1).max() < 0.03  # metres a frame
    np.testing.assert_array_equal(tracks[28], tracks[29])
    low = straight[:, 2] < -0.24
    assert np.abs(tracks[:, low] - tracks[0, low]).max() < 0.005  # the foot is held
    top = tracks[:, np.isclose(straight[:, 2], 0.25)]
    up = np.cross(top[:, 1] - top[:, 0], top[:, -1] - top[:, 0])
    lean = np.degrees(np.arccos(np.abs(up[:, 2]) / np.linalg.norm(up, axis=1)))
    assert 45 <= lean[-1] <= 70
    assert (np.diff(lean) > -1e-4).all()


def test_seeds_decide_and_fewer_frames_are_the_beginning():
    long, short = bar(2, width=48, height=36), bar(2, frames=8, width=48, height=36)
    np.testing.assert_array_equal(short.truth.tracks, long.truth.tracks[:8])
    np.testing.assert_array_equal(short.truth.poses, long.truth.poses[:8])
    np.testing.assert_array_equal(short.image(7, 3), long.image(7, 3))
    other = bar(3, width=8, height=6)
    assert np.abs(other.truth.tracks[29] - long.truth.tracks[29]).max() > 0.02
    np.testing.assert_allclose(other.truth.tracks[0], long.truth.tracks[0], atol=1e-9)


def test_still_is_still_and_selections_keep_their_tracks():
    still = bar(frames=6, width=48, height=36, still=True)
    np.testing.assert_array_equal(still.image(5, 0), still.image(0, 0))
    np.testing.assert_allclose(still.flow(4, 0), 0, atol=1e-6)
    np.testing.assert_array_equal(still.truth.tracks[5], still.truth.tracks[0])
    some = bar(frames=9, width=8, height=6, cameras=1).select(slice(2, 9, 3))
    np.testing.assert_array_equal(some.truth.tracks, bar(frames=9).truth.tracks[[2, 5, 8]])


def test_it_is_opened_by_name():
    sequence = open_sequence("simulated:bar?seed=1&frames=2&width=16&height=12&cameras=4&still=true")
    assert (sequence.name, sequence.num_frames, sequence.num_cameras) == ("bar_seed1", 2, 4)
    assert open_sequence("simulated:bar").num_frames == 30


@pytest.mark.parametrize("name", ["frames", "width", "height", "cameras"])
def test_counts_must_be_positive(name):
    with pytest.raises(ValueError, match=f"{name} must be at least 1, got 0"):
        bar(**{name: 0})


@pytest.mark.parametrize("shape", [(2, 5, 3), (3, 5, 2), (3, 5), (3,)])
def test_tracks_that_do_not_fit_their_poses(shape):
    poses = np.tile(np.eye(4), (3, 0, 1, 1))
    Truth((), np.zeros(0, int), poses, tracks=np.zeros((3, 5, 3)))
    with pytest.raises(ValueError, match=r"tracks must have shape \(3, "):
        Truth((), np.zeros(0, int), poses, tracks=np.zeros(shape))


def test_a_frame_is_drawn_fast(scene):
    scene.image(29, 0)  # the noise is made once
    durations = []
    for c in range(1, 4):
        start = time.thread_time()
        scene.image(29, c), scene.depth(29, c), scene.mask(29, c)
        durations.append(time.thread_time() - start)
    assert min(durations) < 1.5  # it is 0.3 s without the checks of annotations
