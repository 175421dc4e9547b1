"""Interfaces that methods require of external models: segmentation, dense features, optical flow, language,
and answers to questions.

`gsjax.perception` has a default without weights for most of them, and adapters for foundation models.
No inheritance is needed: any callable with a matching signature works. All run on the host, in numpy.
"""

from typing import TYPE_CHECKING, Protocol, runtime_checkable

import numpy as np
from jaxtyping import Float, Int, Num

from gsjax.scene.frame import Frame

if TYPE_CHECKING:
    from gsjax.methods.deform import Answer, SceneFacts


@runtime_checkable
class SequenceLike(Protocol):
    """Synchronised cameras over time; `gsjax.data.Sequence` is one."""

    @property
    def num_frames(self) -> int:
        """Number of frames, T."""
        ...

    @property
    def num_cameras(self) -> int:
        """Number of cameras, C."""
        ...

    @property
    def times(self) -> Float[np.ndarray, "T"]:
        """Seconds, increasing."""
        ...

    def image(self, t: int, c: int) -> np.ndarray:
        """RGB of camera `c` in frame `t`, [H,W,3] uint8."""
        ...

    def frame(self, t: int) -> Frame:
        """All cameras of frame `t` as arrays on the device."""
        ...


@runtime_checkable
class Segmenter(Protocol):
    """Segmentation of an image into labelled objects."""

    def __call__(
        self,
        image: Num[np.ndarray, "H W 3"],
        depth: Num[np.ndarray, "H W"] | None,
        K: Float[np.ndarray, "3 3"] | None,
    ) -> Int[np.ndarray, "H W"]:
        """0 for background, then 1, 2, ... from the largest object to the smallest.

        Args:
            image: RGB, uint8 or floats 0 to 1.
            depth: metres, 0 where unknown; None without a depth camera.
            K: intrinsics; None where unknown.
        """
        ...


@runtime_checkable
class Propagator(Protocol):
    """Propagation of the labels of one image to others."""

    def __call__(
        self, images: Num[np.ndarray, "V H W 3"], labels: Int[np.ndarray, "H W"]
    ) -> Int[np.ndarray, "V H W"]:
        """Labels of all images; equal numbers denote the same object, and 0 the background.

        Args:
            images: RGB, uint8 or floats 0 to 1, ordered so that neighbours are similar: views from side to
                side, or frames of a video.
            labels: labels of the first image, which are returned unchanged.
        """
        ...


@runtime_checkable
class DenseEncoder(Protocol):
    """A feature for each pixel."""

    def __call__(self, images: Num[np.ndarray, "C H W 3"]) -> Float[np.ndarray, "C H W D"]:
        """Features of images that should be comparable with each other.

        Args:
            images: RGB, uint8 or floats 0 to 1.
        """
        ...


@runtime_checkable
class OpticalFlow(Protocol):
    """Optical flow from one image to another."""

    def __call__(
        self, image: Num[np.ndarray, "H W 3"], other: Num[np.ndarray, "H W 3"]
    ) -> Float[np.ndarray, "H W 2"]:
        """Displacement (x, y) of each pixel of `image` to `other`, pixels; NaN where unknown.

        Args:
            image, other: RGB, uint8 or floats 0 to 1.
        """
        ...


@runtime_checkable
class LanguageEncoder(Protocol):
    """Objects and text in one vector space, in which similarity is the cosine."""

    @property
    def min_score(self) -> float:
        """A query whose best cosine is lower matches none of the objects; an attribute will do."""
        ...

    def embed_objects(
        self, image: Num[np.ndarray, "H W 3"], labels: Int[np.ndarray, "H W"], count: int
    ) -> Float[np.ndarray, "count D"]:
        """A vector for each of the labels 1 to `count`; zeros for a label without pixels.

        Args:
            image: RGB, uint8 or floats 0 to 1.
            labels: label of each pixel, 0 for background.
            count: the largest label to embed.
        """
        ...

    def embed_text(self, text: str) -> Float[np.ndarray, "D"]:
        """The vector of a query.

        Raises:
            ValueError: the encoder does not understand the text; the message says what it understands.
        """
        ...


@runtime_checkable
class Answerer(Protocol):
    """Answers questions about a scene; `gsjax.methods.deform` has the default."""

    def __call__(self, question: str, facts: "SceneFacts") -> "Answer":
        """The answer as a sentence, and as a value if it has one.

        Args:
            question: a question in plain English.
            facts: measurements of the scene.

        Raises:
            ValueError: the question cannot be answered; the message says what can be asked.
        """
        ...


@runtime_checkable
class LanguageModel(Protocol):
    """Text completion; gsjax has no default, the user provides the function."""

    def __call__(self, prompt: str) -> str:
        """The completion of the prompt."""
        ...
