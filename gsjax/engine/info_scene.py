"""The contents of a file of Gaussians, as printed by `gsjax info`."""

import warnings
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from jaxtyping import Float, Int

from gsjax.engine.files import read_frames
from gsjax.engine.messages import describe
from gsjax.engine.terminal import format_bytes
from gsjax.io.brief import shortened
from gsjax.io.scene_file import SceneReport
from gsjax.io.scenes import read_gaussians
from gsjax.scene.gaussians import Gaussians
from gsjax.scene.origin import in_world, origin_text

_MOST_LABELS = 8  # to list


def describe_scene(file: Path) -> dict[str, str]:
    """Facts about the Gaussians of a file; warns about those that cannot be drawn.

    Raises:
        SceneError: it holds no Gaussians.
    """
    return _facts_of(file, *read_gaussians(file))


def _facts_of(file: Path, gaussians: Gaussians, report: SceneReport) -> dict[str, str]:
    parts = file.parent.iterdir() if file.name == "meta.json" else [file]  # of a SOG in a folder
    size = format_bytes(sum(part.stat().st_size for part in parts if part.is_file()))
    facts = {"file": f"{report.format}, {size}", "Gaussians": f"{gaussians.num:,}"}
    if report.stored != gaussians.num:
        facts["Gaussians"] += f" of {report.stored:,}"
    facts["colours"] = f"spherical harmonics of degree {gaussians.sh_degree}"
    if gaussians.num:
        means = in_world(np.asarray(gaussians.means), report.origin)
        low, high = np.percentile(means, [1, 99], axis=0)
        facts["extent"] = " to ".join(f"({', '.join(f'{x:.2f}' for x in end)})" for end in (low, high))
        facts["sizes"] = "{:.2g} to {:.2g}".format(*np.percentile(gaussians.scales, [1, 99]))
        opacities = np.asarray(gaussians.opacities)
        facts["opacities"] = "{:.2f} to {:.2f}".format(*np.percentile(opacities, [1, 99]))
        if faint := int((opacities < 1 / 255).sum()):
            facts["opacities"] += f"; {faint:,} are too faint to be drawn (below 1/255)"
    facts |= origin_fact(report.origin)
    if report.antialiased is not None:
        facts["drawn"] = "antialiased" if report.antialiased else "classic"
    if report.labels is not None:
        facts["labels"] = _in_short(np.unique(report.labels))
    if report.extra:
        facts["not read"] = ", ".join(report.extra)
    return facts


def describe_frames(files: Sequence[Path]) -> dict[str, str]:
    """Facts about a moving scene: describes its first frame, and warns about what is wrong with the others.

    Args:
        files: the files of its frames.

    Raises:
        ValueError, OSError: the first cannot be read.
    """
    read = read_frames(files)
    first = next(read)
    try:
        for _ in read:
            pass
    except (ValueError, OSError) as error:
        warnings.warn(describe(error), UserWarning, stacklevel=1)
    size = format_bytes(sum(file.stat().st_size for file in files))
    frames = f"{len(files)}, {files[0].name} to {files[-1].name}, {size}"
    return {"frames": frames} | _facts_of(files[0], *first)


def origin_fact(origin: Float[np.ndarray, "3"] | None) -> dict[str, str]:
    """The fact about data that lie far from 0; none for others.

    Args:
        origin: what was subtracted from positions; None for data near 0.
    """
    return {} if origin is None else {"origin": origin_text(origin)}


def _in_short(labels: Int[np.ndarray, "k"]) -> str:
    """Labels in increasing order, in a few words."""
    if len(labels) > 2 and labels[-1] - labels[0] == len(labels) - 1:
        return f"{labels[0]} to {labels[-1]}"
    count = f" ({len(labels)} in all)" if len(labels) > _MOST_LABELS else ""
    return shortened(map(str, labels), _MOST_LABELS) + count or "none"
