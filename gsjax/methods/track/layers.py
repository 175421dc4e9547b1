"""What a scene shows: which label is on top in each pixel, and how deep it lies.

Two ways. The whole scene is drawn, or what moves is drawn over what stands: the background is drawn once and
kept, and drawn again only when a camera has moved. Where the background is opaque and a pixel's moving
Gaussians lie all in front of it or all behind, the second is exact but for what `plan_moving` leaves out;
else a pixel belongs to what is nearer.
"""

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

    labels: Int[Array, "c height width"]  # the group on top; 0 for background and for nothing
    depths: Float[Array, "c height width"]  # metres; 0 where nothing is drawn
    covered: Bool[Array, "c height width"]  # more than half opaque


class Backdrop(NamedTuple):
    """The background alone, and the cameras that it was drawn for."""

    cameras: Camera
    depths: Float[Array, "c height width"]
    alphas: Float[Array, "c height width"]

    @property
    def covers(self) -> Bool[Array, "c height width"]:
        """Pixels where it is more than half opaque."""
        return self.alphas > 0.5


def render_labels(
    scene: TrackedScene, pose: Pose, frame: Frame, plan: Plan, *, one_sided: bool = False
) -> Rendered:
    """The scene as it stands, with the share of each label in each pixel as features [C, H, W, K+1].

    `one_sided` leaves out what a camera sees from behind: right for comparing with images, while for
    silhouettes the far side of an object stands in for a near side that no camera has seen yet.
    """
    one_hot = jax.nn.one_hot(scene.labels, scene.num_objects + 1)
    visibility = facing(scene, pose, camera_centers(frame.cameras.viewmat)) if one_sided else None
    return render(place(scene, pose), frame.cameras, plan, features=one_hot, visibility=visibility)


def shown_by(rendered: Rendered) -> Shown:
    """What the whole scene shows, drawn by `render_labels`."""
    assert rendered.features is not None
    covered = rendered.alphas > 0.5
    labels = jnp.where(covered, jnp.argmax(rendered.features, axis=-1), 0)
    return Shown(labels.astype(jnp.int32), rendered.depths, covered)


def background_of(scene: TrackedScene) -> Gaussians:
    """The Gaussians that do not move."""
    return jax.tree.map(lambda a: a[scene.num_moving :], scene.gaussians)


def moving_of(scene: TrackedScene, pose: Pose) -> Gaussians:
    """The Gaussians that move, placed by `pose`."""
    moving = jax.tree.map(lambda a: a[: scene.num_moving], scene.gaussians)
    return eqx.tree_at(lambda g: (g.means, g.quats), moving, (pose.means, pose.quats))


def thinned(gaussians: Gaussians, coarseness: int) -> Gaussians:
    """Every coarseness^2-th Gaussian, `coarseness` times as large: the same surface for smaller pictures."""
    some = jax.tree.map(lambda a: a[:: coarseness**2], gaussians)
    return eqx.tree_at(lambda g: g.log_scales, some, some.log_scales + np.log(coarseness))


def reduced(cameras: Camera, coarseness: int) -> Camera:
    """The same views in smaller pictures, pixels `coarseness` times as wide."""
    width, height = (-(-size // coarseness) for size in (cameras.width, cameras.height))
    return resized(cameras, 1 / coarseness, width, height)


def draw_backdrop(scene: TrackedScene, cameras: Camera, plan: Plan) -> tuple[Backdrop, Int[Array, ""]]:
    """The background in these cameras, and what capacity that needed."""
    drawn = render(background_of(scene), cameras, plan)
    return Backdrop(cameras, drawn.depths, drawn.alphas), drawn.meta.needed.max()


def keep_backdrop(
    backdrop: Backdrop, scene: TrackedScene, cameras: Camera, plan: Plan
) -> tuple[Backdrop, Int[Array, ""]]:
    """The backdrop for these cameras: the one there is, unless a camera has moved."""
    same = are_same(backdrop.cameras, cameras)
    return jax.lax.cond(same, lambda: (backdrop, jnp.int32(0)), lambda: draw_backdrop(scene, cameras, plan))


def are_same(a: Camera, b: Camera) -> Bool[Array, ""]:
    """Whether these cameras of one size are in the same places, and see the same of it."""
    return jnp.array_equal(a.viewmat, b.viewmat) & jnp.array_equal(a.K, b.K)


def plan_moving(moving: Gaussians, cameras: Camera, headroom: float) -> Plan:
    """A plan for `show_moving`, of which only labels and depths are needed: shares of a pixel below 3 % are
    left out, and all that lies behind once less than a tenth is left. A Gaussian that would leave less than
    1 % is not drawn, so none may take that much alone: `alpha_max`. So where one alone is all that shows of
    an opaque thing, depth leans by up to 9 % of the way to what moves behind it. Small tiles fit small
    Gaussians, and a few of them end sooner than many (tuned on a CPU).

    Args:
        moving: the Gaussians that move.
        cameras: all that look at them.
        headroom: 1 or more.
    """
    limits = {"alpha_min": 0.03, "alpha_max": 0.9, "min_transmittance": 0.01}
    tiles = {"tile_size": 4, "tiles_per_batch": 384}
    return plan_render(moving, cameras, headroom=headroom, sh_degree=None, **limits, **tiles)


def show_moving(
    scene: TrackedScene, pose: Pose, backdrop: Backdrop, plan: Plan, coarseness: int = 1
) -> tuple[Shown, Int[Array, ""]]:
    """What moves, `thinned` and drawn alone, over the backdrop; and what capacity that needed.

    Labels are drawn as their binary digits, which are few channels: where one label has more than half of a
    pixel's weight, so has each of its digits.

    Args:
        scene: what is tracked.
        pose: where it is.
        backdrop: what does not move, drawn once.
        plan: from `plan_moving`.
        coarseness: that of the backdrop; Gaussians are `thinned` by as much.
    """
    moving, cameras = thinned(moving_of(scene, pose), coarseness), backdrop.cameras
    powers = np.left_shift(1, np.arange(max(1, scene.num_objects.bit_length())))
    labels = scene.labels[: scene.num_moving : coarseness**2]
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
    """1 for each Gaussian of a group that a camera sees: its label is on top there and its depth agrees.

    Args:
        means: of the Gaussians, metres.
        groups: 1 and up.
        shown: what each camera has on top.
        cameras: C of them.
        gap: by how much depths may differ, metres.
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
