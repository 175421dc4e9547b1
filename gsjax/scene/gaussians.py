"""The scene: Gaussians as one pytree of raw (unconstrained) parameters, and separate integer tags."""

import math
from collections.abc import Sequence
from functools import partial
from typing import Any, TypeVar

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.typing import ArrayLike, DTypeLike
from jaxtyping import Array, Bool, Float, Integer

from gsjax.geometry.rotations import MIN_SQUARED_NORM
from gsjax.geometry.spherical_harmonics import num_sh_bases, rgb_to_sh0

# Activated values are clipped to this range before their logarithm is taken, so that 0 and 1 stay finite.
_MIN_SCALE = 1e-12
_MIN_OPACITY = 1e-6
FLAT, OPAQUE = math.log(_MIN_SCALE), math.log1p(-_MIN_OPACITY) - math.log(_MIN_OPACITY)
"""The log scale of a Gaussian without thickness, and the logit of one that hides everything behind it."""
SH_SIZES = tuple(num_sh_bases(degree) for degree in range(4))


class Gaussians(eqx.Module):
    """N Gaussians. All leaves are floats, so `jax.grad` applies to the whole; an absent field is None and
    costs nothing.

    Attributes:
        means: centres in the world, metres.
        quats: orientations [w, x, y, z], of any non-zero length.
        log_scales: logarithms of the standard deviations along the Gaussian's own axes, metres.
        logit_opacities: logits of the opacities.
        sh0: constant spherical-harmonics coefficient of each colour channel.
        shN: the other K - 1 coefficients, K in 4, 9, 16; None means a view-independent colour.
        features: any further values to composite.

    Raises:
        ValueError: a field is not a float array or has the wrong shape. Only construction checks this; tree
            transformations such as `vmap` rebuild the module unchecked, with whatever leading axes they add.
    """

    means: Float[Array, "N 3"]
    quats: Float[Array, "N 4"]
    log_scales: Float[Array, "N 3"]
    logit_opacities: Float[Array, "N"]
    sh0: Float[Array, "N 1 3"]
    shN: Float[Array, "N rest 3"] | None = None
    features: Float[Array, "N D"] | None = None

    def __check_init__(self):
        count = self.means.shape[0] if np.ndim(self.means) else None
        wanted = {
            "means": (count, 3),
            "quats": (count, 4),
            "log_scales": (count, 3),
            "logit_opacities": (count,),
            "sh0": (count, 1, 3),
            "shN": (count, None, 3),
            "features": (count, None),
        }
        for name, shape in wanted.items():
            value = getattr(self, name)
            if value is not None:
                _check_array(f"Gaussians.{name}", value, shape)
        if self.shN is not None and self.shN.shape[1] + 1 not in SH_SIZES[1:]:
            raise ValueError(
                "Gaussians.shN: expected shape [N, 3, 3], [N, 8, 3] or [N, 15, 3] (degree 1, 2 or 3 without "
                f"its constant), or None for degree 0, found {self.shN.shape}"
            )

    @property
    def num(self) -> int:
        """Number of Gaussians."""
        return self.means.shape[0]

    @property
    def scales(self) -> Float[Array, "N 3"]:
        """Standard deviations along the Gaussian's own axes, metres."""
        return jnp.exp(self.log_scales)

    @property
    def opacities(self) -> Float[Array, "N"]:
        """Opacities, 0 to 1."""
        return jax.nn.sigmoid(self.logit_opacities)

    @property
    def sh_degree(self) -> int:
        """Degree of the spherical harmonics, 0 to 3."""
        return 0 if self.shN is None else SH_SIZES.index(self.shN.shape[-2] + 1)

    @property
    def sh(self) -> Float[Array, "N K 3"]:
        """All spherical-harmonics coefficients."""
        return self.sh0 if self.shN is None else jnp.concatenate([self.sh0, self.shN], axis=-2)


