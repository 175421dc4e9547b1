"""Which masks and features teach, as chosen on the command line or in Python."""

from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

from gsjax.engine.options import ClipWeights, SamWeights
from gsjax.engine.recording import absolute_path
from gsjax.engine.teaching.source import KINDS
from gsjax.perception.feature_files import EACH
from gsjax.perception.levels import LEVELS, Level

Masks = Literal["auto", "files", "segment"]
Second = Literal["none", "maskclip"]
OneLevel = Level | Literal["default"]
Levels = OneLevel | Literal["each"]
NO_TEACHER = "none"
"""The value of `features` for no teacher, for methods that can do without."""
OF_CLIP = ("clip", "maskclip")


@dataclass(frozen=True)
class TeacherOptions(SamWeights, ClipWeights):
    """Which masks and features teach."""

    features: str = "auto"
    """Features to learn: classes (a code for each class of the mask files), closed (colour and outline of
    each mask; no foundation model), clip or maskclip (with --weights; for clip also SigLIP's), or a folder of
    feature files (LangSplat's, Feature-3DGS's, LERF's, .npy, .npz; named like the pictures, or by frame
    number). auto: classes if there are mask files, else closed. gsjax deform also accepts none, and its auto
    means none if fewer than two mask classes are left to learn (tools are left out by default)."""
    masks: Masks = "auto"
    """Source of the masks: the recording's own files, or a segmenter without weights. auto: the
    files, or the segmenter if there are none."""
    level: OneLevel = "default"
    """Size of objects in LangSplat's files, or of SAM's masks: large (things), medium (their parts) or small
    (the parts of these). default: as the files have it; of SAM's masks, the smallest."""


@dataclass(frozen=True)
class TeacherChoice(TeacherOptions):
    """Which masks and features teach, with the options that only `gsjax distill` has."""

    level: Levels = "default"
    """Size of objects in LangSplat's files, or of SAM's masks: large (things), medium (their parts), small
    (the parts of these), or each: all three at once; a query then reports the level of what it found.
    default: as the files have it; of SAM's masks, the smallest."""
    second: Second = "none"
    """Second teacher beside --features clip, which gives one vector per mask: maskclip gives CLIP's vector of
    each patch, from the same --weights. The weight of its loss is --distill.weights.map."""
    snap: int = 0
    """Snap the outlines of masks to edges in the picture up to this many pixels away, for masks with inexact
    outlines, such as those of many segmenters."""

    @property
    def levels(self) -> tuple[str, ...]:
        """The levels whose features are concatenated along the channels; empty if there is only one."""
        return LEVELS if self.level == EACH else ()

    @property
    def of_files(self) -> bool:
        """Whether the features come from a folder of files."""
        return self.features not in ("auto", NO_TEACHER, *KINDS)

    def located(self) -> dict[str, Any]:
        """Its paths in a form that is valid from any folder, by the options that name them."""
        paths = {"sam": self.sam, "weights": self.weights}
        found: dict[str, Any] = {
            name: path and Path(absolute_path(str(path))) for name, path in paths.items()
        }
        return found | ({"features": absolute_path(self.features)} if self.of_files else {})

    def check(self, *, optional: bool = False) -> None:
        """Check the choice, before anything slow begins.

        Args:
            optional: whether the method can do without a teacher.

        Raises:
            ValueError: options contradict each other.
            FileNotFoundError: a folder does not exist.
        """
        known = ("auto", *KINDS, *((NO_TEACHER,) if optional else ()))
        if self.features not in known and not (self.of_files and Path(self.features).is_dir()):
            raise FileNotFoundError(
                f"--features {self.features}: expected {', '.join(known)}, or a folder of feature files, "
                f"found {_what_is(Path(self.features), 'none of these')}"
            )
        for option, folder, model in (("weights", self.weights, "CLIP"), ("sam", self.sam, "SAM")):
            if folder is not None and not folder.is_dir():
                raise FileNotFoundError(
                    f"--{option} {folder}: expected a folder of {model}'s weights, in the layout of Hugging "
                    f"Face, found {_what_is(folder, 'nothing there')}"
                )
        if self.features in OF_CLIP and self.weights is None:
            raise ValueError(
                f"--features {self.features}: expected --weights PATH too, a folder of CLIP's "
                "weights; closed needs none"
            )
        if self.features not in OF_CLIP and self.weights is not None:
            raise ValueError(
                f"--weights: expected --features {' or '.join(OF_CLIP)}, which have them, found "
                f"{self.features}"
            )
        if self.snap < 0:
            raise ValueError(f"--snap: expected 0 or more pixels, found {self.snap}")
        if self.level != "default" and not self.of_files and self.sam is None:
            raise ValueError(
                f"--level {self.level}: expected --features FOLDER, with LangSplat's files, or --sam, found "
                f"{self.features}"
            )
        one_level = "maps of patches" if "maskclip" in (self.features, self.second) else ""
        one_level = "a scene that deforms" if optional else one_level
        if self.levels and one_level:
            raise ValueError(f"--level {self.level}: {one_level} has features on one level; leave it out")
        if self.second != "none" and self.features != "clip":
            raise ValueError(
                f"--second {self.second}: expected --features clip, which it complements, found "
                f"{self.features}"
            )


def _what_is(path: Path, nothing: str) -> str:
    return "a file" if path.exists() else nothing
