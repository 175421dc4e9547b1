"""What splitting a step over devices costs: the same work on 1, 2 and 4 virtual devices of one machine.

    python -m experiments.many_devices.scaling

A step draws all cameras, differentiates and applies Adam. The devices share the machine's cores, so the best
that can come out is the same time; what is more is the price of splitting. All programs live in one process
and take turns, so that what else the machine does meets them alike. Writes scaling.json beside this file and
docs/images/many-devices.svg; `--plot-only` draws the committed figures again.
"""

import json
import os
import time
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import optax
import tyro
from jax.sharding import NamedSharding
from jax.sharding import PartitionSpec as P
from matplotlib.figure import Figure

import gsjax
from gsjax.engine import machine
from gsjax.geometry.cameras import intrinsics, look_at

HERE = Path(__file__).resolve().parent
FIGURE = HERE.parents[1] / "docs" / "images" / "many-devices.svg"
DEVICES = (1, 2, 4)
PLAIN = "gsjax.rasterization"


def a_scene(num: int, cameras: int, width: int, height: int) -> tuple[dict, dict]:
    """Seeded Gaussians in a ball, and cameras in a ring around it."""
    rng = np.random.default_rng(0)
    eyes = [(1.5 * np.cos(a), 1.5 * np.sin(a), 0.8) for a in np.arange(cameras) * 2 * np.pi / cameras]
    gaussians = {
        "means": rng.uniform(-0.5, 0.5, (num, 3)),
        "quats": rng.normal(size=(num, 4)),
        "scales": np.exp(rng.uniform(-6, -4, (num, 3))),
        "opacities": rng.uniform(0.2, 0.95, num),
        "colors": rng.uniform(0, 1, (num, 3)),
    }
    views = {
        "viewmats": np.stack([look_at(np.array(eye), np.zeros(3)) for eye in eyes]),
        "Ks": np.broadcast_to(intrinsics(1.1 * width, width, height), (cameras, 3, 3)),
        "targets": rng.uniform(0, 1, (cameras, height, width, 3)),
    }
    return tuple({k: a.astype(np.float32) for k, a in part.items()} for part in (gaussians, views))


def make_step(draw, plan: gsjax.Plan, adam):
    """One jitted training step: (params, state, views) -> (params, state)."""

    def loss(params, views):
        colors, _, meta = draw(
            **params,
            viewmats=views["viewmats"],
            Ks=views["Ks"],
            width=plan.width,
            height=plan.height,
            plan=plan,
        )
        return jnp.abs(colors - views["targets"]).mean(), meta.pairs.sum()

    @jax.jit
    def step(params, state, views):
        grads, pairs = jax.grad(loss, has_aux=True)(params, views)
        updates, state = adam.update(grads, state)
        return optax.apply_updates(params, updates), state, pairs

    return step


def measure(num: int, cameras: int, width: int, height: int, rounds: int) -> dict:
    jax.config.update("jax_platforms", "cpu")
    jax.config.update("jax_num_cpu_devices", max(DEVICES))
    gaussians, views = a_scene(num, cameras, width, height)
    geometry = [gaussians[k] for k in ("means", "quats", "scales", "opacities")]
    plan = gsjax.plan(*geometry, views["viewmats"], views["Ks"], width, height, headroom=1.5)
    adam = optax.adam(1e-4)

    runs = {}
    for count in (PLAIN, *DEVICES):
        draw, params, placed = gsjax.rasterization, gaussians, views
        if count != PLAIN:
            mesh = jax.make_mesh((count,), ("cameras",), devices=jax.devices()[:count])
            draw = gsjax.sharded_rasterization(mesh, cameras="cameras")
            params = jax.device_put(gaussians, NamedSharding(mesh, P()))
            placed = jax.device_put(views, NamedSharding(mesh, P("cameras")))
        params = jax.tree.map(jnp.asarray, params)
        step, state = make_step(draw, plan, adam), adam.init(params)
        start = time.perf_counter()
        params, state, pairs = jax.block_until_ready(step(params, state, placed))
        print(f"{count}: compiled and ran in {time.perf_counter() - start:.1f} s", flush=True)
        runs[str(count)] = [step, params, state, placed]

    load = os.getloadavg()[0]
    seconds = {name: [] for name in runs}
    for turn in range(rounds):
        for name in np.roll(list(runs), turn):  # nobody always runs after the same neighbour
            step, params, state, placed = runs[name]
            start = time.perf_counter()
            params, state, _ = jax.block_until_ready(step(params, state, placed))
            seconds[name].append(time.perf_counter() - start)
            runs[name][1:3] = params, state

    one = np.array(seconds[PLAIN])
    rows = {
        name: {
            "best_ms": round(1e3 * min(times), 1),
            "quartiles_ms": np.percentile(1e3 * np.array(times), [25, 50, 75]).round(1).tolist(),
            "times_plain": np.percentile(np.array(times) / one, [25, 50, 75]).round(3).tolist(),
        }
        for name, times in seconds.items()
    }
    floats = sum(a.size for a in gaussians.values()) // num
    return {
        "steps": rows,
        "gaussians": num,
        "cameras": cameras,
        "size": [width, height],
        "tile_pairs": int(pairs),
        "sent_bytes_per_step": 4 * floats * num,
        "rounds": rounds,
        "cores": os.cpu_count(),
        "load_before": round(load, 1),
        "load_after": round(os.getloadavg()[0], 1),
        "machine": machine.in_words(machine.describe()),
    }


