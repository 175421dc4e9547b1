"""`gsjax parts` on two states, each seen by its own cameras: from a scene to a report with its joints."""

import json

import numpy as np
import pytest

from gsjax.cli import main

SCENE = "simulated:cabinet?width=96&height=72&cameras=12"
QUICK = (
    *("--fit.steps", "60", "--fit.cap", "3000", "--fit.start.count", "3000", "--fit.coarse-until", "0"),
    *("--parts.refine.iterations", "3", "--eval-cameras", "5"),
)


@pytest.mark.slow
def test_a_door_and_a_drawer_have_their_joints(tmp_path):
    folder = tmp_path / "run"
    assert main(["parts", SCENE, "--out", str(folder), *QUICK]) == 0
    found = json.loads((folder / "metrics.json").read_text())
    assert found["complete"]
    assert (found["anchor"], found["steps"], found["frames"]["followed"]) == (0, 3, 2)
    assert any("motions were searched for" in note for note in found["notes"])
    rows = {row["true_name"]: row for row in found["parts"] if "true_name" in row}
    assert rows["door_1"]["kind"] == "revolute"
    assert rows["drawer_1"]["kind"] == "prismatic"
    for row in rows.values():
        assert row["axis_deg"] < 1.0
        assert row["median_point_error_mm"] < 5.0
    assert found["ari"] > 0.6
    arrays = np.load(folder / "parts.npz")
    np.testing.assert_allclose(arrays["R"][0], np.broadcast_to(np.eye(3), arrays["R"][0].shape), atol=1e-6)
    assert (folder / "report.html").stat().st_size > 10_000
