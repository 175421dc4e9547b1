"""Known shapes are located on their plane and coloured, which initializes a scene without depth."""

from dataclasses import dataclass, replace

import equinox as eqx
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from gsjax.geometry.cameras import Camera, intrinsics, look_at
from gsjax.methods.track import StartConfig, TrackConfig, scene_from_shapes, start_scene
from gsjax.methods.track.shapes import Shape, find_pose
from gsjax.scene.frame import Frame
from gsjax.scene.gaussians import concatenate, gaussians_from_activated
from gsjax.scene.render import plan_render, render

TRUE_POSE = np.eye(4)
TRUE_POSE[:3, :3] = Rotation.from_euler("z", 40, degrees=True).as_matrix()
TRUE_POSE[:3, 3] = [0.07, -0.04, 0.0]


@dataclass
class Model:
    name: str
    means: np.ndarray
    colors: np.ndarray
    label: int
    pose: np.ndarray | None = None
    plane: np.ndarray | None = None
    size: float = 0.006

    @property
    def quats(self):
        return np.tile([1.0, 0, 0, 0], (len(self.means), 1))

    @property
    def scales(self):
        return np.full((len(self.means), 3), self.size)

    @property
    def opacities(self):
        return np.full(len(self.means), 0.9)


def block(**fields) -> Model:
    """An orange L of 12 x 8 x 2 cm, without rotational symmetry."""
    x, y, z = np.meshgrid(np.arange(0, 0.12, 0.01), np.arange(0, 0.08, 0.01), [0.005, 0.015])
    means = np.stack([x, y, z], -1).reshape(-1, 3)
    means = means[(means[:, 0] < 0.035) | (means[:, 1] < 0.035)] - [0.04, 0.03, 0.0]
    return Model("block", means, np.tile([0.9, 0.4, 0.1], (len(means), 1)), 1, **fields)


def ground(**fields) -> Model:
    x, y = np.meshgrid(np.arange(-0.25, 0.25, 0.01), np.arange(-0.25, 0.25, 0.01))
    means = np.stack([x, y, np.zeros_like(x)], -1).reshape(-1, 3)
    return Model("ground", means, np.tile([0.3, 0.5, 0.6], (len(means), 1)), 0, np.eye(4), **fields)


@pytest.fixture(scope="module")
def frame() -> Frame:
    """The block at its true pose on the ground, rendered for two cameras."""
    parts = []
    for model, pose in ((block(), TRUE_POSE), (ground(), np.eye(4))):
        means = model.means @ pose[:3, :3].T + pose[:3, 3]
        parts.append(
            gaussians_from_activated(means, model.quats, model.scales, model.opacities, model.colors)
        )
    eyes = np.array([[0.4, -0.4, 0.5], [-0.45, -0.3, 0.5]])
    cameras = Camera(
        jnp.asarray(np.stack([look_at(eye, np.zeros(3)) for eye in eyes]), jnp.float32),
        jnp.asarray(np.stack([intrinsics(150.0, 128, 96)] * 2), jnp.float32),
        128,
        96,
    )
    scene = concatenate(parts)
    drawn = render(scene, cameras, plan_render(scene, cameras))
    return Frame(images=drawn.colors, depths=None, cameras=cameras)


def miss(pose: np.ndarray) -> tuple[float, float]:
    """(mean distance of the block's points from the truth, metres; rotation error, degrees)."""
    means = block().means
    there, truth = (means @ p[:3, :3].T + p[:3, 3] for p in (pose, TRUE_POSE))
    turn = Rotation.from_matrix(TRUE_POSE[:3, :3].T @ pose[:3, :3]).magnitude()
    return float(np.linalg.norm(there - truth, axis=1).mean()), float(np.degrees(turn))


@pytest.mark.thorough
def test_a_pose_is_found_on_the_plane(frame):
    pose = find_pose(block(plane=np.array([0, 0, 2.0, 0.0])), frame, ground().means)
    distance, turn = miss(pose)
    assert distance < 12e-3  # points inside the block's outline cost nothing; refinement by rendering follows
    assert turn < 6


