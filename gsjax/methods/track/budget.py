"""A time budget for updates: what is left out so that each one is done in time.

Once, before the first frame, the richest settings whose measured cost fits are chosen from a ladder. Then,
from frame to frame, a `Governor` decides how many groups may be looked for everywhere, which a compiled
update can vary. Updates that were late are paid back by those that follow.
"""

from collections.abc import Callable
from dataclasses import replace
from typing import NamedTuple

from gsjax.methods.track.config import PRESETS, TrackConfig

_USED = 0.9  # share of the budget that is planned with; the rest is for what no measurement foresaw
_MOST_OWED = 5.0  # budgets of debt that are remembered: a machine that slept starts afresh
_LEARNING = 0.1  # weight of an update in the running estimate of what one costs


class Costs(NamedTuple):
    """Cost of an update, in seconds."""

    base: float  # without looking for anything everywhere
    search: float  # for each group that is looked for everywhere


class Chosen(NamedTuple):
    """Settings for a budget, and what was measured on the way to them.

    Attributes:
        name: the rung of the ladder.
        config: its settings.
        costs: what its updates cost.
        tried: the costs of every rung that was measured, by name.
        fits: False where even the cheapest rung costs more than the budget.
    """

    name: str
    config: TrackConfig
    costs: Costs
    tried: dict[str, Costs]
    fits: bool


def ladder(config: TrackConfig, num_cameras: int) -> dict[str, TrackConfig]:
    """Settings from the richest to the cheapest; how a scene starts, and how much may join it, is as in
    `config` always."""

    def rung(preset: TrackConfig) -> TrackConfig:
        grow = replace(preset.grow, slots=config.grow.slots)
        return replace(preset, start=config.start, headroom=config.headroom, seed=config.seed, grow=grow)

    rungs = {name: rung(PRESETS[name]) for name in ("accurate", "balanced", "fast")}
    small = replace(rungs["fast"], shrink=2)
    rungs["fast, half the resolution"] = small
    for count in range(num_cameras - 1, 0, -1):
        cameras = "1 camera" if count == 1 else f"{count} cameras"
        rungs[f"fast, half the resolution, {cameras}"] = replace(small, cameras=tuple(range(count)))
    return rungs


def choose(
    rungs: dict[str, TrackConfig], measure: Callable[[TrackConfig], Costs], budget: float, num_groups: int
) -> Chosen:
    """The richest rung that leaves time to look for a group, or for all where the rung above fits too.

    Args:
        rungs: from `ladder`. The search begins at "fast": each measurement compiles an update.
        measure: what updates cost with these settings.
        budget: seconds.
        num_groups: groups that may be looked for.
    """
    names, tried = list(rungs), {}

    def cost(name: str, groups: int) -> float:
        if name not in tried:
            tried[name] = measure(rungs[name])
        return tried[name].base + groups * tried[name].search

    at = names.index("fast")
    while at > 0 and cost(names[at], num_groups) <= _USED * budget:
        at -= 1
    while cost(names[at], 1) > _USED * budget and at + 1 < len(names):
        at += 1
    fits = cost(names[at], 1) <= budget
    name = names[at] if fits else min(tried, key=lambda name: tried[name].base)
    return Chosen(name, rungs[name], tried[name], tried, fits)


class Governor:
    """How many groups each update may look for everywhere.

    Args:
        budget: seconds an update may take.
        costs: what was measured.
        most: groups there are.
    """

    def __init__(self, budget: float, costs: Costs, most: int):
        self._budget, self._costs, self._most, self._debt = budget, costs, most, 0.0

    def allowed(self) -> int:
        """The number for the next update."""
        left = _USED * self._budget - self._debt - self._costs.base
        return int(min(max(left / max(self._costs.search, 1e-6), 0), self._most))

    def spent(self, seconds: float, searched: int) -> None:
        """Record what an update took, and how many groups it looked for."""
        owed = self._debt + seconds - self._budget
        self._debt = min(max(owed, 0.0), _MOST_OWED * self._budget)
        error = seconds - searched * self._costs.search - self._costs.base
        self._costs = self._costs._replace(base=self._costs.base + _LEARNING * error)
