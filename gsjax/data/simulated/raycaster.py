"""Exact images of moving solids: colour, depth along the optical axis, labels and optical flow."""

from collections.abc import Mapping
from dataclasses import dataclass, field, replace

import numpy as np
from jaxtyping import Float, Int, UInt8

from gsjax.data.simulated.primitives import Primitive, at_rest, deformed, intersect, normals
from gsjax.data.simulated.textures import GAMMA, albedo

_NEAR_M = 1e-3
# Shadow rays end this fraction before the point, so that a surface does not shadow itself.
_SHADOW_MARGIN = 1e-6
# Colour samples within a pixel, and the point of the lamp's disc that each one uses, in units of its radius.
_SUBPIXELS = ((0.25, 0.25), (0.75, 0.25), (0.25, 0.75), (0.75, 0.75))
_LIGHT_POINTS = ((1.0, 0.0), (-1.0, 0.0), (0.0, 1.0), (0.0, -1.0))


@dataclass(frozen=True, eq=False)
class Light:
    """A small lamp and ambient light.

    Attributes:
        position: metres, world, [3].
        radius: metres; softens shadows, with one light sample per pixel sample.
        color: linear RGB of the lamp.
        ambient: linear RGB from above; surfaces that face down receive half.
    """

    position: tuple[float, float, float]
    radius: float = 0.0
    color: tuple[float, float, float] = (0.82, 0.78, 0.70)
    ambient: tuple[float, float, float] = (0.26, 0.28, 0.32)


@dataclass(frozen=True, eq=False)
class Scene:
    """Solids on rigidly moving bodies, a light and cameras. Bent boxes and sheets may also deform.

    Attributes:
        primitives: the solids; those of one body do not move relative to each other.
        labels: the mask value of each body, [B].
        poses: body-to-world transforms, [T,B,4,4].
        light: lamp and ambient light.
        Ks: intrinsics in pixels, pixel centres at +0.5, [T,C,3,3].
        viewmats: world to camera, OpenCV axes, [T,C,4,4].
        width: pixels.
        height: pixels.
        sizes: size in each frame, [T,n], of each primitive that deforms, by its index; replaces its own size.
    """

    primitives: tuple[Primitive, ...]
    labels: Int[np.ndarray, "bodies"]
    poses: Float[np.ndarray, "frames bodies 4 4"]
    light: Light
    Ks: Float[np.ndarray, "frames cameras 3 3"]
    viewmats: Float[np.ndarray, "frames cameras 4 4"]
    width: int
    height: int
    sizes: Mapping[int, Float[np.ndarray, "frames n"]] = field(default_factory=dict)

    def solids(self, t: int) -> list[tuple[Primitive, Float[np.ndarray, "4 4"]]]:
        """The primitives in frame t, each with its transform to the world."""
        now = list(self.primitives)
        for i, size in self.sizes.items():
            now[i] = replace(now[i], size=tuple(size[t]))
        return [(primitive, self.poses[t, primitive.body] @ primitive.pose) for primitive in now]


@dataclass(frozen=True, eq=False)
class Hits:
    """The first hit of each ray of a camera.

    Attributes:
        depth: metres along the optical axis, infinite for a miss, [H,W].
        primitive: index of the primitive, -1 for a miss, [H,W].
        origin: the camera centre, world, [3].
        directions: ray directions in the world, scaled to unit depth, [3,H,W].
    """

    depth: Float[np.ndarray, "height width"]
    primitive: Int[np.ndarray, "height width"]
    origin: Float[np.ndarray, "3"]
    directions: Float[np.ndarray, "3 height width"]

    def points(self) -> Float[np.ndarray, "3 height width"]:
        """World points of the hits; the camera centre for a miss."""
        depth = np.where(np.isfinite(self.depth), self.depth, 0.0)
        return self.origin[:, None, None] + self.directions * depth


