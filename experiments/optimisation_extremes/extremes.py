"""Optimisations with extreme settings, scenes and data: do they stay finite and end at their best?"""

import warnings
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from time import perf_counter
from typing import Any, NamedTuple

import equinox as eqx
import jax
import numpy as np

import gsjax
from gsjax.data import Sequence
from gsjax.data.photographs import photographs_of
from gsjax.engine.drive import Drive
from gsjax.engine.parts.start import FIT
from gsjax.methods.deform import PRESETS
from gsjax.methods.distill import DistillConfig
from gsjax.methods.fit import FitConfig, StartConfig
from gsjax.methods.parts import PartsConfig
from gsjax.optim.compiler import host_options
from gsjax.scene.gaussians import Gaussians, take

TISSUE = "simulated:tissue?width=96&height=76&frames=12"
STILL = TISSUE + "&still=true"
PARTS = "simulated:hard_parts?case=small&width=96&height=72&cameras=4&frames=5"
STEPS = 600
WINDOW = 100
MILLION = 1_000_000


class Given(NamedTuple):
    """The input of an optimisation.

    Attributes:
        sequence: the recording.
        config: settings.
        gaussians: number of Gaussians that it starts with; None for the usual number.
    """

    sequence: Sequence
    config: Any
    gaussians: int | None = None


def run(options: dict[str, Any], seed: int, folder: Path) -> dict[str, Any]:
    """One optimisation; a ValueError is an outcome, any other error is raised."""
    given, begin = METHODS[options["method"]]
    given = CASES[options["case"]](given(seed))
    begun = perf_counter()
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always", UserWarning)
        try:
            row = _followed(begin(given))
        except ValueError as error:
            return {"finite": None, "said": f"error: {error}"}
    said = dict.fromkeys(str(one.message) for one in caught if one.category is not DeprecationWarning)
    return row | {"said": "; ".join(said), "seconds": perf_counter() - begun}


def _followed(ticks: Drive) -> dict[str, Any]:
    """Its losses to the end, and the loss of what it ends with, over the batches of its last window."""
    losses, skipped, stretch = [], 0, 0
    for now in ticks:
        if now.run.guard.best is None and now.run.guard.steps == 1:
            stretch = len(losses)  # from here on, losses can be compared
        losses.append(float(now.info["loss"]))
        skipped += bool(now.info["skipped"])
    last = np.array(losses[stretch:])
    window = min(WINDOW, len(last))
    best = float(np.convolve(last, np.full(window, 1 / window), "valid").min())
    ended = float(np.mean(_losses_at_end(ticks, window)))
    result = jax.tree.leaves(eqx.filter(ticks.run.params, eqx.is_inexact_array))
    return {
        "finite": all(bool(np.isfinite(np.asarray(leaf)).all()) for leaf in result),
        "best": best,
        "ended": ended,
        "lost": 100 * (ended / best - 1),
        "returns": ticks.run.guard.returns,
        "skipped": skipped,
        "curve": np.array(losses[:: max(1, len(losses) // 200)]).tolist(),
    }


def _losses_at_end(ticks: Drive, window: int) -> list[float]:
    """The losses of the parameters at the end on the batches of the last steps."""
    method, problem, last = ticks.method, ticks.problem, ticks.run
    key, losses = jax.random.key(method.config.seed), []

    def loss_of(params, state, batch, step):
        key_of_step = jax.random.fold_in(key, step)
        return method.step.update(params, state, batch, step=step, key=key_of_step)[2]["loss"]

    loss = jax.jit(loss_of, compiler_options=host_options() or None)
    for step in range(last.step - window, last.step):
        at, progress = last.having(step=step), step / max(1, last.step)
        batch, _ = method.batch(problem, at, progress)
        losses.append(float(loss(last.params, last.state, batch, step)))
    return losses


def _fit(given: Given) -> Drive:
    photographs = photographs_of(given.sequence.select(frames=[0]))
    config = given.config
    if given.gaussians is not None:
        config = replace(config, cap=given.gaussians, start=StartConfig("random", given.gaussians))
    return gsjax.fit(photographs, config)


def _deform(given: Given) -> Drive:
    gaussians = None
    if given.gaussians is not None:
        gaussians = _sized(_fit(Given(given.sequence, FIT_CONFIG)), given.gaussians)
    return gsjax.deform(given.sequence, given.config, teacher="none", gaussians=gaussians)


def _distill(given: Given) -> Drive:
    scene = _sized(_fit(Given(given.sequence, FIT_CONFIG)), given.gaussians)
    photographs = photographs_of(given.sequence.select(frames=[0]))
    return gsjax.distill(scene, photographs, "classes", given.config)


def _parts(given: Given) -> Drive:
    photographs = photographs_of(given.sequence.select(frames=[0]))
    scene = _sized(gsjax.fit(photographs, replace(FIT, steps=STEPS)), given.gaussians)
    return gsjax.parts(given.sequence, given.config, anchor=0, gaussians=scene)


def _sized(fitting: Drive, count: int | None) -> Gaussians:
    """The scene of a fit, with a number of Gaussians: the first ones, over and over."""
    for _ in fitting:
        pass
    scene = fitting.result
    return scene if count is None else take(scene, np.resize(np.arange(scene.num), count))


def _longer(given: Given) -> Given:
    config = given.config
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
        if isinstance(config, PartsConfig):
            names = ("rate", "turn_rate", "field_rate")
            rates = {name: factor * getattr(config.stream, name) for name in names}
            return given._replace(config=replace(config, stream=replace(config.stream, **rates)))
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
    return given._replace(sequence=given.sequence.select(frames=[0], cameras=[0]))


def _as_at_first(given: Given) -> Given:
    sequence = given.sequence
    images, depths = sequence.load_image, sequence.load_depth
    still = {"load_image": lambda t, c: images(0, c), "load_depth": lambda t, c: depths(0, c)}
    return given._replace(sequence=replace(sequence, **still))


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


CASES: dict[str, Callable[[Given], Given]] = {
    "as it is": lambda given: given,
    "ten times the steps": _longer,
    "rates ten times as high": _faster(10.0),
    "rates a tenth": _faster(0.1),
    "two Gaussians": lambda given: given._replace(gaussians=2),
    "a million Gaussians": lambda given: given._replace(gaussians=MILLION),
    "one view": _one_view,
    "one colour": _seen_as(lambda picture, t: np.full_like(picture, 130)),
    "a constant picture": _as_at_first,
    "the whole picture moves": _seen_as(lambda picture, t: np.roll(picture, 9 * t, axis=1)),
    "all at one time": _one_time,
    "depth with 5 % outliers": _outliers,
}


FIT_CONFIG = FitConfig(steps=STEPS, cap=4_000, start=StartConfig(count=2_000), coarse_until=0.0)


METHODS: dict[str, tuple[Callable[[int], Given], Callable[[Given], Drive]]] = {
    "fit": (lambda seed: Given(gsjax.open_sequence(STILL), replace(FIT_CONFIG, seed=seed)), _fit),
    "distill": (
        lambda seed: Given(
            gsjax.open_sequence(STILL), DistillConfig(iterations=STEPS, contrast_after=0.3, seed=seed)
        ),
        _distill,
    ),
    "parts": (lambda seed: Given(gsjax.open_sequence(PARTS), PartsConfig(seed=seed)), _parts),
}
for name in PRESETS:
    METHODS[f"deform {name}"] = (
        lambda seed, name=name: Given(
            gsjax.open_sequence(TISSUE), replace(PRESETS[name], warmup=200, iterations=STEPS, seed=seed)
        ),
        _deform,
    )
