"""The result of a reconstruction: the scene at any time, its cameras, and queries."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from gsjax.geometry.cameras import Camera
from gsjax.methods.deform.meaning import Meaning, text_prompt
from gsjax.methods.deform.poses import times_of
from gsjax.methods.deform.query import prompt_probabilities
from gsjax.methods.deform.update import DeformingScene, Moving
from gsjax.methods.protocols import LanguageEncoder
from gsjax.scene.frame import Frame
from gsjax.scene.gaussians import Gaussians


class Timeline(NamedTuple):
    """Times and cameras of the frames of a recording.

    Attributes:
        times: times of the frames, 0 to 1.
        frame_ids: frame numbers in the recording.
        seconds: duration of the recording.
        viewmats: view matrices of the training camera in each frame: world to camera, OpenCV axes; refined
            if poses were.
        Ks: its intrinsics, pixels.
        size: width and height of its images, pixels.
        near: distance of its near plane, metres.
        held_out: indices of the held-out frames.
        metric: whether the unit of length is the metre.
    """

    times: Float[np.ndarray, "T"]
    frame_ids: Int[np.ndarray, "T"]
    seconds: float
    viewmats: Float[np.ndarray, "T 4 4"]
    Ks: Float[np.ndarray, "T 3 3"]
    size: tuple[int, int]
    near: float
    held_out: Int[np.ndarray, "held"]
    metric: bool = True


def timeline_of(frames: Sequence[Frame]) -> Timeline:
    """A timeline from frames alone: numbered from 0, one second long, and metric if any frame has depth."""
    cameras = jax.tree.map(
        lambda *arrays: np.concatenate(arrays).astype(np.float64), *(frame.cameras for frame in frames)
    )
    view = (cameras.viewmat, cameras.K, (cameras.width, cameras.height), cameras.near)
    metric = any(frame.depths is not None for frame in frames)
    return Timeline(times_of(frames), np.arange(len(frames)), 1.0, *view, np.zeros(0, int), metric)


@dataclass(frozen=True, eq=False)
class DeformResult:
    """A deforming scene, the content of deformation.npz (`gsjax.engine.deform.file`).

    Attributes:
        scene: canonical Gaussians and their deformation field.
        moving: where the field is evaluated: at nodes, at some Gaussians, or at all.
        meaning: meaning of the features; None without.
        timeline: the frames of the recording.
    """

    scene: DeformingScene
    moving: Moving
    meaning: Meaning | None
    timeline: Timeline

    def __repr__(self) -> str:
        frames = f"{len(self.timeline.times)} frames"
        meant = "" if self.meaning is None else f", with meaning: {', '.join(self.names) or 'features'}"
        return f"DeformResult({self.scene.gaussians.num:,} Gaussians, {frames}{meant})"

    def at(self, time: float) -> Gaussians:
        """The scene at a time, 0 to 1."""
        return _at(self.scene, jnp.asarray(time, jnp.float32), self.moving)

    def features_at(self, times: Sequence[float] | Float[np.ndarray, "T"]) -> Float[Array, "T n c"]:
        """Features of all Gaussians at some times, 0 to 1.

        Raises:
            ValueError: the scene has no features.
        """
        self._expect_features()
        rows = jnp.arange(self.scene.gaussians.num)
        return _features_at(self.scene, jnp.asarray(times, jnp.float32), rows, self.moving)

    def query(
        self,
        text: str,
        time: float = 0.0,
        *,
        negatives: tuple[str, ...] | None = None,
        encoder: Callable[[], LanguageEncoder] | None = None,
    ) -> Float[Array, "n"]:
        """Scores of Gaussians for a text, at a time; see `Prompt.scores`.

        Args:
            text: one of `names`, or a text for the encoder of the features.
            time: 0 to 1; irrelevant unless features change over time.
            negatives, encoder: as for `text_prompt`.

        Raises:
            ValueError: the scene has no features with a meaning, or as for `text_prompt`.
            FileNotFoundError: the encoder's weights are missing.
        """
        meaning = self._expect_features()
        return text_prompt(meaning, text, negatives, encoder).scores(self.features_at([time])[0])

    def probabilities(self, time: float = 0.0) -> Float[Array, "n names"]:
        """Probability of each of `names` for each Gaussian at a time, 0 to 1; see `prompt_probabilities`.

        Raises:
            ValueError: the scene has no features with a meaning.
        """
        meaning = self._expect_features()
        features = self.features_at([time])[0]
        return prompt_probabilities(features, jnp.asarray(meaning.codebook, features.dtype))

    def camera(self, frame: int) -> Camera:
        """The camera at a frame, 0 to T - 1, as a batch of one."""
        timeline = self.timeline
        viewmat, K = (jnp.asarray(a[frame], jnp.float32)[None] for a in (timeline.viewmats, timeline.Ks))
        return Camera(viewmat, K, *timeline.size, timeline.near)

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the features' codebook; none without a meaning."""
        return () if self.meaning is None else self.meaning.names

    @property
    def meaning_changes(self) -> bool:
        """Whether features change over time."""
        return self.scene.field is not None and self.scene.field.config.feature

    def _expect_features(self) -> Meaning:
        if self.meaning is None or self.scene.gaussians.features is None:
            raise ValueError(
                "features: expected a scene that learned from a teacher, found none; it needs two "
                'classes of masks (tools="draw" makes the tools one) or another teacher'
            )
        return self.meaning


_at, _features_at = jax.jit(DeformingScene.at), jax.jit(DeformingScene.features_at)
