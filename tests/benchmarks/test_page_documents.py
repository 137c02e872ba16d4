"""A results folder from somebody else: report.json is checked key by key, and nothing of it is code or names a file."""

from __future__ import annotations

import base64
import json
import re
from dataclasses import replace
from hashlib import sha256
from pathlib import Path

import numpy as np
import pytest

import benchmarks.page.skeleton as skeleton
import oed
from benchmarks.page.charts import COLOURS, chart, extent, style
from benchmarks.page.content import MOST_POINTS, Figure, Page, Section, Table, read_page, thinned
from benchmarks.page.figures_static import drawn, save_figure
from benchmarks.page.skeleton import html, save_page, write_report
from oed.errors import CampaignError, InputError

HOSTILE = '</script><script>alert(1)</script><img src=x onerror="alert(2)">'


def page(text: str = "a < b") -> Page:
    rows = [
        {"x": k, "y": k * 0.5, "low": k * 0.4, "high": k * 0.6, "series": text, "panel": text}
        for k in range(1, 4)
    ]
    figure = Figure("f", text, text, rows, text, text)
    table = Table(
        "t", text, {"a": text, "b": "B"}, [{"a": text, "b": 1.25, "b_se": 0.02}, {"a": "x", "b": None}]
    )
    return Page("comparison", text, text, [text], [text], [figure], [Section(text, [text], [table], [figure])], {text: text},
                downloads={"in.csv": text}, names={text: text})  # fmt: skip


def test_text_is_never_markup(tmp_path):
    made = save_page(tmp_path, page(HOSTILE)).read_text()
    before, data, rest = re.split(
        r'<script type="application/json" id="page-data">|</script>', made, maxsplit=2
    )
    assert "<" not in data
    assert before.count("&lt;script&gt;alert(1)") > 5
    assert not re.search(r"<script|<img|<iframe", before)
    assert "alert(1)" not in rest


def test_the_policy_allows_the_two_scripts_of_the_page_and_nothing_else(tmp_path):
    made = html(page())
    bodies = re.findall(r"<script>(.*?)</script>", made, re.DOTALL)
    policy = re.search(r'Content-Security-Policy" content="([^"]+)"', made)[1]
    allowed = re.search(r"script-src ([^;]+)", policy)[1].split()
    digests = [f"'sha256-{base64.b64encode(sha256(body.encode()).digest()).decode()}'" for body in bodies]
    assert allowed == digests
    assert "default-src 'none'" in policy
    assert "connect-src 'none'" in policy
    assert "connect-src 'self'" in html(page(), live=True)


def test_the_page_is_made_again_from_report_json(tmp_path):
    first = save_page(tmp_path, page())
    before = first.read_bytes()
    first.unlink()
    assert write_report(tmp_path).read_bytes() == before
    assert (tmp_path / "in.csv").read_text() == "a < b"
    for suffix in (".parquet", ".csv", ".md", ".tex"):
        assert (tmp_path / "tables" / f"t{suffix}").stat().st_size


def test_a_figure_without_rows_is_left_out_of_the_page_and_of_the_files(tmp_path):
    """Two replicates choose no best way: the figure of what knowledge is worth is empty, and ended a comparison at its last step."""
    save_page(tmp_path, Page("comparison", "t", "a", hero=[Figure("empty", "c", "a", [])]), static=True)
    assert not list(tmp_path.glob("figures/*"))


@pytest.mark.parametrize(
    "change, words",
    [
        ({"title": 3}, "title is 3; it must be a text"),
        ({"sure": "x"}, "sure is 'x'; it must be a list of texts"),
        (
            {"sections": [{"title": "s", "tables": [{"name": "t"}]}]},
            "'sections.0..tables.0..caption' is missing",
        ),
        ({"sections": [{"title": "s", "script": "x"}]}, "script"),
        (
            {"hero": [{"name": "f", "caption": "", "alt": "", "rows": [{"x": [1]}]}]},
            r"must be a text, a number",
        ),
        (
            {"hero": [{"name": "f", "caption": "", "alt": "", "rows": [], "marks": {"a": "image"}}]},
            "one of line",
        ),
        ({"hero": [{"name": "f", "caption": "", "alt": "", "rows": [], "url": "x"}]}, "url"),
    ],
)
def test_a_report_that_is_not_what_it_should_be(tmp_path, change, words):
    save_page(tmp_path, page())
    file = tmp_path / "report.json"
    file.write_text(json.dumps(json.loads(file.read_text()) | change))
    with pytest.raises(CampaignError, match=words) as refused:
        write_report(tmp_path)
    assert f"written by oed {oed.__version__}, and this is" in str(refused.value)


