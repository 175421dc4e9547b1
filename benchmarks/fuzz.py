"""Fuzz the rasterizer: poison every input over seeded scenes; look for non-finite output and silent drops.

A case puts one value (NaN, an infinity, a denormal, a threshold, ...) into one input: a whole row, or one
element of it. Then every image and every gradient (or tangent) has to be finite, and

- a Gaussian that cannot be drawn is counted in `meta.culled`, and the rest is bitwise equal to the scene
  without it;
- a Gaussian that is not counted is drawn as in the float64 reference, or left out if it is invisible there;
- `reads` changes no bit; a camera that is not finite sees nothing and counts every row as culled; a
  background that is not finite, or whose square is not, is black.

Run it with

    python -m benchmarks.fuzz --minutes 5 --seed 0   # writes benchmarks/results/fuzz.json
    python -m benchmarks.fuzz --case MODE:SEED:INPUT:ROW:COLUMN:POISON   # one case; column -1: a whole row
"""

import argparse
import collections
import functools
import json
import time
from pathlib import Path
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from benchmarks.poisons import (
    HEIGHT,
    MODES,
    NEAR,
    NUM,
    PER_GAUSSIAN,
    POISONS,
    WIDTH,
    Case,
    cases,
    plan_of,
    poisoned,
    scene_of,
)
from benchmarks.scenes import ARRAYS, relative_error
from gsjax.engine import machine
from gsjax.rasterize.rasterization import rasterization
from gsjax.rasterize.reference import rasterization_reference

RESULT = Path(__file__).parent / "results" / "fuzz.json"
TOLERANCE = 1e-3  # relative to the image's largest value: far above rounding, far below a missing Gaussian


class Outcome(NamedTuple):
    images: list[np.ndarray]  # colours, alphas, features
    derivatives: dict[str, np.ndarray]  # gradients by input; or the images' tangents
    culled: int


def _random_like(tree, seed: int):
    rng = np.random.default_rng(seed)
    return jax.tree.map(lambda a: jnp.asarray(rng.normal(size=a.shape), a.dtype), tree)


@functools.cache
def _program(name: str):
    """The compiled program of a mode: scene -> images, derivatives, culled."""
    plan = plan_of(MODES[name])

    def images_of(scene, reads):
        colors, alphas, meta = rasterization(**scene, reads=reads, width=WIDTH, height=HEIGHT, plan=plan)
        return [colors, alphas, meta.features], meta.culled[0]

    def reverse(scene, reads):
        def objective(scene):
            images, culled = images_of(scene, reads)
            weights = _random_like(images, 1)
            return sum(jnp.vdot(a, w) for a, w in zip(images, weights, strict=True)), (images, culled)

        gradients, (images, culled) = jax.grad(objective, has_aux=True)(scene)
        return images, gradients, culled

    def forward(scene, reads):
        images, tangents, culled = jax.jvp(
            functools.partial(images_of, reads=reads), (scene,), (_random_like(scene, 1),), has_aux=True
        )
        return images, dict(zip(("colors", "alphas", "features"), tangents, strict=True)), culled

    return jax.jit(forward if plan.derivative == "forward" else reverse)


def run(name: str, scene: dict[str, np.ndarray]) -> Outcome:
    images, derivatives, culled = _program(name)(
        {k: v for k, v in scene.items() if k != "reads"}, scene["reads"]
    )
    return Outcome([np.asarray(a) for a in images], jax.tree.map(np.asarray, derivatives), int(culled))


@functools.cache
def _reference_program(name: str):
    options = {k: v for k, v in MODES[name].options.items() if k != "derivative"}

    def reference(scene):
        result = rasterization_reference(
            *(scene[name] for name in ARRAYS[:5]),
            scene["viewmats"][0],
            scene["Ks"][0],
            WIDTH,
            HEIGHT,
            near_plane=NEAR,
            background=scene["backgrounds"][0],
            features=scene["features"],
            **options,
        )
        return [result.colors, result.alphas, result.features], result.doubtful

    return jax.jit(reference)


