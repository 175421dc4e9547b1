"""A run of `gsjax live`: objects tracked while frames arrive, and what was measured meanwhile."""

from collections.abc import Iterator
from contextlib import nullcontext
from dataclasses import dataclass, replace
from functools import partial
from math import isinf
from pathlib import Path
from time import perf_counter
from typing import Annotated, Any, NamedTuple

import jax
import numpy as np
import tyro
from rich.console import Console
from rich.live import Live
from scipy.spatial.transform import Rotation

from gsjax.data.consistency import check_recording
from gsjax.data.errors import DataError
from gsjax.data.opencv_cameras import open_camera, snapshots
from gsjax.data.realsense_camera import open_realsense
from gsjax.data.stream import Arrival, NewestSnapshots, Snapshot, StreamStalled, replay
from gsjax.engine.drive import Tick
from gsjax.engine.ending import completion, exit_code
from gsjax.engine.first_mask import first_mask, label_names, placed, warn_of_missing
from gsjax.engine.folder import RunFolder
from gsjax.engine.locks import releasing_locks
from gsjax.engine.machine import describe as describe_machine
from gsjax.engine.machine import resident_mb
from gsjax.engine.messages import FITTING, MEASURING, Notes, counted, stage
from gsjax.engine.options import Common, FirstMasks, Overwriting, Selection, checked, expect_positive
from gsjax.engine.recording import Recording, draw_ahead, drawing_ahead, open_recording
from gsjax.engine.terminal import print_facts
from gsjax.engine.track.rehearsal import Rehearsal
from gsjax.engine.track.scoring import budget_metrics
from gsjax.engine.track.tracking import track
from gsjax.methods.track import PLAN, PRESETS, TrackedScene, start_scene
from gsjax.perception.segmenters import PlaneOrRegionSegmenter
from gsjax.scene.frame import Frame
from gsjax.scene.origin import in_world

_CAMERAS = {
    "camera": lambda number, patience: open_camera(number),
    "realsense": lambda number, patience: open_realsense(number, patience=patience),
}
_MEMORY_EVERY_S = 1.0
_SHOWN_EVERY = 15  # updates
CONFIG = PRESETS["fast"]  # how a scene starts; what follows is chosen for the budget


@dataclass(frozen=True)
class SourceAndOut:
    """The source to follow, and the folder of the run."""

    source: Annotated[str, tyro.conf.Positional, tyro.conf.arg(metavar="SOURCE")]
    """camera:0 for an RGB-D camera (OpenCV, OpenNI 2), realsense:0 for a RealSense camera, or a recording,
    replayed back and forth."""
    out: Path
    """Folder for the run: a new one, or that of an earlier run with --overwrite."""


@dataclass(frozen=True, kw_only=True)
class Options(Common, Overwriting, FirstMasks, Selection, SourceAndOut):
    """Options of `gsjax live`."""

    minutes: float = 1.0
    """How long to follow, once the scene is fitted and updates are compiled, which takes a minute or two the
    first time."""
    hz: float = 30.0
    """Frames per second of the replay, from which the budget is derived."""
    budget_ms: float | None = None
    """Time that an update may take, milliseconds; default: the time between two frames."""
    patience: float = 10.0
    """Seconds to wait for a frame before giving up."""


class Source(NamedTuple):
    """A stream, and the scene at its first frame.

    Attributes:
        first: the frame from which the scene starts.
        scene: the scene at that frame.
        names: name of each mask value.
        rehearsal: compiles the first settings that are measured.
        snapshots: the stream, which begins when it is first iterated over.
        origin: the point that positions are relative to, [3], in the recording's coordinates; None if they
            are as in the recording.
    """

    first: Frame
    scene: TrackedScene
    names: dict[int, str]
    rehearsal: Rehearsal
    snapshots: Iterator[Snapshot]
    origin: np.ndarray | None = None


