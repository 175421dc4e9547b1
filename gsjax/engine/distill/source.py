"""What a field's features mean: who made them, by which texts and pictures find their way back into them."""

from collections.abc import Mapping
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any, Literal

from gsjax.methods.protocols import LanguageEncoder
from gsjax.perception.closed_vocabulary import COLORS, OUTLINES, ClosedVocabulary
from gsjax.perception.codebook import ClassCodebook

Kind = Literal["classes", "closed", "clip", "maskclip", "files"]
KINDS = ("classes", "closed", "clip", "maskclip")
SAID = {
    "classes": "a code for each class: a stand-in for a model of language, which knows the labels' names",
    "closed": "colour and outline of each mask (a closed vocabulary; no foundation model)",
    "clip": "CLIP's vector of each mask's crop",
    "maskclip": "CLIP's vectors of patches (MaskCLIP)",
    "files": "features from files",
}
GENERIC = ("object", "things", "stuff", "texture")
"""What a text is held against unless told otherwise (Kerr et al. 2023, "LERF", section 3.4)."""


@dataclass(frozen=True)
class Source:
    """Where features come from.

    Attributes:
        kind: which encoder.
        names: of the labels, where names are features.
        weights: the encoder's folder, or that of the files.
    """

    kind: Kind
    names: Mapping[int, str] = field(default_factory=dict)
    weights: str | None = None

    @staticmethod
    def of(stored: Mapping[str, Any]) -> "Source":
        """The inverse of `plain`.

        Raises:
            KeyError, TypeError, ValueError: it is not one.
        """
        names = {int(label): str(name) for label, name in stored["names"].items()}
        if stored["kind"] not in SAID:
            raise ValueError(f"kind: expected one of {', '.join(SAID)}, found {stored['kind']!r}")
        return Source(stored["kind"], names, stored["weights"])

    def plain(self) -> dict[str, Any]:
        """What JSON can hold of it."""
        return asdict(self) | {"names": {str(label): name for label, name in self.names.items()}}

    def encoder(self, weights: Path | None = None) -> LanguageEncoder:
        """Who reads texts in the space of these features.

        Args:
            weights: of CLIP, where they are now; or for features from files, if they are CLIP's.

        Raises:
            ValueError: nobody does, a package is missing, or weights are given to one that has none.
            FileNotFoundError: the weights are not there.
        """
        if self.kind in ("classes", "closed") and weights is not None:
            raise ValueError(f"--weights: features of {self.kind} have none; leave it out")
        if self.kind == "classes":
            return ClassCodebook(self.names)
        if self.kind == "closed":
            return ClosedVocabulary(self.names, sizes=False)
        if self.kind == "files" and weights is None:
            raise ValueError(
                "these features are from files, and nobody here reads texts in their space; if they are "
                "CLIP's, --weights names its folder; else ask by --point, or in gsjax view for what is picked"
            )
        from gsjax.perception.clip import load_clip

        try:
            return load_clip(weights or str(self.weights))
        except FileNotFoundError as error:
            raise FileNotFoundError(f"{error}; --weights says where they are now") from error

    def hint(self, weights: Path | None = None) -> str:
        """What can be asked for, to who is about to.

        Args:
            weights: of CLIP, where they are now; or for features from files, if they are CLIP's.
        """
        if self.kind == "classes":
            return "One of: " + ", ".join(sorted(self.names.values()))
        if self.kind == "closed":
            return "Colours and outlines: " + ", ".join((*COLORS, *OUTLINES, *self.names.values()))
        if self.kind == "files" and weights is None:
            return "No words (--weights, if these features are CLIP's): ask for what is picked"
        return "Any words"

    def negatives(self, text: str) -> tuple[str, ...]:
        """What a text is held against unless told: with classes all others, with CLIP what is meant by
        nothing in particular."""
        if self.kind == "classes":
            return ClassCodebook(self.names).others(text)
        return () if self.kind == "closed" else GENERIC
