"""The points that are aligned with the images: positions with tones, equally many for each group.

They are pixels of the last frame, which look most like the new one; pixels of a keyframe, carried along since
then; and centres of the Gaussians labelled by the first mask. With pixels of the last frame alone, a group
would drift, and once it slid off its object, it would take its neighbours' pixels for its own; the other two
remember what the object looked like.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import jaxlie
import numpy as np
from jaxtyping import Array, Bool, Float, Int, Shaped

from gsjax.geometry.cameras import Camera, unproject
from gsjax.geometry.rotations import matrix_of
from gsjax.methods.track.config import AlignConfig
from gsjax.rasterize.sorting import argsort_keys
from gsjax.scene.frame import Frame


class Points(NamedTuple):
    """Points of the groups 1..K, for each of C cameras; the values of one coordinate are contiguous."""

    means: Float[Array, "*k c 3 p"]
    tones: Float[Array, "*k c 3 p"]
    seen: Float[Array, "*k c p"]  # weight of the point in the camera, 0 to 1; 0 is padding


def join(*several: Points) -> Points:
    """All points of several sets of the same groups and cameras."""
    return Points(*(jnp.concatenate(rows, axis=-1) for rows in zip(*several, strict=True)))


class ToneImages(NamedTuple):
    """A frame as tones and depth, for comparison with points."""

    cameras: Camera
    pixels: Float[Array, "c height width d"]  # tones of red, green and blue and, if measured, depth in metres
    measures: Bool[Array, "c"] | None  # cameras that measured any depth; None without depth cameras

    @property
    def tones(self) -> Float[Array, "c height width 3"]:
        """The first three channels of the pixels."""
        return self.pixels[..., :3]

    @property
    def depths(self) -> Float[Array, "c height width"] | None:
        """Metres; 0 where nothing was measured."""
        return self.pixels[..., 3] if self.pixels.shape[-1] == 4 else None


def tone_images(frame: Frame, shading: float) -> ToneImages:
    """The frame in tones; `shading` as for `tones`."""
    seen = tones(frame.images, shading)
    if frame.depths is None:
        return ToneImages(frame.cameras, seen, None)
    # A concatenation would be compiled to a loop with branches on a CPU.
    padded = jnp.pad(seen, [(0, 0)] * 3 + [(0, 1)])
    pixels = jnp.where(np.arange(4) < 3, padded, frame.depths[..., None])
    return ToneImages(frame.cameras, pixels, (frame.depths > 0).any((1, 2)))


def tones(colors: Float[Array, "*n 3"], shading: float) -> Float[Array, "*n 3"]:
    """Logarithms of the three channels, halved to span about 0 to 1, with their mean scaled by `shading`.

    Light scales all channels equally, so it changes only the mean of the logarithms. Without the scaling, a
    can that rolls under a lamp would look more like one that stands still.
    """
    logs = 0.5 * jnp.log(jnp.maximum(colors, 0.0) + 0.1)  # the offset keeps the noise of dark pixels down
    mean = sum_of_three(logs, axis=-1) / 3
    return logs - (1 - shading) * mean[..., None]


def select_groups(chosen: Bool[Array, "k"], a: Shaped[Array, "k *d"], b: Shaped[Array, "k *d"]):
    """The rows of `a` for the chosen groups and of `b` for the others."""
    return jnp.where(chosen.reshape(-1, *[1] * (a.ndim - 1)), a, b)


def carry(points: Points, twist: Float[Array, "6"], center: Float[Array, "3"]) -> Points:
    """The points of one group after its twist (translation, metres, and rotation vector) about `center`."""
    moved = rotated(matrix_of(twist[3:]), points.means - center[:, None]) + (center + twist[:3])[:, None]
    return points._replace(means=moved)


def rotated(matrix: Float[Array, "3 3"], vectors: Float[Array, "*n 3 p"]) -> Float[Array, "*n 3 p"]:
    """matrix @ vectors, written out: XLA:CPU takes longer to set up so thin a product than to compute it."""
    x, y, z = (vectors[..., i : i + 1, :] for i in range(3))
    return matrix[:, :1] * x + matrix[:, 1:2] * y + matrix[:, 2:] * z


def sum_of_three(values: Float[Array, "..."], axis: int) -> Float[Array, "..."]:
    """The sum of `values` [..., 3, ...] along an axis of length 3, written out, because XLA:CPU does not
    vectorise reductions."""
    x, y, z = (jax.lax.index_in_dim(values, i, axis, keepdims=False) for i in range(3))
    return x + y + z


def first_members(
    groups: Int[Array, "n"], num_groups: int, per_group: int
) -> tuple[Int[Array, "k p"], Bool[Array, "k p"]]:
    """Indices of up to `per_group` members of each group, in a fixed random order, and which are real.

    A single sort finds the members of all groups.

    Args:
        groups: group of each Gaussian or pixel; values other than 1..K are ignored.
        num_groups: K, static.
        per_group: number of indices of each group, static; those that are not real are padding.
    """
    count = groups.shape[0]
    visit = np.random.default_rng(0).permutation(count).astype(np.int32)
    group = jnp.where((groups >= 1) & (groups <= num_groups), groups, num_groups + 1)[visit]
    order = argsort_keys(group.astype(jnp.uint32))
    reference = jnp.arange(1, num_groups + 1, dtype=group.dtype)
    places = jnp.searchsorted(group[order], reference)[:, None] + jnp.arange(per_group)
    found = order[jnp.minimum(places, count - 1)]
    real = (places < count) & (group[found] == reference[:, None])
    return jnp.asarray(visit)[found], real


def pixel_counts(labels: Int[Array, "c h w"], num_groups: int) -> Float[Array, "k"]:
    """Number of pixels that show each group 1..K, all cameras together."""
    groups = jnp.arange(1, num_groups + 1)
    return jax.vmap(lambda group: (labels == group).sum(dtype=float))(groups)


def pixels_of_groups(
    images: ToneImages,
    labels: Int[Array, "c h w"],
    depths: Float[Array, "c h w"],
    num_groups: int,
    config: AlignConfig,
    coarseness: int = 1,
) -> Points:
    """Up to `config.pixels` pixels of each group in each camera, as points with weight 1 in that camera.

    Args:
        images: the frame; a camera without depth takes the depth of the model.
        labels: group of each pixel, 0 for none.
        depths: depth of the model, metres. A pixel whose measured depth differs by more than the thickness of
            a group shows something else.
        num_groups: K, static.
        coarseness: n, if labels and depths are of every n-th pixel.
    """
    images = images._replace(pixels=images.pixels[:, ::coarseness, ::coarseness])
    width = images.pixels.shape[2]
    measured = depths
    if images.depths is not None:
        assert images.measures is not None
        measured = jnp.where(images.measures[:, None, None], images.depths, depths)
    usable = (measured > 0) & (jnp.abs(measured - depths) < config.max_thickness)

    def one(viewmat, K, groups, depth, image):
        rows, real = first_members(groups.ravel(), num_groups, config.pixels)
        pixels = coarseness * jnp.stack([rows % width, rows // width], axis=-1) + 0.5
        points = unproject(pixels, depth.ravel()[rows], viewmat, K)
        seen = image.reshape(-1, 3)[rows]
        return jnp.swapaxes(points, 1, 2), jnp.swapaxes(seen, 1, 2), real.astype(points.dtype)

    views = (images.cameras.viewmat, images.cameras.K, jnp.where(usable, labels, 0), measured, images.tones)
    return Points(*jax.vmap(one, out_axes=1)(*views))


class Keyframe(NamedTuple):
    """Pixels that showed each group in an earlier frame, carried along since then."""

    points: Points
    turned: Float[Array, "k 4"]  # rotation of each group since then, as a quaternion


def first_keyframe(pixels: Points) -> Keyframe:
    """A keyframe of the last frame's pixels."""
    unturned = jnp.zeros((len(pixels.means), 4), pixels.means.dtype).at[:, 0].set(1.0)
    return Keyframe(pixels, unturned)


