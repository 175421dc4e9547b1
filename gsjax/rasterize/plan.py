"""Plans: the static part of a rasterization. Image size, options and capacities; never values of a scene.

The idea is that of jax-md's neighbour lists: shapes are fixed in advance with some headroom, the device
reports what it needed, and the host re-plans if the capacity was too small. Capacities are rungs of a single
geometric ladder, so that a growing scene compiles only a few variants, and re-planning on a known rung
compiles nothing.
"""

import dataclasses
import math
from collections.abc import Callable
from numbers import Real
from typing import Any, NamedTuple, TypeVar

import jax
from jaxtyping import Array, Int

_LADDER_START, _LADDER_RATIO = 4096, math.sqrt(2.0)

RENDER_MODES = ("RGB", "D", "ED", "RGB+D", "RGB+ED")
RASTERIZE_MODES = ("classic", "antialiased")
DERIVATIVES = ("reverse", "forward")
TILE_SIZES = (4, 8, 16, 32)
SORTS = ("host", "device")
FEW_CHANNELS = 8  # up to this many, multiply-adds are cheaper than many tiny matmuls
_BATCH_PIXELS = {"cpu": 2048, "gpu": 16384}
"""Pixels composited together. A batch ends with its longest list, so small batches wait less; a GPU needs
large ones to stay busy."""
_LEAST_PIXELS = 512  # per batch, even with many channels: tiny matmuls take a third longer on a CPU


class Limits(NamedTuple):
    """Thresholds where compositing starts, saturates and ends; defaults as in Kerbl et al. 2023."""

    alpha_min: float = 1 / 255
    alpha_max: float = 0.99
    min_transmittance: float = 1e-4


DEFAULT_LIMITS = Limits()


