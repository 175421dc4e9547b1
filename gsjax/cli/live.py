"""`gsjax live`: follow objects while frames arrive, at the rate at which they do."""

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from time import perf_counter
from typing import Annotated, Any, NamedTuple

import jax
import numpy as np
import tyro
from rich.console import Console
from rich.live import Live
from rich.table import Table
from scipy.spatial.transform import Rotation

from gsjax.data.opencv_cameras import open_camera, snapshots
from gsjax.data.stream import Arrival, NewestSnapshots, Snapshot, replay
from gsjax.engine.drive import Tick
from gsjax.engine.ending import ended, exit_code
from gsjax.engine.folder import RunFolder
from gsjax.engine.machine import describe as describe_machine
from gsjax.engine.machine import resident_mb
from gsjax.engine.messages import FITTING, MEASURING, Notes, stage
from gsjax.engine.options import Common, FirstMasks, Overwriting, Selection, checked, expect_positive
from gsjax.engine.recording import draw_ahead, first_mask, label_names, open_recording
from gsjax.engine.track.scoring import budget_metrics
from gsjax.engine.track.tracking import track
from gsjax.methods.track import PLAN, PRESETS, TrackedScene, start_scene
from gsjax.perception.segmenters import PlaneOrRegionSegmenter
from gsjax.scene.frame import Frame

CAMERA_PREFIX = "camera:"
_MEMORY_EVERY_S = 1.0
CONFIG = PRESETS["fast"]  # how a scene starts; what follows is chosen for the budget


@dataclass(frozen=True)
class SourceAndOut:
    """The source to follow, and the folder of the run."""

    source: Annotated[str, tyro.conf.Positional, tyro.conf.arg(metavar="SOURCE")]
    """camera:0 for an RGB-D camera (OpenCV, OpenNI 2), or a recording, replayed back and forth."""
    out: Path
    """Folder for the run: a new one, or that of an earlier run with --overwrite."""


@dataclass(frozen=True, kw_only=True)
class Options(Common, Overwriting, FirstMasks, Selection, SourceAndOut):
    """Options of `gsjax live`."""

    minutes: float = 1.0
    """How long to follow, once the scene is fitted and updates are compiled, which takes some minutes."""
    hz: float = 30.0
    """Frames a second: of the replay, and what the budget comes from."""
    budget_ms: float | None = None
    """Time that an update may take, milliseconds; default: the time between two frames."""
    patience: float = 10.0
    """Seconds to wait for a frame before giving up."""


class Source(NamedTuple):
    """Where frames come from.

    Attributes:
        first: what the scene starts from.
        scene: at that frame.
        names: of each mask value.
        snapshots: the stream, which begins when it is first asked.
    """

    first: Frame
    scene: TrackedScene
    names: dict[int, str]
    snapshots: Iterator[Snapshot]


def run(options: Options) -> int:
    """Follow a stream and report on it; returns the exit code.

    Raises:
        ValueError, OSError: what was asked cannot be done; what was followed before that is on disk.
    """
    options = checked(options)
    _check(options)
    console = Console(stderr=True, highlight=False)
    with Notes(console) as notes:
        folder = RunFolder(options.out, overwrite=options.overwrite, resume=None)
        source = _open(options, console)
        folder.write_config(options)  # from here on an earlier run is gone
        log = Log(source.scene.label_ids, source.names)
        stopped = follow(options, source, log, console)
        found = {
            "kind": "live",
            "source": options.source,
            **ended(stopped, report=False),
            **log.metrics(),
            "machine": describe_machine(),
            "notes": notes.all,
        }
        folder.write_metrics(found)
        if log.times:
            folder.write_trajectory(**log.trajectory())
    _print(found, folder)
    return exit_code(stopped)


def _check(options: Options) -> None:
    expect_positive(options, "hz", "patience", "budget_ms")
    if options.source.startswith(CAMERA_PREFIX):
        for name in ("cameras", "mask_camera", "frames", "masks", "scale", "read"):
            if getattr(options, name) != getattr(Options(options.source, options.out), name):
                option = name.replace("_", "-")
                raise ValueError(
                    f"--{option}: is of recordings, and {options.source} is a camera; leave it out"
                )


