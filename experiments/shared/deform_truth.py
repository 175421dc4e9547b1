"""True answers to ten types of question about simulated tissue, from the simulation's labels, depth, tracks
and poses. Independent code: it shares nothing with the answerer under test."""

from collections.abc import Callable
from dataclasses import dataclass
from functools import cache, cached_property
from typing import Any

import cv2
import numpy as np
from jaxtyping import Float, Int
from scipy.spatial import cKDTree

import gsjax
from experiments.shared.deform_regions import REGIONS, region_map
from experiments.shared.deforming import TOOL, Dataset, lifted, pixels_in, split
from gsjax.methods.deform import Question
from gsjax.scene.frame import Frame

NAMES = ("background", *(f"patch {i}" for i in range(1, REGIONS + 1)), "tool")
THE_TOOL = len(NAMES) - 1
TOUCH_MM, STILL_MM, LEAST_SHARE = 2.0, 1.0, 1e-3
_SEEN_WITHIN_M = 1e-3
_EDGE_M, _OFF_VERTICES_M = 3e-3, 5e-3


def built_in(seed: int) -> Dataset:
    """The built-in tissue, with its truth in the format of tissue_0."""
    sequence = gsjax.open_sequence(f"simulated:tissue?seed={seed}&width=160&height=128&frames=40")
    truth = sequence.truth
    assert truth is not None
    assert truth.tracks is not None
    assert truth.poses is not None
    grid = np.linspace(0, 1, round(np.sqrt(truth.tracks.shape[1])))
    uv = np.stack(np.meshgrid(grid, grid, indexing="ij"), axis=-1).reshape(-1, 2)
    seg = np.stack([1 + (sequence.mask(t, 0) == TOOL) for t in range(sequence.num_frames)])
    arrays = {"verts": truth.tracks, "uv": uv, "seg": seg, "T_w_tool": truth.poses[:, 0]}
    return Dataset(sequence, *split(sequence.num_frames), arrays)


