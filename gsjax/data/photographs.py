"""Posed photographs of one scene: the result of static readers and the input of a reconstruction."""

from collections.abc import Callable, Mapping
from collections.abc import Sequence as Indices
from dataclasses import dataclass, field, replace

import jax
import numpy as np
from jaxtyping import Bool, Float, Int, Integer, UInt8

from gsjax.data.resizing import area_resized, check_scale, nearest_resized
from gsjax.data.sequence import Sequence
from gsjax.data.validation import (
    check_background,
    check_intrinsics,
    check_loaded,
    check_poses,
    check_shape,
    positions_of,
    usable_depth,
)
from gsjax.geometry.cameras import NEAR, Camera, on_device
from gsjax.scene.frame import Frame

# Field shapes are in the docstrings: constructors check them, with better messages than an annotation's.

_POSE_ADVICE = "viewmats are world-to-camera in OpenCV axes; correct or leave out that photograph."


@dataclass(frozen=True, eq=False)
class Cloud:
    """Coloured points of a scene, for example from structure from motion.

    Attributes:
        points: [M,3], in the photographs' world frame.
        colors: RGB, 0 to 1, [M,3].

    Raises:
        ValueError: shapes disagree, or colours are bytes.
    """

    points: Float[np.ndarray, "..."]
    colors: Float[np.ndarray, "..."] | UInt8[np.ndarray, "..."]

    def __post_init__(self):
        check_shape("points", self.points, (len(self.points), 3))
        check_shape("colors", self.colors, (len(self.points), 3))
        if np.issubdtype(self.colors.dtype, np.integer):
            raise ValueError(f"colors: expected RGB from 0 to 1, found {self.colors.dtype}; divide by 255")


