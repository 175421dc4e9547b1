"""A Panda arm in MuJoCo and three RGB-D cameras around it: what experiments with a robot share.

The models are robosuite's. Its controllers run in Python at every step of the physics; here MuJoCo's own
position servos hold the joints, and inverse kinematics sets their targets once a control step, which is
faster. Without a display, set MUJOCO_GL=egl before starting Python.
"""

from collections.abc import Iterator

import jax.numpy as jnp
import mujoco
import numpy as np
from scipy.spatial.transform import Rotation

from gsjax.geometry.cameras import Camera, intrinsics, look_at
from gsjax.methods.track import StartConfig, TrackedScene
from gsjax.methods.track.scene import assemble, labelled_cloud
from gsjax.scene.frame import Frame
from gsjax.scene.initialize import gaussians_from_points

ARM, TOOL = "robot0_joint", "gripper0_right_grip_site"
ROBOT = ("robot0", "gripper0", "fixed_mount0")
STIFFNESS, DAMPING = 1500.0, 120.0  # of the joints' servos, N m / rad and N m s / rad
LAG = DAMPING / STIFFNESS  # delay of the arm behind its commands, seconds
CLOSED, OPEN = 0.0, 0.04  # each finger from the middle, metres
RANGE = 1.9  # of the depth cameras, metres; beyond it they see nothing
SITE_TO_TOOL = np.array([[0.0, 1.0, 0.0], [-1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])  # the site closes along its x
_SHOWN, _HIDDEN = 1, 5  # groups of geoms


class Arm:
    """Drives the tool of a robosuite Panda to poses; tool axes are those of `gsjax.methods.grasping`."""

    def __init__(self, model: mujoco.MjModel, data: mujoco.MjData, period: float):
        """`period` is the time between commands, seconds."""
        self.model, self.data = model, data
        self.steps = round(period / model.opt.timestep)
        joints = [model.joint(f"{ARM}{i}") for i in range(1, 8)]
        self.qpos = np.array([joint.qposadr[0] for joint in joints])
        self.dofs = np.array([joint.dofadr[0] for joint in joints])
        self.limits = np.stack([joint.range for joint in joints], axis=1)
        self.site = model.site(TOOL).id
        driven = list(model.actuator_trnid[:, 0])
        self.motors = np.array([driven.index(joint.id) for joint in joints])
        model.actuator_gainprm[self.motors, 0] = STIFFNESS
        model.actuator_biastype[self.motors] = mujoco.mjtBias.mjBIAS_AFFINE
        model.actuator_biasprm[self.motors, :3] = 0.0, -STIFFNESS, -DAMPING
        model.actuator_ctrllimited[self.motors] = 0
        names = [model.actuator(i).name for i in range(model.nu)]
        self.fingers = [next(i for i, n in enumerate(names) if f"finger_joint{k}" in n) for k in (1, 2)]
        self.rest = data.qpos[self.qpos].copy()

    def pose(self) -> np.ndarray:
        """Tool to world [4, 4]."""
        pose = np.eye(4)
        pose[:3, :3] = self.data.site_xmat[self.site].reshape(3, 3) @ SITE_TO_TOOL
        pose[:3, 3] = self.data.site_xpos[self.site]
        return pose

    def opening(self) -> float:
        """Between the fingers, metres."""
        fingers = [self.model.actuator(i).trnid[0] for i in self.fingers]
        first, second = (self.data.qpos[self.model.jnt_qposadr[joint]] for joint in fingers)
        return float(first - second)

    def place(self, pose: np.ndarray) -> None:
        """Put the tool at `pose` without physics: where a trial begins."""
        self.data.qpos[self.qpos] = self.rest
        for _ in range(200):
            mujoco.mj_forward(self.model, self.data)
            self.data.qpos[self.qpos] = self._joints_for(pose)
        self.data.qvel[:] = 0
        self.data.ctrl[self.motors] = self.data.qpos[self.qpos]
        self.grip(OPEN)
        mujoco.mj_forward(self.model, self.data)

    def servo(self, pose: np.ndarray, finger: float) -> None:
        """One control period towards `pose`, with each finger commanded to `finger` metres from the
        middle."""
        weight = self.data.qfrc_bias[self.dofs] / STIFFNESS  # the arm carries itself, as a Panda does
        self.data.ctrl[self.motors] = self._joints_for(pose) + weight
        self.grip(finger)
        mujoco.mj_step(self.model, self.data, nstep=self.steps)

    def grip(self, finger: float) -> None:
        self.data.ctrl[self.fingers] = finger, -finger

    def _joints_for(self, pose: np.ndarray, damping: float = 0.02, rest: float = 0.05) -> np.ndarray:
        """Joints after one step of damped least squares towards the tool pose; the null space returns to
        rest."""
        here, q = self.pose(), self.data.qpos[self.qpos]
        turn = Rotation.from_matrix(pose[:3, :3] @ here[:3, :3].T).as_rotvec()
        twist = np.concatenate([pose[:3, 3] - here[:3, 3], turn])
        linear, angular = np.zeros((3, self.model.nv)), np.zeros((3, self.model.nv))
        mujoco.mj_jacSite(self.model, self.data, linear, angular, self.site)
        jacobian = np.concatenate([linear, angular])[:, self.dofs]
        inverse = jacobian.T @ np.linalg.inv(jacobian @ jacobian.T + damping**2 * np.eye(6))
        free = np.eye(7) - np.linalg.pinv(jacobian, rcond=1e-3) @ jacobian
        return np.clip(q + inverse @ twist + free @ (rest * (self.rest - q)), *self.limits)


class Cameras:
    """Static RGB-D cameras. They see the robot as its collision meshes, which are far coarser."""

    def __init__(self, model: mujoco.MjModel, views: list[tuple], width: int, height: int, fovy: float):
        """`views` are (eye, target), world, metres; the model needs as many cameras, which are replaced."""
        self.model, self.views = model, views
        for i, view in enumerate(views):
            viewmat = look_at(*map(np.array, view))
            quat = np.zeros(4)
            mujoco.mju_mat2Quat(quat, (viewmat[:3, :3].T @ np.diag([1.0, -1.0, -1.0])).ravel())
            model.cam_bodyid[i], model.cam_mode[i], model.cam_fovy[i] = 0, 0, fovy
            model.cam_pos[i], model.cam_quat[i] = view[0], quat
        _dress(model)
        focal = 0.5 * height / np.tan(np.deg2rad(fovy) / 2)
        viewmats = np.stack([look_at(*map(np.array, view)) for view in views])
        Ks = np.tile(intrinsics(focal, width, height), (len(views), 1, 1))
        as_float = [jnp.asarray(a, jnp.float32) for a in (viewmats, Ks)]
        self.cameras = Camera(*as_float, width=width, height=height)
        self.renderer = mujoco.Renderer(model, height, width)
        self.renderer.scene.flags[mujoco.mjtRndFlag.mjRND_SHADOW] = 0
        self.renderer.scene.flags[mujoco.mjtRndFlag.mjRND_REFLECTION] = 0
        self.option = mujoco.MjvOption()
        self.option.geomgroup[:] = 0
        self.option.geomgroup[_SHOWN] = 1
        self.option.sitegroup[:] = 0
        names = [model.body(body).name for body in model.geom_bodyid]
        self.is_robot = np.array([name.startswith(ROBOT) for name in names] + [False])

    def images(self, data: mujoco.MjData) -> tuple[np.ndarray, np.ndarray]:
        """RGB [C, H, W, 3] of 8 bits and depth [C, H, W] in metres, 0 where it is unknown.

        Depth is unknown out of range and on the robot, which knows its joints and shape and so the pixels
        that it covers: this filter keeps it from being mistaken for the object that it grasps.
        """
        colors, depths = [], []
        for camera in range(len(self.views)):
            self.renderer.update_scene(data, camera, self.option)
            colors.append(self.renderer.render().copy())
            self.renderer.enable_depth_rendering()
            depth = self.renderer.render().copy()
            self.renderer.disable_depth_rendering()
            robot = self.is_robot[self._geoms(data, camera)]
            depths.append(np.where((depth < RANGE) & ~robot, depth, 0.0).astype(np.float32))
        return np.stack(colors), np.stack(depths)

    def _geoms(self, data: mujoco.MjData, camera: int) -> np.ndarray:
        """Index of the geom that each pixel shows; the number of geoms where there is none."""
        self.renderer.enable_segmentation_rendering()
        self.renderer.update_scene(data, camera, self.option)
        found = self.renderer.render()
        self.renderer.disable_segmentation_rendering()
        is_geom = found[..., 1] == mujoco.mjtObj.mjOBJ_GEOM
        return np.where(is_geom, found[..., 0], self.model.ngeom)

    def frame(self, data: mujoco.MjData) -> Frame:
        return as_frame(*self.images(data), self.cameras)

    def mask(self, data: mujoco.MjData, camera: int, bodies: list[str]) -> np.ndarray:
        """Labels [H, W] of one camera: 1.. the bodies in order, 0 everything else. A stand-in for a
        segmenter."""
        names = [self.model.body(body).name for body in self.model.geom_bodyid]
        table = np.array([bodies.index(name) + 1 if name in bodies else 0 for name in names] + [0])
        return table[self._geoms(data, camera)]


def as_frame(colors: np.ndarray, depths: np.ndarray, cameras: Camera) -> Frame:
    images = jnp.asarray(colors.astype(np.float32) / 255)
    return Frame(images, jnp.asarray(depths), cameras)


def _dress(model: mujoco.MjModel) -> None:
    """Show robots as white collision meshes and everything else unchanged; hide the markers of goals."""
    model.vis.quality.offsamples = 0
    for geom in range(model.ngeom):
        name = model.body(model.geom_bodyid[geom]).name
        if name.startswith(ROBOT):
            solid = model.geom_contype[geom] or model.geom_conaffinity[geom]
            model.geom_group[geom] = _SHOWN if solid else _HIDDEN
            model.geom_rgba[geom] = 0.9, 0.9, 0.92, 1.0
            model.geom_matid[geom] = -1
        elif name.startswith("Visual"):
            model.geom_group[geom] = _HIDDEN


def body_pose(data: mujoco.MjData, name: str) -> np.ndarray:
    """Body to world [4, 4]."""
    pose = np.eye(4)
    pose[:3, :3], pose[:3, 3] = data.body(name).xmat.reshape(3, 3), data.body(name).xpos
    return pose


def set_body(model: mujoco.MjModel, data: mujoco.MjData, name: str, position, yaw: float) -> None:
    """Place a free body, at rest."""
    joint = model.body(name).jntadr[0]
    at = model.jnt_qposadr[joint]
    quat = Rotation.from_euler("z", yaw).as_quat(scalar_first=True)
    data.qpos[at : at + 7] = *position, *quat
    data.qvel[model.jnt_dofadr[joint] :][:6] = 0


def start(
    frame: Frame, mask: np.ndarray, mask_camera: int, config: StartConfig, per_object: int, background: int
) -> TrackedScene:
    """Like `gsjax.start_scene`, with the pixels' own colours and the same number of Gaussians in every scene.

    Arrays of the same shapes let one compiled program serve all trials. Where an object shows fewer points,
    some are repeated.

    Raises:
        ValueError: an object of the mask, or the background, has no points.
    """
    cloud = labelled_cloud(frame, mask, mask_camera, config)
    rng, parts, labels, towards = np.random.default_rng(0), [], [], []
    values = [int(value) for value in np.unique(mask) if value]
    for label, value in enumerate([*values, 0], 1):
        rows = rng.permutation(np.flatnonzero(cloud.labels == value))
        if len(rows) == 0:
            raise ValueError(f"start: nothing is labelled {value}; the mask has {values}")
        rows = np.resize(rows, per_object if value else background)
        parts.append(gaussians_from_points(cloud.points[rows], cloud.colors[rows], normals="pca"))
        labels.append(np.full(len(rows), label if value else 0))
        towards.append(cloud.eyes[rows] - cloud.points[rows])
    return assemble(parts, labels, (0, *values), towards)


def fed(box: list[Frame]) -> Iterator[Frame]:
    """Frames for `gsjax.track`, taken from `box`, which must hold one whenever the next is requested."""
    while True:
        yield box.pop()


def motion_between(first: np.ndarray, now: np.ndarray) -> np.ndarray:
    """The rigid motion [4, 4] that best takes the points `first` [N, 3] to `now` (Kabsch 1976)."""
    middles = first.mean(0), now.mean(0)
    u, _, vt = np.linalg.svd((now - middles[1]).T @ (first - middles[0]))
    flip = np.diag([1.0, 1.0, np.linalg.det(u @ vt)])
    motion = np.eye(4)
    motion[:3, :3] = u @ flip @ vt
    motion[:3, 3] = middles[1] - motion[:3, :3] @ middles[0]
    return motion
