"""Starting without depth: from shapes that are known as Gaussians, posed and coloured by the first images.

A shape with a pose (the ground) is placed as it is. One without is laid on its plane where the images look
like it: a search over position and heading, scored by the colours its centres fall on, then refined against
rendered images. Colours of everything are then read off the images, and at last all of it is optimised
photometrically, as a scene from depth is: shapes that are too fat for their pictures become slimmer.
"""

import warnings
from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import cache
from types import SimpleNamespace
from typing import Protocol, runtime_checkable

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float
from scipy.spatial.transform import Rotation

from gsjax.geometry.cameras import project
from gsjax.geometry.neighbors import nearest
from gsjax.geometry.spherical_harmonics import rgb_to_sh0
from gsjax.methods.track.align import bilinear, spot
from gsjax.methods.track.config import TrackConfig
from gsjax.methods.track.first_fit import fit_scene
from gsjax.methods.track.layers import render_labels
from gsjax.methods.track.motion import Motion, first_pose, move
from gsjax.methods.track.refine import RefineBatch, refine
from gsjax.methods.track.scene import TrackedScene, assemble
from gsjax.optim.compiler import host_options
from gsjax.rasterize.plan import with_room
from gsjax.scene.frame import Frame
from gsjax.scene.gaussians import Gaussians, gaussians_from_activated
from gsjax.scene.region import tiles_to_pixels, touched_tiles
from gsjax.scene.render import plan_render

_GRID_STEP, _HEADINGS, _SAMPLES = 0.03, 36, 96  # metres, over the full turn, centres a candidate is scored on
_COLOR_LIMIT = 0.35  # a colour difference beyond this is of something else
_MAX_SPREAD = 0.2  # cameras that see the same thing agree better on its brightness
_MARGIN = 4  # pixels around an object that may show it rather than the background
_REFINEMENTS, _ITERATIONS = 3, 60


@runtime_checkable
class Shape(Protocol):
    """What is known of an object or of the background; `gsjax.data.PointModel` is one."""

    @property
    def name(self) -> str:
        """Its name."""
        ...

    @property
    def means(self) -> np.ndarray:
        """Centres in its own frame, metres, [N,3]."""
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
        """Shape to world [4,4] in the first frame; None where it must be fitted."""
        ...

    @property
    def plane(self) -> np.ndarray | None:
        """(n, d) with n.x + d = 0 of the plane in the world that it rests on, or None."""
        ...


def scene_from_shapes(
    shapes: Sequence[Shape], frame: Frame, config: TrackConfig | None = None
) -> TrackedScene:
    """A labelled scene of known shapes, posed and coloured to fit the first frame.

    Args:
        shapes: objects (label > 0) and background (label 0).
        frame: what the cameras see at first; depth is not used.
        config: see `TrackConfig`.

    Raises:
        ValueError: there is no object, or an object has neither a pose nor a plane to lie on.
    """
    config = TrackConfig() if config is None else config
    background = [s for s in shapes if not s.label]
    extent = np.concatenate([_placed(s, s.pose).means for s in background]) if background else None
    parts, labels, label_ids = [], [], [0]
    for shape in shapes:
        pose = shape.pose
        if pose is None:
            pose = find_pose(shape, frame, extent)
        if shape.label:
            label_ids.append(int(shape.label))
        parts.append(_placed(shape, pose))
        labels.append(np.full(len(shape.means), len(label_ids) - 1 if shape.label else 0))
    scene = assemble(parts, labels, tuple(label_ids))
    scene = _recolored(scene, frame)
    for _ in range(_REFINEMENTS):
        scene = _recolored(_refined(scene, frame, config), frame)
    return fit_scene(scene, frame, config.start.iterations, config.headroom)[0]


def _placed(shape: Shape, pose: np.ndarray) -> Gaussians:
    rotation, translation = np.asarray(pose)[:3, :3], np.asarray(pose)[:3, 3]
    quats = Rotation.from_matrix(rotation) * Rotation.from_quat(shape.quats, scalar_first=True)
    means = shape.means @ rotation.T + translation
    return gaussians_from_activated(
        means, quats.as_quat(scalar_first=True), shape.scales, shape.opacities, shape.colors
    )


def find_pose(shape: Shape, frame: Frame, extent: np.ndarray | None) -> Float[np.ndarray, "4 4"]:
    """The pose on its plane in which a shape's centres fall on pixels of their colours, in all cameras.

    Args:
        shape: with a plane (n, d): n.x + d = 0, that it rests on, either side up.
        frame: the first images.
        extent: points of the background, whose box bounds the search.

    Raises:
        ValueError: the shape has no plane, or there is no background to search on.
    """
    if shape.plane is None or extent is None:
        raise ValueError(
            f"the shape {shape.name!r} has no pose; finding one takes a plane to rest on and a background"
        )
    normal = np.asarray(shape.plane[:3], np.float64)
    normal, offset = normal / np.linalg.norm(normal), float(shape.plane[3]) / np.linalg.norm(normal)
    # Places are counted along two directions of the plane, whichever way it lies in the world.
    across = np.linalg.svd(normal[None])[2][1:]
    low, high = (extent @ across.T).min(0), (extent @ across.T).max(0)
    best = (np.inf, np.eye(4))
    for up in (1.0, -1.0):
        base, _ = Rotation.align_vectors([normal], [[0.0, 0.0, up]])
        standing = shape.means @ base.as_matrix().T
        lift = -offset - np.quantile(standing @ normal, 0.02)
        center = standing.mean(0)
        x, y = np.meshgrid(np.arange(low[0], high[0], _GRID_STEP), np.arange(low[1], high[1], _GRID_STEP))
        places = np.stack([x.ravel(), y.ravel()], axis=-1)
        headings = np.linspace(0, 2 * np.pi, _HEADINGS, endpoint=False)
        step, turn = _GRID_STEP, headings[1]
        for _ in range(4):  # ever finer around the best
            candidates = np.array([[px, py, h] for h in headings for px, py in places])
            poses = _poses(candidates, base, normal, across, lift, center)
            cost = _scores(shape, poses, frame)
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
    """Model-to-world transforms that turn the standing shape about its centre and move it over the plane."""
    turned = Rotation.from_rotvec(candidates[:, 2:] * normal)
    poses = np.tile(np.eye(4), (len(candidates), 1, 1))
    poses[:, :3, :3] = (turned * base).as_matrix()
    flat = center - (center @ normal) * normal
    poses[:, :3, 3] = candidates[:, :2] @ across + lift * normal - turned.apply(flat)
    return poses


