"""Edits of part motions: pure functions from trajectories to trajectories, which compose.

Each edits the given parts and leaves all others unchanged, bit for bit. There are two kinds.

- Edits of time (`speed`, `loop`, `freeze`, `isolate`) show parts as they were at other times. Motion after
  the interval from `begin` to `end` follows the edited interval, earlier or later than it did.
- Edits of pose and appearance (`move`, `rotate`, `redirect`, `amplify`, `scale`, `fade`, `ghost`) are applied
  by a `share`, 0 to 1: one number, or one for each moment, such as `during` returns.

A trajectory keeps its times: motion that an edit moves past its last moment is cut off, so lengthen it first
(`at_times`). After MotionSplicer, section 4.2, which names the edits but does not define them.
"""

from collections.abc import Sequence
from functools import partial

import equinox as eqx
import jax
import jax.numpy as jnp
import jaxlie
import numpy as np
from jaxtyping import Array, Bool, Float, Integer

from gsjax.methods.parts.screws import motions_of, pose_of, turned_about, unwound
from gsjax.methods.parts.trajectory import Trajectory
from gsjax.scene.handles import HandlePose

Scalar = float | Float[Array, ""]
Share = Scalar | Float[Array, "T"]
_HIT = 1e-3  # of the time between two moments, within which a time counts as one of them
_INSTANT = 1e-4  # seconds; so that rounding does not decide on which side of a boundary a moment falls


@jax.jit  # one program, instead of a hundred for its operations, for each new length
def at_times(trajectory: Trajectory, times: Float[Array, "S"]) -> Trajectory:
    """The same motion, sampled at other times.

    Between two moments a part moves along the screw from one to the other, so that a part on a hinge stays on
    it; opacities and scales are interpolated linearly. Before the first moment and after the last, everything
    is constant. Times of the trajectory itself are reproduced bit for bit.

    Args:
        times: seconds, in any order.
    """
    known = trajectory.times
    last = len(known) - 1
    before = jnp.clip(jnp.searchsorted(known, times, side="right") - 1, 0, max(last - 1, 0))
    after = jnp.minimum(before + 1, last)
    share = (times - known[before]) / jnp.where(after > before, known[after] - known[before], 1.0)
    whole = jnp.round(share)
    share = jnp.clip(jnp.where(jnp.abs(share - whole) < _HIT, whole, share), 0.0, 1.0)[:, None]

    def choose(mixed, a, b):
        at = share.reshape(-1, *[1] * (a.ndim - 1))
        return jnp.where(at == 0, a, jnp.where(at == 1, b, mixed))

    first, second = (jax.tree.map(lambda leaf, i=i: leaf[i], _state(trajectory)) for i in (before, after))
    start, end = motions_of(first[0]), motions_of(second[0])
    along = start @ jaxlie.SE3.exp(share[..., None] * (start.inverse() @ end).log())
    mixed = (pose_of(along), *(a + share * (b - a) for a, b in zip(first[1:], second[1:], strict=True)))
    return Trajectory(times, *jax.tree.map(choose, mixed, first, second))


def retime(trajectory: Trajectory, parts: Sequence[int], sources: Float[Array, "T"]) -> Trajectory:
    """The trajectory in which the parts at moment i are as they were at time `sources[i]`, seconds."""
    seen = at_times(_only(trajectory, parts), sources)
    return _with(trajectory, parts, seen)


def speed(
    trajectory: Trajectory,
    parts: Sequence[int],
    factor: Scalar,
    begin: Scalar | None = None,
    end: Scalar | None = None,
    stay: bool = False,
) -> Trajectory:
    """Plays the motion from `begin` to `end` `factor` times as fast; backwards if negative.

    The interval then takes (end - begin) / |factor| seconds, and the motion after it follows.

    Args:
        factor: speed, relative to the original.
        begin, end: seconds; default: the whole trajectory.
        stay: whether parts stay still after the interval; always so without an `end`.

    Raises:
        ValueError: `factor` is 0 (use `freeze`), or the interval is empty.
    """
    if _is_known(factor) and factor == 0:
        raise ValueError("factor: expected a number other than 0, found 0; to stop a part, freeze it")
    start, stop = _interval(trajectory, begin, end)
    past, takes, back = trajectory.times - start, (stop - start) / abs(factor), factor < 0
    sources = trajectory.times + (abs(factor) - 1) * jnp.clip(past, 0.0, takes)
    sources = jnp.where(back & (past >= 0) & (past <= takes), start + stop - sources, sources)
    if stay or end is None:
        sources = jnp.where(past > takes, jnp.where(back, start, stop), sources)
    return retime(trajectory, parts, sources)


