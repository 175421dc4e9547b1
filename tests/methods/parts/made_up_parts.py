"""Synthetic scenes of parts and trajectories for which the results of edits are known."""

import jax
import jax.numpy as jnp
import numpy as np
from scipy.spatial.transform import Rotation

from gsjax.geometry.joints import Joint
from gsjax.methods.parts.trajectory import Moment, PartScene, Trajectory, trajectory_of
from gsjax.scene.gaussians import Gaussians
from gsjax.scene.handles import HandlePose

STEP = 0.125  # seconds between moments; exact in binary, so that moments can be hit to the bit
TIMES = STEP * np.arange(9.0)  # 0 to 1 s
CENTERS = np.array([[0.0, 0.0, 0.0], [0.4, 0.1, 0.2], [-0.5, 0.3, 0.0]])
"""Centres of the handles of a background, a lid and a drawer."""


def floats(values):
    """Values on the device, in JAX's current default floating type; NumPy does the conversion."""
    return jax.device_put(np.asarray(values, jnp.result_type(float)))


def scene_of(seed, num=7, parts=3):
    """A random scene with soft weights."""
    rng = np.random.default_rng(seed)
    shapes = ((num, 3), (num, 4), (num, 3), (num,), (num, 1, 3))
    gaussians = Gaussians(*(floats(rng.normal(size=shape)) for shape in shapes))
    weights = floats(rng.dirichlet(np.ones(parts), num))
    return PartScene(gaussians, weights, floats(rng.normal(size=(parts, 3))))


def whole(scene, part):
    """The scene with all Gaussians assigned to one part."""
    weights = floats(np.tile(np.arange(scene.weights.shape[1]) == part, (len(scene.weights), 1)))
    return PartScene(scene.gaussians, weights, scene.centers)


def moment_of(seed, parts=3):
    """A random moment, in which every part has moved and changed its opacity and size."""
    rng = np.random.default_rng(seed)
    pose = HandlePose(floats(rng.normal(size=(parts, 4))), floats(rng.normal(size=(parts, 3))))
    opacities, scales = rng.uniform(0.1, 0.9, parts), rng.uniform(0.5, 2.0, parts)
    return Moment(pose, floats(opacities), floats(scales))


def trajectory(seed, moments=9, parts=4):
    """Random motions of parts, by at most half a radian and 20 cm between moments."""
    rng = np.random.default_rng(seed)
    steps = Rotation.from_rotvec(rng.uniform(-0.25, 0.25, (moments * parts, 3)))
    turns = np.empty((moments, parts, 4))
    now = [Rotation.random(rng=rng) for _ in range(parts)]
    for t in range(moments):
        now = [steps[t * parts + p] * now[p] for p in range(parts)]
        turns[t] = [turn.as_quat(scalar_first=True) for turn in now]
    shifts = np.cumsum(rng.uniform(-0.1, 0.1, (moments, parts, 3)), axis=0)
    opacities, scales = rng.uniform(0.1, 0.9, (moments, parts)), rng.uniform(0.5, 2.0, (moments, parts))
    poses = HandlePose(floats(turns), floats(shifts))
    return Trajectory(floats(STEP * np.arange(moments)), poses, floats(opacities), floats(scales))


def hinge(angles, axis=(0.0, 0.0, 1.0), point=(0.0, 0.0, 0.0)):
    return Joint("revolute", np.array(axis), np.array(point), np.asarray(angles, float))


def jointed(joints, centers, times):
    """The trajectory of handles at `centers` whose parts move by the given joints."""
    motions = np.stack([joint.motions() for joint in joints], axis=1)
    turns = Rotation.from_matrix(motions[..., :3, :3].reshape(-1, 3, 3)).as_quat(scalar_first=True)
    shifts = np.einsum("tpij,pj->tpi", motions[..., :3, :3], centers) + motions[..., :3, 3] - centers
    poses = HandlePose(floats(turns.reshape(*motions.shape[:2], 4)), floats(shifts))
    return trajectory_of(floats(times), poses)


def motions(trajectory, centers, part):
    """World-space transforms of a part at each moment, [T, 4, 4]."""
    quats = np.asarray(trajectory.poses.quats[:, part])
    turns = Rotation.from_quat(quats, scalar_first=True).as_matrix()
    found = np.tile(np.eye(4), (len(quats), 1, 1))
    found[:, :3, :3] = turns
    found[:, :3, 3] = trajectory.poses.translations[:, part] + centers[part] - turns @ centers[part]
    return found


def rows(trajectory, parts, indices):
    """Poses, opacities and scales of parts at the given moments, as a list of arrays."""
    chosen = (np.asarray(indices)[:, None], np.asarray(parts))
    leaves = (trajectory.poses, trajectory.opacities, trajectory.scales)
    return [np.asarray(leaf)[chosen] for leaf in jax.tree.leaves(leaves)]


def assert_same(found, expected, atol=0.0):
    """Asserts that two lists of arrays or trees are equal, to the bit unless a tolerance is given."""
    if atol:
        jax.tree.map(lambda a, b: np.testing.assert_allclose(a, b, atol=atol), found, expected)
    else:
        jax.tree.map(np.testing.assert_array_equal, found, expected)
