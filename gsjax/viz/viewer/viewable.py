"""What a viewer shows: Gaussians, their motion, names and photographs, and how to edit or query them."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Literal, NamedTuple

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool, Float, Int

from gsjax.geometry.cameras import NEAR
from gsjax.scene.gaussians import Gaussians, take, valid_rows
from gsjax.scene.selection import only

# The shapes of fields are in the docstrings: constructors check them with clearer messages than annotations.

Coloring = Literal["colour", "depth", "label", "features"]


@dataclass(frozen=True, eq=False)
class Shots:
    """Cameras that took photographs of a scene. T is 1 if they do not move.

    Attributes:
        names: names of the V cameras.
        viewmats: world to camera, OpenCV axes, [T,V,4,4].
        Ks: intrinsics in pixels, [T,V,3,3].
        sizes: width and height in pixels, [V,2].
        load_image: (t, v) -> RGB, [H,W,3] uint8; None if there are no pictures to show.
        near: distance of their near planes, metres: anything nearer was not fitted, and would hide the rest.

    Raises:
        ValueError: shapes disagree.
    """

    names: tuple[str, ...]
    viewmats: Float[np.ndarray, "..."]
    Ks: Float[np.ndarray, "..."]
    sizes: Int[np.ndarray, "..."]
    load_image: Callable[[int, int], np.ndarray] | None = field(default=None, repr=False)
    near: float = NEAR

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
        num_frames: number of frames.
        num_moving: the first `num_moving` Gaussians may differ between frames, except in colour.
        at: frame -> all Gaussians.
    """

    num_frames: int
    num_moving: int
    at: Callable[[int], Gaussians] = field(repr=False)


def moved(gaussians: Gaussians, means: Float[np.ndarray, "..."], quats: Float[np.ndarray, "..."]) -> Motion:
    """A motion of the first M Gaussians, while the others stand still.

    Args:
        gaussians: N Gaussians.
        means: centres of the first M, [T,M,3].
        quats: orientations of the first M, [T,M,4].

    Raises:
        ValueError: shapes disagree.
    """
    frames, moving = means.shape[:2]
    if frames == 0 or moving > gaussians.num:
        raise ValueError(
            f"means: expected shape [T,M,3], T at least 1 and M at most {gaussians.num}, found {means.shape}"
        )
    _check("means", means, (frames, moving, 3))
    _check("quats", quats, (frames, moving, 4))

    def at(frame: int) -> Gaussians:
        there = jnp.asarray(gaussians.means).at[:moving].set(means[frame])
        turned = jnp.asarray(gaussians.quats).at[:moving].set(quats[frame])
        return eqx.tree_at(lambda g: (g.means, g.quats), gaussians, (there, turned))

    return Motion(frames, moving, at)


@dataclass(frozen=True, eq=False)
class Editing:
    """How a scene can be edited. An edit is a line of text; edits are applied in order.

    Attributes:
        operations: name to help text: a line on what the operation does, then one line per key.
        parts: name on the page to name in edits, for each part that can be edited.
        cameras: names of the cameras that can film; the first is the default.
        begin: (operation, part) -> a template line.
        preview: lines -> the edited scene. It raises a ValueError or an OSError to report an edit that cannot
            be done, as does `save`.
        save: (lines, name, camera, goes_on) -> the path of the saved film; nothing is overwritten.
            `goes_on(done, total)` is called after each frame, and the film ends when it returns False.
    """

    operations: Mapping[str, Sequence[str]]
    parts: Mapping[str, str]
    cameras: tuple[str, ...]
    begin: Callable[[str, str], str]
    preview: Callable[[Sequence[str]], "Preview"]
    save: Callable[[Sequence[str], str, str, Callable[[int, int], bool]], Path]


class Answer(NamedTuple):
    """The answer to a query.

    Attributes:
        what: a short description of the query.
        scores: score of each Gaussian, [N].
        threshold: Gaussians with a higher score are selected.
        rule: how the threshold was chosen.
        seconds: time taken.
    """

    what: str
    scores: Float[np.ndarray, "..."]
    threshold: float
    rule: str
    seconds: float


Showing = Literal["heat of the scores", "only what was found", "all but that", "the scene"]
"""How an answer is shown."""


@dataclass(frozen=True, eq=False)
class Asking:
    """How a scene can be queried. The functions raise a ValueError to report a query that cannot be answered.

    Attributes:
        hint: what can be asked for.
        ask: (text, frame, level) -> the answer. The frame matters only for features that change over time;
            the level is None for the one that the text fits best.
        like: (row of a Gaussian, frame, level) -> the answer to "what is similar to it".
        save: (selected Gaussians [N], name, frame) -> the path of a PLY file with the Gaussians as they are
            in that frame; nothing is overwritten.
        levels: levels of the features, the smallest first; empty if there is only one.
    """

    hint: str
    ask: Callable[[str, int, str | None], Answer]
    like: Callable[[int, int, str | None], Answer]
    save: Callable[[Bool[np.ndarray, "n"], str, int], Path]
    levels: tuple[str, ...] = ()


