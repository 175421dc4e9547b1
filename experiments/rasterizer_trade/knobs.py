"""The knobs: what a value of config.yaml means to the rasterizer."""

from dataclasses import dataclass
from fractions import Fraction
from typing import Any

import numpy as np

from gsjax.rasterize.plan import Plan

PLAN_KNOBS = ("alpha_min", "min_transmittance", "max_per_tile", "tile_size", "sh_degree")


@dataclass(frozen=True)
class Variant:
    """One way to draw a scene; the defaults are exact."""

    options: tuple[tuple[str, Any], ...] = ()  # of the plan, by name
    shrink: int = 1  # the image is drawn this much smaller, and scaled up again
    dtype: str = "float32"  # of the colours
    region: Fraction = Fraction(1)  # share of the frame that is wanted, in its middle
    with_reads: bool = False

    @property
    def same_lists(self) -> bool:
        """Whether as many Gaussians enter as many tiles as by default: a plan's capacity is the same then."""
        other_lists = {"alpha_min", "tile_size", "rasterize_mode"} & {name for name, _ in self.options}
        return self.shrink == 1 and self.region == 1 and not other_lists


def variant_of(knob: str, value: Any) -> Variant:
    """Values as config.yaml writes them; a default is left out, so that it is the exact variant itself."""
    if knob in PLAN_KNOBS or knob == "antialiased":
        known = {"antialiased": "rasterize_mode"}.get(knob, knob)
        parsed = float(Fraction(value)) if isinstance(value, str) else value
        parsed = ("antialiased" if value else "classic") if knob == "antialiased" else parsed
        if knob == "sh_degree":
            return Variant(((known, parsed),))
        return Variant(() if parsed == getattr(Plan(1, 1, 0), known) else ((known, parsed),))
    if knob == "resolution":
        return Variant(shrink=int(1 / Fraction(value)))
    if knob == "colors":
        return Variant(dtype=value)
    if knob == "roi":
        return Variant(region=Fraction(value))
    assert knob == "reads", knob
    return Variant(with_reads=value)


def middle(region: Fraction, width: int, height: int) -> np.ndarray:
    """True in the middle of the frame, on that share of its pixels."""
    mask, edge = np.zeros((height, width), bool), float(region) ** 0.5
    rows, columns = (round(n * (1 - edge) / 2) for n in mask.shape)
    mask[rows : height - rows, columns : width - columns] = True
    return mask
