"""What a fit of given minutes can afford, by what steps cost."""

from collections.abc import Iterator
from dataclasses import replace

from gsjax.methods.fit import FitConfig

LEAST_STEPS = 150
"""Steps on photographs of a size, without which smaller ones give more."""
_STEP_S = (0.01, 2.5e-7, 7.5e-7)  # a step, and more for a pixel and a slot, on two cores of an AMD EPYC
_STEPS = 0.6  # of the minutes: steps, without reading, matching, compiling, scores and the report
_LEAST_SIDE = 32  # pixels
_SLOTS_A_STEP = 20  # docs/choosing.md
_LEAST_SLOTS, _MOST_SLOTS = 5_000, 1_000_000


def affordable(config: FitConfig, size: tuple[int, int], minutes: float) -> tuple[FitConfig, int]:
    """The settings with as many slots for Gaussians, and spherical harmonics of such a degree, as pay in
    these minutes; and how many steps there should be.

    Twenty slots a step are near the best of two scenes (docs/choosing.md). A degree pays if it is unlocked in
    the first half.

    Args:
        config: of a fit, with its default settings.
        size: width and height of the photographs, pixels.
        minutes: for the whole command.
    """
    slots, steps = next(
        (slots, steps)
        for slots in _fewer_and_fewer(_MOST_SLOTS)
        if (steps := _steps_within(60 * minutes * _STEPS, config, size, slots)) * _SLOTS_A_STEP >= slots
        or slots == _LEAST_SLOTS
    )
    start = replace(config.start, count=min(config.start.count, slots))
    degree = min(3, steps // (2 * config.sh_every))
    return replace(config, cap=slots, sh_degree=degree, start=start), steps


def last_shrink(config: FitConfig, size: tuple[int, int], seconds: float) -> int:
    """The factor by which photographs are downscaled at the end: that of the largest for which a fifth of the
    time should be enough for 150 steps.

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
    """Seconds of a step with a photograph of so many pixels and so many slots for Gaussians: a guess, for
    before any is measured."""
    constant, a_pixel, a_slot = _STEP_S
    return constant + a_pixel * pixels + a_slot * slots


def _steps_within(seconds: float, config: FitConfig, size: tuple[int, int], slots: int) -> int:
    """The steps of a fit that begins with smaller photographs."""
    last, coarse = last_shrink(config, size, seconds), config.coarse_until
    pixels = size[0] * size[1] / last**2
    stages = ((coarse / 3, 16), (2 * coarse / 3, 4), (1 - coarse, 1))
    return int(seconds * sum(share / step_seconds(pixels / fewer, slots) for share, fewer in stages))


def _fewer_and_fewer(slots: float) -> Iterator[int]:
    while slots > _LEAST_SLOTS:
        yield int(float(f"{slots:.2g}"))
        slots /= 1.25
    yield _LEAST_SLOTS
