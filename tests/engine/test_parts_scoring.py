"""Parts against true joints, on the two parts of `test_edit`; and warnings of parts that are doubtful."""

import io
from dataclasses import replace
from pathlib import Path
from unittest.mock import Mock

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from rich.console import Console

from gsjax.data import open_sequence
from gsjax.data.objects import Truth
from gsjax.engine.messages import Notes
from gsjax.engine.parts.outputs import _note_absences
from gsjax.engine.parts.run import Options, _warn_if_doubtful
from gsjax.engine.parts.scoring import part_rows, score_parts, warn_of_runaways
from gsjax.engine.recording import Recording
from gsjax.geometry.joints import Joint
from gsjax.methods.parts import DiscoverConfig, PartScene, PartsConfig, PartsResult, Start, motions_in_world
from gsjax.scene.handles import HandlePose
from gsjax.scene.initialize import gaussians_from_points
from tests.cli.parts.test_edit import DATASET, scene_and_trajectory

X = np.array([1.0, 0.0, 0.0])
SLIDE = Joint("prismatic", X, np.zeros(3), np.array([0.0, 0.05, 0.1, 0.15]))  # that of part 1
SHUT = replace(SLIDE, values=np.zeros(4))
RISE = replace(SLIDE, axis=np.array([0.0, 0.0, 1.0]))


def truth_of(**joints):
    """The truth of objects with these joints, by name."""
    motions = np.stack([joint.motions() for joint in joints.values()], axis=1)
    return Truth(tuple(joints), np.arange(1, len(joints) + 1), motions, joints=tuple(joints.values()))


def scored(scene, trajectory, truth, anchor=0):
    """The scores of a recording without masks and depth, and the row of part 1."""
    joints = PartsResult(scene, trajectory, np.ones(4, bool), anchor, 1e-3, "quaternion").joints()
    rows = part_rows(scene, trajectory, joints)
    sequence = replace(open_sequence(DATASET), load_mask=None, load_depth=None, truth=truth)
    recording, notes = Recording(sequence, sequence, 4), Notes(Console(quiet=True))
    found = score_parts(scene, trajectory, joints, rows, recording, anchor, "quaternion", notes)
    return found, rows[0]


@pytest.mark.parametrize(("absent", "rests", "anchor"), [([2, 3], 1, 0), ([0, 1], 2, 3)])
def test_a_part_is_compared_in_the_frames_in_which_it_is_there(absent, rests, anchor):
    """In the others it rests where it was last seen, though its true joint goes on."""
    scene, trajectory = scene_and_trajectory()
    shown = np.ones((4, 3), np.float32)
    shown[absent, 1] = 0
    trajectory = eqx.tree_at(lambda t: t.opacities, trajectory, shown)
    shifts = np.array(trajectory.poses.translations)
    shifts[absent] = shifts[rests]
    shifts -= shifts[anchor]
    trajectory = eqx.tree_at(lambda t: t.poses.translations, trajectory, shifts)
    _, row = scored(scene, trajectory, truth_of(drawer=SLIDE), anchor)
    assert row["true_name"] == "drawer"
    assert row["axis_deg"] < 0.1
    assert row["value_mm"] < 0.1
    assert row["point_error_mm"] < 0.1


def test_the_frames_without_a_part_have_their_numbers_in_the_data():
    _, trajectory = scene_and_trajectory()
    shown = np.ones((4, 3), np.float32)
    shown[[0, 1, 3], 1] = 0
    notes = Notes(Console(quiet=True))
    trajectory = eqx.tree_at(lambda t: t.opacities, trajectory, shown)
    _note_absences(trajectory, np.ones(4, bool), (100, 105, 110, 115), notes)
    assert notes.all == ["Part 1 is not there in 3 of 4 frames: 100 to 105, 115."]


def test_the_error_of_points_is_their_distance_from_where_they_truly_are():
    """Part 1 slides by 40 cm, and in the last of four frames it is also found turned by 2 degrees about its
    handle. The error is a mean over frames."""
    scene, trajectory = scene_and_trajectory()
    far = replace(SLIDE, values=np.array([0.0, 0.1, 0.2, 0.4]))
    quats, shifts = map(np.array, jax.tree.leaves(trajectory.poses))
    quats[3, 1] = np.cos(np.radians(1)), 0, 0, np.sin(np.radians(1))
    shifts[:, 1, 0] = far.values
    trajectory = eqx.tree_at(lambda t: t.poses, trajectory, HandlePose(*map(jnp.asarray, (quats, shifts))))
    _, row = scored(scene, trajectory, truth_of(drawer=far))
    points = np.asarray(scene.gaussians.means, np.float64)[np.asarray(scene.labels) == 1]
    found, true = (
        points @ motion[:3, :3].T + motion[:3, 3]
        for motion in (motions_in_world(scene, trajectory)[3, 1], far.motions()[3])
    )
    assert row["point_error_mm"] == pytest.approx(
        1000 * np.linalg.norm(found - true, axis=1).mean() / 4, rel=1e-4
    )


def test_an_object_that_does_not_move_is_not_missed():
    found, _ = scored(*scene_and_trajectory(), truth_of(door=SHUT, drawer=SLIDE))
    assert found == {"true_parts": 1, "missed": []}


@pytest.mark.parametrize(("other", "moving", "missed"), [(SHUT, 1, []), (RISE, 2, ["drawer"])])
def test_objects_of_one_name_are_found_or_missed_each_by_itself(other, moving, missed):
    truth = replace(truth_of(one=SLIDE, two=other), names=("drawer", "drawer"))
    found, row = scored(*scene_and_trajectory(), truth)
    assert found == {"true_parts": moving, "missed": missed}
    assert row["true_name"] == "drawer"


@pytest.mark.parametrize("moved_mm", [900.0, 5000.0])
def test_a_part_that_moves_farther_than_the_scene_is_wide_is_warned_of(moved_mm):
    means = np.random.default_rng(0).uniform(size=(500, 3))  # in a cube of one metre, but for two
    means[0] = 100.0
    means[1] = np.nan
    gaussians = gaussians_from_points(means, means[:, ::-1].clip(0, 1))
    scene = PartScene(gaussians, jnp.ones((500, 1)), jnp.zeros((1, 3)))
    rows = [
        {"part": 1, "gaussians": 400, "moved_mm": 300.0},
        {"part": 2, "gaussians": 38, "moved_mm": moved_mm},
    ]
    with Notes(Console(file=io.StringIO())) as notes:
        warn_of_runaways(rows, scene, notes)
        assert len(notes.all) == (moved_mm > 2000)
        assert all("2 (38 Gaussians)" in one for one in notes.all)


def test_pieces_are_not_said_to_be_left_out_where_none_may_be():
    """Three pieces remain whether three changed, or more."""
    start = Mock(spec=Start, masks=np.array([[[1, 2, 3]]]))
    parts = PartsConfig(discover=DiscoverConfig(most_parts=3))
    with Notes(Console(file=io.StringIO())) as notes:
        _warn_if_doubtful(start, 0.1, Options("data", Path("run"), parts=parts), notes)
        (said,) = [one for one in notes.all if "--parts.discover.most-parts 3" in one]
    assert "smaller ones, if any, were left out" in said
