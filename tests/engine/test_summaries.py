"""The wording of summaries: scores are labelled as what they are, and datasets have readable titles."""

import pytest

from gsjax.engine.summary import title_of
from gsjax.engine.track.results import SCORES


def test_the_tile_of_the_tracker_is_a_mean_and_says_so():
    score = next(score for score in SCORES if score.key == "centroid_error_mm")
    still, moved = {"moved_mm": 0.0}, {"moved_mm": 200.0}
    objects = {
        "block": {"centroid_error_mm": 9.0, **still},  # it stood still, so it tests no tracker
        "can": {"centroid_error_mm": 7.6, **moved},
        "ball": {"centroid_error_mm": 0.8, **moved},
    }
    found = {"objects": objects, "over_frames": {"centroid_error_mm": {"can": [0.0, 13.3]}}}
    assert score.head == "mean centroid error, worst object"
    assert score.value(found) == pytest.approx(7.6)


@pytest.mark.parametrize(
    ("dataset", "title"),
    [
        ("tabletop_seed0", "tabletop, seed 0"),
        ("bar_seed12", "bar, seed 12"),
        ("fox", "fox"),
        ("room_seed3", "room_seed3"),  # a user's folder
        ("a_seeds", "a_seeds"),
    ],
)
def test_a_built_in_scene_has_a_title_for_people(dataset, title):
    assert title_of(dataset) == title
