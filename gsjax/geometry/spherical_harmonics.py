"""Real spherical harmonics to degree 3, in the order and sign of 3DGS (Kerbl et al. 2023)."""

import jax.numpy as jnp
from jaxtyping import Array, Float

SH_C0 = 0.28209479177387814  # 1 / (2 sqrt(pi)): the constant harmonic
_C1 = 0.4886025119029199
_C2 = (1.0925484305920792, -1.0925484305920792, 0.31539156525252005, -1.0925484305920792, 0.5462742152960396)
_C3 = (
    -0.5900435899266435,
    2.890611442640554,
    -0.4570457994644658,
    0.3731763325901154,
    -0.4570457994644658,
    1.445305721320277,
    -0.5900435899266435,
)


def num_sh_bases(degree: int) -> int:
    """Number of coefficients per channel up to `degree`: 1, 4, 9, 16."""
    return (degree + 1) ** 2


def sh_bases(degree: int, directions: Float[Array, "*n 3"]) -> Float[Array, "*n bases"]:
    """All harmonics up to `degree` (0 to 3) at unit `directions`.

    Raises:
        ValueError: `degree` is not 0, 1, 2 or 3.
    """
    if degree not in (0, 1, 2, 3):
        raise ValueError(f"degree: expected 0, 1, 2 or 3, found {degree!r}")
    x, y, z = jnp.moveaxis(directions, -1, 0)
    bases = [jnp.full_like(x, SH_C0)]
    if degree >= 1:
        bases += [-_C1 * y, _C1 * z, -_C1 * x]
    if degree >= 2:
        xx, yy, zz, xy, yz, xz = x * x, y * y, z * z, x * y, y * z, x * z
        bases += [
            _C2[0] * xy,
            _C2[1] * yz,
            _C2[2] * (2 * zz - xx - yy),
            _C2[3] * xz,
            _C2[4] * (xx - yy),
        ]
        if degree >= 3:
            bases += [
                _C3[0] * y * (3 * xx - yy),
                _C3[1] * xy * z,
                _C3[2] * y * (4 * zz - xx - yy),
                _C3[3] * z * (2 * zz - 3 * xx - 3 * yy),
                _C3[4] * x * (4 * zz - xx - yy),
                _C3[5] * z * (xx - yy),
                _C3[6] * x * (xx - 3 * yy),
            ]
    return jnp.stack(bases, axis=-1)


def evaluate_sh(
    degree: int, coefficients: Float[Array, "*n bases channels"], directions: Float[Array, "*n 3"]
) -> Float[Array, "*n channels"]:
    """Colours sum_k c_k Y_k(direction) + 0.5, not clamped. Directions need not be unit length.

    Coefficients beyond `degree` are ignored, so a schedule can unlock degrees one by one.
    """
    squared = jnp.sum(directions * directions, axis=-1, keepdims=True)
    # A camera exactly at the centre of a Gaussian has no viewing direction: use +z, with zero gradient.
    usable = squared > 1e-24
    fallback = jnp.zeros_like(directions).at[..., 2].set(1.0)
    unit = jnp.where(usable, directions, fallback) / jnp.sqrt(jnp.where(usable, squared, 1.0))
    bases = sh_bases(degree, unit)
    used = coefficients[..., : num_sh_bases(degree), :]
    return jnp.einsum("...k,...kc->...c", bases, used, precision="highest") + 0.5


def rgb_to_sh0(rgb: Float[Array, "*n 3"]) -> Float[Array, "*n 3"]:
    """The degree-0 coefficient that evaluates to `rgb`."""
    return (rgb - 0.5) / SH_C0
