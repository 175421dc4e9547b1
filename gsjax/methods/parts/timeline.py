"""Edit scripts: a list of operations on named parts, as YAML, and the film that results.

    fps: 15           # frames a second; default: the recording's own
    length: 8         # seconds; default: as long as the recording and the edits require
    edits:            # one after the other
      - {op: speed, parts: [drawer], factor: 2}
      - {op: echo, parts: [3], copies: 3, every: 0.2, fade: 0.5}

`gsjax.methods.parts.operations` defines the operations and their keys.
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
"""Loads another run from its path: the discovered scene, and the names of its parts."""
MOST_MOMENTS = 100_000
"""Length of the longest film, also while it is edited; a longer one is taken for a mistake."""
LENGTHS = 0.01, 86400.0
"""Shortest and longest film, seconds."""
ROUND = 256
"""Films are edited in multiples of this number of moments, so that a new length rarely causes compilation."""
_INSTANT = 1e-6  # seconds; so that rounding does not add a moment


@dataclass(frozen=True, kw_only=True)
class Script(Entry):
    """A checked edit script.

    Attributes:
        fps: frames per second; None: those of the recording.
        length: seconds; None: as long as the recording and the edits require.
        edits: the edits, in the order of application.
    """

    fps: float | None = field(default=None, metadata=number("frames a second, 0.1 to 1000", 0.1, 1000.0))
    length: float | None = field(default=None, metadata=number("seconds, 0.01 to 86400", *LENGTHS))
    edits: tuple[Edit, ...] = field(default=(), metadata={"check": read_edits})


def parse_script(text: str) -> Script:
    """The script in a YAML text.

    Raises:
        ValueError: the text is not YAML, or an entry is not as expected; the message names the number of the
            edit, the operation and the key.
    """
    with _not_too_deep():
        found = _yaml(text)
        return read(Script, {} if found is None else found)


def parse_op(text: str, number: int = 1) -> Edit:
    """The edit in a line such as `speed:parts=drawer,factor=2` or `scale:parts=[1, lid],factor=0.5,from=1`.

    Args:
        text: the line.
        number: number of the edit in messages.

    Raises:
        ValueError: as for `parse_script`.
    """
    operation, _, pairs = text.partition(":")
    pairs = re.sub(r"(^|,)\s*(\w+)\s*=", r"\1 \2: ", pairs)
    with _not_too_deep():
        (edit,) = read_edits([_yaml(f"{{op: {operation}, {pairs}}}")], number)
        return edit


def to_yaml(script: Script) -> str:
    """The script as YAML, which `parse_script` reads back."""
    return yaml.safe_dump(_plain(script), sort_keys=False, allow_unicode=True, default_flow_style=None)


def apply(script: Script, layer: Layer, names: Names, load_scene: LoadScene | None = None) -> Film:
    """Applies a script to a scene. The film's times begin at 0, and Gaussians that are never visible are
    removed.

    Args:
        script: the script.
        layer: the discovered scene.
        names: its parts by name; "background" is predefined.
        load_scene: loads other runs; required by `composite`.

    Raises:
        ValueError: a part is unknown, an edit has nothing to change, or the film would be too long; the
            message names the number of the edit and its operation.
    """
    recorded = np.asarray(layer.trajectory.times, np.float64)
    recorded = recorded - recorded[0]
    step = 1 / script.fps if script.fps else _frame_time(recorded)
    plan = _plan_of(script.edits, layer, names, load_scene)
    length = script.length or plan.end(range(layer.scene.num_parts)) + step
    times = _extended(np.zeros(1) if script.fps else recorded, step, length)
    return trimmed(_edited(plan, times[times < length - _INSTANT], step))


@dataclass(frozen=True, eq=False)
class _Step:
    """One edit of a plan.

    Attributes:
        edit: the edit.
        parts: the parts that it changes or adds.
        ends: the end of the motion of each part of the scene before the edit, seconds.
        added: the plan of the scene that a `Composite` adds.
    """

    edit: Edit
    parts: list[int]
    ends: list[float]
    added: "_Plan | None" = None


@dataclass(frozen=True, eq=False)
class _Plan:
    """The planned edits of a scene.

    Attributes:
        layer: the discovered scene.
        steps: the edits in order.
        ends: the end of the motion of each part of the scene after all edits, seconds.
        added_end: the end of the motion of all copies and added parts, seconds.
    """

    layer: Layer
    steps: list[_Step]
    ends: list[float]
    added_end: float

    def end(self, parts: Iterable[int]) -> float:
        """The end of the motion of some parts of the scene and of everything added, seconds."""
        return max([self.added_end, *(self.ends[p] for p in parts)])


def _plan_of(edits: Sequence[Edit], layer: Layer, names: Names, load_scene: LoadScene | None) -> _Plan:
    num, times = layer.scene.num_parts, layer.trajectory.times
    ends, steps, added_end = [float(times[-1] - times[0])] * num, [], 0.0
    for place, edit in enumerate(edits):
        with _naming(place, edit):
            if isinstance(edit, Composite):
                parts, added = _added_by(edit, load_scene)
                steps.append(_Step(edit, parts, ends, added))
                added_end = max(added_end, edit.added_end(added.end(parts)))
            else:
                parts = edit.affected(layer.trajectory, _numbers(edit.parts, names, num), ends)
                steps.append(_Step(edit, parts, ends))
                added_end = max([added_end, *(edit.added_end(ends[p]) for p in parts)])
                ends = [edit.end_after(end) if p in parts else end for p, end in enumerate(ends)]
    return _Plan(layer, steps, ends, added_end)


def _added_by(edit: Composite, load_scene: LoadScene | None) -> tuple[list[int], _Plan]:
    """The parts that a composite adds, and the plan of its own edits."""
    if load_scene is None:
        raise ValueError("from_run: expected load_scene, which loads other runs, found none; pass it")
    layer, names = load_scene(edit.from_run)
    parts = _numbers(edit.parts, names, layer.scene.num_parts)
    return parts, _plan_of(edit.edits, layer, names, load_scene)


def _edited(plan: _Plan, times: Float[np.ndarray, "T"], step: float) -> Film:
    """The film at `times`; while it is edited, it is as long as any edit requires."""
    layer = plan.layer
    longest = max(end for ends in (*(at.ends for at in plan.steps), plan.ends) for end in ends)
    dtype = layer.trajectory.times.dtype
    longer = _extended(times, step, longest + step)
    longer = _extended(longer, step, longer[-1] + step * (1 + -len(longer) % ROUND))
    recorded = eqx.tree_at(
        lambda t: t.times, layer.trajectory, layer.trajectory.times - layer.trajectory.times[0]
    )
    film: Film = (Layer(layer.scene, at_times(recorded, jnp.asarray(longer, dtype))),)
    for place, at in enumerate(plan.steps):
        with _naming(place, at.edit):
            if isinstance(at.edit, Composite) and at.added is not None:
                film = at.edit.joined(film, _edited(at.added, longer, step), at.parts)
            else:
                film = at.edit.applied(film, at.parts, at.ends)
    return tuple(Layer(one.scene, _first_moments(one.trajectory, len(times))) for one in film)


def _first_moments(trajectory: Trajectory, moments: int) -> Trajectory:
    """The first moments of a trajectory; on the host, where slicing compiles nothing."""
    return jax.tree.map(lambda leaf: jax.device_put(np.asarray(leaf)[:moments]), trajectory)


def _numbers(parts: Sequence[str | int], names: Names, num: int) -> list[int]:
    """Numbers of the parts, without duplicates."""
    known, numbers = {"background": BACKGROUND, **names}, []
    for part in parts:
        if part == ALL:
            numbers += range(num)
        elif isinstance(part, str) and part not in known:
            listed = ", ".join(f"{name} ({p})" for name, p in known.items())
            raise ValueError(f"parts: expected one of {listed}, found {did_you_mean(part, known)}")
        else:
            numbers.append(known[part] if isinstance(part, str) else part)
    wrong = [p for p in numbers if not 0 <= p < num]
    if wrong:
        raise ValueError(f"parts: expected numbers from 0 to {num - 1}, found {wrong[0]}")
    return list(dict.fromkeys(numbers))


def _frame_time(times: Float[np.ndarray, "T"]) -> float:
    """Seconds from one moment to the next."""
    if len(times) < 2:
        raise ValueError("fps: expected a frame rate, as the recording has only one frame; found none")
    return float(np.median(np.diff(times)))


def _extended(times: Float[np.ndarray, "T"], step: float, until: float) -> Float[np.ndarray, "S"]:
    """The times, extended by steps of `step` seconds up to `until`."""
    if until / step > MOST_MOMENTS:
        found = f"{until:g} s at {1 / step:g} frames a second"
        raise ValueError(
            f"length: expected at most {MOST_MOMENTS} moments after each edit, found {found}; "
            "loop or echo less often, or slow down less"
        )
    more = max(0, int(np.ceil((until - times[-1]) / step - _INSTANT)) - 1)
    return np.concatenate([times, times[-1] + step * np.arange(1, more + 1)])


def _plain(entry: Entry) -> dict[str, Any]:
    """The entry as plain values for YAML, without defaults."""

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
    except (ValueError, OverflowError) as error:  # an invalid date, or a number that is too long
        raise ValueError(f"expected YAML, found a value that cannot be read: {error}") from None


@contextmanager
def _not_too_deep() -> Iterator[None]:
    """Raises ValueError where something is nested too deeply for Python."""
    try:
        yield
    except RecursionError:
        raise ValueError("expected edits, found lists or mappings nested too deeply to be read") from None


@contextmanager
def _naming(place: int, edit: Edit) -> Iterator[None]:
    """Adds the number and the operation of an edit to errors."""
    try:
        yield
    except ValueError as error:
        raise ValueError(f"{label(place + 1, edit.operation())}: {error}") from error
