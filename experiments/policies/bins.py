"""robosuite's PickPlaceCan: a Panda takes a can out of one bin and puts it into a quarter of another."""

from dataclasses import dataclass

import mujoco
import numpy as np
import robosuite

from experiments.shared.panda import CLOSED, OPEN, Arm, Cameras, body_pose, set_body

VIEWS = [((0.8, -0.45, 1.4), (0.1, -0.12, 0.86)), ((0.8, 0.45, 1.4), (0.1, 0.16, 0.88))]
WIDTH, HEIGHT, FOVY = 320, 240, 34.0
CAN = "Can_main"
PERIOD = 0.05  # of control, seconds
STEP = 0.015  # how far the commanded position moves in a period at most, metres
REACH = 0.05  # how far the commanded position may be from the tool along each axis, metres
SPACE = np.array([[-0.15, -0.55, 0.855], [0.35, 0.6, 1.2]])  # where it may be, metres
HORIZON = 160  # periods of a rollout
ABOVE, CARRY, LOW = (
    0.10,
    1.08,
    0.9,
)  # start above the can; height of the tool when carrying, releasing; metres
LIFTED = 0.91  # height of a can that stands 5 cm over the floor of its bin, metres
NOISE = 0.004  # of demonstrated motions, metres: later actions show how to correct it


@dataclass(frozen=True)
class Proprioception:
    """The arm's proprioception: commanded position, position of the tool, and opening of the hand, metres."""

    command: np.ndarray
    tool: np.ndarray
    opening: float

    def vector(self) -> np.ndarray:
        return np.concatenate([self.command, self.tool, [self.opening]]).astype(np.float32)


class Bins:
    """The simulated world.

    An action is a move of the tool's commanded position [3], in STEPs, and 1 for closed or -1 for open.
    """

    def __init__(self):
        options = {"has_renderer": False, "has_offscreen_renderer": False, "use_camera_obs": False}
        self.env = robosuite.make("PickPlaceCan", robots="Panda", **options, seed=0)
        self.env.reset()
        self.model, self.data = self.env.sim.model._model, self.env.sim.data._data
        self.arm = Arm(self.model, self.data, PERIOD)
        self.cameras = Cameras(self.model, VIEWS, WIDTH, HEIGHT, FOVY)
        self.clean = self.data.qpos.copy()
        placed = self.env.target_bin_placements[self.env.object_to_id["can"]]
        self.goal = np.array([*placed[:2], CARRY])
        self.home = self.arm.pose()
        self.home[:3, :3] = np.diag([-1.0, 1.0, -1.0])
        self.home[:3, 3] = 0.0, -0.1, 1.1

    def begin(self, seed: int) -> None:
        """Place the can in its bin at random, as robosuite does, and the arm at its start."""
        rng = np.random.default_rng(seed)
        mujoco.mj_resetData(self.model, self.data)
        self.data.qpos[:] = self.clean
        half = np.array(self.env.bin_size[:2]) / 2 - 0.05 - 0.025
        at = np.array(self.env.bin1_pos[:2]) + rng.uniform(-half, half)
        set_body(self.model, self.data, CAN, (*at, 0.865), rng.uniform(-np.pi, np.pi))
        self.arm.place(self.home)
        self.command, self.lifted = self.home[:3, 3].copy(), False
        for _ in range(8):
            self.move(np.array([0.0, 0.0, 0.0, -1.0]))

    def move(self, action: np.ndarray, guarded: bool = False) -> None:
        """One control period; with `guarded` the command is kept near the tool and within the bins."""
        self.command = self.command + STEP * np.clip(action[:3], -1, 1)
        if guarded:
            tool = self.arm.pose()[:3, 3]
            self.command = np.clip(np.clip(self.command, tool - REACH, tool + REACH), *SPACE)
        pose = self.home.copy()
        pose[:3, 3] = self.command
        self.arm.servo(pose, CLOSED if action[3] > 0 else OPEN)
        self.lifted |= bool(self.can()[2, 3] > LIFTED)

    def feel(self) -> Proprioception:
        return Proprioception(self.command, self.arm.pose()[:3, 3], self.arm.opening())

    def can(self) -> np.ndarray:
        """Can to world [4, 4]."""
        return body_pose(self.data, CAN)

    def success(self) -> bool:
        """robosuite's rule: the can lies in its quarter of the other bin, and the tool has left it."""
        return bool(self.env._check_success())


class Script:
    """A scripted demonstration: over the can, down, close, up, over the goal, down, open, up."""

    def __init__(self, world: Bins):
        self.world, self.phase, self.count = world, 0, 0

    def __call__(self) -> np.ndarray:
        """The next action; it uses the can's true position until the can is grasped."""
        can, at = self.world.can()[:3, 3], self.world.command
        if self.phase < 2:
            self.aim = can.copy()
        high, over = np.array([*self.aim[:2], CARRY]), self.world.goal
        above, low = self.aim + np.array([0, 0, ABOVE]), np.array([*over[:2], LOW])
        stops = [above, self.aim, self.aim, high, over, low, low, over]
        waits, closed = [0, 2, 10, 0, 0, 2, 6, 40], self.phase in (2, 3, 4, 5)
        goal = stops[self.phase]
        if np.linalg.norm(goal - at) < 0.006:
            self.count += 1
            if self.count > waits[self.phase] and self.phase < len(stops) - 1:
                self.phase, self.count = self.phase + 1, 0
        move = (goal - at) / STEP
        move /= max(1.0, np.linalg.norm(move))
        return np.array([*move, 1.0 if closed else -1.0])
