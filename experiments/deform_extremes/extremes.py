"""Does a deforming scene stay finite with extreme settings, teachers and scenes?"""

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

import gsjax
from experiments.shared.deforming import one_frame
from gsjax.engine.deform.scores import draw
from gsjax.engine.drive import drive
from gsjax.methods.deform import (
    Deform,
    DeformConfig,
    DeformRatesConfig,
    DeformWeightsConfig,
    GraphConfig,
    Lesson,
    start_gaussians,
)
from gsjax.methods.deform.method import PLAN
from gsjax.scene.deformation import DeformationConfig
from gsjax.scene.frame import Frame
from gsjax.scene.gaussians import Gaussians

DATA = "simulated:tissue?width=64&height=52&frames=6"
BASE = DeformConfig(
    warmup=5,
    iterations=25,
    start_pixels=1.0,
    nodes=64,
    channels=4,
    deformation=DeformationConfig(resolution=16, time_resolution=6, levels=1, channels=4, hidden=16),
    graph=GraphConfig(after=0.2, nodes=32, neighbors=3, matches=2, window=1),
)
CODES = np.eye(2, 4)
FAR_TIMES = (-1e9, 0.0, 0.5, 1.0, 1e9)


class Given(NamedTuple):
    """The input of a reconstruction."""

    frames: list[Frame]
    config: DeformConfig
    lesson: Lesson
    gaussians: Gaussians | None = None


def _config(**settings: Any) -> Callable[[Given], Given]:
    return lambda given: given._replace(config=replace(given.config, **settings))


def _field(**settings: Any) -> Callable[[Given], Given]:
    return _config(deformation=replace(BASE.deformation, **settings))


def _graph(**settings: Any) -> Callable[[Given], Given]:
    return _config(graph=replace(BASE.graph, **settings))


def _frames(change: Callable[[Frame], Frame]) -> Callable[[Given], Given]:
    return lambda given: given._replace(frames=[change(frame) for frame in given.frames])


def _codes(change: Callable[[np.ndarray], np.ndarray]) -> Callable[[Given], Given]:
    return lambda given: given._replace(lesson=given.lesson._replace(codebook=change(given.lesson.codebook)))


def _one_frame(given: Given) -> Given:
    return given._replace(frames=given.frames[:1], lesson=given.lesson._replace(ids=given.lesson.ids[:1]))


def _start(change: Callable[[Gaussians], Gaussians]) -> Callable[[Given], Given]:
    def changed(given: Given) -> Given:
        return given._replace(gaussians=change(start_gaussians(given.frames, 0, given.config.start_pixels)))

    return changed


def _larger(factor: float) -> Callable[[Frame], Frame]:
    """The same scene in another unit of length."""

    def of(frame: Frame) -> Frame:
        viewmat = frame.cameras.viewmat.copy()
        viewmat[:, :3, 3] *= factor
        cameras = replace(frame.cameras, viewmat=viewmat, near=frame.cameras.near * factor)
        return replace(frame, cameras=cameras, depths=frame.depths * factor)

    return of


def _one_pixel(frame: Frame) -> Frame:
    masks = np.zeros_like(frame.masks)
    masks[:, 20:22, 20:22] = True
    return replace(frame, masks=masks)


def _with(name: str, value: Callable[[Any], Any]) -> Callable[[Gaussians], Gaussians]:
    return lambda gaussians: eqx.tree_at(lambda g: getattr(g, name), gaussians, replace_fn=value)


CASES: dict[str, Callable[[Given], Given]] = {
    "as it is": lambda given: given,
    "GaussianClin's turns and pairs": lambda given: _graph(kind="similarity")(_field(rotation="add")(given)),
    "sines": _field(kind="mlp"),
    "sines of 2^20 half periods": _field(kind="mlp", frequencies=20),
    "voxels": _field(kind="voxels"),
    "two vertices an axis and of time": _field(resolution=2, time_resolution=2),
    "all that can change over time": _field(color=True, opacity=True, feature=True, semantic=True),
    "one node": _config(nodes=1),
    "more nodes than Gaussians": _config(nodes=100_000),
    "no nodes, one Gaussian in a hundred deforms": _config(nodes=0, moving_share=0.01),
    "rates a thousand times as high": _config(
        rates=DeformRatesConfig(*(1e3 * rate for rate in vars(DeformRatesConfig()).values()))
    ),
    "weights 1e9": _config(weights=DeformWeightsConfig(depth=1e9, feature=1e9, plane_tv=1e9)),
    "two nodes in the graph": _graph(nodes=2),
    "a graph whose edges end at 1e-6 radii": _graph(tau_x=1e-6, tau_t=1e-6),
    "a graph of weight 1e9": _graph(node=1e9, structure=1e9),
    "codes of length 1e6": _codes(lambda codes: 1e6 * codes),
    "codes of length 1e-6": _codes(lambda codes: 1e-6 * codes),
    "codes all alike": _codes(np.ones_like),
    "four pixels count": _frames(_one_pixel),
    "one look": _one_frame,
    "all looks at one time": _frames(lambda frame: replace(frame, time=np.asarray(0.5))),
    "in micrometres": _frames(_larger(1e6)),
    "in kilometres": _frames(_larger(1e-3)),
    "a Gaussian 1000 km away": _start(_with("means", lambda a: a.at[0].set(jnp.array([1e6, 0.0, 0.0])))),
    "ten Gaussians without a place": _start(_with("means", lambda a: a.at[:10].set(jnp.nan))),
    "all scales 1e-12": _start(_with("log_scales", lambda a: jnp.full_like(a, np.log(1e-12)))),
    "quaternions of length 1e-5": _start(_with("quats", lambda a: 1e-5 * a)),
}


def run(options: dict[str, Any], seed: int, folder: Path) -> dict[str, Any]:
    """Thirty steps of one case, and the scene long before, during and long after the recording."""
    given = CASES[options["case"]](_given(seed))
    method = Deform(given.config)
    ticks = drive(method, *method.start(given.frames, given.lesson, gaussians=given.gaussians))
    rows = [jax.device_get(now.info) for now in ticks]
    scene, moving = ticks.run.params, ticks.run.kept.moving
    losses = np.array([float(row["loss"]) for row in rows])
    pictures = []
    for time in FAR_TIMES:
        seen = draw(scene, moving, replace(given.frames[0], time=np.asarray(time)), ticks.run.plans[PLAN])
        pictures.append(np.isfinite(seen.colors).all() and np.isfinite(seen.depths).all())
    leaves = jax.tree.leaves(scene.field)
    return {
        "finite_losses": float(np.isfinite(losses).mean()),
        "skipped": sum(bool(row["skipped"]) for row in rows),
        "first_psnr": float(rows[0]["psnr"]),
        "last_psnr": float(rows[-1]["psnr"]),
        "finite_field": float(np.mean([np.isfinite(leaf).all() for leaf in leaves])),
        "finite_pictures": float(np.mean(pictures)),
    }


def _given(seed: int) -> Given:
    seen = gsjax.open_sequence(DATA)
    frames = []
    for t in range(seen.num_frames):
        pose, time = (seen.viewmats[t, 0], seen.Ks[t, 0]), t / (seen.num_frames - 1)
        frames.append(
            one_frame(seen.image(t, 0), *pose, time, seen.depth(t, 0), seen.mask(t, 0) == 0, seen.near)
        )
    ids = (np.arange(seen.width) > seen.width // 2)[None].repeat(seen.height, 0).astype(np.int32)
    return Given(frames, replace(BASE, seed=seed), Lesson([ids] * seen.num_frames, CODES))
