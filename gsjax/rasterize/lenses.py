"""Mappings from points to the image, linearised at each Gaussian's centre, for pinholes and fisheyes."""

from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from gsjax.rasterize.plan import Plan

Columns = Float[Array, "rows lanes"]

_NEAR_AXIS = 0.01  # squared sine of the angle off axis below which series are used
_ANGLES = np.arange(1, 193) / 64  # off axis, radians: up to 172 degrees, since at 180 all directions meet


class Linearised(NamedTuple):
    """Image coordinates of focal length 1 and their Jacobian, for rows of Gaussians."""

    x: Columns  # times depth
    y: Columns  # times depth
    depth: Columns  # z; of a fisheye the distance from the camera
    slopes: Callable  # a direction in the camera's frame -> its image under the Jacobian, times depth
    seen: Bool[Array, "rows lanes"] | None  # where a fisheye's mapping is one-to-one; None: wherever z > 0


def pinhole(local: list[Columns], K: Float[Array, "3 3"], plan: Plan) -> Linearised:
    """A pinhole: (x / z, y / z).

    Args:
        local: x, y and z in the camera's frame.
        K: intrinsics, pixels.
        plan: gives the size of the image.
    """
    x, y, z = local
    fx, cx, fy, cy = K[0, 0], K[0, 2], K[1, 1], K[1, 2]
    # Far outside the image the linearisation would blow up, so its x/z is clamped to near the frame.
    margin_x, margin_y = 0.15 * plan.width / fx, 0.15 * plan.height / fy
    tx = jnp.clip(x / z, -cx / fx - margin_x, (plan.width - cx) / fx + margin_x)
    ty = jnp.clip(y / z, -cy / fy - margin_y, (plan.height - cy) / fy + margin_y)

    def slopes(direction):
        in_x, in_y, in_z = direction
        slope_y = in_y - ty * in_z
        return in_x - tx * in_z, slope_y

    return Linearised(x, y, z, slopes, None)


def fisheye(local: list[Columns], coeffs: Float[Array, "4"]) -> Linearised:
    """A fisheye, by the model of Kannala and Brandt.

    In OpenCV's form of the model (PAMI 28(8), 2006), with the unit vector n to a point and its angle theta
    off axis, the image is F A (n_x, n_y), where

        A = theta / sin(theta)          F = 1 + k1 theta^2 + k2 theta^4 + k3 theta^6 + k4 theta^8

    Its Jacobian maps v to (F A v_x + n_x s, F A v_y + n_y s) / r, at a distance r, where with the derivative
    P of F theta, D = (P - F) / theta^2 and B = (A - cos(theta)) / sin(theta)^2

        s = (D A^2 cos(theta) - F B) (n_x v_x + n_y v_y) - P v_z

    A and B are smooth on the axis, where series replace their quotients. Points beyond the first angle at
    which P is not positive, where the lens folds back, are not seen.

    Args:
        local: x, y and z in the camera's frame.
        coeffs: k1 to k4.
    """
    x, y, z = local
    distance = jnp.sqrt(x * x + y * y + z * z)
    nx, ny, cosine = x / distance, y / distance, z / distance
    squared = nx * nx + ny * ny
    a, b = _angle_by_sine(squared, cosine)
    t2 = a * a * squared
    k1, k2, k3, k4 = coeffs
    f = 1 + t2 * (k1 + t2 * (k2 + t2 * (k3 + t2 * k4)))
    d = 2 * k1 + t2 * (4 * k2 + t2 * (6 * k3 + t2 * 8 * k4))
    p = _growth(t2, coeffs)
    radial = d * a * a * cosine - f * b

    def slopes(direction):
        in_x, in_y, in_z = direction
        s = radial * (nx * in_x + ny * in_y) - p * in_z
        return f * a * in_x + nx * s, f * a * in_y + ny * s

    return Linearised(f * a * x, f * a * y, distance, slopes, t2 < _widest(coeffs) ** 2)


def _angle_by_sine(squared, cosine):
    """theta / sin(theta), and (theta - sin(theta) cos(theta)) / sin(theta)^3."""
    near = (squared < _NEAR_AXIS) & (cosine > 0)
    q = jnp.where(near, squared, 0.0)
    a = 1 + q * (1 / 6 + q * (3 / 40 + q * (5 / 112 + q * (35 / 1152 + q * 63 / 2816))))
    b = 2 / 3 + q * (1 / 5 + q * (3 / 28 + q * (5 / 72 + q * (35 / 704 + q * 63 / 1664))))
    q = jnp.where(near, 1.0, squared)
    sine, cosine = jnp.sqrt(q), jnp.where(near, 0.0, cosine)
    far_a = jnp.arctan2(sine, cosine) / sine
    return jnp.where(near, a, far_a), jnp.where(near, b, (far_a - cosine) / q)


def _growth(t2, coeffs):
    """Derivative of the distance from the image's centre with respect to theta."""
    k1, k2, k3, k4 = coeffs
    return 1 + t2 * (3 * k1 + t2 * (5 * k2 + t2 * (7 * k3 + t2 * 9 * k4)))


def _widest(coeffs: Float[Array, "4"]) -> Float[Array, ""]:
    """The angle off axis up to which the image's distance from its centre grows, radians."""
    coeffs = jax.lax.stop_gradient(coeffs)
    angles = jnp.asarray(_ANGLES, coeffs.dtype)
    grows = jnp.cumprod(_growth(angles * angles, coeffs) > 0)
    return jnp.where(grows, angles, 0.0).max()
