"""Optimisations with extreme settings, scenes and data: do they stay finite and end at their best?"""

import re
import warnings
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

import gsjax
from experiments.optimisation_extremes.tracker import TRACKER, faster, longer, track
from experiments.shared.recordings import MASK_CAMERA
from gsjax.data import Sequence
from gsjax.data.photographs import photographs_of
from gsjax.engine.drive import Drive
from gsjax.engine.parts.start import FIT
from gsjax.methods.deform import PRESETS, DeformConfig
from gsjax.methods.distill import DistillConfig
from gsjax.methods.fit import FitConfig, GrowthConfig, StartConfig
from gsjax.methods.parts import PartsConfig
from gsjax.methods.track import TrackConfig
from gsjax.optim.compiler import host_options
from gsjax.scene.gaussians import Gaussians, take

TISSUE = "simulated:tissue?width=96&height=76&frames=12"
STILL = TISSUE + "&still=true"
TABLE = "simulated:tabletop?width=160&height=120&frames=24"
PARTS = "simulated:hard_parts?case=small&width=96&height=72&cameras=4"
FRAMES_OF_PARTS = range(0, 16, 3)  # all of the motion
STEPS = 600
STEPS_OF_A_FIT = 1_500
RELOCATED = 0.4  # share of them in which Gaussians are relocated, after which its losses can be compared
WINDOW = 100
MILLION = 1_000_000
STEPS_OF_A_MILLION = 60  # each takes seconds
SEEDS = 20


class Given(NamedTuple):
    """The input of an optimisation.

    Attributes:
        sequence: the recording.
        config: settings.
        gaussians: number of Gaussians that it starts with; None for the usual number.
        colors: type of the colours of a scene that it starts with; None for the usual one.
    """

    sequence: Sequence
    config: Any
    gaussians: int | None = None
    colors: Any = None


def run(options: dict[str, Any], seed: int, folder: Path) -> dict[str, Any]:
    """One optimisation; a ValueError is an outcome, any other error is raised."""
    method, case = options["method"], options["case"]
    if (why := WITHOUT_EFFECT.get((method, case))) is not None:
        return {"finite": None, "said": f"as it is: {why}"}
    if case == "twenty seeds":
        rows = [_outcome(method, CASES["as it is"], seed + i) for i in range(SEEDS)]
        worst = max(rows, key=lambda row: (not row["finite"], row.get("lost", row.get("error_mm", 0.0))))
        said = dict.fromkeys(row["said"] for row in rows if row["said"])
        totals = {key: sum(row.get(key, 0) for row in rows) for key in ("returns", "skipped") if key in worst}
        return worst | totals | {"said": "; ".join(said)}
    return _outcome(method, CASES[case], seed)


def _outcome(method: str, case: Callable[[Given], Given], seed: int) -> dict[str, Any]:
    made, begin = METHODS[method]
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always", UserWarning)
        try:
            row = begin(case(made(seed)))
        except ValueError as error:
            return {"finite": None, "said": f"error: {error}"}
    said = [str(one.message) for one in caught if one.category is not DeprecationWarning]
    return row | {"said": "; ".join([*_of_each_kind(said), *row.pop("said", [])])}


def _of_each_kind(messages: list[str]) -> list[str]:
    """The first of the messages that differ in numbers alone, and how many there are."""
    kinds: dict[str, list[str]] = {}
    for message in dict.fromkeys(messages):
        kinds.setdefault(re.sub(r"\d+", "#", message), []).append(message)
    return [of[0] + (f" ({len(of)} such messages)" if of[1:] else "") for of in kinds.values()]


def _followed(ticks: Drive) -> dict[str, Any]:
    """Its quality to the end, and that of what it ends with, over the batches of its last window."""
    values, skipped, stretch = [], 0, 0
    for now in ticks:
        if now.run.guard.best is None and now.run.guard.steps == 1:
            stretch = len(values)  # from here on, losses can be compared
        values.append(_quality(now.info))
        skipped += bool(now.info["skipped"])
    last = np.array(values[stretch:])
    window = min(WINDOW, len(last))
    best = float(np.convolve(last, np.full(window, 1 / window), "valid").max())
    ended = float(np.mean(_values_at_end(ticks, window)))
    return {
        "finite": _finite(ticks.run.params),
        "best": best,
        "ended": ended,
        "lost": max(best, ended) - ended,
        "returns": ticks.run.guard.returns,
        "skipped": skipped,
    }


def _quality(info: dict[str, Any]) -> float:
    """PSNR of the photograph, dB; without one, the loss in dB: 10 of them are a tenth of the loss."""
    return float(info["psnr"]) if "psnr" in info else -10 * float(np.log10(info["loss"]))


