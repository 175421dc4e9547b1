"""The loop over the frames of a recording: frames in, poses out, and everything timed."""

from collections.abc import Callable
from dataclasses import dataclass, field
from time import perf_counter

import equinox as eqx
import jax
import numpy as np
from jaxtyping import Float
from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn

from gsjax.data import Sequence
from gsjax.engine.drive import Tick
from gsjax.engine.interrupts import shielded
from gsjax.engine.machine import usable_cores
from gsjax.engine.messages import COMPILING, MEASURING
from gsjax.engine.recording import Prefetched
from gsjax.engine.track.tracking import track
from gsjax.methods.track import EMPTY, PLAN, Pose, TrackConfig, TrackedScene, first_pose
from gsjax.methods.track.budget import Chosen
from gsjax.scene.frame import Frame

LOADED_AHEAD = 2
"""Frames read ahead while an update runs, if there is a second core for that."""
_RATE_OVER = 10  # updates
_SHOWN_EVERY_S = 0.1  # the progress bar is drawn between updates: a thread of its own would make some late


@dataclass
class Tracking:
    """What has been tracked so far: the first frame, and one more entry for each update.

    Attributes:
        scene: the scene at the first frame.
        poses: poses of the moving Gaussians in each frame, on the host; from the second frame on they include
            those that joined.
        tick: the newest tick, with what has joined the objects; None before the first update.
        joined: number of Gaussians that had joined by each frame.
        update_s: seconds of each update; 0 for the first frame, which is initialisation.
        compile_s: seconds spent compiling, since the run began or was resumed.
        planning_s: seconds before the first update, without compiling: for the plan, processing the first
            frame and, under a budget, trials of settings.
        loading_s: seconds that the loop waited for images.
        loop_s: seconds of the whole loop.
        plans: number of plans; more than one means that a plan had become too small.
        visible: [K] per update: which objects some camera saw.
        lost: [K] per update: which objects were not where they were believed to be.
        turn_known: [K] per update: whether the rotation of each object since the first frame is known.
        agrees: [K] per update: the fraction of what is seen of each object that agrees with the pictures.
        skipped: number of updates that changed nothing, because a number in them was not finite.
        everywhere: number of groups for which each update tried rotations or other places.
        resumed: number of frames that an earlier run had tracked; 0 without one.
        stopped: what ended the loop early, or None.
    """

    scene: TrackedScene
    poses: list[Pose]
    tick: Tick | None = None
    joined: list[int] = field(default_factory=lambda: [0])
    update_s: list[float] = field(default_factory=lambda: [0.0])
    compile_s: float = 0.0
    planning_s: float = 0.0
    loading_s: float = 0.0
    loop_s: float = 0.0
    plans: int = 0
    visible: list[np.ndarray] = field(default_factory=list)
    lost: list[np.ndarray] = field(default_factory=list)
    turn_known: list[np.ndarray] = field(default_factory=list)
    agrees: list[np.ndarray] = field(default_factory=list)
    skipped: int = 0
    everywhere: list[int] = field(default_factory=list)
    resumed: int = 0
    stopped: BaseException | None = None

    def add(self, now: Tick) -> None:
        """Append one frame."""
        self.tick, info = now, now.info
        self.poses.append(jax.device_get(now.result.pose))
        self.joined.append(int(info["joined"]))
        self.update_s.append(now.seconds)
        self.compile_s += now.compile_seconds
        self.everywhere.append(int(info["looked_for"].sum()))
        self.visible.append(np.asarray(info["visible"]))
        self.lost.append(np.asarray(info["lost"]))
        self.turn_known.append(np.asarray(info["turn_known"]))
        self.agrees.append(np.asarray(info["agrees"]))
        self.skipped += int(info["skipped"])

    @property
    def final(self) -> TrackedScene | None:
        """The scene after the last frame; None before the first update."""
        return None if self.tick is None else self.tick.result.scene

    @property
    def chosen(self) -> Chosen | None:
        """The settings chosen for a budget, or None."""
        return None if self.tick is None else self.tick.run.kept.chosen

    @property
    def num_frames(self) -> int:
        """Frames that have a pose."""
        return len(self.poses)

    @property
    def hz(self) -> float | None:
        """Updates per second, without loading and compiling; None before the first."""
        total = sum(self.update_s)
        return (self.num_frames - 1) / total if total else None

    def seconds(self) -> dict[str, float]:
        """How the time of the loop was spent, in seconds."""
        parts = {
            "planning": self.planning_s,
            "compile": self.compile_s,
            "updates": sum(self.update_s[max(self.resumed, 1) :]),
            "loading": self.loading_s,
        }
        return parts | {"loop_rest": self.loop_s - sum(parts.values()), "loop_wall": self.loop_s}

    def means(self) -> Float[np.ndarray, "T N 3"]:
        """The centres of all Gaussians over time, metres."""
        still = np.asarray(self.scene.gaussians.means)[self.scene.num_moving :]
        count = self.scene.num_moving
        return np.stack([np.concatenate([pose.means[:count], still]) for pose in self.poses])

    def quats(self) -> Float[np.ndarray, "T M 4"]:
        """The orientations of the moving Gaussians, which come first, over time."""
        return np.stack([pose.quats[: self.scene.num_moving] for pose in self.poses])

    def at(self, t: int) -> tuple[TrackedScene, Pose]:
        """The scene and its pose in frame t, in the same shapes for all t, without what joined later."""
        final, pose = self.final, self.poses[t]
        if final is None:
            return self.scene, pose
        count = self.scene.num_moving
        slots = final.num_moving - len(pose.means)  # the first frame has none
        if slots:
            pose = jax.tree.map(lambda a: np.concatenate([a, np.repeat(a[:1], slots, axis=0)]), pose)
        labels = np.asarray(final.labels).copy()
        later = slice(count + self.joined[t], final.num_moving)
        labels[later] = final.num_objects + 1
        logits = np.asarray(final.gaussians.logit_opacities).copy()
        logits[later] = EMPTY
        scene = eqx.tree_at(lambda s: (s.labels, s.gaussians.logit_opacities), final, (labels, logits))
        return scene, pose


