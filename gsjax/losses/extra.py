"""User-defined losses, in addition to those of a method.

A method that takes `extra_losses` adds them to its own and trains on the gradient of the sum:

    def above_the_table(scene, rendered, frame):
        return 10.0 * jnp.sum(jnp.minimum(scene.gaussians.means[:, 2], 0.0) ** 2)

    gsjax.track(scene, first, frames, config, extra_losses=(above_the_table,))

The weight of a loss is a factor inside it. A loss that asks for its position in the run gets it by keyword:

    def prior(scene, rendered, frame, *, index, progress):
        return (1 - progress) * jnp.abs(rendered.depths - DEPTHS[index]).mean()

Without extra losses, a method's program is unchanged.
"""

import hashlib
import inspect
import os
import sysconfig
from collections.abc import Callable, Hashable
from contextlib import suppress
from functools import cache, partial
from pathlib import Path
from types import CodeType, FunctionType, MethodType
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

ExtraLoss = Callable[..., Float[Array, ""]]
"""A pure, differentiable function `loss(scene, rendered, frame)` to be minimised, of

- the method's scene, with `scene.gaussians` [N] as they were drawn; see the method for its other fields,
- its rendering (`gsjax.scene.render.Rendered`): colours, depths and alphas of C cameras,
- the frame that these cameras saw (`gsjax.scene.frame.Frame`): images [C,H,W,3], 0 to 1, and depths,

and, if it has keyword-only arguments of these names without defaults, of

- `index`: the position of the photograph or frame among those that the method was given,
- `camera`: the position of its camera (`parts`),
- `progress`: the fraction of the steps taken, 0 to 1; in `parts`, of one frame's steps or of the
  refinement's.

The tracker, whose frames come one by one, provides none of the three.
"""

_DIGESTED = 2**20  # bytes up to which an array is identified by its content, not by its identity

ExtraLosses = tuple[ExtraLoss, ...]
"""A tuple, because it is static under jit. A new function object, such as a fresh lambda, recompiles."""


