"""Plots of a tracked recording, in the coordinates and with the numbers of frames of the data."""

from dataclasses import replace
from unittest.mock import Mock

import numpy as np

from gsjax.engine.folder import RunFolder
from gsjax.engine.recording import Recording
from gsjax.engine.scores import Scores
from gsjax.engine.track.outputs import write_plots
from gsjax.metrics.tracking import ObjectScore
from gsjax.viz import plots
from tests.engine.test_track_poses import EACH, FRAMES, LABELS, recording, tracking


def test_paths_are_in_the_coordinates_of_the_data(tmp_path, monkeypatch):
    folder, drawn, trajectories = RunFolder(tmp_path), [], plots.trajectories

    def draw(paths, labels, truth):
        drawn.append((paths, truth))
        return trajectories(paths, labels, truth)

    monkeypatch.setattr(plots, "trajectories", draw)
    scores, names = Mock(spec=Scores, num_frames=0, cameras={}), {2: "carton"}
    origin = np.array([500_000.0, 5_000_000.0, 300.0])
    for sequence in (recording(), replace(recording(), origin=origin)):
        told = Recording(sequence, sequence, FRAMES)
        write_plots(folder, tracking(), told, scores, {}, names, LABELS)
    for near, far in zip(*drawn, strict=True):
        np.testing.assert_allclose(far["carton"] - near["carton"], np.tile(origin, (FRAMES, 1)), atol=1e-6)


def test_frames_have_their_numbers_in_the_data(tmp_path, monkeypatch):
    figures, numbers = {}, (100, 105, 110)

    def keep(figure, path):
        figures[path.stem] = figure
        return path

    monkeypatch.setattr(plots, "save", keep)
    sequence, tracked = replace(recording(), frame_ids=numbers), tracking()
    tracked.update_s = [0.0, 0.03, 0.04]
    camera = Mock(values={"psnr": [30.0, 31.0, 29.0]}, held_out=False)
    scores = Mock(spec=Scores, num_frames=FRAMES, cameras={0: camera})
    motion = {2: Mock(spec=ObjectScore, centroid_errors_mm=np.ones(FRAMES), num_scored=EACH)}
    told = Recording(sequence, sequence, FRAMES)
    write_plots(RunFolder(tmp_path), tracked, told, scores, motion, {2: "carton"}, LABELS)
    for name in ("centroid_error", "update_time", "psnr"):
        assert tuple(figures[name].axes[0].get_lines()[0].get_xdata()) == numbers
