"""What the page of a viewer says, as Markdown and HTML."""

import html
import re
from collections.abc import Sequence

import numpy as np

from gsjax.viz.colors import label_color
from gsjax.viz.viewer.pick import Picked
from gsjax.viz.viewer.viewable import Coloring, Viewable

HOW_TO_PICK = "Click on something in the view: what is said here is of the Gaussian that shows most there."
NOTHING_THERE = "Nothing there: less than half of the ray is stopped. " + HOW_TO_PICK
_MOST_NAMES = 24


def heading(scene: Viewable, sent: int) -> str:
    """The scene in a few words.

    Args:
        scene: what is shown.
        sent: how many Gaussians the browser has.
    """
    count = scene.gaussians.num
    told = [f"**{count:,}** Gaussians", f"SH degree {scene.gaussians.sh_degree}"]
    if scene.num_frames > 1:
        told.append(f"{scene.num_frames} frames")
    if scene.shots is not None:
        told.append(f"{len(scene.shots.names)} {'cameras' if scene.num_frames > 1 else 'photographs'}")
    lines = [", ".join(told) + "."]
    if sent < count:
        lines.append(f"The view has the {sent:,} most opaque of them; the render has all.")
    return " ".join(lines) + "\n\nDrag to turn, right drag to shift, scroll to come nearer."


def length(value: float, unit: str) -> str:
    """A length with three digits."""
    return f"{value:.3g}" + (f" {unit}" if unit else "")


def moment(scene: Viewable, frame: int) -> str:
    """Which frame that is, or when it was, where that is known."""
    if scene.times is None:
        return f"frame {frame} of 0 to {scene.num_frames - 1}"
    since = scene.times[frame] - scene.times[0]
    return f"{since:.2f} s of {scene.times[-1] - scene.times[0]:.2f} s"


def length_of(scene: Viewable) -> str:
    """How long a film is, and of how much."""
    frames, count = scene.num_frames, scene.gaussians.num
    lasts = "" if scene.times is None else f"{scene.times[-1] - scene.times[0]:.2f} s, "
    return f"{lasts}{frames} frames, {count:,} Gaussians"


def described(scene: Viewable, picked: Picked | None, frame: int) -> str:
    """What is known of a picked Gaussian, as a table in Markdown.

    Args:
        scene: what is shown.
        picked: the Gaussian, or None where nothing was hit.
        frame: which is shown.
    """
    if picked is None:
        return NOTHING_THERE
    gaussians, row = scene.at(frame), picked.index
    center = np.asarray(gaussians.means)[row]
    scales = np.exp(np.asarray(gaussians.log_scales, np.float64)[row])
    opacity = 1 / (1 + np.exp(-float(gaussians.logit_opacities[row])))
    unit = f" {scene.unit}" if scene.unit else ""
    told = {
        "Gaussian": f"{row} of {gaussians.num}",
        "label": None if scene.labels is None else f"{_plain(scene.name_of(row))} ({int(scene.labels[row])})",
        "centre": ", ".join(f"{value:.3f}" for value in center) + unit,
        "opacity": f"{opacity:.2f}",
        "scales": ", ".join(f"{value:.2g}" for value in scales) + unit,
        "distance": length(picked.depth, scene.unit),
        "share of colour": f"{100 * picked.share:.0f} %",
    }
    rows = "\n".join(f"| {name} | {value} |" for name, value in told.items() if value is not None)
    return f"| | |\n| --- | --- |\n{rows}"


def legend(
    scene: Viewable, coloring: Coloring, depths: tuple[float, float] | None, sizes: Sequence[int] = ()
) -> str:
    """What the colours mean, as HTML; empty where they mean themselves.

    Args:
        coloring: how Gaussians are coloured.
        depths: the ends of the scale of depth, where it is known.
        sizes: labels of the scene, for their colours.
    """
    if coloring == "depth" and depths is not None:
        near, far = (length(value, scene.unit) for value in depths)
        return _small(f"bright: {near} away, dark: {far}")
    if coloring == "features":
        return _small("the three principal components as red, green and blue")
    if coloring == "label":
        shown = [_chip(label, scene) for label in sizes[:_MOST_NAMES]]
        more = [f"and {len(sizes) - _MOST_NAMES} more"] if len(sizes) > _MOST_NAMES else []
        return _small(" ".join([*shown, *more]))
    return ""


def _chip(label: int, scene: Viewable) -> str:
    color = "rgb({}, {}, {})".format(*(label_color(label) if label >= 0 else (38, 40, 44)))
    name = scene.names.get(label, "background" if label == 0 else f"object {label}")
    dot = f'<span style="color: {color}; font-size: 1.3em; vertical-align: -0.08em">&#9679;</span>'
    return f'<span style="white-space: nowrap; margin-right: 0.5em">{dot} {html.escape(name)}</span>'


def lines(told: Sequence[str], color: str = "inherit") -> str:
    """Sentences as HTML, one below the other."""
    return _small("".join(f'<div style="color: {color}">{html.escape(line)}</div>' for line in told))


def explained(told: Sequence[str]) -> str:
    """What an operation does and what its keys want ("key: what"), as HTML."""
    does, *keys = (re.sub("`(.+?)`", r"<b>\1</b>", html.escape(line)) for line in told)
    pairs = (line.partition(": ") for line in keys)
    return _small(
        "".join([f"<div>{does}</div>", *(f"<div><b>{key}</b> {wants}</div>" for key, _, wants in pairs)])
    )


def _small(text: str) -> str:
    return (
        f'<div style="font-size: 0.8em; line-height: 1.6; padding: 0 1em 0.5em; opacity: 0.85">{text}</div>'
    )


def _plain(name: str | None) -> str:
    """A name without what Markdown or a table would take for its own."""
    return "".join(f"\\{c}" if c in "\\`*_{}[]<>()#+!|~" else c for c in name or "")
