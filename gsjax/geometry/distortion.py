"""OpenCV's models of lens distortion for points and whole images, differentiable in every argument.

Points are normalised and dimensionless, (x, y) = (X/Z, Y/Z). `model="opencv"` has 4, 5 or 8 coefficients in
OpenCV's order (k1, k2, p1, p2, k3, k4, k5, k6); missing ones are 0. With r^2 = x^2 + y^2

    s  = (1 + k1 r^2 + k2 r^4 + k3 r^6) / (1 + k4 r^2 + k5 r^4 + k6 r^6)
    x' = s x + 2 p1 x y + p2 (r^2 + 2 x^2)            y' = s y + p1 (r^2 + 2 y^2) + 2 p2 x y

and `model="opencv_fisheye"` has 4 (k1, k2, k3, k4); with theta = atan(r)

    (x', y') = theta (1 + k1 theta^2 + k2 theta^4 + k3 theta^6 + k4 theta^8) / r (x, y)

Pixel centres lie at +0.5 here and at integers in OpenCV: cx and cy of a K for OpenCV are smaller by 0.5, and
so are the positions in its maps. K may have skew. Every function raises ValueError for an unknown model or a
wrong number of coefficients.

Sources: docs.opencv.org, modules calib3d and fisheye; Brown 1966; Kannala, Brandt, PAMI 28(8), 2006.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from gsjax.geometry.cameras import pixel_grid

Matrix = Float[Array, "3 3"]
Coeffs = Float[Array, "k"]
Image = Float[Array, "rows columns channels"]

MODELS = {"opencv": (4, 5, 8), "opencv_fisheye": (4,)}
"""The models, and the numbers of coefficients that each accepts."""

_ITERATIONS = 20  # Newton needs 4 to 8 of them; at a fold, where the Jacobian is singular, more
_RAY = 16  # points on the way to a solution that are checked for folds
_CONDITION = 1e-4  # smallest det J / |J|^2, about 1 over the condition number, that counts as invertible
_HORIZON = 1.57  # largest angle off axis, radians; 0.05 degrees short of a right angle, where x and y diverge
_EDGE = 1e-3  # pixels; K and its inverse do not cancel exactly


class Undistorted(NamedTuple):
    """Undistorted points, and which of them exist."""

    points: Float[Array, "*n 2"]  # always finite
    valid: Bool[Array, "*n"]


class Warped(NamedTuple):
    """A resampled image, and which of its pixels are valid."""

    image: Float[Array, "height width channels"]  # 0 where not valid
    valid: Bool[Array, "height width"]


def distort(points: Float[Array, "*n 2"], coeffs: Coeffs, model: str = "opencv") -> Float[Array, "*n 2"]:
    """Distort normalised points. With zero coefficients, "opencv" is exactly the identity.

    Far off axis the polynomials fold back, and a point that the camera cannot see may land in the image.
    Points that are not finite, or so far out that r^6 overflows, become NaN with zero gradients; if any
    coefficient is not finite, all points do.

    Args:
        points: normalised, (X/Z, Y/Z).
        coeffs: coefficients of the lens, in the order above.
        model: "opencv" or "opencv_fisheye".
    """
    c, sound = _padded(coeffs, model)
    r2 = jnp.sum(points * points, axis=-1, keepdims=True)
    known = jnp.isfinite(r2 * r2 * r2) & sound
    flat = jnp.where(known, points, 0.0)
    if model == "opencv_fisheye":
        flat = flat * _atan_over_r(jnp.sum(flat * flat, axis=-1, keepdims=True))
    return jnp.where(known, _bend(flat, c), jnp.nan)


def undistort(points: Float[Array, "*n 2"], coeffs: Coeffs, model: str = "opencv") -> Undistorted:
    """The inverse of `distort`, by Newton's method, differentiated exactly by the implicit function theorem.

    A point is invalid if it lies beyond the fold (no point is distorted to it) or so near to it that the
    condition number exceeds 1e4, if it is 90 degrees or more off axis, or if it is not finite; all points
    are invalid if a coefficient is not finite. For invalid points the result is finite and its gradients are
    zero.

    Args:
        points: distorted, normalised.
        coeffs, model: the lens, as for `distort`.
    """
    c, sound = _padded(coeffs, model)
    dtype = jnp.result_type(points, c)
    points = jnp.where(sound, points, jnp.nan).astype(dtype)
    solution, valid = _unbend(points, c.astype(dtype))
    if model == "opencv_fisheye":
        t2 = jnp.sum(solution * solution, axis=-1, keepdims=True)
        ahead = t2 < _HORIZON**2
        solution = jnp.where(ahead, solution * _tan_over_t(jnp.where(ahead, t2, 0.0)), 0.0)
        valid &= ahead[..., 0]
    return Undistorted(solution, valid)


def undistort_map(
    K: Matrix, coeffs: Coeffs, width: int, height: int, pinhole_K: Matrix | None = None, model: str = "opencv"
) -> Float[Array, "height width 2"]:
    """Where in a photograph the pixels of an ideal pinhole image lie: cv2.initUndistortRectifyMap, plus 0.5.

    Args:
        K, coeffs, model: the camera that took the photograph.
        width, height: size of the pinhole image, pixels.
        pinhole_K: intrinsics of the pinhole image; default: K.
    """
    ideal = _normalized_grid(width, height, K if pinhole_K is None else pinhole_K)
    return _to_pixels(distort(ideal, coeffs, model), K)


def distort_map(
    K: Matrix, coeffs: Coeffs, width: int, height: int, pinhole_K: Matrix | None = None, model: str = "opencv"
) -> Undistorted:
    """Where in an ideal pinhole image the pixels of a photograph lie, pixels [height, width, 2].

    Arguments as for `undistort_map`, except that width and height are those of the photograph.
    """
    ideal, valid = undistort(_normalized_grid(width, height, K), coeffs, model)
    return Undistorted(_to_pixels(ideal, K if pinhole_K is None else pinhole_K), valid)


def undistort_image(
    image: Image,
    K: Matrix,
    coeffs: Coeffs,
    *,
    pinhole_K: Matrix | None = None,
    size: tuple[int, int] | None = None,
    model: str = "opencv",
) -> Warped:
    """The photograph that an ideal pinhole camera would have taken, to compare with a rendered image.

    Arguments as for `undistort_map`; `size` is (width, height) of the result, by default the photograph's.
    """
    width, height = size or image.shape[1::-1]
    return sample(image, undistort_map(K, coeffs, width, height, pinhole_K, model))


def distort_image(
    image: Image,
    K: Matrix,
    coeffs: Coeffs,
    *,
    pinhole_K: Matrix | None = None,
    size: tuple[int, int] | None = None,
    model: str = "opencv",
) -> Warped:
    """A rendered pinhole image as seen through a lens; used to fit a lens to photographs.

    Differentiable in image, K, pinhole_K and coeffs. A lens may pull in pixels from outside the frame, and
    these have to be rendered too: render with `with_margin`, and pass the `size` of the photograph. Do not
    exclude invalid pixels from a loss: a lens that folds everything away would then cost nothing.

    Args:
        image: the rendered image.
        K, coeffs, model: the camera with the lens, as for `undistort_map`.
        pinhole_K: intrinsics of the rendered image; default: K.
        size: (width, height) of the result; default: that of `image`.
    """
    width, height = size or image.shape[1::-1]
    pixels, valid = distort_map(K, coeffs, width, height, pinhole_K, model)
    warped, known = sample(image, pixels)
    return Warped(jnp.where(valid[..., None], warped, 0.0), known & valid)


def with_margin(K: Matrix, width: int, height: int, margin: int) -> tuple[Matrix, int, int]:
    """(K, width, height) of the same camera with a margin of `margin` pixels added on each side."""
    return jnp.asarray(K).at[:2, 2].add(margin), width + 2 * margin, height + 2 * margin


def sample(image: Image, pixels: Float[Array, "height width 2"]) -> Warped:
    """Bilinear interpolation of `image` at positions (x, y) in pixels, centres at +0.5.

    A position is valid if it lies between the outermost pixel centres and all of its neighbours are finite.
    """
    last = jnp.array(image.shape[1::-1]) - 1
    finite = jnp.isfinite(image).all(axis=-1)
    image = jnp.where(finite[..., None], image, 0.0)
    at = pixels - 0.5
    valid = ((at >= -_EDGE) & (at <= last + _EDGE)).all(axis=-1)  # False for NaN
    at = jnp.clip(jnp.where(valid[..., None], at, 0.0), 0.0, last)
    low = jnp.floor(at)
    total = jnp.zeros((*valid.shape, image.shape[-1]), image.dtype)
    for corner in jnp.array([[0, 0], [1, 0], [0, 1], [1, 1]]):
        weight = jnp.where(corner == 1, at - low, 1 - (at - low)).prod(axis=-1)
        # Beyond the last row or column there is no pixel, but its weight is 0.
        x, y = jnp.moveaxis(jnp.minimum(low + corner, last).astype(jnp.int32), -1, 0)
        total += weight[..., None] * image[y, x]
        valid &= finite[y, x] | (weight == 0)
    return Warped(jnp.where(valid[..., None], total, 0.0), valid)


def _padded(coeffs: Coeffs, model: str) -> tuple[Float[Array, "9"], Bool[Array, ""]]:
    """Coefficients of `_bend` (numerator r^2..r^8, denominator r^2..r^6, p1, p2), and whether all are finite.

    If any is not, all are replaced by zeros.
    """
    if model not in MODELS:
        raise ValueError(f"model: expected one of {', '.join(MODELS)}, found {model!r}")
    counts, coeffs = MODELS[model], jnp.asarray(coeffs)
    if coeffs.ndim != 1 or len(coeffs) not in counts:
        listed = " or ".join(map(str, counts))
        raise ValueError(f"coeffs: expected {listed} coefficients for {model}, found shape {coeffs.shape}")
    order = (0, 1, 2, 3, 8, 8, 8, 8, 8) if model == "opencv_fisheye" else (0, 1, 4, 8, 5, 6, 7, 2, 3)
    sound = jnp.isfinite(coeffs).all()
    return jnp.pad(jnp.where(sound, coeffs, 0.0), (0, 9 - len(coeffs)))[np.array(order)], sound


def _bend(points: Float[Array, "*n 2"], c: Float[Array, "9"]) -> Float[Array, "*n 2"]:
    """Apply the distortion; for the fisheye, the points' distance from the axis is theta."""
    x, y = points[..., 0], points[..., 1]
    r2 = x * x + y * y
    numerator = 1 + r2 * (c[0] + r2 * (c[1] + r2 * (c[2] + r2 * c[3])))
    scale = numerator / (1 + r2 * (c[4] + r2 * (c[5] + r2 * c[6])))
    xd = scale * x + (2 * c[7] * x * y + c[8] * (r2 + 2 * x * x))
    yd = scale * y + (c[7] * (r2 + 2 * y * y) + 2 * c[8] * x * y)
    return jnp.stack([xd, yd], axis=-1)


