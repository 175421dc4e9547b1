"""The field: a feature for each position, and the convolution to the teacher's channels (FD-3DGS, section
3.3).

The last layer of the network is linear, and so is rendering. With h_i the input of that layer at Gaussian i,
f_i = A h_i + b, and alpha the rendered alpha,

    F' = sum_i w_i f_i = A (sum_i w_i h_i) + alpha b,

so h with 128 channels (by default) is rendered instead of f with 256. The result is the same, and so is
everything that is linear in F'.
"""

from functools import partial
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import optax
from jaxtyping import Array, Float, Int, PRNGKeyArray

from gsjax.methods.distill.config import DistillConfig
from gsjax.optim.step import per_field_adam
from gsjax.scene.feature_grid import FeatureGrid, Located, init_feature_grid, locate

_MARGIN = 0.02  # by which the box extends beyond the outermost Gaussians, as a share of its size
_OUTLIERS = 0.01  # share of the Gaussians that may lie far out on either side of an axis
_RATES = {"table": 2.5e-2, "layers": 5e-3}  # learning rates of the fit to vectors
_FINAL_RATE, _SOME = 0.1, 4096
_OUTLIER_MARGIN = 0.5  # how far the box extends at most beyond the inliers, as a share of their extent


class FeatureField(eqx.Module):
    """Features of positions or Gaussians of a scene, and the convolution to the teacher's channels.

    Attributes:
        encoding: a grid over the scene with `channels` outputs, or a vector for each Gaussian.
        lift: the 1x1 convolution, without bias.
    """

    encoding: FeatureGrid | Float[Array, "n channels"]
    lift: Float[Array, "d channels"]

    @property
    def channels(self) -> int:
        """Number of channels of a Gaussian's feature."""
        return self.lift.shape[1]

    @property
    def dimension(self) -> int:
        """Number of channels of the teacher's features, D."""
        return self.lift.shape[0]


class RenderedFeatures(NamedTuple):
    """The features that are rendered for a field, and the linear map to its channels.

    Attributes:
        values: h of each Gaussian.
        head: [A b], so that F' = head (sum w h, alpha); None if h is f.
    """

    values: Float[Array, "n hidden"]
    head: Float[Array, "channels hidden+1"] | None

    def channels_of(self, rendered: Float[Array, "*pixels r"]) -> Float[Array, "*pixels channels"]:
        """F', the feature image in the field's channels, from the rendered output of `joined`."""
        if self.head is None:
            return rendered
        return jnp.matmul(rendered, self.head.T, precision="highest")

    def joined(self, image: Float[Array, "*pixels hidden"], alphas: Float[Array, "*pixels"]):
        """A rendered image and its alphas as the input of `channels_of`."""
        return image if self.head is None else jnp.concatenate([image, alphas[..., None]], axis=-1)

    def lifted(self, lift: Float[Array, "d channels"]) -> Float[Array, "d r"]:
        """The convolution and `head` as one matrix, which applies to the output of `joined`."""
        return lift if self.head is None else jnp.matmul(lift, self.head, precision="highest")


def init_field(
    key: PRNGKeyArray, config: DistillConfig, means: Float[Array, "n 3"], dimension: int
) -> tuple[FeatureField, Located | None]:
    """An untrained field, and the locations of the Gaussians in its grid.

    Args:
        key: random key for the initial values.
        config: configuration of the field.
        means: centres of the scene's Gaussians, metres. The grid covers the box of the finite ones; outliers
            have the features of its surface.
        dimension: number of channels of the teacher's features, D.

    Raises:
        ValueError: no Gaussian has a finite centre.
    """
    first, second = jax.random.split(key)
    bound = np.sqrt(1 / config.channels)
    lift = jax.random.uniform(second, (dimension, config.channels), minval=-bound, maxval=bound)
    if config.encoding == "table":
        return FeatureField(1e-2 * jax.random.normal(first, (len(means), config.channels)), lift), None
    low, high = _box(expect_finite(means))
    room = _MARGIN * max((high - low).max(), 1e-3)
    grid = init_feature_grid(first, config.grid, config.channels, np.stack([low - room, high + room]))
    return FeatureField(grid, lift), locate(grid, jnp.asarray(means))


def expect_finite(means: Float[Array, "n 3"]) -> Float[np.ndarray, "some 3"]:
    """The centres of Gaussians, without those that are not finite. On the host.

    Args:
        means: centres, metres.

    Raises:
        ValueError: none is finite.
    """
    points = np.asarray(means)
    points = points[np.isfinite(points).all(axis=1)]
    if not len(points):
        raise ValueError(
            f"means: expected finite centres of Gaussians, found {len(means)}, none of them finite"
        )
    return points


