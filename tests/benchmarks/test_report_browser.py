"""The report in a real browser: it sorts, filters, enlarges, saves, fits its window, and complains about nothing."""

from __future__ import annotations

import base64
import html
import json
import re
import shutil
import subprocess
from pathlib import Path

import pytest
from matplotlib.figure import Figure

from benchmarks.page.report import save_figure, save_report, save_table

BROWSER = shutil.which("chromium") or shutil.which("chromium-browser")
needs_browser = pytest.mark.skipif(BROWSER is None, reason="no chromium on PATH (.ci/run installs Debian's)")
OPTIONS = [
    "--headless",
    "--no-sandbox",
    "--disable-gpu",
    "--no-first-run",
    "--disable-background-networking",
    "--disable-component-update",
    "--disable-sync",
    "--hide-scrollbars",
    "--allow-file-access-from-files",
    "--enable-logging=stderr",
]

# Runs beside the page, in a frame as wide as the window is to be: browsers refuse windows below 500 pixels.
PROBE = """
<!doctype html><meta charset="utf-8"><body style="margin:0">
<iframe id="frame" src="report.html" style="border:0;width:WIDTHpx;height:1200px"></iframe>
<script>
const errors = [];
document.getElementById('frame').addEventListener('load', event => {
  const inner = event.target.contentWindow, page = inner.document;
  inner.addEventListener('error', e => errors.push(e.message));
  const column = n => [...page.querySelectorAll('table tbody tr')].filter(r => !r.hidden).map(r => r.cells[n].textContent);
  const headings = [...page.querySelectorAll('table th')];
  const result = {width: inner.innerWidth, scroll: page.documentElement.scrollWidth, before: column(1)};
  headings[1].click(); result.up = column(1); result.sorted = headings[1].getAttribute('aria-sort');
  headings[1].click(); result.down = column(1);
  headings[0].dispatchEvent(new inner.KeyboardEvent('keydown', {key: 'Enter'})); result.words = column(0);
  const box = page.querySelector('input[type=search]');
  box.value = 'WHITE <B'; box.dispatchEvent(new inner.Event('input')); result.filtered = column(0);
  box.value = ''; box.dispatchEvent(new inner.Event('input')); result.all = column(0).length;
  page.querySelector('figure svg').dispatchEvent(new inner.MouseEvent('click', {bubbles: true}));
  result.enlarged = page.querySelector('dialog').open && page.querySelectorAll('dialog svg').length;
  page.querySelector('dialog').click(); result.closed = !page.querySelector('dialog').open;
  result.saves = [...page.querySelectorAll('a[download]')].map(a => [a.download, a.href]);
  result.wide = [...page.querySelectorAll('main > *, section > *')].filter(
    e => e.getBoundingClientRect().right > inner.innerWidth + 0.5).map(e => e.tagName + '.' + e.className);
  result.text = page.querySelector('h1').textContent;
  result.errors = errors;
  const out = document.createElement('pre'); out.id = 'result'; out.textContent = JSON.stringify(result);
  document.body.append(out);
});
</script>
"""


@pytest.fixture(scope="module")
def folder(tmp_path_factory) -> Path:
    """A report with a wide table, a wide figure and text that looks like markup."""
    where = tmp_path_factory.mktemp("report")
    rows = [
        {"input": name, "rho": value, "rho_se": 0.01 * value, **{f"column {k}": k * value for k in range(14)}}
        for name, value in (("white", 10.0), ("power", 2.0), ("white & <b>", 3.0), ("sweep", float("nan")))
    ]
    columns = {key: key for key in rows[0] if key != "rho_se"}
    figure = Figure(figsize=(9, 3))
    figure.add_subplot().plot([1, 2, 3])
    save_report(
        where,
        {
            "title": "A report & its <tests>",
            "lead": ["One sentence."],
            "sections": [
                {
                    "title": "First",
                    "tables": [save_table(where, "first", rows, columns, "A table.")],
                    "figures": [save_figure(where, "line", figure, "A figure.")],
                }
            ],
            "made": {"command": "oed compare " + "--plant reference " * 20, "seed": "0"},
        },
    )
    return where


def opened(folder: Path, width: int, profile: Path) -> tuple[dict, list[str]]:
    """What the probe saw in a page of that width, and what the browser's console said."""
    probe = folder / f"probe-{width}.html"
    probe.write_text(PROBE.replace("WIDTH", str(width)), encoding="utf-8")
    command = [
        BROWSER, *OPTIONS, f"--user-data-dir={profile}", f"--window-size={max(width, 500)},1300",
        "--virtual-time-budget=5000", "--dump-dom", probe.as_uri(),
    ]  # fmt: skip
    run = subprocess.run(command, capture_output=True, text=True, timeout=100, check=True)
    found = re.search(r'<pre id="result">(.*?)</pre>', run.stdout, re.DOTALL)
    assert found, run.stdout[-2000:]
    console = [line for line in run.stderr.splitlines() if ":CONSOLE" in line]
    return json.loads(html.unescape(found[1])), console


@needs_browser
@pytest.mark.slow
@pytest.mark.parametrize("width", [1400, 400])
def test_the_report_in_a_browser(folder, tmp_path, width):
    seen, console = opened(folder, width, tmp_path / "profile")
    assert console == []
    assert seen["errors"] == []
    assert seen["width"] == width
    assert seen["scroll"] <= width  # nothing but the tables themselves scrolls sideways
    assert seen["wide"] == []
    assert seen["text"] == "A report & its <tests>"
    assert [x.split()[0] for x in seen["before"]] == ["10.00", "2.000", "3.000", "–"]
    assert [x.split()[0] for x in seen["up"]] == ["2.000", "3.000", "10.00", "–"]
    assert seen["sorted"] == "ascending"
    assert [x.split()[0] for x in seen["down"]] == ["10.00", "3.000", "2.000", "–"]
    assert seen["words"] == ["power", "sweep", "white", "white & <b>"]
    assert seen["filtered"] == ["white & <b>"]
    assert seen["all"] == 4
    assert seen["enlarged"] == 1
    assert seen["closed"]
    names = [name for name, _ in seen["saves"]]
    assert names == ["first.csv", "first.tex", "first.md", "line.svg", "line.pdf"]
    contents = [base64.b64decode(link.split("base64,")[1]) for _, link in seen["saves"]]
    for name, content in zip(names, contents, strict=True):
        home = folder / ("figures" if name.startswith("line") else "tables")
        assert content == (home / name).read_bytes()


@needs_browser
@pytest.mark.slow
def test_the_check_sees_an_error_and_an_overflow(folder, tmp_path):
    """The same check on a page with a planted script error and an element that is too wide."""
    page = folder / "report.html"
    whole = page.read_text(encoding="utf-8")
    try:
        planted = '<div style="width:3000px">wide</div><script>nonsense()</script></main>'
        page.write_text(whole.replace("</main>", planted, 1), encoding="utf-8")
        seen, console = opened(folder, 400, tmp_path / "profile")
    finally:
        page.write_text(whole, encoding="utf-8")
    assert seen["scroll"] > 400
    assert any("nonsense" in line for line in console)