@functools.cache
def _in_float64(name: str):
    """The rasterizer itself in float64, for cases beyond the reference; forward only."""
    plan = plan_of(MODES[name])

    def images_of(scene):
        colors, alphas, meta = rasterization(**scene, width=WIDTH, height=HEIGHT, plan=plan)
        return [colors[0], alphas[0], meta.features[0]], jnp.zeros((HEIGHT, WIDTH), bool)

    return jax.jit(images_of)


def _error(
    name: str, scene: dict[str, np.ndarray], images: list[np.ndarray], judge=_reference_program
) -> float:
    """Largest error of the images against a float64 program, relative to the image's largest value."""
    exact = {k: np.asarray(v, np.float64) for k, v in scene.items() if k not in ("reads", "means2d_offset")}
    exact["opacities"] = np.clip(exact["opacities"], 0.0, 1.0)
    with jax.enable_x64(True):
        want, doubtful = judge(name)(exact)
    certain = ~np.asarray(doubtful)[..., None]
    return max(relative_error(a[0], np.asarray(b), certain) for a, b in zip(images, want, strict=True))


@functools.lru_cache(maxsize=64)
def _clean(mode: str, seed: int) -> Outcome:
    return run(mode, scene_of(mode, seed))


def _without(scene: dict[str, np.ndarray], row: int) -> dict[str, np.ndarray]:
    opacities = scene["opacities"].copy()
    opacities[row] = 0.0
    return scene | {"opacities": opacities}


@functools.lru_cache(maxsize=64)
def _absent(mode: str, seed: int, row: int) -> Outcome:
    return run(mode, _without(scene_of(mode, seed), row))


def _differing(a: Outcome, b: Outcome) -> list[str]:
    """Names of the arrays that are not bitwise equal."""
    names = [f"image {i}" for i in range(3) if not np.array_equal(a.images[i], b.images[i])]
    return names + [k for k in a.derivatives if not np.array_equal(a.derivatives[k], b.derivatives[k])]


def check(case: Case) -> tuple[str, str]:
    """(what happened to the poisoned value, description of the failure or "")."""
    scene = poisoned(case)
    got = run(case.mode, scene)
    bad = [f"image {i}" for i, a in enumerate(got.images) if not np.isfinite(a).all()]
    bad += [k for k, a in got.derivatives.items() if not np.isfinite(np.float32(a)).all()]
    if bad:
        return "drawn", f"not finite: {', '.join(bad)}"
    nonfinite = not np.isfinite(np.float32(scene[case.input])).all()
    if case.input == "reads":
        return "ignored", _listed("changed", _differing(got, _clean(case.mode, case.seed)))
    with np.errstate(over="ignore"):
        overflows = ~np.isfinite(scene["backgrounds"] ** 2)
    if case.input == "backgrounds" and overflows.any():
        black = run(
            case.mode, scene | {"backgrounds": np.where(overflows, np.float32(0), scene["backgrounds"])}
        )
        # A background treated as black has no derivative; one that is black does.
        own = ("backgrounds", "colors") if "alphas" in got.derivatives else ("backgrounds",)
        return "black", _listed("changed", [k for k in _differing(got, black) if k not in own])
    if case.input in ("viewmats", "Ks") and nonfinite:
        sees = bool(got.images[1].any())
        return "culled", f"{got.culled} of {NUM} counted" if got.culled < NUM else "it is not blank" * sees
    if case.input in (*PER_GAUSSIAN, "means2d_offset"):
        absent = _absent(case.mode, case.seed, case.row)
        if got.culled:
            counted = "" if got.culled == 1 else f"{got.culled} counted; "
            return "culled", counted + _listed("other Gaussians changed", _differing(got, absent))
        if nonfinite:
            return "drawn", "neither drawn nor counted"
        if not _differing(got, absent):
            comparable = case.input != "means2d_offset" or abs(POISONS[case.poison]) > 1
            if comparable and _error(case.mode, scene, got.images) <= TOLERANCE:
                return "invisible", ""
    if case.input == "means2d_offset":  # not an input of the reference
        value = float(POISONS[case.poison])
        if abs(value) > 1e6:
            return "invisible", _listed("other Gaussians changed", _differing(got, absent))
        small = abs(value) < 1e-9
        return "drawn", _listed("changed", _differing(got, _clean(case.mode, case.seed))) if small else ""
    if got.culled:  # a camera in which some Gaussians have zero area
        return "culled", ""
    if case.input == "viewmats" and abs(POISONS[case.poison]) > 1e3:
        # No rigid motion, or beyond float32: it only has to be finite (docs/numerics.md has the distances).
        return "drawn", ""
    error = _error(case.mode, scene, got.images)
    if error > TOLERANCE and case.input in ("scales", "Ks"):
        # The reference forms full covariances, in which a needle's width is lost next to its squared length.
        error = _error(case.mode, scene, got.images, _in_float64)
    if error > TOLERANCE and case.poison in ("at near", "below near", "far"):
        # Exactly on the plane, rounding decides.
        error = _error(case.mode, _without(scene, case.row), got.images)
    return "drawn", "" if error <= TOLERANCE else f"off the reference by {error:.1e}"


