"""Deforming scenes: a field of offsets for each Gaussian at a given time, and the deformed Gaussians.

    mean' = mean + dmean,    scale' = exp(log s + ds)
    q' = Exp(dw) q                    SurstSplat, eq. 4: dw an axis times an angle
    q' = normalize(q + dq)            GaussianClin, eq. 3, with q of length 1

A field consists of an encoding of position and time, a small network on it, and a last layer that is
initialised to zero, so that nothing moves before training. Encodings are in `gsjax.scene.time_encodings`.
"""

from dataclasses import dataclass
from typing import Literal, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import jaxlie
import numpy as np
from jax.typing import ArrayLike
from jaxtyping import Array, Float, Int, PRNGKeyArray

from gsjax.geometry.rotations import multiply_quats, normalize_quats
from gsjax.scene.feature_grid import interpolated
from gsjax.scene.gaussians import Gaussians
from gsjax.scene.time_encodings import HexPlane, Sinusoids, Voxels, init_hexplane, init_voxels, within

_MOST_VOXELS = 255  # with 256^3 vertices, the most that a feature grid holds


@dataclass(frozen=True)
class DeformationConfig:
    """Sizes of a deformation field, and what it changes besides positions, orientations and scales."""

    kind: Literal["hexplane", "mlp", "voxels"] = "hexplane"
    """Encoding of position and time: six planes per level, one for each pair of axes (hexplane; Cao and
    Johnson 2023); sinusoids of both (mlp); or dense voxels in space with sinusoids of time (voxels;
    SurstSplat, section 2.1)."""
    rotation: Literal["exp", "add"] = "exp"
    """Axis and angle composed with the rotation, as in SurstSplat, or a difference of quaternions, as in
    GaussianClin."""
    resolution: int = 64
    """Vertices per axis of the coarsest planes, or voxels per axis (at most 255)."""
    time_resolution: int = 30
    """Vertices along the time axis of all planes: about half the number of frames, so that nearby frames
    share vertices."""
    levels: int = 2
    """Levels of planes, each twice as fine in space as the one before."""
    channels: int = 16
    """Channels per vertex."""
    frequencies: int = 6
    """Number of sinusoid frequencies: 1, 2, 4, ... periods over the box, or over the whole duration."""
    hidden: int = 64
    """Width of the network's hidden layers."""
    depth: int = 1
    """Number of hidden layers of the network."""
    semantic: bool = False
    """Feed the Gaussians' features to the network."""
    color: bool = False
    """Change colours over time."""
    opacity: bool = False
    """Change opacities over time."""
    feature: bool = False
    """Change features over time."""

    def __post_init__(self):
        least = {"resolution": 2, "time_resolution": 2, "levels": 1, "channels": 1, "hidden": 1}
        least |= {"frequencies": 0, "depth": 0}
        for name, low in least.items():
            if getattr(self, name) < low:
                raise ValueError(f"{name}: expected at least {low}, found {getattr(self, name)}")
        if self.kind == "voxels" and self.resolution > _MOST_VOXELS:
            raise ValueError(
                f"resolution: expected at most {_MOST_VOXELS} with voxels, found {self.resolution}"
            )


class Offsets(NamedTuple):
    """Offsets of N Gaussians; None for fields that do not change.

    Attributes:
        means: offsets of the centres, metres.
        turns: axis times angle, radians; or, with four columns, differences of unit quaternions.
        log_scales: offsets of the logarithms of the standard deviations.
        logit_opacities, sh0, features: offsets of these raw values.
    """

    means: Float[Array, "N 3"]
    turns: Float[Array, "N turn"]
    log_scales: Float[Array, "N 3"]
    logit_opacities: Float[Array, "N"] | None = None
    sh0: Float[Array, "N 1 3"] | None = None
    features: Float[Array, "N D"] | None = None


