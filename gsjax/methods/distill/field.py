"""The field itself: a feature for each place, and the convolution that makes the teacher's numbers of it
(papers/002, section 3.3).

The last layer of the network is linear, and so is rendering. With h_i what that layer is given at Gaussian i,
f_i = A h_i + b, and alpha the rendered alpha,

    F' = sum_i w_i f_i = A (sum_i w_i h_i) + alpha b,

so that h is rendered, 128 numbers by default, and not f with 256. The result is the same, and so is
everything that is linear in F' after it.
"""

from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int, PRNGKeyArray

from gsjax.methods.distill.config import DistillConfig
from gsjax.scene.feature_grid import FeatureGrid, Located, init_feature_grid, locate

_MARGIN = 0.02  # of the box, beyond the outermost Gaussians, in its own size
_MOST = 0.01  # of the Gaussians, that may lie far out to either side of an axis
_FAR_OUT = 0.5  # of the size of what holds all others


class FeatureField(eqx.Module):
    """Features of a scene's places or Gaussians, and how the teacher's are made of them.

    Attributes:
        encoding: a grid over the scene, with `channels` outputs; or a vector for each Gaussian.
        lift: the 1x1 convolution, without bias.
    """

    encoding: FeatureGrid | Float[Array, "n channels"]
    lift: Float[Array, "d channels"]

    @property
    def channels(self) -> int:
        """How many numbers the field has for each Gaussian."""
        return self.lift.shape[1]

    @property
    def dimension(self) -> int:
        """D, of the teacher's features."""
        return self.lift.shape[0]


class Carried(NamedTuple):
    """What is rendered of a field, and what makes its channels of that.

    Attributes:
        values: h of each Gaussian.
        head: [A b], so that F' = head (sum w h, alpha); None where h is f.
    """

    values: Float[Array, "n hidden"]
    head: Float[Array, "channels hidden+1"] | None

    def channels_of(self, rendered: Float[Array, "*pixels r"]) -> Float[Array, "*pixels channels"]:
        """F' of what was rendered."""
        if self.head is None:
            return rendered
        return jnp.matmul(rendered, self.head.T, precision="highest")

    def joined(self, image: Float[Array, "*pixels hidden"], alphas: Float[Array, "*pixels"]):
        """What `channels_of` wants of a rendered image and its alphas."""
        return image if self.head is None else jnp.concatenate([image, alphas[..., None]], axis=-1)

    def lifted(self, lift: Float[Array, "d channels"]) -> Float[Array, "d r"]:
        """The convolution and what is before it, as one matrix, of what was rendered."""
        return lift if self.head is None else jnp.matmul(lift, self.head, precision="highest")


def init_field(
    key: PRNGKeyArray, config: DistillConfig, means: Float[Array, "n 3"], dimension: int
) -> tuple[FeatureField, Located | None]:
    """A field before it has learned, and where the Gaussians lie in its grid.

    Args:
        key: of first values.
        config: its sizes.
        means: of the scene's Gaussians, metres; the grid is over the box of those that are finite, and of a
            few that lie far out the features are those of its surface.
        dimension: D, of the teacher's features.

    Raises:
        ValueError: no Gaussian has a place.
    """
    first, second = jax.random.split(key)
    bound = np.sqrt(1 / config.channels)
    lift = jax.random.uniform(second, (dimension, config.channels), minval=-bound, maxval=bound)
    if config.encoding == "table":
        return FeatureField(1e-2 * jax.random.normal(first, (len(means), config.channels)), lift), None
    points = np.asarray(means)
    points = points[np.isfinite(points).all(axis=1)]
    if not len(points):
        raise ValueError(f"means: expected Gaussians with a place, found {len(means)}, none of them finite")
    low, high = _box(points)
    room = _MARGIN * max((high - low).max(), 1e-3)
    grid = init_feature_grid(first, config.grid, config.channels, np.stack([low - room, high + room]))
    return FeatureField(grid, lift), locate(grid, jnp.asarray(means))


def _box(points: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "2 3"]:
    """Around all points, but for those of a few that would make its cells much larger for all others."""
    low, high = np.quantile(points, [_MOST, 1 - _MOST], axis=0).astype(np.float32)
    room = _FAR_OUT * max((high - low).max(), 1e-3)
    return np.stack([np.maximum(points.min(0), low - room), np.minimum(points.max(0), high + room)])


def carried(field: FeatureField, located: Located | None, rows: Int[Array, "some"] | None = None) -> Carried:
    """What to render of a field: of all Gaussians, or of some.

    Args:
        field: of all Gaussians.
        located: where they lie in its grid; None for a table.
        rows: of which Gaussians; of all unless given.
    """
    if not isinstance(field.encoding, FeatureGrid):
        return Carried(field.encoding if rows is None else field.encoding[rows], None)
    assert located is not None
    if rows is not None:
        located = Located(*(a[rows] for a in located))
    last = field.encoding.layers[-1]
    assert last.bias is not None
    head = jnp.concatenate([last.weight, last.bias[:, None]], axis=1)
    return Carried(field.encoding.hidden_at(located), head)


def features_of(field: FeatureField, located: Located | None) -> Float[Array, "n channels"]:
    """f of each Gaussian."""
    return field.encoding.at(located) if isinstance(field.encoding, FeatureGrid) else field.encoding


def used_part(
    field: FeatureField, located: Located | None
) -> tuple[FeatureField, Located | None, Int[np.ndarray, "used"] | None]:
    """The field with only those entries of its table that some Gaussian lies between, and which they are.

    The others get no gradient, and Adam leaves alone what never had one; a fine grid has millions. On the
    host.
    """
    if not isinstance(field.encoding, FeatureGrid):
        return field, None, None
    assert located is not None
    rows, place = np.unique(np.asarray(located.indices), return_inverse=True)
    grid = eqx.tree_at(lambda g: g.table, field.encoding, field.encoding.table[rows])
    indices = jnp.asarray(place.reshape(located.indices.shape), jnp.int32)
    return FeatureField(grid, field.lift), located._replace(indices=indices), rows


def whole(field: FeatureField, rows: Int[np.ndarray, "used"] | None) -> FeatureField:
    """The field of a `used_part`, for any place; entries that no Gaussian of the scene lies between are 0."""
    if rows is None or not isinstance(field.encoding, FeatureGrid):
        return field
    table = field.encoding.table
    full = jnp.zeros((sum(field.encoding.config.entries), table.shape[1]), table.dtype).at[rows].set(table)
    return eqx.tree_at(lambda f: f.encoding.table, field, full)
