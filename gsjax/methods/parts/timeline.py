"""Edit scripts: a list of operations on named parts, as YAML, and the film that they make of a scene.

    fps: 15           # frames a second; default: the recording's own
    length: 8         # seconds; default: as long as the recording and what the edits need
    edits:            # one after the other
      - {op: speed, parts: [drawer], factor: 2}
      - {op: echo, parts: [3], copies: 3, every: 0.2, fade: 0.5}

`gsjax.methods.parts.operations` has the operations and their keys.
"""

import re
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field, fields
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import yaml
from jaxtyping import Float

from gsjax.methods.parts.edits import at_times
from gsjax.methods.parts.entries import ALL, Entry, did_you_mean, key_of, number, read
from gsjax.methods.parts.film import Film, Layer, trimmed
from gsjax.methods.parts.operation import Edit
from gsjax.methods.parts.operations import Composite, label, read_edits
from gsjax.methods.parts.trajectory import BACKGROUND, Trajectory

Names = Mapping[str, int]
"""Parts by name."""
LoadScene = Callable[[str], tuple[Layer, Names]]
"""From the path of another run to its scene as it was found, and the names of its parts."""
MOST_MOMENTS = 100_000
"""A film that is longer, if only while it is edited, is a slip."""
LENGTHS = 0.01, 86400.0
"""Seconds, of a film."""
ROUND = 256
"""Moments: films are edited in multiples of these, so that a new length seldom compiles anything."""
_INSTANT = 1e-6  # seconds; rounding must not add a moment


@dataclass(frozen=True, kw_only=True)
class Script(Entry):
    """An edit script, checked.

    Attributes:
        fps: frames a second; None is the recording's own.
        length: seconds; None is as long as the recording and what the edits need.
        edits: in the order in which they are applied.
    """

    fps: float | None = field(default=None, metadata=number("frames a second, 0.1 to 1000", 0.1, 1000.0))
    length: float | None = field(default=None, metadata=number("seconds, 0.01 to 86400", *LENGTHS))
    edits: tuple[Edit, ...] = field(default=(), metadata={"check": read_edits})


def parse_script(text: str) -> Script:
    """The script that YAML describes.

    Raises:
        ValueError: it is no YAML, or an entry is not as expected; the message names the edit by its number,
            the operation and the key.
    """
    with _not_too_deep():
        found = _yaml(text)
        return read(Script, {} if found is None else found)


def parse_op(text: str, number: int = 1) -> Edit:
    """One edit from one line: `speed:parts=drawer,factor=2` or `scale:parts=[1, lid],factor=0.5,from=1`.

    Args:
        number: that messages call it by.

    Raises:
        ValueError: as for `parse_script`.
    """
    operation, _, pairs = text.partition(":")
    pairs = re.sub(r"(^|,)\s*(\w+)\s*=", r"\1 \2: ", pairs)
    with _not_too_deep():
        (edit,) = read_edits([_yaml(f"{{op: {operation}, {pairs}}}")], number)
        return edit


def to_yaml(script: Script) -> str:
    """The script as YAML, from which `parse_script` makes an equal one."""
    return yaml.safe_dump(_plain(script), sort_keys=False, allow_unicode=True, default_flow_style=None)


def apply(script: Script, layer: Layer, names: Names, load_scene: LoadScene | None = None) -> Film:
    """The film that a script makes of a scene. Its times begin at 0, and what is never seen is left out.

    Args:
        layer: the scene as it was found.
        names: its parts by name; "background" is known without.
        load_scene: reads other runs; needed where parts of one are brought in.

    Raises:
        ValueError: a part is not known, there is nothing for an edit to change, or the film would be too
            long; the message names the edit by its number and operation.
    """
    recorded = np.asarray(layer.trajectory.times, np.float64)
    recorded = recorded - recorded[0]
    step = 1 / script.fps if script.fps else _step(recorded)
    plan = _planned(script.edits, layer, names, load_scene)
    length = script.length or plan.end(range(layer.scene.num_parts)) + step
    times = _reaching(np.zeros(1) if script.fps else recorded, step, length)
    return trimmed(_edited(plan, times[times < length - _INSTANT], step))


@dataclass(frozen=True, eq=False)
class _Step:
    """One edit of a plan.

    Attributes:
        edit: the edit.
        parts: that it changes, or brings in.
        lasts: when the motion of each part of the scene ends before it, seconds.
        brought: what it brings in, if that is what it does.
    """

    edit: Edit
    parts: list[int]
    lasts: list[float]
    brought: "_Plan | None" = None


@dataclass(frozen=True, eq=False)
class _Plan:
    """What edits of a scene come to, before any of them is done.

    Attributes:
        layer: the scene as it was found.
        steps: one after the other.
        lasts: when the motion of each part of the scene ends after all of them, seconds.
        added: when that of all copies and of all that was brought in ends.
    """

    layer: Layer
    steps: list[_Step]
    lasts: list[float]
    added: float

    def end(self, parts: Iterable[int]) -> float:
        """When nothing moves any more of some parts of the scene and of what was added, seconds."""
        return max([self.added, *(self.lasts[p] for p in parts)])


