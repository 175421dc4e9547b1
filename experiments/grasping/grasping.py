"""Grasp what lies still, or comes along on a belt, by the Gaussians that the tracker follows.

An object is named in the first frame, whose mask in one camera is the simulator's: the mask stands in for a
segmenter, and the name for a language query. From then on the arm knows only what three RGB-D cameras show. A
frame's command is carried out after the next frame is taken, so each command is one control period old.
"""

from dataclasses import replace
from functools import cache, partial
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from scipy.spatial.transform import Rotation

import gsjax
from experiments.grasping.conveyor import HOME, PERIOD, Conveyor, Trial, draw_trial
from experiments.shared.panda import CLOSED, LAG, OPEN, fed, motion_between, start
from gsjax.geometry.rotations import quats_to_matrices
from gsjax.methods.grasping import Grasp, Gripper, best_grasp, score_grasp
from gsjax.methods.planning import straight_line
from gsjax.methods.track import PRESETS, TrackedScene
from gsjax.scene.frame import Frame

FAST = PRESETS["fast"]
# Colours come straight from the pixels, and no Gaussians join objects: fewer programs to compile.
CONFIG = replace(FAST, grow=replace(FAST.grow, slots=0))
WIDTH, HEIGHT, MASK_CAMERA = 240, 180, 0
OWN, BACKGROUND = 512, 8192  # Gaussians of an object and of the background
OTHERS, NEAR = 1024, 0.25  # points around an object that may be in the way, and their distance, metres
# robosuite's hand: its palm starts 31 mm behind the tool's point and its fingers end 9 mm beyond it. Margins
# of 4 and 2 mm are added.
GRIPPER = Gripper(finger_thickness=0.027, finger_height=0.038, tip=0.011, palm_height=0.092)
KEY = jax.random.key(0)
TILT = 0.35  # of the approach away from straight down, radians
SEARCH = 4  # the held grasp is scored at every update, and new ones are drawn at every fourth
BETTER = 0.1  # a new grasp replaces the held one if its score is this much larger
CARROT = 0.045  # lead of the commanded position, metres: over the servos' lag this is the tool's speed
AT_GRASP = (0.004, 0.008, 0.08)  # across and along the approach, metres, and radians: then the fingers close
REACHING, CLOSING, LIFTING, HOLDING = 260, 14, 45, 15  # control periods at most
LIFT, LIFTED = 0.15, 0.10  # rise of the tool, and of an object that counts as lifted, metres
WINDOW = 8  # frames from which the object's velocity is estimated
LEAD = LAG + 2 * PERIOD  # from a frame to the time at which the arm has carried out its command


class Body(NamedTuple):
    """The object in the first frame: its rows among the moving Gaussians, their points and normals."""

    rows: np.ndarray
    points: np.ndarray
    normals: np.ndarray


class Begun(NamedTuple):
    """The start shared by all methods."""

    scene: TrackedScene
    frame: Frame
    body: Body


@cache
def world() -> Conveyor:
    return Conveyor(WIDTH, HEIGHT)


@cache
def begun(trial_seed: int, moving: bool) -> Begun:
    """The first frame of a trial as labelled Gaussians."""
    conveyor, trial = world(), draw_trial(trial_seed, moving)
    conveyor.begin(trial)
    frame = conveyor.cameras.frame(conveyor.data)
    mask = conveyor.cameras.mask(conveyor.data, MASK_CAMERA, conveyor.rows)
    scene = start(frame, mask, MASK_CAMERA, CONFIG.start, OWN, BACKGROUND)
    label = conveyor.rows.index(conveyor.bodies[trial.target]) + 1
    rows = np.flatnonzero(np.asarray(scene.labels) == scene.label_ids.index(label))
    axes = quats_to_matrices(scene.gaussians.quats[rows])
    normals = np.asarray(jnp.einsum("nij,nj->ni", axes, scene.normals[rows]))
    return Begun(scene, frame, Body(rows, np.asarray(scene.gaussians.means)[rows], normals))


