"""Initialisation without depth: known shapes, given as Gaussians, are fitted to the first images.

A shape with a pose (the ground) is placed as it is. One without is placed on its plane where it matches the
images: position and heading are searched for, scored by the colours of the pixels that its centres project
to, and then refined against rendered images. Finally all colours are sampled from the images, and the scene
is optimised photometrically, like a scene from depth: shapes too wide for their images become narrower.
"""

import warnings
from collections.abc import Sequence
from dataclasses import replace
from types import SimpleNamespace
from typing import Protocol, runtime_checkable

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float
from scipy.spatial.transform import Rotation

from gsjax.geometry.cameras import project
from gsjax.geometry.neighbors import nearest
from gsjax.geometry.spherical_harmonics import rgb_to_sh0
from gsjax.methods.track.align import bilinear, pixel_position
from gsjax.methods.track.config import TrackConfig
from gsjax.methods.track.first_fit import fit_scene
from gsjax.methods.track.frames import prepared_first
from gsjax.methods.track.layers import render_labels
from gsjax.methods.track.motion import Motion, first_pose, move, place
from gsjax.methods.track.refine import RefineBatch, refine
from gsjax.methods.track.scene import TrackedScene, assemble
from gsjax.optim.compiler import host_jit
from gsjax.rasterize.plan import with_room
from gsjax.scene.frame import Frame
from gsjax.scene.gaussians import Gaussians, gaussians_from_activated
from gsjax.scene.region import tiles_to_pixels, touched_tiles
from gsjax.scene.render import plan_render

_GRID_STEP, _HEADINGS, _SAMPLES = 0.03, 36, 96  # metres; per full turn; centres on which a pose is scored
_COLOR_LIMIT = 0.35  # a larger colour difference is due to something else
_MAX_SPREAD = 0.2  # cameras whose brightness differs by more do not see the same surface
_MARGIN = 4  # pixels around an object that may show it rather than the background
_REFINEMENTS, _ITERATIONS = 3, 60  # rounds of refinement and recolouring; iterations of each


@runtime_checkable
class Shape(Protocol):
    """A known model of an object or of the background; `gsjax.data.PointModel` is one."""

    @property
    def name(self) -> str:
        """Name."""
        ...

    @property
    def means(self) -> np.ndarray:
        """Centres in the frame of the shape, metres, [N,3]."""
        ...

    @property
    def quats(self) -> np.ndarray:
        """Orientations w x y z, [N,4]."""
        ...

    @property
    def scales(self) -> np.ndarray:
        """Standard deviations, metres, [N,3]."""
        ...

    @property
    def opacities(self) -> np.ndarray:
        """0 to 1, [N]."""
        ...

    @property
    def colors(self) -> np.ndarray:
        """RGB, 0 to 1, [N,3]."""
        ...

    @property
    def label(self) -> int:
        """Mask value of the object; 0 is the static background."""
        ...

    @property
    def pose(self) -> np.ndarray | None:
        """Shape to world [4,4] in the first frame; None if it is to be fitted."""
        ...

    @property
    def plane(self) -> np.ndarray | None:
        """(n, d) of the plane n.x + d = 0 in the world on which the shape rests, or None."""
        ...


def scene_from_shapes(
    shapes: Sequence[Shape], frame: Frame, config: TrackConfig | None = None
) -> TrackedScene:
    """A labelled scene of known shapes, with poses and colours fitted to the first frame.

    Args:
        shapes: objects (label > 0) and background (label 0).
        frame: the first frame; depth is not used.
        config: see `TrackConfig`.

    Raises:
        ValueError: there is no object, an object has neither a pose nor a plane to rest on, a background has
            no pose, or cameras are fisheyes.
    """
    config = TrackConfig() if config is None else config
    frame = prepared_first(frame)
    background = [s for s in shapes if not s.label]
    if len(background) == len(shapes):
        raise ValueError("shapes: expected an object, a shape with a label above 0, found none")
    if any(s.pose is None for s in background):
        raise ValueError(
            "shapes: expected a pose of each shape of label 0, the background, found one without"
        )
    extent = np.concatenate([_placed(s, s.pose).means for s in background]) if background else None
    parts, labels, label_ids = [], [], [0]
    for shape in shapes:
        pose = find_pose(shape, frame, extent) if shape.pose is None else shape.pose
        if shape.label:
            label_ids.append(int(shape.label))
        parts.append(_placed(shape, pose))
        labels.append(np.full(len(shape.means), len(label_ids) - 1 if shape.label else 0))
    scene = _recolored(assemble(parts, labels, tuple(label_ids)), frame)
    for _ in range(_REFINEMENTS):
        scene = _recolored(_refined(scene, frame, config), frame)
    return fit_scene(scene, frame, config.start.iterations, config.headroom)[0]