class Tags(eqx.Module):
    """Attributes of each Gaussian that are not parameters; kept apart because they have no gradient.

    Attributes:
        labels: object ids; 0 is background.
        alive: False for slots that currently hold no Gaussian.
    """

    labels: Integer[Array, "N"] | None = None
    alive: Bool[Array, "N"] | None = None


def _check_array(name: str, value: ArrayLike, wanted: tuple[int | None, ...]) -> None:
    """Raise ValueError unless `value` is a float array of shape `wanted`, in which None is any size."""
    shape, dtype = getattr(value, "shape", None), getattr(value, "dtype", None)
    if shape is None or dtype is None:
        return  # a stand-in that a tree transformation put there (None, a spec, a rate)
    fits = len(shape) == len(wanted) and all(w is None or s == w for s, w in zip(shape, wanted, strict=True))
    if not fits:
        text = ", ".join("any" if size is None else str(size) for size in wanted)
        raise ValueError(f"{name}: expected shape [{text}], found {tuple(shape)}")
    if not jnp.issubdtype(dtype, jnp.floating):
        raise ValueError(f"{name}: expected floats (integers belong in Tags), found dtype {dtype}")


def gaussians_from_activated(
    means: ArrayLike,
    quats: ArrayLike,
    scales: ArrayLike,
    opacities: ArrayLike,
    colors: ArrayLike,
    *,
    shN: ArrayLike | None = None,
    features: ArrayLike | None = None,
    dtype: DTypeLike = jnp.float32,
) -> Gaussians:
    """Gaussians from activated values (scales, opacities, colours): the inverse of the activations.

    Args:
        means: [N, 3], metres.
        quats: [N, 4], w x y z.
        scales: [N, 3], metres; values below 1e-12 count as 1e-12.
        opacities: [N], 0 to 1, clipped to [1e-6, 1 - 1e-6] so that the logits are finite.
        colors: [N, 3], RGB 0 to 1, converted to sh0.
        shN: [N, K-1, 3] or None.
        features: [N, D] or None.
        dtype: type of all fields.

    Raises:
        ValueError: a shape is wrong, or colours are bytes; the message names the argument.
    """
    count = np.shape(means)[0] if np.ndim(means) else None
    wanted = {"means": 3, "quats": 4, "scales": 3, "opacities": None, "colors": 3}
    arrays = dict(zip(wanted, (means, quats, scales, opacities, colors), strict=True))
    wide = jnp.promote_types(jnp.result_type(dtype), jnp.float32)  # in half precision, 1 - 1e-6 is 1
    arrays = {
        name: _on_device(value, dtype if name in ("means", "quats") else wide)
        for name, value in arrays.items()
    }
    if getattr(colors, "dtype", None) == np.uint8:
        raise ValueError("colors: expected RGB from 0 to 1, found uint8; divide by 255")
    for name, columns in wanted.items():
        _check_array(name, arrays[name], (count,) if columns is None else (count, columns))
    extra = {"shN": shN, "features": features}
    extra = {name: None if value is None else _on_device(value, dtype) for name, value in extra.items()}
    return Gaussians(arrays["means"], arrays["quats"], *_raw(arrays), **extra)


def _on_device(value: Any, dtype: Any) -> Array:
    """An array of this type; host arrays are converted on the host, without a program for each shape."""
    return (
        jnp.asarray(value, dtype)
        if isinstance(value, jax.Array)
        else jax.device_put(np.asarray(value, dtype))
    )


@jax.jit
def _raw(activated: dict[str, Array]) -> tuple[Array, Array, Array]:
    """Log scales, opacity logits, and sh0. A single program, as most numbers of Gaussians occur only once."""
    opacities = jnp.clip(activated["opacities"], _MIN_OPACITY, 1 - _MIN_OPACITY)
    logits = jnp.log(opacities) - jnp.log1p(-opacities)
    log_scales = jnp.log(jnp.maximum(activated["scales"], _MIN_SCALE))
    colors, dtype = rgb_to_sh0(activated["colors"])[:, None, :], activated["means"].dtype
    return log_scales.astype(dtype), logits.astype(dtype), colors.astype(dtype)


