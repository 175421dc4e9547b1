"""A box that twists and bends: properties of its map, and ray intersections."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.ndimage import binary_dilation
from scipy.spatial.distance import pdist
from scipy.spatial.transform import Rotation

from gsjax.data.simulated import Light, Primitive, Scene, Texture, simulated_sequence
from gsjax.data.simulated.bent_box import BentBox
from gsjax.data.simulated.motion import rigid
from gsjax.data.simulated.primitives import deformed, intersect, normals
from gsjax.geometry.cameras import intrinsics, look_at

CHECKED = Texture("checker", ((0.9, 0.2, 0.1), (0.1, 0.3, 0.8)), 0.05)
SIZE = (0.05, 0.036, 0.25)
LAMP = (0.8, -0.4, 1.5)
seeds = st.integers(0, 10_000)


def bent(seed):
    """A random bent box, and the random generator."""
    rng = np.random.default_rng(seed)
    half = rng.uniform([0.02, 0.02, 0.15], [0.06, 0.06, 0.30])
    return BentBox(*half, rng.uniform(-2.5, 2.5), rng.uniform(0, 1.5), rng.uniform(-4, 4)), rng


def edges(box):
    return np.array([[box.half_x], [box.half_y], [box.half_z]])


def inside(box, rng, count=200):
    return rng.uniform(-1, 1, (3, count)) * edges(box)


def beyond(box, points):
    """Distance of points [...,3,n] outside the body, in rest coordinates; negative inside."""
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
def test_normals_are_perpendicular_to_the_surface(seed):
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
    assert (steps > 0.005)[beyond(box, points) > 0.01].mean() > 0.7  # the steps are not needlessly short
    assert box.advance(1.5 * directions, directions).min() > 0.1


@given(seeds)
def test_its_extents_hold_it(seed):
    box, rng = bent(seed)
    surface = box.deform(on_surface(box, rng, 2000))
    assert (np.abs(surface) <= box.half_extents[:, None]).all()


@pytest.mark.parametrize(
    ("bend", "says"), [(-0.1, "rotate the azimuth"), (3.2, "got 3.2"), (np.nan, "got nan")]
)
def test_impossible_bends_are_refused(bend, says):
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
    """Two frames of `solid` on a floor beside a ball of radius `ball`; it can cast shadows on both."""
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
    assert differ.mean() < 1e-3  # a sample at an edge may fall on the other side


def test_sizes_per_frame_replace_the_size_of_the_primitive():
    straight, twisted = (*SIZE, 0.0, 0.0, 0.0), (*SIZE, 1.0, 0.8, 0.5)
    changing = beside(Primitive("bent box", straight, CHECKED, 1), {1: np.array([straight, twisted])})
    for t, size in enumerate((straight, twisted)):
        own = beside(Primitive("bent box", size, CHECKED, 1))
        np.testing.assert_array_equal(changing.image(t, 0), own.image(t, 0))
        np.testing.assert_array_equal(changing.depth(t, 0), own.depth(t, 0))


def test_a_bent_box_casts_its_shadow():
    """A point of the floor is darker exactly where the line to the lamp passes through the body."""
    box, nothing = BentBox(0.10, 0.05, 0.25, 1.2, 1.0, 2.0), Primitive("sphere", (1e-3,), CHECKED, 1)
    size = (*edges(box)[:, 0], box.twist, box.bend, box.azimuth)
    solid = Primitive("bent box", size, CHECKED, 1)
    sequence, empty = beside(solid, ball=1e-3), beside(nothing, ball=1e-3)
    y, x = np.nonzero(~binary_dilation((sequence.mask(0, 0) > 0) | (empty.mask(0, 0) > 0)))
    camera = np.linalg.inv(empty.viewmats[0, 0])
    rays = camera[:3, :3] @ np.linalg.inv(empty.Ks[0, 0]) @ np.stack([x + 0.5, y + 0.5, np.ones(len(x))])
    middle = np.array([[0.0], [0.0], [box.half_z]])  # origin of the body's frame
    points = camera[:3, 3:] + rays * empty.depth(0, 0)[y, x] - middle
    to_lamp = np.array(LAMP)[:, None] - middle - points
    nearest = np.min([beyond(box, points + share * to_lamp) for share in np.linspace(0, 1, 400)], axis=0)
    images = [s.image(0, 0)[y, x].astype(float).mean(-1) for s in (empty, sequence)]
    clear = np.abs(nearest) > 0.012  # away from the shadow's edge
    assert (clear & (nearest < 0)).sum() > 150
    np.testing.assert_array_equal((images[0] - images[1] > 5)[clear], nearest[clear] < 0)


def test_above_the_horizon_there_is_no_floor():
    floor, up = Primitive("plane", (), CHECKED), np.array([[0.0, 1, 1], [1, 1, 1], [0.5, 0, -0.5]])
    np.testing.assert_allclose(intersect(floor, np.array([0.0, 0, 2]), up), [np.inf, np.inf, 4.0])
