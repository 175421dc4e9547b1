"""Cameras and projection. View matrices are world to camera in OpenCV axes (+x right, +y down, +z forward);
pixel centres lie at +0.5."""

from dataclasses import replace
from functools import partial
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import jaxlie
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from gsjax.geometry.sight import pixels_at

# nerfstudio, Blender and OpenGL look along -z with +y up; flipping the signs of two axes gives OpenCV.
OPENGL_TO_OPENCV = np.diag([1.0, -1.0, -1.0, 1.0])


NEAR = 0.01
"""Default near plane, metres; cameras do not focus closer than this."""


class Camera(eqx.Module):
    """One or more cameras with the same image size, pinhole or fisheye.

    Attributes:
        viewmat: world-to-camera transforms, OpenCV axes, metres.
        K: intrinsics in pixels; the principal point counts pixel centres at +0.5.
        width: pixels, static.
        height: pixels, static.
        near: distance of the near plane, metres, static. Anything nearer is not drawn, such as parts of the
            rig where cameras see each other.
        fisheye: coefficients k1 to k4 of the model of Kannala and Brandt, in OpenCV's form; None for
            pinholes. Depth is the distance from the camera for a fisheye, and z in its frame for a pinhole.
    """

    viewmat: Float[Array | np.ndarray, "*batch 4 4"]
    K: Float[Array | np.ndarray, "*batch 3 3"]
    width: int = eqx.field(static=True)
    height: int = eqx.field(static=True)
    near: float = eqx.field(static=True, default=NEAR)
    fisheye: Float[Array | np.ndarray, "*batch 4"] | None = None


def viewmat_from_opengl(camera_to_world: Float[np.ndarray, "*batch 4 4"]) -> Float[np.ndarray, "*batch 4 4"]:
    """World-to-camera OpenCV matrices from camera-to-world OpenGL ones (Blender, nerfstudio, push_t)."""
    return np.linalg.inv(np.asarray(camera_to_world, np.float64) @ OPENGL_TO_OPENCV)


def look_at(
    eye: Float[np.ndarray, "3"], target: Float[np.ndarray, "3"], up: Float[np.ndarray, "3"] | None = None
) -> Float[np.ndarray, "4 4"]:
    """The view matrix of a camera at `eye` that looks at `target`; `up` defaults to +z.

    Raises:
        ValueError: the viewing direction is zero or parallel to `up`.
    """
    eye, target = np.asarray(eye, np.float64), np.asarray(target, np.float64)
    up = np.array([0.0, 0.0, 1.0]) if up is None else np.asarray(up, np.float64)
    forward = target - eye
    right = np.cross(forward, up)
    if np.linalg.norm(right) < 1e-9:
        raise ValueError(f"look_at: eye {eye} to target {target} has no direction apart from up {up}")
    forward, right = forward / np.linalg.norm(forward), right / np.linalg.norm(right)
    rotation = np.stack([right, np.cross(forward, right), forward])
    viewmat = np.eye(4)
    viewmat[:3, :3], viewmat[:3, 3] = rotation, -rotation @ eye
    return viewmat


def intrinsics(
    focal: float, width: int, height: int, center: tuple[float, float] | None = None
) -> Float[np.ndarray, "3 3"]:
    """K of a camera with square pixels; the principal point defaults to the middle of the image.

    Args:
        focal: focal length along both axes, pixels.
        width, height: size of the image, pixels.
        center: principal point (cx, cy), pixel centres at +0.5.
    """
    cx, cy = center or (width / 2, height / 2)
    return np.array([[focal, 0.0, cx], [0.0, focal, cy], [0.0, 0.0, 1.0]])


def on_device(camera: Camera) -> Camera:
    """The camera with its arrays as JAX arrays of the default float type."""
    dtype = jnp.result_type(float)
    return jax.device_put(jax.tree.map(lambda a: np.asarray(a, dtype), camera))


def resized(camera: Camera, scale: float, width: int, height: int) -> Camera:
    """The same view at another resolution, with pixels 1 / `scale` times as wide.

    Args:
        camera: camera at the present resolution.
        scale: new pixels per old pixel.
        width, height: new size of the image, pixels.
    """
    K = camera.K * jnp.array([[scale], [scale], [1.0]])
    return replace(camera, K=K, width=width, height=height)


@partial(jax.jit, inline=True)
def world_to_camera(points: Float[Array, "*n 3"], viewmat: Float[Array, "4 4"]) -> Float[Array, "*n 3"]:
    """Points in the frame of one camera."""
    return jnp.matmul(points, viewmat[:3, :3].T, precision="highest") + viewmat[:3, 3]


