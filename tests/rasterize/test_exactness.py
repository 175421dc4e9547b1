"""Images and all gradients against the float64 reference; `benchmarks.exactness` runs 52 such scenes."""

import pytest

from benchmarks.exactness import DOUBTFUL_LIMIT, LIMITS
from benchmarks.scenes import case, compare

pytestmark = pytest.mark.usefixtures("x64")


def check(seed: int) -> None:
    found = compare(case(seed))
    assert found["longest_list"] > 256
    assert found["doubtful_share"] < 2 * DOUBTFUL_LIMIT  # 0.1 % holds over all scenes, not for each
    for dtype, (image_limit, gradient_limit) in LIMITS.items():
        for name, error in found[dtype].items():
            limit = image_limit if name.endswith("image") else gradient_limit
            assert error <= limit, f"{name} in {dtype}: {error:.1e}"


# RGB+ED, antialiased, SH 1, features, other limits; ED, classic, 7 channels, features.
@pytest.mark.parametrize("seed", [29, pytest.param(42, marks=pytest.mark.slow)])
def test_images_and_gradients_equal_the_reference(seed):
    check(seed)


@pytest.mark.slow
@pytest.mark.parametrize("seed", [3, *range(10, 20)])
def test_images_and_gradients_equal_the_reference_in_more_modes(seed):
    check(seed)
