"""A results folder from somebody else: nothing of it but words, numbers and lines reaches the page."""

from __future__ import annotations

import json
import re

import pytest

from benchmarks.page.drawings import safe_drawing
from benchmarks.page.report import save_figure, save_report, save_table, write_report
from oed.errors import CampaignError

HEAD = '<svg xmlns="http://www.w3.org/2000/svg" xmlns:xlink="http://www.w3.org/1999/xlink" xmlns:h="http://www.w3.org/1999/xhtml">'
HOSTILE = {
    "script": "<script>alert(1)</script>",
    "handler": '<g onload="alert(1)"><path d="M0 0"/></g>',
    "foreign": "<foreignObject><h:iframe src='x'/></foreignObject>",
    "prefixed": "<h:script>alert(1)</h:script>",
    "link": '<a xlink:href="javascript:alert(1)"><text>x</text></a>',
    "use": '<use xlink:href="http://elsewhere/x.svg#a"/>',
    "image": '<image href="file:///etc/passwd"/>',
    "image2": '<image href="data:image/svg+xml;base64,AAAA"/>',
    "css": "<style>@import url(http://elsewhere/x.css);</style>",
    "css2": '<path style="fill:url(http://elsewhere/x)"/>',
    "css3": "<style>p{background:u\\72l(http://elsewhere)}</style>",
    "comment": "<!--><script>alert(1)</script>-->",
    "cdata": "<style><![CDATA[</style><script>alert(1)</script>]]></style>",
    "entity": "<text>&lt;script&gt;alert(1)&lt;/script&gt;</text>",
    "animate": '<set attributeName="href" to="javascript:alert(1)"/>',
}


@pytest.mark.parametrize("name", HOSTILE)
def test_what_runs_or_fetches_is_left_out(name):
    drawing = safe_drawing(f"<?xml version='1.0'?>{HEAD}{HOSTILE[name]}<path d='M1 2'/></svg>", "x.svg")
    assert 'd="M1 2"' in drawing
    assert not re.search(r"<script|onload|iframe|javascript:|elsewhere|passwd|@import|svg\+xml|<!--", drawing)


@pytest.mark.parametrize(
    "text", ["", "no drawing", "<svg>", "<html><svg/></html>", HEAD, "<svg " * 9, HEAD + "&x;</svg>"]
)
def test_what_is_no_drawing_is_refused(text):
    with pytest.raises(CampaignError, match="is not a drawing"):
        safe_drawing(text, "x.svg")


@pytest.fixture
def folder(tmp_path):
    from matplotlib.figure import Figure

    figure = Figure()
    axes = figure.subplots()
    axes.plot([0, 1], [1, 2], label="a < b")
    axes.imshow([[1, 2], [3, 4]])
    axes.legend()
    figures = [save_figure(tmp_path, "f", figure, "a figure")]
    tables = [save_table(tmp_path, "t", [{"a": 1}], {"a": "A"}, "a table")]
    sections = [{"title": "s", "figures": figures, "tables": tables}]
    save_report(tmp_path, {"title": "T", "lead": [], "sections": sections, "made": {}})
    return tmp_path


def test_our_own_drawings_keep_every_line(folder):
    text = (folder / "figures" / "f.svg").read_text()
    drawing = safe_drawing(text, "f.svg")
    for tag in ("path", "text", "use", "clipPath", "style", "image", "g"):
        assert len(re.findall(rf"<{tag}[ >/]", drawing)) == len(re.findall(rf"<{tag}[ >/]", text)), tag
    assert "a &lt; b" in drawing
    assert "url(#" in drawing
    assert re.search(r'(xlink:)?href="data:image/png', drawing)


@pytest.mark.parametrize(
    "change, words",
    [
        ({"title": 3}, "title is 3; it must be a text"),
        ({"sections": [{"title": "s", "figures": [{"file": "../../x.svg", "caption": ""}]}]}, "not in"),
        ({"sections": [{"title": "s", "figures": [{"file": "/etc/passwd", "caption": ""}]}]}, "not in"),
        ({"sections": [{"title": "s", "figures": [{"file": "linked.svg", "caption": ""}]}]}, "not in"),
        (
            {"sections": [{"title": "s", "tables": [{"file": "t.parquet"}]}]},
            "'sections.0..tables.0..caption' is missing",
        ),
        ({"lead": "x"}, "lead is 'x'; it must be a list of texts"),
    ],
)
def test_a_report_that_is_not_what_it_should_be(folder, change, words):
    outside = folder.parent / "outside.svg"
    outside.write_text(HEAD + "</svg>")
    (folder / "linked.svg").symlink_to(outside)
    file = folder / "report.json"
    file.write_text(json.dumps(json.loads(file.read_text()) | change))
    with pytest.raises(CampaignError, match=words):
        write_report(folder)
