"""The step protocol: every method advances by a pair of pure functions, as in optax and blackjax.

    state = step.init(params)
    params, state, info = step.update(params, state, batch, step=i, key=key)

`params` holds the trainable parameters, `batch` the inputs (observations, frozen scene, plan, progress) and
`state` the step's own state. `step` is the index of the step, a traced integer; the position in a schedule,
0 to 1, is part of the batch. `info` has the losses by name, and always

    loss       the value that is minimised
    skipped    True if params and state are unchanged: a number was not finite, or a plan overflowed
    overflow   True if a plan was too small
    needed     the capacity that would have sufficed: a number, or in the form of the method's plans

Steps close over static configuration only, so they run under jit, vmap and scan, and compose by calling
one another. tests/engine/test_laws.py checks every step of the package.
"""

from collections.abc import Callable, Mapping
from types import MappingProxyType
from typing import Any, NamedTuple, Protocol

import equinox as eqx
import jax
import jax.numpy as jnp
import optax
from jaxtyping import Array, Bool, PyTree

_MAX_ROOTS = 10.0  # bound on a gradient in the first moment, in units of the root of the second


class Init(Protocol):
    """Makes the initial state of a step from its parameters."""

    def __call__(self, params: PyTree) -> PyTree: ...


class Update(Protocol):
    """Advances parameters and state by one batch, and reports on it in `info`."""

    def __call__(
        self, params: PyTree, state: PyTree, batch: PyTree, *, step: Any, key: Any
    ) -> tuple[PyTree, PyTree, dict[str, Any]]: ...


class Step(NamedTuple):
    """A pair of pure functions; see the module's docstring."""

    init: Init
    update: Update


def gradient_step(
    loss: Callable[..., tuple[Array, dict[str, Any]]], optimizer: optax.GradientTransformation
) -> Step:
    """One step down the gradient of `loss(params, batch, *, step, key) -> (scalar, aux)`.

    A step whose loss or gradient is not finite, whose gradient is too large to be squared, or whose aux
    reports an `overflow`, returns params and state unchanged, with `info["skipped"]` True. `info` is aux with
    `loss` and `skipped`. Without a plan, aux may omit `overflow` and `needed`, by default False and 0.
    """

    def update(params, state, batch, *, step, key):
        (value, aux), gradients = jax.value_and_grad(loss, has_aux=True)(params, batch, step=step, key=key)
        updates, new_state = optimizer.update(gradients, state, params)
        new_params = optax.apply_updates(params, updates)
        overflow = jnp.asarray(aux.get("overflow", False)).any()
        squares = jax.tree.map(jnp.square, gradients)  # an infinite second moment would freeze a parameter
        sound = all_finite((value, squares)) & ~overflow
        params, state = keep_if(sound, (new_params, new_state), (params, state))
        reported = {"needed": jnp.int32(0), **aux, "overflow": overflow}
        return params, state, {**reported, "loss": value, "skipped": ~sound}

    return Step(optimizer.init, update)


@jax.jit
def copied(tree: PyTree) -> PyTree:
    """The same arrays in buffers of their own, which outlive a step that donates the buffers of its inputs.
    Half precision, in which the moments of Adam underflow, becomes single."""

    def own(leaf):
        if jnp.issubdtype(leaf.dtype, jnp.floating):
            leaf = leaf.astype(jnp.promote_types(leaf.dtype, jnp.float32))
        return jnp.copy(leaf)

    return jax.tree.map(own, tree)


def all_finite(tree: PyTree) -> Bool[Array, ""]:
    """Whether every number of a pytree is finite."""
    return jnp.stack([jnp.isfinite(leaf).all() for leaf in jax.tree.leaves(tree)]).all()


def keep_if(condition: Bool[Array, ""], new: PyTree, old: PyTree) -> PyTree:
    """`new` where the condition holds, else `old`, leaf by leaf."""
    return jax.tree.map(lambda a, b: jnp.where(condition, a, b), new, old)


def steady_adam(rate: Any, eps: float = 1e-15, decay: float = 0.0) -> optax.GradientTransformation:
    """Adam in which a single gradient moves a parameter by no more than about ten learning rates.

    In plain Adam it is 31, whatever the size of the gradient, if those before were much smaller: the first
    moment is then (1 - b1) g, the second (1 - b2) g^2, and the first decays slowly. So one badly rendered
    frame could ruin what all frames share. Here gradients enter the first moment clipped to ten roots of the
    second, which affects no gradient that recurs in one step of a hundred or more often. The state is that of
    `optax.adam`.

    Args:
        rate: learning rate, or a schedule.
        eps: added to the root of the second moment.
        decay: weight decay of AdamW.
    """
    b1, b2 = 0.9, 0.999

    def update(gradients, state, params=None):
        count = optax.safe_increment(state.count)

        def corrected(moment, decay):
            return moment / (1 - decay**count).astype(moment.dtype)

        nu = jax.tree.map(lambda v, g: b2 * v + (1 - b2) * jnp.square(g), state.nu, gradients)
        roots = jax.tree.map(lambda v: jnp.sqrt(corrected(v, b2)), nu)
        limited = jax.tree.map(
            lambda g, root: jnp.clip(g, -_MAX_ROOTS * root, _MAX_ROOTS * root), gradients, roots
        )
        mu = jax.tree.map(lambda m, g: b1 * m + (1 - b1) * g, state.mu, limited)
        moves = jax.tree.map(lambda m, root: corrected(m, b1) / (root + eps), mu, roots)
        return moves, optax.ScaleByAdamState(count, mu, nu)

    scale = optax.GradientTransformation(optax.scale_by_adam().init, update)
    decays = [optax.add_decayed_weights(decay)] if decay else []
    return optax.chain(scale, *decays, optax.scale_by_learning_rate(rate))


def per_field_adam(
    rates: dict[str, Any],
    others: Mapping[str, optax.GradientTransformation] = MappingProxyType({}),
    decay: float = 0.0,
) -> optax.GradientTransformation:
    """`steady_adam` (eps 1e-15, as in 3DGS) with a learning rate for each field of a module or of nested
    modules.

    Args:
        rates: learning rates by field name. All other fields do not change.
        others: transformations, by field name, that replace Adam.
        decay: weight decay of AdamW for the fields in `rates`.

    Raises:
        ValueError: from the optimizer's init, if the module lacks one of the fields.
    """
    transforms = {name: steady_adam(rate, decay=decay) for name, rate in rates.items()} | dict(others)

    def label(params):
        fields = _fields(params)
        unknown = [name for name in transforms if name not in fields]
        if unknown:
            raise ValueError(f"rates: {type(params).__name__} has no field {unknown[0]!r}; it has {fields}")

        def of(path, _):
            names = [getattr(key, "name", str(key)) for key in path]
            return next((name for name in reversed(names) if name in transforms), "rest")

        return jax.tree_util.tree_map_with_path(of, params)

    return optax.multi_transform(transforms | {"rest": optax.set_to_zero()}, label)


def _fields(module: Any) -> tuple[str, ...]:
    """Names of the fields of a module, and of the modules within it."""
    if not isinstance(module, eqx.Module):
        return getattr(module, "_fields", ())
    return tuple(name for field, value in vars(module).items() for name in (field, *_fields(value)))