@dataclass(frozen=True, eq=False)
class Photographs:
    """N photographs by calibrated cameras, pinhole or fisheye, each with its own size. They are loaded on
    demand and not cached. Lengths are in the data's own unit, which is metres only if a depth sensor fixes
    the scale.

    Attributes:
        name: name of the set.
        names: name of each photograph, as in the data.
        sizes: width and height in pixels, [N,2].
        Ks: intrinsics in pixels, pixel centres at +0.5, [N,3,3] float64.
        viewmats: world to camera, OpenCV axes, [N,4,4] float64.
        load_image: i -> RGB, [H,W,3] uint8, undistorted, or as the fisheye took it.
        load_mask: i -> which pixels count, [H,W] bool; or None if all do.
        load_depth: i -> depth along the optical axis, or distance from a fisheye, [H,W], 0 = invalid; or None
            without depth.
        load_labels: i -> label of each pixel, [H,W] integers; or None without labels.
        label_names: names of labels, for those that have one.
        times: seconds, [N]; None if the data has none.
        splits: "train", "val" or "test" for each; None if the data has no splits.
        cloud: points of the scene.
        background: RGB, 0 to 1, composited behind transparent photographs; None if none is transparent.
        near: near clipping distance, in the data's unit.
        locate: (kind, i) -> path of a file, for messages; kind is "image", "mask", "labels" or "depth".
        origin: for data far from 0, the point that poses and points are relative to, in the coordinates of
            the files, [3] float64; None if they are as in the files.
        fisheye: coefficients k1 to k4 of each camera (see `gsjax.geometry.cameras.Camera`), [N,4] float64;
            None for pinholes.
        layout: name of the layout of its files, such as "COLMAP"; empty if it was not opened with
            `open_photographs`.

    Raises:
        ValueError: shapes disagree, a pose is not a rigid motion, the background is not from 0 to 1, or there
            is no photograph.
    """

    name: str
    names: tuple[str, ...]
    sizes: Int[np.ndarray, "..."]
    Ks: Float[np.ndarray, "..."]
    viewmats: Float[np.ndarray, "..."]
    load_image: Callable[[int], np.ndarray] = field(repr=False)
    load_mask: Callable[[int], np.ndarray | None] | None = field(default=None, repr=False)
    load_depth: Callable[[int], np.ndarray | None] | None = field(default=None, repr=False)
    load_labels: Callable[[int], np.ndarray | None] | None = field(default=None, repr=False)
    label_names: Mapping[int, str] = field(default_factory=dict)
    times: Float[np.ndarray, "..."] | None = None
    splits: tuple[str, ...] | None = None
    cloud: Cloud | None = field(default=None, repr=False)
    background: tuple[float, float, float] | None = None
    near: float = NEAR
    locate: Callable[[str, int], str] | None = field(default=None, repr=False)
    origin: Float[np.ndarray, "..."] | None = None
    fisheye: Float[np.ndarray, "..."] | None = None
    layout: str = ""

    def __post_init__(self):
        count = len(self.names)
        if count == 0:
            raise ValueError(f"{self.name}: expected at least one photograph, found none.")
        check_shape("sizes", self.sizes, (count, 2))
        check_shape("Ks", self.Ks, (count, 3, 3))
        check_shape("viewmats", self.viewmats, (count, 4, 4))
        if self.origin is not None:
            check_shape("origin", self.origin, (3,))
        if self.fisheye is not None:
            check_shape("fisheye", self.fisheye, (count, 4))
        for name in ("times", "splits"):
            if getattr(self, name) is not None:
                check_shape(name, np.asarray(getattr(self, name)), (count,))
        check_background(self.background)
        check_intrinsics(self.Ks[:, None], lambda i, _: self.names[i])
        check_poses("viewmat", self.viewmats[:, None], lambda i, _: self.names[i], _POSE_ADVICE)

    def __repr__(self) -> str:
        sizes = {f"{width}x{height}" for width, height in self.sizes.tolist()}
        size = sizes.pop() if len(sizes) == 1 else "several sizes"
        loaders = {"depth": self.load_depth, "masks": self.load_mask, "labels": self.load_labels}
        there = [name for name, loader in loaders.items() if loader is not None]
        return f"Photographs({self.name}: {self.num} of {size}{', with ' * bool(there)}{', '.join(there)})"

    @property
    def num(self) -> int:
        """Number of photographs, N."""
        return len(self.names)

    def camera(self, i: int) -> Camera:
        """The camera of photograph `i`, in JAX's default float type."""
        return on_device(jax.tree.map(lambda a: a[0], self._cameras(i)))

    def frame(self, i: int) -> Frame:
        """Photograph `i` as a frame of one camera, on the host: RGB in bytes, poses in float64.

        Raises:
            DataError: as for `image`.
        """
        mask, depth = self.mask(i), self.depth(i)
        return Frame(
            self.image(i)[None],
            None if depth is None else depth[None],
            self._cameras(i),
            None if mask is None else mask[None],
        )

    def _cameras(self, i: int) -> Camera:
        """The camera of photograph `i` as a batch of one, on the host."""
        width, height = (int(size) for size in self.sizes[i])
        fisheye = None if self.fisheye is None else self.fisheye[i][None]
        return Camera(self.viewmats[i][None], self.Ks[i][None], width, height, self.near, fisheye)

    def image(self, i: int) -> UInt8[np.ndarray, "height width 3"]:
        """RGB.

        Raises:
            DataError: the file is unreadable, or the loader returned another shape or type.
        """
        image = np.asarray(self.load_image(i))
        self._check("image", i, image, (3,), np.uint8)
        return image

    def mask(self, i: int) -> Bool[np.ndarray, "height width"] | None:
        """Which pixels count; None if all do.

        Raises:
            DataError: as for `image`.
        """
        return self._optional(self.load_mask, "mask", i, np.bool_)

    def depth(self, i: int) -> Float[np.ndarray, "height width"] | None:
        """Depth along the optical axis, or distance from a fisheye, float32, 0 = invalid; None without depth.

        Raises:
            DataError: as for `image`.
        """
        depth = self._optional(self.load_depth, "depth", i, np.floating)
        return None if depth is None else usable_depth(depth)

    def labels(self, i: int) -> Integer[np.ndarray, "height width"] | None:
        """Label of each pixel, 0 for the background; None without labels.

        Raises:
            DataError: as for `image`.
        """
        return self._optional(self.load_labels, "labels", i, np.integer)

    def select(self, indices: Indices[int] | np.ndarray) -> "Photographs":
        """The photographs at these indices, in this order, or where a mask is True.

        Raises:
            ValueError: a mask has another length, or there is no photograph left.
            IndexError: there is no such photograph.
        """
        chosen = positions_of(indices, self.num)
        locate = self.locate
        return replace(
            self,
            names=tuple(self.names[i] for i in chosen),
            sizes=self.sizes[chosen],
            Ks=self.Ks[chosen],
            viewmats=self.viewmats[chosen],
            load_image=lambda i: self.load_image(chosen[i]),
            load_mask=self.load_mask and (lambda i: self.mask(chosen[i])),
            load_depth=self.load_depth and (lambda i: self.depth(chosen[i])),
            load_labels=self.load_labels and (lambda i: self.labels(chosen[i])),
            times=None if self.times is None else self.times[chosen],
            splits=None if self.splits is None else tuple(self.splits[i] for i in chosen),
            fisheye=None if self.fisheye is None else self.fisheye[chosen],
            locate=locate and (lambda kind, i: locate(kind, chosen[i])),
        )

    def scaled(self, scale: float | Float[np.ndarray, "views"]) -> "Photographs":
        """The same views downscaled: colours are averaged over the area of each new pixel; masks, depths and
        labels are sampled at its centre.

        Args:
            scale: one for all photographs, or one for each.

        Raises:
            ValueError: a scale is not above 0 and at most 1.
        """
        scales = np.broadcast_to(scale, self.num)
        for one in np.unique(scales):
            check_scale(float(one))
        if (scales == 1).all():
            return self
        sizes = np.maximum(1, np.round(self.sizes * scales[:, None]).astype(int))
        factors = np.concatenate([sizes / self.sizes, np.ones((self.num, 1))], axis=1)

        def size(i: int) -> tuple[int, int]:
            return tuple(sizes[i].tolist())

        return replace(
            self,
            sizes=sizes,
            Ks=self.Ks * factors[:, :, None],
            load_image=area_resized(self.image, size),
            load_mask=nearest_resized(self.load_mask and self.mask, size),
            load_depth=nearest_resized(self.load_depth and self.depth, size),
            load_labels=nearest_resized(self.load_labels and self.labels, size),
        )

    def where(self, kind: str, i: int) -> str:
        """Name of a photograph's image, mask, labels or depth in messages: its path, if it has one."""
        return f"{self.name}, {kind} {self.names[i]}" if self.locate is None else self.locate(kind, i)

    def _optional(self, loader: Callable | None, kind: str, i: int, dtype: type) -> np.ndarray | None:
        loaded = None if loader is None else loader(i)
        if loaded is not None:
            self._check(kind, i, loaded, (), dtype)
        return loaded

    def _check(self, kind: str, i: int, array: np.ndarray, channels: tuple[int, ...], dtype: type) -> None:
        width, height = (int(size) for size in self.sizes[i])
        check_loaded(self.where(kind, i), array, (height, width, *channels), dtype)