def loop(
    trajectory: Trajectory,
    parts: Sequence[int],
    begin: Scalar | None = None,
    end: Scalar | None = None,
    times: int | None = None,
    bounce: bool = False,
    stay: bool = False,
) -> Trajectory:
    """Repeats the motion from `begin` to `end`.

    Args:
        begin, end: seconds; default: the whole trajectory.
        times: number of repetitions, after which the motion goes on; default: endless.
        bounce: play each repetition forwards and backwards, so that there is no jump.
        stay: whether parts stay still after the repetitions; always so without an `end`.

    Raises:
        ValueError: the interval is empty, or `times` is less than 1.
    """
    if times is not None and times < 1:
        raise ValueError(f"times: expected 1 or more, found {times}")
    start, stop = _interval(trajectory, begin, end)
    length = jnp.maximum(stop - start, _INSTANT)
    period = 2 * length if bounce else length
    past, lasts = trajectory.times - start, period * (jnp.inf if times is None else times)
    phase = jnp.maximum(jnp.mod(past + _INSTANT, period) - _INSTANT, 0.0)
    phase = length - jnp.abs(length - phase) if bounce else phase
    after = trajectory.times - (lasts if bounce else lasts - length)
    if stay or end is None:
        after = start if bounce else stop
    sources = jnp.where(past < lasts - _INSTANT, start + phase, after)
    return retime(trajectory, parts, jnp.where(past < 0, trajectory.times, sources))


def freeze(
    trajectory: Trajectory,
    parts: Sequence[int],
    at: Scalar | None = None,
    begin: Scalar | None = None,
    end: Scalar | None = None,
) -> Trajectory:
    """Holds parts from `begin` to `end` as they were at `at`; then they continue from there.

    Args:
        at: seconds; default: `begin`.
        begin: seconds; default: `at`, or the first moment.
        end: seconds; default: parts never continue.

    Raises:
        ValueError: `end` is not after `begin`.
    """
    start, stop = _interval(trajectory, at if begin is None else begin, end)
    past, held = trajectory.times - start, stop - start
    sources = (start if at is None else at) + jnp.maximum(past - held, 0.0)
    return retime(trajectory, parts, jnp.where(past < 0, trajectory.times, sources))


def isolate(
    trajectory: Trajectory,
    parts: Sequence[int],
    at: Scalar | None = None,
    begin: Scalar | None = None,
    end: Scalar | None = None,
) -> Trajectory:
    """Freezes all other parts. To hide them, use `ghost`.

    Args:
        parts: indices of the parts that keep moving.
        at, begin, end: as for `freeze`, seconds.
    """
    return freeze(trajectory, others(trajectory, parts), at, begin, end)


def during(
    times: Float[Array, "T"], begin: Scalar | None = None, end: Scalar | None = None, ease: float = 0.0
) -> Float[Array, "T"]:
    """A share for edits of pose and appearance: 1 from `begin` until `end`, 0 before and after.

    Args:
        times: seconds.
        begin, end: seconds; default: unbounded.
        ease: duration of the smooth transitions within the bounds, seconds; 0: abrupt.
    """
    elapsed = times - (-jnp.inf if begin is None else begin)
    left = (jnp.inf if end is None else end) - times
    if ease == 0:
        return jnp.where((elapsed > -_INSTANT) & (left > _INSTANT), 1.0, 0.0)
    x = jnp.clip(jnp.minimum(elapsed, left) / ease, 0.0, 1.0)
    return x * x * (3 - 2 * x)


def move(
    trajectory: Trajectory, parts: Sequence[int], shift: Float[Array, "3"], share: Share = 1.0
) -> Trajectory:
    """Moves parts by `shift`, metres, in the world's axes."""
    chosen = _checked(trajectory, parts)
    by = _over_time(trajectory, share)[..., None] * shift
    moved = trajectory.poses.translations.at[:, chosen].add(by)
    return eqx.tree_at(lambda t: t.poses.translations, trajectory, moved)


