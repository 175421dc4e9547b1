"""Live streams of frames: the newest frame is delivered, and all others are counted."""

import itertools
import math
import sys
import threading
from types import ModuleType, SimpleNamespace

import cv2
import equinox as eqx
import jax.numpy as jnp
import numpy as np
import pytest

from gsjax.data import DataError
from gsjax.data.opencv_cameras import calibrated_camera, open_camera, snapshots
from gsjax.data.realsense_camera import open_realsense
from gsjax.data.stream import NewestSnapshots, Snapshot, StreamStalled, back_and_forth, replay
from gsjax.extras import MissingExtra
from gsjax.geometry.cameras import Camera
from gsjax.scene.frame import Frame

FRAME = Frame(jnp.zeros((1, 2, 3, 3)), None, Camera(jnp.eye(4)[None], jnp.eye(3)[None], 3, 2))


def snapshot(stamp: float, skew: float = 0.0) -> Snapshot:
    return Snapshot(FRAME, stamp, skew)


def test_a_consumer_that_keeps_up_loses_nothing():
    taken = threading.Semaphore(0)

    def source():
        for stamp in range(5):
            yield snapshot(stamp)
            taken.acquire()

    newest, stamps = NewestSnapshots(source()), []
    for arrival in newest:
        stamps.append(arrival.snapshot.stamp)
        taken.release()
    assert stamps == [0, 1, 2, 3, 4]
    assert (newest.counts.offered, newest.counts.used, newest.counts.dropped) == (5, 5, 0)


def test_a_slow_consumer_gets_only_the_newest():
    begun, rest = threading.Event(), threading.Event()

    def source():
        yield snapshot(0)
        begun.wait()
        yield from map(snapshot, range(1, 9))
        rest.set()

    newest, stamps = NewestSnapshots(source()), []
    for arrival in newest:
        stamps.append(arrival.snapshot.stamp)
        if arrival.snapshot.stamp == 0:  # processing that takes as long as eight frames
            begun.set()
            rest.wait()
    assert stamps == [0, 8]
    assert (newest.counts.offered, newest.counts.used, newest.counts.dropped) == (9, 2, 7)


def test_snapshots_out_of_order_or_out_of_sync_are_dropped_and_counted():
    taken = threading.Semaphore(0)

    def source():
        for shot in (snapshot(1), snapshot(0.5), snapshot(1), snapshot(2, 0.03), snapshot(3, 0.01)):
            yield shot
            if shot.stamp in (1, 3):
                taken.acquire(timeout=1)

    newest, stamps = NewestSnapshots(source(), max_skew=0.02), []
    for arrival in newest:
        stamps.append(arrival.snapshot.stamp)
        taken.release(2)
    assert stamps == [1, 3]
    counts = newest.counts
    assert (counts.offered, counts.used, counts.out_of_order, counts.out_of_sync) == (5, 2, 2, 1)


def test_a_stalled_stream_raises_an_error():
    never, received = threading.Event(), []

    def source():
        yield snapshot(0)
        never.wait(5)

    with pytest.raises(StreamStalled, match=r"nothing for 0.1 s after 1 frames"):
        received.extend(arrival.snapshot.stamp for arrival in NewestSnapshots(source(), patience=0.1))
    never.set()


def test_patience_may_be_endless():
    begun = threading.Event()

    def source():
        begun.wait(0.05)
        yield snapshot(0)

    assert len(list(NewestSnapshots(source(), patience=math.inf))) == 1


def test_an_exception_of_the_source_is_raised_in_the_consumer():
    def source():
        yield snapshot(0)
        raise DataError("camera 0", "a picture", "none", "Check its connection.")

    with pytest.raises(DataError, match="camera 0"):
        list(NewestSnapshots(source()))


def test_a_recording_goes_back_and_forth_without_jumps():
    assert list(itertools.islice(back_and_forth(4), 10)) == [0, 1, 2, 3, 2, 1, 0, 1, 2, 3]
    assert list(itertools.islice(back_and_forth(1), 3)) == [0, 0, 0]
    assert list(itertools.islice(back_and_forth(2), 5)) == [0, 1, 0, 1, 0]