def test_a_report_of_an_older_version_says_so(tmp_path):
    save_page(tmp_path, page())
    file = tmp_path / "report.json"
    content = json.loads(file.read_text())
    del content["made"]["version of oed"]
    file.write_text(json.dumps(content | {"conclusion": "x"}))
    with pytest.raises(
        CampaignError,
        match=r"'conclusion' is unknown.* written by oed before 0.2.0, .* run its command again",
    ):
        read_page(tmp_path)


def test_a_folder_without_a_result_is_refused(tmp_path):
    with pytest.raises(InputError, match=r"has no report.json"):
        read_page(tmp_path)


def test_a_figure_shows_every_value(tmp_path):
    """Limits of the scales hold values and intervals; a logarithmic scale leaves out what it cannot show."""
    rows = [{"x": 1.0, "y": 2.0, "low": -1.0, "high": 9.0}, {"x": 4.0, "y": 3.0}]
    low, high = extent(rows, ("y", "low", "high"), False)
    assert low <= -1
    assert high >= 9
    low, high = extent(rows, ("y", "low", "high"), True)
    assert 0 < low <= 2
    assert high >= 9
    figure = Figure("f", "", "", rows, "x", "y", log="xy", rules=(20.0,))
    scales = [layer["encoding"]["y"]["scale"] for layer in chart(figure)["layer"]]
    assert all(s["type"] == "log" and s["domain"][1] >= 20 for s in scales)
    save_figure(tmp_path, ("f", figure))
    assert (tmp_path / "f.svg").read_text().startswith("<?xml")
    assert (tmp_path / "f.pdf").read_bytes().startswith(b"%PDF")


@pytest.mark.parametrize("mark", ["line", "points", "both", "ticks", "stems", "bars", "step"])
@pytest.mark.parametrize("sideways", [False, True])
def test_every_mark_is_a_valid_specification_and_a_drawing(mark, sideways, tmp_path):
    rows = [
        {"x": 1.0, "y": "a" if sideways else 2.0, "low": 0.5, "high": 2.5, "series": "s", "panel": p}
        for p in "PQ"
    ]
    figure = Figure("f", "", "", rows, marks={"s": mark}, sideways=sideways)
    assert chart(figure)["layer"]  # Altair has checked it against the schema of Vega-Lite
    save_figure(tmp_path, ("f", figure))
    with pytest.raises(KeyError, match="y"):
        chart(replace(figure, rows=[{"x": 1.0}], sideways=True))


def test_series_differ_beyond_their_number_of_colours():
    looks = [tuple(map(str, style(k).values())) for k in range(4 * len(COLOURS))]
    assert len(set(looks)) == len(looks)


def test_colours_stand_out_on_both_papers():
    """Contrast of at least 3 : 1, what WCAG 2.1 asks of graphics, on white and on the dark page."""

    def luminance(colour: str) -> float:
        channels = np.array([int(colour[k : k + 2], 16) for k in (1, 3, 5)]) / 255
        linear = np.where(channels <= 0.04045, channels / 12.92, ((channels + 0.055) / 1.055) ** 2.4)
        return float(linear @ [0.2126, 0.7152, 0.0722])

    for colour in COLOURS:
        for paper in ("#ffffff", "#14181c"):
            light, dark = sorted((luminance(colour), luminance(paper)), reverse=True)
            assert (light + 0.05) / (dark + 0.05) >= 3, (colour, paper)


def test_long_signals_keep_their_extremes():
    y = np.random.default_rng(0).standard_normal(50_000)
    rows = thinned(np.arange(50_000), {"y": y})
    assert len(rows) <= MOST_POINTS + 2
    assert (min(r["y"] for r in rows), max(r["y"] for r in rows)) == (y.min(), y.max())
    assert [r["x"] for r in rows] == sorted(r["x"] for r in rows)
    assert len(thinned(np.arange(10), {"a": y[:10], "b": y[:10]})) == 20


