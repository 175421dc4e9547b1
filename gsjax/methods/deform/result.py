"""What a reconstruction is for: the scene at any time, from where it was seen, and what is what in it."""

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
    """The frames of a recording: when each was taken, and by which camera.

    Attributes:
        times: of the frames, 0 to 1.
        frame_ids: the recording's own numbers of the frames.
        seconds: how long the recording lasts.
        viewmats: of the camera that is learned from, in each frame: world to camera, OpenCV axes.
        Ks: its intrinsics, pixels.
        size: width and height of its pictures, pixels.
        near: what is nearer to it is not drawn, metres.
        held_out: indices of the frames that nothing is learned from.
        metric: whether lengths are metres.
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
    """The timeline of frames of which nothing else is known: they are numbered from 0 and last a second, and
    lengths are metres where any of them has depth."""
    camera = frames[0].cameras
    viewmats, Ks = (
        np.concatenate([np.asarray(getattr(frame.cameras, name), np.float64) for frame in frames])
        for name in ("viewmat", "K")
    )
    metric = any(frame.depths is not None for frame in frames)
    view = (viewmats, Ks, (camera.width, camera.height), camera.near)
    return Timeline(times_of(frames), np.arange(len(frames)), 1.0, *view, np.zeros(0, int), metric)


@dataclass(frozen=True, eq=False)
class DeformResult:
    """A deforming scene, as it lies in deformation.npz (`gsjax.engine.deform.file`).

    Attributes:
        scene: canonical Gaussians, and the field that moves them; None of a scene that stands still.
        moving: where the field is evaluated: at nodes, at some Gaussians, or at all.
        meaning: what features mean; None without.
        timeline: the frames of the recording, with the camera's poses as they were refined.
    """

    scene: DeformingScene
    moving: Moving
    meaning: Meaning | None
    timeline: Timeline

    def at(self, time: float) -> Gaussians:
        """The scene at a time, 0 to 1."""
        return _at(self.scene, self.moving, jnp.asarray(time, jnp.float32))

    def features_at(self, times: Sequence[float] | Float[np.ndarray, "T"]) -> Float[Array, "T n c"]:
        """Features of all Gaussians at some times.

        Args:
            times: 0 to 1.

        Raises:
            ValueError: the scene has no features.
        """
        self._expect_features()
        rows = jnp.arange(self.scene.gaussians.num)
        return _features_at(self.scene, self.moving, jnp.asarray(times, jnp.float32), rows)

    def query(
        self,
        text: str,
        time: float = 0.0,
        *,
        negatives: tuple[str, ...] | None = None,
        encoder: Callable[[], LanguageEncoder] | None = None,
    ) -> Float[Array, "n"]:
        """Scores of Gaussians for a text, at a time; see `gsjax.methods.query.Prompt.scores`.

        Args:
            text: one of `names`, or what the encoder of the features reads.
            time: 0 to 1; of no matter unless features change over time.
            negatives: texts to compare with (default: the encoder's own). Of no use for names.
            encoder: loads the encoder that reads texts (default: that of the features).

        Raises:
            ValueError: the scene has no features with a meaning, no class has the name, or no encoder reads
                texts in these features' space.
            FileNotFoundError: weights of the encoder are not there.
        """
        meaning = self._expect_features()
        return text_prompt(meaning, text, negatives, encoder).scores(self.features_at([time])[0])

    def probabilities(self, time: float = 0.0) -> Float[Array, "n names"]:
        """How likely each Gaussian is each of `names` at a time, 0 to 1; see `prompt_probabilities`.

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
    def viewmats(self) -> Float[np.ndarray, "T 4 4"]:
        """World to camera in each frame of the recording, OpenCV axes; refined where poses were."""
        return self.timeline.viewmats

    @property
    def names(self) -> tuple[str, ...]:
        """Names of what features tell apart; none without."""
        return () if self.meaning is None else self.meaning.names

    @property
    def meaning_changes(self) -> bool:
        """Whether features are not the same at all times."""
        return self.scene.field is not None and self.scene.field.config.feature

    def _expect_features(self) -> Meaning:
        if self.meaning is None or self.scene.gaussians.features is None:
            raise ValueError(
                "features: expected a scene that learned from a teacher, found none; give it two classes of "
                'masks that count (tools="draw"), or another teacher'
            )
        return self.meaning


@jax.jit
def _at(scene: DeformingScene, moving: Moving, time: Float[Array, ""]) -> Gaussians:
    return scene.at(time, moving)


@jax.jit
def _features_at(
    scene: DeformingScene, moving: Moving, times: Float[Array, "T"], rows: Int[Array, "n"]
) -> Float[Array, "T n c"]:
    return scene.features_at(times, rows, moving)
