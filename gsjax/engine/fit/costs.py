"""What a fit can afford within given minutes, from an estimate of the cost of a step."""

from collections.abc import Iterator
from dataclasses import replace

from gsjax.methods.fit import FitConfig

LEAST_STEPS = 150
"""Fewest steps that make photographs of a size worthwhile; with fewer, smaller photographs give more."""
_STEP_S = (0.01, 2.5e-7, 7.5e-7)  # of a step, plus per pixel and per slot; two cores of an AMD EPYC
_STEPS = 0.6  # share of the minutes for steps: not reading, matching, compiling, scores and the report
_LEAST_SIDE = 32  # pixels
_SLOTS_PER_STEP = 20  # docs/choosing.md
_LEAST_SLOTS, _MOST_SLOTS = 5_000, 1_000_000


def settings_within(config: FitConfig, size: tuple[int, int], minutes: float) -> tuple[FitConfig, int]:
    """Returns the settings with the number of slots for Gaussians and the SH degree that pay off in these
    minutes, and the number of steps to expect.

    Twenty slots per step are close to the best for two scenes (docs/choosing.md). A degree pays off if it is
    unlocked in the first half of the steps.

    Args:
        config: of a fit, with its default settings.
        size: width and height of the photographs, pixels.
        minutes: for the whole command.
    """
    slots, steps = next(
        (slots, steps)
        for slots in _slot_counts(_MOST_SLOTS)
        if (steps := _steps_within(60 * minutes * _STEPS, config, size, slots)) * _SLOTS_PER_STEP >= slots
        or slots == _LEAST_SLOTS
    )
    start = replace(config.start, count=min(config.start.count, slots))
    degree = min(3, steps // (2 * config.sh_every))
    return replace(config, cap=slots, sh_degree=degree, start=start), steps


def final_shrink(config: FitConfig, size: tuple[int, int], seconds: float) -> int:
    """The factor by which photographs are downscaled at the end of a fit: the smallest with which a fifth of
    the time should suffice for 150 steps.

    Args:
        config: of a fit.
        size: width and height of the photographs, pixels.
        seconds: for steps.
    """
    width, height = size
    factor = 1
    while (
        step_seconds(width * height / factor**2, config.start.count) * LEAST_STEPS > seconds / 5
        and min(size) >= 8 * factor * _LEAST_SIDE
    ):
        factor *= 2
    return factor


def step_seconds(pixels: float, slots: int) -> float:
    """Estimates the seconds of a step from the pixels of its photograph and the slots for Gaussians; used
    until steps have been timed."""
    constant, a_pixel, a_slot = _STEP_S
    return constant + a_pixel * pixels + a_slot * slots


def _steps_within(seconds: float, config: FitConfig, size: tuple[int, int], slots: int) -> int:
    """The number of steps of a fit that begins with smaller photographs."""
    last, coarse = final_shrink(config, size, seconds), config.coarse_until
    pixels = size[0] * size[1] / last**2
    stages = ((coarse / 3, 16), (2 * coarse / 3, 4), (1 - coarse, 1))
    return int(seconds * sum(share / step_seconds(pixels / fewer, slots) for share, fewer in stages))


def _slot_counts(slots: float) -> Iterator[int]:
    while slots > _LEAST_SLOTS:
        yield int(float(f"{slots:.2g}"))
        slots /= 1.25
    yield _LEAST_SLOTS
