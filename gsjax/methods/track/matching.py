"""Template matching: find each object's template in the image, and lift its shift to 3D (the object-centric
initialisation of Object-Aware Gaussian Splatting for Robotic Manipulation, section II-B).

The template is the last scene as rendered, masked by the object's visible alpha. The score is the zero-mean
normalised cross-correlation under that mask, over all shifts at once by FFT:

    score(d) = sum_p m T'(p) I(p+d) / sqrt(sum_p m T'(p)^2  V(d)),
    V(d) = sum_p m I(p+d)^2 - (sum_p m I(p+d))^2 / sum_p m,

with T' = T minus its mean under m; sums include the channels.
"""

from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from gsjax.geometry.cameras import camera_centers, unproject
from gsjax.methods.track.config import MatchConfig
from gsjax.scene.frame import Frame


class Template(NamedTuple):
    """The last scene as rendered, or the last images, with the weight of each object in each pixel."""

    colors: Float[Array, "c h w 3"]
    depths: Float[Array, "c h w"]
    weights: Float[Array, "c h w k"]


class TemplateMatch(NamedTuple):
    """Where the template of each object was found in each camera."""

    score: Float[Array, "*ck"]  # correlation at the peak, -1 to 1; 0 if nothing was visible
    shift: Float[Array, "*ck 2"]  # pixels
    origin: Float[Array, "*ck 2"]  # centre of the visible mask, pixels
    depth: Float[Array, "*ck"]  # rendered depth of the visible surface, metres
    depth_change: Float[Array, "*ck"]  # measured minus rendered, metres
    measured: Bool[Array, "*ck"]  # whether the depth image has the surface


def _peak(scores: Float[Array, "s s"]) -> tuple[Float[Array, "2"], Float[Array, ""]]:
    """Sub-pixel position (x, y) of the largest score, from a parabola along each axis, and that score."""
    size = scores.shape[0]
    flat = jnp.argmax(scores)
    y, x = flat // size, flat % size
    best = scores[y, x]

    def vertex(before, after):
        bend = before - 2 * best + after
        offset = jnp.clip(0.5 * (before - after) / jnp.minimum(bend, -1e-6), -0.5, 0.5)
        return jnp.where(bend < -1e-6, offset, 0.0)

    xs = jnp.clip(jnp.array([x - 1, x + 1]), 0, size - 1)
    ys = jnp.clip(jnp.array([y - 1, y + 1]), 0, size - 1)
    dx, dy = vertex(scores[y, xs[0]], scores[y, xs[1]]), vertex(scores[ys[0], x], scores[ys[1], x])
    return jnp.stack([x + dx, y + dy]), best


def correlate(
    template: Float[Array, "p p 3"], mask: Float[Array, "p p"], search: Float[Array, "s s 3"]
) -> Float[Array, "d d"]:
    """Masked zero-mean normalised cross-correlation at every placement of the template within `search`."""
    size, patch = search.shape[0], template.shape[0]
    places = size - patch + 1
    total = jnp.maximum(mask.sum(), 1e-6)
    mean = (mask[..., None] * template).sum((0, 1)) / total
    centred = mask[..., None] * (template - mean)
    template_energy = (centred * (template - mean)).sum()
    search = search - search.mean((0, 1))  # no effect on the score, and smaller numbers

    def spectrum(a):
        return jnp.fft.rfft2(a, (size, size), axes=(0, 1))

    def placed(a):
        return jnp.fft.irfft2(a, (size, size), axes=(0, 1))[:places, :places]

    of_mask = jnp.conj(spectrum(mask))
    of_search = spectrum(search)
    product = placed((of_search * jnp.conj(spectrum(centred))).sum(-1))
    squares = placed(spectrum((search**2).sum(-1)) * of_mask)
    sums = placed(of_search * of_mask[..., None])
    energy = jnp.maximum(squares - (sums**2).sum(-1) / total, 0.0)
    # Patches without contrast correlate with everything: regularise as if there were a little noise.
    floor = 1e-4 * total
    return product / jnp.sqrt((energy + floor) * (template_energy + floor))


def match_templates(
    template: Template, frame: Frame, config: MatchConfig, reduction: int = 1
) -> TemplateMatch:
    """Match every object in every camera: fields [C, K].

    Args:
        template: the last scene in the new frame's cameras.
        frame: the new frame.
        reduction: factor by which images are averaged down first, for objects larger than the template.
    """
    shrink = jax.vmap(lambda a: _reduce(a, reduction))
    (colors, depths, weights), images = template, frame.images
    rendered_small, image_small, weight_small = shrink(colors), shrink(images), shrink(weights)
    one = partial(_match_one, config=config, reduction=reduction)
    measured = jnp.zeros_like(depths) if frame.depths is None else frame.depths
    over_objects = jax.vmap(one, in_axes=(None, None, -1, -1, None, None))
    return jax.vmap(over_objects)(rendered_small, image_small, weight_small, weights, depths, measured)