def _finite(tree: Any) -> bool:
    leaves = jax.tree.leaves(eqx.filter(tree, eqx.is_inexact_array))
    return all(bool(np.isfinite(np.asarray(leaf)).all()) for leaf in leaves)


def _values_at_end(ticks: Drive, window: int) -> list[float]:
    """The quality of the parameters at the end on the batches of the last steps."""
    method, problem, last = ticks.method, ticks.problem, ticks.run
    key, values = jax.random.key(method.config.seed), []

    def info_of(params, state, batch, step):
        key_of_step = jax.random.fold_in(key, step)
        return method.step.update(params, state, batch, step=step, key=key_of_step)[2]

    info = jax.jit(info_of, compiler_options=host_options() or None)
    for step in range(last.step - window, last.step):
        at, progress = last.having(step=step), step / max(1, last.step)
        batch, _ = method.batch(problem, at, progress)
        values.append(_quality(info(last.params, last.state, batch, step)))
    return values


def _fitting(given: Given) -> Drive:
    photographs = photographs_of(given.sequence.select(frames=[0]))
    config = given.config
    if given.gaussians is not None:
        config = replace(config, cap=given.gaussians, start=StartConfig("random", given.gaussians))
    return gsjax.fit(photographs, config)


def _deform(given: Given) -> Drive:
    is_given = given.gaussians is not None or given.colors is not None
    scene = _scene(given, SCENE_CONFIG) if is_given else None
    if is_given:
        warnings.warn("starts from a fitted scene, not from depth", stacklevel=2)
    return gsjax.deform(given.sequence, given.config, teacher="none", gaussians=scene)


def _distill(given: Given) -> Drive:
    photographs = photographs_of(given.sequence.select(frames=[0]))
    return gsjax.distill(_scene(given, SCENE_CONFIG), photographs, "classes", given.config)


def _parts(given: Given) -> Drive:
    start = replace(FIT.start, count=3_000)
    scene = _scene(given, replace(FIT, steps=STEPS, cap=4_000, start=start, coarse_until=0.0))
    return gsjax.parts(given.sequence, given.config, anchor=0, gaussians=scene)


def _scene(given: Given, config: FitConfig) -> Gaussians:
    """A scene of the first frame with the number of Gaussians that is asked for: the first ones, over and
    over."""
    fitting = gsjax.fit(photographs_of(given.sequence.select(frames=[0])), config)
    for _ in fitting:
        pass
    scene, count = fitting.result, given.gaussians
    scene = scene if count is None else take(scene, np.resize(np.arange(scene.num), count))
    return scene if given.colors is None else replace(scene, sh0=scene.sh0.astype(given.colors))


def _longer(given: Given) -> Given:
    config = given.config
    if isinstance(config, TrackConfig):
        return given._replace(config=longer(config))
    if isinstance(config, PartsConfig):
        refine = replace(config.refine, iterations=10 * config.refine.iterations)
        stream = replace(config.stream, iterations=10 * config.stream.iterations)
        return given._replace(config=replace(config, stream=stream, refine=refine))
    name = "steps" if isinstance(config, FitConfig) else "iterations"
    return given._replace(config=replace(config, **{name: 10 * getattr(config, name)}))


def _faster(factor: float) -> Callable[[Given], Given]:
    """All learning rates times a factor."""

    def changed(given: Given) -> Given:
        config = given.config
        if isinstance(config, TrackConfig):
            return given._replace(config=faster(config, factor))
        if isinstance(config, PartsConfig):
            stream, refine = config.stream, config.refine
            names = ("rate", "turn_rate", "field_rate")
            stream = replace(stream, **{name: factor * getattr(stream, name) for name in names})
            refine = replace(refine, rate=factor * refine.rate)
            return given._replace(config=replace(config, stream=stream, refine=refine))
        rates = {name: factor * rate for name, rate in vars(config.rates).items()}
        return given._replace(config=replace(config, rates=replace(config.rates, **rates)))

    return changed


def _seen_as(change: Callable[[np.ndarray, int], np.ndarray]) -> Callable[[Given], Given]:
    """Pictures replaced by `change(picture, t)`."""

    def changed(given: Given) -> Given:
        load = given.sequence.load_image
        return given._replace(sequence=replace(given.sequence, load_image=lambda t, c: change(load(t, c), t)))

    return changed


def _one_view(given: Given) -> Given:
    """A single picture; for the tracker, a single camera."""
    if isinstance(given.config, TrackConfig):
        return given._replace(sequence=given.sequence.select(cameras=[MASK_CAMERA]))
    return given._replace(sequence=given.sequence.select(frames=[0], cameras=[0]))


