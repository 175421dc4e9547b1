"""The frames of `gsjax parts`: followed, shown and saved, until all are found."""

from dataclasses import dataclass, field
from typing import Any

import numpy as np
from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn

from gsjax.data import Sequence
from gsjax.methods.motion_parts import Parts, PartsConfig, Start, follow


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
    called after each."""
    columns = (TextColumn("following parts"), BarColumn(), MofNCompleteColumn(), TimeRemainingColumn())
    words = TextColumn("{task.description}")
    if not console.is_terminal:
        console.print("following parts, frame by frame", soft_wrap=True)
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
                told = f"{_count(found.parts)} parts, loss {following.losses[-1][1]:.4f}"
                bar.update(task, completed=int(found.parts.done.sum()), description=told)
                save(following, last=False)
        except (KeyboardInterrupt, Exception) as stopped:
            following.stopped = stopped
        save(following, last=True)
    return following


def _count(parts: Parts) -> int:
    return int(np.asarray(parts.canonical.alive).sum()) - 1