def _slope(
    points: Float[Array, "*n 2"], c: Float[Array, "9"]
) -> tuple[Float[Array, "*n 4"], Bool[Array, "*n"]]:
    """The Jacobian of `_bend`, row-major, and whether it is sound: invertible, and not flipped by a fold."""

    def along(axis):
        direction = jnp.zeros_like(points).at[..., axis].set(1.0)
        return jax.jvp(lambda p: _bend(p, c), (points,), (direction,))[1]

    J = jnp.stack([along(0), along(1)], axis=-1).reshape(*points.shape[:-1], 4)
    det, trace = J[..., 0] * J[..., 3] - J[..., 1] * J[..., 2], J[..., 0] + J[..., 3]
    return J, (det > _CONDITION * jnp.sum(J * J, axis=-1)) & (trace > 0)


def _divide(v: Float[Array, "*n 2"], J: Float[Array, "*n 4"]) -> Float[Array, "*n 2"]:
    """J^-1 v."""
    a, b, c, d = jnp.moveaxis(J, -1, 0)
    x, y = v[..., 0], v[..., 1]
    return jnp.stack([d * x - b * y, a * y - c * x], axis=-1) / (a * d - b * c)[..., None]


@jax.custom_jvp
def _unbend(
    points: Float[Array, "*n 2"], coeffs: Float[Array, "9"]
) -> tuple[Float[Array, "*n 2"], Bool[Array, "*n"]]:
    """The inverse of `_bend`, and where it exists. Steps that raise the error or cross a fold shrink."""
    target = jnp.where(jnp.isfinite(points).all(axis=-1, keepdims=True), points, 0.0)

    def iteration(_, carry):
        at, distance, rate = carry  # at: the point, its image under `_bend`, and the Jacobian there
        point = at[..., :2] + rate * _divide(target - at[..., 2:4], at[..., 4:])
        bent = _bend(point, coeffs)
        slope, sound = _slope(point, coeffs)
        new_distance = jnp.sum((bent - target) ** 2, axis=-1)
        better = (sound & (new_distance < distance))[..., None]
        at = jnp.where(better, jnp.concatenate([point, bent, slope], axis=-1), at)
        distance = jnp.where(better[..., 0], new_distance, distance)
        return at, distance, jnp.where(better, jnp.minimum(2 * rate, 1), rate / 4)

    zero = jnp.zeros_like(target)
    start = jnp.concatenate([zero, zero, zero + jnp.array([1, 0]), zero + jnp.array([0, 1])], axis=-1)
    start = (start, jnp.sum(target**2, axis=-1), jnp.ones_like(target[..., :1]))
    solution = jax.lax.fori_loop(0, _ITERATIONS, iteration, start)[0][..., :2]

    tolerance = 32 * jnp.finfo(points.dtype).eps * (1 + jnp.abs(points))
    solved = (jnp.abs(_bend(solution, coeffs) - points) <= tolerance).all(axis=-1)  # False for NaN

    def check_for_fold(i, solved):
        return solved & _slope(solution * ((i + 1) / _RAY).astype(points.dtype), coeffs)[1]

    return solution, jax.lax.fori_loop(0, _RAY, check_for_fold, solved)


