import numpy as np
import pytest
from matplotlib import pyplot

from gsjax.viz import plots

TIMES = 0.05 + 0.01 * np.random.default_rng(0).random(30)


def texts(figure) -> str:
    return " ".join(text.get_text() for axes in figure.axes for text in axes.texts)


def test_update_time_names_its_lines():
    labels = texts(plots.update_time(TIMES))
    assert f"median {np.median(TIMES) * 1e3:.0f} ms" in labels
    assert "30 Hz" in labels


def test_update_time_with_a_slow_first_frame_is_logarithmic():
    assert plots.update_time(np.r_[30.0, TIMES]).axes[0].get_yscale() == "log"
    assert plots.update_time(TIMES).axes[0].get_yscale() == "linear"


def test_error_has_one_line_per_object_in_the_colour_of_its_label():
    errors = {"cup": TIMES, "box": TIMES * 2}
    figure = plots.error_over_frames(errors, labels={"cup": 2, "box": 5}, limit_mm=5)
    cup, box, _limit = figure.axes[0].get_lines()
    assert cup.get_label() == "cup"
    assert cup.get_color() == plots._rgb(2)
    assert box.get_color() == plots._rgb(5)
    assert "5 mm" in texts(figure)


def test_psnr_distinguishes_tracked_from_held_out():
    figure = plots.psnr_over_frames({"camera 0": TIMES}, {"camera 2": TIMES})
    assert [line.get_label() for line in figure.axes[0].get_lines()] == [
        "camera 0 (tracked)",
        "camera 2 (held out)",
    ]
    assert figure.axes[0].get_lines()[1].get_linestyle() == "--"


def test_curves_of_fits_leave_out_rows_without_evaluation():
    rows = [{"seconds": 60.0 * i, "test_psnr": 20.0 + i if i % 2 else None} for i in range(6)]
    figure = plots.fit_curves({"a": rows, "never judged": rows[:1]})
    curve, end, *never = figure.axes[0].get_lines()
    assert curve.get_label() == "a"
    np.testing.assert_allclose(np.transpose(curve.get_data()), [[1, 21], [3, 23], [5, 25]])
    np.testing.assert_allclose(np.transpose(end.get_data()), [[5, 25]])
    assert end.get_color() == curve.get_color() != never[0].get_color()
    assert all(len(line.get_xdata()) == 0 for line in never)


@pytest.mark.filterwarnings("error")
def test_names_are_drawn_letter_by_letter(tmp_path):
    names = ["_old", r"a$\d$b", "$x"]
    figure = plots.fit_curves({name: [{"seconds": 60.0, "test_psnr": 20.0}] for name in names})
    drawn = plots.save(figure, tmp_path / "curves.svg").read_text()
    assert all(f"{name} -->" in drawn for name in names)  # each text is also a comment


def test_trajectories_survive_gaps_and_absent_objects(tmp_path):
    path = np.cumsum(np.ones((10, 3)) * 0.01, axis=0)
    path[3] = np.nan
    paths = {"cup": path, "never seen": np.full((10, 3), np.nan)}
    figure = plots.trajectories(paths, truth={"cup": path})
    assert [one.get_ylabel() for one in figure.axes] == ["y (m)", "z (m)"]
    assert plots.save(figure, tmp_path / "plots" / "paths.png").stat().st_size > 5000


@pytest.mark.parametrize("suffix", [".svg", ".png"])
def test_saving_twice_gives_the_same_bytes_and_leaves_no_state(tmp_path, suffix):
    first, second = (plots.save(plots.update_time(TIMES), tmp_path / f"{i}{suffix}") for i in range(2))
    assert first.read_bytes() == second.read_bytes()
    assert pyplot.get_fignums() == []


@pytest.mark.thorough
@pytest.mark.parametrize("plot", [plots.update_time, lambda x: plots.error_over_frames({"a": x})])
@pytest.mark.parametrize("values", [np.full(3, np.nan), np.zeros(0), np.ones(1)])
def test_little_or_nothing_to_draw(plot, values, tmp_path):
    assert plots.save(plot(values), tmp_path / "plot.svg").exists()