@releasing_locks()
def run(options: Options) -> int:
    """Follow a stream and report on it; returns the exit code.

    Raises:
        ValueError, OSError: an option cannot be met; what was followed before that is on disk.
    """
    options = checked(options)
    _check(options)
    console = Console(stderr=True, highlight=False)
    with Notes(console) as notes:
        folder = RunFolder.locked(options.out, overwrite=options.overwrite, resume=None)
        source = _open(options, console, notes)
        settings = replace(options, masks=placed(options.masks))
        folder.write_config(settings)  # from here on an earlier run is gone
        log = Log(source.scene.label_ids, source.names)
        stopped = follow(options, source, log, console)
        found = {
            "kind": "live",
            "source": options.source,
            **completion(stopped, report=False),
            **log.metrics(),
            "machine": describe_machine(),
            "notes": notes.all,
        }
        folder.write_metrics(found)
        if log.rows:
            moved = log.trajectory()
            centers = in_world(moved["centers"], source.origin)
            folder.write_trajectory(**moved | {"centers": centers})
    print_facts(_facts(found) | {"written": str(folder.path)})
    return exit_code(stopped)


def _check(options: Options) -> None:
    expect_positive(options, "hz", "patience", "budget_ms")
    if isinf(options.hz):
        raise ValueError("--hz: expected a finite number of frames per second, found inf")
    if _camera(options.source):
        default = Options(options.source, options.out)
        for name in ("cameras", "mask_camera", "frames", "masks", "scale", "read"):
            if getattr(options, name) != getattr(default, name):
                option = name.replace("_", "-")
                raise ValueError(
                    f"--{option}: applies to recordings, and {options.source} is a camera; leave it out"
                )


def _camera(source: str) -> str | None:
    """The kind of a source that is a camera; None if it is a recording."""
    kind = source.partition(":")[0]
    return kind if source.startswith(f"{kind}:") and kind in _CAMERAS else None


def _open(options: Options, console: Console, notes: Notes) -> Source:
    if kind := _camera(options.source):
        number = options.source.removeprefix(f"{kind}:")
        if not number.isdecimal():
            raise ValueError(f"SOURCE: expected {kind}:NUMBER, as in {kind}:0, found {options.source}")
        camera = _CAMERAS[kind](int(number), options.patience)
        arriving = snapshots([camera])
        if (begins := next(arriving, None)) is None:
            raise DataError(options.source, "a frame", "none", "Check its connection.")
        first, drawing, stream = begins.frame, nullcontext(), lambda: arriving
        image, depth = np.asarray(first.images[0]), np.asarray(first.depths)[0]
        labels = PlaneOrRegionSegmenter()((255 * image).astype(np.uint8), depth, camera.K).astype(np.int32)
        recording, mask, index, names = None, None, 0, {}
    else:
        recording = open_recording(
            options.source, options.cameras, (), options.frames, options.read, options.scale
        )
        check_recording(recording.judged)
        mask = first_mask(recording.tracked, options.mask_camera, options.masks, options.scale)
        if mask.labels is None:
            raise ValueError(
                f"SOURCE: {options.source} has no depth; gsjax live starts from depth. Use gsjax track."
            )
        tracked = recording.tracked
        first, labels, index = tracked.frame(0), mask.labels, tracked.camera_ids.index(mask.camera)
        names, drawing = label_names(recording, mask.source), drawing_ahead(recording)
        stream = partial(_replayed, recording, options, console)
    rehearsal = Rehearsal(first, CONFIG, budgeted=True)
    with drawing, stage(console, FITTING):
        scene = start_scene(first, labels, index, CONFIG, before_fit=rehearsal.begin)
    if recording is not None and mask is not None:
        warn_of_missing(recording, mask, scene.label_ids, notes)
    origin = None if recording is None else recording.tracked.origin
    return Source(first, scene, names, rehearsal, stream(), origin)


def _replayed(recording: Recording, options: Options, console: Console) -> Iterator[Snapshot]:
    """The frames of a recording, which are all in memory now, as they would arrive."""
    draw_ahead(recording, console)
    frames = [recording.tracked.frame(t) for t in range(recording.tracked.num_frames)]
    return replay(frames, options.hz, 60 * options.minutes)