def rotate(
    trajectory: Trajectory,
    parts: Sequence[int],
    turn: Float[Array, "3"],
    arm: Float[Array, "*parts 3"] | None = None,
    share: Share = 1.0,
) -> Trajectory:
    """Rotates parts in addition to their motion, each about its handle or another of its points.

    Args:
        turn: axis in the world times angle, radians.
        arm: vector from the handle to the point in the canonical scene, metres.
        share: how far the edit is applied, 0 to 1.
    """
    motions, share = motions_of(_only(trajectory, parts).poses), _over_time(trajectory, share)
    around = motions.apply(jnp.zeros(3) if arm is None else arm)
    return _moved(trajectory, parts, turned_about(around, share, turn) @ motions, share != 0)


def redirect(
    trajectory: Trajectory,
    parts: Sequence[int],
    turn: Float[Array, "3"],
    arm: Float[Array, "*parts 3"] | None = None,
    at: Scalar | None = None,
    share: Share = 1.0,
) -> Trajectory:
    """Rotates the captured motion instead of the part.

    The path is rotated about the handle (G M G^-1 instead of M): a lid that opened to the back opens to the
    side, a drawer slides in another direction. A rotation about a point of a hinge replaces the hinge's axis.

    Args:
        turn: axis in the world times angle, radians.
        arm: vector from the handle to the centre of rotation, in the canonical scene, metres.
        at: the time at which the part's pose is unchanged, seconds; default: the first moment.
        share: how far the edit is applied, 0 to 1.
    """
    motions, first, share = *_relative(trajectory, parts, at), _over_time(trajectory, share)
    around = turned_about(first.apply(jnp.zeros(3) if arm is None else arm), share, turn)
    return _moved(trajectory, parts, around @ motions @ around.inverse() @ first, share != 0)


def amplify(
    trajectory: Trajectory,
    parts: Sequence[int],
    factor: Scalar,
    at: Scalar | None = None,
    share: Share = 1.0,
) -> Trajectory:
    """Moves parts `factor` times as far along the screw to each moment; on a hinge they stay on it.

    Args:
        factor: above 1 it makes subtle motion visible, below 1 damps it, 0 stops it, negative reverses it.
        at: the time at which poses are unchanged, seconds; default: the first moment. Parts must rotate by
            less than a full turn from there.
        share: how far the edit is applied, 0 to 1.
    """
    by = 1 + _over_time(trajectory, share) * (factor - 1)
    motions, first = _relative(trajectory, parts, at)
    further = jaxlie.SE3.exp(by[..., None] * unwound(motions))
    return _moved(trajectory, parts, further @ first, by != 1)


def scale(trajectory: Trajectory, parts: Sequence[int], factor: Scalar, share: Share = 1.0) -> Trajectory:
    """Scales parts by `factor` about their handles.

    Args:
        factor: scale, more than 0.
        share: how far the edit is applied, 0 to 1; intermediate scales are geometric means.

    Raises:
        ValueError: `factor` is not more than 0.
    """
    if _is_known(factor) and not factor > 0:
        raise ValueError(f"factor: expected more than 0, found {factor}; to hide a part, fade it")
    by = factor ** _over_time(trajectory, share)
    scales = trajectory.scales.at[:, _checked(trajectory, parts)].multiply(by, unique_indices=True)
    return eqx.tree_at(lambda t: t.scales, trajectory, scales)


def fade(
    trajectory: Trajectory, parts: Sequence[int], opacity: Scalar = 0.0, share: Share = 1.0
) -> Trajectory:
    """Makes parts translucent or invisible.

    Args:
        opacity: factor on their opacities, 0 to 1.
        share: how far the edit is applied, 0 to 1.
    """
    by = 1 + _over_time(trajectory, share) * (opacity - 1)
    opacities = trajectory.opacities.at[:, _checked(trajectory, parts)].multiply(by, unique_indices=True)
    return eqx.tree_at(lambda t: t.opacities, trajectory, opacities)


def ghost(
    trajectory: Trajectory, parts: Sequence[int], opacity: Scalar = 0.0, share: Share = 1.0
) -> Trajectory:
    """Fades all other parts, including the background, by the factor `opacity`; `share` as for `fade`."""
    return fade(trajectory, others(trajectory, parts), opacity, share)


