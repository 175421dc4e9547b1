"""Poison in every input of the rasterizer, over seeded scenes: is anything non-finite, or dropped in silence?

A case puts one value (NaN, an infinity, a denormal, a threshold, ...) into one input: a whole row or one
number of it. Then every image and every gradient (or tangent) has to be finite, and

- what cannot be drawn is counted in `meta.culled`, and all the rest is to the bit as in the scene without it;
- what is not counted is drawn as the float64 reference draws it, or left out where that shows nothing;
- `reads` changes no bit; a camera that is not finite sees nothing and counts every row; a background that
  is not finite, or whose square is not, is black.

Run it with

    python -m benchmarks.fuzz --minutes 5 --seed 0   # writes benchmarks/results/fuzz.json
    python -m benchmarks.fuzz --case MODE:SEED:INPUT:ROW:COLUMN:POISON   # one again; column -1: the whole row
"""

import argparse
import collections
import dataclasses
import functools
import itertools
import json
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from benchmarks.scenes import ARRAYS, make_scene, relative_error
from benchmarks.scenes import case as seeded
from gsjax.cli import machine
from gsjax.rasterize.plan import Plan
from gsjax.rasterize.rasterization import rasterization
from gsjax.rasterize.reference import rasterization_reference

RESULT = Path(__file__).parent / "results" / "fuzz.json"
WIDTH, HEIGHT, NUM = 33, 17, 40
NEAR = 0.01
PER_GAUSSIAN = (*ARRAYS[:5], "features")
TOLERANCE = 1e-3  # of the image's largest value: far above rounding, far below one Gaussian left out


class Mode(NamedTuple):
    """One compiled program."""

    options: dict[str, Any]
    dtype: str = "float32"  # of colours and features
    feature_channels: int = 2


MODES = {
    "rgb": Mode({}),
    "depth": Mode({"render_mode": "RGB+ED"}),
    "antialiased": Mode({"render_mode": "RGB+ED", "rasterize_mode": "antialiased"}),
    "harmonics": Mode({"rasterize_mode": "antialiased", "sh_degree": 3}),
    "bfloat16": Mode({}, "bfloat16"),
    "float16": Mode({}, "float16"),
    "channels": Mode({"render_mode": "RGB+D"}, feature_channels=16),  # composited by matmuls
    "forward": Mode({"render_mode": "RGB+ED", "sh_degree": 3, "derivative": "forward"}),
}

_F32 = np.finfo(np.float32)
POISONS = {
    "nan": np.nan,
    "inf": np.inf,
    "-inf": -np.inf,
    "largest": _F32.max,
    "1e38": 1e38,
    "-1e38": -1e38,
    "1e19": 1e19,
    "1e12": 1e12,
    "-1e6": -1e6,
    "denormal": _F32.smallest_subnormal,
    "smallest": _F32.tiny,
    "1e-19": 1e-19,
    "1e-12": 1e-12,
    "1e-6": 1e-6,
    "0": 0.0,
    "-0": -0.0,
    "1": 1.0,
    "-1": -1.0,
    "1/255": np.float32(1 / 255),
    "below 1/255": np.nextafter(np.float32(1 / 255), np.float32(0)),
    "0.99": np.float32(0.99),
    "above 0.99": np.nextafter(np.float32(0.99), np.float32(1)),
    "near": NEAR,
    "eps2d": 0.3,
    "1e5": 1e5,
    "1e10": 1e10,
}
# Places of a mean on the optical axis, as depths.
PLACES = {
    "at 0": 0.0,
    "at near": NEAR,
    "below near": NEAR * (1 - 1e-6),
    "above near": NEAR * (1 + 1e-3),
    "behind": -1.0,
    "far": 1e10,
}
INTEGERS = {"0": 0, "-1": -1, "1": 1, "largest": 2**31 - 1, "smallest": -(2**31), "999": 999}
INPUTS = (*PER_GAUSSIAN, "means2d_offset", "viewmats", "Ks", "backgrounds", "reads")


class Case(NamedTuple):
    """Which poison goes where. Printed with colons between, it is what `--case` takes."""

    mode: str
    seed: int
    input: str
    row: int
    column: int  # into the row, flattened; -1 for the whole row
    poison: str

    def __str__(self) -> str:
        return ":".join(map(str, self))

    @classmethod
    def parse(cls, text: str) -> "Case":
        mode, seed, name, row, column, poison = text.split(":")
        return cls(mode, int(seed), name, int(row), int(column), poison)


