"""Our rasterizer's picture of a scene from any camera: compiled once per size, however the camera moves."""

import threading
from collections.abc import Callable
from functools import partial
from typing import Any, Literal, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float, UInt8

from gsjax.geometry.cameras import Camera
from gsjax.geometry.spherical_harmonics import rgb_to_sh0
from gsjax.scene.gaussians import Gaussians
from gsjax.scene.render import plan_render, render, with_room
from gsjax.viz.colors import colorize_depth, to_uint8

Shown = Literal["colour", "depth", "alpha", "label", "features"]

_ROOM = 1.25  # slots per Gaussian of a scene that outgrows the previous ones
_INVISIBLE = -40.0  # an opacity logit
_HEADROOM = 1.5  # of a plan over what its first camera needs: later cameras need about as much
_OPAQUE = 0.5  # pixels with less alpha have no depth


class Drawn(NamedTuple):
    """One picture.

    Attributes:
        colors: RGB over the background, 0 to 1.
        depths: expected depth; 0 where alpha is below one half.
        alphas: opacity of each pixel, 0 to 1.
    """

    colors: Float[np.ndarray, "height width 3"]
    depths: Float[np.ndarray, "height width"]
    alphas: Float[np.ndarray, "height width"]


class Drawer:
    """Draws scenes of one kind; thread-safe. A scene with fewer Gaussians than an earlier one is padded with
    invisible ones, because each new number of Gaussians takes seconds to compile.

    Args:
        background: RGB, 0 to 1.
        antialiased: whether to compensate opacities for the dilation of small splats.
        compiler_options: XLA options of the program that draws.
    """

    def __init__(
        self,
        background: tuple[float, float, float] = (0.0, 0.0, 0.0),
        antialiased: bool = False,
        compiler_options: dict[str, Any] | None = None,
    ):
        self._background = np.array([background], np.float32)
        self._mode = "antialiased" if antialiased else "classic"
        self._plans: dict[tuple[int, ...], dict[int, Any]] = {}
        self._lock = threading.Lock()
        self._program: Callable = jax.jit(_draw, compiler_options=compiler_options or {})

    def __call__(self, gaussians: Gaussians, camera: Camera) -> Drawn:
        """The picture of one camera [1]. A plan that is too small grows, and the larger one is kept.

        Raises:
            ValueError: no plan can hold what the camera sees.
        """
        kind, count = (camera.width, camera.height, gaussians.sh_degree), gaussians.num
        with self._lock:
            plans = self._plans.setdefault(kind, {})
            grown = int(_ROOM * count) if plans else count
            slots = min((known for known in plans if known >= count), default=grown)
            gaussians, plan = _padded(gaussians, slots), plans.get(slots)
            if plan is None:
                plan = plan_render(gaussians, camera, headroom=_HEADROOM, rasterize_mode=self._mode)
            draw = partial(self._program, gaussians, camera, self._background)
            drawn, plans[slots] = with_room(draw, plan, _HEADROOM)
            return jax.device_get(drawn)


def _padded(gaussians: Gaussians, slots: int) -> Gaussians:
    """The Gaussians padded to `slots` with invisible ones. On the host, so that nothing is compiled."""
    if slots == gaussians.num:
        return gaussians
    rows = np.minimum(np.arange(slots), gaussians.num - 1)
    more = jax.tree.map(lambda leaf: np.asarray(leaf)[rows], gaussians)
    more.logit_opacities[gaussians.num :] = _INVISIBLE
    return jax.tree.map(jnp.asarray, more)


def _draw(gaussians: Gaussians, camera: Camera, background: jax.Array, plan: Any) -> tuple[Drawn, Any]:
    drawn = render(gaussians, camera, plan, backgrounds=background)
    alphas = drawn.alphas[0]
    depths = jnp.where(alphas > _OPAQUE, drawn.depths[0], 0.0)
    return Drawn(drawn.colors[0], depths, alphas), drawn.meta._replace(features=None)


def recolored(gaussians: Gaussians, colors: Float[np.ndarray, "n 3"]) -> Gaussians:
    """The same Gaussians in other, view-independent colours (RGB, 0 to 1)."""
    sh0 = rgb_to_sh0(jnp.asarray(colors, gaussians.sh0.dtype))[:, None, :]
    return eqx.tree_at(lambda g: (g.sh0, g.shN), gaussians, (sh0, None), is_leaf=lambda leaf: leaf is None)


def picture_of(
    drawn: Drawn, shown: Shown, depths: tuple[float, float] | None
) -> UInt8[np.ndarray, "height width 3"]:
    """The requested channel as a picture; depth is scaled to `depths`, or to its own range if None."""
    if shown == "depth":
        return colorize_depth(drawn.depths, *(depths or (None, None)))
    if shown == "alpha":
        grey = np.round(255 * np.clip(drawn.alphas, 0, 1)).astype(np.uint8)
        return np.repeat(grey[..., None], 3, axis=-1)
    return to_uint8(drawn.colors)
