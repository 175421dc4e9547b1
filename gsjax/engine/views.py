"""What a scene that moves looks like from each camera, frame by frame, beside what the camera saw."""

from collections.abc import Callable, Iterator
from functools import cache
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float, Int

from gsjax.engine.recording import Prefetched, Recording
from gsjax.optim.compiler import host_options
from gsjax.rasterize.plan import Plan
from gsjax.scene.frame import Frame
from gsjax.scene.render import plan_render

OPAQUE = 0.5
"""Pixels with less alpha show nothing: they have no label and no depth."""
_DRAWN = ("render", "render_depth", "groups", "covered")


class View(NamedTuple):
    """One camera at one frame.

    Attributes:
        t: frame, counted from 0 in the run.
        camera: the camera's id.
        held_out: whether it is only judged.
        image, depth, mask: what the camera saw; None where there is no such file.
        render, render_depth: the scene; depth 0 where nothing is drawn.
        groups: the group on top in each pixel, 0 for background.
        covered: where something is drawn.
    """

    t: int
    camera: int
    held_out: bool
    image: Float[np.ndarray, "height width 3"]
    depth: Float[np.ndarray, "height width"] | None
    mask: Int[np.ndarray, "height width"] | None
    render: Float[np.ndarray, "height width 3"]
    render_depth: Float[np.ndarray, "height width"]
    groups: Int[np.ndarray, "height width"]
    covered: np.ndarray


def views_of(
    recording: Recording, chosen: range, at: Callable, draw: Callable, placed: Callable
) -> Iterator[list[View]]:
    """Views of the frames in `chosen`.

    Args:
        at: frame -> (scene, pose).
        draw: (scene, pose, frame, plan) -> Rendered, whose features are 1 where a group shows.
        placed: (scene, pose) -> Gaussians.
    """
    sequence = recording.judged
    cameras = range(sequence.num_cameras)
    drawing = _compiled(draw)

    def load(t: int):
        return sequence.frame(t), [sequence.mask(t, c) for c in cameras]

    plan: Plan | None = None
    for t, (frame, masks) in zip(chosen, Prefetched(load, chosen), strict=True):
        scene, pose = at(t)
        if plan is None:
            plan = plan_render(placed(scene, pose), frame.cameras)
        while True:
            *drawn, overflow, needed = jax.device_get(drawing(scene, pose, frame, plan))
            if not overflow:
                break
            plan = plan.grown(int(needed))
        images = np.asarray(frame.images)
        depths = None if frame.depths is None else np.asarray(frame.depths)
        yield [
            View(
                t=t,
                camera=sequence.camera_ids[c],
                held_out=c >= recording.tracked.num_cameras,
                image=images[c],
                depth=None if depths is None or not depths[c].any() else depths[c],
                mask=masks[c],
                **{name: value[c] for name, value in zip(_DRAWN, drawn, strict=True)},
            )
            for c in cameras
        ]


@cache
def _compiled(draw: Callable) -> Callable:
    """The jitted render; made late, because its options ask which machine this is, and once."""

    def drawn(scene, pose, frame: Frame, plan: Plan):
        rendered = draw(scene, pose, frame, plan)
        covered = rendered.alphas > OPAQUE
        return (
            rendered.colors,
            jnp.where(covered, rendered.depths, 0.0),
            jnp.where(covered, jnp.argmax(rendered.features, axis=-1), 0),
            covered,
            rendered.meta.overflow.any(),
            rendered.meta.needed.max(),
        )

    return jax.jit(drawn, compiler_options=host_options())