def _planned(edits: Sequence[Edit], layer: Layer, names: Names, load_scene: LoadScene | None) -> _Plan:
    num, times = layer.scene.num_parts, layer.trajectory.times
    lasts, steps, added = [float(times[-1] - times[0])] * num, [], 0.0
    for place, edit in enumerate(edits):
        with _naming(place, edit):
            if isinstance(edit, Composite):
                parts, brought = _brought(edit, load_scene)
                steps.append(_Step(edit, parts, lasts, brought))
                added = max(added, edit.adds_until(brought.end(parts)))
            else:
                parts = edit.concerned(layer.trajectory, _numbers(edit.parts, names, num), lasts)
                steps.append(_Step(edit, parts, lasts))
                added = max([added, *(edit.adds_until(lasts[p]) for p in parts)])
                lasts = [edit.ends(last) if p in parts else last for p, last in enumerate(lasts)]
    return _Plan(layer, steps, lasts, added)


def _brought(edit: Composite, load_scene: LoadScene | None) -> tuple[list[int], _Plan]:
    """The parts that a composite brings in, and what its own edits of them come to."""
    if load_scene is None:
        raise ValueError("from_run: expected load_scene, which reads other runs, found none; pass it on")
    layer, names = load_scene(edit.from_run)
    parts = _numbers(edit.parts, names, layer.scene.num_parts)
    return parts, _planned(edit.edits, layer, names, load_scene)


def _edited(plan: _Plan, times: Float[np.ndarray, "T"], step: float) -> Film:
    """The film at `times`. While it is edited it is as long as any edit needs it."""
    layer = plan.layer
    longest = max(last for lasts in (*(at.lasts for at in plan.steps), plan.lasts) for last in lasts)
    dtype = layer.trajectory.times.dtype
    longer = _reaching(times, step, longest + step)
    longer = _reaching(longer, step, longer[-1] + step * (1 + -len(longer) % ROUND))
    recorded = eqx.tree_at(
        lambda t: t.times, layer.trajectory, layer.trajectory.times - layer.trajectory.times[0]
    )
    film: Film = (Layer(layer.scene, at_times(recorded, jnp.asarray(longer, dtype))),)
    for place, at in enumerate(plan.steps):
        with _naming(place, at.edit):
            if isinstance(at.edit, Composite) and at.brought is not None:
                film = at.edit.joined(film, _edited(at.brought, longer, step), at.parts)
            else:
                film = at.edit.edited(film, at.parts, at.lasts)
    return tuple(Layer(one.scene, _begun(one.trajectory, len(times))) for one in film)


def _begun(trajectory: Trajectory, moments: int) -> Trajectory:
    """Its first moments. On the host, where nothing is compiled for it (`jnp.asarray` would)."""
    return jax.tree.map(lambda leaf: jax.device_put(np.asarray(leaf)[:moments]), trajectory)


def _numbers(parts: Sequence[str | int], names: Names, num: int) -> list[int]:
    """Parts by number, each once."""
    known, numbers = {"background": BACKGROUND, **names}, []
    for part in parts:
        if part == ALL:
            numbers += range(num)
        elif isinstance(part, str) and part not in known:
            names = ", ".join(f"{name} ({p})" for name, p in known.items())
            raise ValueError(f"parts: expected one of {names}, found {did_you_mean(part, known)}")
        else:
            numbers.append(known[part] if isinstance(part, str) else part)
    wrong = [p for p in numbers if not 0 <= p < num]
    if wrong:
        raise ValueError(f"parts: expected numbers from 0 to {num - 1}, found {wrong[0]}")
    return list(dict.fromkeys(numbers))


def _step(times: Float[np.ndarray, "T"]) -> float:
    """Seconds from one moment to the next."""
    if len(times) < 2:
        raise ValueError("fps: expected frames a second, as the recording is of one moment; found nothing")
    return float(np.median(np.diff(times)))


def _reaching(times: Float[np.ndarray, "T"], step: float, until: float) -> Float[np.ndarray, "S"]:
    """These times, and more, `step` seconds apart, as far as they are before `until`."""
    if until / step > MOST_MOMENTS:
        found = f"{until:g} s at {1 / step:g} frames a second"
        raise ValueError(
            f"length: expected at most {MOST_MOMENTS} moments, also between edits, found {found}; "
            "loop or echo less often, or slow down less"
        )
    more = max(0, int(np.ceil((until - times[-1]) / step - _INSTANT)) - 1)
    return np.concatenate([times, times[-1] + step * np.arange(1, more + 1)])


def _plain(entry: Entry) -> dict[str, Any]:
    """As YAML has it; what is as it would be anyway is left out."""

    def plain(value: Any) -> Any:
        if isinstance(value, Entry):
            return _plain(value)
        return [plain(one) for one in value] if isinstance(value, tuple) else value

    values = {f: getattr(entry, f.name) for f in fields(entry)}
    op = {"op": entry.operation()} if isinstance(entry, Edit) else {}
    return op | {key_of(f): plain(value) for f, value in values.items() if value != f.default}


def _yaml(text: str) -> Any:
    try:
        return yaml.safe_load(text)
    except yaml.YAMLError as error:
        mark, problem = getattr(error, "problem_mark", None), getattr(error, "problem", None)
        fault = f"a fault in line {mark.line + 1}: {problem}" if mark else str(error)
        raise ValueError(f"expected YAML, found {fault}") from None
    except (ValueError, OverflowError) as error:  # of a date that is none, a number too long to read
        raise ValueError(f"expected YAML, found a value that cannot be read: {error}") from None


@contextmanager
def _not_too_deep() -> Iterator[None]:
    """A ValueError where something is nested deeper than Python can follow."""
    try:
        yield
    except RecursionError:
        raise ValueError("expected edits, found lists or mappings nested too deeply to be read") from None


@contextmanager
def _naming(place: int, edit: Edit) -> Iterator[None]:
    """Errors name the edit in this place."""
    try:
        yield
    except ValueError as error:
        raise ValueError(f"{label(place + 1, edit.operation())}: {error}") from error