@partial(jax.jit, inline=True)
def project(
    points: Float[Array, "*n 3"], viewmat: Float[Array, "4 4"], K: Float[Array, "3 3"]
) -> tuple[Float[Array, "*n 2"], Float[Array, "*n"]]:
    """Pixel positions and depths of world points in one camera; the division clamps depths to 1e-6 m.

    Args:
        points: world, metres.
        viewmat: world to camera, OpenCV axes.
        K: intrinsics, pixels.
    """
    local = world_to_camera(points, viewmat)
    z = local[..., 2]
    homogeneous = jnp.matmul(local, K.T, precision="highest")
    return homogeneous[..., :2] / jnp.maximum(z, 1e-6)[..., None], z


class PointPixels(NamedTuple):
    """The pixels onto which points project.

    Attributes:
        columns, rows: indices of the pixel; 0 for a point outside the image.
        depths: z in the camera's frame, metres.
        inside: whether the point is in front of the camera and inside the image.
    """

    columns: Int[np.ndarray, "n"]
    rows: Int[np.ndarray, "n"]
    depths: Float[np.ndarray, "n"]
    inside: Bool[np.ndarray, "n"]


def pixels_of(
    points: Float[np.ndarray, "n 3"],
    viewmat: Float[np.ndarray, "4 4"],
    K: Float[np.ndarray, "3 3"],
    width: int,
    height: int,
) -> PointPixels:
    """The pixel onto which each point projects, on the host. Occlusion is not tested.

    Args:
        points: world, metres.
        viewmat, K: pose and intrinsics of the camera.
        width, height: size of the image, pixels.
    """
    xy, depths = pixels_at(points @ viewmat[:3, :3].T + viewmat[:3, 3], K)
    inside = (xy >= 0).all(axis=1) & (xy < (width, height)).all(axis=1)  # False for NaN
    columns, rows = np.where(inside[:, None], xy, 0).astype(int).T
    return PointPixels(columns, rows, depths, inside)


@partial(jax.jit, inline=True)
def unproject(
    pixels: Float[Array, "*n 2"],
    depths: Float[Array, "*n"],
    viewmat: Float[Array, "4 4"],
    K: Float[Array, "3 3"],
) -> Float[Array, "*n 3"]:
    """World points at z-depth `depths` on the rays through `pixels`; the inverse of `project`.

    Args:
        pixels: (x, y), centres at +0.5.
        depths: along the optical axis, metres.
        viewmat, K: pose and intrinsics of the camera, as for `project`.
    """
    x = (pixels[..., 0] - K[0, 2] - K[0, 1] * (pixels[..., 1] - K[1, 2]) / K[1, 1]) / K[0, 0]
    y = (pixels[..., 1] - K[1, 2]) / K[1, 1]
    local = jnp.stack([x, y, jnp.ones_like(x)], axis=-1) * depths[..., None]
    return jnp.matmul(local - viewmat[:3, 3], viewmat[:3, :3], precision="highest")


def camera_centers(viewmats: Float[Array, "*batch 4 4"]) -> Float[Array, "*batch 3"]:
    """Positions of cameras in the world: -R^T t."""
    rotations, translations = viewmats[..., :3, :3], viewmats[..., :3, 3]
    return -jnp.einsum("...ji,...j->...i", rotations, translations, precision="highest")


def perturbed(
    viewmats: Float[Array, "c 4 4"], twist: Float[Array, "6"], radius: Float[Array, ""] | float
) -> Float[Array, "c 4 4"]:
    """View matrices of the cameras after each is rotated about its own centre and shifted, all by one twist.

    Args:
        viewmats: world to camera.
        twist: a rotation vector (radians) and a shift (in units of `radius`), both along the world's axes.
        radius: radius of the scene, metres.
    """
    turn = jaxlie.SO3.exp(twist[:3]).as_matrix()
    rotations = jnp.matmul(viewmats[:, :3, :3], turn.T, precision="highest")
    centers = camera_centers(viewmats) + radius * twist[3:]
    shifts = -jnp.einsum("cij,cj->ci", rotations, centers, precision="highest")
    return viewmats.at[:, :3, :3].set(rotations).at[:, :3, 3].set(shifts)


def pixel_grid(width: int, height: int) -> Float[Array, "height width 2"]:
    """Centres of all pixels, (x, y)."""
    x, y = jnp.arange(width) + 0.5, jnp.arange(height) + 0.5
    return jnp.stack(jnp.meshgrid(x, y), axis=-1)
