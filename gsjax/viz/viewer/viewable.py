"""What a viewer shows, as arrays: Gaussians, where they go, their names, and who photographed them."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Literal

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float, Int

from gsjax.scene.gaussians import Gaussians, take, valid_rows

# Shapes of fields stand in the docstrings: constructors check them, and say more than an annotation could.

Coloring = Literal["colour", "depth", "label", "features"]


@dataclass(frozen=True, eq=False)
class Shots:
    """Cameras that took photographs of a scene. T is 1 where they stand still.

    Attributes:
        names: of each camera, V of them.
        viewmats: world to camera, OpenCV axes, [T,V,4,4].
        Ks: intrinsics in pixels, [T,V,3,3].
        sizes: width and height in pixels, [V,2].
        load_image: (t, v) -> RGB, [H,W,3] uint8; None where there are no pictures to show.

    Raises:
        ValueError: shapes disagree.
    """

    names: tuple[str, ...]
    viewmats: Float[np.ndarray, "..."]
    Ks: Float[np.ndarray, "..."]
    sizes: Int[np.ndarray, "..."]
    load_image: Callable[[int, int], np.ndarray] | None = field(default=None, repr=False)

    def __post_init__(self):
        frames, count = len(self.viewmats), len(self.names)
        _check("viewmats", self.viewmats, (frames, count, 4, 4))
        _check("Ks", self.Ks, (frames, count, 3, 3))
        _check("sizes", self.sizes, (count, 2))

    def at(self, frame: int) -> int:
        """The row of `viewmats` and `Ks` for a frame of the scene."""
        return min(frame, len(self.viewmats) - 1)


@dataclass(frozen=True, eq=False)
class Viewable:
    """A scene to look at. What it does not have is None, and the page does not offer it.

    Attributes:
        title: what to call it.
        gaussians: the scene, of the first frame where there is time; rows that cannot be drawn are an error.
        labels: of each Gaussian, [N] integers; 0 is the background.
        names: of the labels.
        means: centres of the first M Gaussians over time, [T,M,3]; the others stand still.
        quats: their orientations, [T,M,4].
        times: seconds of each frame, [T].
        shots: the photographs.
        up: which way is up, [3]; taken from the photographs, else +z, unless given.
        background: RGB behind the scene, 0 to 1.
        antialiased: whether it was fitted with `rasterize_mode="antialiased"`.
        unit: of lengths, as in "m"; empty where only their proportions are known.

    Raises:
        ValueError: shapes disagree, there is no Gaussian, or one holds a number that is not finite.
    """

    title: str
    gaussians: Gaussians
    labels: Int[np.ndarray, "..."] | None = None
    names: Mapping[int, str] = field(default_factory=dict)
    means: Float[np.ndarray, "..."] | None = None
    quats: Float[np.ndarray, "..."] | None = None
    times: Float[np.ndarray, "..."] | None = None
    shots: Shots | None = None
    up: Float[np.ndarray, "..."] | None = None
    background: tuple[float, float, float] = (0.0, 0.0, 0.0)
    antialiased: bool = False
    unit: str = ""

    def __post_init__(self):
        count = self.gaussians.num
        if count == 0:
            raise ValueError(f"{self.title}: expected Gaussians to look at, found none")
        if not valid_rows(self.gaussians).all():
            raise ValueError(
                f"{self.title}: some Gaussians hold a NaN, an infinity or a zero quaternion, which cannot be "
                "drawn; leave them out with gsjax.scene.gaussians.cull_invalid"
            )
        if self.labels is not None:
            _check("labels", self.labels, (count,))
        if (self.means is None) != (self.quats is None):
            raise ValueError("means and quats over time: expected both or none, found one of them")
        if self.means is not None:
            frames, moving = self.means.shape[:2]
            if frames == 0 or moving > count:
                raise ValueError(
                    f"means: got shape {self.means.shape}, want [T,M,3], T from 1 on, M to {count}"
                )
            _check("means", self.means, (frames, moving, 3))
            _check("quats", self.quats, (frames, moving, 4))
        if self.times is not None:
            _check("times", self.times, (self.num_frames,))

    @property
    def num_frames(self) -> int:
        """How many frames there are; 1 where nothing moves."""
        return 1 if self.means is None else len(self.means)

    @property
    def num_moving(self) -> int:
        """How many Gaussians, from the first on, may differ from frame to frame."""
        return 0 if self.means is None or self.num_frames == 1 else self.means.shape[1]

    @property
    def colorings(self) -> tuple[Coloring, ...]:
        """What Gaussians can be coloured by."""
        known: list[Coloring] = ["colour", "depth"]
        if self.labels is not None and (self.labels != self.labels[0]).any():
            known.append("label")
        if self.gaussians.features is not None:
            known.append("features")
        return tuple(known)

    def at(self, frame: int) -> Gaussians:
        """The Gaussians in a frame, without features, which are not drawn."""
        gaussians = eqx.tree_at(lambda g: g.features, self.gaussians, None, is_leaf=lambda leaf: leaf is None)
        if self.means is None or self.quats is None:
            return gaussians
        moving = self.means.shape[1]
        means = jnp.asarray(self.gaussians.means).at[:moving].set(self.means[frame])
        quats = jnp.asarray(self.gaussians.quats).at[:moving].set(self.quats[frame])
        return eqx.tree_at(lambda g: (g.means, g.quats), gaussians, (means, quats))

    def name_of(self, index: int) -> str | None:
        """What the thing is called that a Gaussian belongs to; None without labels."""
        if self.labels is None:
            return None
        label = int(self.labels[index])
        return self.names.get(label, "background" if label == 0 else f"object {label}")


def most_opaque(gaussians: Gaussians, count: int) -> Int[np.ndarray, "kept"]:
    """Rows of the `count` most opaque Gaussians, in their order; all where there are no more."""
    if gaussians.num <= count:
        return np.arange(gaussians.num)
    order = np.argsort(-np.asarray(gaussians.logit_opacities), kind="stable")
    return np.sort(order[:count])


def rows_of(gaussians: Gaussians, rows: Int[np.ndarray, "kept"]) -> Gaussians:
    """Some of the Gaussians; the same object where that is all of them."""
    return gaussians if len(rows) == gaussians.num else take(gaussians, rows)


def _check(name: str, array: np.ndarray, wanted: tuple[int, ...]) -> None:
    if np.shape(array) != wanted:
        raise ValueError(f"{name}: got shape {np.shape(array)}, want {wanted}")