def _placed(shape: Shape, pose: np.ndarray) -> Gaussians:
    """The Gaussians of a shape at a pose [4, 4]."""
    rotation, translation = np.asarray(pose)[:3, :3], np.asarray(pose)[:3, 3]
    quats = Rotation.from_matrix(rotation) * Rotation.from_quat(shape.quats, scalar_first=True)
    means = shape.means @ rotation.T + translation
    return gaussians_from_activated(
        means, quats.as_quat(scalar_first=True), shape.scales, shape.opacities, shape.colors
    )


def find_pose(shape: Shape, frame: Frame, extent: np.ndarray | None) -> Float[np.ndarray, "4 4"]:
    """The pose on its plane at which the centres of a shape project to pixels of their colours.

    Args:
        shape: a shape with a plane, on which it rests with either side up.
        frame: the first frame.
        extent: points of the background [N, 3], whose bounding box bounds the search.

    Raises:
        ValueError: the shape has no plane, or there is no background.
    """
    if shape.plane is None or extent is None:
        raise ValueError(
            f"shape {shape.name!r}: expected a pose, or a plane to rest on and a background, found neither"
        )
    normal = np.asarray(shape.plane[:3], np.float64)
    normal, offset = normal / np.linalg.norm(normal), float(shape.plane[3]) / np.linalg.norm(normal)
    # Positions are coordinates along two directions of the plane, however it is oriented in the world.
    across = np.linalg.svd(normal[None])[2][1:]
    low, high = (extent @ across.T).min(0), (extent @ across.T).max(0)
    best = (np.inf, np.eye(4))
    rows = np.random.default_rng(0).permutation(len(shape.means))[:_SAMPLES]
    sampled = [jnp.asarray(values[rows], jnp.float32) for values in (shape.means, shape.colors)]
    for up in (1.0, -1.0):
        base = Rotation.align_vectors([normal], [[0.0, 0.0, up]])[0]
        standing = shape.means @ base.as_matrix().T
        lift = -offset - np.quantile(standing @ normal, 0.02)
        center = standing.mean(0)
        ends = np.maximum(high, low + _GRID_STEP)  # at least one place, even on a single Gaussian
        x, y = np.meshgrid(np.arange(low[0], ends[0], _GRID_STEP), np.arange(low[1], ends[1], _GRID_STEP))
        places = np.stack([x.ravel(), y.ravel()], axis=-1)
        headings = np.linspace(0, 2 * np.pi, _HEADINGS, endpoint=False)
        step, turn = _GRID_STEP, headings[1]
        for _ in range(4):  # coarse to fine, around the best
            candidates = np.array([[px, py, h] for h in headings for px, py in places])
            poses = _poses(candidates, base, normal, across, lift, center)
            cost = np.asarray(_cost(jnp.asarray(poses, jnp.float32), *sampled, frame))
            winner = int(cost.argmin())
            if cost[winner] < best[0]:
                best = (float(cost[winner]), poses[winner])
            px, py, h = candidates[winner]
            step, turn = step / 3, turn / 3
            grid = np.arange(-3, 4)
            offsets = np.stack(np.meshgrid(grid * step, grid * step), axis=-1).reshape(-1, 2)
            places, headings = np.array([px, py]) + offsets, h + grid * turn
    return best[1]


def _poses(
    candidates: np.ndarray,
    base: Rotation,
    normal: np.ndarray,
    across: np.ndarray,
    lift: float,
    center: np.ndarray,
) -> np.ndarray:
    """Shape-to-world transforms that turn the standing shape about its centre and move it over the plane."""
    turned = Rotation.from_rotvec(candidates[:, 2:] * normal)
    poses = np.tile(np.eye(4), (len(candidates), 1, 1))
    poses[:, :3, :3] = (turned * base).as_matrix()
    flat = center - (center @ normal) * normal
    poses[:, :3, 3] = candidates[:, :2] @ across + lift * normal - turned.apply(flat)
    return poses


@jax.jit
def _cost(poses, means, colors, frame):
    """Mean truncated colour difference of the points at each pose."""

    def one(pose):
        moved = means @ pose[:3, :3].T + pose[:3, 3]

        def view(viewmat, K, image):
            found, inside = _at_points(image, moved, viewmat, K)
            gap = jnp.abs(found - colors).mean(-1)
            return jnp.where(inside, jnp.minimum(gap, _COLOR_LIMIT), _COLOR_LIMIT).mean()

        return jax.vmap(view)(frame.cameras.viewmat, frame.cameras.K, frame.images).mean()

    return jax.lax.map(one, poses, batch_size=2048)