def _listed(what: str, names: list[str]) -> str:
    return f"{what}: {', '.join(names)}" if names else ""


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--minutes", type=float, default=5.0)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--case", type=Case.parse, help="a single case, as printed for a failure")
    arguments = parser.parse_args()
    if arguments.case:
        outcome, failure = check(arguments.case)
        raise SystemExit(f"{arguments.case}: {outcome}; {failure}" if failure else f"{outcome}, as expected")
    print(machine.in_words(machine.describe()))
    began = time.perf_counter()
    for mode in MODES:
        _error(mode, scene_of(mode, 0), run(mode, scene_of(mode, 0)).images)
    compiling = time.perf_counter() - began
    print(f"{len(MODES)} modes compiled in {compiling:.0f} s", flush=True)
    began, count, failures = time.perf_counter(), 0, []
    by_input, by_poison = (collections.defaultdict(collections.Counter) for _ in range(2))
    modes = collections.Counter()
    for case in cases(arguments.seed):
        if time.perf_counter() - began > 60 * arguments.minutes:
            break
        outcome, failure = check(case)
        count += 1
        modes[case.mode] += 1
        by_input[case.input][outcome] += 1
        by_poison["reads: " + case.poison if case.input == "reads" else case.poison][outcome] += 1
        if failure:
            failures.append({"case": str(case), "what": failure})
            print(f"python -m benchmarks.fuzz --case '{case}'  # {failure}", flush=True)
    seconds = time.perf_counter() - began
    for title, table in (("input", by_input), ("poison", by_poison)):
        print(f"\n{title:15} {'cases':>7}  outcomes")
        for name, counts in table.items():
            words = ", ".join(f"{n} {outcome}" for outcome, n in counts.most_common())
            print(f"{name:15} {counts.total():7}  {words}")
    print(f"\n{count} cases in {seconds:.0f} s ({len(modes)} modes), {len(failures)} failures")
    record = {
        "machine": machine.describe(),
        "seed": arguments.seed,
        "seconds": round(seconds),
        "seconds_of_compiling": round(compiling),
        "cases": count,
        "failures": failures,
        "cases_by_mode": modes,
        "by_input": by_input,
        "by_poison": by_poison,
    }
    RESULT.parent.mkdir(exist_ok=True)
    RESULT.write_text(json.dumps(record, indent=1) + "\n")
    if failures:
        raise SystemExit(1)


if __name__ == "__main__":
    main()