@jax.tree_util.register_static
@dataclasses.dataclass(frozen=True)
class Plan:
    """Options and capacities for one kind of call. Frozen, hashable, and a pytree without leaves.

    Attributes:
        width, height: image size in pixels.
        capacity: largest number of Gaussian-tile pairs of one camera, and twice the largest number of tile
            rows that its Gaussians may cross.
        near_plane, far_plane: depths between which Gaussians are drawn, metres.
        eps2d: variance added to projected Gaussians, square pixels.
        sh_degree: None if colours are values, else the degree up to which their coefficients are used.
        render_mode: RGB, D (accumulated depth), ED (expected depth), RGB+D, RGB+ED.
        rasterize_mode: classic, or antialiased (opacity compensated for the dilation of small splats).
        derivative: "reverse" for the hand-written VJP, "forward" for jvp, linearize and Gauss-Newton.
        alpha_min: fainter contributions are skipped.
        alpha_max: where a single contribution saturates.
        min_transmittance: a pixel ends before the Gaussian that would reduce its transmittance to this.
        max_per_tile: most Gaussians drawn per tile, nearest first; None for all. With a number the image is
            an approximation, and omitted Gaussians get no gradient.
        tile_size: edge of a tile, pixels. Small tiles have fewer pixel pairs, large ones shorter lists.
        tiles_per_batch: tiles composited together (default: 2048 pixels, 16384 on a GPU); affects only speed.
        sort: "host" for numpy's sort where XLA runs on the CPU, "device" for XLA's own; affects only speed.
    """

    width: int
    height: int
    capacity: int
    near_plane: float = 0.01
    far_plane: float = 1e10
    eps2d: float = 0.3
    sh_degree: int | None = None
    render_mode: str = "RGB"
    rasterize_mode: str = "classic"
    derivative: str = "reverse"
    alpha_min: float = DEFAULT_LIMITS.alpha_min
    alpha_max: float = DEFAULT_LIMITS.alpha_max
    min_transmittance: float = DEFAULT_LIMITS.min_transmittance
    max_per_tile: int | None = None
    tile_size: int = 8
    tiles_per_batch: int | None = None
    sort: str = "host"

    def __post_init__(self):
        for name, allowed in (
            ("render_mode", RENDER_MODES),
            ("rasterize_mode", RASTERIZE_MODES),
            ("derivative", DERIVATIVES),
            ("sh_degree", (None, 0, 1, 2, 3)),
            ("tile_size", TILE_SIZES),
            ("sort", SORTS),
        ):
            value = getattr(self, name)
            if type(value) not in map(type, allowed) or value not in allowed:  # True equals 1, and 8.0 is 8
                raise ValueError(f"{name} must be one of {', '.join(map(repr, allowed))}; got {value!r}")
        for name in ("width", "height", "tiles_per_batch", "max_per_tile"):
            value = getattr(self, name)
            if value is None and name in ("tiles_per_batch", "max_per_tile"):
                continue
            if not isinstance(value, int) or isinstance(value, bool) or value < 1:
                raise ValueError(f"{name} must be a positive Python int (it is static); got {value!r}")
        if not isinstance(self.capacity, int) or (self.capacity < 2 and self.capacity != 0):
            raise ValueError(
                f"capacity must be a Python int of 2 or more, or 0 if it is yet to be planned; "
                f"got {self.capacity!r}"
            )
        for name in ("near_plane", "far_plane", "eps2d", *Limits._fields):
            value = getattr(self, name)
            if not isinstance(value, Real):
                raise ValueError(f"{name} must be a Python number (it is static); got {value!r}")
        if not 0 <= self.near_plane < self.far_plane:
            raise ValueError(
                f"near_plane {self.near_plane} must be 0 or more, and below far_plane {self.far_plane}"
            )
        for name in Limits._fields:
            if not 0 < getattr(self, name) < 1:
                raise ValueError(f"{name} must be above 0 and below 1; got {getattr(self, name)}")
        if not self.alpha_min < self.alpha_max:
            raise ValueError(f"alpha_min {self.alpha_min} must be below alpha_max {self.alpha_max}")
        if not self.eps2d >= 0:
            raise ValueError(f"eps2d must be 0 or more; got {self.eps2d}")

    @property
    def tiles_x(self) -> int:
        """Number of tiles per row; the last one may extend beyond the image."""
        return -(-self.width // self.tile_size)

    @property
    def tiles_y(self) -> int:
        """Number of tiles per column; the last one may extend beyond the image."""
        return -(-self.height // self.tile_size)

    @property
    def num_tiles(self) -> int:
        """Number of tiles of one image."""
        return self.tiles_x * self.tiles_y

    @property
    def limits(self) -> Limits:
        """The three thresholds of compositing."""
        return Limits(self.alpha_min, self.alpha_max, self.min_transmittance)

    @property
    def tile_pixels(self) -> int:
        """Number of pixels of one tile."""
        return self.tile_size * self.tile_size

    def batch_size(self, channels: int) -> int:
        """Tiles composited together: `tiles_per_batch` if set, else a number that falls with the channels."""
        pixels = _BATCH_PIXELS["cpu" if jax.default_backend() == "cpu" else "gpu"]
        pixels = max(_LEAST_PIXELS, FEW_CHANNELS * pixels // max(channels, FEW_CHANNELS))
        return self.tiles_per_batch or max(1, pixels // self.tile_pixels)

    def grown(self, needed: int | Int[Array, ""], headroom: float = 1.0) -> "Plan":
        """The same plan on the lowest rung that holds `needed` pairs times `headroom`, never below this one.

        Raises:
            ValueError: `needed` is negative, or 2^31 - 1, which stands for more than can be counted; or
                `headroom` is below 1, with which re-planning would never end.
        """
        if not isinstance(headroom, Real) or not headroom >= 1:
            raise ValueError(f"headroom must be 1 or more, so that what is needed fits; got {headroom!r}")
        needed = int(needed)
        if needed < 0:
            raise ValueError(f"needed must be 0 or more, as meta.needed is; got {needed}")
        if needed >= 2**31 - 1:
            raise ValueError(
                f"these Gaussians touch more than 2^30 tiles of a {self.width}x{self.height} image; "
                "prune the ones that fill the frame, or draw fewer at a time"
            )
        return dataclasses.replace(self, capacity=max(self.capacity, rung(needed * headroom)))


HEADROOM = 1.3
"""Capacity of a plan as a multiple of what is needed; `parts` and `track` have `config.headroom`, the viewer
has its own value, and `gsjax.plan` and `plan_render` an argument."""

Drawn = TypeVar("Drawn")


def with_room(
    draw: Callable[[Plan], tuple[Drawn, Any]], plan: Plan, headroom: float = HEADROOM
) -> tuple[Drawn, Plan]:
    """The result of `draw(plan)`, with the plan grown until nothing overflows, and that plan. For loops on
    the host.

    Args:
        draw: plan -> (result, meta), whose `overflow` and `needed` are those of a rasterization.
        plan: the plan to begin with.
        headroom: capacity of a grown plan as a multiple of what was needed, 1 or more.
    """
    while True:
        drawn, meta = draw(plan)
        if not bool(meta.overflow.any()):
            return drawn, plan
        plan = plan.grown(int(meta.needed.max()), headroom)


def rung(pairs: float) -> int:
    """The smallest capacity on the ladder that holds `pairs`."""
    capacity, steps = _LADDER_START, 0
    while capacity < pairs:
        steps += 1
        capacity = math.ceil(_LADDER_START * _LADDER_RATIO**steps / 16) * 16
    return capacity


class _Unset:
    """Stands for "not given", so that an explicit option can be distinguished from a plan's own."""

    def __repr__(self):
        return "UNSET"


UNSET: Any = _Unset()

_SIZES = ("width", "height", "capacity")
OPTION_NAMES = tuple(f.name for f in dataclasses.fields(Plan) if f.name not in _SIZES)


def resolve(plan: Plan | None, width: int, height: int, options: dict[str, Any]) -> Plan:
    """The plan that a call runs under; without one, a plan with the given options whose capacity is still 0.

    Args:
        plan: the caller's plan, or None.
        width, height: image size in pixels.
        options: options by name; those that are UNSET come from the plan, or else are the defaults.

    Raises:
        ValueError: an explicit option contradicts the plan, or `plan` is not a Plan.
    """
    if not isinstance(plan, Plan | None):
        raise ValueError(f"plan must be a gsjax.Plan, from gsjax.plan(...); got {type(plan).__name__}")
    given = {name: value for name, value in options.items() if value is not UNSET}
    if plan is None:
        return Plan(width=width, height=height, capacity=0, **given)
    for name, value in {"width": width, "height": height, **given}.items():
        if getattr(plan, name) != value:
            raise ValueError(
                f"{name}={value!r} contradicts the plan, which was made with {name}={getattr(plan, name)!r}; "
                "leave the option out, or make another plan with gsjax.plan(...)"
            )
    return plan