class Outcome(NamedTuple):
    images: list[np.ndarray]  # colours, alphas, features
    derivatives: dict[str, np.ndarray]  # gradients by input; or the images' tangents
    culled: int


def _plan(mode: Mode) -> Plan:
    return Plan(WIDTH, HEIGHT, 4096, near_plane=NEAR, **mode.options)


@functools.lru_cache(maxsize=8)
def scene_of(name: str, seed: int) -> dict[str, np.ndarray]:
    """A small scene that has every input."""
    mode = MODES[name]
    fields = {"width": WIDTH, "height": HEIGHT, "render_mode": "RGB", "channels": 3}
    fields |= {"sh_degree": mode.options.get("sh_degree"), "feature_channels": mode.feature_channels}
    scene = make_scene(dataclasses.replace(seeded(seed, NUM), **fields))
    scene = {k: np.float32(v) for k, v in scene.items()}
    for painted in ("colors", "features"):
        scene[painted] = scene[painted].astype(jnp.dtype(mode.dtype))
    scene["means2d_offset"] = np.zeros((1, NUM, 2), np.float32)
    scene["reads"] = np.zeros((1, _plan(mode).num_tiles), np.int32)
    return scene


def _random_like(tree, seed: int):
    rng = np.random.default_rng(seed)
    return jax.tree.map(lambda a: jnp.asarray(rng.normal(size=a.shape), a.dtype), tree)


@functools.cache
def _program(name: str):
    """scene -> images, derivatives, culled: the one program of a mode."""
    plan = _plan(MODES[name])

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
    """The rasterizer itself, for what the reference cannot tell; forward only."""
    plan = _plan(MODES[name])

    def images_of(scene):
        colors, alphas, meta = rasterization(**scene, width=WIDTH, height=HEIGHT, plan=plan)
        return [colors[0], alphas[0], meta.features[0]], jnp.zeros((HEIGHT, WIDTH), bool)

    return jax.jit(images_of)


def _error(
    name: str, scene: dict[str, np.ndarray], images: list[np.ndarray], judge=_reference_program
) -> float:
    """Largest error of images against a float64 program, of an image's largest value."""
    exact = {k: np.asarray(v, np.float64) for k, v in scene.items() if k not in ("reads", "means2d_offset")}
    exact["opacities"] = np.clip(exact["opacities"], 0.0, 1.0)
    with jax.enable_x64(True):
        want, doubtful = judge(name)(exact)
    certain = ~np.asarray(doubtful)[..., None]
    return max(relative_error(a[0], np.asarray(b), certain) for a, b in zip(images, want, strict=True))


def poisoned(case: Case) -> dict[str, np.ndarray]:
    """The scene of a case."""
    scene = scene_of(case.mode, case.seed)
    array = scene[case.input].copy()
    rows = array if case.input in PER_GAUSSIAN else array[0]
    if case.poison in PLACES:
        viewmat = np.float64(scene["viewmats"][0])
        rows[case.row] = (np.array([0, 0, PLACES[case.poison]]) - viewmat[:3, 3]) @ viewmat[:3, :3]
    else:
        table = INTEGERS if case.input == "reads" else POISONS
        at = case.row if case.column < 0 else (case.row, *np.unravel_index(case.column, rows.shape[1:]))
        with np.errstate(over="ignore"):  # 1e38 is an infinity in float16
            rows[at] = np.asarray(table[case.poison]).astype(rows.dtype)
    return scene | {case.input: array}


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
    """What of two outcomes is not equal to the bit."""
    names = [f"image {i}" for i in range(3) if not np.array_equal(a.images[i], b.images[i])]
    return names + [k for k in a.derivatives if not np.array_equal(a.derivatives[k], b.derivatives[k])]


