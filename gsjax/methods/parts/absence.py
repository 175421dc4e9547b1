"""Parts that are absent from some frames: they have left, or have yet to appear. In these frames, pictures
show other colours in their places, and are explained better without them."""

from functools import partial

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from gsjax.methods.parts.config import PartsConfig, StreamConfig
from gsjax.methods.parts.discovery import Discovery
from gsjax.methods.parts.pictures import Problem, coarse_frame, with_part_masks
from gsjax.methods.parts.search import POINTS, color_differences, colors_of, most_visible
from gsjax.methods.parts.stream import Canonical, image_loss, posed
from gsjax.methods.parts.trajectory import BACKGROUND
from gsjax.optim.compiler import host_jit
from gsjax.rasterize.plan import Plan, with_room
from gsjax.scene.frame import Frame, one_camera
from gsjax.scene.handles import skin
from gsjax.scene.render import plan_render, render

# Factor on the anchor's colour difference, and offset, above which a part may be absent.
_MISMATCH = (1.5, 0.05)
_CAMERAS = 4  # of a frame, for which it is rendered with and without the part
_CONCLUSIVE = 0.98  # share of the larger loss below which the smaller one is conclusive
_FRAMES = 2  # in succession from which a part is absent, at least


def absences(problem: Problem, discovery: Discovery, config: PartsConfig) -> Bool[np.ndarray, "T P"] | None:
    """The frames from which each part is absent; None if no part ever is.

    Each part is tested twice in each frame. The first test compares the colours at the projections of its
    Gaussians, as in the search for parts that jump. If these match clearly worse than at the anchor, the
    frame is rendered with the part and without it. If that is inconclusive, as for an occluded part, the part
    is present if it was in the neighbouring frame towards the anchor, in which all parts are.

    Args:
        problem: the recording.
        discovery: the discovery of all frames, with its final weights.
        config: settings.
    """
    canonical, blend = discovery.canonical, config.stream.blend
    labels = np.asarray(discovery.weights).argmax(-1)
    parts = [part for part in np.unique(labels).tolist() if part != BACKGROUND]
    rows = {part: np.resize(most_visible(canonical.movable, labels == part), POINTS) for part in parts}
    colors, explained = colors_of(canonical.movable), _AbsenceTest(problem, discovery, config)
    anchor = coarse_frame(problem, discovery, discovery.anchor)
    means = np.asarray(canonical.movable.means)
    usual = {part: color_differences(anchor, means[mine], colors[mine])[0] for part, mine in rows.items()}
    absent = np.zeros(discovery.quats.shape[:2], bool)
    for t in np.argsort(discovery.found)[-discovery.count :].tolist():  # away from the anchor
        before = t - 1 if t > discovery.anchor else t + 1
        frame, pose = coarse_frame(problem, discovery, t), discovery.pose(t)
        moved = skin(canonical.movable, discovery.weights, canonical.centers, pose, blend)
        places = np.asarray(moved.means)
        for part, mine in rows.items():
            here = color_differences(frame, places[mine], colors[mine])[0]
            if here > _MISMATCH[0] * usual[part] + _MISMATCH[1]:
                better = explained.without(frame, t, part)
                absent[t, part] = absent[before, part] if better is None else better
    absent = without_blips(absent, discovery.done)
    return absent if absent.any() else None


def without_blips(absent: Bool[np.ndarray, "T P"], done: Bool[np.ndarray, "T"]) -> Bool[np.ndarray, "T P"]:
    """The absences without those of a single frame, between frames in which the part is present.

    Args:
        absent: the frames from which each part is absent.
        done: the frames that were found.
    """
    kept = absent.copy()
    found = np.flatnonzero(done)
    for part in np.flatnonzero(absent.any(0)).tolist():
        there = absent[found, part]
        edges = np.flatnonzero(np.diff(np.concatenate([[False], there, [False]])))
        for begin, end in edges.reshape(-1, 2).tolist():
            if end - begin < min(_FRAMES, len(found) - 1):
                kept[found[begin:end], part] = False
    return kept


def with_absences(discovery: Discovery, absent: Bool[np.ndarray, "T P"]) -> Discovery:
    """The discovery in which absent parts rest where they were last seen, or will first be seen.

    Args:
        discovery: the discovery of all frames.
        absent: from `absences`.
    """
    quats, translations = discovery.quats.copy(), discovery.translations.copy()
    for t, part in np.argwhere(absent):
        toward = 1 if t < discovery.anchor else -1
        near = next(s for s in range(t, discovery.anchor + toward, toward) if not absent[s, part])
        quats[t, part], translations[t, part] = quats[near, part], translations[near, part]
    return discovery._replace(quats=quats, translations=translations, absent=absent)


class _AbsenceTest:
    """Whether pictures are explained better without a part."""

    def __init__(self, problem: Problem, discovery: Discovery, config: PartsConfig):
        self._discovery, self._weights, self._blend = discovery, discovery.weights, config.stream.blend
        self._config, self._headroom = config.stream, 2 * config.headroom
        self._plan: Plan | None = None
        self._cameras = problem.sequence.num_cameras

    def without(self, frame: Frame, t: int, part: int) -> bool | None:
        """Whether the pictures of some cameras in a frame are; None if the losses hardly differ.

        Args:
            frame: all cameras, at the coarse size.
            t: index of the frame.
            part: index of the part.
        """
        canonical, pose = self._discovery.canonical, self._discovery.pose(t)
        seen = with_part_masks(frame, canonical, self._weights, pose, blend=self._blend)
        if self._plan is None:
            scene = posed(canonical, self._weights, pose, self._blend)
            self._plan = plan_render(scene, seen.cameras, headroom=self._headroom)
        shown = np.ones(len(canonical.alive), np.float32)
        losses = {}
        for opacity in (1.0, 0.0):
            shown[part] = opacity
            losses[opacity] = sum(
                self._of(one_camera(seen, c), pose, jnp.asarray(shown)) for c in self._chosen(t)
            )
        if min(losses.values()) > _CONCLUSIVE * max(losses.values()):
            return None
        return losses[0.0] < losses[1.0]

    def _of(self, frame: Frame, pose, shown: Float[Array, "P"]) -> float:
        canonical, weights, config = self._discovery.canonical, self._weights, self._config

        def draw(plan: Plan):
            return loss_of_picture(canonical, weights, pose, frame, plan, config, shown)

        loss, self._plan = with_room(draw, self._plan, self._headroom)
        return float(loss)

    def _chosen(self, t: int) -> list[int]:
        """The cameras to use in frame t, which change from frame to frame."""
        count = min(_CAMERAS, self._cameras)
        return sorted({(t + k * self._cameras // count) % self._cameras for k in range(count)})


@partial(host_jit, static_argnames=("plan", "config"))
def loss_of_picture(
    canonical: Canonical, weights, pose, frame: Frame, plan: Plan, config: StreamConfig, opacities=None
):
    """The loss of a picture of one camera, and what rendering it needed.

    Args:
        canonical, weights, pose: the scene; see `posed`.
        frame: the camera and its picture.
        plan: the render plan of the picture.
        config: settings.
        opacities: factors on the parts' opacities, or None.
    """
    scene = posed(canonical, weights, pose, config.blend, opacities=opacities)
    drawn = render(scene, frame.cameras, plan, roi=frame.masks)
    return image_loss(drawn, frame, config), drawn.meta