def _reduce(image: Float[Array, "h w k"], factor: int) -> Float[Array, "h2 w2 k"]:
    """Means over blocks; the border is repeated to fill the last ones."""
    if factor == 1:
        return image
    height, width, channels = image.shape
    padded = jnp.pad(image, ((0, -height % factor), (0, -width % factor), (0, 0)), mode="edge")
    blocks = padded.reshape(padded.shape[0] // factor, factor, -1, factor, channels)
    return blocks.mean((1, 3))


def _match_one(color, image, weight, full_weight, depth, measured_depth, config: MatchConfig, reduction: int):
    """The match of one object in one camera."""
    patch, radius = config.patch, config.radius
    height, width = weight.shape
    mass = weight.sum()
    y, x = jnp.meshgrid(jnp.arange(height) + 0.5, jnp.arange(width) + 0.5, indexing="ij")
    center = jnp.stack([(weight * x).sum(), (weight * y).sum()]) / jnp.maximum(mass, 1e-6)
    corner = jnp.floor(center).astype(jnp.int32) - patch // 2  # (x, y) of the template's first pixel

    margin = patch + radius  # room for a template centred on any pixel, and its search

    def crop(a, size, before, mode="edge"):
        padded = jnp.pad(a, [(margin, margin)] * 2 + [(0, 0)] * (a.ndim - 2), mode=mode)
        begin = (corner[1] - before + margin, corner[0] - before + margin) + (0,) * (a.ndim - 2)
        return jax.lax.dynamic_slice(padded, begin, (size, size, *a.shape[2:]))

    inside = crop(jnp.ones_like(weight), patch, 0, "constant")
    mask = crop(weight, patch, 0, "constant")
    grown = jax.lax.reduce_window(mask, -jnp.inf, jax.lax.max, (2 * config.margin + 1,) * 2, (1, 1), "SAME")
    scores = correlate(crop(color, patch, 0), grown * inside, crop(image, patch + 2 * radius, radius))
    place, score = _peak(scores)
    shift = (place - radius) * reduction

    seen = full_weight > 0.5
    surface, known = _weighted_median(depth, seen & (depth > 0))
    moved = jnp.round(shift).astype(jnp.int32)
    found_depth = _shifted(measured_depth, moved)
    change, measured = _weighted_median(found_depth - depth, seen & (found_depth > 0) & (depth > 0))
    enough = known & (seen.sum() >= 8)
    return TemplateMatch(
        score=jnp.where(enough, score, 0.0),
        shift=shift,
        origin=center * reduction,
        depth=surface,
        depth_change=change,
        measured=measured & enough,
    )


def _shifted(image: Float[Array, "h w"], shift) -> Float[Array, "h w"]:
    """`image` read at p + shift; 0 outside."""
    height, width = image.shape
    rows, columns = jnp.arange(height) + shift[1], jnp.arange(width) + shift[0]
    inside = ((rows >= 0) & (rows < height))[:, None] & ((columns >= 0) & (columns < width))[None, :]
    read = image[jnp.clip(rows, 0, height - 1)][:, jnp.clip(columns, 0, width - 1)]
    return jnp.where(inside, read, 0.0)


def _weighted_median(values: Float[Array, "h w"], chosen: Bool[Array, "h w"]):
    """Median of the chosen values, and whether there is one."""
    count = chosen.sum()
    ordered = jnp.sort(jnp.where(chosen, values, jnp.inf).ravel())
    middle = ordered[jnp.maximum(count - 1, 0) // 2]
    return jnp.where(count > 0, middle, 0.0), count > 0


def lift(
    match: TemplateMatch, frame: Frame, config: MatchConfig
) -> tuple[Float[Array, "k 3"], Bool[Array, "k"]]:
    """Translation of each object in the world from its matches in all cameras, and whether it was found.

    In each camera, the point seen at `origin` now lies on the ray through `origin + shift` (two equations)
    and, with depth, at a known depth (one more). Least squares solves all together: one camera with depth, or
    two without, determine the translation; one without moves the object parallel to its image.
    """
    viewmats, Ks = frame.cameras.viewmat, frame.cameras.K
    usable = match.score >= config.min_score

    def equations(viewmat, K, origin, shift, depth, change, measured, weight):
        before = unproject(origin, depth, viewmat, K)
        center = camera_centers(viewmat)
        on_ray = unproject(origin + shift, depth, viewmat, K) - center
        ray = on_ray / jnp.maximum(jnp.linalg.norm(on_ray), 1e-9)  # 0 if the object was not seen
        across = jnp.eye(3) - jnp.outer(ray, ray)
        axis = viewmat[2, :3]
        along = jnp.where(measured, 1.0, 0.0)
        # Both kinds of equation are in metres.
        matrix = weight * (across + along * jnp.outer(axis, axis))
        right = weight * (across @ (center - before) + along * axis * change)
        return matrix, right

    per_object = jax.vmap(equations, in_axes=(None, None, 0, 0, 0, 0, 0, 0))
    weight = jnp.where(usable, match.score, 0.0)
    fields = (match.origin, match.shift, match.depth, match.depth_change, match.measured)
    matrices, rights = jax.vmap(per_object)(viewmats, Ks, *fields, weight)

    def solve(matrices, rights):
        ridge = 1e-3 * jnp.eye(3)
        return jnp.linalg.solve(matrices.sum(0) + ridge, rights.sum(0)[..., None])[..., 0]

    together = jax.vmap(solve, in_axes=1)(matrices, rights)
    best = jax.nn.one_hot(jnp.argmax(weight, axis=0), weight.shape[0], axis=0)
    alone = jax.vmap(solve, in_axes=1)(matrices * best[..., None, None], rights * best[..., None])
    residual = jnp.linalg.norm(jnp.einsum("ckij,kj->cki", matrices, together) - rights, axis=-1)
    apart = (residual > weight * config.max_residual).any(0)
    return jnp.where(apart[:, None], alone, together), usable.any(0)