def around(begun: Begun, means: np.ndarray, center: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Points near the object that belong to others, and which entries are valid."""
    label = begun.scene.labels[begun.body.rows[0]]
    near = np.linalg.norm(means - center, axis=1) < NEAR
    rows = np.flatnonzero(np.asarray(begun.scene.labels != label) & near)
    if len(rows) > OTHERS:
        rows = rows[np.linspace(0, len(rows) - 1, OTHERS).astype(int)]
    return means[np.resize(rows, OTHERS)], np.arange(OTHERS) < len(rows)


OPTIONS = {"approach": jnp.array([0.0, 0.0, -1.0]), "max_angle": TILT}


@jax.jit
def search(held: jax.Array, *cloud: jax.Array) -> Grasp:
    """The held grasp with a new score, or the best new grasp where it is better or the only feasible one."""
    new, old = best_grasp(KEY, *cloud, GRIPPER, **OPTIONS), score(held, *cloud)
    keep = old.feasible & ~(new.feasible & (new.score > old.score + BETTER))
    return jax.tree.map(partial(jnp.where, keep), old, new)


@jax.jit
def score(held: jax.Array, *cloud: jax.Array) -> Grasp:
    return score_grasp(held, *cloud, GRIPPER, **OPTIONS)


plan = jax.jit(straight_line)


class Aim:
    """The target grasp, which moves with the object."""

    def __init__(self, begun: Begun):
        self.begun, self.held, self.track = begun, np.full((4, 4), np.nan), []
        self.see(np.eye(4), np.asarray(begun.scene.gaussians.means))

    def see(self, motion: np.ndarray, means: np.ndarray) -> None:
        """Update with the object's motion since the first frame and the current centres of all Gaussians."""
        body = self.begun.body
        points = body.points @ motion[:3, :3].T + motion[:3, 3]
        center = points.mean(0)
        near, is_near = around(self.begun, means, center)
        cloud = (points, body.normals @ motion[:3, :3].T, np.ones(len(points), bool), near, is_near)
        cloud = [np.asarray(a, bool if a.dtype == bool else np.float32) for a in cloud]
        held, due = np.asarray(motion @ self.held, np.float32), len(self.track) % SEARCH == 0
        grasp = search(held, *cloud) if due or not self.grasp.feasible else score(held, *cloud)
        self.grasp = jax.tree.map(np.array, grasp)
        self.held = np.linalg.inv(motion) @ self.grasp.pose
        self.track.append(center)

    def coast(self) -> None:
        """Extrapolate the object's motion while the fingers hide it."""
        step = self.ahead(PERIOD)[:3, 3] - self.grasp.pose[:3, 3]
        self.grasp.pose[:3, 3] += step
        self.track.append(self.track[-1] + step)

    def ahead(self, seconds: float) -> np.ndarray:
        """The grasp's pose after `seconds` at the object's current velocity."""
        recent = np.array(self.track[-WINDOW:])
        velocity = (recent[-1] - recent[0]) / max(len(recent) - 1, 1) / PERIOD
        pose = np.array(self.grasp.pose, float)
        pose[:3, 3] += seconds * velocity
        return pose


def reached(tool: np.ndarray, goal: np.ndarray) -> bool:
    """Whether the tool is near enough to the goal to close the fingers."""
    offset = goal[:3, :3].T @ (tool[:3, 3] - goal[:3, 3])
    turn = Rotation.from_matrix(goal[:3, :3].T @ tool[:3, :3]).magnitude()
    errors = np.linalg.norm(offset[:2]), abs(offset[2]), turn
    return all(error < limit for error, limit in zip(errors, AT_GRASP, strict=True))


def run(options: dict[str, Any], seed: int, folder: Path) -> dict[str, Any]:
    """One trial."""
    moving = options["object"] == "moving"
    trial = draw_trial(seed, moving)
    first, conveyor = begun(seed, moving), world()
    conveyor.begin(trial)
    return Attempt(conveyor, trial, first, options["grasp from"]).run()


class Attempt:
    """The arm's side of a trial: reach, close, lift."""

    def __init__(self, conveyor: Conveyor, trial: Trial, first: Begun, source: str):
        self.conveyor, self.trial, self.start, self.source = conveyor, trial, first, source
        self.aim, self.first = Aim(first), conveyor.pose(trial.target)
        self.box: list[Frame] = []
        self.tracking = gsjax.track(first.scene, first.frame, fed(self.box), CONFIG)
        self.errors: list[float] = []
        self.waiting = HOME

    def observe(self) -> None:
        """Take a frame and update the aim."""
        if self.source == "first frame":
            return
        means = np.array(self.start.scene.gaussians.means)
        truth = self.conveyor.pose(self.trial.target) @ np.linalg.inv(self.first)
        motion, body = truth, self.start.body
        if self.source == "tracker":
            self.box.append(self.conveyor.cameras.frame(self.conveyor.data))
            moved = next(self.tracking).result.pose.means
            means[: len(moved)] = moved
            motion = motion_between(body.points, means[body.rows])
        else:  # the other objects ride on the belt as well
            moving = means[: self.start.scene.num_moving]
            moving[:] = moving @ truth[:3, :3].T + truth[:3, 3]
        self.aim.see(motion, means)
        center = np.append(body.points.mean(0), 1)
        self.errors.append(1e3 * float(np.linalg.norm(((motion - truth) @ center)[:3])))

    def act(self, pose: np.ndarray, finger: float) -> None:
        """One control period, which carries out the command of the period before."""
        self.conveyor.step(self.waiting, finger)
        self.waiting = pose

    def goal(self, seconds: float) -> np.ndarray:
        """Goal of the tool after `seconds`, with the fingers exchanged if that is a smaller rotation."""
        pose, tool = self.aim.ahead(seconds), self.conveyor.arm.pose()
        flipped = pose @ np.diag([-1.0, -1.0, 1.0, 1.0])
        return max(pose, flipped, key=lambda goal: np.trace(goal[:3, :3].T @ tool[:3, :3]))

    def along_path(self, tool: np.ndarray) -> np.ndarray:
        """A pose slightly ahead on a new path to where the grasp will be when the arm arrives."""
        goal = self.goal(LEAD)
        path = np.asarray(plan(tool.astype(np.float32), self.aim.grasp._replace(pose=np.float32(goal))).poses)
        to_grasp = path[: len(path) // 2]
        ahead = np.linalg.norm(to_grasp[:, :3, 3] - tool[:3, 3], axis=1)
        return to_grasp[np.argmax(ahead > CARROT) if (ahead > CARROT).any() else -1]

    def run(self) -> dict[str, Any]:
        """The whole attempt, and its results."""
        arm, heights, there = self.conveyor.arm, [], False
        possible, height = bool(self.aim.grasp.feasible), self.first[2, 3]
        periods = 0
        while periods < REACHING and not there:
            periods += 1
            self.act(self.along_path(arm.pose()), OPEN)
            self.observe()
            there = reached(arm.pose(), self.goal(0.0))
        before = self.errors[-1] if self.errors else None
        for _ in range(CLOSING if there else 0):
            self.act(self.goal(LEAD), CLOSED)
            self.aim.coast()
        score, tool = float(self.aim.grasp.score), arm.pose()
        for i in range(LIFTING + HOLDING if there else 0):
            raised = tool.copy()
            raised[2, 3] += LIFT * min(1.0, (i + 1) / (LIFTING - HOLDING))
            self.act(raised, CLOSED)
            heights.append(self.conveyor.pose(self.trial.target)[2, 3] - height)
        return {
            "success": float(there and min(heights[-HOLDING:]) >= LIFTED),
            "reached": float(there),
            "seconds_to_grasp": periods * PERIOD if there else None,
            "error_mm": float(np.median(self.errors)) if self.errors else None,
            "error_before_mm": before,
            "score": score,
            "feasible_at_first": float(possible),
            "target": self.trial.target,
            "speed": abs(self.trial.speed),
        }


def figure(rows: list[dict[str, Any]], path: Path) -> None:
    """Success rates of the methods, and errors of the tracker."""
    from experiments.shared.plots import draw_grasping

    draw_grasping(rows, path)
