"""Where features come from, and the encoder that maps texts and pictures into the same space."""

from collections.abc import Mapping
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any, Literal

from gsjax.methods.protocols import LanguageEncoder
from gsjax.perception.closed_vocabulary import COLORS, OUTLINES, ClosedVocabulary
from gsjax.perception.codebook import ClassCodebook

Kind = Literal["classes", "closed", "clip", "maskclip", "files"]
KINDS = ("classes", "closed", "clip", "maskclip")
ABOUT = {
    "classes": "a code for each class: a stand-in for a model of language, which knows the labels' names",
    "closed": "colour and outline of each mask (a closed vocabulary; no foundation model)",
    "clip": "CLIP's, or SigLIP's, vector of each mask's crop",
    "maskclip": "CLIP's vectors of patches (MaskCLIP)",
    "files": "features from files",
}
GENERIC = ("object", "things", "stuff", "texture")
"""Default negatives of a text (Kerr et al. 2023, "LERF", section 3.4)."""


@dataclass(frozen=True)
class Source:
    """Where features come from.

    Attributes:
        kind: the encoder; "files" for features of an unknown one.
        names: names of the labels, if the features depend on them.
        weights: folder of the encoder's weights, or of the feature files.
        levels: levels whose features are concatenated along the channels; empty if there is only one.
    """

    kind: Kind
    names: Mapping[int, str] = field(default_factory=dict)
    weights: str | None = None
    levels: tuple[str, ...] = ()

    @staticmethod
    def of(stored: Mapping[str, Any]) -> "Source":
        """The inverse of `plain`.

        Raises:
            KeyError, TypeError, ValueError: `stored` is not what `plain` returns.
        """
        names = {int(label): str(name) for label, name in stored["names"].items()}
        if stored["kind"] not in ABOUT:
            raise ValueError(f"kind: expected one of {', '.join(ABOUT)}, found {stored['kind']!r}")
        return Source(stored["kind"], names, stored["weights"], tuple(map(str, stored.get("levels", ()))))

    def plain(self) -> dict[str, Any]:
        """The source as values for JSON."""
        return asdict(self) | {"names": {str(label): name for label, name in self.names.items()}}

    def encoder(self, weights: Path | None = None) -> LanguageEncoder:
        """The encoder that reads texts in the space of these features.

        Args:
            weights: folder of CLIP's weights (default: where they were); also for features from files, if
                they are CLIP's.

        Raises:
            ValueError: there is none, a package is missing, or weights are given for one that has none.
            FileNotFoundError: the weights do not exist.
        """
        if self.kind in ("classes", "closed") and weights is not None:
            raise ValueError(f"--weights: expected none, as features of {self.kind} need none; leave it out")
        if self.kind == "classes":
            return ClassCodebook(self.names)
        if self.kind == "closed":
            return ClosedVocabulary(self.names, sizes=False)
        if self.kind == "files" and weights is None:
            raise ValueError(
                "these features are from files, and no encoder of their texts is known; if they are CLIP's, "
                "give its folder with --weights; else query by --point, or by a click in gsjax view"
            )
        from gsjax.perception.clip import load_clip

        try:
            return load_clip(weights or str(self.weights))
        except FileNotFoundError as error:
            raise FileNotFoundError(f"{error}; give their folder with --weights") from error

    def hint(self, weights: Path | None = None) -> str:
        """Describes the queries that the encoder understands.

        Args:
            weights: as for `encoder`.
        """
        if self.kind == "classes":
            return "One of: " + ", ".join(sorted(self.names.values()))
        if self.kind == "closed":
            return "Colours and outlines: " + ", ".join((*COLORS, *OUTLINES, *self.names.values()))
        if self.kind == "files" and weights is None:
            return "No words (--weights, if these features are CLIP's): ask for what is picked"
        return "Any words"

    def negatives(self, text: str) -> tuple[str, ...]:
        """Default negatives of a text: all other classes, none (closed vocabulary), or generic words."""
        if self.kind == "classes":
            return ClassCodebook(self.names).others(text)
        return () if self.kind == "closed" else GENERIC
