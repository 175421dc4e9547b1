"""Texts of the viewer's page, as Markdown and HTML."""

import html
import re
from collections.abc import Sequence

import numpy as np

from gsjax.scene.origin import in_world
from gsjax.viz.colors import label_color
from gsjax.viz.viewer.pick import Picked
from gsjax.viz.viewer.viewable import Coloring, Viewable

HOW_TO_PICK = "Click on something in the view to see the Gaussian that contributes most there."
NOTHING_THERE = "Nothing there: the opacity along the ray is below one half. " + HOW_TO_PICK
_MOST_NAMES = 24


def heading(scene: Viewable, sent: int) -> str:
    """A short description of a scene of which `sent` Gaussians are sent to the browser."""
    count = scene.gaussians.num
    lines = [", ".join([f"**{count:,}** Gaussians", *contents(scene)]) + "."]
    if sent < count:
        lines.append(f"The view shows the {sent:,} most opaque of them; the render shows all.")
    return " ".join(lines) + "\n\nDrag to rotate, right-drag to pan, scroll to zoom."


def contents(scene: Viewable) -> list[str]:
    """The contents of a scene besides its number of Gaussians."""
    moves = scene.num_frames > 1
    facts = [f"SH degree {scene.gaussians.sh_degree}", *([f"{scene.num_frames} frames"] if moves else [])]
    if scene.shots is not None:
        facts.append(f"{len(scene.shots.names)} {'cameras' if moves else 'photographs'}")
    return facts


def format_length(value: float, unit: str) -> str:
    """A length with three digits."""
    return f"{value:.3g}" + (f" {unit}" if unit else "")


def frame_label(scene: Viewable, frame: int) -> str:
    """The time of a frame, or its index if times are unknown."""
    if scene.times is None:
        return f"frame {frame} of 0 to {scene.num_frames - 1}"
    elapsed = scene.times[frame] - scene.times[0]
    return f"{elapsed:.2f} s of {scene.times[-1] - scene.times[0]:.2f} s"


def film_summary(scene: Viewable) -> str:
    """Duration, number of frames and number of Gaussians of a film."""
    frames, count = scene.num_frames, scene.gaussians.num
    duration = "" if scene.times is None else f"{scene.times[-1] - scene.times[0]:.2f} s, "
    return f"{duration}{frames} frames, {count:,} Gaussians"


def describe_pick(scene: Viewable, picked: Picked | None, frame: int) -> str:
    """The properties of a picked Gaussian, as a Markdown table.

    Args:
        scene: the scene that is shown.
        picked: the Gaussian, or None if nothing was hit.
        frame: the frame that is shown.
    """
    if picked is None:
        return NOTHING_THERE
    gaussians, row = scene.at(frame), picked.index
    center = in_world(np.asarray(gaussians.means)[row], scene.origin)
    scales = np.exp(np.asarray(gaussians.log_scales, np.float64)[row])
    opacity = 1 / (1 + np.exp(-float(gaussians.logit_opacities[row])))
    unit = f" {scene.unit}" if scene.unit else ""
    properties = {
        "Gaussian": f"{row} of {gaussians.num}",
        "label": _label_cell(scene, row),
        "centre": ", ".join(f"{value:.3f}" for value in center) + unit,
        "opacity": f"{opacity:.2f}",
        "scales": ", ".join(f"{value:.2g}" for value in scales) + unit,
        "distance": format_length(picked.depth, scene.unit),
        "share of colour": f"{100 * picked.share:.0f} %",
    }
    rows = "\n".join(f"| {name} | {value} |" for name, value in properties.items() if value is not None)
    return f"| | |\n| --- | --- |\n{rows}"


def legend(
    scene: Viewable, coloring: Coloring, depths: tuple[float, float] | None, labels: Sequence[int] = ()
) -> str:
    """What the colours mean, as HTML; empty for the Gaussians' own colours.

    Args:
        scene: the scene that is shown.
        coloring: how Gaussians are coloured.
        depths: the ends of the depth scale, if known.
        labels: labels of the scene, for their colours.
    """
    if coloring == "depth" and depths is not None:
        near, far = (format_length(value, scene.unit) for value in depths)
        return _small(f"bright: {near} away, dark: {far}")
    if coloring == "features":
        return _small("the three principal components as red, green and blue")
    if coloring == "label":
        shown = [_chip(label, scene) for label in labels[:_MOST_NAMES]]
        more = [f"and {len(labels) - _MOST_NAMES} more"] if len(labels) > _MOST_NAMES else []
        return _small(" ".join([*shown, *more]))
    return ""


def _chip(label: int, scene: Viewable) -> str:
    color = "rgb({}, {}, {})".format(*(label_color(label) if label >= 0 else (38, 40, 44)))
    name = scene.name_of_label(label)
    dot = f'<span style="color: {color}; font-size: 1.3em; vertical-align: -0.08em">&#9679;</span>'
    return f'<span style="white-space: nowrap; margin-right: 0.5em">{dot} {html.escape(name)}</span>'


RED, AMBER, GREEN = "#ff6b6b", "#f5b041", "#51cf66"
"""Colours of errors, warnings and successes."""


def as_lines(*sentences: str, color: str = "inherit") -> str:
    """Sentences as HTML, one per line."""
    return _small("".join(f'<div style="color: {color}">{html.escape(line)}</div>' for line in sentences))


def operation_help(lines: Sequence[str]) -> str:
    """The help of an operation as HTML: a sentence, then its keys, each as "key: value"."""
    summary, *keys = (re.sub("`(.+?)`", r"<b>\1</b>", html.escape(line)) for line in lines)
    pairs = (line.partition(": ") for line in keys)
    return _small(
        "".join([f"<div>{summary}</div>", *(f"<div><b>{key}</b> {value}</div>" for key, _, value in pairs)])
    )


def _small(text: str) -> str:
    return (
        f'<div style="font-size: 0.8em; line-height: 1.6; padding: 0 1em 0.5em; opacity: 0.85">{text}</div>'
    )


def _label_cell(scene: Viewable, row: int) -> str | None:
    """Name and label of a Gaussian; None without labels."""
    return None if scene.labels is None else f"{_escaped(scene.name_of(row))} ({int(scene.labels[row])})"


def _escaped(name: str | None) -> str:
    """A name with the special characters of Markdown and of tables escaped."""
    return "".join(f"\\{c}" if c in "\\`*_{}[]<>()#+!|~" else c for c in name or "")