class DeformationField(eqx.Module):
    """(position, time) -> `Offsets`. All leaves are floats, so `jax.grad` applies to the whole module.

    Attributes:
        encoding: encoding of position and time.
        layers: layers of the network, with a ReLU between them.
        config: sizes.
        bounds: least and largest coordinates of the scene's box, metres; its longest edge is the unit of
            `means`.
    """

    encoding: HexPlane | Sinusoids | Voxels
    layers: tuple[eqx.nn.Linear, ...]
    config: DeformationConfig = eqx.field(static=True)
    bounds: tuple[tuple[float, ...], tuple[float, ...]] = eqx.field(static=True)

    def __call__(
        self, means: Float[Array, "N 3"], time: Float[Array, ""], features: Float[Array, "N D"] | None = None
    ) -> Offsets:
        """Offsets of Gaussians at a time.

        Args:
            means: canonical centres, metres; those outside the box are clamped to its surface.
            time: 0 to 1 over the whole recording; clamped beyond its ends.
            features: features of the Gaussians, if the field reads or changes them.

        Raises:
            ValueError: the field needs features and there are none.
        """
        config = self.config
        if features is None and (config.semantic or config.feature):
            raise ValueError("features: expected an array, as this field reads or changes them, found None")
        values = self.encoding(within(means, self.bounds), time)
        if config.semantic:
            values = jnp.concatenate([values, features], axis=-1)
        for layer in self.layers[:-1]:
            values = jax.nn.relu(jax.vmap(layer)(values))
        values = jax.vmap(self.layers[-1])(values)
        widths = _widths(config, 0 if features is None else features.shape[1])
        split = jnp.split(values, np.cumsum([*widths.values()])[:-1].tolist(), axis=-1)
        found = {name: part for name, part in zip(widths, split, strict=True) if widths[name]}
        edge = max(high - low for low, high in zip(*self.bounds, strict=True))
        found["means"] = edge * found["means"]
        if config.opacity:
            found["logit_opacities"] = found["logit_opacities"][:, 0]
        if config.color:
            found["sh0"] = found["sh0"][:, None]
        if isinstance(self.encoding, Voxels) and features is not None and config.feature:
            found["features"] = found["features"] + self.encoding.meaning(within(means, self.bounds))
        return Offsets(**found)


def init_deformation(
    key: PRNGKeyArray, config: DeformationConfig, bounds: ArrayLike, feature_size: int = 0
) -> DeformationField:
    """A field that does not change anything yet.

    Args:
        key: random key for the initial values.
        config: sizes.
        bounds: [2, 3], least and largest coordinates of the scene, metres. They are static.
        feature_size: size of the Gaussians' features, if the field reads or changes them.

    Raises:
        ValueError: the box is invalid, or the field needs features and `feature_size` is 0.
    """
    box = np.asarray(bounds, np.float32)
    if box.shape != (2, 3) or not np.isfinite(box).all() or not (box[0] < box[1]).all():
        raise ValueError(f"bounds: expected [2, 3], least and largest coordinates, found {box.tolist()}")
    if (config.semantic or config.feature) and feature_size < 1:
        raise ValueError(
            f"feature_size: expected 1 or more, as the field reads or changes features, found {feature_size}"
        )
    key, first = jax.random.split(key)
    encoding: HexPlane | Sinusoids | Voxels
    if config.kind == "hexplane":
        encoding = init_hexplane(
            first, config.resolution, config.time_resolution, config.levels, config.channels
        )
    elif config.kind == "mlp":
        encoding = Sinusoids(config.frequencies)
    else:
        outputs = max(1, feature_size if config.feature else 0)
        encoding = init_voxels(first, config.resolution, config.channels, config.frequencies, outputs)
    inputs = encoding.size + (feature_size if config.semantic else 0)
    outputs = sum(_widths(config, feature_size).values())
    widths = (inputs, *[config.hidden] * config.depth, outputs)
    keys = jax.random.split(key, config.depth + 1)
    layers = [eqx.nn.Linear(*pair, key=one) for *pair, one in zip(widths[:-1], widths[1:], keys, strict=True)]
    layers[-1] = jax.tree.map(jnp.zeros_like, layers[-1])
    low, high = box.tolist()
    return DeformationField(encoding, tuple(layers), config, (tuple(low), tuple(high)))


def _widths(config: DeformationConfig, feature_size: int) -> dict[str, int]:
    """Number of outputs of the last layer for each field of `Offsets`."""
    return {
        "means": 3,
        "turns": 3 if config.rotation == "exp" else 4,
        "log_scales": 3,
        "logit_opacities": int(config.opacity),
        "sh0": 3 * config.color,
        "features": feature_size * config.feature,
    }


def deform(gaussians: Gaussians, offsets: Offsets) -> Gaussians:
    """The Gaussians with the offsets of a field applied.

    Args:
        gaussians: canonical Gaussians.
        offsets: offsets of each Gaussian.
    """
    quats = normalize_quats(gaussians.quats)
    if offsets.turns.shape[-1] == 3:
        quats = multiply_quats(jaxlie.SO3.exp(offsets.turns).wxyz, quats)
    else:
        quats = normalize_quats(quats + offsets.turns)
    added = {name: getattr(offsets, name) for name in Offsets._fields if name != "turns"}
    changed = {name: getattr(gaussians, name) + value for name, value in added.items() if value is not None}
    return Gaussians(
        **{name: getattr(gaussians, name) for name in ("logit_opacities", "sh0", "shN", "features")}
        | changed
        | {"quats": quats}
    )