def test_a_replay_keeps_its_rate_whatever_the_processing_time():
    clock, naps = [10.0], []

    def sleep(seconds):
        naps.append(seconds)
        clock[0] += seconds

    stamps = []
    frames = [eqx.tree_at(lambda f: f.images, FRAME, FRAME.images + i) for i in range(3)]
    for shot in replay(frames, 10.0, 0.5, now=lambda: clock[0], sleep=sleep):
        stamps.append((int(shot.frame.images[0, 0, 0, 0]), round(shot.stamp, 3), round(clock[0] - 10, 3)))
        clock[0] += 0.04  # processing time
    assert stamps == [(0, 0.1, 0.1), (1, 0.2, 0.2), (2, 0.3, 0.3), (1, 0.4, 0.4), (0, 0.5, 0.5)]
    np.testing.assert_allclose(naps, [0.1, 0.06, 0.06, 0.06, 0.06], atol=1e-9)


def test_a_replay_may_be_endless():
    shots = replay([FRAME], 1e3, math.inf, sleep=lambda seconds: None)
    assert [shot.stamp for shot in itertools.islice(shots, 3)] == [0.001, 0.002, 0.003]


class FakeCapture:
    """A camera that returns `frames` pictures like OpenCV's OpenNI 2 backend."""

    def __init__(self, frames=2, focal=300.0, opened=True, depth=True, size=(4, 6)):
        self.left, self.focal, self.opened, self.depth, self.size = frames, focal, opened, depth, size

    def isOpened(self):
        return self.opened

    def get(self, propId):
        sizes = {cv2.CAP_PROP_FRAME_WIDTH: self.size[1], cv2.CAP_PROP_FRAME_HEIGHT: self.size[0]}
        return sizes.get(propId, self.focal)

    def grab(self):
        self.left -= 1
        return self.left >= 0

    def retrieve(self, *, flag=0):
        if flag == cv2.CAP_OPENNI_DEPTH_MAP:
            return self.depth, np.full(self.size, 1500, np.uint16)
        return True, np.broadcast_to(np.array([255, 0, 0], np.uint8), (*self.size, 3))


def test_opencv_gives_metres_and_red_green_blue():
    cameras = [calibrated_camera(i, FakeCapture(), np.eye(4)) for i in range(2)]
    np.testing.assert_allclose(cameras[0].K, [[300, 0, 3], [0, 300, 2], [0, 0, 1]])
    shots = list(snapshots(cameras))
    assert len(shots) == 2
    np.testing.assert_allclose(shots[0].frame.depths, np.full((2, 4, 6), 1.5), rtol=1e-6)
    np.testing.assert_allclose(shots[0].frame.images[1, 0, 0], [0, 0, 1])
    assert shots[1].stamp > shots[0].stamp
    assert 0 <= shots[0].skew < 1


@pytest.mark.parametrize(
    ("cameras", "says"),
    [
        ([FakeCapture(opened=False)], "none that can be opened"),
        ([FakeCapture(focal=0.0)], "a camera without depth"),
        ([FakeCapture(depth=False)], "a frame without depth"),
        ([FakeCapture(), FakeCapture(size=(3, 6))], r"\(3, 6\), \(4, 6\)"),
    ],
)
def test_unsuitable_cameras_are_refused_with_the_reason(cameras, says):
    with pytest.raises(DataError, match=says):
        list(snapshots([calibrated_camera(i, camera, np.eye(4)) for i, camera in enumerate(cameras)]))


def test_a_missing_camera_is_an_error_with_advice():
    with pytest.raises(DataError, match="replay a folder"):
        open_camera(97)