def _open(options: Options, console: Console) -> Source:
    """The stream, and the scene at its first frame."""
    if options.source.startswith(CAMERA_PREFIX):
        number = options.source.removeprefix(CAMERA_PREFIX)
        if not number.isdecimal():
            raise ValueError(
                f"SOURCE: expected {CAMERA_PREFIX}NUMBER, as in camera:0, found {options.source}"
            )
        camera = open_camera(int(number))
        stream = snapshots([camera])
        first = next(stream).frame
        image, depth = np.asarray(first.images[0]), np.asarray(first.depths)[0]
        mask = PlaneOrRegionSegmenter()((255 * image).astype(np.uint8), depth, camera.K)
        with stage(console, FITTING):
            scene = start_scene(first, mask.astype(np.int32), 0, CONFIG)
        return Source(first, scene, {}, stream)
    recording = open_recording(
        options.source, options.cameras, (), options.frames, options.read, options.scale
    )
    mask = first_mask(recording.tracked, options.mask_camera, options.masks)
    if mask.labels is None:
        raise ValueError(
            f"SOURCE: {options.source} has no depth; gsjax live starts from depth. Use gsjax track."
        )
    draw_ahead(recording, console)
    frames = [recording.tracked.frame(t) for t in range(recording.tracked.num_frames)]
    with stage(console, FITTING):
        scene = start_scene(frames[0], mask.labels, recording.tracked.camera_ids.index(mask.camera), CONFIG)
    names = label_names(recording, mask.source)
    return Source(frames[0], scene, names, replay(frames, options.hz, 60 * options.minutes))


class Log:
    """What is kept of a stream: a few numbers an update, so that memory stays flat."""

    def __init__(self, label_ids: tuple[int, ...], names: dict[int, str]):
        """
        Args:
            label_ids: the mask value of each group, the background's first.
            names: of mask values.
        """
        self._ids, self._names = label_ids, names
        self.times: list[float] = []
        self.stamps: list[float] = []
        self.latencies: list[float] = []
        self.seconds: list[float] = []
        self.everywhere: list[int] = []
        self.memory_mb: list[float] = []
        self.poses: list[np.ndarray] = []
        self.lost: list[np.ndarray] = []
        self.turn_known: list[np.ndarray] = []
        self._turned, self._centers = Rotation.identity(len(label_ids) - 1), None
        self.late, self.skipped, self.counts, self.chosen, self.plans = 0, 0, {}, None, set()
        self._memory_at = 0.0

    def add(self, now: Tick, arrival: Arrival, budget: float) -> None:
        """One update.

        Args:
            now: the tracker after it.
            arrival: the frame, and when it came.
            budget: seconds, beyond which an update is late.
        """
        time, info = perf_counter(), now.info
        self.times.append(time)
        self.stamps.append(arrival.snapshot.stamp)
        self.latencies.append(time - arrival.time)
        self.seconds.append(now.seconds)
        self.late += now.seconds > budget
        self.skipped += bool(info["skipped"])
        self.everywhere.append(int(info["looked_for"].sum()))
        self.chosen = now.run.kept.chosen
        self.plans.add(now.run.plans[PLAN])
        self.lost.append(np.asarray(info["lost"]))
        self.turn_known.append(np.asarray(info["turn_known"]))
        self.poses.append(self._carried(*jax.device_get((info["motion"].twists, info["centers"]))))
        if time - self._memory_at > _MEMORY_EVERY_S:
            self._memory_at = time
            self.memory_mb.append(resident_mb())

    def _carried(self, twists: np.ndarray, centers: np.ndarray) -> np.ndarray:
        """Where the groups' first centres are now, and how they are turned.

        The tracker's own centres shift with what joins a group; these go where its motion carries them.
        """
        before, turns = centers - twists[:, :3], Rotation.from_rotvec(twists[:, 3:])
        old = before if self._centers is None else self._centers
        self._centers = turns.apply(old - before) + centers
        self._turned = turns * self._turned
        quats = self._turned.as_quat(scalar_first=True)
        return np.concatenate([self._centers, quats], axis=1).astype(np.float32)

    def _updates_with(self, flags: list[np.ndarray]) -> dict[str, int]:
        """In how many updates the flag of an object, or of a part of it, was set."""
        ids, rows = np.asarray(self._ids[1:]), np.asarray(flags, bool).reshape(len(flags), len(self._ids) - 1)
        return {self._name(v): int(rows[:, ids == v].any(axis=1).sum()) for v in sorted({*self._ids} - {0})}

    def trajectory(self) -> dict[str, np.ndarray]:
        """The place and turn of every group over time."""
        poses = np.stack(self.poses)
        return {
            "times": np.asarray(self.stamps),
            "centers": poses[..., :3],
            "quats": poses[..., 3:],
            "lost": np.stack(self.lost),
            "turn_known": np.stack(self.turn_known),
            "label_ids": np.asarray(self._ids[1:]),
            "latency_s": np.asarray(self.latencies),
            "update_s": np.asarray(self.seconds),
        }

    def metrics(self) -> dict[str, Any]:
        """What metrics.json holds of the stream."""
        span = self.times[-1] - self.times[0] if len(self.times) > 1 else None
        return {
            "frames": dict(self.counts),
            "hz": (len(self.times) - 1) / span if span else None,
            "latency_ms": _spread(self.latencies),
            "update_ms": _spread(self.seconds),
            "late": self.late,
            "skipped": self.skipped,
            "looked_for": float(np.mean(self.everywhere)) if self.everywhere else None,
            "budget": None if self.chosen is None else budget_metrics(self.chosen),
            "plans": len(self.plans),
            "memory_mb": {"first": self.memory_mb[0], "last": self.memory_mb[-1], "max": max(self.memory_mb)}
            if self.memory_mb
            else None,
            "objects": {str(v): self._name(v) for v in sorted({*self._ids} - {0})},
            "frames_lost": self._updates_with(self.lost),
            "frames_turn_unknown": self._updates_with([~known for known in self.turn_known]),
        }

    def _name(self, value: int) -> str:
        return self._names.get(value, f"object {value}")


