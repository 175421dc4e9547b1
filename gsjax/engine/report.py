"""report.html: a summary on one page that needs no network, no script and no file beside it."""

import base64
import html
from collections.abc import Callable, Iterable, Mapping, Sequence
from importlib import resources
from pathlib import Path
from typing import Any

from gsjax.engine.summary import ARROWS, Card, Media, Summary, Table
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


def write_report(path: str | Path, summary: Summary) -> None:
    """Write a summary as a standalone page. A medium whose file is missing is left out and noted.

    Args:
        path: the .html file, replaced whole.
        summary: what it shows.

    Raises:
        ValueError: a medium has a suffix that browsers do not show.
    """
    notes = summary.all_notes
    sections = [
        _cards(summary.cards),
        _gallery("Videos", summary.videos, _video, notes),
        _gallery("Plots", summary.plots, _image, notes),
        "".join(_table(table) for table in summary.tables if table.rows),
        _gallery("Images", summary.images, _image, notes),
        _gallery("Pictures", summary.strips, _image, notes),
        _list("Notes", map(_text, notes)),
        _list("Next", (f"{_text(label)}: <code>{_text(command)}</code>" for label, command in summary.hints)),
    ]
    title = summary.title + ("" if summary.complete else " (partial run)")
    below = f"<p>{_text(summary.subtitle)}</p>" if summary.subtitle else ""
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
        temporary.write_text(page, encoding="utf-8", errors="replace")  # a path may not be UTF-8


def _text(value: Any) -> str:
    return html.escape(str(value))


def _cards(cards: Sequence[Card]) -> str:
    drawn = []
    for card in cards:
        unit = f"<small>{_text(card.unit)}</small>" if card.unit else ""
        drawn.append(f"<div><dt>{_text(card.head)}</dt><dd>{_text(card.text)}{unit}</dd></div>")
    return f'<dl class="cards">{"".join(drawn)}</dl>' if drawn else ""


def _table(table: Table) -> str:
    columns = table.shown
    numeric = ["number" if table.is_numeric(column) else "" for column in columns]
    heads = [
        _text(column.head + ARROWS[column.better])
        + (f"<small>{_text(column.unit)}</small>" if column.unit else "")
        for column in columns
    ]

    def line(texts: Iterable[str], tag: str, row: int | None = None) -> str:
        kinds = (
            " ".join(filter(None, (number, "best" if (row, column.key) in table.best else "")))
            for number, column in zip(numeric, columns, strict=True)
        )
        classes = (f' class="{kind}"' if kind else "" for kind in kinds)
        return "".join(f"<{tag}{kind}>{text}</{tag}>" for kind, text in zip(classes, texts, strict=True))

    def texts(row: Mapping[str, Any]) -> list[str]:
        return [_text(column.text(row)) for column in columns]

    body = ""
    for i, row in enumerate(table.rows):
        cells = texts(row)
        if table.colors:
            cells[0] = f'<i class="swatch" style="background: rgb{table.colors[i]}"></i>{cells[0]}'
        body += f"<tr>{line(cells, 'td', i)}</tr>"
    body += "".join(f'<tr class="mean">{line(texts(row), "td")}</tr>' for row in table.means)
    note = f'<p class="note">{_text(table.note)}</p>' if table.note else ""
    return (
        f'<section><h2>{_text(table.title)}</h2><div class="scroll"><table>'
        f"<thead><tr>{line(heads, 'th')}</tr></thead><tbody>{body}</tbody></table></div>{note}</section>"
    )


def _gallery(title: str, media: Sequence[Media], element: Callable[[str, str], str], notes: list[str]) -> str:
    """The media whose files exist; the others are named in `notes`."""
    figures = []
    for path, caption in media:
        if not path.is_file():
            notes.append(f"{title}: {path.name} was not written.")
            continue
        shown = element(_data_uri(path), caption or path.stem.replace("_", " "))
        below = f"<figcaption>{_text(caption)}</figcaption>" if caption else ""
        figures.append(f"<figure>{shown}{below}</figure>")
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


def _list(title: str, lines: Iterable[str]) -> str:
    items = "".join(f"<li>{line}</li>" for line in lines)
    return f'<section class="notes"><h2>{title}</h2><ul>{items}</ul></section>' if items else ""
