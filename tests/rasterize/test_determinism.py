"""Results are equal bit for bit: in every run and process, and for every order of the Gaussians."""

import hashlib
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from tests.rasterize.front import GAUSSIANS, TRAINED, cotangent, drawn, plan_for, scene_before


def digest() -> str:
    """A digest of an image and all gradients, exact to the bit."""
    image, gradient, _ = drawn(scene_before(), cotangent(), plan_for())
    arrays = [image, *(gradient[key] for key in TRAINED)]
    return hashlib.sha256(b"".join(np.asarray(a).tobytes() for a in arrays)).hexdigest()


@pytest.mark.thorough
def test_five_runs_and_two_processes_are_equal_bit_for_bit():
    command = "import runpy, sys; print(runpy.run_path(sys.argv[1])['digest']())"
    root = Path(__file__).resolve().parents[2]
    started = [
        subprocess.Popen(
            [sys.executable, "-c", command, __file__], cwd=root, stdout=subprocess.PIPE, text=True
        )
        for _ in range(2)
    ]
    here = {digest() for _ in range(5)}
    assert len(here) == 1
    assert {process.communicate()[0].strip() for process in started} == here


@pytest.mark.thorough
def test_a_permutation_of_the_gaussians_changes_no_bit():
    scene, order = scene_before(), np.random.default_rng(3).permutation(12)
    want, slope, _ = drawn(scene, cotangent(), plan_for())
    shuffled = {k: v[order] if k in GAUSSIANS else v for k, v in scene.items()}
    got, gradient, _ = drawn(shuffled, cotangent(), plan_for())
    np.testing.assert_array_equal(got, want)
    for key in GAUSSIANS:
        np.testing.assert_array_equal(gradient[key], slope[key][order])
