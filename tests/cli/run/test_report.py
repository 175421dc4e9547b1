import base64
import os
import re
from functools import partial
from html.parser import HTMLParser

import numpy as np
import pytest
from rich.console import Console

from gsjax.engine.report import write_report
from gsjax.engine.summary import Card, Column, Media, Summary, Table, format_number
from gsjax.engine.terminal import print_summary, print_table

VOID = {"meta", "img", "br"}


class Outline(HTMLParser):
    """Checks that tags nest, and keeps what the page refers to and says."""

    def __init__(self):
        super().__init__()
        self.open, self.tags, self.links, self.text = [], [], [], []

    def handle_starttag(self, tag, attrs):
        self.tags.append(tag)
        self.links += [value for name, value in attrs if name in ("src", "href", "poster")]
        if tag not in VOID:
            self.open.append(tag)

    def handle_endtag(self, tag):
        assert self.open.pop() == tag

    def handle_data(self, data):
        self.text.append(data)


@pytest.fixture
def write(tmp_path):
    def written(**content):
        write_report(tmp_path / "report.html", Summary(**{"title": "a run"} | content))
        outline = Outline()
        outline.feed((tmp_path / "report.html").read_text())
        assert outline.open == []
        return outline

    return written


def test_page_stands_alone_and_holds_its_media(write, tmp_path):
    for name in ("a.png", "b.mp4", "c.svg"):
        (tmp_path / name).write_bytes(name.encode() * 3)
    page = write(
        images=[Media(tmp_path / "a.png")],
        videos=[Media(tmp_path / "b.mp4", "camera 0")],
        plots=[Media(tmp_path / "c.svg")],
    )
    kinds = [link.split(";")[0] for link in page.links]
    assert kinds == ["data:video/mp4", "data:image/svg+xml", "data:image/png"]
    assert base64.b64decode(page.links[0].split(",")[1]) == b"b.mp4" * 3
    assert "camera 0" in page.text
    assert "script" not in page.tags
    assert "link" not in page.tags
    assert not re.search(r"https?://|url\(", (tmp_path / "report.html").read_text())


def test_figures_tables_and_notes_are_shown(write):
    rows = [{"name": "cup", "error": 1.234}, {"name": "box", "error": None}]
    columns = (Column("object", "name"), Column("error", "error", "mm"), Column("empty", "empty"))
    page = write(
        cards=[Card("Update rate", 18.24, "Hz"), Card("Gaussians", 48211)],
        tables=[
            Table("Objects", columns, rows, note="A note.", means=[{"name": "mean", "error": 1.234}]),
            Table("Nothing in it", columns, []),
        ],
        notes=["The robot: no truth."],
    )
    text = " ".join(page.text)
    for said in ("Update rate", "18.2", "Hz", "48\u202f211", "cup", "1.23", "–", "mm", "A note.", "truth."):
        assert said in text
    assert "empty" not in text
    assert "Nothing in it" not in text


def test_text_is_escaped(write):
    page = write(
        title="<script>", notes=["a < b & c"], tables=[Table("t", [Column("<b>", "k")], [{"k": "<i>"}])]
    )
    assert {"script", "b", "i"}.isdisjoint(page.tags)
    assert "a < b & c" in page.text


def test_cells_may_stand_out_and_strips_lie_below_each_other(write, tmp_path):
    (tmp_path / "a.png").write_bytes(b"a")
    rows = [{"run": "a", "psnr": 20.0}, {"run": "b", "psnr": 21.0}]
    columns = (Column("run", "run"), Column("PSNR", "psnr", better="more"))
    table = Table("Runs", columns, rows, best={(1, "psnr"), (0, "run")})
    page = write(tables=[table], strips=[Media(tmp_path / "a.png", "view 7")])
    assert "view 7" in page.text
    html = (tmp_path / "report.html").read_text()
    assert '<td class="best">a</td><td class="number">20.0</td>' in html
    assert '<td>b</td><td class="number best">21.0</td>' in html
    assert '<div class="gallery pictures">' in html
    assert "PSNR ↑" in page.text


def test_missing_media_become_a_note(write, tmp_path):
    page = write(videos=[Media(tmp_path / "video_7.mp4")])
    assert "Videos: video_7.mp4 was not written." in page.text
    assert "video" not in page.tags


