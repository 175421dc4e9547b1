"""Plots of a run, from arrays. Each function returns a new matplotlib Figure; `save` writes it.

Only matplotlib's object interface is used: no window, no pyplot, no state shared between plots.
"""

from collections.abc import Mapping, Sequence
from pathlib import Path

import matplotlib
import numpy as np
from jaxtyping import Float
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator

from gsjax.viz.colors import label_color

INK, FAINT, GRID = "#22262b", "#6b7280", "#e4e7eb"
"""Colours of text, of secondary text, and of grids and frames."""
_BLUE, _ORANGE = "#0072b2", "#d55e00"
_SIZE = 6.4, 3.4  # of a plot, inches
_DASHED, _TARGET_HZ = (0, (5, 3)), 30


def update_time(update_s: Float[np.ndarray, "frames"], frames: Sequence[int] | None = None) -> Figure:
    """Update times over frames, with their median and 95th percentile, against 30 Hz; NaN is left out.

    Args:
        update_s: of each frame, seconds.
        frames: numbers of the frames (default: counted from 0); there may be more than values.
    """
    figure, axes = _new("Time of one update", "frame", "ms")
    ms = np.asarray(update_s, float) * 1e3
    axes.plot(_numbers(frames, ms), ms, color=_BLUE, lw=1.1, marker="o", ms=2.2, mew=0)
    if np.isfinite(ms).any():
        median, p95 = np.nanpercentile(ms, [50, 95])
        axes.axhline(median, color=_BLUE, lw=1.4, alpha=0.9)
        axes.axhline(p95, color=_BLUE, lw=1.0, alpha=0.5)
        _margin_label(axes, median, f"median {median:.0f} ms", _BLUE)
        if p95 > 1.25 * median:  # otherwise the two labels would overlap
            _margin_label(axes, p95, f"p95 {p95:.0f} ms", _BLUE)
        if np.nanmax(ms) > 8 * p95:  # the first update compiles
            axes.set_yscale("log")
            axes.minorticks_off()
    axes.axhline(1e3 / _TARGET_HZ, color=_ORANGE, lw=1.2, ls=_DASHED)
    _margin_label(axes, 1e3 / _TARGET_HZ, f"{_TARGET_HZ} Hz", _ORANGE)
    if axes.get_yscale() == "linear":
        axes.set_ylim(bottom=0)
    return figure


def error_over_frames(
    errors_mm: Mapping[str, Float[np.ndarray, "frames"]],
    labels: Mapping[str, int] | None = None,
    limit_mm: float | None = None,
    frames: Sequence[int] | None = None,
) -> Figure:
    """Position error of each object in mm, one line per object.

    Args:
        errors_mm: name to error in each frame; NaN where there is no ground truth.
        labels: name to label, which gives the line its colour (default: counted from 1).
        limit_mm: a target, drawn dashed.
        frames: as for `update_time`.
    """
    figure, axes = _new("Centroid error", "frame", "mm")
    for i, (name, error) in enumerate(errors_mm.items()):
        color = _rgb(labels[name] if labels else i + 1)
        axes.plot(_numbers(frames, error), error, color=color, lw=1.6, label=literal(name))
    if limit_mm is not None:
        axes.axhline(limit_mm, color=FAINT, lw=1.0, ls=_DASHED)
        _margin_label(axes, limit_mm, f"{limit_mm:g} mm", FAINT)
    axes.set_ylim(bottom=0)
    _legend(figure, axes)
    return figure


def fit_curve(rows: Sequence[Mapping[str, float | None]]) -> Figure:
    """PSNR of held-out views and, behind it, the number of Gaussians, over minutes.

    Args:
        rows: `seconds`, `alive` and `test_psnr` (None if not evaluated) of each row of the log.
    """
    figure, axes = _new("Held-out PSNR", "minutes", "dB")
    behind = axes.twinx()
    minutes = np.array([row["seconds"] for row in rows], float) / 60
    behind.plot(minutes, [row["alive"] for row in rows], color=FAINT, lw=1.0)
    behind.set_ylabel("Gaussians", color=FAINT)
    behind.set_ylim(bottom=0)
    behind.spines[["top"]].set_visible(False)
    axes.plot(*_held_out_psnr(rows), color=_BLUE, lw=1.6, marker="o", ms=3)
    return figure