@dataclass(frozen=True, eq=False)
class Truth:
    """Ground truth of a simulated recording, in views of the left eye."""

    data: Dataset

    @property
    def count(self) -> int:
        return self.data.sequence.num_frames

    @cached_property
    def frames(self) -> list[Frame]:
        """Frames of the left eye, tools included."""
        return [self.data.frame(t, tools=True) for t in range(self.count)]

    def pose(self, t: int) -> tuple[Float[np.ndarray, "4 4"], Float[np.ndarray, "3 3"]]:
        """View matrix and intrinsics of the left eye in a frame."""
        camera = self.frames[t].cameras
        return camera.viewmat[0], camera.K[0]

    @cached_property
    def depths(self) -> Float[np.ndarray, "t h w"]:
        """Metres, 0 where unknown."""
        return np.concatenate([frame.depths for frame in self.frames])

    @cached_property
    def labels(self) -> Int[np.ndarray, "t h w"]:
        """Rows of `NAMES` of each pixel."""
        maps = np.stack([region_map(self.data, t) for t in range(self.count)])
        return np.where(maps < 0, THE_TOOL, maps)

    @cached_property
    def pieces(self) -> list[list[Int[np.ndarray, "h w"]]]:
        """Connected pieces of each frame and class: their numbers in a label image, 0 elsewhere; small pieces
        are left out."""
        return [[_pieces(labels == k) for k in range(len(NAMES))] for labels in self.labels]

    def points(self, t: int, k: int) -> Float[np.ndarray, "n 3"]:
        """World points of a class that frame `t` shows."""
        depth = self.depths[t]
        return lifted(depth, (self.pieces[t][k] > 0) & (depth > 0), *self.pose(t))

    def surface(self, t: int, k: int) -> Float[np.ndarray, "n 3"]:
        """`points` without those whose label and depth belong to two surfaces, as on an edge: tissue is near
        its vertices, and a tool is no deeper than in adjacent pixels."""
        found = self.points(t, k)
        if k not in (0, THE_TOOL):
            return found[cKDTree(self.data.truth["verts"][t]).query(found)[0] < _OFF_VERTICES_M]
        depth, shown = self.depths[t], self.pieces[t][k] > 0
        beside = cv2.erode(np.where(shown, depth, 9.0).astype(np.float32), np.ones((3, 3), np.uint8))
        return found[(depth - beside < _EDGE_M)[shown & (depth > 0)]]

    @cache  # noqa: B019 (as long as the truth is needed, gaps are)
    def _tree(self, t: int, k: int) -> cKDTree | None:
        found = self.surface(t, k)
        return cKDTree(found) if len(found) else None

    @cache  # noqa: B019
    def gap(self, t: int, i: int, j: int) -> float:
        """Millimetres between the visible points of two classes in a frame; NaN where one is not in view."""
        trees = [tree for k in (i, j) if (tree := self._tree(t, k)) is not None]
        if len(trees) < 2:
            return np.nan
        few, many = sorted(trees, key=lambda tree: tree.n)
        return 1e3 * float(many.query(few.data)[0].min())

    def way(self, k: int, f: int, g: int) -> Float[np.ndarray, "n 3"] | None:
        """Displacements in millimetres, from frame `f` to frame `g`, of a class's points visible in `f`; None
        without any."""
        if k in (0, THE_TOOL):  # stand still, or turn as a whole
            start = self.points(f, k)
            pose = self.data.truth["T_w_tool"]
            turn = pose[g] @ np.linalg.inv(pose[f]) if k == THE_TOOL else np.eye(4)
            end = start @ turn[:3, :3].T + turn[:3, 3]
        else:
            verts = self.data.truth["verts"]
            column, row, depth, inside = pixels_in(verts[f], self.frames[f])
            near = np.abs(self.depths[f][row, column] - depth) < _SEEN_WITHIN_M
            seen = inside & near & (self.pieces[f][k][row, column] > 0)
            start, end = verts[f][seen], verts[g][seen]
        return 1e3 * (end - start) if len(start) else None

    def answer(self, asked: Question) -> Any:
        """The true value; None where an object in question is not in view."""
        kind, things, frames = asked.kind, asked.things, asked.frames
        t, k = (frames or (0,))[0], things[0]
        pieces = self.pieces[t][k]
        if kind == "when":
            return self._when(things, asked.event)
        if kind == "presence":
            return bool(pieces.any())
        if kind == "count":
            return int(pieces.max())
        if kind == "touch":
            return bool(self.gap(t, *things) < TOUCH_MM)
        if kind == "distance":
            gap = self.gap(t, *things)
            return float(gap) if np.isfinite(gap) else None
        if kind in ("motion", "direction"):
            way = self.way(k, *frames)
            if way is None:
                return None
            if kind == "motion":
                return float(np.median(np.linalg.norm(way, axis=1)))
            return _direction(self.pose(t)[0][:3, :3] @ way.mean(axis=0))
        if not all(self.pieces[t][one].any() for one in things):
            return None
        if kind == "place":
            rows, columns = np.nonzero(pieces)
            return _part((columns.mean() + 0.5) / pieces.shape[1], (rows.mean() + 0.5) / pieces.shape[0])
        depths = [self._depth(t, one) for one in things]
        return depths[0] if kind == "depth" else NAMES[things[int(np.argmin(depths))]]

    def _depth(self, t: int, k: int) -> float:
        depth = self.depths[t]
        return 1e3 * float(np.median(depth[(self.pieces[t][k] > 0) & (depth > 0)]))

    def _when(self, things: tuple[int, ...], event: str) -> int | None:
        """The frame of an event; None where it never happens."""
        k = things[0]
        there = [t for t in range(self.count) if self.pieces[t][k].any()]
        of: dict[str, Callable[[], dict[int, float]]] = {
            "first seen": lambda: dict.fromkeys(there, 0.0),
            "touch": lambda: {t: 0.0 for t in there if self.gap(t, *things) < TOUCH_MM},
            "nearest": lambda: {t: self._depth(t, k) for t in there},
            "fastest": lambda: {t: -speed for t in there if (speed := self._speed(k, t)) is not None},
        }
        scores = of[event]()
        return min(scores, key=lambda t: (scores[t], t)) if scores else None

    def _speed(self, k: int, t: int) -> float | None:
        way = self.way(k, t, t + 1) if t + 1 < self.count else None
        return None if way is None else float(np.median(np.linalg.norm(way, axis=1)))


def _pieces(mask: np.ndarray) -> Int[np.ndarray, "h w"]:
    _, found, about, _ = cv2.connectedComponentsWithStats(mask.astype(np.uint8), connectivity=8)
    pieces = np.zeros_like(found)
    for number, size in enumerate(about[1:, cv2.CC_STAT_AREA], 1):
        if size >= LEAST_SHARE * mask.size:
            pieces[found == number] = pieces.max() + 1
    return pieces


def _part(x: float, y: float) -> str:
    column = "left" if x < 1 / 3 else "middle" if x < 2 / 3 else "right"
    row = "upper" if y < 1 / 3 else "middle" if y < 2 / 3 else "lower"
    return "centre" if (row, column) == ("middle", "middle") else f"{row} {column}"


def _direction(shift: np.ndarray) -> str:
    """The word for millimetres right, down, forward."""
    if np.linalg.norm(shift) < STILL_MM:
        return "still"
    words = {"right": shift[0], "left": -shift[0], "down": shift[1], "up": -shift[1], "away": shift[2]}
    words["towards"] = -shift[2]
    return max(words, key=lambda word: words[word])