def _spread(seconds: list[float]) -> dict[str, float] | None:
    """Median, 95th percentile and worst, milliseconds."""
    if not seconds:
        return None
    milliseconds = 1e3 * np.asarray(seconds)
    return {
        "median": float(np.median(milliseconds)),
        "p95": float(np.percentile(milliseconds, 95)),
        "worst": float(milliseconds.max()),
    }


def follow(options: Options, source: Source, log: Log, console: Console) -> BaseException | None:
    """Track until the stream ends; returns what ended it early, or None.

    Args:
        options: budget, patience and how long.
        source: where frames come from.
        log: keeps every update.
        console: shows how far it is.
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

    try:
        console.print(MEASURING)
        # Drawn between updates: a thread of its own would make some of them late.
        with Live(console=console, auto_refresh=False, transient=True) as shown:
            for now in track(source.scene, source.first, frames(), CONFIG, budget_ms=budget_ms):
                if not arrived:
                    continue
                log.add(now, arrived[0], budget_ms / 1e3)
                if len(log.times) % 15 == 0:
                    worst, counts = 1e3 * max(log.latencies), newest.counts
                    words = f"{counts.used} frames, {counts.dropped} dropped, {worst:.0f} ms at worst"
                    shown.update(words, refresh=True)
    except (KeyboardInterrupt, Exception) as stopped:
        return stopped
    finally:
        log.counts = vars(newest.counts)
    return None


def _print(found: dict[str, Any], folder: RunFolder) -> None:
    """The run in a few lines."""
    console = Console(highlight=False)
    frames, latency, memory = found["frames"], found["latency_ms"], found["memory_mb"]
    table = Table.grid(padding=(0, 3, 0, 0))
    table.add_row(
        "[bold]frames[/]", f"{frames['offered']} offered, {frames['used']} used, {frames['dropped']} dropped"
    )
    left_out = {"out of order": frames["out_of_order"], "cameras out of sync": frames["out_of_sync"]}
    for name, count in left_out.items():
        if count:
            table.add_row("", f"{count} left out, {name}")
    if latency:
        table.add_row("[bold]rate[/]", f"{found['hz']:.1f} Hz" if found["hz"] else "one update")
        spread = ", ".join(f"{name} {value:.0f} ms" for name, value in latency.items())
        table.add_row("[bold]latency[/]", f"from arrival to the new state: {spread}")
        table.add_row("[bold]late[/]", f"{found['late']} updates were over the budget")
    if found["skipped"]:
        words = f"{found['skipped']} updates came to nothing finite and were left out"
        table.add_row("[bold]skipped[/]", words)
    for title, key in (("lost", "frames_lost"), ("turn unknown", "frames_turn_unknown")):
        counts = {name: count for name, count in found[key].items() if count}
        if counts:
            words = ", ".join(f"{name} in {count} updates" for name, count in counts.items())
            table.add_row(f"[bold]{title}[/]", words)
    if found["budget"]:
        beyond = "" if found["budget"]["fits"] else ", the cheapest, which takes longer than the budget"
        table.add_row("[bold]settings[/]", found["budget"]["chosen"] + beyond)
    if memory:
        table.add_row(
            "[bold]memory[/]", f"{memory['first']:.0f} MB at first, {memory['last']:.0f} MB at last"
        )
    console.print(table)
    console.print(f"[bold]written[/] {folder.path}", soft_wrap=True)
