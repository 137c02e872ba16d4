"""The one page: contents, answer, filters, sections, tables and figures of any result, in one HTML file without a request.

The browser itself holds it to that: the page's security policy allows the scripts whose digests it names and no
connection at all, so neither a results folder from somebody else nor a specification can run or fetch anything.
"""

import base64
import json
import os
import re
from contextlib import suppress
from dataclasses import replace
from functools import lru_cache, partial
from hashlib import blake2b, sha256
from html import escape
from pathlib import Path
from typing import Any

import oed
from benchmarks.campaign.processes import spread
from benchmarks.page.charts import CONFIG, chart, extent, style
from benchmarks.page.content import Figure, Page, Table, cell, read_page, series_of
from benchmarks.tables.formats import ABSENT, to_csv, to_latex, to_markdown, to_parquet
from oed.errors import OedError
from oed.files.writing import in_text, write_whole

LONGEST_NAME = 100
"""Characters of a file's name that come from the names of plants and methods; file systems allow 255 bytes."""
DIGITS = 6
"""Of a number in the page: more than anyone reads or sorts by; the files in tables/ have all of them."""
DRAWN = 5
"""Of a number in a figure: a pixel is a thousandth of it, and what is said of a point comes as text where it matters."""
FEW = 16
"""Figures that are drawn sooner, at a tenth of a second each, than other processes have loaded what draws them."""
PREFER = ("power", "procedure-2", "two-experiment")
"""Inputs that the answer's matrix shows first: the iterations, whichever the plant's channels allow."""


def file_name(text: str) -> str:
    """A name that every file system takes, different for different texts: a plant may be a file in a folder."""
    plain = re.sub(r"[^\w.+-]+", "-", text, flags=re.ASCII)[:LONGEST_NAME]
    return plain if plain == text else f"{plain}-{blake2b(in_text(text).encode(), digest_size=3).hexdigest()}"


def save_page(folder: Path, page: Page, *, static: bool = False, jobs: int = 1) -> Path:
    """Write report.json, its tables as files, with `static` every figure as SVG and PDF too, on so many processes, and the page."""
    from benchmarks.cli import plain

    page = replace(page, made={**page.made, "version of oed": oed.__version__})
    for table in page.tables:
        if not table.rows:
            continue
        where, rows = folder / "tables", list(table.rows)
        name, columns = file_name(table.name), dict(table.columns)
        where.mkdir(parents=True, exist_ok=True)
        to_parquet(rows, where / f"{name}.parquet", page.made, overwrite=True)
        to_csv(rows, where / f"{name}.csv", overwrite=True)
        write_whole(where / f"{name}.md", to_markdown(rows, columns) + "\n")
        write_whole(
            where / f"{name}.tex", to_latex(rows, columns, caption=table.caption, label=f"tab:{name}") + "\n"
        )
    if static:
        from benchmarks.page.figures_static import save_figure

        # as on the page: without rows there is nothing to draw
        figures = {file_name(figure.name): figure for figure in page.figures if figure.rows}
        spread(partial(save_figure, folder / "figures"), figures.items(), jobs if len(figures) > FEW else 1)
    for name, text in page.downloads.items():
        write_whole(folder / file_name(name), text)
    write_whole(folder / "report.json", json.dumps(plain(page.to_dict()), ensure_ascii=False) + "\n")
    return write_report(folder)


def write_report(folder: Path) -> Path:
    """Make the HTML page of a results folder again, from report.json alone."""
    path = folder / "report.html"
    write_whole(path, html(read_page(folder)))
    return path


@lru_cache(maxsize=1)
def _bundle() -> str:
    """Vega, Vega-Lite and Vega-Embed as one script; bundling takes seconds, so a copy is kept in the user's cache."""
    import vl_convert

    kept = lambda: Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "oed"
    name = f"vega-{vl_convert.get_vega_version()}-{vl_convert.__version__}.js"
    with suppress(OSError, RuntimeError):  # the second where the user has no home
        return (kept() / name).read_text(encoding="utf-8")
    whole = vl_convert.javascript_bundle()  # pyright: ignore[reportCallIssue]
    text = whole.replace("</script", "<\\/script")
    with suppress(OSError, RuntimeError, OedError):  # no place to keep it: it is bundled again next time
        kept().mkdir(parents=True, exist_ok=True)
        write_whole(kept() / name, text)
    return text


def _source(name: str) -> str:
    return (Path(__file__).parent / "assets" / name).read_text(encoding="utf-8")


def _short(value: Any, digits: int) -> Any:
    """A value as the page holds it: numbers to so many digits, what is not finite as null."""
    if isinstance(value, bool) or value is None or isinstance(value, str):
        return value
    number = float(value)
    if number - number != 0:
        return None
    return int(number) if number.is_integer() and abs(number) < 1e15 else float(f"{number:.{digits}g}")


def _columns(rows: Any, keys: Any, digits: int = DIGITS) -> dict[str, Any]:
    """Rows as columns; one that repeats its values as the different ones and which of them every row has, where that is shorter."""
    return {key: _packed([_short(row.get(key), digits) for row in rows]) for key in keys}


