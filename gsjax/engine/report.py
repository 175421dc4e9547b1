"""report.html: a run on one page that needs no network, no script and no file beside it."""

import base64
import html
import math
from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass
from importlib import resources
from pathlib import Path
from typing import Any

from gsjax.io.atomic import atomic_write

_MIME = {
    ".png": "image/png",
    ".jpg": "image/jpeg",
    ".jpeg": "image/jpeg",
    ".svg": "image/svg+xml",
    ".webp": "image/webp",
    ".gif": "image/gif",
    ".mp4": "video/mp4",
    ".webm": "video/webm",
}


@dataclass(frozen=True)
class Table:
    """A table of the report.

    Attributes:
        title: stands above it.
        columns: heads; the first column names the row.
        rows: cells of each row: text, numbers, or None where there is nothing to say.
        units: one a column, "" for none; shown small below the heads.
        decimals: one a column: digits behind the point of its fractions, None for three digits in all.
        note: a line below the table.
        best: (row, column) of cells that stand out.
        colors: one a row, RGB 0 to 255: that in which videos show what the row is about; none if empty.
    """

    title: str
    columns: Sequence[str]
    rows: Sequence[Sequence[Any]]
    units: Sequence[str] = ()
    note: str = ""
    decimals: Sequence[int | None] = ()
    best: Collection[tuple[int, int]] = ()
    colors: Sequence[tuple[int, int, int]] = ()

    def __post_init__(self):
        width = len(self.columns)
        if self.units and len(self.units) != width:
            raise ValueError(f"Table {self.title!r}: {len(self.units)} units for {width} columns")
        if self.decimals and len(self.decimals) != width:
            raise ValueError(f"Table {self.title!r}: {len(self.decimals)} decimals for {width} columns")
        if self.colors and len(self.colors) != len(self.rows):
            raise ValueError(f"Table {self.title!r}: {len(self.colors)} colors for {len(self.rows)} rows")
        for i, row in enumerate(self.rows):
            if len(row) != width:
                raise ValueError(f"Table {self.title!r}: {len(row)} cells in row {i} for {width} columns")


@dataclass(frozen=True)
class Media:
    """An image, video or plot to embed, and what it shows."""

    path: str | Path
    caption: str = ""


def write_report(
    path: str | Path,
    *,
    title: str,
    summary: Mapping[str, Any],
    subtitle: str = "",
    tables: Sequence[Table] = (),
    images: Sequence[Media | str | Path] = (),
    videos: Sequence[Media | str | Path] = (),
    plots: Sequence[Media | str | Path] = (),
    strips: Sequence[Media | str | Path] = (),
    notes: Sequence[str] = (),
) -> None:
    """Writes a standalone page.

    Args:
        path: the .html file, replaced whole.
        title: the heading.
        summary: headline figures, name to value or (value, unit); each becomes a card.
        subtitle: a line below the heading: what ran on what.
        tables, images, videos, plots: what to show; media are embedded, a plain path has no caption.
        strips: images of several pictures side by side, one below the other.
        notes: what was not scored and why, warnings, the machine.
            A medium whose file is missing is left out and added here.

    Raises:
        ValueError: a medium's suffix is none that browsers show.
    """
    notes = list(notes)
    sections = [
        _cards(summary),
        _gallery("Videos", videos, _video, notes),
        _gallery("Plots", plots, _image, notes),
        "".join(map(_table, tables)),
        _gallery("Images", images, _image, notes),
        _gallery("Pictures", strips, _image, notes),
        _notes(notes),
    ]
    below = f"<p>{_text(subtitle)}</p>" if subtitle else ""
    head = f"<header><h1>{_text(title)}</h1>{below}</header>"
    style = resources.files("gsjax.engine").joinpath("report.css").read_text(encoding="utf-8")
    page = (
        '<!doctype html>\n<html lang="en">\n<head>\n<meta charset="utf-8">\n'
        '<meta name="viewport" content="width=device-width, initial-scale=1">\n'
        '<meta name="color-scheme" content="light dark">\n'
        f"<title>{_text(title)}</title>\n<style>\n{style}</style>\n</head>\n<body>\n<main>\n{head}\n"
        + "\n".join(section for section in sections if section)
        + "\n<footer>Written by gsjax.</footer>\n</main>\n</body>\n</html>\n"
    )
    with atomic_write(path) as temporary:
        temporary.write_text(page, encoding="utf-8")


