"""Points that are aligned: with tones, the same number for each group, each looked for by some cameras.

They are pixels of the last frame, which look most like the new one; pixels of a keyframe, carried along since
then; and centres of the Gaussians that the first mask named. The last frame alone would drift, and what once
slid off its object would take its neighbours' pixels for its own; the others remember what it was.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import jaxlie
import numpy as np
from jaxtyping import Array, Bool, Float, Int, Shaped

from gsjax.geometry.cameras import Camera, unproject
from gsjax.methods.track.config import AlignConfig
from gsjax.rasterize.sorting import sort_keys
from gsjax.scene.frame import Frame


class Points(NamedTuple):
    """Points of the groups 1..K that each of C cameras looks for; a coordinate's values lie side by side."""

    means: Float[Array, "*k c 3 p"]
    tones: Float[Array, "*k c 3 p"]
    seen: Float[Array, "*k c p"]  # what a point counts, 0 to 1; 0 fills up a row


def join(*several: Points) -> Points:
    """The points of all."""
    return Points(*(jnp.concatenate(rows, axis=-1) for rows in zip(*several, strict=True)))


class Sight(NamedTuple):
    """A frame as points are compared with it: red, green and blue in tones and, if measured, depth."""

    cameras: Camera
    pixels: Float[Array, "c height width d"]
    measures: Bool[Array, "c"] | None  # which cameras measured any depth; None without depth

    @property
    def tones(self) -> Float[Array, "c height width 3"]:
        """The first three channels of the pixels, which are compared."""
        return self.pixels[..., :3]

    @property
    def depths(self) -> Float[Array, "c height width"] | None:
        """Metres; 0 where nothing was measured."""
        return self.pixels[..., 3] if self.pixels.shape[-1] == 4 else None


def sight_of(frame: Frame, shading: float) -> Sight:
    """The frame in tones."""
    seen = tones(frame.images, shading)
    if frame.depths is None:
        return Sight(frame.cameras, seen, None)
    # As a concatenation this is a loop with branches on a CPU.
    padded = jnp.pad(seen, [(0, 0)] * 3 + [(0, 1)])
    pixels = jnp.where(np.arange(4) < 3, padded, frame.depths[..., None])
    return Sight(frame.cameras, pixels, (frame.depths > 0).any((1, 2)))


def tones(colors: Float[Array, "*n 3"], shading: float) -> Float[Array, "*n 3"]:
    """Logarithms of the three channels, halved to span about 0 to 1, their mean reduced to a share `shading`.

    Light scales all channels alike, so it moves the mean of the logarithms only. Without this, a can that
    rolls under a lamp looks more like one that stands still, lit as before.
    """
    logs = 0.5 * jnp.log(jnp.maximum(colors, 0.0) + 0.1)  # the offset keeps the noise of dark pixels down
    mean = sum_of_three(logs, axis=-1) / 3
    return logs - (1 - shading) * mean[..., None]


def of_groups(chosen: Bool[Array, "k"], a: Shaped[Array, "k *d"], b: Shaped[Array, "k *d"]):
    """The rows of `a` for the chosen groups, and of `b` for the others."""
    return jnp.where(chosen.reshape(-1, *[1] * (a.ndim - 1)), a, b)


def carry(points: Points, twist: Float[Array, "6"], center: Float[Array, "3"]) -> Points:
    """One group's points after its twist (translation, rotation vector) about its centre.

    Args:
        points: of the group.
        twist: translation in metres, rotation vector.
        center: about which it turns, metres.
    """
    turn = jaxlie.SO3.exp(twist[3:]).as_matrix()
    moved = rotated(turn, points.means - center[:, None]) + (center + twist[:3])[:, None]
    return points._replace(means=moved)


def rotated(matrix: Float[Array, "3 3"], vectors: Float[Array, "*n 3 p"]) -> Float[Array, "*n 3 p"]:
    """matrix @ vectors, written out: XLA:CPU takes longer to set up a product so thin than to do it."""
    x, y, z = (vectors[..., i : i + 1, :] for i in range(3))
    return matrix[:, :1] * x + matrix[:, 1:2] * y + matrix[:, 2:] * z


def sum_of_three(values: Float[Array, "..."], axis: int) -> Float[Array, "..."]:
    """The sum of an array [..., 3, ...] along an axis of length 3, written out.

    XLA:CPU works out a reduction's numbers one by one.
    """
    x, y, z = (jax.lax.index_in_dim(values, i, axis, keepdims=False) for i in range(3))
    return x + y + z