def check(case: Case) -> tuple[str, str]:
    """(what became of the poison, what is wrong with that or "")."""
    scene = poisoned(case)
    got = run(case.mode, scene)
    bad = [f"image {i}" for i, a in enumerate(got.images) if not np.isfinite(a).all()]
    bad += [k for k, a in got.derivatives.items() if not np.isfinite(np.float32(a)).all()]
    if bad:
        return "drawn", f"not finite: {', '.join(bad)}"
    harmful = not np.isfinite(np.float32(scene[case.input])).all()
    if case.input == "reads":
        return "ignored", _said("changed", _differing(got, _clean(case.mode, case.seed)))
    with np.errstate(over="ignore"):
        overflows = ~np.isfinite(scene["backgrounds"] ** 2)
    if case.input == "backgrounds" and overflows.any():
        black = run(
            case.mode, scene | {"backgrounds": np.where(overflows, np.float32(0), scene["backgrounds"])}
        )
        # What counts as black has no derivative; a black background has.
        own = ("backgrounds", "colors") if "alphas" in got.derivatives else ("backgrounds",)
        return "black", _said("changed", [k for k in _differing(got, black) if k not in own])
    if case.input in ("viewmats", "Ks") and harmful:
        sees = bool(got.images[1].any())
        return "culled", f"{got.culled} of {NUM} counted" if got.culled < NUM else "it sees" * sees
    if case.input in (*PER_GAUSSIAN, "means2d_offset"):
        absent = _absent(case.mode, case.seed, case.row)
        if got.culled:
            counted = "" if got.culled == 1 else f"{got.culled} counted; "
            return "culled", counted + _said("neighbours touched", _differing(got, absent))
        if harmful:
            return "drawn", "neither drawn nor counted"
        if not _differing(got, absent):
            fine = case.input != "means2d_offset" or abs(POISONS[case.poison]) > 1
            if fine and _error(case.mode, scene, got.images) <= TOLERANCE:
                return "invisible", ""
    if case.input == "means2d_offset":  # the reference has no such input
        value = float(POISONS[case.poison])
        if abs(value) > 1e6:
            return "invisible", _said("neighbours touched", _differing(got, absent))
        small = abs(value) < 1e-9
        return "drawn", _said("changed", _differing(got, _clean(case.mode, case.seed))) if small else ""
    if got.culled:  # a camera in which some Gaussians have no area
        return "culled", ""
    if case.input == "viewmats" and abs(POISONS[case.poison]) > 1e3:
        # No rigid motion, or one beyond float32: finite and no more (docs/numerics.md has the distances).
        return "drawn", ""
    error = _error(case.mode, scene, got.images)
    if error > TOLERANCE and case.input in ("scales", "Ks"):
        # The reference multiplies covariances out: a needle's width is lost beside the square of its length.
        error = _error(case.mode, scene, got.images, _in_float64)
    if error > TOLERANCE and case.poison in ("at near", "below near", "far"):
        # On the very plane rounding decides.
        error = _error(case.mode, _without(scene, case.row), got.images)
    return "drawn", "" if error <= TOLERANCE else f"off the reference by {error:.1e}"


def _said(what: str, names: list[str]) -> str:
    return f"{what}: {', '.join(names)}" if names else ""


def cases(seed: int) -> Iterator[Case]:
    """Without end: scene after scene in every mode, every poison in a random row of every input."""
    for scene_seed in itertools.count(seed):
        for mode in MODES:
            rng = np.random.default_rng([scene_seed, len(mode)])
            for name in INPUTS:
                shape = scene_of(mode, scene_seed)[name].shape
                shape = shape if name in PER_GAUSSIAN else shape[1:]
                columns = {-1, int(rng.integers(np.prod(shape[1:], dtype=int)))} if len(shape) > 1 else {-1}
                row = int(rng.choice([0, shape[0] - 1, *rng.integers(shape[0], size=4)]))
                poisons = INTEGERS if name == "reads" else POISONS
                for column, poison in itertools.product(sorted(columns), poisons):
                    yield Case(mode, scene_seed, name, row, column, poison)
                for place in PLACES if name == "means" else ():
                    yield Case(mode, scene_seed, name, row, -1, place)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--minutes", type=float, default=5.0)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--case", type=Case.parse, help="one case as a failure printed it")
    arguments = parser.parse_args()
    if arguments.case:
        outcome, failure = check(arguments.case)
        raise SystemExit(
            f"{arguments.case}: {outcome}; {failure}" if failure else f"{outcome}, as it should be"
        )
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
        print(f"\n{title:15} {'cases':>7}  what became of them")
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
