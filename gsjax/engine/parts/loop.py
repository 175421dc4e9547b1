"""The frames of `gsjax parts`: followed, shown and saved, until all are found."""

from dataclasses import dataclass, field
from typing import Any

import numpy as np
from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn

from gsjax.data import Sequence
from gsjax.engine.messages import Notes, counted, reason
from gsjax.methods.parts import Parts, PartsConfig, Start, follow, refine

_LINES = 10  # of a log, about the frames of a run


@dataclass
class Following:
    """What following gave so far.

    Attributes:
        parts: the state.
        update_s: seconds of each frame, compiling apart.
        losses: at the first and at the last steps of each frame.
        skipped: steps that changed nothing, because a number in them was not finite.
        joined: what became one: (part, into which).
        divided: what became two: (new part, of which).
        compile_s: seconds spent compiling, since it began or was resumed.
        stopped: what ended it early, or None.
    """

    parts: Parts
    update_s: list[float] = field(default_factory=list)
    losses: list[tuple[float, float]] = field(default_factory=list)
    skipped: int = 0
    joined: list[tuple[int, int]] = field(default_factory=list)
    divided: list[tuple[int, int]] = field(default_factory=list)
    compile_s: float = 0.0
    stopped: BaseException | None = None


def follow_parts(
    views: Sequence, start: Start, following: Following, config: PartsConfig, save: Any, console: Console
) -> Following:
    """Go on from what there is until all frames are found, Ctrl-C or an error; `save(following, last=...)` is
    called after each.

    Args:
        views: the cameras that are looked through.
        start: the canonical scene and what may move.
        following: how far it is.
        config: how parts are followed.
        save: as above.
        console: shows how far it is.
    """
    columns = (TextColumn("following parts"), BarColumn(), MofNCompleteColumn(), TimeRemainingColumn())
    words = TextColumn("{task.description}")
    if not console.is_terminal:
        console.print(
            "following parts; compiling, which takes a minute or two the first time", soft_wrap=True
        )
    with Progress(*columns, words, console=console, transient=True, disable=not console.is_terminal) as bar:
        task = bar.add_task("", total=len(following.parts.done))
        bar.update(task, completed=int(following.parts.done.sum()), description="compiling")
        try:
            frames = follow(views, start, following.parts, config)
            for found in frames:
                following.parts = found.parts
                following.update_s.append(found.seconds)
                following.compile_s += found.compile_seconds
                few = max(1, len(found.losses) // 8)
                following.losses.append((float(found.losses[:few].mean()), float(found.losses[-few:].mean())))
                following.skipped += found.skipped
                following.joined += found.joined
                following.divided += found.divided
                told = f"{counted(_count(found.parts), 'part')}, loss {following.losses[-1][1]:.4f}"
                done, asked = int(found.parts.done.sum()), len(found.parts.done)
                bar.update(task, completed=done, description=told)
                if not console.is_terminal and _LINES * done // asked > _LINES * (done - 1) // asked:
                    console.print(f"{done} of {asked} frames: {told}", soft_wrap=True)
                save(following, last=False)
        except (KeyboardInterrupt, Exception) as stopped:
            following.stopped = stopped
        save(following, last=True)
    return following


def refine_parts(
    views: Sequence, parts: Parts, following: Following, config: PartsConfig, notes: Notes, console: Console
) -> Parts:
    """Parts with the scene and all poses fitted to all frames, as far as it came where it was stopped.
    `following` is told of Ctrl-C.

    Args:
        views: the cameras that are looked through.
        parts: as they were followed.
        following: how that went.
        config: how parts are refined.
        notes: told of what was left out.
        console: shows how far it is.
    """
    done, skipped, steps = 0, [], config.refine.iterations
    columns = (TextColumn("refining the scene over all frames"), BarColumn(), MofNCompleteColumn())
    if steps and not console.is_terminal:
        console.print("refining the scene over all frames", soft_wrap=True)
    with Progress(*columns, console=console, transient=True, disable=not console.is_terminal) as bar:
        task = bar.add_task("", total=steps)
        try:
            for refined in refine(views, parts, config):
                parts, done = refined.parts, done + 1
                skipped.append(refined.skipped)
                bar.update(task, completed=done)
        except (KeyboardInterrupt, OSError) as stopped:
            notes.warn(
                f"the scene was refined by {done} of {steps} steps, and then stopped by {reason(stopped)}"
            )
            following.stopped = stopped if isinstance(stopped, KeyboardInterrupt) else None
    if lost := int(np.sum(skipped)):
        notes.warn(f"{lost} of {done} steps that refine the scene changed nothing: numbers were not finite")
    return parts


def _count(parts: Parts) -> int:
    return int(np.asarray(parts.canonical.alive).sum()) - 1