def _at_points(image: Float[Array, "h w d"], points: Float[Array, "n 3"], viewmat, K):
    """Values of an image at the projections of points [N, D], and whether these lie inside the image [N]."""
    pixels, z = project(points, viewmat, K)
    size = image.shape[1::-1]
    inside = ((pixels > 0) & (pixels < jnp.array(size))).all(-1) & (z > 0)
    return bilinear(image, pixel_position(*pixels.T, *size)).values.T, inside


def _observed_colors(scene: TrackedScene, frame: Frame):
    """Colour of each Gaussian in each camera, whether it is inside the image, and whether near an object."""
    rendered = render_labels(scene, first_pose(scene), frame, plan_render(scene.gaussians, frame.cameras))
    assert rendered.features is not None
    objects = 1 - rendered.features[..., 0] / jnp.maximum(rendered.alphas, 1e-3)
    margin = (1, 2 * _MARGIN + 1, 2 * _MARGIN + 1)
    near = jax.lax.reduce_window(objects, -jnp.inf, jax.lax.max, margin, (1, 1, 1), "SAME")

    def view(viewmat, K, image, near):
        place = (scene.gaussians.means, viewmat, K)
        return *_at_points(image, *place), _at_points(near[..., None], *place)[0][:, 0] > 0.1

    return jax.vmap(view)(frame.cameras.viewmat, frame.cameras.K, frame.images, near)


def _recolored(scene: TrackedScene, frame: Frame) -> TrackedScene:
    """The scene in which each Gaussian has the median of its colours in the cameras.

    The background ignores pixels that an object may cover, and objects ignore colours unlike the rest of
    their group, because they are occluded there. A Gaussian without colours left takes that of its nearest
    neighbour in its group.
    """
    colors, inside, covered = (np.asarray(a) for a in _observed_colors(scene, frame))
    group = np.asarray(scene.labels)
    usable = inside & ~(covered & (group == 0))
    for k in range(1, scene.num_objects + 1):
        member = group == k
        typical = np.median(colors[usable & member], axis=0)
        usable &= ~(member & (np.abs(colors - typical).mean(-1) > _COLOR_LIMIT))
    # If cameras disagree on a piece of background, not all of them see it.
    shades = np.where(usable, colors.mean(-1), np.nan)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", RuntimeWarning)  # rows that no camera sees
        spread = np.nanmax(shades, axis=0) - np.nanmin(shades, axis=0)
    alone = (usable.sum(0) < min(2, len(usable))) | (spread > _MAX_SPREAD)
    usable &= ~(alone & (group == 0))
    seen = usable.any(0)
    new = np.ma.median(np.ma.array(colors, mask=np.repeat(~usable[..., None], 3, -1)), axis=0).filled(0.0)
    means = np.asarray(scene.gaussians.means)
    for k in range(scene.num_objects + 1):
        unseen, known = np.flatnonzero((group == k) & ~seen), np.flatnonzero((group == k) & seen)
        if len(known):
            new[unseen] = new[known[nearest(means[unseen], means[known])[0]]]
    sh0 = rgb_to_sh0(jnp.asarray(new, scene.gaussians.sh0.dtype))[:, None]
    return eqx.tree_at(lambda s: s.gaussians.sh0, scene, sh0)


def _refined(scene: TrackedScene, frame: Frame, config: TrackConfig) -> TrackedScene:
    """The scene with all objects moved rigidly to where its render fits the images best."""
    pose = first_pose(scene)
    plan = plan_render(scene.gaussians, frame.cameras, headroom=config.headroom)
    roi = tiles_to_pixels(touched_tiles([pose.means], frame), frame)
    groups = scene.groups
    centers = jnp.stack([pose.means[groups == k + 1].mean(0) for k in range(scene.num_objects)])
    still = Motion(jnp.zeros((len(centers), 6)), jnp.zeros_like(pose.means))
    rates = replace(config.refine, iterations=_ITERATIONS, delta_rate=0.0, background_rate=0.0)

    def refined(plan):
        batch = RefineBatch(scene, frame, plan, pose, centers, roi)
        motion, _, info = _refine_rigidly(still, batch, rates)
        return motion, SimpleNamespace(**info)

    motion, _ = with_room(refined, plan, config.headroom)
    moved = place(scene, move(pose, motion, centers, groups))
    return eqx.tree_at(lambda s: s.gaussians, scene, moved)


_refine_rigidly = host_jit(refine, static_argnums=2)