def concatenate(parts: Sequence[Gaussians]) -> Gaussians:
    """All Gaussians of `parts`, in order. Missing SH degrees are filled with zeros, which renders the same.

    Raises:
        ValueError: there are no parts, or their features differ in dimension or are missing in some parts.
    """
    if not parts:
        raise ValueError("concatenate: expected at least one Gaussians, found no parts")
    sizes = {None if part.features is None else part.features.shape[1] for part in parts}
    if len(sizes) > 1:
        raise ValueError(f"concatenate: features must have one size in all parts or be None, got {sizes}")
    degree = max(part.sh_degree for part in parts)
    return _joined([with_sh_degree(part, degree) for part in parts])


@partial(jax.jit, inline=True)
def _joined(parts: list[Gaussians]) -> Gaussians:
    return jax.tree.map(lambda *leaves: jnp.concatenate(leaves, axis=0), *parts)


def with_sh_degree(gaussians: Gaussians, degree: int) -> Gaussians:
    """The same Gaussians at a higher degree, with new coefficients of 0; `degree` is at least their own."""
    missing = num_sh_bases(degree) - num_sh_bases(gaussians.sh_degree)
    if missing == 0:
        return gaussians
    padded = jnp.pad(gaussians.sh, ((0, 0), (0, missing), (0, 0)))
    return eqx.tree_at(lambda g: g.shN, gaussians, padded[:, 1:], is_leaf=lambda leaf: leaf is None)


Tree = TypeVar("Tree", Gaussians, Tags)


def take(tree: Tree, indices: Integer[ArrayLike, "M"] | Bool[ArrayLike, "N"]) -> Tree:
    """The rows `indices` (or, outside a trace, those where a boolean mask is True) of Gaussians or Tags.

    Raises:
        ValueError: outside a trace, a mask has another length, or there is no such row.
    """
    if not isinstance(indices, jax.core.Tracer):
        indices, count = np.asarray(indices), min((len(leaf) for leaf in jax.tree.leaves(tree)), default=0)
        if indices.dtype == bool:
            if indices.shape != (count,):
                raise ValueError(f"indices: expected a mask of shape ({count},), found {indices.shape}")
            indices = np.flatnonzero(indices)
        elif not indices.size:
            indices = indices.astype(int)  # an empty list becomes floats
        elif (wrong := (indices < -count) | (indices >= count)).any():
            raise ValueError(f"indices: expected rows below {count}, found {indices[wrong][0]}")
    return _rows(tree, indices)


@partial(jax.jit, inline=True)
def _rows(tree: Tree, indices: Integer[ArrayLike, "M"]) -> Tree:
    return jax.tree.map(lambda leaf: jnp.asarray(leaf)[indices], tree)


def valid_rows(gaussians: Gaussians) -> Bool[np.ndarray, "N"]:
    """Rows in which all values are finite and the quaternion is long enough to be a rotation. On the host."""
    valid = np.ones(gaussians.num, bool)
    for leaf in jax.tree.leaves(gaussians):
        valid &= np.isfinite(np.asarray(leaf)).all(axis=tuple(range(1, leaf.ndim)))
    # In float64, so that squares of 1e38 do not overflow and those of denormals do not vanish.
    with np.errstate(invalid="ignore"):  # of signalling NaN
        quats = np.where(valid[:, None], np.asarray(gaussians.quats, np.float64), 0.0)
    return valid & (np.sum(quats**2, axis=1) >= MIN_SQUARED_NORM)


def cull_invalid(gaussians: Gaussians) -> tuple[Gaussians, int]:
    """Remove rows with NaN, infinity or |q|^2 < 1e-12; returns the rest and the number of rows removed."""
    valid = valid_rows(gaussians)
    removed = int(np.sum(~valid))
    return (gaussians if removed == 0 else take(gaussians, np.flatnonzero(valid))), removed
