"""What a viewer shows: Gaussians, where they go, their names, who photographed them, and how to edit them."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Literal, NamedTuple

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool, Float, Int

from gsjax.scene.gaussians import Gaussians, take, valid_rows
from gsjax.scene.selection import only

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
class Motion:
    """How a scene changes from frame to frame; `moved` makes it from arrays.

    Attributes:
        num_frames: how many there are.
        num_moving: so many Gaussians, from the first on, may differ between frames, but for their colours.
        at: frame -> all Gaussians.
    """

    num_frames: int
    num_moving: int
    at: Callable[[int], Gaussians] = field(repr=False)


def moved(gaussians: Gaussians, means: Float[np.ndarray, "..."], quats: Float[np.ndarray, "..."]) -> Motion:
    """The first M Gaussians go elsewhere in each frame, and the others stand still.

    Args:
        gaussians: N of them.
        means: centres of the first M, [T,M,3].
        quats: their orientations, [T,M,4].

    Raises:
        ValueError: shapes disagree.
    """
    frames, moving = means.shape[:2]
    if frames == 0 or moving > gaussians.num:
        raise ValueError(f"means: got shape {means.shape}, want [T,M,3], T from 1 on, M to {gaussians.num}")
    _check("means", means, (frames, moving, 3))
    _check("quats", quats, (frames, moving, 4))

    def at(frame: int) -> Gaussians:
        there = jnp.asarray(gaussians.means).at[:moving].set(means[frame])
        turned = jnp.asarray(gaussians.quats).at[:moving].set(quats[frame])
        return eqx.tree_at(lambda g: (g.means, g.quats), gaussians, (there, turned))

    return Motion(frames, moving, at)


@dataclass(frozen=True, eq=False)
class Editing:
    """How a scene can be edited. An edit is a line of text; they are done one after the other.

    Attributes:
        operations: by name, lines that say what each does and what it wants.
        parts: what lines call the things that can be edited, by what to call them on the page.
        cameras: names of those that can film; the first does unless told otherwise.
        begin: (operation, part) -> a line to begin with.
        preview: lines -> what they make of the scene. A ValueError or an OSError of it says what cannot be
            done, as do those of `save`.
        save: (lines, name, camera, goes_on) -> where the film is kept that they make; none is written over.
            `goes_on(done, asked)` is asked after each frame, and ends the film where it is False.
    """

    operations: Mapping[str, Sequence[str]]
    parts: Mapping[str, str]
    cameras: tuple[str, ...]
    begin: Callable[[str, str], str]
    preview: Callable[[Sequence[str]], "Preview"]
    save: Callable[[Sequence[str], str, str, Callable[[int, int], bool]], Path]


class Found(NamedTuple):
    """The answer to a question.

    Attributes:
        what: was asked for, in a few words.
        scores: of each Gaussian, [N].
        threshold: from which on they are meant.
        rule: by which that is so.
        seconds: that it took.
    """

    what: str
    scores: Float[np.ndarray, "..."]
    threshold: float
    rule: str
    seconds: float


Showing = Literal["heat of the scores", "only what was found", "all but that", "the scene"]
"""What is shown of an answer."""


@dataclass(frozen=True, eq=False)
class Asking:
    """How a scene can be asked. A ValueError of it says what cannot be answered.

    Attributes:
        hint: what can be asked for.
        ask: (text, frame) -> the answer. Only what means something else in each frame looks at the frame.
        like: (row of a Gaussian, frame) -> the answer to "what is like it".
        save: (which Gaussians [N], a name, frame) -> where they are kept as a PLY file, as they are in that
            frame; none is written over.
    """

    hint: str
    ask: Callable[[str, int], Found]
    like: Callable[[int, int], Found]
    save: Callable[[Bool[np.ndarray, "n"], str, int], Path]


@dataclass(frozen=True, eq=False)
class Viewable:
    """A scene to look at. What it does not have is None, and the page does not offer it.

    Attributes:
        title: what to call it.
        gaussians: the scene, of the first frame where there is time; rows that cannot be drawn are an error.
        labels: of each Gaussian, [N] integers; 0 is the background.
        names: of the labels.
        motion: where they go, in T frames.
        times: seconds of each frame, [T].
        shots: the photographs.
        up: which way is up, [3]; taken from the photographs, else +z, unless given.
        background: RGB behind the scene, 0 to 1.
        antialiased: whether it was fitted with `rasterize_mode="antialiased"`.
        unit: of lengths, as in "m"; empty where only their proportions are known.
        editing: how it can be edited.
        asking: how it can be asked, where it cannot be edited.

    Raises:
        ValueError: shapes disagree, there is no Gaussian, or one holds a number that is not finite.
    """

    title: str
    gaussians: Gaussians
    labels: Int[np.ndarray, "..."] | None = None
    names: Mapping[int, str] = field(default_factory=dict)
    motion: Motion | None = None
    times: Float[np.ndarray, "..."] | None = None
    shots: Shots | None = None
    up: Float[np.ndarray, "..."] | None = None
    background: tuple[float, float, float] = (0.0, 0.0, 0.0)
    antialiased: bool = False
    unit: str = ""
    editing: Editing | None = None
    asking: Asking | None = None

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
        if self.times is not None:
            _check("times", self.times, (self.num_frames,))

    @property
    def num_frames(self) -> int:
        """How many frames there are; 1 where nothing moves."""
        return 1 if self.motion is None else self.motion.num_frames

    @property
    def num_moving(self) -> int:
        """How many Gaussians, from the first on, may differ from frame to frame."""
        return 0 if self.motion is None or self.num_frames == 1 else self.motion.num_moving

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
        gaussians = self.gaussians if self.motion is None else self.motion.at(frame)
        return eqx.tree_at(lambda g: g.features, gaussians, None, is_leaf=lambda leaf: leaf is None)

    def name_of(self, index: int) -> str | None:
        """What the thing is called that a Gaussian belongs to; None without labels."""
        if self.labels is None:
            return None
        label = int(self.labels[index])
        return self.names.get(label, "background" if label == 0 else f"object {label}")


def redone(
    scene: Viewable, change: Callable[[Gaussians], Gaussians], kept: Bool[np.ndarray, "n"] | None = None
) -> Viewable:
    """A scene with something done to its Gaussians in each frame.

    Args:
        scene: to be changed.
        change: what is done; it does not change how many there are.
        kept: which are left of them afterwards; all unless given.
    """

    def done(gaussians: Gaussians) -> Gaussians:
        gaussians = change(gaussians)
        return gaussians if kept is None else only(gaussians, kept)

    labels, motion = scene.labels, scene.motion
    if kept is not None and labels is not None:
        labels = labels[kept]
    if motion is not None:
        moving = motion.num_moving if kept is None else int(kept[: motion.num_moving].sum())
        at = motion.at
        motion = Motion(motion.num_frames, moving, lambda frame: done(at(frame)))
    return replace(scene, gaussians=done(scene.gaussians), labels=labels, motion=motion)


class Preview(NamedTuple):
    """What edits make of a scene.

    Attributes:
        scene: to look at.
        doubts: what may look wrong in it, a sentence each.
    """

    scene: Viewable
    doubts: Sequence[str] = ()


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