def _held_out_psnr(rows: Sequence[Mapping[str, float | None]]) -> Float[np.ndarray, "2 n"]:
    """Minutes and PSNR of the evaluated rows."""
    evaluated = [(row["seconds"], row["test_psnr"]) for row in rows if row["test_psnr"] is not None]
    return np.array(evaluated, float).reshape(-1, 2).T / [[60], [1]]


def losses_over_steps(rows: Sequence[Mapping[str, float | None]]) -> Figure:
    """Each loss over the steps, on a logarithmic axis; steps at which a loss was not active are left out.

    Args:
        rows: `step`, and losses by name (None or 0 where inactive); `loss`, their sum, is not shown.
    """
    figure, axes = _new("Losses", "step", "")
    steps = np.array([row["step"] for row in rows], float)
    names = [name for name in rows[0] if name not in ("step", "seconds", "loss")]
    for i, name in enumerate(names):
        values = np.array([row[name] or np.nan for row in rows], float)
        if np.isfinite(values).any():
            axes.plot(steps, values, color=_rgb(i + 1), lw=1.4, label=literal(name))
    axes.set_yscale("log")
    _legend(figure, axes)
    return figure


def fit_curves(runs: Mapping[str, Sequence[Mapping[str, float | None]]]) -> Figure:
    """PSNR of held-out views over minutes, one line per run, with a ring at its end.

    Args:
        runs: name to rows of `seconds` and `test_psnr` (None if not evaluated).
    """
    figure, axes = _new("Held-out PSNR", "minutes", "dB")
    for i, (name, rows) in enumerate(runs.items()):
        minutes, psnr = _held_out_psnr(rows)
        color = _rgb(i + 1)
        axes.plot(minutes, psnr, color=color, lw=1.6, marker="o", ms=2.6, mew=0, label=literal(name))
        axes.plot(minutes[-1:], psnr[-1:], color=color, marker="o", ms=7, mfc="white", mew=1.6)
    axes.set_xlim(left=0)
    _legend(figure, axes)
    return figure


def psnr_over_frames(
    tracked: Mapping[str, Float[np.ndarray, "frames"]],
    held_out: Mapping[str, Float[np.ndarray, "frames"]] | None = None,
    frames: Sequence[int] | None = None,
) -> Figure:
    """PSNR in dB over frames, one line per camera: solid for tracked cameras, dashed for held-out ones.

    Args:
        tracked: camera to PSNR of each frame.
        held_out: the same for cameras that the method did not see.
        frames: as for `update_time`.
    """
    figure, axes = _new("PSNR", "frame", "dB")
    lines = [(n, v, "-", "tracked") for n, v in tracked.items()]
    lines += [(n, v, (0, (4, 2)), "held out") for n, v in (held_out or {}).items()]
    for i, (name, values, style, kind) in enumerate(lines):
        label = f"{name} ({kind})"
        axes.plot(_numbers(frames, values), values, color=_rgb(i + 1), lw=1.6, ls=style, label=label)
    _legend(figure, axes)
    return figure


