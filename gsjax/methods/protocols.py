"""What methods ask of others: who says what belongs together, what a pixel is like, where it moves, what
words mean, and what the answer to a question is.

`gsjax.perception` has a default without weights for each, and adapters of foundation models. Nobody needs to
inherit: whatever can be called like this fits. All of them work on the host, in numpy.
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
        """T."""
        ...

    @property
    def num_cameras(self) -> int:
        """C."""
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
    """Labels of a picture."""

    def __call__(
        self,
        image: Num[np.ndarray, "H W 3"],
        depth: Num[np.ndarray, "H W"] | None,
        K: Float[np.ndarray, "3 3"] | None,
    ) -> Int[np.ndarray, "H W"]:
        """0 background, then 1, 2, ... from the largest object to the smallest.

        Args:
            image: RGB, uint8 or floats 0 to 1.
            depth: metres, 0 where unknown; None without a depth camera.
            K: intrinsics; None where unknown.
        """
        ...


@runtime_checkable
class Propagator(Protocol):
    """Labels of one picture, carried to others."""

    def __call__(
        self, images: Num[np.ndarray, "V H W 3"], labels: Int[np.ndarray, "H W"]
    ) -> Int[np.ndarray, "V H W"]:
        """Labels of all pictures; the same number means the same object, and 0 the background.

        Args:
            images: RGB, uint8 or floats 0 to 1, in an order in which neighbours are alike: views from side to
                side, or frames of a video.
            labels: of the first picture. They come back as they are.
        """
        ...


@runtime_checkable
class DenseEncoder(Protocol):
    """A feature for each pixel."""

    def __call__(self, images: Num[np.ndarray, "C H W 3"]) -> Float[np.ndarray, "C H W D"]:
        """Features of pictures that are to be comparable with each other.

        Args:
            images: RGB, uint8 or floats 0 to 1.
        """
        ...


@runtime_checkable
class OpticalFlow(Protocol):
    """Where each pixel of a picture is in another one."""

    def __call__(
        self, image: Num[np.ndarray, "H W 3"], other: Num[np.ndarray, "H W 3"]
    ) -> Float[np.ndarray, "H W 2"]:
        """Pixels (x, y) that each pixel of `image` moves until `other`; NaN where unknown.

        Args:
            image, other: RGB, uint8 or floats 0 to 1.
        """
        ...


@runtime_checkable
class LanguageEncoder(Protocol):
    """Objects and words in one vector space, in which likeness is the cosine.

    Attributes:
        min_score: a query whose best cosine is less means none of the objects.
    """

    min_score: float

    def embed_objects(
        self, image: Num[np.ndarray, "H W 3"], labels: Int[np.ndarray, "H W"], count: int
    ) -> Float[np.ndarray, "count D"]:
        """A vector for each of the labels 1 to `count`; zeros for one that no pixel has.

        Args:
            image: RGB, uint8 or floats 0 to 1.
            labels: of its pixels, 0 the background.
            count: the largest label that is asked for.
        """
        ...

    def embed_text(self, text: str) -> Float[np.ndarray, "D"]:
        """The vector of a query.

        Raises:
            ValueError: the text says nothing that this encoder knows; the message says what it does know.
        """
        ...


@runtime_checkable
class Answerer(Protocol):
    """What is the answer to a question on a scene; `gsjax.methods.deform` has the default."""

    def __call__(self, question: str, facts: "SceneFacts") -> "Answer":
        """A sentence, and a value where it comes to one.

        Args:
            question: in plain English.
            facts: what was measured of the scene.

        Raises:
            ValueError: it cannot be answered; the message says what can be asked.
        """
        ...


@runtime_checkable
class LanguageModel(Protocol):
    """A text that goes on from another; gsjax has none, its user gives the function."""

    def __call__(self, prompt: str) -> str:
        """The model's text."""
        ...