class Log:
    """A few numbers per update, so that memory stays flat.

    Args:
        label_ids: the mask value of each group, the background's first.
        names: name of each mask value.

    Attributes:
        rows: one per update, by name as in trajectory.npz; `looked_for` and `latency_s` are numbers.
        counts: the statistics of the stream.
    """

    def __init__(self, label_ids: tuple[int, ...], names: dict[int, str]):
        self._ids = np.asarray(label_ids[1:])
        self._names = {v: names.get(v, f"object {v}") for v in sorted({*label_ids} - {0})}
        self.rows: list[dict[str, Any]] = []
        self.counts: dict[str, Any] = {}
        self._turned, self._centers = Rotation.identity(len(label_ids) - 1), None
        self._late, self._skipped, self._chosen, self._plans = 0, 0, None, set()
        self._begun, self._now, self._memory_mb, self._memory_at = 0.0, 0.0, [], 0.0

    def add(self, now: Tick, arrival: Arrival, budget: float) -> None:
        """Record one update.

        Args:
            now: the tracker after it.
            arrival: the frame, and when it arrived.
            budget: seconds above which an update is late.
        """
        time, info = perf_counter(), now.info
        pose = self._carried(*jax.device_get((info["motion"].twists, info["centers"])))
        self.rows.append(
            {
                "times": arrival.snapshot.stamp,
                "centers": pose[:, :3],
                "quats": pose[:, 3:],
                "lost": np.asarray(info["lost"]),
                "turn_known": np.asarray(info["turn_known"]),
                "latency_s": time - arrival.time,
                "update_s": now.seconds,
                "looked_for": int(info["looked_for"].sum()),
            }
        )
        self._begun, self._now = self._begun or time, time
        self._late += now.seconds > budget
        self._skipped += bool(info["skipped"])
        self._chosen = now.run.kept.chosen
        self._plans.add(now.run.plans[PLAN])
        if time - self._memory_at > _MEMORY_EVERY_S:
            self._memory_at = time
            self._memory_mb.append(resident_mb())

    def _carried(self, twists: np.ndarray, centers: np.ndarray) -> np.ndarray:
        """The current position of each group's first centre, and its rotation since then.

        The tracker's own centres shift as Gaussians join a group; these only move with the group.
        """
        before, turns = centers - twists[:, :3], Rotation.from_rotvec(twists[:, 3:])
        old = before if self._centers is None else self._centers
        self._centers = turns.apply(old - before) + centers
        self._turned = turns * self._turned
        quats = self._turned.as_quat(scalar_first=True)
        return np.concatenate([self._centers, quats], axis=1).astype(np.float32)

    def trajectory(self) -> dict[str, np.ndarray]:
        """The position and rotation of every group over time."""
        names = ("times", "centers", "quats", "lost", "turn_known", "latency_s", "update_s")
        return {name: self._column(name) for name in names} | {"label_ids": self._ids}

    def metrics(self) -> dict[str, Any]:
        """The part of metrics.json about the stream."""
        span, looked_for, memory = self._now - self._begun, self._column("looked_for"), self._memory_mb
        return {
            "frames": dict(self.counts),
            "hz": (len(self.rows) - 1) / span if span else None,
            "latency_ms": _spread(self._column("latency_s")),
            "update_ms": _spread(self._column("update_s")),
            "late": self._late,
            "skipped": self._skipped,
            "looked_for": float(looked_for.mean()) if len(looked_for) else None,
            "budget": None if self._chosen is None else budget_metrics(self._chosen),
            "plans": len(self._plans),
            "memory_mb": {"first": memory[0], "last": memory[-1], "max": max(memory)} if memory else None,
            "objects": {str(value): name for value, name in self._names.items()},
            "frames_lost": self._updates_with(self._column("lost")),
            "frames_turn_unknown": self._updates_with(self._column("turn_known") == 0),
        }

    def _column(self, name: str) -> np.ndarray:
        return np.asarray([row[name] for row in self.rows])

    def _updates_with(self, flags: np.ndarray) -> dict[str, int]:
        """The number of updates in which the flag of an object, or of a part of it, was set."""
        flags = flags.reshape(len(self.rows), len(self._ids))
        return {name: int(flags[:, self._ids == v].any(axis=1).sum()) for v, name in self._names.items()}