def trace(scene: Scene, t: int, c: int, subpixel: tuple[float, float] = (0.5, 0.5)) -> Hits:
    """Trace one ray per pixel of camera c in frame t.

    Args:
        scene: the scene.
        t, c: frame and camera.
        subpixel: position of the ray within its pixel, (x, y), 0 to 1; 0.5 is the centre.
    """
    K, viewmat = scene.Ks[t, c], scene.viewmats[t, c]
    x, y = np.meshgrid(np.arange(scene.width) + subpixel[0], np.arange(scene.height) + subpixel[1])
    pixels = np.stack([x, y, np.ones_like(x)])
    directions = np.tensordot(viewmat[:3, :3].T @ np.linalg.inv(K), pixels, axes=1)
    origin = -viewmat[:3, :3].T @ viewmat[:3, 3]
    depth = np.full((scene.height, scene.width), np.inf)
    index = np.full((scene.height, scene.width), -1)
    for i, (primitive, pose) in enumerate(scene.solids(t)):
        window = _window(primitive, viewmat @ pose, K, scene.width, scene.height)
        if window is None:
            continue
        rays = directions[(slice(None), *window)]
        local_origin, local_rays = _to_local(pose, origin), pose[:3, :3].T @ rays.reshape(3, -1)
        found = intersect(primitive, local_origin, local_rays).reshape(rays.shape[1:])
        nearer = found < depth[window]
        depth[window] = np.where(nearer, found, depth[window])
        index[window] = np.where(nearer, i, index[window])
    return Hits(depth=depth, primitive=index, origin=origin, directions=directions)


def render_depth(hits: Hits) -> Float[np.ndarray, "height width"]:
    """Depth in metres, float32, 0 for a miss."""
    return np.where(np.isfinite(hits.depth), hits.depth, 0.0).astype(np.float32)


def render_labels(scene: Scene, hits: Hits) -> Int[np.ndarray, "height width"]:
    """Mask values, int32, 0 for a miss."""
    return np.append(_primitive_labels(scene), 0)[hits.primitive].astype(np.int32)


def render_color(scene: Scene, t: int, c: int) -> UInt8[np.ndarray, "height width 3"]:
    """RGB with Lambertian shading and shadows, four samples per pixel.

    Args:
        scene: the scene.
        t, c: frame and camera.
    """
    total = np.zeros((3, scene.height, scene.width))
    side, up = _light_disc(scene.light)
    for subpixel, (a, b) in zip(_SUBPIXELS, _LIGHT_POINTS, strict=True):
        lamp = np.array(scene.light.position) + scene.light.radius * (a * side + b * up)
        total += _radiance(scene, t, trace(scene, t, c, subpixel), lamp)
    screen = np.clip(total / len(_SUBPIXELS), 0.0, 1.0) ** (1 / GAMMA)
    return np.round(screen * 255).astype(np.uint8).transpose(1, 2, 0)


def render_flow(scene: Scene, t: int, u: int, c: int, hits: Hits) -> Float[np.ndarray, "height width 2"]:
    """Displacement (x, y) in pixels of each visible point from frame t to u, whether or not it is visible
    in u.

    NaN for rays that hit nothing and for points behind the camera in frame u.

    Args:
        scene: the scene.
        t, u: the frames.
        c: the camera.
        hits: the hits of its rays in frame t.
    """
    index, points = hits.primitive.ravel(), hits.points().reshape(3, -1)
    solids_before, solids_after = scene.solids(t), scene.solids(u)
    for i in np.unique(index[index >= 0]):
        here = np.flatnonzero(index == i)
        (before, from_pose), (after, to_pose) = solids_before[i], solids_after[i]
        local = deformed(after, at_rest(before, _to_local(from_pose, points[:, here])))
        points[:, here] = to_pose[:3, :3] @ local + to_pose[:3, 3:]
    to_pixels = scene.Ks[u, c] @ scene.viewmats[u, c][:3]
    homogeneous = (to_pixels[:, :3] @ points + to_pixels[:, 3:]).reshape(3, scene.height, scene.width)
    y, x = np.mgrid[: scene.height, : scene.width] + 0.5
    seen = (hits.primitive >= 0) & (homogeneous[2] > _NEAR_M)
    z = np.where(seen, homogeneous[2], np.nan)
    return np.stack([homogeneous[0] / z - x, homogeneous[1] / z - y], axis=-1)