def angle_since(keyframe: Keyframe) -> Float[Array, "k"]:
    """Angle by which each group has rotated since its keyframe, radians."""
    return 2 * jnp.arccos(jnp.clip(jnp.abs(keyframe.turned[:, 0]), 0.0, 1.0))


def faded(keyframe: Keyframe, max_turn: float) -> Points:
    """The keyframe's points, with weights that fade to 0 as a group rotates by `max_turn`, radians, because
    it is then lit differently."""
    share = jnp.clip(1 - angle_since(keyframe) / max(max_turn, 1e-9), 0.0, 1.0)
    return keyframe.points._replace(seen=keyframe.points.seen * share[:, None, None])


def renewed(
    keyframe: Keyframe, pixels: Points, max_turn: float, relocated: Bool[Array, "k"] | None = None
) -> Keyframe:
    """The keyframe, replaced by `pixels` for groups that have rotated by more than `max_turn`, radians, and
    so show other sides, and for `relocated` ones, whose keyframe shows something else."""
    old = angle_since(keyframe) > max_turn
    old = old if relocated is None else old | relocated
    return jax.tree.map(lambda new, kept: select_groups(old, new, kept), first_keyframe(pixels), keyframe)


def carry_keyframe(keyframe: Keyframe, twists: Float[Array, "k 6"], centers: Float[Array, "k 3"]) -> Keyframe:
    """The keyframe after the twists of the groups (translations, metres, and rotation vectors) about their
    `centers`."""
    turned = jaxlie.SO3.exp(twists[:, 3:]) @ jaxlie.SO3(keyframe.turned)
    return Keyframe(jax.vmap(carry)(keyframe.points, twists, centers), turned.normalize().wxyz)
