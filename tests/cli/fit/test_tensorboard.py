"""Event files of a fit's curve, read back record by record; a resumed run leaves no value twice."""

import struct
import sys
import time

import cv2
import numpy as np
import pytest

from gsjax.engine.fit.tensorboard import TensorBoard
from gsjax.extras import MissingExtra

pytest.importorskip("tensorboardX")


def row(step, test_psnr=None):
    return {"step": step, "loss": 1 / step, "psnr": 20.0, "alive": 10 * step, "test_psnr": test_psnr}


def events(folder):
    """The events of all files by name; a record is a length, its checksum, an event and its checksum."""
    from tensorboardX.proto.event_pb2 import Event

    for file in sorted((folder / "tensorboard").glob("events.*")):
        data = file.read_bytes()
        while len(data) > 12 and len(data) >= 16 + struct.unpack("<Q", data[:8])[0]:
            (length,) = struct.unpack("<Q", data[:8])
            yield Event.FromString(data[12 : 12 + length])
            data = data[16 + length :]


def read(folder):
    """What TensorBoard shows: tag -> {step: value}, and (tag, step, width) of each picture. A session's start
    voids earlier values of its step and later ones."""
    scalars, pictures = [], []
    for event in events(folder):
        if event.session_log.status == 1:
            scalars = [entry for entry in scalars if entry[1] < event.step]
        for value in event.summary.value:
            if value.HasField("image"):
                pictures.append((value.tag, event.step, value.image.width))
            else:
                scalars.append((value.tag, event.step, value.simple_value))
    shown = {}
    for tag, step, number in scalars:
        assert step not in shown.setdefault(tag, {}), f"{tag} twice at {step}"
        shown[tag][step] = number
    return shown, pictures


def test_rows_are_there_before_the_end_and_pictures_at_it(tmp_path):
    board = TensorBoard(tmp_path)
    board.add(row(100))
    board.add(row(200, test_psnr=24.5) | {"psnr": float("inf")})
    deadline = time.monotonic() + 60
    while "psnr_held_out" not in (shown := read(tmp_path)[0]) or 200 not in shown["gaussians"]:
        assert time.monotonic() < deadline
        time.sleep(0.05)
    assert shown["psnr"] == {100: 20.0}
    assert shown["loss"] == {100: pytest.approx(0.01), 200: pytest.approx(0.005)}
    assert shown["psnr_held_out"] == {200: 24.5}
    assert shown["gaussians"] == {100: 1000, 200: 2000}
    cv2.imwrite(str(tmp_path / "a.png"), np.zeros((4, 6, 3), np.uint8))
    board.close({"held_out/a": tmp_path / "a.png", "held_out/gone": tmp_path / "gone.png"})
    assert read(tmp_path)[1] == [("held_out/a", 200, 6)]


def test_a_resumed_run_appends_and_voids_what_the_killed_one_wrote_after_its_checkpoint(tmp_path):
    killed = TensorBoard(tmp_path)
    for step in (100, 200, 300):
        killed.add(row(step))
    killed.close()
    going_on = TensorBoard(tmp_path, [row(100), row(200)])
    going_on.add(row(300, test_psnr=25.0))
    going_on.add(row(400))
    going_on.close()
    shown, _ = read(tmp_path)
    assert list(shown["loss"]) == [100, 200, 300, 400]
    assert shown["psnr_held_out"] == {300: 25.0}


def test_a_resumed_run_that_had_none_writes_all_and_a_new_one_begins_anew(tmp_path):
    TensorBoard(tmp_path, [row(100), row(200)]).close()
    assert list(read(tmp_path)[0]["loss"]) == [100, 200]
    new = TensorBoard(tmp_path)
    new.add(row(50))
    new.close()
    assert list(read(tmp_path)[0]["loss"]) == [50]


def test_without_the_package_it_says_what_to_install(tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "tensorboardX", None)
    with pytest.raises(MissingExtra, match=r"--tensorboard needs tensorboardX, .* 'gsjax\[tensorboard\]'"):
        TensorBoard(tmp_path)
    assert not (tmp_path / "tensorboard").exists()