def _radiance(scene: Scene, t: int, hits: Hits, lamp: np.ndarray) -> Float[np.ndarray, "3 height width"]:
    """Linear RGB radiance from the surfaces towards the camera."""
    solids, index = scene.solids(t), hits.primitive.ravel()
    order = np.argsort(index, kind="stable")  # the pixels of one primitive side by side, misses first
    ends = np.cumsum(np.bincount(index + 1, minlength=len(solids) + 1))
    order, ends = order[ends[0] :], ends - ends[0]
    points = hits.points().reshape(3, -1)[:, order]
    normal, reflectance = np.empty_like(points), np.empty_like(points)
    for (primitive, pose), begin, end in zip(solids, ends, ends[1:], strict=False):
        if begin < end:
            here = slice(begin, end)
            local = _to_local(pose, points[:, here])
            normal[:, here] = pose[:3, :3] @ normals(primitive, local)
            reflectance[:, here] = albedo(primitive.texture, at_rest(primitive, local))
    to_lamp = lamp[:, None] - points
    cosine = _dot(normal, to_lamp) / np.sqrt(_dot(to_lamp, to_lamp))
    lit = np.flatnonzero(cosine > 0)
    direct = np.zeros_like(cosine)
    direct[lit] = cosine[lit] * ~_shadowed(solids, lamp, points[:, lit])
    sky = 0.75 + 0.25 * normal[2]
    light = np.array(scene.light.color)[:, None] * direct + np.array(scene.light.ambient)[:, None] * sky
    radiance = np.zeros((3, len(index)))
    radiance[:, order] = reflectance * light
    return radiance.reshape(3, scene.height, scene.width)


def _shadowed(solids: list[tuple[Primitive, np.ndarray]], lamp: np.ndarray, points: np.ndarray) -> np.ndarray:
    """Whether some solid stands between the lamp and each point."""
    rays = points - lamp[:, None]
    lengths = np.sqrt(_dot(rays, rays))
    dark = np.zeros(len(lengths), bool)
    for primitive, pose in solids:
        if primitive.shape in ("plane", "sheet"):  # there is nothing below to be shadowed
            continue
        # Only points in the cone of the solid's bounding sphere can lie in its shadow.
        center, radius = pose[:3, 3] - lamp, np.linalg.norm(primitive.half_extents)
        distance = np.linalg.norm(center)
        cosine = np.sqrt(np.maximum(1 - (radius / distance) ** 2, 0.0)) if distance > radius else -1.0
        here = np.flatnonzero((center / distance) @ rays >= cosine * lengths)
        here = here[(lengths[here] > distance - radius) & ~dark[here]]
        entry = intersect(primitive, _to_local(pose, lamp), pose[:3, :3].T @ rays[:, here])
        dark[here] = entry < 1 - _SHADOW_MARGIN
    return dark


def _dot(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Dot products of columns, [3,N]."""
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]


def _window(
    primitive: Primitive, to_camera: np.ndarray, K: np.ndarray, width: int, height: int
) -> tuple[slice, slice] | None:
    """Rows and columns whose rays may hit a primitive; None if there are none."""
    half = primitive.half_extents
    everything = slice(0, height), slice(0, width)
    if not np.isfinite(half).all():
        return everything
    signs = np.stack(np.meshgrid(*[(-1.0, 1.0)] * 3, indexing="ij")).reshape(3, -1)
    corners = to_camera[:3, :3] @ (signs * half[:, None]) + to_camera[:3, 3:]
    if (corners[2] < _NEAR_M).all():
        return None
    if (corners[2] < _NEAR_M).any():
        return everything
    pixels = (K @ corners)[:2] / corners[2]
    (left, top), (right, bottom) = np.floor(pixels.min(1)).astype(int), np.ceil(pixels.max(1)).astype(int)
    left, right = max(left - 1, 0), min(right + 1, width)
    top, bottom = max(top - 1, 0), min(bottom + 1, height)
    return (slice(top, bottom), slice(left, right)) if left < right and top < bottom else None


def _to_local(pose: np.ndarray, points: np.ndarray) -> np.ndarray:
    """World points (columns, or a single one) in the frame of `pose`."""
    origin = pose[:3, 3] if points.ndim == 1 else pose[:3, 3:]
    return pose[:3, :3].T @ (points - origin)


def _light_disc(light: Light) -> tuple[np.ndarray, np.ndarray]:
    """Two unit vectors that span the lamp's disc, which faces the world's origin."""
    toward = -np.array(light.position) / np.linalg.norm(light.position)
    side = np.cross(toward, [0.0, 1.0, 0.0] if abs(toward[1]) < 0.9 else [1.0, 0.0, 0.0])
    side /= np.linalg.norm(side)
    return side, np.cross(side, toward)


def _primitive_labels(scene: Scene) -> np.ndarray:
    return np.asarray(scene.labels)[[primitive.body for primitive in scene.primitives]]
