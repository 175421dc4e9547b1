"""What follows the steps of a fit, as far as time allows: pruning, scores, an ablation, and a video."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from functools import partial
from time import perf_counter
from typing import Any, TypeVar

import numpy as np
from jaxtyping import Float
from rich.console import Console

from gsjax.engine.budget import REPORT_S, Budget, note_if_few
from gsjax.engine.fit.ablation import ablate
from gsjax.engine.fit.judge import Judge, Scores
from gsjax.engine.fit.orbit import FRAMES, write_orbit
from gsjax.engine.folder import RunFolder
from gsjax.engine.messages import Notes, reason, stage
from gsjax.engine.progress import Progress
from gsjax.methods.fit import FitConfig, prune
from gsjax.scene.frame import Frame
from gsjax.scene.gaussians import Gaussians

T = TypeVar("T")
MAX_JUDGED = 4
"""Most held-out views that are evaluated during the fit."""
_COMPILING_S, _SCORING_S = 6.0, 1.5  # before the first view
_PIXEL_S = 1e-6  # for SSIM and a picture, beside rendering
_SLACK = 1.1
_PRUNING_VIEWS = 3.0  # times that of rendering a view, as gradients are computed
_ABLATING = "ablating parts of the scene"
_PARTS = 8  # of a scene, at most


@dataclass
class Ending:
    """The stages after the last step. An error or Ctrl-C ends only the current one; the run still gets its
    report.

    Attributes:
        judge: scores views.
        fitted: the photographs of the fit.
        judged: the held-out photographs, by name.
        progress: of the fit.
        budget: the time that is left.
        console, notes: for messages.
        seconds: of each stage, by name.
    """

    judge: Judge
    fitted: Sequence[Frame]
    judged: Sequence[tuple[str, Frame]]
    progress: Progress
    budget: Budget
    console: Console
    notes: Notes
    seconds: dict[str, float] = field(default_factory=dict)
    _left_out: list[str] = field(default_factory=list)

    def expected_s(self) -> dict[str, float]:
        """Seconds that each stage should take, estimated from those of a view; infinite until a view or a
        step has been timed."""
        view, pace = self.judge.view_s, self.progress.pace
        if not np.isfinite(view) and pace:
            view = 0.5 / pace
        pixels = sum(frame.cameras.width * frame.cameras.height for _, frame in self.judged)
        return {
            "pruning": _COMPILING_S + _PRUNING_VIEWS * view * len(self.fitted),
            "scores": _SCORING_S + view * max(1, len(self.judged)) + _PIXEL_S * pixels,
            "parts": _PARTS * view * len(judged_subset(self.judged)),
            "video": _COMPILING_S + view * FRAMES,
        }

    def rest_s(self, most: float) -> float:
        """Seconds to keep for the report and for the stages that fit into `most`, most valuable first."""
        kept, expected = REPORT_S, self.expected_s()
        if np.isfinite(self.judge.view_s):  # the last steps are evaluated too
            kept += self.judge.view_s * len(judged_subset(self.judged))
        certain = kept
        for name in ("scores", "pruning", "parts", "video"):
            if _SLACK * (kept + expected[name]) > most:
                break
            kept += expected[name]
        return min(most, _SLACK * kept) if kept > certain else most

    def pruned(
        self, gaussians: Gaussians, frames: Sequence[Frame], config: FitConfig
    ) -> tuple[Gaussians, Float[np.ndarray, "n"] | None]:
        """The `gaussians` that at least one of the `frames` needs, and the light of each, or None if pruning
        was left out; `config.prune` is the share of light that may be lost."""
        keep = self.expected_s()["scores"] + REPORT_S

        def work() -> tuple[Gaussians, Float[np.ndarray, "n"]]:
            kept, light = prune(gaussians, self.budget.guarded(frames, keep), config)
            if kept.num < gaussians.num:
                self.notes.add(
                    f"{gaussians.num - kept.num:,} of {gaussians.num:,} Gaussians were removed at the end: "
                    f"together they gave at most {config.prune:.2%} of the light of any photograph."
                )
            return kept, light

        words = "removing Gaussians that no photograph needs"
        return self._if_time("pruning", words, work, (gaussians, None), keep)

    def scored(self, gaussians: Gaussians, otherwise: tuple[str, Frame], folder: RunFolder) -> Scores:
        """The scores of `gaussians` in held-out photographs, or in `otherwise` if there are none; pictures go
        into `folder`."""
        which = self.budget.affordable(self.judged or [otherwise])
        work = partial(self.judge, gaussians, which, folder)
        scores = self._stage("scores", "scoring held-out photographs", work, Scores([]))
        note_if_few(scores.rows, self.judged, "held-out photographs", self.notes)
        return scores

    def ablated(self, gaussians: Gaussians, light: Float[np.ndarray, "n"] | None) -> list[dict[str, Any]]:
        """The scores of parts of the scene, as `ablate` gives them."""
        if light is None and self.judged and "pruning" not in self.seconds and not self.budget.hurried:
            self._left_out.append(_ABLATING)
        if not self.judged or light is None or not len(light):
            return []
        work = partial(ablate, gaussians, light, judged_subset(self.judged), self.progress.rows, self.judge)
        return self._if_time("parts", _ABLATING, work, [])

    def filmed(
        self, gaussians: Gaussians, frames: Sequence[Frame], focus: Float[np.ndarray, "3"], folder: RunFolder
    ) -> None:
        """Write a video of `gaussians` into `folder`, on a path around `focus` between the cameras of
        `frames`, and note which stages were left out."""
        camera = self.fitted[len(self.fitted) // 2].cameras
        viewmats = np.concatenate([frame.cameras.viewmat for frame in frames])
        work = partial(write_orbit, folder, camera, viewmats, focus, gaussians, self.judge)
        self._if_time("video", "drawing a video of the scene", work, None)
        if self._left_out:
            self.notes.add(f"Left out, as --minutes left no time for it: {', '.join(self._left_out)}.")

    def _if_time(
        self, name: str, words: str, work: Callable[[], T], otherwise: T, keep: float = REPORT_S
    ) -> T:
        """The result of a stage, or `otherwise` if there is no time for it or the run was stopped early."""
        if self.budget.allows(self.expected_s()[name], keep):
            return self._stage(name, words, work, otherwise)
        if not self.budget.hurried:
            self._left_out.append(words)
        return otherwise

    def _stage(self, name: str, words: str, work: Callable[[], T], otherwise: T) -> T:
        begun, found = perf_counter(), otherwise
        try:
            with stage(self.console, words):
                found = work()
        except (KeyboardInterrupt, OSError, ValueError) as error:
            self.notes.warn(f"{words} was left out: {reason(error)}")
        self.seconds[name] = perf_counter() - begun
        return found


def judged_subset(judged: Sequence[tuple[str, Frame]]) -> Sequence[tuple[str, Frame]]:
    """The held-out views that are evaluated during the fit; at its end, all of them are."""
    return judged[:: max(1, len(judged) // MAX_JUDGED)][:MAX_JUDGED]