@pytest.mark.thorough
def test_the_plane_may_lie_any_way_in_the_world(frame):
    """The same in a rotated world, whose ground is steep and slanted."""
    world = np.eye(4)
    world[:3, :3] = Rotation.from_euler("yx", [80, 25], degrees=True).as_matrix()
    cameras = eqx.tree_at(
        lambda c: c.viewmat, frame.cameras, frame.cameras.viewmat @ jnp.asarray(world.T, jnp.float32)
    )
    turned = Frame(frame.images, None, cameras)
    model = block(plane=np.array([*world[:3, 2], 0.0]))
    pose = find_pose(model, turned, ground().means @ world[:3, :3].T)
    distance, _ = miss(world.T @ pose)
    assert distance < 12e-3


@pytest.mark.slow
def test_a_scene_from_shapes_is_posed_coloured_and_labelled(frame):
    shapes = [ground(), block(plane=np.array([0, 0, 1.0, 0.0]))]
    assert all(isinstance(shape, Shape) for shape in shapes)
    shapes[1].colors = shapes[1].colors * 0.8  # the images correct that
    scene = scene_from_shapes(shapes, frame)
    assert scene.label_ids == (0, 1)
    assert scene.num_moving == len(block().means)
    truth = block().means @ TRUE_POSE[:3, :3].T + TRUE_POSE[:3, 3]
    error = np.linalg.norm(np.asarray(scene.gaussians.means[: scene.num_moving]) - truth, axis=1)
    assert error.mean() < 3e-3
    drawn = render(scene.gaussians, frame.cameras, plan_render(scene.gaussians, frame.cameras))
    assert float(jnp.abs(drawn.colors - frame.images).mean()) < 0.03


@pytest.mark.thorough
def test_a_shape_with_nothing_to_rest_on_is_told(frame):
    with pytest.raises(ValueError, match="'block': expected a pose"):
        scene_from_shapes([ground(), block()], frame)
    with pytest.raises(ValueError, match="'block': expected a pose"):
        scene_from_shapes([block(plane=np.array([0, 0, 1.0, 0]))], frame)


def test_what_cannot_be_placed_is_told(frame):
    standing = {"plane": np.array([0, 0, 1.0, 0])}
    with pytest.raises(ValueError, match="shapes: expected an object, a shape with a label above 0"):
        scene_from_shapes([], frame)
    with pytest.raises(ValueError, match="expected a pose of each shape of label 0"):
        scene_from_shapes([replace(ground(), pose=None), block(**standing)], frame)
    bent = eqx.tree_at(
        lambda f: f.cameras.fisheye, frame, jnp.zeros((2, 4)), is_leaf=lambda leaf: leaf is None
    )
    with pytest.raises(ValueError, match="cameras: expected pinholes, found fisheyes"):
        scene_from_shapes([ground(), block(**standing)], bent)
    with pytest.raises(ValueError, match="cameras: expected pinholes, found fisheyes"):
        start_scene(bent, np.ones((96, 128), np.int32), 0)


@pytest.mark.thorough
def test_a_background_of_one_gaussian_is_a_place(frame):
    pose = find_pose(block(plane=np.array([0, 0, 1.0, 0])), frame, np.zeros((1, 3)))
    assert np.isfinite(pose).all()


@pytest.mark.thorough
def test_pictures_in_bytes_are_pictures(frame):
    shapes = [ground(), replace(block(), pose=TRUE_POSE)]
    config = TrackConfig(start=StartConfig(iterations=0))
    images = np.round(np.clip(np.asarray(frame.images), 0, 1) * 255).astype(np.uint8)
    in_bytes = replace(frame, images=images)
    scenes = [scene_from_shapes(shapes, one, config).gaussians.sh0 for one in (frame, in_bytes)]
    np.testing.assert_allclose(*scenes, atol=0.01)
