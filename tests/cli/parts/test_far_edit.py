"""`gsjax edit` on a run whose data lie far from the origin."""

from dataclasses import replace

import jax
import numpy as np
import pytest

from gsjax.engine.files import relative_to_scene
from gsjax.engine.parts.films import edited
from gsjax.engine.parts.saved import open_parts_run
from gsjax.methods.parts.timeline import parse_script
from tests.cli.parts.test_edit import write_run


@pytest.mark.thorough
@pytest.mark.filterwarnings("ignore:.*coordinates reach")
def test_points_are_in_the_coordinates_of_the_data_also_far_from_0(tmp_path):
    """The points of edits, the place of another run's parts, and the points of these parts' own edits."""
    text = """
    edits:
      - {op: rotate, parts: [drawer], axis: [0, 0, 1], degrees: 30, about: [%s, 0.2, 0.1]}
      - op: composite
        from_run: %s
        parts: [1]
        place: {to: [%s, 0, 0]}
        edits: [{op: redirect, parts: [1], degrees: 10, axis: [0, 1, 0], about: [%s, 0, 0]}]
    """
    near = open_parts_run(write_run(tmp_path / "run"))
    origin = np.array([5e6, 0.0, 0.0])
    far = replace(near, recording=relative_to_scene(near.recording, origin))
    other = write_run(tmp_path / "other")
    far_other = write_run(tmp_path / "far", origin=origin)
    expected, _ = edited(parse_script(text % (0.5, other, 1.5, 0.25)), near)
    found, _ = edited(parse_script(text % (5000000.5, far_other, 5000001.5, 5000000.25)), far)
    assert len(found) == len(expected) == 2
    for was, now in zip(jax.tree.leaves(expected), jax.tree.leaves(found), strict=True):
        np.testing.assert_allclose(now, was, atol=1e-6)