def begin(scene: TrackedScene) -> Tracking:
    """Tracking that has reached the first frame."""
    return Tracking(scene, [jax.device_get(first_pose(scene))])


def follow(
    tracking: Tracking,
    first: Frame,
    tracked: Sequence,
    config: TrackConfig,
    console: Console,
    *,
    budget_ms: float | None = None,
    like: Callable[[], Tick | None] = lambda: None,
    saved: Callable[..., None] = lambda tracking, *, last: None,
) -> Tracking:
    """Track the remaining frames. Ctrl-C or an error ends the loop; what was tracked until then is kept.

    Args:
        tracking: from `begin` or an earlier run; it is extended, and returned.
        first: the first frame.
        tracked: the tracked cameras; only images and depth are loaded.
        config: the settings of the tracker.
        console: for the progress bar.
        budget_ms: time that an update may take, or None.
        like: as for `track`.
        saved: called after each update, and once more, with `last` on, at the end of the loop.
    """
    shared = usable_cores() == 1 and jax.default_backend() == "cpu"  # with a thread that reads meanwhile
    ahead = 0 if shared else LOADED_AHEAD
    frames = Prefetched(tracked.frame, range(tracking.num_frames, tracked.num_frames), ahead)
    after = tracking.tick
    columns = (
        TextColumn("[bold]{task.description}"),
        BarColumn(bar_width=None),
        MofNCompleteColumn(),
        TextColumn("{task.fields[rate]}"),
        TimeRemainingColumn(),
    )
    begun, plans, drawn = perf_counter(), set(), 0.0
    if not console.is_terminal and tracking.num_frames < tracked.num_frames:  # the bar is drawn at the end
        console.print(COMPILING if budget_ms is None else MEASURING, soft_wrap=True)
    with Progress(*columns, console=console, expand=True, auto_refresh=False) as progress:
        task = progress.add_task(
            "tracking", total=tracked.num_frames, completed=tracking.num_frames, rate="compiling"
        )
        try:
            for now in track(
                tracking.scene, first, frames, config, budget_ms=budget_ms, after=after, like=like
            ):
                if not plans:
                    known = now.seconds + now.compile_seconds + frames.waited
                    tracking.planning_s = max(0.0, perf_counter() - begun - known)
                shielded(tracking.add, now)
                plans.add(now.run.plans[PLAN])
                saved(tracking, last=False)
                recent = tracking.update_s[1:][-_RATE_OVER:]
                progress.update(task, advance=1, rate=f"{len(recent) / sum(recent):.2f} Hz")
                if perf_counter() - drawn > _SHOWN_EVERY_S:
                    progress.refresh()
                    drawn = perf_counter()
        except (KeyboardInterrupt, Exception) as stopped:
            tracking.stopped = stopped
            progress.update(task, rate="stopped")
        if tracking.tick is not after:
            saved(tracking, last=True)
    tracking.loop_s = perf_counter() - begun
    tracking.loading_s, tracking.plans = frames.waited, len(plans)
    return tracking
