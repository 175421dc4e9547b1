"""The one sequence type that every reader returns and every method takes."""

import warnings
from collections import Counter
from collections.abc import Callable, Mapping
from collections.abc import Sequence as Indices
from dataclasses import dataclass, field, replace

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float, Int, UInt8

from gsjax.data.errors import DataWarning
from gsjax.data.objects import PointModel, Truth
from gsjax.data.resizing import area_resized, check_scale, nearest_resized
from gsjax.data.validation import (
    check_background,
    check_depth,
    check_intrinsics,
    check_loaded,
    check_poses,
    check_shape,
    check_times,
    positions_of,
)
from gsjax.geometry.cameras import NEAR, Camera
from gsjax.scene.frame import Frame

# Field shapes are in the docstrings: constructors check them, with better messages than an annotation's.

_POSE_ADVICE = "viewmats are world-to-camera in OpenCV axes; correct or leave out that pose."


@dataclass(frozen=True, eq=False)
class Sequence:
    """A scene recorded by calibrated cameras over time. Frames are loaded on demand and not cached.

    `t` and `c` count frames and cameras of this sequence from 0; `frame_ids` and `camera_ids` are the data's
    own numbers for them. The cameras of one frame are treated as simultaneous.

    Attributes:
        name: name of the sequence.
        camera_ids: the data's own camera numbers, C of them.
        width: pixels, of every camera.
        height: pixels.
        times: seconds, increasing, [T] float64; if `shared_times`, neighbours may be equal.
        frame_ids: the data's own frame numbers, T of them.
        Ks: intrinsics in pixels, pixel centres at +0.5, [T,C,3,3] float64; given as [C,3,3], the same in all
            frames.
        viewmats: world to camera, OpenCV axes, metres, [T,C,4,4] float64; given as [C,4,4], the same in all
            frames.
        load_image: (t, c) -> RGB, [H,W,3] uint8; or floats in 0..1 if `float_images`.
        load_depth: (t, c) -> metres, [H,W], 0 = invalid; or None for a camera without depth.
        load_mask: (t, c) -> labels, [H,W] integers; or None for a camera without masks.
        load_flow: (t, u, c) -> displacement in pixels [H,W,2] of each pixel from frame t to frame u; NaN =
            unknown.
        truth: ground truth of the objects, for scoring.
        models: objects of known shape.
        label_names: names of mask values, besides those that `truth` and `models` name.
        float_images: `load_image` returns floats. Pixels that are not finite are reported, become black, and
            are invalid in `depth`.
        near: near clipping distance, metres.
        locate: (kind, t, c) -> path of a file, for messages; kind is "image", "depth", "mask" or "flow".
        origin: for data far from 0, the point that all positions are relative to, in the coordinates of the
            files, [3] float64; None if positions are as in the files.
        layout: name of the layout of its files, such as "TUM RGB-D"; empty if it was not opened with
            `open_sequence`.
        shared_times: whether frames may share a time, as photographs of a moving scene do.
        splits: "train", "val" or "test" for each frame; None if the data has no splits.
        background: RGB, 0 to 1, composited behind transparent images; None if none is transparent.

    Raises:
        ValueError: there is no camera, ids of cameras or frames repeat, shapes disagree, intrinsics are not a
            camera's, a pose is not a rigid motion, times do not increase, or the background is not from 0 to
            1.
    """

    name: str
    camera_ids: tuple[int, ...]
    width: int
    height: int
    times: Float[np.ndarray, "..."]
    frame_ids: tuple[int, ...]
    Ks: Float[np.ndarray, "..."]
    viewmats: Float[np.ndarray, "..."]
    load_image: Callable[[int, int], np.ndarray] = field(repr=False)
    load_depth: Callable[[int, int], np.ndarray | None] | None = field(default=None, repr=False)
    load_mask: Callable[[int, int], np.ndarray | None] | None = field(default=None, repr=False)
    load_flow: Callable[[int, int, int], np.ndarray | None] | None = field(default=None, repr=False)
    truth: Truth | None = None
    models: tuple[PointModel, ...] = ()
    label_names: Mapping[int, str] = field(default_factory=dict)
    float_images: bool = False
    near: float = NEAR
    locate: Callable[[str, int, int], str] | None = field(default=None, repr=False)
    origin: Float[np.ndarray, "..."] | None = None
    layout: str = ""
    shared_times: bool = False
    splits: tuple[str, ...] | None = None
    background: tuple[float, float, float] | None = None

    def __post_init__(self):
        for name in ("times", "Ks", "viewmats"):
            object.__setattr__(self, name, np.asarray(getattr(self, name), np.float64))
        frames, cameras = self.num_frames, self.num_cameras
        for name, side in (("Ks", 3), ("viewmats", 4)):  # given once per camera, for all frames
            if getattr(self, name).shape == (cameras, side, side):
                of_frames = np.tile(getattr(self, name), (frames, 1, 1, 1))
                object.__setattr__(self, name, of_frames)
        if cameras == 0:
            raise ValueError("a sequence needs at least one camera, got none. Choose other cameras.")
        if len(set(self.camera_ids)) != cameras:
            raise ValueError(f"camera_ids must differ from each other, got {self.camera_ids}")
        check_shape("times", self.times, (frames,))
        check_times(self.times, shared=self.shared_times)
        check_shape("frame_ids", np.asarray(self.frame_ids), (frames,))
        if repeated := [i for i, count in Counter(self.frame_ids).items() if count > 1]:
            raise ValueError(f"frame_ids must differ from each other, got {repeated[0]} more than once")
        check_shape("Ks", self.Ks, (frames, cameras, 3, 3))
        check_shape("viewmats", self.viewmats, (frames, cameras, 4, 4))
        if self.origin is not None:
            check_shape("origin", self.origin, (3,))
        if self.splits is not None:
            check_shape("splits", np.asarray(self.splits), (frames,))
        check_background(self.background)
        check_intrinsics(self.Ks, self._camera_in_frame)
        check_poses("viewmat", self.viewmats, self._camera_in_frame, _POSE_ADVICE)
        if self.truth is not None:
            check_shape("truth.poses", self.truth.poses, (frames, len(self.truth.names), 4, 4))

    def __repr__(self) -> str:
        size = f"{self.num_frames} frames of {self.num_cameras} cameras, {self.width}x{self.height}"
        known = {"depth": self.has_depth, "masks": self.has_masks, "truth": self.truth is not None}
        there = [name for name, known in known.items() if known]
        return f"Sequence({self.name}: {size}{', with ' * bool(there)}{', '.join(there)})"

    @property
    def num_frames(self) -> int:
        """Number of frames, T."""
        return len(self.times)

    @property
    def num_cameras(self) -> int:
        """Number of cameras, C."""
        return len(self.camera_ids)

    @property
    def has_depth(self) -> bool:
        """Whether some camera has depth."""
        return self.load_depth is not None

    @property
    def has_masks(self) -> bool:
        """Whether some camera has masks."""
        return self.load_mask is not None

    @property
    def has_flow(self) -> bool:
        """Whether optical flow is known."""
        return self.load_flow is not None

    @property
    def names_of_labels(self) -> dict[int, str]:
        """Names of mask values: from the data, the models and the truth."""
        return dict(self.label_names) | self.known_objects

    @property
    def known_objects(self) -> dict[int, str]:
        """Names of the mask values of objects whose shape or true poses are known."""
        names = {m.label: m.name for m in self.models if m.label}
        if self.truth is not None:
            labels = (int(label) for label in self.truth.label_ids)
            names |= dict(zip(labels, self.truth.names, strict=True))
            names |= {} if self.truth.robot is None else {self.truth.robot: "robot"}
        return names

    def camera(self, t: int, c: int) -> Camera:
        """Camera `c` in frame `t`, in JAX's default float type."""
        dtype = jnp.result_type(float)
        viewmat, K = jnp.asarray(self.viewmats[t, c], dtype), jnp.asarray(self.Ks[t, c], dtype)
        return Camera(viewmat, K, self.width, self.height, self.near)

    def image(self, t: int, c: int) -> UInt8[np.ndarray, "height width 3"]:
        """RGB. Warns with DataWarning if float pixels are not finite or the whole image is one colour.

        Raises:
            DataError: the file is unreadable, or the loader returned another shape or type.
        """
        image, what = self._raw_image(t, c), self.where("image", t, c)
        if self.float_images:
            finite = np.isfinite(image).all(-1)
            if not finite.all():
                message = f"{what}: {np.sum(~finite)} pixels are not finite; they become black without depth"
                warnings.warn(message, DataWarning, stacklevel=2)
            clean = np.where(finite[..., None], image, 0)
            image = np.round(np.clip(clean, 0, 1) * 255).astype(np.uint8)
        if (image == image[0, 0]).all():
            warnings.warn(f"{what}: the image is empty, all of one colour", DataWarning, stacklevel=2)
        return image

    def depth(self, t: int, c: int) -> Float[np.ndarray, "height width"] | None:
        """Depth along the optical axis, metres, float32, 0 = invalid; None if this camera has none.

        Warns with DataWarning if no pixel is valid.

        Raises:
            DataError: the file is unreadable, the loader returned another shape or type, or the unit is
                wrong.
        """
        depth = self._load(self.load_depth, "depth", t, c)
        if depth is None:
            return None
        what = self.where("depth", t, c)
        check_loaded(what, depth, (self.height, self.width), np.floating)
        if self.float_images:
            depth = np.where(np.isfinite(self._raw_image(t, c)).all(-1), depth, 0)
        return check_depth(depth, what)

    def mask(self, t: int, c: int) -> Int[np.ndarray, "height width"] | None:
        """Labels, int32; None if this camera has none.

        Raises:
            DataError: the file is unreadable, or the loader returned another shape or type.
        """
        mask = self._load(self.load_mask, "mask", t, c)
        if mask is None:
            return None
        check_loaded(self.where("mask", t, c), mask, (self.height, self.width), np.integer)
        return mask.astype(np.int32)

    def frame(self, t: int) -> Frame:
        """All cameras of frame `t` as device arrays; cameras without depth have depth 0 everywhere.

        Raises:
            DataError: as for `image` and `depth`.
        """
        cameras = range(self.num_cameras)
        dtype = jnp.result_type(float)
        images = np.stack([self.image(t, c) for c in cameras]).astype(dtype) / dtype.type(255)
        depths = None
        if self.has_depth:
            invalid = np.zeros((self.height, self.width), np.float32)
            loaded = [self.depth(t, c) for c in cameras]
            depths = np.stack([invalid if d is None else d for d in loaded]).astype(dtype)
        poses = np.asarray(self.viewmats[t], dtype), np.asarray(self.Ks[t], dtype)
        images, depths, poses = jax.device_put((images, depths, poses))
        return Frame(images, depths, Camera(*poses, self.width, self.height, self.near))

    def flow(self, t: int, c: int) -> Float[np.ndarray, "height width 2"] | None:
        """Displacement (x, y) of each pixel from frame `t` to t + 1, pixels; NaN = unknown, None = no flow.

        Raises:
            IndexError: `t` is the last frame, or there is no such frame.
            DataError: the loader returned another shape or type.
        """
        if self.load_flow is None:
            return None
        self._check_index(t, c)
        self._check_index(t + 1, c)
        flow = self.load_flow(t, t + 1, c)
        if flow is not None:
            check_loaded(self.where("flow", t, c), flow, (self.height, self.width, 2), np.floating)
        return flow

    def select(
        self, frames: slice | Indices[int] | np.ndarray = slice(None), cameras: Indices[int] | None = None
    ) -> "Sequence":
        """The sequence of some frames (positions from 0, or a mask) and cameras (by camera id; None = all).

        Raises:
            ValueError: a camera or frame does not exist, none is left, or frames do not increase.
        """
        every = np.arange(self.num_frames)
        chosen = every[frames] if isinstance(frames, slice) else positions_of(frames, self.num_frames)
        outside = [int(t) for t in chosen if not 0 <= t < self.num_frames]
        if outside or len(chosen) == 0:
            found = f"no frame {outside[0]}" if outside else f"no frame in {frames}"
            raise ValueError(f"{self.name} has {found}: it has frames 0 to {self.num_frames - 1}.")
        ids = self.camera_ids if cameras is None else tuple(int(c) for c in cameras)
        unknown = [c for c in ids if c not in self.camera_ids]
        if unknown:
            raise ValueError(f"{self.name} has no camera {unknown[0]}; it has {list(self.camera_ids)}.")
        ts, cs = [int(t) for t in chosen], [self.camera_ids.index(c) for c in ids]
        load_flow, locate = self.load_flow, self.locate
        truth = self.truth and self.truth.select(ts)
        return replace(
            self,
            camera_ids=ids,
            times=self.times[ts],
            frame_ids=tuple(self.frame_ids[t] for t in ts),
            Ks=self.Ks[np.ix_(ts, cs)],
            viewmats=self.viewmats[np.ix_(ts, cs)],
            load_image=_reindex(self.load_image, ts, cs),
            load_depth=_reindex(self.load_depth, ts, cs),
            load_mask=_reindex(self.load_mask, ts, cs),
            load_flow=load_flow and (lambda t, u, c: load_flow(ts[t], ts[u], cs[c])),
            locate=locate and (lambda kind, t, c: locate(kind, ts[t], cs[c])),
            truth=truth,
            splits=None if self.splits is None else tuple(self.splits[t] for t in ts),
        )

    def scaled(self, scale: float) -> "Sequence":
        """The same views downscaled: colours are averaged over the area of each new pixel; depths, labels and
        flow are sampled at its centre.

        Raises:
            ValueError: `scale` is not above 0 and at most 1.
        """
        check_scale(scale)
        if scale == 1:
            return self
        width, height = (max(1, round(side * scale)) for side in (self.width, self.height))
        factors = np.array([width / self.width, height / self.height, 1.0])

        def size(*_: int) -> tuple[int, int]:
            return width, height

        flow = nearest_resized(self.load_flow, size)
        return replace(
            self,
            width=width,
            height=height,
            Ks=self.Ks * factors[:, None],
            load_image=area_resized(self.image, size),
            load_depth=nearest_resized(self.load_depth and self.depth, size),
            load_mask=nearest_resized(self.load_mask and self.mask, size),
            load_flow=flow and (lambda *indices: _times(flow(*indices), factors[:2])),
            float_images=False,  # `image` has converted them to bytes; `depth` has masked non-finite pixels
        )

    def _raw_image(self, t: int, c: int) -> np.ndarray:
        image = self._load(self.load_image, "image", t, c)
        kind = np.floating if self.float_images else np.uint8
        check_loaded(self.where("image", t, c), image, (self.height, self.width, 3), kind)
        assert image is not None
        return image

    def _load(self, loader: Callable | None, kind: str, t: int, c: int) -> np.ndarray | None:
        self._check_index(t, c)
        loaded = None if loader is None else loader(t, c)
        return None if loaded is None else np.asarray(loaded)

    def _check_index(self, t: int, c: int) -> None:
        if not (0 <= t < self.num_frames and 0 <= c < self.num_cameras):
            raise IndexError(
                f"{self.name} has {self.num_frames} frames and {self.num_cameras} cameras, counted from 0; "
                f"got frame {t}, camera {c}"
            )

    def _camera_in_frame(self, t: int, c: int) -> str:
        return f"camera {self.camera_ids[c]} in frame {self.frame_ids[t]}"

    def where(self, kind: str, t: int, c: int) -> str:
        """Name of the image, depth or mask of camera `c` in frame `t` in messages: its path, if it has one.

        Args:
            kind: "image", "depth", "mask" or "flow".
            t, c: frame and camera, counted from 0.
        """
        if self.locate is not None:
            return self.locate(kind, t, c)
        return f"{self.name}, {kind} of {self._camera_in_frame(t, c)}"


def _reindex(loader: Callable | None, frames: list[int], cameras: list[int]) -> Callable | None:
    return loader and (lambda t, c: loader(frames[t], cameras[c]))


def _times(flow: np.ndarray | None, factors: Float[np.ndarray, "2"]) -> np.ndarray | None:
    return None if flow is None else (flow * factors).astype(flow.dtype)