FIRST, LETTERS = ord("0"), ord("~") - ord("0") + 1
"""The places of few values are one letter each, from the first on."""


def _packed(values: list[Any]) -> Any:
    keys = [(isinstance(value, bool), value) for value in values]  # True is no 1
    at = {key: k for k, key in enumerate(dict.fromkeys(keys))}
    places: Any = [at[key] for key in keys]
    if len(at) <= LETTERS:
        places = "".join(chr(FIRST + k) for k in places)
    packed = {"of": [value for _, value in at], "at": places}
    return min(values, packed, key=lambda way: len(_text(way)))


def _text(content: Any) -> str:
    return json.dumps(content, ensure_ascii=False, separators=(",", ":"), allow_nan=False)


def _read(value: Any) -> str:
    """What the page's script makes of a value that has no text of its own."""
    short = _short(value, DIGITS)
    return ABSENT if short is None else f"{short:.5g}" if isinstance(short, int | float) else str(short)


def _keys(rows: Any) -> list[str]:
    return list(dict.fromkeys(key for row in rows for key in row))


def _table_data(table: Table, filters: Any) -> dict[str, Any]:
    numeric = [
        key for key in table.columns
        if any(row.get(key) is not None for row in table.rows)
        and all(isinstance(row.get(key), int | float) and not isinstance(row.get(key), bool)
                for row in table.rows if row.get(key) is not None)
    ]  # fmt: skip
    hidden = [
        key
        for key in (*filters, "method", "estimator")
        if key not in table.columns and key in _keys(table.rows)
    ]
    return {
        "name": table.name, "caption": table.caption, "columns": table.columns, "numeric": numeric,
        "shade": [key for key in table.shade if key in numeric], "repeat": table.repeat,
        "values": _columns(table.rows, (*table.columns, *hidden)),
        "text": {key: _packed(texts) for key in table.columns
                 if (texts := [cell(row, key) for row in table.rows]) != [_read(row.get(key)) for row in table.rows]},
    }  # fmt: skip


def _figure_data(figure: Figure, filters: Any) -> dict[str, Any]:
    names = series_of(figure)
    rows = [row | {"series": str(row.get("series") or "")} for row in figure.rows]
    keys = [
        key for key in _keys(rows) if key in ("x", "y", "low", "high", "series", "panel", "text", *filters)
    ]
    shown = {"panel": "part", "series": "series"} if len(names) > 1 or "panel" in keys else {}
    shown |= {
        "x": figure.x or "x",
        "y": figure.y or ("name" if figure.sideways else "y"),
        "low": "from",
        "high": "to",
    }
    if figure.sideways:
        shown = {"y": shown.pop("y"), **shown}
    columns = {key: head for key, head in shown.items() if key in keys}
    words = [key for key in columns if any(isinstance(row.get(key), str) for row in rows)]
    return {
        "name": figure.name, "alt": figure.alt, "x": figure.x, "sideways": figure.sideways, "square": figure.square,
        "zoom": extent(figure.rows, ("x",), False) if figure.zoom else None,
        "series": [{"name": name, "mark": figure.marks.get(name, "line"), **style(k)} for k, name in enumerate(names)],
        "spec": chart(figure), "rows": _columns(rows, keys, DRAWN),
        "columns": columns if len(rows) <= MOST_LISTED else None,
        "numeric": [key for key in columns if key not in words],
    }  # fmt: skip


MOST_LISTED = 1500
"""Values of a figure that are listed as a table below it: a longer one is a signal, and is a file of the folder."""


def _filter_values(page: Page) -> dict[str, dict[str, Any]]:
    rows = [row for table in page.tables for row in table.rows]
    found = {}
    for key, label in page.filters.items():
        values = sorted(
            {row[key] for row in rows if row.get(key) is not None}, key=lambda v: (isinstance(v, str), v)
        )
        if len(values) > 1:
            found[key] = {
                "label": label,
                "values": [f"{v:g}" if isinstance(v, float) else str(v) for v in values],
            }
    return found