class Nodes(NamedTuple):
    """Control nodes: the field is evaluated there instead of at every Gaussian, and the offsets are blended,
    because deformations vary slowly between Gaussians (Sumner et al. 2007; SC-GS, Huang et al. 2024).

    Attributes:
        rows: the Gaussians that are nodes.
        indices: the nodes that each Gaussian blends.
        weights: weights of these nodes, which sum to 1.
    """

    rows: Int[Array, "M"]
    indices: Int[Array, "N k"]
    weights: Float[Array, "N k"]


def deform_by_nodes(
    gaussians: Gaussians, field: DeformationField, time: Float[Array, ""], nodes: Nodes
) -> Gaussians:
    """The scene at a time, with each Gaussian moved by the nodes around it.

    Args:
        gaussians: canonical Gaussians.
        field: the deformation field.
        time: 0 to 1.
        nodes: control nodes among these Gaussians.
    """
    return deform(gaussians, _by_nodes(gaussians, field, time, nodes))


def _by_nodes(gaussians: Gaussians, field: DeformationField, time: Float[Array, ""], nodes: Nodes) -> Offsets:
    """Offsets of the Gaussians that `nodes` blends."""
    return blended_offsets(node_offsets(gaussians, field, time, nodes), nodes)


def node_offsets(
    gaussians: Gaussians, field: DeformationField, time: Float[Array, ""], nodes: Nodes
) -> Offsets:
    """Offsets of the nodes. Arguments as for `deform_by_nodes`."""
    features = None if gaussians.features is None else gaussians.features[nodes.rows]
    return field(gaussians.means[nodes.rows], time, features)


def blended_offsets(offsets: Offsets, nodes: Nodes) -> Offsets:
    """Offsets of all Gaussians.

    Args:
        offsets: offsets of the nodes.
        nodes: control nodes.
    """

    def blended(values):
        flat = values.reshape(len(values), -1)
        found = interpolated(flat, nodes.weights[:, None], nodes.indices[:, None])
        return found.reshape(-1, *values.shape[1:])

    return jax.tree.map(blended, offsets)


def features_at(
    gaussians: Gaussians,
    field: DeformationField | None,
    times: Float[Array, "T"],
    rows: Int[Array, "n"],
    nodes: Nodes | None = None,
) -> Float[Array, "T n D"]:
    """Features of selected Gaussians at several times; the field is evaluated only if it changes features.

    Args:
        gaussians: canonical Gaussians with features.
        field: the deformation field; None changes nothing.
        times: 0 to 1.
        rows: the selected Gaussians.
        nodes: control nodes at which to evaluate the field; None evaluates it at the Gaussians themselves.
    """
    some = jax.tree.map(lambda leaf: leaf[rows], gaussians)
    still = jnp.broadcast_to(some.features, (len(times), *some.features.shape))
    if field is None or not field.config.feature:
        return still
    if nodes is None:
        changes = jax.vmap(lambda time: field(some.means, time, some.features).features)(times)
    else:
        blends = nodes._replace(indices=nodes.indices[rows], weights=nodes.weights[rows])
        changes = jax.vmap(lambda time: _by_nodes(gaussians, field, time, blends).features)(times)
    assert changes is not None
    return still + changes


def deform_rows(
    gaussians: Gaussians, field: DeformationField, time: Float[Array, ""], rows: Int[Array, "M"] | None = None
) -> Gaussians:
    """The scene at a time, with only some Gaussians deformed: the field is evaluated only at those.

    Args:
        gaussians: canonical Gaussians.
        field: the deformation field.
        time: 0 to 1.
        rows: the Gaussians that deform (default: all). Rows beyond the last Gaussian (`gaussians.num`) pad
            the list to a static length and change nothing.
    """
    if rows is None:
        return deform(gaussians, field(gaussians.means, time, gaussians.features))
    some = jax.tree.map(lambda leaf: leaf.at[rows].get(mode="clip"), gaussians)
    moved = deform(some, field(some.means, time, some.features))
    return jax.tree.map(lambda leaf, new: leaf.at[rows].set(new, mode="drop"), gaussians, moved)
