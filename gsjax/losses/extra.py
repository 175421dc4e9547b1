"""Losses of one's own, beside those that a method has.

A method that takes `extra_losses` adds them up with its own, and the gradient of the sum is what trains:

    def above_the_table(scene, rendered, frame):
        return 10.0 * jnp.sum(jnp.minimum(scene.gaussians.means[:, 2], 0.0) ** 2)

    gsjax.track(scene, first, frames, config, extra_losses=(above_the_table,))

What one counts beside the others is a factor within it. Without any, a method's program is what it was.
"""

from typing import Any, Protocol, runtime_checkable

import jax.numpy as jnp
from jaxtyping import Array, Float

from gsjax.scene.frame import Frame
from gsjax.scene.render import Rendered


@runtime_checkable
class ExtraLoss(Protocol):
    """A pure function, differentiable in what it reads: of a scene as it was drawn, and of what was seen."""

    def __call__(self, scene: Any, rendered: Rendered, frame: Frame) -> Float[Array, ""]:
        """A scalar, the smaller the better.

        Args:
            scene: the method's, with `scene.gaussians` [N] where they were drawn; what else it has, its
                method says.
            rendered: colours, depths and alphas of C cameras; [C,H,W] and channels.
            frame: what these cameras saw: images [C,H,W,3], 0 to 1, and depths [C,H,W], metres, 0 where
                unknown, or None.
        """
        ...


ExtraLosses = tuple[ExtraLoss, ...]
"""A tuple, for it is static under jit. A function made anew, as a lambda is, compiles anew: make it once."""


def named_losses(losses: Any) -> dict[str, ExtraLoss]:
    """Losses by the names of their functions, under which `info["extra"]` has their values.

    Raises:
        ValueError: what is given is not a tuple of functions, or two have one name.
    """
    if not isinstance(losses, tuple):
        raise ValueError(
            f"extra_losses: expected a tuple of functions, (loss,) for one, found {type(losses).__name__}"
        )
    named = {}
    for loss in losses:
        if not callable(loss):
            raise ValueError(f"extra_losses: expected functions loss(scene, rendered, frame), found {loss!r}")
        name = getattr(loss, "__name__", type(loss).__name__)
        if name in named:
            raise ValueError(f"extra_losses: expected one function of each name, found two named {name!r}")
        named[name] = loss
    return named


def extra_terms(losses: Any, scene: Any, rendered: Any, frame: Any) -> dict[str, Float[Array, ""]]:
    """What each of them comes to, by name.

    Args:
        losses: functions of scene, rendered and frame.
        scene, rendered, frame: what they are given.

    Raises:
        ValueError: as `named_losses`; or what one returns is no scalar.
    """
    terms = {name: loss(scene, rendered, frame) for name, loss in named_losses(losses).items()}
    for name, value in terms.items():
        if value is None or jnp.shape(value) != ():
            found = "None" if value is None else f"shape {jnp.shape(value)}"
            raise ValueError(
                f"extra_losses: expected a scalar of {name}, found {found}; take a sum or a mean"
            )
    return terms