def html(page: Page, *, live: bool = False) -> str:
    """The page as one text; with `live` it asks the server it came from whether there is something newer."""
    filters = _filter_values(page)
    figures = {f"figure-{file_name(f.name)}": _figure_data(f, filters) for f in page.figures if f.rows}
    tables = {f"table-{file_name(t.name)}": _table_data(t, filters) for t in page.tables if t.rows}
    answer = f"table-{file_name(page.matrix)}"
    data = {
        "filters": filters, "figures": figures, "tables": tables, "names": page.names, "repeat": page.repeat,
        "config": CONFIG, "runs": page.runs, "downloads": page.downloads, "live": live,
        "matrix": {"table": answer, "prefer": PREFER} if answer in tables else None,
    }  # fmt: skip
    embedded = _text(data).replace("<", "\\u003c")
    scripts = [_bundle(), _source("page.js")]
    digests = " ".join(f"'sha256-{base64.b64encode(sha256(s.encode()).digest()).decode()}'" for s in scripts)
    policy = f"default-src 'none'; script-src {digests}; style-src 'unsafe-inline'; img-src data: blob:; "
    policy += f"connect-src {chr(39) + 'self' + chr(39) if live else chr(39) + 'none' + chr(39)}; base-uri 'none'; form-action 'none'"
    return "\n".join([
        '<!doctype html><html lang="en"><head><meta charset="utf-8">',
        f'<meta http-equiv="Content-Security-Policy" content="{policy}">',
        '<meta name="viewport" content="width=device-width, initial-scale=1"><link rel="icon" href="data:,">',
        f"<title>{escape(page.title)}</title><style>{_source('page.css')}</style></head><body>",
        '<a class="skip" href="#main">to the result</a><div class="page">',
        *_contents(page), '<main id="main" tabindex="-1">', *_head(page, filters), *_sections(page), "</main></div>",
        '<dialog aria-label="row"></dialog><noscript>Figures and tables need JavaScript; nothing is fetched.</noscript>',
        f'<script type="application/json" id="page-data">{embedded}</script>',
        *(f"<script>{script}</script>" for script in scripts), "</body></html>", "",
    ])  # fmt: skip


def _anchor(title: str) -> str:
    return re.sub(r"\W+", "-", title.lower()).strip("-") or "section"


def _contents(page: Page) -> list[str]:
    titles = [s.title for s in page.sections] + (["How this was made"] if page.made else [])
    entries = "".join(f'<li><a href="#{_anchor(t)}">{escape(t)}</a></li>' for t in titles)
    return [
        f'<nav aria-label="contents"><details open><summary>Contents</summary><ul>{entries}</ul></details></nav>'
    ]


def _head(page: Page, filters: Any) -> list[str]:
    """The answer, how sure it is and what to do, before anything else."""
    parts = [f'<h1><span>{escape(page.title)}</span><button type="button" id="theme">light / dark</button></h1>',
             f'<p class="answer">{escape(page.answer)}</p>']  # fmt: skip
    if page.progress:
        done, total = page.progress
        parts.append(f'<p><progress id="progress" aria-label="progress" max="{total}" value="{done}"></progress> '
                     f'<span id="progress-text">{done} of {total}</span></p>')  # fmt: skip
    left = ['<div id="matrix"></div>'] if page.matrix else []
    left += [line for figure in page.hero if figure.rows for line in _figure(figure)]
    right = []
    for title, lines in (("What to do", page.todo), ("How sure", page.sure)):
        if lines:
            items = "".join(f"<li>{_whole_options(line)}</li>" for line in lines)
            right.append(f"<h2 class='first'>{title}</h2><ul>{items}</ul>")
    right += [
        f'<p><button type="button" data-download="{escape(name)}">save {escape(name)}</button></p>'
        for name in page.downloads
    ]
    parts += ['<div class="top"><div>', *left, "</div><div>", *right, "</div></div>"]
    if filters:
        parts.append(
            '<div class="bar filters" role="group" aria-label="filters of all figures and tables"></div>'
        )
    return parts


def _sections(page: Page) -> list[str]:
    parts = []
    for section in page.sections:
        name = _anchor(section.title)
        parts += [f'<section id="{name}">', f'<h2>{escape(section.title)}<a class="anchor" href="#{name}" '
                  f'aria-label="link to: {escape(section.title)}">#</a></h2>']  # fmt: skip
        parts += [f"<p>{escape(sentence)}</p>" for sentence in section.text]
        parts += [line for figure in section.figures if figure.rows for line in _figure(figure)]
        parts += [f'<div id="table-{file_name(t.name)}"></div>' for t in section.tables if t.rows]
        parts.append("</section>")
    if page.names:
        parts.append("<section><h2>Names</h2><dl>" + "".join(
            f"<dt>{escape(k)}</dt><dd>{escape(v)}</dd>" for k, v in page.names.items()) + "</dl></section>")  # fmt: skip
    if page.made:
        made = "".join(
            f"<dt>{escape(str(k))}</dt><dd>{_whole_options(str(v))}</dd>"
            for k, v in page.made.items()
            if str(v)
        )
        parts.append(f'<section id="how-this-was-made"><h2>How this was made</h2><dl>{made}</dl></section>')
    return parts


def _whole_options(text: str) -> str:
    """Words of a page, the options of commands in one piece."""
    return re.sub(r"--[a-z][a-z-]*", r"<span class='whole'>\g<0></span>", escape(text))


def _figure(figure: Figure) -> list[str]:
    name = f"figure-{file_name(figure.name)}"
    return [f'<figure id="{name}" aria-labelledby="{name}-caption"><figcaption id="{name}-caption">{escape(figure.caption)}&nbsp;'
            f'<a class="anchor" href="#{name}" aria-label="link to this figure">#</a></figcaption></figure>']  # fmt: skip
