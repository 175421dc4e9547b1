"""What a file of Gaussians holds, as `gsjax info` prints it."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from jaxtyping import Float

from gsjax.io.scenes import read_gaussians
from gsjax.scene.origin import in_numbers, in_world


def describe_scene(file: Path) -> dict[str, str]:
    """Facts about the Gaussians of a file; what cannot be drawn is warned of.

    Raises:
        SceneError: it holds no Gaussians.
    """
    gaussians, report = read_gaussians(file)
    facts = {"Gaussians": f"{gaussians.num:,}"}
    if report.stored != gaussians.num:
        facts["Gaussians"] += f" of {report.stored:,}"
    facts["colours"] = f"spherical harmonics of degree {gaussians.sh_degree}"
    if gaussians.num:
        means = in_world(np.asarray(gaussians.means), report.origin)
        low, high = np.percentile(means, [1, 99], axis=0)
        facts["places"] = " to ".join(f"({', '.join(f'{x:.2f}' for x in end)})" for end in (low, high))
        facts["sizes"] = "{:.2g} to {:.2g}".format(*np.percentile(gaussians.scales, [1, 99]))
        facts["opacities"] = "{:.2f} to {:.2f}".format(*np.percentile(gaussians.opacities, [1, 99]))
    facts |= origin_fact(report.origin)
    if report.antialiased is not None:
        facts["drawn"] = "antialiased" if report.antialiased else "classic"
    if report.labels is not None:
        facts["labels"] = ", ".join(map(str, np.unique(report.labels)[:8])) or "none"
    if report.extra:
        facts["not read"] = ", ".join(report.extra)
    return facts


def describe_frames(files: Sequence[Path]) -> dict[str, str]:
    """Facts about a scene that moves.

    Args:
        files: of its frames, of which the first is described.

    Raises:
        SceneError: the first holds no Gaussians.
    """
    return {"frames": f"{len(files)}, {files[0].name} to {files[-1].name}"} | describe_scene(files[0])


def origin_fact(origin: Float[np.ndarray, "3"] | None) -> dict[str, str]:
    """The fact about data that lie far from 0; none for others.

    Args:
        origin: what was taken off; None for data near 0.
    """
    return {} if origin is None else {"origin": in_numbers(origin)}