def named_losses(losses: Any) -> dict[str, ExtraLoss]:
    """Losses by function name, under which `info["extra"]` reports their values.

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
                f"extra_losses: expected functions, found {type(loss).__name__}, which cannot be hashed; "
                "freeze its dataclass, and let a function take arrays from outside"
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
    """The values that losses capture, compiled in as constants: if they change, a method recompiles.

    Numbers, strings and arrays are found in globals, closures, defaults, partials, containers, attributes of
    callable objects, and in the user's own functions that a loss calls. Values reached in other ways (an
    attribute of a module or of another object) are not, and under `jax.jit` JAX keeps what it traced.

    Args:
        losses: functions of scene, rendered and frame.
    """
    found: list[Hashable] = []
    known: dict[int, Any] = {}  # holds the objects, so that their ids are not reused
    for loss in losses:
        _collect(loss, found, known)
    return tuple(found)


class Recompiling:
    """The program of a loop, recompiled if values that its losses capture have changed between two steps.
    Changes made by tracing itself, such as to a counter of traces, do not count."""

    def __init__(self, losses: ExtraLosses, compiled: Callable[[tuple[Hashable, ...]], Callable]):
        """
        Args:
            losses: functions of scene, rendered and frame.
            compiled: makes the program for the values that `captured` found.
        """
        self._losses, self._compiled = losses, compiled
        self._left = captured(losses)
        self._program = compiled(self._left)

    def __call__(self, *args: Any) -> Any:
        if self._losses and (now := captured(self._losses)) != self._left:
            self._program = self._compiled(now)
        result = self._program(*args)
        self._left = captured(self._losses)
        return result


class _Same:
    """An array that is equal only to itself. A cache key that holds it keeps its id from being reused."""

    def __init__(self, array: Any):
        self.array = array

    def __eq__(self, other: object) -> bool:
        return isinstance(other, _Same) and self.array is other.array

    def __hash__(self) -> int:
        return id(self.array)


def _collect(value: Any, found: list[Hashable], known: dict[int, Any]) -> None:
    if isinstance(value, bool | int | float | complex | str | np.generic):
        found.append((type(value).__name__, repr(value)))
        return
    if id(value) in known:
        return
    known[id(value)] = value
    if isinstance(value, np.ndarray) and value.nbytes <= _DIGESTED and value.dtype != object:
        digest = hashlib.sha256(np.ascontiguousarray(value)).hexdigest()
        found.append((str(value.dtype), value.shape, digest))
    elif isinstance(value, np.ndarray | jax.Array):
        found.append(_Same(value))
    elif isinstance(value, tuple | list):
        found.append(len(value))
        for one in value:
            _collect(one, found, known)
    elif isinstance(value, set | frozenset):
        _collect(sorted(value, key=repr), found, known)
    elif isinstance(value, dict):
        for name, one in value.items():
            found.append(str(name))
            _collect(one, found, known)
    elif isinstance(value, partial):
        _collect([value.func, *value.args, value.keywords], found, known)
    elif isinstance(value, MethodType):
        _collect([value.__func__, value.__self__], found, known)
    elif isinstance(value, FunctionType):
        if not _is_library(value.__code__):
            _collect(_captured_by(value), found, known)
    elif callable(value) and not isinstance(value, type):
        _collect(getattr(value, "__dict__", {}), found, known)


def _captured_by(function: FunctionType) -> dict[str, Any]:
    """The values that a function takes from globals, its closure and its defaults, by name."""
    names, codes = set(), [function.__code__]
    while codes:  # a lambda or a comprehension within it has code of its own
        code = codes.pop()
        names |= set(code.co_names)
        codes += [one for one in code.co_consts if isinstance(one, CodeType)]
    values = {name: function.__globals__[name] for name in sorted(names & function.__globals__.keys())}
    for name, cell in zip(function.__code__.co_freevars, function.__closure__ or (), strict=True):
        with suppress(ValueError):  # not set yet
            values[f"{name} of the closure"] = cell.cell_contents
    return values | {"defaults": function.__defaults__ or (), **(function.__kwdefaults__ or {})}


def _is_library(code: CodeType) -> bool:
    return code.co_filename.startswith(_library_folders())


@cache
def _library_folders() -> tuple[str, ...]:
    folders = sysconfig.get_path("stdlib"), sysconfig.get_path("purelib"), str(Path(__file__).parents[1])
    return tuple(f"{folder}{os.sep}" for folder in folders)


def extra_terms(
    losses: Any,
    scene: Any,
    rendered: Any,
    frame: Any,
    **context: Float[Array, ""] | Int[Array, ""] | float | int,
) -> dict[str, Float[Array, ""]]:
    """The value of each loss, by name.

    Args:
        losses: functions of scene, rendered and frame.
        scene, rendered, frame: their arguments.
        context: what a loss gets by keyword if it asks for it; see `ExtraLoss`.

    Raises:
        ValueError: as for `named_losses`; or a loss asks for what `context` lacks, or returns no scalar.
    """
    named = named_losses(losses)
    terms = {name: _value(name, loss, scene, rendered, frame, context) for name, loss in named.items()}
    for name, value in terms.items():
        is_array = isinstance(value, int | float | np.ndarray | np.generic | jax.Array)
        if not is_array or jnp.shape(value) != ():
            found = f"shape {jnp.shape(value)}" if is_array else f"{type(value).__name__}"
            raise ValueError(
                f"extra_losses: expected a scalar from {name}, found {found}; take a sum or a mean"
            )
    return terms


def _required(loss: Callable) -> tuple[str, ...]:
    """Names of keyword-only arguments without defaults."""
    try:
        given = inspect.signature(loss).parameters.values()
    except (TypeError, ValueError):  # a function written in C
        return ()
    return tuple(one.name for one in given if one.kind is one.KEYWORD_ONLY and one.default is one.empty)


def _value(name: str, loss: Callable, scene: Any, rendered: Any, frame: Any, context: dict[str, Any]) -> Any:
    """The value of a loss. Its errors get a note that names the loss and the usual causes."""
    asked = _required(loss)
    if missing := sorted({*asked} - context.keys()):
        given = f"only {' and '.join(sorted(context))}" if context else "nothing"
        raise ValueError(
            f"extra_losses: {name} asks for {' and '.join(missing)} by keyword, and {given} is given here; "
            "give the argument a default, or leave it out"
        )
    try:
        return loss(scene, rendered, frame, **{one: context[one] for one in asked})
    except Exception as error:
        error.add_note(
            f"This is in the extra loss {name}(scene, rendered, frame). Its arguments are traced: take jnp, "
            "jnp.where and jax.debug.print in place of np, if and print. The Gaussians are scene.gaussians."
        )
        raise
