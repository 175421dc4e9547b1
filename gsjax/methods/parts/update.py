"""The step of a discovery: frame after frame, and then all frames together."""

from typing import Any

from gsjax.losses.extra import ExtraLosses
from gsjax.methods.parts.config import PartsConfig
from gsjax.methods.parts.refine import RefineParams, refine_step
from gsjax.methods.parts.stream import StreamParams, stream_step
from gsjax.optim.step import Step


def parts_step(config: PartsConfig, extra_losses: ExtraLosses = ()) -> Step:
    """`stream_step` of `StreamParams`, `refine_step` of `RefineParams`; neither uses `step` or `key`.

    Args:
        config: of the discovery.
        extra_losses: custom losses `loss(scene, rendered, frame)` (`gsjax.losses.extra`), whose scene is a
            `PosedScene`.
    """
    stream, refine = stream_step(config.stream, extra_losses), refine_step(config, extra_losses)

    def of(params: StreamParams | RefineParams) -> Step:
        return refine if isinstance(params, RefineParams) else stream

    def update(params: StreamParams | RefineParams, state: Any, batch: Any, *, step: Any, key: Any):
        return of(params).update(params, state, batch, step=step, key=key)

    return Step(lambda params: of(params).init(params), update)
