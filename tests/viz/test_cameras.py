"""The drawing of cameras and points: its content, its scale, and its count of what is left out."""

import numpy as np
import pytest
from matplotlib.collections import LineCollection

from gsjax.geometry.cameras import intrinsics, look_at
from gsjax.viz.cameras import CameraGroup, cameras_and_points
from gsjax.viz.plots import save

EYES = np.array([[2.0, 0, 1], [0, 2, 1.5], [-2, 0, 1], [0, -2, 1.2]])


def group(eyes=EYES, color="#0072b2", turn=None):
    viewmats = np.stack([look_at(eye, np.zeros(3)) for eye in eyes])
    if turn is not None:
        viewmats = viewmats @ turn
    n = len(eyes)
    return CameraGroup(
        viewmats, np.tile(intrinsics(50.0, 80, 60), (n, 1, 1)), np.tile([80, 60], (n, 1)), color
    )


def lines(panel):
    (drawn,) = [item for item in panel.collections if isinstance(item, LineCollection)]
    return np.array(drawn.get_segments())


def test_frusta_start_where_cameras_stand_and_open_to_where_they_look():
    above, side = cameras_and_points({"fitted": group()}).axes
    assert (above.get_xlabel(), above.get_ylabel()) == ("x (units of the data)", "y (units of the data)")
    assert side.get_ylabel() == "z (units of the data)"
    for panel, keep in ((above, [0, 1]), (side, [0, 2])):
        segments = lines(panel).reshape(4, 8, 2, 2)  # four edges and four sides each
        np.testing.assert_allclose(segments[:, :4, 0], np.repeat(EYES[:, None, keep], 4, axis=1), atol=1e-9)
        ends = segments[:, :4, 1].mean(1)
        ahead = -EYES / np.linalg.norm(EYES, axis=1, keepdims=True)
        np.testing.assert_allclose(
            (ends - EYES[:, keep]) / (ends - EYES[:, keep])[0, 0], ahead[:, keep] / ahead[0, 0]
        )
        assert panel.get_aspect() == 1
    assert above.get_xlim() == side.get_xlim()


def test_cameras_at_one_place_are_drawn_once_and_all_are_counted():
    figure = cameras_and_points({"fitted": group(np.repeat(EYES, 5, axis=0)), "held out": group(EYES[:1])})
    assert [text.get_text() for text in figure.legends[0].get_texts()] == ["fitted (20)", "held out (1)"]
    drawn = [len(item.get_segments()) for item in figure.axes[0].collections]
    assert drawn == [4 * 8, 8]


def test_a_few_far_points_do_not_shrink_the_rest_and_are_counted():
    near = np.random.default_rng(0).uniform(-1, 1, (990, 3))
    far = np.full((10, 3), 1e4)
    figure = cameras_and_points({"fitted": group()}, np.concatenate([near, far]), unit="m", title="room")
    above = figure.axes[0]
    assert above.get_xlim()[1] < 3
    assert above.get_xlabel() == "x (m)"
    (points,) = [item for item in above.collections if not isinstance(item, LineCollection)]
    assert len(points.get_offsets()) == 990
    captions = [text.get_text() for text in figure.texts]
    assert "1,000 points, 1.0% of them beyond the edges" in captions


def test_a_world_that_lies_on_its_side_is_set_upright():
    """With -y up, as structure from motion often has it, heights are drawn upwards."""
    turn = np.eye(4)
    turn[:3, :3] = [[1, 0, 0], [0, 0, 1], [0, -1, 0]]  # new coordinates to old ones: z = -y, y = z
    _, side = cameras_and_points({"fitted": group(turn=turn)}).axes
    assert side.get_ylabel() == "-y (units of the data)"
    heights = lines(side).reshape(4, 8, 2, 2)[:, 0, 0, 1]
    np.testing.assert_allclose(heights, EYES[:, 2], atol=1e-9)


def test_an_oblique_world_has_axes_of_its_own():
    turn = np.eye(4)
    turn[1:3, 1:3] = [[np.cos(0.6), -np.sin(0.6)], [np.sin(0.6), np.cos(0.6)]]
    above, side = cameras_and_points({"fitted": group(turn=turn)}).axes
    assert above.get_ylabel() == "ahead (units of the data)"
    heights = lines(side).reshape(4, 8, 2, 2)[:, 0, 0, 1]
    np.testing.assert_allclose(heights - heights[0], EYES[:, 2] - EYES[0, 2], atol=0.1)


@pytest.mark.parametrize(
    ("groups", "points"),
    [
        ({}, None),
        ({}, np.random.default_rng(0).normal(size=(50, 3))),
        ({"fitted": group(EYES[:1])}, None),
        ({"fitted": group(EYES[:1])}, np.full((3, 3), np.nan)),
        ({"fitted": group()}, np.zeros((0, 3))),
    ],
)
def test_little_or_nothing_to_draw(groups, points, tmp_path):
    figure = cameras_and_points(groups, points, title=r"$\room$")  # no command to typeset
    assert save(figure, tmp_path / "a.png").stat().st_size > 5000
    for panel in figure.axes:
        assert np.isfinite([*panel.get_xlim(), *panel.get_ylim()]).all()