def test_the_published_page_is_at_most_two_megabytes():
    """It was 2.8: one file that a browser reads before it shows anything."""
    published = Path(__file__).resolve().parents[2] / "docs" / "results" / "report.html"
    assert published.stat().st_size < 2_000_000


def test_a_figure_without_rows_is_left_out_for_papers_too(tmp_path):
    empty = Figure("none", "no run of so many", "none", [], "x", "y")
    save_page(tmp_path, replace(page(), hero=[*page().hero, empty]), static=True)
    assert sorted(file.name for file in (tmp_path / "figures").iterdir()) == ["f.pdf", "f.svg"]


def test_a_figure_is_drawn_once_for_each_of_its_files(monkeypatch, tmp_path):
    """`savefig` drew everything once more before, of which nothing is seen: a third of the time."""
    from matplotlib.figure import Figure as Sheet

    drawings, draw = [], Sheet.draw
    monkeypatch.setattr(Sheet, "draw", lambda sheet, renderer: (drawings.append(1), draw(sheet, renderer)))
    save_figure(tmp_path, ("f", page().hero[0]))
    assert len(drawings) == 2


@pytest.mark.parametrize(
    "ends, said", [((1e-4, 30.0), ["10⁻³", "1"]), ((2.0, 9.0), ["5"]), ((1.1, 1.4), ["1.2", "1.3"])]
)
def test_a_logarithmic_axis_has_numbers_however_short(ends, said):
    sheet = drawn(Figure("f", "", "", [{"x": v, "y": 1.0} for v in ends], "x", "y", log="x"))
    sheet.draw_without_rendering()
    axis = sheet.axes[0].xaxis
    words = [t.get_text() for t in axis.get_ticklabels() + axis.get_ticklabels(minor=True)]
    assert set(said) <= set(words)
    assert not any("$" in word for word in words), "a formula takes a hundred times as long as a text"


def test_many_figures_are_the_same_bytes_on_several_processes(tmp_path):
    one = page().hero[0]
    many = replace(page(), hero=[replace(one, name=f"f{k}", log="y") for k in range(skeleton.FEW + 1)])
    for jobs in (1, 2):
        save_page(tmp_path / str(jobs), many, static=True, jobs=jobs)
    first, second = (
        {f.name: f.read_bytes() for f in (tmp_path / jobs / "figures").iterdir()} for jobs in "12"
    )
    assert len(first) > 2 * skeleton.FEW
    assert first == second


@pytest.mark.parametrize("count, letters", [(4, 28), (24, 26), (3, 6)])
def test_the_legend_of_a_narrow_figure_stays_within_it(count, letters):
    from matplotlib.backends.backend_agg import FigureCanvasAgg

    rows = [{"x": k, "y": k, "series": f"{name:0{letters}d}"} for name in range(count) for k in (1, 2)]
    sheet = drawn(Figure("f", "", "", rows))
    FigureCanvasAgg(sheet).draw()
    legend, axes = sheet.legends[0].get_window_extent(), sheet.axes[0].get_window_extent()
    assert legend.x0 >= 0
    assert legend.x1 <= sheet.bbox.x1
    assert axes.height > 0.5 * 3.0 * sheet.dpi


@pytest.mark.parametrize("where", ["read-only", "nobody's"])
def test_a_page_is_made_where_its_scripts_cannot_be_kept(where, tmp_path, monkeypatch):
    """A home that is full or may not be written to ended a command after its work, and so did a user without one."""
    import vl_convert

    def none():
        raise RuntimeError("Could not determine home directory.")

    (tmp_path / "oed").symlink_to("/proc")
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path) if where == "read-only" else "")
    monkeypatch.setattr(Path, "home", none)
    monkeypatch.setattr(vl_convert, "javascript_bundle", lambda: "let a;</script>")
    assert skeleton._bundle.__wrapped__() == "let a;<\\/script>"


def test_ticks_of_logarithmic_axes_are_written_out_near_one() -> None:
    """1, 2, 5, 10¹, 2×10¹ had stood beside one another."""
    from benchmarks.page.figures_static import _power

    found = {0.02: "0.02", 1.0: "1", 10.0: "10", 20.0: "20", 500.0: "500", 1e3: "10³", 5e-4: "5×10⁻⁴"}
    assert {value: _power(value) for value in found} == found