def plot(result: dict) -> Figure:
    """Time of a step over the number of devices, and the plain call as the line to stay at."""
    figure = Figure(figsize=(6.2, 3.4), layout="constrained")
    axes = figure.add_subplot()
    low, middle, high = np.array([result["steps"][str(n)]["quartiles_ms"] for n in DEVICES]).T
    best = [result["steps"][str(n)]["best_ms"] for n in DEVICES]
    where = np.arange(len(DEVICES))
    axes.errorbar(where, middle, (middle - low, high - middle), fmt="o", color="#0072b2", capsize=4)
    axes.plot(where, best, "_", color="#0072b2", ms=14, mew=2)
    plain = result["steps"][PLAIN]
    for value, style in ((plain["quartiles_ms"][1], "-"), (plain["best_ms"], ":")):
        axes.axhline(value, color="#d55e00", lw=1.2, ls=style)
    axes.plot([], [], "o", color="#0072b2", label="split: median and quartiles")
    axes.plot([], [], "_", color="#0072b2", ms=14, mew=2, label="split: best")
    axes.plot([], [], color="#d55e00", label=f"{PLAIN}: median")
    axes.plot([], [], color="#d55e00", ls=":", label=f"{PLAIN}: best")
    axes.set_xticks(where, [str(n) for n in DEVICES])
    axes.set_xlim(-0.5, len(DEVICES) - 0.5)
    axes.set_ylim(0, None)
    axes.set_xlabel(f"virtual devices, which share {result['cores']} cores")
    axes.set_ylabel("one step, ms")
    axes.set_title(f"The same {result['cameras']} cameras: what splitting costs", loc="left")
    axes.spines[["top", "right"]].set_visible(False)
    axes.legend(frameon=False, fontsize="small", ncols=2, loc="lower center")
    return figure


def main(
    num: int = 20_000,
    cameras: int = 4,
    width: int = 320,
    height: int = 240,
    rounds: int = 25,
    plot_only: bool = False,
) -> None:
    """Measure, write the result and draw it.

    Args:
        num: Gaussians.
        cameras: of all devices together; a multiple of 4.
        width, height: pixels of an image.
        rounds: steps of each program.
        plot_only: draw the result that is there.
    """
    file = HERE / "scaling.json"
    if not plot_only:
        file.write_text(
            json.dumps(measure(num, cameras, width, height, rounds), indent=2) + "\n", encoding="utf-8"
        )
    result = json.loads(file.read_text(encoding="utf-8"))
    plot(result).savefig(FIGURE, metadata={"Date": None})
    for name, row in result["steps"].items():
        print(
            f"{name:>20}  best {row['best_ms']:7.1f} ms   median {row['quartiles_ms'][1]:7.1f} ms   "
            f"x {row['times_plain'][1]:.3f} of plain"
        )


if __name__ == "__main__":
    tyro.cli(main)
