"""User-defined losses, in addition to those of a method.

A method that takes `extra_losses` adds them to its own and trains on the gradient of the sum:

    def above_the_table(scene, rendered, frame):
        return 10.0 * jnp.sum(jnp.minimum(scene.gaussians.means[:, 2], 0.0) ** 2)

    gsjax.track(scene, first, frames, config, extra_losses=(above_the_table,))

The weight of a loss is a factor inside it. Without extra losses, a method's program is unchanged.
"""

import hashlib
from collections.abc import Callable, Hashable, Iterator
from functools import partial
from inspect import getclosurevars
from types import FunctionType
from typing import Any, Protocol, runtime_checkable

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from gsjax.scene.frame import Frame
from gsjax.scene.render import Rendered


@runtime_checkable
class ExtraLoss(Protocol):
    """A pure, differentiable function of the scene, its rendering, and the observed frame."""

    def __call__(self, scene: Any, rendered: Rendered, frame: Frame) -> Float[Array, ""]:
        """A scalar to be minimised.

        Args:
            scene: the method's scene, with `scene.gaussians` [N] as they were drawn; see the method for its
                other fields.
            rendered: colours, depths and alphas of C cameras; [C,H,W] and channels.
            frame: what these cameras saw: images [C,H,W,3], 0 to 1, and depths [C,H,W], metres, 0 where
                unknown, or None.
        """
        ...


ExtraLosses = tuple[ExtraLoss, ...]
"""A tuple, because it is static under jit. A new function object, such as a fresh lambda, recompiles."""


def named_losses(losses: Any) -> dict[str, ExtraLoss]:
    """Losses by the names of their functions, under which `info["extra"]` reports their values.

    Raises:
        ValueError: `losses` is not a tuple of functions, one cannot be hashed, or two have the same name.
    """
    if not isinstance(losses, tuple):
        raise ValueError(
            f"extra_losses: expected a tuple of functions, such as (loss,), found {type(losses).__name__}"
        )
    named = {}
    for loss in losses:
        if not callable(loss):
            raise ValueError(f"extra_losses: expected functions loss(scene, rendered, frame), found {loss!r}")
        try:
            hash(loss)
        except TypeError as error:
            raise ValueError(
                f"extra_losses: expected functions, found a {type(loss).__name__} that cannot be hashed, as "
                "it holds arrays; define a function that takes them from outside"
            ) from error
        name = _name(loss)
        if name in named:
            raise ValueError(
                f"extra_losses: expected functions with different names, found two named {name!r}; rename "
                "one (loss.__name__ = ...)"
            )
        named[name] = loss
    return named


def _name(loss: Any) -> str:
    if (given := getattr(loss, "__name__", None)) is not None:
        return given
    return _name(loss.func) if isinstance(loss, partial) else type(loss).__name__


def captured(losses: ExtraLosses) -> tuple[Hashable, ...]:
    """The numbers, texts and arrays that losses take from outside (globals, closures, defaults, those of
    functions that they call), which are compiled in: where one has changed, a method compiles anew.

    Args:
        losses: functions of scene, rendered and frame.
    """
    return tuple(value for loss in losses for value in _captured(loss, set()))


def _is_library(function: Any) -> bool:
    return (getattr(function, "__module__", None) or "").partition(".")[0] in ("gsjax", "jax", "numpy")


def _captured(loss: Any, known: set[int]) -> Iterator[Hashable]:
    if id(loss) in known:
        return
    known.add(id(loss))
    if isinstance(loss, partial):
        outside: dict[Any, Any] = dict(enumerate(loss.args)) | loss.keywords | {"func": loss.func}
    elif isinstance(loss, FunctionType):
        try:
            found = getclosurevars(loss)
        except ValueError:  # a variable that is not set yet
            return
        defaults = enumerate(loss.__defaults__ or ())
        outside = {**found.globals, **found.nonlocals, **(loss.__kwdefaults__ or {}), **dict(defaults)}
    else:
        return
    for name, value in outside.items():
        if isinstance(value, bool | int | float | complex | str | np.generic):
            yield name, type(value).__name__, repr(value)
        elif isinstance(value, np.ndarray | jax.Array) and not isinstance(value, jax.core.Tracer):
            array = np.asarray(value)
            yield name, str(array.dtype), array.shape, hashlib.sha256(array.tobytes()).hexdigest()
        elif isinstance(value, partial | FunctionType) and not _is_library(value):
            yield from _captured(value, known)


def extra_terms(losses: Any, scene: Any, rendered: Any, frame: Any) -> dict[str, Float[Array, ""]]:
    """The value of each loss, by name.

    Args:
        losses: functions of scene, rendered and frame.
        scene, rendered, frame: their arguments.

    Raises:
        ValueError: as for `named_losses`, or a loss returns something other than a scalar.
    """
    terms = {name: _value(name, loss, scene, rendered, frame) for name, loss in named_losses(losses).items()}
    for name, value in terms.items():
        is_array = isinstance(value, int | float | np.ndarray | np.generic | jax.Array)
        if not is_array or jnp.shape(value) != ():
            found = f"shape {jnp.shape(value)}" if is_array else f"{type(value).__name__}"
            raise ValueError(
                f"extra_losses: expected a scalar from {name}, found {found}; take a sum or a mean"
            )
    return terms


def _value(name: str, loss: Callable, scene: Any, rendered: Any, frame: Any) -> Any:
    """The value of a loss; what goes wrong in it says in which, and what is usual."""
    try:
        return loss(scene, rendered, frame)
    except Exception as error:
        error.add_note(
            f"This is in the extra loss {name}(scene, rendered, frame). Its arguments are traced: take jnp, "
            "jnp.where and jax.debug.print in place of np, if and print. The Gaussians are scene.gaussians."
        )
        raise