def _as_at_first(given: Given) -> Given:
    """All that is seen, and what is true of it, as in the first frame."""
    sequence, truth = given.sequence, given.sequence.truth
    loaders = ("load_image", "load_depth", "load_mask")
    still = {name: _first_of(getattr(sequence, name)) for name in loaders if getattr(sequence, name)}
    if truth is not None and truth.poses is not None:
        still["truth"] = replace(truth, poses=np.broadcast_to(truth.poses[:1], truth.poses.shape))
    return given._replace(sequence=replace(sequence, **still))


def _first_of(load: Callable[[int, int], Any]) -> Callable[[int, int], Any]:
    return lambda t, c: load(0, c)


def _outliers(given: Given) -> Given:
    """Depth of which one pixel in twenty is anywhere from a tenth to ten times as far."""
    load = given.sequence.load_depth

    def wrong(t: int, c: int) -> np.ndarray:
        depth, random = np.array(load(t, c), np.float32), np.random.default_rng((t, c))
        off = random.uniform(size=depth.shape) < 0.05
        return np.where(off, depth * 10 ** random.uniform(-1, 1, depth.shape), depth).astype(np.float32)

    return given._replace(sequence=replace(given.sequence, load_depth=wrong))


def _one_time(given: Given) -> Given:
    count = given.sequence.num_frames
    return given._replace(sequence=replace(given.sequence, times=np.full(count, 1.0), shared_times=True))


def _halved(given: Given) -> Given:
    """The colours of the scene that it starts from as float16."""
    return given._replace(colors=jnp.float16)


def _million(given: Given) -> Given:
    config = given.config
    if isinstance(config, FitConfig):
        config = replace(config, steps=STEPS_OF_A_MILLION)
    elif isinstance(config, DistillConfig):
        config = replace(config, iterations=STEPS_OF_A_MILLION)
    elif isinstance(config, DeformConfig):
        config = replace(config, warmup=STEPS_OF_A_MILLION // 2, iterations=STEPS_OF_A_MILLION // 2)
    elif isinstance(config, PartsConfig):
        stream = replace(config.stream, iterations=STEPS_OF_A_MILLION // 10)
        refine = replace(config.refine, iterations=STEPS_OF_A_MILLION // 2)
        config = replace(config, stream=stream, refine=refine)
    return given._replace(config=config, gaussians=MILLION)


CASES: dict[str, Callable[[Given], Given]] = {
    "as it is": lambda given: given,
    "ten times the steps": _longer,
    "rates ten times as high": _faster(10.0),
    "rates a hundred times as high": _faster(100.0),
    "rates a tenth": _faster(0.1),
    "two Gaussians": lambda given: given._replace(gaussians=2),
    "a million Gaussians": _million,
    "one view": _one_view,
    "one colour": _seen_as(lambda picture, t: np.full_like(picture, 130)),
    "a constant picture": _as_at_first,
    "the whole picture moves": _seen_as(lambda picture, t: np.roll(picture, 9 * t, axis=1)),
    "all at one time": _one_time,
    "depth with 5 % outliers": _outliers,
    "float16 colours": _halved,
}


WITHOUT_EFFECT = {
    **{
        (method, case): "it sees one frame"
        for method in ("fit", "distill")
        for case in ("a constant picture", "the whole picture moves", "all at one time")
    },
    ("track", "all at one time"): "it takes no times",
    ("fit", "float16 colours"): "it starts from points, and pictures are bytes",
    ("track", "float16 colours"): "it starts from points, and pictures are bytes",
    ("distill", "float16 colours"): "it learns features, which no colour enters",
}
SCENE_CONFIG = FitConfig(steps=STEPS, cap=4_000, start=StartConfig(count=2_000), coarse_until=0.0)
FIT_CONFIG = replace(SCENE_CONFIG, steps=STEPS_OF_A_FIT, growth=GrowthConfig(end=RELOCATED))


def _of(name: str, config: Any, frames: slice | range = slice(None)) -> Callable[[int], Given]:
    """What a method is given for a seed."""
    return lambda seed: Given(gsjax.open_sequence(name).select(frames), replace(config, seed=seed))


METHODS: dict[str, tuple[Callable[[int], Given], Callable[[Given], dict[str, Any]]]] = {
    "fit": (_of(STILL, FIT_CONFIG), lambda given: _followed(_fitting(given))),
    "distill": (
        _of(STILL, DistillConfig(iterations=STEPS, contrast_after=0.3)),
        lambda given: _followed(_distill(given)),
    ),
    "parts": (_of(PARTS, PartsConfig(), FRAMES_OF_PARTS), lambda given: _followed(_parts(given))),
    "track": (_of(TABLE, TRACKER), lambda given: track(given.sequence, given.config, given.gaussians)),
}
for name in PRESETS:
    config = replace(PRESETS[name], warmup=200, iterations=STEPS)
    METHODS[f"deform {name}"] = (_of(TISSUE, config), lambda given: _followed(_deform(given)))
