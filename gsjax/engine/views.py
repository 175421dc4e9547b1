"""Rendered views of a moving scene beside the recorded ones, frame by frame."""

from collections.abc import Callable, Iterator
from functools import cache, partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float, Int

from gsjax.engine.recording import Prefetched, Recording
from gsjax.optim.compiler import host_options
from gsjax.optim.traces import jit_once
from gsjax.rasterize.plan import Plan, with_room
from gsjax.scene.frame import Frame
from gsjax.scene.render import plan_render

OPAQUE = 0.5
"""Pixels with less alpha have no label and no depth."""
_DRAWN = ("render", "render_depth", "groups", "covered")


class View(NamedTuple):
    """One camera at one frame.

    Attributes:
        t: index of the frame in the run, from 0.
        camera: the camera's id.
        held_out: whether the camera is held out.
        image, depth, mask: the recording; None if there is no such file.
        render, render_depth: the scene; depth is 0 where nothing is drawn.
        groups: the group with the largest share of each pixel, 0 for background.
        covered: whether something is drawn there.
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
    """The views of all cameras, a list per frame.

    Args:
        recording: the frames and cameras.
        chosen: indices of the frames.
        at: index of a frame -> (scene, pose).
        draw: (scene, pose, frame, plan) -> Rendered, whose features are the share of each group.
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
        drawn, plan = with_room(partial(drawing, scene, pose, frame), plan)
        drawn, images = jax.device_get(drawn), np.asarray(frame.images)
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
    """The jitted render; made on first use, because its options depend on the machine."""

    def drawn(scene, pose, frame: Frame, plan: Plan):
        rendered = draw(scene, pose, frame, plan)
        covered = rendered.alphas > OPAQUE
        depths = jnp.where(covered, rendered.depths, 0.0)
        groups = jnp.where(covered, jnp.argmax(rendered.features, axis=-1), 0)
        return (rendered.colors, depths, groups, covered), rendered.meta._replace(features=None)

    return jit_once(drawn, draw, compiler_options=host_options())
