"""Cases of the fuzzer: seeded scenes, poisonous values at the limits of floats, and the inputs to poison."""

import dataclasses
import functools
import itertools
from collections.abc import Iterator
from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np

from benchmarks.scenes import ARRAYS, make_scene
from benchmarks.scenes import case as seeded
from gsjax.rasterize.plan import Plan

WIDTH, HEIGHT, NUM = 33, 17, 40
NEAR = 0.01
PER_GAUSSIAN = (*ARRAYS[:5], "features")


class Mode(NamedTuple):
    """Options of one compiled program."""

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
# Depths at which a mean is placed on the optical axis.
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
    """One poisoned element. As a string, joined by colons, it is the value of `--case`."""

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


def plan_of(mode: Mode) -> Plan:
    """A plan with capacity for all pairs of the scenes."""
    return Plan(WIDTH, HEIGHT, 4096, near_plane=NEAR, **mode.options)


@functools.lru_cache(maxsize=8)
def scene_of(name: str, seed: int) -> dict[str, np.ndarray]:
    """A small scene with every input."""
    mode = MODES[name]
    fields = {"width": WIDTH, "height": HEIGHT, "render_mode": "RGB", "channels": 3}
    fields |= {"sh_degree": mode.options.get("sh_degree"), "feature_channels": mode.feature_channels}
    scene = make_scene(dataclasses.replace(seeded(seed, NUM), **fields))
    scene = {k: np.float32(v) for k, v in scene.items()}
    for painted in ("colors", "features"):
        scene[painted] = scene[painted].astype(jnp.dtype(mode.dtype))
    scene["means2d_offset"] = np.zeros((1, NUM, 2), np.float32)
    scene["reads"] = np.zeros((1, plan_of(mode).num_tiles), np.int32)
    return scene


def poisoned(case: Case) -> dict[str, np.ndarray]:
    """The poisoned scene of a case."""
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


def cases(seed: int) -> Iterator[Case]:
    """An infinite sequence: for each scene and mode, every poison in a random row of every input."""
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
