"""The size of photographs in a fit of given minutes, chosen by the measured pace of its steps."""

from rich.console import Console

from gsjax.engine.budget import Budget
from gsjax.engine.fit.costs import LEAST_STEPS, final_shrink
from gsjax.engine.messages import Notes
from gsjax.engine.progress import Progress
from gsjax.methods.fit import FitConfig

_COMPILING_S = 5.0
_COST_RATIO = 3.5  # cost of a step on photographs of twice the width and height; docs/choosing.md


class Sizes:
    """Maps the progress of a fit to the factor by which photographs are downscaled.

    As in a fit without minutes, a sixth of the time goes to photographs at a quarter of the final size, a
    third to those at half of it, and half to the final size. The final size is the largest that leaves time
    for 150 steps; it is first estimated from the usual cost of a step, then found from the measured pace.
    """

    def __init__(
        self,
        config: FitConfig,
        size: tuple[int, int],
        budget: Budget,
        progress: Progress,
        notes: Notes,
        console: Console,
    ):
        """
        Args:
            config: of the fit.
            size: width and height of the largest photograph, pixels.
            budget: the time that is left.
            progress: of the fit, with its pace.
            notes, console: to say what was chosen.
        """
        self._config, self._size, self._budget, self._progress = config, size, budget, progress
        self._notes, self._console = notes, console
        if progress.rows and not progress.shrink:  # of an older checkpoint
            progress.shrink = progress.rows[-1]["shrink"]
        self._resumed, coarse = bool(progress.shrink), config.coarse_until
        self._times = [t for t in (coarse / 3, coarse, (1 + coarse) / 2) if coarse]

    @property
    def now(self) -> int:
        """The current factor; 0 before the first step."""
        return self._progress.shrink

    def __call__(self, progress: float) -> int:
        if not self.now:
            self._progress.shrink = self._first()
        if self._resumed:  # earlier decisions are not made again
            self._times, self._resumed = [t for t in self._times if t > progress], False
        if self.now > 1 and self._times and progress >= self._times[0] and (pace := self._progress.pace):
            self._times.pop(0)
            last = not self._times
            left = int((self._budget.steps_s - _COMPILING_S) * pace / _COST_RATIO)
            if left >= LEAST_STEPS:
                self._progress.shrink //= 2
                self._progress.pace = 0.0  # unknown at the new size
            elif last:
                self._say(max(0, left))
        return self.now

    def _first(self) -> int:
        """The initial factor: four times that of the largest size for which there should be time."""
        if not self._times:
            return 1
        return 4 * final_shrink(self._config, self._size, self._budget.steps_s)

    def _say(self, left: int) -> None:
        width, height = self._size
        words = (
            f"photographs stay at {width // self.now}x{height // self.now}: of {2 * width // self.now}x"
            f"{2 * height // self.now} there would be time for {left} steps"
        )
        self._console.print(words, soft_wrap=True)
        self._notes.add(f"P{words[1:]}, and {LEAST_STEPS} are needed to gain by it (--minutes).")