@_unbend.defjvp
def _unbend_jvp(primals, tangents):
    """bend(u, c) = d, so du = J^-1 (dd - d bend/dc dc)."""
    (points, coeffs), (d_points, d_coeffs) = primals, tangents
    solution, solved = _unbend(points, coeffs)
    u = jnp.where(solved[..., None], solution, 0.0)  # at 0, J is the identity
    _, by_coeffs = jax.jvp(lambda c: _bend(u, c), (coeffs,), (d_coeffs,))
    moved = jnp.where(solved[..., None], _divide(d_points - by_coeffs, _slope(u, coeffs)[0]), 0.0)
    return (solution, solved), (moved, np.zeros(solved.shape, jax.dtypes.float0))


def _atan_over_r(r2):
    """atan(r) / r as a function of r^2; a series near 0, where the square root has no derivative."""
    small = r2 < 1e-4
    r = jnp.sqrt(jnp.where(small, 1.0, r2))
    return jnp.where(small, 1 - r2 * (1 / 3 - r2 * (1 / 5 - r2 * (1 / 7 - r2 / 9))), jnp.arctan(r) / r)


def _tan_over_t(t2):
    """tan(t) / t as a function of t^2; a series near 0, as in `_atan_over_r`."""
    small = t2 < 1e-4
    t = jnp.sqrt(jnp.where(small, 1.0, t2))
    series = 1 + t2 * (1 / 3 + t2 * (2 / 15 + t2 * (17 / 315 + t2 * 62 / 2835)))
    return jnp.where(small, series, jnp.tan(t) / t)


def _normalized_grid(width, height, K):
    u, v = jnp.moveaxis(pixel_grid(width, height).astype(K.dtype), -1, 0)
    y = (v - K[1, 2]) / K[1, 1]
    return jnp.stack([(u - K[0, 2] - K[0, 1] * y) / K[0, 0], y], axis=-1)


def _to_pixels(points, K):
    x, y = points[..., 0], points[..., 1]
    return jnp.stack([K[0, 0] * x + K[0, 1] * y + K[0, 2], K[1, 1] * y + K[1, 2]], axis=-1)
