"""What a scene shows: the label on top in each pixel, and its depth.

Either the whole scene is drawn, or the moving Gaussians are drawn over the background, which is drawn once
and stored until a camera moves. If the background is opaque and the moving Gaussians of a pixel lie all in
front of it or all behind it, the second way is exact except for what `plan_moving` omits; else a pixel
belongs to whichever is nearer.
"""

from functools import partial
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from gsjax.geometry.cameras import Camera, camera_centers, project, resized
from gsjax.methods.track.motion import Pose, facing, place
from gsjax.methods.track.scene import TrackedScene
from gsjax.optim.compiler import in_memory
from gsjax.rasterize.plan import Plan
from gsjax.rasterize.rasterization import rasterization
from gsjax.scene.frame import Frame
from gsjax.scene.gaussians import Gaussians
from gsjax.scene.render import Rendered, plan_render, render


class Shown(NamedTuple):
    """What each pixel of C cameras shows."""

    labels: Int[Array, "c height width"]  # group on top; 0 for the background or nothing
    depths: Float[Array, "c height width"]  # metres; 0 where nothing is drawn
    covered: Bool[Array, "c height width"]  # more than half opaque


class Backdrop(NamedTuple):
    """The background alone, as drawn for these cameras."""

    cameras: Camera
    depths: Float[Array, "c height width"]
    alphas: Float[Array, "c height width"]

    @property
    def covers(self) -> Bool[Array, "c height width"]:
        """Pixels in which the background is more than half opaque."""
        return self.alphas > 0.5


def render_labels(
    scene: TrackedScene, pose: Pose, frame: Frame, plan: Plan, *, one_sided: bool = False
) -> Rendered:
    """The scene at `pose`, with the weight of each label in each pixel as features [C, H, W, K+1].

    Args:
        scene, pose, plan: what is drawn.
        frame: its cameras.
        one_sided: omit surfaces that a camera sees from behind. Comparisons with images need this; for
            silhouettes, the far side of an object stands in for a near side that no camera has seen yet.
    """
    one_hot = jax.nn.one_hot(scene.labels, scene.num_objects + 1)
    visibility = facing(scene, pose, camera_centers(frame.cameras.viewmat)) if one_sided else None
    return render(place(scene, pose), frame.cameras, plan, features=one_hot, visibility=visibility)


def shown_by(rendered: Rendered) -> Shown:
    """What the whole scene shows, as drawn by `render_labels`."""
    assert rendered.features is not None
    covered = rendered.alphas > 0.5
    labels = jnp.where(covered, jnp.argmax(rendered.features, axis=-1), 0)
    return Shown(labels.astype(jnp.int32), rendered.depths, covered)


@partial(jax.jit, inline=True)
def background_of(scene: TrackedScene) -> Gaussians:
    """The Gaussians of the background."""
    return jax.tree.map(lambda a: a[scene.num_moving :], scene.gaussians)


@partial(jax.jit, inline=True)
def moving_of(scene: TrackedScene, pose: Pose) -> Gaussians:
    """The moving Gaussians at `pose`."""
    moving = jax.tree.map(lambda a: a[: scene.num_moving], scene.gaussians)
    return eqx.tree_at(lambda g: (g.means, g.quats), moving, (pose.means, pose.quats))


@partial(jax.jit, static_argnums=1, inline=True)
def thinned(gaussians: Gaussians, coarseness: int) -> Gaussians:
    """Every coarseness^2-th Gaussian, `coarseness` times as large: the same surface for smaller images."""
    some = jax.tree.map(lambda a: a[:: coarseness**2], gaussians)
    return eqx.tree_at(lambda g: g.log_scales, some, some.log_scales + np.log(coarseness))


