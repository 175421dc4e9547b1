import base64
import re
from html.parser import HTMLParser

import numpy as np
import pytest

from gsjax.engine.report import Media, Table, format_number, write_report

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
        options = {"title": "a run", "summary": {}} | content
        write_report(tmp_path / "report.html", **options)
        outline = Outline()
        outline.feed((tmp_path / "report.html").read_text())
        assert outline.open == []
        return outline

    return written


def test_page_stands_alone_and_holds_its_media(write, tmp_path):
    for name in ("a.png", "b.mp4", "c.svg"):
        (tmp_path / name).write_bytes(name.encode() * 3)
    page = write(
        images=[tmp_path / "a.png"],
        videos=[Media(tmp_path / "b.mp4", "camera 0")],
        plots=[str(tmp_path / "c.svg")],
    )
    kinds = [link.split(";")[0] for link in page.links]
    assert kinds == ["data:video/mp4", "data:image/svg+xml", "data:image/png"]
    assert base64.b64decode(page.links[0].split(",")[1]) == b"b.mp4" * 3
    assert "camera 0" in page.text
    assert "script" not in page.tags
    assert "link" not in page.tags
    assert not re.search(r"https?://|url\(", (tmp_path / "report.html").read_text())


def test_figures_tables_and_notes_are_shown(write):
    rows = [("cup", 1.234), ("box", None)]
    page = write(
        summary={"Update rate": (18.24, "Hz"), "Gaussians": 48211},
        tables=[Table("Objects", ("object", "error"), rows, units=("", "mm"), note="A note.")],
        notes=["The robot: no truth."],
    )
    text = " ".join(page.text)
    for said in ("Update rate", "18.2", "Hz", "48\u202f211", "cup", "1.23", "–", "mm", "A note.", "truth."):
        assert said in text


def test_text_is_escaped(write):
    page = write(title="<script>", notes=["a < b & c"], tables=[Table("t", ("<b>",), [("<i>",)])])
    assert {"script", "b", "i"}.isdisjoint(page.tags)
    assert "a < b & c" in page.text


def test_cells_may_stand_out_and_strips_lie_below_each_other(write, tmp_path):
    (tmp_path / "a.png").write_bytes(b"a")
    table = Table("Runs", ("run", "PSNR"), [("a", 20.0), ("b", 21.0)], best={(1, 1), (0, 0)})
    page = write(tables=[table], strips=[Media(tmp_path / "a.png", "view 7")])
    assert "view 7" in page.text
    html = (tmp_path / "report.html").read_text()
    assert '<td class="best">a</td><td class="number">20.0</td>' in html
    assert '<td>b</td><td class="number best">21.0</td>' in html
    assert '<div class="gallery pictures">' in html


def test_missing_media_become_a_note(write, tmp_path):
    page = write(videos=[tmp_path / "video_7.mp4"])
    assert "Videos: video_7.mp4 was not written." in page.text
    assert "video" not in page.tags


def test_empty_report_is_a_page(write):
    assert write().tags.count("h1") == 1


def test_what_no_browser_shows_is_refused_and_the_old_page_stays(write, tmp_path):
    write()
    (tmp_path / "scene.ply").touch()
    before = (tmp_path / "report.html").read_bytes()
    with pytest.raises(ValueError, match=r"scene\.ply: expected one of \.png"):
        write(images=[tmp_path / "scene.ply"])
    assert (tmp_path / "report.html").read_bytes() == before


def test_ragged_tables_are_refused():
    with pytest.raises(ValueError, match="1 cells in row 1 for 2 columns"):
        Table("t", ("a", "b"), [(1, 2), (3,)])
    with pytest.raises(ValueError, match="1 units for 2 columns"):
        Table("t", ("a", "b"), [], units=("mm",))
    with pytest.raises(ValueError, match="2 colors for 1 rows"):
        Table("t", ("a",), [(1,)], colors=[(0, 0, 0)] * 2)


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