def format_number(value: Any, decimals: int | None = None) -> str:
    """A cell's text: three digits for fractions, thin spaces between thousands, a dash for nothing.

    With `decimals`, fractions have that many digits behind the point, so that a column lines up.
    """
    if value is None:
        return "–"
    if isinstance(value, (str, bool)):
        return str(value)
    if isinstance(value, int) or (hasattr(value, "dtype") and value.dtype.kind in "iu"):
        return f"{int(value):,}".replace(",", "\u202f")
    value = float(value)
    if not math.isfinite(value):
        return "–"
    if decimals is not None:
        value = round(value, decimals) + 0.0  # no minus before a zero
        return f"{value:,.{decimals}f}".replace(",", "\u202f").replace("-", "−")
    if value != 0 and not 1e-3 <= abs(value) < 1e6:
        return f"{value:.2e}".replace("-", "−")
    decimals = 0 if value == 0 else max(0, 2 - math.floor(math.log10(abs(value))))
    return f"{value:,.{decimals}f}".replace(",", "\u202f").replace("-", "−")


def _text(value: Any) -> str:
    return html.escape(str(value))


def _cards(summary: Mapping[str, Any]) -> str:
    cards = []
    for name, entry in summary.items():
        value, unit = entry if isinstance(entry, tuple) else (entry, "")
        unit = f"<small>{_text(unit)}</small>" if unit else ""
        cards.append(f"<div><dt>{_text(name)}</dt><dd>{_text(format_number(value))}{unit}</dd></div>")
    return f'<dl class="cards">{"".join(cards)}</dl>' if cards else ""


def _table(table: Table) -> str:
    numeric = [
        any(not isinstance(row[i], str) and row[i] is not None for row in table.rows)
        for i in range(len(table.columns))
    ]

    def cells(values: Sequence[str], tag: str, row: int | None = None) -> str:
        kinds = [
            " ".join(name for name, holds in (("number", n), ("best", (row, i) in table.best)) if holds)
            for i, n in enumerate(numeric)
        ]
        kinds = [f' class="{kind}"' if kind else "" for kind in kinds]
        return "".join(f"<{tag}{k}>{v}</{tag}>" for k, v in zip(kinds, values, strict=True))

    units = table.units or [""] * len(table.columns)
    heads = [
        _text(name) + (f"<small>{_text(unit)}</small>" if unit else "")
        for name, unit in zip(table.columns, units, strict=True)
    ]
    decimals = table.decimals or [None] * len(table.columns)
    texts = [[_text(format_number(v, d)) for v, d in zip(row, decimals, strict=True)] for row in table.rows]
    for row, color in zip(texts, table.colors, strict=False):
        row[0] = f'<i class="swatch" style="background: rgb{color}"></i>{row[0]}'
    body = "".join(f"<tr>{cells(row, 'td', i)}</tr>" for i, row in enumerate(texts))
    note = f'<p class="note">{_text(table.note)}</p>' if table.note else ""
    return (
        f'<section><h2>{_text(table.title)}</h2><div class="scroll"><table>'
        f"<thead><tr>{cells(heads, 'th')}</tr></thead><tbody>{body}</tbody></table></div>{note}</section>"
    )


def _gallery(
    title: str,
    media: Sequence[Media | str | Path],
    element: Callable[[str, str], str],
    notes: list[str],
) -> str:
    """The media whose files exist; the others are named in `notes`."""
    figures = []
    for item in media:
        item = item if isinstance(item, Media) else Media(item)
        file = Path(item.path)
        if not file.is_file():
            notes.append(f"{title}: {file.name} was not written.")
            continue
        shown = element(_data_uri(file), item.caption or file.stem.replace("_", " "))
        caption = f"<figcaption>{_text(item.caption)}</figcaption>" if item.caption else ""
        figures.append(f"<figure>{shown}{caption}</figure>")
    if not figures:
        return ""
    return f'<section><h2>{title}</h2><div class="gallery {title.lower()}">{"".join(figures)}</div></section>'


def _image(uri: str, caption: str) -> str:
    return f'<img src="{uri}" alt="{_text(caption)}">'


def _video(uri: str, caption: str) -> str:
    return f'<video src="{uri}" controls loop muted playsinline aria-label="{_text(caption)}"></video>'


def _data_uri(file: Path) -> str:
    mime = _MIME.get(file.suffix.lower())
    if mime is None:
        raise ValueError(f"{file}: expected one of {', '.join(_MIME)}, found {file.suffix!r}")
    return f"data:{mime};base64,{base64.b64encode(file.read_bytes()).decode()}"


def _notes(notes: Sequence[str]) -> str:
    if not notes:
        return ""
    items = "".join(f"<li>{_text(note)}</li>" for note in notes)
    return f'<section class="notes"><h2>Notes</h2><ul>{items}</ul></section>'