def _box(points: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "2 3"]:
    """The bounding box without a few outliers, which would make all cells much larger."""
    low, high = np.quantile(points, [_OUTLIERS, 1 - _OUTLIERS], axis=0).astype(np.float32)
    room = _OUTLIER_MARGIN * max((high - low).max(), 1e-3)
    return np.stack([np.maximum(points.min(0), low - room), np.minimum(points.max(0), high + room)])


@partial(jax.jit, inline=True)
def rendered_features(
    field: FeatureField, located: Located | None, rows: Int[Array, "some"] | None = None
) -> RenderedFeatures:
    """The features to render for a field, for all Gaussians or some.

    Args:
        field: the field of all Gaussians.
        located: their locations in its grid; None for a vector per Gaussian.
        rows: indices of Gaussians (default: all).
    """
    if not isinstance(field.encoding, FeatureGrid):
        return RenderedFeatures(field.encoding if rows is None else field.encoding[rows], None)
    assert located is not None
    if rows is not None:
        located = Located(*(a[rows] for a in located))
    last = field.encoding.layers[-1]
    assert last.bias is not None
    head = jnp.concatenate([last.weight, last.bias[:, None]], axis=1)
    return RenderedFeatures(field.encoding.hidden_at(located), head)


@partial(jax.jit, inline=True)
def features_of(field: FeatureField, located: Located | None) -> Float[Array, "n channels"]:
    """The feature f of each Gaussian."""
    return field.encoding.at(located) if isinstance(field.encoding, FeatureGrid) else field.encoding


def fitted_to_vectors(
    field: FeatureField,
    located: Located | None,
    vectors: Float[Array, "n channels"],
    key: PRNGKeyArray,
    steps: int = 400,
) -> FeatureField:
    """The field with its encoding fitted to given vectors at the Gaussians.

    Args:
        field: the field before.
        located: locations of the Gaussians in its grid; None for a vector per Gaussian.
        vectors: the vector of each Gaussian.
        key: random key that draws the Gaussians of each step.
        steps: steps of Adam, of a few thousand Gaussians each.
    """
    if located is None:
        return eqx.tree_at(lambda f: f.encoding, field, vectors)
    return eqx.tree_at(lambda f: f.encoding, field, _fitted(field.encoding, located, vectors, key, steps))


@partial(jax.jit, static_argnames="steps")
def _fitted(grid: FeatureGrid, located: Located, vectors: Float[Array, "n c"], key, steps: int):
    falling = optax.exponential_decay(1.0, steps, _FINAL_RATE)
    rates = {name: lambda count, rate=rate: rate * falling(count) for name, rate in _RATES.items()}
    optimizer = per_field_adam(rates)

    def loss(grid, some):
        found = grid.at(Located(*(a[some] for a in located)))
        return jnp.mean(jnp.where(located.valid[some, None], (found - vectors[some]) ** 2, 0.0))

    def step(carry, key):
        grid, state = carry
        some = jax.random.randint(key, (min(_SOME, len(vectors)),), 0, len(vectors))
        updates, state = optimizer.update(jax.grad(loss)(grid, some), state)
        return (eqx.apply_updates(grid, updates), state), None

    (grid, _), _ = jax.lax.scan(step, (grid, optimizer.init(grid)), jax.random.split(key, steps))
    return grid


def active_table(
    field: FeatureField, located: Located | None
) -> tuple[FeatureField, Located | None, Int[np.ndarray, "active"] | None]:
    """The field with only the entries of its table that surround a Gaussian; the locations of the Gaussians
    in it; and the indices of these entries. The latter two are None for a vector per Gaussian.

    The other entries, millions in a fine grid, get no gradient, so Adam would not change them. On the host.
    """
    if not isinstance(field.encoding, FeatureGrid):
        return field, None, None
    assert located is not None
    rows, place = np.unique(np.asarray(located.indices), return_inverse=True)
    table, indices = np.asarray(field.encoding.table)[rows], place.reshape(located.indices.shape)
    table, indices = jax.device_put((table, indices.astype(np.int32)))
    grid = eqx.tree_at(lambda g: g.table, field.encoding, table)
    return FeatureField(grid, field.lift), located._replace(indices=indices), rows


def full_table(field: FeatureField, rows: Int[np.ndarray, "active"] | None) -> FeatureField:
    """The inverse of `active_table`: the field at any position. Entries that surround no Gaussian are 0."""
    if rows is None or not isinstance(field.encoding, FeatureGrid):
        return field
    table = field.encoding.table
    full = np.zeros((sum(field.encoding.config.entries), table.shape[1]), table.dtype)
    full[rows] = table
    return eqx.tree_at(lambda f: f.encoding.table, field, jax.device_put(full))
