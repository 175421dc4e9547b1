"""A belt with groceries in front of a Panda."""

from dataclasses import dataclass

import mujoco
import numpy as np
from robosuite.models.arenas import TableArena
from robosuite.models.bases import robot_base_factory
from robosuite.models.grippers import gripper_factory
from robosuite.models.objects import BreadObject, CanObject, CerealObject, MilkObject
from robosuite.models.robots import Panda
from robosuite.models.tasks import ManipulationTask

from experiments.shared.panda import Arm, Cameras, body_pose, set_body

OBJECTS = {"can": CanObject, "milk": MilkObject, "bread": BreadObject, "cereal": CerealObject}
VIEWS = [
    ((0.75, -0.65, 1.45), (0, 0, 0.85)),
    ((0.75, 0.65, 1.45), (0, 0, 0.85)),
    ((-0.1, -1.0, 1.5), (0, 0, 0.85)),
]
HOME = np.array([[-1, 0, 0, -0.2], [0, 1, 0, 0], [0, 0, -1, 1.2], [0, 0, 0, 1]], float)
TOP = 0.84  # of the belt, metres
PERIOD = 0.034  # of control, seconds: 17 steps of the physics, 29.4 Hz
AWAY = 3.0


@dataclass(frozen=True)
class Trial:
    """Initial state of a trial."""

    target: str
    speed: float  # of the belt along y, m/s
    places: dict[str, tuple[float, float, float]]  # x, y and yaw of each object on the belt


def draw_trial(seed: int, moving: bool) -> Trial:
    """The target and two other objects, at least 13 cm apart; a moving belt brings them from one side."""
    rng = np.random.default_rng([seed, moving])
    names = [str(name) for name in rng.permutation(list(OBJECTS))[:3]]
    speed = float(rng.uniform(0.03, 0.08) * rng.choice([-1, 1])) if moving else 0.0
    start = -0.18 * np.sign(speed)  # upstream
    spots: list[np.ndarray] = [np.array([rng.uniform(-0.08, 0.1), start + rng.uniform(-0.06, 0.06)])]
    while len(spots) < 3:
        spot = np.array([rng.uniform(-0.15, 0.15), start + rng.uniform(-0.25, 0.25)])
        if min(np.linalg.norm(spot - other) for other in spots) > 0.13:
            spots.append(spot)
    yaws = rng.uniform(-np.pi, np.pi, 3)
    places = {n: (float(x), float(y), float(yaw)) for n, (x, y), yaw in zip(names, spots, yaws, strict=True)}
    return Trial(names[0], speed, places)


class Conveyor:
    """The simulated world, made once and reset for each trial."""

    def __init__(self, width: int, height: int):
        robot = Panda(idn=0)
        robot.add_base(robot_base_factory(robot.default_base, idn=0))
        robot.add_gripper(gripper_factory("PandaGripper", idn="0_right"), robot.eef_name["right"])
        robot.set_base_xpos(robot.base_xpos_offset["table"](0.8))
        arena = TableArena(table_full_size=(0.8, 1.6, 0.05), table_offset=(0, 0, 0.8))
        arena.set_origin([0, 0, 0])
        groceries = [make(name=name) for name, make in OBJECTS.items()]
        self.heights = {o.name: -o.bottom_offset[2] for o in groceries}
        task = ManipulationTask(mujoco_arena=arena, mujoco_robots=[robot], mujoco_objects=groceries)
        spec = mujoco.MjSpec.from_string(task.get_xml())
        belt = spec.worldbody.add_body(name="belt", pos=[0, 0, TOP - 0.015], mass=1000, inertia=[1000] * 3)
        belt.explicitinertial = True
        belt.add_joint(name="belt", type=mujoco.mjtJoint.mjJNT_SLIDE, axis=[0, 1, 0])
        shape = {"type": mujoco.mjtGeom.mjGEOM_BOX, "size": [0.22, 4.0, 0.015]}
        belt.add_geom(name="belt", **shape, rgba=[0.25, 0.27, 0.3, 1], group=1, friction=[1, 0.005, 1e-4])
        self.model = spec.compile()
        self.data = mujoco.MjData(self.model)
        self.data.qpos[:7] = robot.init_qpos
        self.bodies = {name: f"{name}_main" for name in OBJECTS}
        self.arm = Arm(self.model, self.data, PERIOD)
        self.arm.rest = np.array(robot.init_qpos)
        self.cameras = Cameras(self.model, VIEWS, width, height, fovy=32.0)

    def begin(self, trial: Trial) -> None:
        """Place all objects and let them settle on the running belt."""
        mujoco.mj_resetData(self.model, self.data)
        for i, name in enumerate(OBJECTS):
            x, y, yaw = trial.places.get(name, (AWAY + i, AWAY, 0.0))
            height = self.heights[name] + (TOP + 0.002 if name in trial.places else 0.0)
            set_body(self.model, self.data, self.bodies[name], (x, y, height), yaw)
        self.arm.place(HOME)
        self.speed = trial.speed
        self.rows = [self.bodies[name] for name in trial.places]
        for _ in range(15):
            self.step(HOME, 0.04)
        self.start_height = self.pose(trial.target)[2, 3]

    def step(self, pose: np.ndarray, finger: float) -> None:
        """One control period."""
        self.data.joint("belt").qvel[0] = self.speed
        self.arm.servo(pose, finger)

    def pose(self, name: str) -> np.ndarray:
        """Object to world."""
        return body_pose(self.data, self.bodies[name])