def photographs_of(sequence: Sequence) -> Photographs:
    """All frames of all cameras of a recording as photographs, frame by frame."""
    frames, cameras = sequence.num_frames, sequence.num_cameras
    views = [(t, c) for t in range(frames) for c in range(cameras)]
    names = (f"{sequence.camera_ids[c]}/{sequence.frame_ids[t]}" for t, c in views)
    return Photographs(
        name=sequence.name,
        names=tuple(names),
        sizes=np.tile([sequence.width, sequence.height], (len(views), 1)),
        Ks=sequence.Ks.reshape(-1, 3, 3),
        viewmats=sequence.viewmats.reshape(-1, 4, 4),
        load_image=lambda i: sequence.image(*views[i]),
        load_depth=(lambda i: sequence.depth(*views[i])) if sequence.has_depth else None,
        load_labels=(lambda i: sequence.mask(*views[i])) if sequence.has_masks else None,
        label_names=sequence.names_of_labels,
        times=np.repeat(sequence.times, cameras) if frames > 1 else None,
        splits=None if sequence.splits is None else tuple(sequence.splits[t] for t, _ in views),
        background=sequence.background,
        near=sequence.near,
        origin=sequence.origin,
        layout=sequence.layout,
        locate=lambda kind, i: sequence.where("mask" if kind == "labels" else kind, *views[i]),
    )
