"""User-defined losses, in addition to those of a method.

A method that takes `extra_losses` adds them to its own and trains on the gradient of the sum:

    def above_the_table(scene, rendered, frame):
        return 10.0 * jnp.sum(jnp.minimum(scene.gaussians.means[:, 2], 0.0) ** 2)

    gsjax.track(scene, first, frames, config, extra_losses=(above_the_table,))

The weight of a loss is a factor inside it. Without extra losses, a method's program is unchanged.
"""

from typing import Any, Protocol, runtime_checkable

import jax.numpy as jnp
from jaxtyping import Array, Float

from gsjax.scene.frame import Frame
from gsjax.scene.render import Rendered


@runtime_checkable
class ExtraLoss(Protocol):
    """A pure, differentiable function of the scene, its rendering, and the observed frame."""

    def __call__(self, scene: Any, rendered: Rendered, frame: Frame) -> Float[Array, ""]:
        """A scalar to be minimised.

        Args:
            scene: the method's scene, with `scene.gaussians` [N] as they were drawn; see the method for its
                other fields.
            rendered: colours, depths and alphas of C cameras; [C,H,W] and channels.
            frame: what these cameras saw: images [C,H,W,3], 0 to 1, and depths [C,H,W], metres, 0 where
                unknown, or None.
        """
        ...


ExtraLosses = tuple[ExtraLoss, ...]
"""A tuple, because it is static under jit. A new function object, such as a fresh lambda, recompiles."""


def named_losses(losses: Any) -> dict[str, ExtraLoss]:
    """Losses by the names of their functions, under which `info["extra"]` reports their values.

    Raises:
        ValueError: `losses` is not a tuple of functions, or two have the same name.
    """
    if not isinstance(losses, tuple):
        raise ValueError(
            f"extra_losses: expected a tuple of functions, such as (loss,), found {type(losses).__name__}"
        )
    named = {}
    for loss in losses:
        if not callable(loss):
            raise ValueError(f"extra_losses: expected functions loss(scene, rendered, frame), found {loss!r}")
        name = getattr(loss, "__name__", type(loss).__name__)
        if name in named:
            raise ValueError(
                f"extra_losses: expected functions with different names, found two named {name!r}; rename one"
            )
        named[name] = loss
    return named


def extra_terms(losses: Any, scene: Any, rendered: Any, frame: Any) -> dict[str, Float[Array, ""]]:
    """The value of each loss, by name.

    Args:
        losses: functions of scene, rendered and frame.
        scene, rendered, frame: their arguments.

    Raises:
        ValueError: as for `named_losses`, or a loss returns something other than a scalar.
    """
    terms = {name: loss(scene, rendered, frame) for name, loss in named_losses(losses).items()}
    for name, value in terms.items():
        if value is None or jnp.shape(value) != ():
            found = "None" if value is None else f"shape {jnp.shape(value)}"
            raise ValueError(
                f"extra_losses: expected a scalar from {name}, found {found}; take a sum or a mean"
            )
    return terms