@jax.jit
def _cost(poses, means, colors, frame):
    def one(pose):
        moved = means @ pose[:3, :3].T + pose[:3, 3]

        def view(viewmat, K, image):
            pixels, z = project(moved, viewmat, K)
            size = image.shape[1::-1]
            inside = ((pixels > 0) & (pixels < jnp.array(size))).all(-1) & (z > 0)
            gap = jnp.abs(bilinear(image, spot(*pixels.T, *size)).values.T - colors).mean(-1)
            return jnp.where(inside, jnp.minimum(gap, _COLOR_LIMIT), _COLOR_LIMIT).mean()

        return jax.vmap(view)(frame.cameras.viewmat, frame.cameras.K, frame.images).mean()

    return jax.lax.map(one, poses, batch_size=2048)


def _scores(shape: Shape, poses: np.ndarray, frame: Frame) -> np.ndarray:
    rows = np.random.default_rng(0).permutation(len(shape.means))[:_SAMPLES]
    means, colors = jnp.asarray(shape.means[rows], jnp.float32), jnp.asarray(shape.colors[rows], jnp.float32)
    return np.asarray(_cost(jnp.asarray(poses, jnp.float32), means, colors, frame))


def _observed_colors(scene: TrackedScene, frame: Frame):
    """Each Gaussian's colour in each camera, whether it has one, and whether an object is near."""
    rendered = render_labels(scene, first_pose(scene), frame, plan_render(scene.gaussians, frame.cameras))
    assert rendered.features is not None
    objects = 1 - rendered.features[..., 0] / jnp.maximum(rendered.alphas, 1e-3)
    margin = (1, 2 * _MARGIN + 1, 2 * _MARGIN + 1)
    near = jax.lax.reduce_window(objects, -jnp.inf, jax.lax.max, margin, (1, 1, 1), "SAME")

    def view(viewmat, K, image, near):
        pixels, z = project(scene.gaussians.means, viewmat, K)
        size = image.shape[1::-1]
        inside = ((pixels > 0) & (pixels < jnp.array(size))).all(-1) & (z > 0)
        at = spot(*pixels.T, *size)
        return bilinear(image, at).values.T, inside, bilinear(near[..., None], at).values[0] > 0.1

    return jax.vmap(view)(frame.cameras.viewmat, frame.cameras.K, frame.images, near)


def _recolored(scene: TrackedScene, frame: Frame) -> TrackedScene:
    """Each Gaussian takes the median over cameras of the colours it is seen in.

    The background uses no pixel that an object may cover, and where none is left to its nearest
    neighbour; an object's Gaussian to none that looks unlike its group, for something stands in front.
    """
    colors, inside, covered = (np.asarray(a) for a in _observed_colors(scene, frame))
    group = np.asarray(scene.labels)
    usable = inside & ~(covered & (group == 0))
    for k in range(1, scene.num_objects + 1):
        member = group == k
        typical = np.median(colors[usable & member], axis=0)
        usable &= ~(member & (np.abs(colors - typical).mean(-1) > _COLOR_LIMIT))
    # Cameras that disagree on a piece of background do not all see it.
    shades = np.where(usable, colors.mean(-1), np.nan)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", RuntimeWarning)  # of rows that no camera sees
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
    """All objects moved rigidly to where the rendered scene fits the images best."""
    pose = first_pose(scene)
    plan = plan_render(scene.gaussians, frame.cameras, headroom=config.headroom)
    roi = tiles_to_pixels(touched_tiles([pose.means], frame), frame)
    groups = scene.labels[: scene.num_moving]
    centers = jnp.stack([pose.means[groups == k + 1].mean(0) for k in range(scene.num_objects)])
    still = Motion(jnp.zeros((len(centers), 6)), jnp.zeros_like(pose.means))
    rates = replace(config.refine, iterations=_ITERATIONS, delta_rate=0.0, background_rate=0.0)

    def refined(plan):
        batch = RefineBatch(scene, frame, plan, pose, centers, roi)
        motion, _, info = _refine_rigidly()(still, batch, rates)
        return motion, SimpleNamespace(**info)

    motion, _ = with_room(refined, plan, config.headroom)
    moved = move(pose, motion, centers, groups)
    count = scene.num_moving
    gaussians = eqx.tree_at(
        lambda g: (g.means, g.quats),
        scene.gaussians,
        (
            scene.gaussians.means.at[:count].set(moved.means),
            scene.gaussians.quats.at[:count].set(moved.quats),
        ),
    )
    return eqx.tree_at(lambda s: s.gaussians, scene, gaussians)


@cache
def _refine_rigidly() -> Callable:
    """The jitted refinement; made late, because its options depend on the machine."""
    return jax.jit(refine, static_argnums=2, compiler_options=host_options())
