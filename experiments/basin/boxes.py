"""Two cartons on a table, alike but for their print: one has a label, the other is plain."""

import numpy as np

from gsjax.data import Sequence
from gsjax.data.simulated.motion import rigid, turn
from gsjax.data.simulated.primitives import Primitive
from gsjax.data.simulated.raycaster import Light, Scene
from gsjax.data.simulated.simulation import simulated_sequence
from gsjax.data.simulated.textures import Texture
from gsjax.geometry.cameras import intrinsics, look_at

OBJECTS = ("textured", "plain")
HALF = (0.0225, 0.014, 0.0325)  # a small carton's, metres
STARTS = ((0.0, -0.16, HALF[2]), (0.0, 0.16, HALF[2]))
SHIFT, TURN = (0.004, 0.003, 0.0), 0.05  # from the first frame to the next, metres and radians
WIDTH, HEIGHT, DISTANCE, FOCAL = 240, 180, 0.9, 0.95
PIXELS_PER_MM = 1e-3 * FOCAL * WIDTH / DISTANCE


def boxes() -> Sequence:
    """Two frames of three RGB-D cameras, with labels and true poses."""
    yaws, shares = np.array([[0.4], [-0.3]]), np.array([0.0, 1.0])
    centers = np.array(STARTS)[:, None] + shares[:, None] * np.array(SHIFT)
    poses = rigid(turn((0.0, 0.0, 1.0), (yaws + shares * TURN).ravel()), centers.reshape(-1, 3))
    poses = np.moveaxis(poses.reshape(2, 2, 4, 4), 1, 0)
    world = np.broadcast_to(np.eye(4), (2, 1, 4, 4))
    red, cream = (0.86, 0.24, 0.16), (0.97, 0.91, 0.72)
    prints = (Texture("label", (red, cream), 0.04, seed=4), Texture("noise", (red, red), 0.1, grain=0.0))
    wood = Texture("stripes", ((0.60, 0.43, 0.28), (0.72, 0.55, 0.38)), 0.035, seed=2, grain=0.18)
    table = Primitive("box", (0.62, 0.55, 0.02), wood, pose=rigid(None, [0.0, 0.0, -0.02]))
    azimuths, elevation = np.deg2rad([-55, 0, 55]), np.deg2rad(40)
    target = np.array([0.0, 0.0, 0.03])
    away = np.stack([np.cos(azimuths) * np.cos(elevation), np.sin(azimuths) * np.cos(elevation)], axis=1)
    eyes = target + DISTANCE * np.concatenate([away, np.full((3, 1), np.sin(elevation))], axis=1)
    viewmats = np.stack([look_at(eye, target) for eye in eyes])
    K = intrinsics(FOCAL * WIDTH, WIDTH, HEIGHT)
    scene = Scene(
        primitives=(table, *(Primitive("box", HALF, prints[i], 1 + i) for i in range(2))),
        labels=np.array([0, 1, 2]),
        poses=np.concatenate([world, poses], axis=1),
        light=Light(position=(0.55, -0.75, 1.35), radius=0.02),
        Ks=np.broadcast_to(K, (2, 3, 3, 3)),
        viewmats=np.broadcast_to(viewmats, (2, 3, 4, 4)),
        width=WIDTH,
        height=HEIGHT,
    )
    return simulated_sequence(
        "boxes", scene, np.arange(2) / 30.0, {name: 1 + i for i, name in enumerate(OBJECTS)}
    )