@dataclass(frozen=True, eq=False)
class Viewable:
    """A scene to look at. Fields that do not apply are None, and the page does not offer them.

    Attributes:
        title: title of the page.
        gaussians: the scene, in its first frame if it moves; rows that cannot be drawn are an error.
        labels: label of each Gaussian, [N] integers; 0 is the background.
        names: label to name.
        motion: the motion over T frames.
        times: time of each frame in seconds, [T].
        shots: the photographs.
        up: the up direction, [3] (default: from the photographs, or +z without any).
        background: RGB behind the scene, 0 to 1.
        antialiased: whether the scene was fitted with `rasterize_mode="antialiased"`.
        unit: unit of lengths, such as "m"; empty if the scale is unknown.
        origin: the point that positions are relative to, [3] float64, if the data lie far from 0.
        editing: how the scene can be edited.
        asking: how the scene can be queried, if it cannot be edited.

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
    origin: Float[np.ndarray, "..."] | None = None
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

    def __repr__(self) -> str:
        frames = f", {self.num_frames} frames" if self.num_frames > 1 else ""
        return f"Viewable({self.title}: {self.gaussians.num:,} Gaussians{frames})"

    @property
    def near(self) -> float:
        """Distance of the near plane of its photographs' cameras, metres."""
        return NEAR if self.shots is None else self.shots.near

    @property
    def num_frames(self) -> int:
        """Number of frames; 1 if nothing moves."""
        return 1 if self.motion is None else self.motion.num_frames

    @property
    def num_moving(self) -> int:
        """Number of leading Gaussians that may differ from frame to frame."""
        return 0 if self.motion is None or self.num_frames == 1 else self.motion.num_moving

    @property
    def colorings(self) -> tuple[Coloring, ...]:
        """The available colorings."""
        known: list[Coloring] = ["colour", "depth"]
        if self.labels is not None and (self.labels != self.labels[0]).any():
            known.append("label")
        if self.gaussians.features is not None:
            known.append("features")
        return tuple(known)

    def at(self, frame: int) -> Gaussians:
        """The Gaussians in a frame, without features, which are not drawn.

        Raises:
            IndexError: there is no such frame.
        """
        if not 0 <= frame < self.num_frames:
            raise IndexError(f"{self.title}: expected a frame from 0 to {self.num_frames - 1}, found {frame}")
        gaussians = self.gaussians if self.motion is None else self.motion.at(frame)
        return eqx.tree_at(lambda g: g.features, gaussians, None, is_leaf=lambda leaf: leaf is None)

    def name_of(self, index: int) -> str | None:
        """Name of the object that a Gaussian belongs to; None without labels."""
        if self.labels is None:
            return None
        return self.name_of_label(int(self.labels[index]))

    def name_of_label(self, label: int) -> str:
        """Name of a label."""
        return self.names.get(label, "background" if label == 0 else f"object {label}")


def redone(
    scene: Viewable, change: Callable[[Gaussians], Gaussians], kept: Bool[np.ndarray, "n"] | None = None
) -> Viewable:
    """A scene with its Gaussians changed in the same way in every frame.

    Args:
        scene: the scene to change.
        change: the change; it must not change the number of Gaussians.
        kept: the Gaussians to keep afterwards (default: all).
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
    """The result of editing a scene.

    Attributes:
        scene: the edited scene.
        doubts: warnings about what may look wrong, one sentence each.
    """

    scene: Viewable
    doubts: Sequence[str] = ()


def most_opaque(gaussians: Gaussians, count: int) -> Int[np.ndarray, "kept"]:
    """Rows of the `count` most opaque Gaussians, in ascending order; all rows if there are no more."""
    if gaussians.num <= count:
        return np.arange(gaussians.num)
    order = np.argsort(-np.asarray(gaussians.logit_opacities), kind="stable")
    return np.sort(order[:count])


def rows_of(gaussians: Gaussians, rows: Int[np.ndarray, "kept"]) -> Gaussians:
    """The selected Gaussians; the same object if all are selected."""
    return gaussians if len(rows) == gaussians.num else take(gaussians, rows)


def _check(name: str, array: np.ndarray, wanted: tuple[int, ...]) -> None:
    if np.shape(array) != wanted:
        raise ValueError(f"{name}: expected shape {wanted}, found {np.shape(array)}")