def _spread(seconds: np.ndarray) -> dict[str, float] | None:
    """Median, 95th percentile and worst, milliseconds."""
    if not len(seconds):
        return None
    return dict(
        zip(("median", "p95", "worst"), np.percentile(1e3 * seconds, [50, 95, 100]).tolist(), strict=True)
    )


def follow(options: Options, source: Source, log: Log, console: Console) -> BaseException | None:
    """Track until the stream ends; returns what ended it early, or None.

    Args:
        options: budget, patience and duration.
        source: the stream.
        log: records every update.
        console: shows the progress.
    """
    budget_ms = 1e3 / options.hz if options.budget_ms is None else options.budget_ms
    newest = NewestSnapshots(source.snapshots, patience=options.patience)
    arrived: list[Arrival] = []

    def frames() -> Iterator[Frame]:
        yield source.first  # compiles the update, and faults its memory in, before the stream begins
        begun = perf_counter()
        for arrival in newest:
            arrived[:] = [arrival]
            yield arrival.snapshot.frame
            if perf_counter() - begun > 60 * options.minutes:
                return
        if _camera(options.source):
            came = counted(1 + newest.counts.offered, "frame")  # with that from which the scene starts
            raise StreamStalled(f"{options.source}: it delivered {came} and no more; check its connection")

    try:
        console.print(MEASURING)
        # Drawn between updates: a thread of its own would make some of them late.
        with Live(console=console, auto_refresh=False, transient=True) as shown:
            worst = 0.0
            how = {"budget_ms": budget_ms, "like": source.rehearsal.tick}
            for now in track(source.scene, source.first, frames(), CONFIG, **how):
                if not arrived:
                    continue
                log.add(now, arrived[0], budget_ms / 1e3)
                worst, counts = max(worst, log.rows[-1]["latency_s"]), newest.counts
                if len(log.rows) % _SHOWN_EVERY == 0:
                    words = f"{counts.used} frames, {counts.dropped} dropped, {1e3 * worst:.0f} ms at worst"
                    shown.update(words, refresh=True)
    except (KeyboardInterrupt, Exception) as stopped:
        return stopped
    finally:
        log.counts = vars(newest.counts)
    return None


def _facts(found: dict[str, Any]) -> dict[str, str]:
    """The run in a few lines."""
    frames = found["frames"]
    left_out = ((frames["out_of_order"], "out of order"), (frames["out_of_sync"], "cameras out of sync"))
    facts = {
        "frames": f"{frames['offered']} offered, {frames['used']} used, {frames['dropped']} dropped"
        + "".join(f"; {count} left out, {why}" for count, why in left_out if count)
    }
    if latency := found["latency_ms"]:
        spread = ", ".join(f"{name} {value:.0f} ms" for name, value in latency.items())
        facts |= {
            "rate": f"{found['hz']:.1f} Hz" if found["hz"] else "one update",
            "latency": f"from arrival to the new state: {spread}",
            "late": f"{found['late']} updates were over the budget",
        }
    if found["skipped"]:
        facts["skipped"] = f"{counted(found['skipped'], 'update')}, whose numbers were not finite"
    for title, key in (("lost", "frames_lost"), ("turn unknown", "frames_turn_unknown")):
        counts = [f"{name} in {counted(count, 'update')}" for name, count in found[key].items() if count]
        if counts:
            facts[title] = ", ".join(counts)
    if budget := found["budget"]:
        beyond = "" if budget["fits"] else ", the cheapest, which takes longer than the budget"
        facts["settings"] = budget["chosen"] + beyond
    if memory := found["memory_mb"]:
        facts["memory"] = f"{memory['first']:.0f} MB at first, {memory['last']:.0f} MB at last"
    return facts