def first_members(
    groups: Int[Array, "n"], num_groups: int, per_group: int
) -> tuple[Int[Array, "k p"], Bool[Array, "k p"]]:
    """Up to `per_group` places of each group 1..K, in a fixed random order, and which of them are real.

    Other values than 1..K belong to nobody. One sort finds the members of all groups.

    Args:
        groups: of n Gaussians or pixels.
        num_groups: K, static.
        per_group: static.
    """
    count = groups.shape[0]
    visit = np.random.default_rng(0).permutation(count).astype(np.int32)
    bits = max(1, (count - 1).bit_length())
    group = jnp.where((groups >= 1) & (groups <= num_groups), groups, num_groups + 1)[visit]
    keys = (group.astype(jnp.uint32) << bits) | jnp.arange(count, dtype=jnp.uint32)
    keys = sort_keys(keys, "host")
    reference = jnp.arange(1, num_groups + 1, dtype=jnp.uint32) << bits
    places = jnp.searchsorted(keys, reference)[:, None] + jnp.arange(per_group)
    found = keys[jnp.minimum(places, count - 1)]
    real = (places < count) & ((found >> bits) == jnp.arange(1, num_groups + 1, dtype=jnp.uint32)[:, None])
    return jnp.asarray(visit)[found & jnp.uint32((1 << bits) - 1)], real


def pixel_counts(labels: Int[Array, "c h w"], num_groups: int) -> Float[Array, "k"]:
    """How many pixels show each group 1..K, all cameras together."""
    groups = jnp.arange(1, num_groups + 1)
    return jax.vmap(lambda group: (labels == group).sum(dtype=float))(groups)


def pixels_of_groups(
    sight: Sight,
    labels: Int[Array, "c h w"],
    depths: Float[Array, "c h w"],
    num_groups: int,
    config: AlignConfig,
    coarseness: int = 1,
) -> Points:
    """Up to `config.pixels` pixels of each group in each camera, as points that this camera looks for.

    Args:
        sight: what the cameras saw; for a camera without depth, the model's depth stands in.
        labels: the group of each pixel, 0 for none.
        depths: of the model at that pixel. What is measured further off
            than a group is thick is something else.
        num_groups: K, static.
        config: with how many pixels.
        coarseness: n, where labels and depths are of every n-th pixel.
    """
    sight = sight._replace(pixels=sight.pixels[:, ::coarseness, ::coarseness])
    width = sight.pixels.shape[2]
    measured = depths
    if sight.depths is not None:
        assert sight.measures is not None
        measured = jnp.where(sight.measures[:, None, None], sight.depths, depths)
    usable = (measured > 0) & (jnp.abs(measured - depths) < config.max_thickness)

    def one(viewmat, K, groups, depth, image):
        rows, real = first_members(groups.ravel(), num_groups, config.pixels)
        pixels = coarseness * jnp.stack([rows % width, rows // width], axis=-1) + 0.5
        points = unproject(pixels, depth.ravel()[rows], viewmat, K)
        seen = image.reshape(-1, 3)[rows]
        return jnp.swapaxes(points, 1, 2), jnp.swapaxes(seen, 1, 2), real.astype(points.dtype)

    views = (sight.cameras.viewmat, sight.cameras.K, jnp.where(usable, labels, 0), measured, sight.tones)
    return Points(*jax.vmap(one, out_axes=1)(*views))


class Keyframe(NamedTuple):
    """Pixels that showed each group in an earlier frame, where they would be now."""

    points: Points
    turned: Float[Array, "k 4"]  # how each group has turned since then, as a quaternion


def first_keyframe(pixels: Points) -> Keyframe:
    """The last frame's pixels as keyframe."""
    unturned = jnp.zeros((len(pixels.means), 4), pixels.means.dtype).at[:, 0].set(1.0)
    return Keyframe(pixels, unturned)


def turn_since(keyframe: Keyframe) -> Float[Array, "k"]:
    """By how much each group has turned since its keyframe, radians."""
    return 2 * jnp.arccos(jnp.clip(jnp.abs(keyframe.turned[:, 0]), 0.0, 1.0))


def faded(keyframe: Keyframe, max_turn: float) -> Points:
    """The keyframe's points, which count less the more a group has turned: it is lit differently by then."""
    share = jnp.clip(1 - turn_since(keyframe) / max(max_turn, 1e-9), 0.0, 1.0)
    return keyframe.points._replace(seen=keyframe.points.seen * share[:, None, None])


def renewed(
    keyframe: Keyframe, pixels: Points, max_turn: float, retaken: Bool[Array, "k"] | None = None
) -> Keyframe:
    """`pixels` for the groups that have turned by more than `max_turn` radians, which show other sides now,
    and for those that are `retaken`: what they had while they were lost is something else's."""
    old = turn_since(keyframe) > max_turn
    old = old if retaken is None else old | retaken
    return jax.tree.map(lambda new, kept: of_groups(old, new, kept), first_keyframe(pixels), keyframe)


def carry_keyframe(keyframe: Keyframe, twists: Float[Array, "k 6"], centers: Float[Array, "k 3"]) -> Keyframe:
    """The keyframe after each group's twist about its centre.

    Args:
        keyframe: of all groups.
        twists: translations in metres, rotation vectors.
        centers: about which groups turn, metres.
    """
    turned = jaxlie.SO3.exp(twists[:, 3:]) @ jaxlie.SO3(keyframe.turned)
    return Keyframe(jax.vmap(carry)(keyframe.points, twists, centers), turned.normalize().wxyz)