def trajectories(
    centroids: Mapping[str, Float[np.ndarray, "frames 3"]],
    labels: Mapping[str, int] | None = None,
    truth: Mapping[str, Float[np.ndarray, "frames 3"]] | None = None,
) -> Figure:
    """Paths of the centroids along x and y, and along x and z, in metres: a ring at the start, a dot at the
    end, the true path thin below.

    Args:
        centroids: name to position in each frame; NaN where there is none.
        labels: name to label, which gives the line its colour (default: counted from 1).
        truth: name to true position in each frame.
    """
    figure = Figure(figsize=_SIZE, facecolor="white", layout="constrained")
    panels = figure.subplots(1, 2)
    for panel, title, plane in zip(panels, ("Paths of the objects", ""), ([0, 1], [0, 2]), strict=True):
        _style(panel, title, *(f"{'xyz'[axis]} (m)" for axis in plane))
        for i, (name, path) in enumerate(centroids.items()):
            color = _rgb(labels[name] if labels else i + 1)
            if truth and name in truth:
                panel.plot(*np.asarray(truth[name])[:, plane].T, color=INK, lw=0.9, alpha=0.55)
            panel.plot(*np.asarray(path)[:, plane].T, color=color, lw=2.0, label=literal(name))
            finite = np.asarray(path)[np.isfinite(path).all(axis=1)][:, plane]
            if len(finite):
                panel.plot(*finite[:1].T, color=color, marker="o", ms=7, mfc="white", mew=1.6)
                panel.plot(*finite[-1:].T, color=color, marker="o", ms=6, mew=0)
        panel.set_aspect("equal", adjustable="datalim")
    _legend(figure, panels[0])
    return figure


def save(figure: Figure, path: str | Path) -> Path:
    """Write the figure in the format of the suffix (.svg, .png, .pdf); equal figures give equal bytes.

    Raises:
        ValueError: matplotlib cannot write this suffix.
    """
    path = Path(path)
    path.parent.mkdir(parents=True, exist_ok=True)
    metadata = {"Date": None} if path.suffix == ".svg" else None
    with matplotlib.rc_context({"svg.hashsalt": "gsjax"}):
        figure.savefig(path, dpi=160, metadata=metadata)
    return path


def literal(name: str) -> str:
    """A name as matplotlib draws it letter by letter: it would leave one that begins with _ out of a legend,
    and typeset what stands between two $."""
    return ("\u200b" if name.startswith("_") else "") + name.replace("$", r"\$")


def _numbers(frames: Sequence[int] | None, values: Float[np.ndarray, "frames"]) -> Sequence[int]:
    return (range(len(values)) if frames is None else frames)[: len(values)]


def _new(title: str, xlabel: str, ylabel: str) -> tuple[Figure, Axes]:
    figure = Figure(figsize=_SIZE, facecolor="white", layout="constrained")
    axes = figure.add_subplot()
    _style(axes, title, xlabel, ylabel)
    return figure, axes


def _style(axes: Axes, title: str, xlabel: str, ylabel: str) -> None:
    axes.set_title(title, loc="left", fontsize=12, fontweight="bold", color=INK, pad=10)
    style_axes(axes, xlabel, ylabel)
    if xlabel == "frame":
        axes.xaxis.set_major_locator(MaxNLocator(integer=True))
    axes.spines[["top", "right", "left"]].set_visible(False)


def style_axes(axes: Axes, xlabel: str, ylabel: str) -> None:
    """Label the axes (xlabel, ylabel), with a faint grid behind the data."""
    axes.set_xlabel(xlabel, color=FAINT, fontsize=10)
    axes.set_ylabel(ylabel, color=FAINT, fontsize=10)
    axes.tick_params(colors=FAINT, labelsize=9.5, length=0)
    axes.grid(color=GRID, lw=0.8)
    axes.set_axisbelow(True)
    for spine in axes.spines.values():
        spine.set_color(GRID)


def _margin_label(axes: Axes, y: float, text: str, color: str) -> None:
    """Label a horizontal line at its right end, outside the plot."""
    place = axes.get_yaxis_transform()
    axes.text(1.01, y, text, transform=place, color=color, fontsize=9, va="center", clip_on=False)


def _legend(figure: Figure, axes: Axes) -> None:
    """Put the legend below the plot, where it hides no line."""
    handles, names = axes.get_legend_handles_labels()
    columns = 5 if max(map(len, names), default=0) < 14 else 3
    if names:
        text = {"fontsize": 9.5, "labelcolor": INK}
        spacing = {"columnspacing": 1.3, "handlelength": 1.4, "frameon": False}
        figure.legend(handles, names, loc="outside lower left", ncols=columns, **text, **spacing)


def _rgb(label: int) -> tuple[float, float, float]:
    red, green, blue = label_color(label)
    return red / 255, green / 255, blue / 255