def echo(trajectory: Trajectory, parts: Sequence[int], delay: Scalar, opacity: Scalar = 1.0) -> Trajectory:
    """A copy of parts that repeats their motion `delay` seconds later; earlier if negative.

    It is rendered beside the original, as another `Layer`: all other parts are hidden in it, and it is hidden
    itself until its motion has begun.

    Args:
        delay: seconds.
        opacity: factor on the opacities of the copy, 0 to 1.
    """
    sources = trajectory.times - delay
    copy = retime(trajectory, range(trajectory.num_parts), sources)
    early = jnp.where(sources < trajectory.times[0] - _INSTANT, 1.0, 0.0)
    return fade(ghost(fade(copy, parts, opacity), parts), parts, share=early)


def others(trajectory: Trajectory, parts: Sequence[int]) -> list[int]:
    """All parts except these."""
    chosen = set(_checked(trajectory, parts).tolist())
    return [p for p in range(trajectory.num_parts) if p not in chosen]


def _checked(trajectory: Trajectory, parts: Sequence[int]) -> Integer[np.ndarray, "parts"]:
    """The parts without duplicates; raises ValueError for one that does not exist."""
    wrong = [p for p in parts if not 0 <= p < trajectory.num_parts]
    if wrong:
        raise ValueError(f"parts: expected numbers from 0 to {trajectory.num_parts - 1}, found {wrong[0]}")
    return np.array(list(dict.fromkeys(parts)), int)


def _interval(trajectory: Trajectory, begin: Scalar | None, end: Scalar | None) -> tuple[Scalar, Scalar]:
    """Both ends of an interval; default: those of the trajectory."""
    if begin is not None and end is not None and _is_known(begin, end) and not begin < end:
        raise ValueError(f"end: expected a time after begin, {begin:g} s, found {end:g}")
    begin = trajectory.times[0] if begin is None else begin
    return begin, jnp.maximum(begin, trajectory.times[-1]) if end is None else end


def _is_known(*numbers: Scalar) -> bool:
    """Whether all numbers have concrete values that can be checked, which traced ones do not."""
    return not any(isinstance(number, jax.core.Tracer) for number in numbers)


def _state(trajectory: Trajectory) -> tuple[HandlePose, Float[Array, "T P"], Float[Array, "T P"]]:
    return trajectory.poses, trajectory.opacities, trajectory.scales


def _only(trajectory: Trajectory, parts: Sequence[int]) -> Trajectory:
    """The trajectory of some parts alone."""
    chosen = _checked(trajectory, parts)
    return Trajectory(trajectory.times, *_columns(_state(trajectory), chosen))


def _with(trajectory: Trajectory, parts: Sequence[int], seen: Trajectory) -> Trajectory:
    """The trajectory with some parts replaced by those of `seen`."""
    chosen = _checked(trajectory, parts)
    return Trajectory(trajectory.times, *_with_columns(_state(trajectory), chosen, _state(seen)))


@partial(jax.jit, inline=True)
def _columns(tree, chosen):
    return jax.tree.map(lambda leaf: leaf[:, chosen], tree)


@partial(jax.jit, inline=True)
def _with_columns(tree, chosen, columns):
    return jax.tree.map(lambda old, new: old.at[:, chosen].set(new), tree, columns)


def _over_time(trajectory: Trajectory, share: Share) -> Float[Array, "T 1"]:
    return jnp.broadcast_to(share, trajectory.times.shape)[:, None]


def _moved(
    trajectory: Trajectory, parts: Sequence[int], motions: jaxlie.SE3, where: Bool[Array, "T 1"]
) -> Trajectory:
    """The trajectory with other motions of some parts at some moments; otherwise unchanged, bit for bit."""
    old = _only(trajectory, parts)
    poses = jax.tree.map(lambda new, a: jnp.where(where[..., None], new, a), pose_of(motions), old.poses)
    return _with(trajectory, parts, eqx.tree_at(lambda t: t.poses, old, poses))


def _relative(
    trajectory: Trajectory, parts: Sequence[int], at: Scalar | None
) -> tuple[jaxlie.SE3, jaxlie.SE3]:
    """The motions of parts relative to their pose at a time, and that pose."""
    chosen = _only(trajectory, parts)
    motions = motions_of(chosen.poses)
    then = motions if at is None else motions_of(at_times(chosen, jnp.full(1, at)).poses)
    first = jaxlie.SE3(then.wxyz_xyz[0])
    return motions @ first.inverse(), first