def reduced(cameras: Camera, coarseness: int) -> Camera:
    """The same views in smaller images, with pixels `coarseness` times as wide."""
    width, height = (-(-size // coarseness) for size in (cameras.width, cameras.height))
    return resized(cameras, 1 / coarseness, width, height)


def draw_backdrop(scene: TrackedScene, cameras: Camera, plan: Plan) -> tuple[Backdrop, Int[Array, ""]]:
    """The background in these cameras, and the capacity needed."""
    drawn = render(background_of(scene), cameras, plan)
    return Backdrop(cameras, drawn.depths, drawn.alphas), drawn.meta.needed.max()


def keep_backdrop(
    backdrop: Backdrop, scene: TrackedScene, cameras: Camera, plan: Plan
) -> tuple[Backdrop, Int[Array, ""]]:
    """The backdrop for these cameras, drawn again only if a camera has moved, and the capacity needed."""
    same = are_same(backdrop.cameras, cameras)
    return jax.lax.cond(same, lambda: (backdrop, jnp.int32(0)), lambda: draw_backdrop(scene, cameras, plan))


def are_same(a: Camera, b: Camera) -> Bool[Array, ""]:
    """Whether cameras of the same image size have equal poses and intrinsics."""
    return jnp.array_equal(a.viewmat, b.viewmat) & jnp.array_equal(a.K, b.K)


def plan_moving(moving: Gaussians, cameras: Camera, headroom: float) -> Plan:
    """A plan for `show_moving`, which needs only labels and depths, with a relative `headroom` of 1 or more.

    Alphas below 3 % of a pixel are omitted. A pixel ends before the Gaussian that would leave 1 % of its
    light or less, so `alpha_max` prevents a single one from taking that much. Therefore, if a single Gaussian
    shows an opaque object, the depth shifts by up to 9 % of the way to whatever moves behind it. Small tiles
    fit small Gaussians, and batches of fewer tiles finish sooner (tuned on a CPU).
    """
    limits = {"alpha_min": 0.03, "alpha_max": 0.9, "min_transmittance": 0.01}
    tiles = {"tile_size": 4, "tiles_per_batch": 384}
    return plan_render(moving, cameras, headroom=headroom, sh_degree=None, **limits, **tiles)


def show_moving(
    scene: TrackedScene, pose: Pose, backdrop: Backdrop, plan: Plan, coarseness: int = 1
) -> tuple[Shown, Int[Array, ""]]:
    """What the moving Gaussians, `thinned`, show over the backdrop; and the capacity needed.

    Labels are drawn as their binary digits, which take few channels: if one label has more than half of a
    pixel's weight, so does each of its digits.

    Args:
        scene, pose: the tracked scene.
        backdrop: the background.
        plan: from `plan_moving`.
        coarseness: coarseness of the backdrop, by which the Gaussians are thinned.
    """
    moving, cameras = thinned(moving_of(scene, pose), coarseness), backdrop.cameras
    powers = np.left_shift(1, np.arange(max(1, scene.num_objects.bit_length())))
    labels = scene.groups[:: coarseness**2]
    digits = ((labels[:, None] & powers) > 0).astype(pose.means.dtype)
    images, alphas, meta = rasterization(
        moving.means,
        moving.quats,
        moving.scales,
        moving.opacities,
        digits,
        cameras.viewmat,
        cameras.K,
        cameras.width,
        cameras.height,
        plan=plan,
        render_mode="RGB+ED",
    )
    alphas, depths = alphas[..., 0], images[..., -1]
    labels = ((images[..., :-1] > 0.5 * alphas[..., None]) * powers).sum(-1).astype(jnp.int32)
    behind = backdrop.covers & (backdrop.depths < depths)
    on_top = (alphas > 0.5) & ~behind
    labels = jnp.where(on_top & (labels <= scene.num_objects), labels, 0)
    depths = jnp.where(on_top, depths, backdrop.depths)
    shown = in_memory(Shown(labels, depths, on_top | backdrop.covers), cameras.K)
    return shown, meta.needed.max()


def seen_from(
    means: Float[Array, "m 3"], groups: Int[Array, "m"], shown: Shown, cameras: Camera, gap: float
) -> Float[Array, "c m"]:
    """1 for each Gaussian that a camera sees, else 0: its group is on top there and the depth agrees.

    Args:
        means: centres of the Gaussians, metres.
        groups: their groups, 1 and up.
        shown: what the cameras show.
        cameras: C cameras.
        gap: tolerance of depth, metres.
    """
    width, height = cameras.width, cameras.height

    def one(viewmat, K, labels, depths):
        pixels, z = project(means, viewmat, K)
        column, row = jnp.floor(pixels).astype(jnp.int32).T
        inside = (column >= 0) & (column < width) & (row >= 0) & (row < height) & (z > 1e-3)
        column, row = jnp.clip(column, 0, width - 1), jnp.clip(row, 0, height - 1)
        on_top = (labels[row, column] == groups) & (jnp.abs(depths[row, column] - z) < gap)
        return (inside & on_top).astype(depths.dtype)

    return jax.vmap(one)(cameras.viewmat, cameras.K, shown.labels, shown.depths)