def test_empty_report_is_a_page(write):
    assert write().tags.count("h1") == 1


def test_what_no_browser_shows_is_refused_and_the_old_page_stays(write, tmp_path):
    write()
    (tmp_path / "scene.ply").touch()
    before = (tmp_path / "report.html").read_bytes()
    with pytest.raises(ValueError, match=r"scene\.ply: expected one of \.png"):
        write(images=[Media(tmp_path / "scene.ply")])
    assert (tmp_path / "report.html").read_bytes() == before


def test_tables_that_do_not_fit_together_are_refused():
    columns = [Column("a", "a")]
    with pytest.raises(ValueError, match="2 colors for 1 rows"):
        Table("t", columns, [{"a": 1}], colors=[(0, 0, 0)] * 2)
    for best in ((1, "a"), (0, "b")):
        with pytest.raises(ValueError, match=f"no cell '{best[1]}' in row {best[0]}"):
            Table("t", columns, [{"a": 1}], best=[best])


def test_the_terminal_shows_what_the_report_does(capsys, tmp_path):
    columns = (Column("object", "name"), Column("centroid error", "error", "mm", 2))
    rows = [{"name": "cup", "error": 1.234}, {"name": "box"}]
    summary = Summary(
        title="a run",
        cards=[Card("update rate", 18.24, "Hz", 2)],
        tables=[Table("Objects", columns, rows, brief=True), Table("Time", columns, rows)],
        notes=["A note."],
        hints=[("view it", "gsjax view RUN")],
        complete=False,
    )
    print_summary(summary, tmp_path / "report.html")
    lines = [" ".join(line.split()) for line in capsys.readouterr().out.splitlines()]
    expected = [
        "cup 1.23",
        "box –",
        "update rate 18.24 Hz",
        "partial run; the same command with --resume continues it",
    ]
    assert [line for line in lines if line in expected] == expected
    assert {"view it gsjax view RUN", f"report {tmp_path / 'report.html'}"} <= {*lines}
    assert "A note." not in lines
    print_summary(summary, None, notes=True, titles=True)
    assert "A note." in capsys.readouterr().out


@pytest.mark.parametrize("width", [60, 80, 120, None])
def test_every_name_and_figure_of_a_table_is_whole_in_a_terminal_of_any_width(width, monkeypatch, capsys):
    terminal = partial(Console, force_terminal=width is not None, color_system=None, width=width)
    monkeypatch.setattr("gsjax.engine.terminal.Console", terminal)
    heads = [f"mean error of what is seen {number}" for number in range(8)]
    columns = [Column("run", "name"), *(Column(head, head, "mm", 2) for head in heads)]
    rows = [{"name": name, **{head: 12345.25 for head in heads}} for name in ("runs/" + "a" * 20, "runs/b")]
    print_table(Table("Scores", columns, rows))
    text = capsys.readouterr().out
    parts = text.count("runs/b")
    assert text.count("runs/" + "a" * 20) == parts
    assert (parts == 1) == (width is None), "only a log has room for all columns beside each other"
    assert text.count("12\u202f345.25") == 16
    assert text.count("error of what is seen") == 8
    assert max(map(len, text.splitlines())) <= (width or 1000)


@pytest.mark.parametrize(
    ("value", "text"),
    [
        (None, "–"),
        (float("nan"), "–"),
        (np.float32("inf"), "–"),
        ("tracked", "tracked"),
        (True, "True"),
        (48211, "48\u202f211"),
        (np.int64(7), "7"),
        (0.0, "0"),
        (18.24, "18.2"),
        (-1.2345, "−1.23"),
        (np.float32(0.5), "0.500"),
        (1234.5, "1\u202f234"),
        (1.5e-7, "1.50e−07"),
        (2.5e9, "2.50e+09"),
    ],
)
def test_numbers_read_well(value, text):
    assert format_number(value) == text


def test_a_name_that_is_not_utf_8_is_shown_as_far_as_it_is(tmp_path):
    name = os.fsdecode(b"donn\xe9es")
    write_report(tmp_path / "report.html", Summary(title=name, hints=[("view", f"gsjax view {name}")]))
    assert (tmp_path / "report.html").read_text(encoding="utf-8").count("donn?es") == 3
