"""Edits of part motions: pure functions from trajectories to trajectories, which compose as functions do.

Each takes the parts that it concerns and leaves all others as they are, to the bit. There are two kinds.

- Edits of time (`speed`, `loop`, `freeze`, `isolate`) show parts as they were at other times. What comes
  after the stretch from `begin` to `end` follows on from there, sooner or later than it did.
- Edits of place and look (`move`, `rotate`, `redirect`, `amplify`, `scale`, `fade`, `ghost`) hold by a
  `share`, 0 to 1: one number, or one for each moment, such as `during` gives.

Times are the trajectory's own, which it keeps: what an edit puts after its last moment is not seen. So
lengthen it first (`at_times`). After MotionSplicer, section 4.2, which names the edits but does
not say how they are made.
"""

from collections.abc import Sequence

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
_HIT = 1e-3  # of the time between two moments: what is as near to one of them is that moment
_INSTANT = 1e-4  # seconds; rounding of times must not decide on which side of a seam a moment falls


@jax.jit  # one program instead of the hundred that its operations would be, for a new length of a film
def at_times(trajectory: Trajectory, times: Float[Array, "S"]) -> Trajectory:
    """The same motion at other times.

    Between two moments a part goes along the screw that leads from one to the other, so what turns about a
    hinge stays on it; opacities and scales go in proportion. Before the first moment and after the last, all
    is as it is there. A moment that is hit is taken over to the bit.

    Args:
        times: seconds, of `trajectory`'s clock, in any order.
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
    """At moment i the parts are where, as large as and as visible as they were at `sources[i]`, seconds."""
    seen = at_times(_only(trajectory, parts), sources)
    return _with(trajectory, parts, seen)


def speed(
    trajectory: Trajectory,
    parts: Sequence[int],
    factor: float,
    begin: float | None = None,
    end: float | None = None,
    stay: bool = False,
) -> Trajectory:
    """What parts do from `begin` to `end` goes `factor` times as fast; backwards if that is negative.

    The stretch then takes (end - begin) / |factor| seconds; what follows comes so much sooner or later.

    Args:
        begin, end: seconds; default: the whole.
        stay: nothing follows, and parts stay as they then are; so it is too if no `end` is given.

    Raises:
        ValueError: `factor` is 0 (that is `freeze`), or the stretch is empty.
    """
    if factor == 0:
        raise ValueError("factor: expected a number other than 0, found 0; to stop a part, freeze it")
    start, stop = _stretch(trajectory, begin, end)
    past, takes = trajectory.times - start, (stop - start) / abs(factor)
    sources = trajectory.times + (abs(factor) - 1) * jnp.clip(past, 0.0, takes)
    if factor < 0:
        sources = jnp.where((past < 0) | (past > takes), sources, start + stop - sources)
    if stay or end is None:
        sources = jnp.where(past > takes, start if factor < 0 else stop, sources)
    return retime(trajectory, parts, sources)


def loop(
    trajectory: Trajectory,
    parts: Sequence[int],
    begin: float | None = None,
    end: float | None = None,
    times: int | None = None,
    bounce: bool = False,
    stay: bool = False,
) -> Trajectory:
    """What parts do from `begin` to `end` is done again and again.

    Args:
        begin, end: seconds; default: the whole.
        times: number of repetitions before what follows goes on; default: without end.
        bounce: there and back each time, so that there is no seam.
        stay: nothing follows, and parts stay as they then are; so it is too if no `end` is given.

    Raises:
        ValueError: the stretch is empty, or `times` is less than 1.
    """
    if times is not None and times < 1:
        raise ValueError(f"times: expected 1 or more, found {times}")
    start, stop = _stretch(trajectory, begin, end)
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
    at: float | None = None,
    begin: float | None = None,
    end: float | None = None,
) -> Trajectory:
    """Parts stand still from `begin` to `end`, as they were at `at`, and then go on from there.

    Args:
        at: seconds; default: `begin`.
        begin: seconds; default: `at`, or the first moment.
        end: seconds; by default they never go on.

    Raises:
        ValueError: `end` is not after `begin`.
    """
    start, stop = _stretch(trajectory, at if begin is None else begin, end)
    past, held = trajectory.times - start, stop - start
    sources = (start if at is None else at) + jnp.maximum(past - held, 0.0)
    return retime(trajectory, parts, jnp.where(past < 0, trajectory.times, sources))


def isolate(
    trajectory: Trajectory,
    parts: Sequence[int],
    at: float | None = None,
    begin: float | None = None,
    end: float | None = None,
) -> Trajectory:
    """Of all motions only those of `parts` go on; the other parts `freeze`. To see nothing else: `ghost`.

    Args:
        trajectory: of all parts.
        parts: that go on.
        at, begin, end: of the others, as for `freeze`, seconds.
    """
    return freeze(trajectory, others(trajectory, parts), at, begin, end)


def during(
    times: Float[Array, "T"], begin: float | None = None, end: float | None = None, ease: float = 0.0
) -> Float[Array, "T"]:
    """A share for edits of place and look: 1 from `begin` until `end`, 0 before and after.

    Args:
        times: seconds.
        begin, end: seconds; default: without bound.
        ease: seconds within the bounds in which it comes and goes smoothly; at once if 0.
    """
    since = times - (-jnp.inf if begin is None else begin)
    left = (jnp.inf if end is None else end) - times
    if ease == 0:
        return jnp.where((since > -_INSTANT) & (left > _INSTANT), 1.0, 0.0)
    x = jnp.clip(jnp.minimum(since, left) / ease, 0.0, 1.0)
    return x * x * (3 - 2 * x)


def move(
    trajectory: Trajectory, parts: Sequence[int], shift: Float[Array, "3"], share: Share = 1.0
) -> Trajectory:
    """Parts are `shift` (metres, of the world) from where they were."""
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
    """Parts are turned, on top of what they do, each about its own handle or another point of its own.

    Args:
        turn: axis of the world times angle, radians.
        arm: from the handle to that point in the canonical scene, metres.
    """
    motions, share = motions_of(_only(trajectory, parts).poses), _over_time(trajectory, share)
    around = motions.apply(jnp.zeros(3) if arm is None else arm)
    return _moved(trajectory, parts, turned_about(around, share, turn) @ motions, share != 0)


def redirect(
    trajectory: Trajectory,
    parts: Sequence[int],
    turn: Float[Array, "3"],
    arm: Float[Array, "*parts 3"] | None = None,
    at: float | None = None,
    share: Share = 1.0,
) -> Trajectory:
    """The captured motion goes in another direction, and the part itself is not turned.

    Its path is turned about the handle (G M G^-1 instead of M): a lid that opened to the back opens to the
    side, a drawer slides where it is sent. A turn about a point of a hinge replaces the hinge's axis there.

    Args:
        turn: axis of the world times angle, radians.
        arm: from the handle to the point about which the path is turned, in the canonical scene, metres.
        at: when the part stays where it is, seconds; default: the first moment.
    """
    since, first, share = *_since(trajectory, parts, at), _over_time(trajectory, share)
    around = turned_about(first.apply(jnp.zeros(3) if arm is None else arm), share, turn)
    return _moved(trajectory, parts, around @ since @ around.inverse() @ first, share != 0)


def amplify(
    trajectory: Trajectory,
    parts: Sequence[int],
    factor: Scalar,
    at: float | None = None,
    share: Share = 1.0,
) -> Trajectory:
    """Parts go `factor` times as far: along the screw that leads to each moment, so about their hinges.

    Args:
        factor: more than 1 makes subtle motion visible, less calms it, 0 stops it, less goes the other way.
        at: when the parts stay where they are, seconds; default: the first moment. They must turn by less
            than a full turn from there.
    """
    by = 1 + _over_time(trajectory, share) * (factor - 1)
    since, first = _since(trajectory, parts, at)
    further = jaxlie.SE3.exp(by[..., None] * unwound(since))
    return _moved(trajectory, parts, further @ first, by != 1)


def scale(trajectory: Trajectory, parts: Sequence[int], factor: float, share: Share = 1.0) -> Trajectory:
    """Parts are `factor` times as large, about their handles.

    Raises:
        ValueError: `factor` is not more than 0.
    """
    if not factor > 0:
        raise ValueError(f"factor: expected more than 0, found {factor}; to hide a part, fade it")
    by = factor ** _over_time(trajectory, share)
    scales = trajectory.scales.at[:, _checked(trajectory, parts)].multiply(by)
    return eqx.tree_at(lambda t: t.scales, trajectory, scales)


def fade(
    trajectory: Trajectory, parts: Sequence[int], opacity: Scalar = 0.0, share: Share = 1.0
) -> Trajectory:
    """Parts become translucent, or vanish.

    Args:
        opacity: factor on their opacities, 0 to 1.
    """
    by = 1 + _over_time(trajectory, share) * (opacity - 1)
    opacities = trajectory.opacities.at[:, _checked(trajectory, parts)].multiply(by)
    return eqx.tree_at(lambda t: t.opacities, trajectory, opacities)


def ghost(
    trajectory: Trajectory, parts: Sequence[int], opacity: Scalar = 0.0, share: Share = 1.0
) -> Trajectory:
    """Only `parts` are shown; all else, the background included, is as faint as `opacity`."""
    return fade(trajectory, others(trajectory, parts), opacity, share)


def echo(trajectory: Trajectory, parts: Sequence[int], delay: float, opacity: Scalar = 1.0) -> Trajectory:
    """A copy of parts that does what they do `delay` seconds later; sooner if that is negative.

    It is to be drawn beside the original (`Layer`): all else is hidden in it, and it is hidden itself until
    what it does has begun.

    Args:
        opacity: factor on the opacities of the copy, 0 to 1.
    """
    sources = trajectory.times - delay
    copy = retime(trajectory, range(trajectory.num_parts), sources)
    early = jnp.where(sources < trajectory.times[0] - _INSTANT, 1.0, 0.0)
    return fade(ghost(fade(copy, parts, opacity), parts), parts, share=early)


def others(trajectory: Trajectory, parts: Sequence[int]) -> list[int]:
    """All parts but these."""
    chosen = set(_checked(trajectory, parts).tolist())
    return [p for p in range(trajectory.num_parts) if p not in chosen]


def _checked(trajectory: Trajectory, parts: Sequence[int]) -> Integer[np.ndarray, "parts"]:
    """The parts as an index, each once; raises a ValueError for one that is not there."""
    wrong = [p for p in parts if not 0 <= p < trajectory.num_parts]
    if wrong:
        raise ValueError(f"parts: expected numbers from 0 to {trajectory.num_parts - 1}, found {wrong[0]}")
    return np.array(list(dict.fromkeys(parts)), int)


def _stretch(trajectory: Trajectory, begin: float | None, end: float | None) -> tuple[Scalar, Scalar]:
    """Both ends of a stretch; default: those of the trajectory."""
    if begin is not None and end is not None and not begin < end:
        raise ValueError(f"end: expected a time after begin, {begin:g} s, found {end:g}")
    begin = trajectory.times[0] if begin is None else begin
    return begin, jnp.maximum(begin, trajectory.times[-1]) if end is None else end


def _state(trajectory: Trajectory) -> tuple[HandlePose, Float[Array, "T P"], Float[Array, "T P"]]:
    return trajectory.poses, trajectory.opacities, trajectory.scales


def _only(trajectory: Trajectory, parts: Sequence[int]) -> Trajectory:
    """The trajectory of some parts alone."""
    chosen = _checked(trajectory, parts)
    return Trajectory(trajectory.times, *jax.tree.map(lambda leaf: leaf[:, chosen], _state(trajectory)))


def _with(trajectory: Trajectory, parts: Sequence[int], seen: Trajectory) -> Trajectory:
    """The trajectory with that of some parts replaced."""
    chosen = _checked(trajectory, parts)
    changed = jax.tree.map(lambda old, new: old.at[:, chosen].set(new), _state(trajectory), _state(seen))
    return Trajectory(trajectory.times, *changed)


def _over_time(trajectory: Trajectory, share: Share) -> Float[Array, "T 1"]:
    return jnp.broadcast_to(share, trajectory.times.shape)[:, None]


def _moved(
    trajectory: Trajectory, parts: Sequence[int], motions: jaxlie.SE3, where: Bool[Array, "T 1"]
) -> Trajectory:
    """The trajectory with other motions of some parts at some moments; else as it was, to the bit."""
    old = _only(trajectory, parts)
    poses = jax.tree.map(
        lambda new, kept: jnp.where(where[..., None], new, kept), pose_of(motions), old.poses
    )
    return _with(trajectory, parts, eqx.tree_at(lambda t: t.poses, old, poses))


def _since(trajectory: Trajectory, parts: Sequence[int], at: float | None) -> tuple[jaxlie.SE3, jaxlie.SE3]:
    """How parts have moved since a time, and where they were then."""
    chosen = _only(trajectory, parts)
    motions = motions_of(chosen.poses)
    then = motions if at is None else motions_of(at_times(chosen, jnp.full(1, at)).poses)
    first = jaxlie.SE3(then.wxyz_xyz[0])
    return motions @ first.inverse(), first
