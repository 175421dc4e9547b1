"""A time budget for updates, and what to omit to meet it.

Before the first frame, the richest settings whose measured cost fits are chosen from a ladder. Then, from
frame to frame, a `Governor` decides how many groups may be searched for everywhere, a number that can vary
without recompilation. Delays are compensated by the updates that follow.
"""

from collections.abc import Callable
from dataclasses import fields, is_dataclass, replace
from typing import Any, NamedTuple

from gsjax.methods.track.config import PRESETS, TrackConfig

_FIRST = "fast"  # the rung that is measured first
_RICHER = 2.0  # a richer rung costs at least this many times as much (docs/results-tracking.md)
_USED = 0.9  # fraction of the budget that is planned; the rest is a reserve
_MAX_DEBT = 5.0  # largest delay to be compensated, in budgets, in case the machine was suspended
_NEW_WEIGHT = 0.1  # weight of an update in the running estimate of the cost


class Costs(NamedTuple):
    """Cost of an update, in seconds."""

    base: float  # without any search everywhere
    search: float  # for each group that is searched for everywhere


class Chosen(NamedTuple):
    """A rung of the ladder chosen for a budget, and the measurements that led to it."""

    name: str
    config: TrackConfig
    costs: Costs
    tried: dict[str, Costs]  # of every rung that was measured, by name
    fits: bool  # False if even the cheapest rung exceeds the budget


_KEPT = ("start", "grow.slots", "headroom", "seed")


def ladder(config: TrackConfig, num_cameras: int) -> dict[str, TrackConfig]:
    """Settings by name, from the richest to the cheapest, for this number of cameras. All have `start`,
    `grow.slots`, `headroom` and `seed` of `config`: how a scene starts, how much may join it, the room in
    plans, and the seed."""

    def rung(preset: TrackConfig) -> TrackConfig:
        grow = replace(preset.grow, slots=config.grow.slots)
        return replace(preset, start=config.start, grow=grow, headroom=config.headroom, seed=config.seed)

    rungs = {name: rung(PRESETS[name]) for name in ("accurate", "balanced", "fast")}
    small = replace(rungs["fast"], shrink=2)
    rungs["fast, half the resolution"] = small
    for count in range(num_cameras - 1, 0, -1):
        cameras = "1 camera" if count == 1 else f"{count} cameras"
        rungs[f"fast, half the resolution, {cameras}"] = replace(small, cameras=tuple(range(count)))
    return rungs


def unused_settings(config: TrackConfig) -> list[str]:
    """Names of settings that are not the default and that no rung of `ladder` adopts."""
    mine, usual = _flat(config), _flat(TrackConfig())
    differ = [name for name in mine if mine[name] != usual[name]]
    return [name for name in differ if name not in _KEPT and name.partition(".")[0] not in _KEPT]


def _flat(settings: Any, prefix: str = "") -> dict[str, Any]:
    """Nested settings by their dotted names."""
    found = {}
    for one in fields(settings):
        value, name = getattr(settings, one.name), f"{prefix}{one.name}"
        found |= _flat(value, f"{name}.") if is_dataclass(value) else {name: value}
    return found


def first_rung(config: TrackConfig, num_cameras: int) -> TrackConfig:
    """The settings that `choose` measures first."""
    return ladder(config, num_cameras)[_FIRST]


def choose(
    rungs: dict[str, TrackConfig], measure: Callable[[TrackConfig], Costs], budget: float, num_groups: int
) -> Chosen:
    """The richest rung that leaves time to search for one group everywhere.

    Args:
        rungs: from `ladder`. Each measurement compiles an update, so the choice starts at `first_rung`, and a
            richer rung is tried only if twice the time of the one below, with a search for all groups, fits.
        measure: settings -> measured costs.
        budget: seconds per update.
        num_groups: number of groups.
    """
    names, tried = list(rungs), {}

    def cost(name: str, groups: int) -> float:
        if name not in tried:
            tried[name] = measure(rungs[name])
        return tried[name].base + groups * tried[name].search

    at = names.index(_FIRST)
    while at > 0 and _RICHER * cost(names[at], num_groups) <= _USED * budget:
        at -= 1
    while cost(names[at], 1) > _USED * budget and at + 1 < len(names):
        at += 1
    fits = cost(names[at], 1) <= budget
    name = names[at] if fits else min(tried, key=lambda name: tried[name].base)
    return Chosen(name, rungs[name], tried[name], tried, fits)


class Governor:
    """Decides how many groups each update may search for everywhere.

    Args:
        budget: seconds per update.
        costs: measured costs.
        most: number of groups.
    """

    def __init__(self, budget: float, costs: Costs, most: int):
        self._budget, self._costs, self._most, self._debt = budget, costs, most, 0.0

    def allowed(self) -> int:
        """The number of groups for the next update."""
        left = _USED * self._budget - self._debt - self._costs.base
        return int(min(max(left / max(self._costs.search, 1e-6), 0), self._most))

    def spent(self, seconds: float, searched: int) -> None:
        """Record the duration of an update, and how many groups it searched for."""
        owed = self._debt + seconds - self._budget
        self._debt = min(max(owed, 0.0), _MAX_DEBT * self._budget)
        error = seconds - searched * self._costs.search - self._costs.base
        self._costs = self._costs._replace(base=self._costs.base + _NEW_WEIGHT * error)
