"""Renders of a scene with parts from each camera, frame by frame."""

from collections.abc import Callable, Iterator
from functools import cache, partial

import jax

from gsjax.engine.recording import Recording
from gsjax.engine.views import View, views_of
from gsjax.methods.parts import Moment, PartScene, Trajectory, gaussians_at, moment
from gsjax.rasterize.plan import Plan
from gsjax.scene.frame import Frame
from gsjax.scene.handles import Blend
from gsjax.scene.render import Rendered, render


def part_views(
    scene: PartScene, trajectory: Trajectory, recording: Recording, blend: Blend
) -> Iterator[list[View]]:
    """The views of all cameras, a list per frame; groups are the parts."""

    def at(t: int) -> tuple[PartScene, Moment]:
        return scene, moment(trajectory, t)

    placed = partial(gaussians_at, blend=blend)
    return views_of(recording, range(len(trajectory.times)), at, _renders_parts(blend), placed)


@cache
def _renders_parts(blend: Blend) -> Callable:
    def render_parts(scene: PartScene, now: Moment, frame: Frame, plan: Plan) -> Rendered:
        labels = jax.nn.one_hot(scene.labels, scene.num_parts)
        return render(gaussians_at(scene, now, blend), frame.cameras, plan, features=labels)

    return render_parts