class FakeRealSense(ModuleType):
    """The part of pyrealsense2 that is used, with one camera: `frames` frames after `late` waits in vain."""

    def __init__(self, frames=2, starts=True, depth=True, late=0):
        super().__init__("pyrealsense2")
        self.left, self.starts, self.depth, self.late, self.waits = frames, starts, depth, late, []
        self.stream = SimpleNamespace(depth="depth", color="color")
        self.format = SimpleNamespace(z16="z16", bgr8="bgr8")
        self.camera_info = SimpleNamespace(serial_number="serial number")
        self.wanted = []
        self.config = lambda: SimpleNamespace(
            enable_device=self.wanted.append, enable_stream=lambda *stream: self.wanted.append(stream)
        )
        device = SimpleNamespace(get_info=lambda what: f"the {what}")
        self.context = lambda: SimpleNamespace(query_devices=lambda: [device])
        wait = self.try_wait_for_frames
        self.pipeline = lambda: SimpleNamespace(start=self.start, try_wait_for_frames=wait)
        self.align = lambda to: SimpleNamespace(process=self.aligned)

    def start(self, config):
        if not self.starts:
            raise RuntimeError("Device or resource busy")
        sensor = SimpleNamespace(get_depth_scale=lambda: 0.0001)
        intrinsics = SimpleNamespace(fx=300.0, fy=310.0, ppx=2.5, ppy=1.5, width=6, height=4)
        profile = SimpleNamespace(get_intrinsics=lambda: intrinsics)
        return SimpleNamespace(
            get_device=lambda: SimpleNamespace(first_depth_sensor=lambda: sensor),
            get_stream=lambda stream: SimpleNamespace(as_video_stream_profile=lambda: profile),
        )

    def try_wait_for_frames(self, milliseconds):
        self.waits.append(milliseconds)
        if len(self.waits) <= self.late:
            return False, {}
        self.left -= 1
        return self.left >= 0, {}

    def aligned(self, frames):
        color = SimpleNamespace(get_data=lambda: np.full((4, 6, 3), (255, 0, 0), np.uint8))
        depth = SimpleNamespace(get_data=lambda: np.full((4, 6), 15000, np.uint16)) if self.depth else None
        return SimpleNamespace(get_color_frame=lambda: color, get_depth_frame=lambda: depth)


def test_a_realsense_camera_gives_metres_and_red_green_blue(monkeypatch):
    fake = FakeRealSense()
    monkeypatch.setitem(sys.modules, "pyrealsense2", fake)
    camera = open_realsense(0)
    assert fake.wanted == ["the serial number", ("depth", "z16"), ("color", "bgr8")]
    np.testing.assert_allclose(camera.K, [[300, 0, 3], [0, 310, 2], [0, 0, 1]])
    shots = list(snapshots([camera]))
    assert len(shots) == 2
    np.testing.assert_allclose(shots[0].frame.depths, np.full((1, 4, 6), 1.5), rtol=1e-6)
    np.testing.assert_allclose(shots[0].frame.images[0, 0, 0], [0, 0, 1])


@pytest.mark.parametrize(
    ("patience", "late", "milliseconds"),
    [(0.5, 1, [500]), (2.5, 3, [1000, 1000, 500]), (math.inf, 30, [1000] * 31)],
)
def test_a_realsense_camera_is_waited_for_as_long_as_asked(monkeypatch, patience, late, milliseconds):
    """Never for more than a second at a time, so that Ctrl-C is noticed."""
    fake = FakeRealSense(late=late)
    monkeypatch.setitem(sys.modules, "pyrealsense2", fake)
    arrived = next(snapshots([open_realsense(0, patience=patience)]), None)
    assert (arrived is not None) == (patience == math.inf)
    assert fake.waits == milliseconds


@pytest.mark.parametrize(
    ("fake", "index", "says"),
    [
        (FakeRealSense(), 1, "realsense:1: expected a RealSense camera, found 1 that are connected"),
        (FakeRealSense(starts=False), 0, r"one that does not start \(Device or resource busy\)"),
        (FakeRealSense(depth=False), 0, "a frame without depth"),
        (None, 0, r"realsense:0 needs pyrealsense2.*gsjax\[realsense\]"),
    ],
    ids=["not connected", "busy", "no depth", "not installed"],
)
def test_realsense_cameras_that_cannot_be_used(monkeypatch, fake, index, says):
    monkeypatch.setitem(sys.modules, "pyrealsense2", fake)
    with pytest.raises((DataError, MissingExtra), match=says):
        list(snapshots([open_realsense(index)]))
