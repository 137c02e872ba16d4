"""The report: one HTML file that opens offline, made from a results folder's report.json, tables and figures.

report.json holds the words and the order; tables are Parquet files, figures SVG with a PDF beside each:

    {"title": .., "lead": [..], "sections": [{"title": .., "text": [..],
     "tables": [{"file": .., "caption": .., "columns": {key: heading}}], "figures": [{"file": .., "caption": ..}],
     "figures_first": false}],
     "made": {name: value}}
"""

from __future__ import annotations

import base64
import json
import re
from collections.abc import Mapping
from hashlib import blake2b
from html import escape
from pathlib import Path
from typing import Any

from benchmarks.page.drawings import safe_drawing
from benchmarks.tables.formats import format_value, from_parquet, to_csv, to_latex, to_markdown, to_parquet
from oed.errors import CampaignError, InputError
from oed.files.documents import keyed, read_document
from oed.files.writing import write_figure, write_whole

__all__ = ["save_figure", "save_report", "save_table", "write_report"]

LONGEST_NAME = 100
"""Characters of a file's name that come from the names of plants and methods; file systems allow 255 bytes."""
TEXT = {"type": "string", "description": "a text"}
TEXTS = {"type": "array", "items": TEXT, "description": "a list of texts"}
WORDS = keyed({}, others=TEXT)
SECTION = keyed(
    {
        "title": TEXT,
        "text": TEXTS,
        "tables": {
            "type": "array",
            "items": keyed({"file": TEXT, "caption": TEXT, "columns": WORDS}, ("file", "caption", "columns")),
            "description": "a list of tables",
        },
        "figures": {
            "type": "array",
            "items": keyed({"file": TEXT, "caption": TEXT}, ("file", "caption")),
            "description": "a list of figures",
        },
        "figures_first": {"type": "boolean", "description": "true or false"},
    },
    ("title",),
)
REPORT = keyed(
    {
        "title": TEXT,
        "lead": TEXTS,
        "sections": {"type": "array", "items": SECTION, "description": "a list of sections"},
        "made": keyed({}, others={}),
    },
    ("title", "lead", "sections", "made"),
)
"""What report.json holds."""

STYLE = """
:root { --ink: #1c2328; --soft: #5b6770; --line: #d9dee2; --accent: #0b5fa5; --paper: #ffffff; }
* { box-sizing: border-box; }
body { font: 16px/1.5 system-ui, sans-serif; color: var(--ink); background: var(--paper); margin: 0; }
main { max-width: 1080px; margin: 0 auto; padding: 24px 20px 80px; }
h1 { font-size: 1.7rem; line-height: 1.2; margin: 0 0 12px; }
h2 { font-size: 1.2rem; margin: 40px 0 8px; border-top: 1px solid var(--line); padding-top: 20px; }
.lead p { font-size: 1.05rem; margin: 0 0 8px; max-width: 75ch; }
p { max-width: 78ch; }
.wide { overflow: auto; max-height: 560px; margin: 8px 0 4px; border-bottom: 1px solid var(--line); }
table { border-collapse: collapse; font-size: .86rem; font-variant-numeric: tabular-nums; }
th, td { padding: 3px 10px 3px 0; text-align: right; white-space: nowrap; border-bottom: 1px solid var(--line); }
th { cursor: pointer; border-bottom: 1.5px solid var(--ink); position: sticky; top: 0; background: var(--paper); }
th:hover, th:focus { color: var(--accent); }
td.word, th.word { text-align: left; }
th[aria-sort=ascending]::after { content: " \\2191"; }
th[aria-sort=descending]::after { content: " \\2193"; }
.tools { display: flex; flex-wrap: wrap; gap: 8px 16px; align-items: center; font-size: .85rem; color: var(--soft); }
.tools a { color: var(--accent); }
input { font: inherit; padding: 3px 8px; border: 1px solid var(--line); border-radius: 4px; min-width: 12em; }
figure { margin: 16px 0 24px; }
.drawing { overflow-x: auto; }
.drawing svg { width: 100%; height: auto; max-width: 980px; cursor: zoom-in; }
figcaption, .caption { color: var(--soft); font-size: .9rem; max-width: 78ch; }
dialog { width: 96vw; max-width: none; height: 94vh; border: 0; padding: 12px; }
dialog svg { width: 100%; height: 100%; }
dl { display: grid; grid-template-columns: max-content 1fr; gap: 2px 16px; font-size: .88rem; }
dt { color: var(--soft); } dd { margin: 0; overflow-wrap: anywhere; }
@media (max-width: 560px) { main { padding: 16px 12px 60px; } dl { grid-template-columns: 1fr; } dt { margin-top: 6px; }
  .drawing svg { min-width: 640px; } dialog { overflow: auto; } dialog svg { width: 200vw; } }
@media print { .tools, dialog { display: none; } .wide { max-height: none; } }
"""

SCRIPT = """
document.querySelectorAll('table').forEach(table => {
  const body = table.tBodies[0];
  table.querySelectorAll('th').forEach((th, column) => {
    const sort = () => {
      const up = th.getAttribute('aria-sort') !== 'ascending';
      table.querySelectorAll('th').forEach(other => other.removeAttribute('aria-sort'));
      th.setAttribute('aria-sort', up ? 'ascending' : 'descending');
      const key = row => row.cells[column].dataset.value;
      const rows = [...body.rows].sort((a, b) => {
        const x = parseFloat(key(a)), y = parseFloat(key(b));
        if (isNaN(x) || isNaN(y)) { return isNaN(x) && isNaN(y) ? key(a).localeCompare(key(b)) : isNaN(x) - isNaN(y); }
        return up ? x - y : y - x;
      });
      if (!up && isNaN(parseFloat(key(rows[0])))) { rows.reverse(); }
      body.append(...rows);
    };
    th.addEventListener('click', sort);
    th.addEventListener('keydown', event => { if (event.key === 'Enter') { sort(); } });
  });
  const box = table.closest('section').querySelector('input[data-for="' + table.id + '"]');
  box.addEventListener('input', () => {
    const words = box.value.toLowerCase().split(/\\s+/);
    [...body.rows].forEach(row => { row.hidden = !words.every(w => row.textContent.toLowerCase().includes(w)); });
  });
});
const dialog = document.querySelector('dialog');
document.querySelectorAll('figure svg').forEach(svg => svg.addEventListener('click', () => {
  dialog.replaceChildren(svg.cloneNode(true)); dialog.showModal();
}));
dialog.addEventListener('click', () => dialog.close());
"""


def save_table(
    folder: Path,
    name: str,
    rows: list[dict[str, Any]],
    columns: dict[str, str],
    caption: str,
    *,
    metadata: Mapping[str, Any] | None = None,
) -> dict[str, Any]:
    """Save a table as Parquet, CSV, Markdown and LaTeX, and describe it for the report."""
    where, name = folder / "tables", file_name(name)
    where.mkdir(parents=True, exist_ok=True)
    to_parquet(rows, where / f"{name}.parquet", metadata, overwrite=True)
    to_csv(rows, where / f"{name}.csv", overwrite=True)
    write_whole(where / f"{name}.md", to_markdown(rows, columns) + "\n")
    write_whole(where / f"{name}.tex", to_latex(rows, columns, caption=caption, label=f"tab:{name}") + "\n")
    return {"file": f"tables/{name}.parquet", "caption": caption, "columns": columns}


def file_name(text: str) -> str:
    """A name that every file system takes, different for different texts: a plant may be a file in a folder."""
    plain = re.sub(r"[^\w.+-]+", "-", text, flags=re.ASCII)[:LONGEST_NAME]
    return plain if plain == text else f"{plain}-{blake2b(text.encode(), digest_size=3).hexdigest()}"


def save_figure(folder: Path, name: str, figure: Any, caption: str) -> dict[str, Any]:
    """Save a figure as SVG and PDF, the same bytes for the same figure, and describe it for the report."""
    import matplotlib

    where, name = folder / "figures", file_name(name)
    where.mkdir(parents=True, exist_ok=True)
    with matplotlib.rc_context({"svg.hashsalt": name, "svg.fonttype": "none", "font.family": "sans-serif"}):
        write_figure(where / f"{name}.svg", figure, metadata={"Date": None})
        engine = figure.get_layout_engine()
        figure.set_layout_engine(
            "none"
        )  # everything has its place by now, and finding it takes half the time
        write_figure(where / f"{name}.pdf", figure, metadata={"CreationDate": None})
        figure.set_layout_engine(engine)
    return {"file": f"figures/{name}.svg", "caption": caption}


def save_report(folder: Path, content: dict[str, Any]) -> Path:
    """Write report.json and the HTML page made from it."""
    write_whole(folder / "report.json", json.dumps(content, indent=1, ensure_ascii=False) + "\n")
    return write_report(folder)


def write_report(folder: Path) -> Path:
    """Make the HTML page of a results folder."""
    file = folder / "report.json"
    if not folder.is_dir():
        raise InputError(
            f"there is no folder {folder}; give the --out folder of a comparison or a diagnosis."
        )
    try:
        content = read_document(file, REPORT, "the report", error=CampaignError) if file.exists() else {}
        if not content:
            raise FileNotFoundError(2, "No such file", str(file))
        page = _page(folder, content)
    except FileNotFoundError as error:
        missing = Path(error.filename or file)
        raise InputError(
            f"{folder} has no {missing.name}; it is not a finished comparison or diagnosis: run that first."
        ) from None
    except (ValueError, KeyError, TypeError) as error:
        raise CampaignError(f"{file} is damaged ({error}); run the comparison again, it resumes.") from None
    path = folder / "report.html"
    write_whole(path, page)
    return path


def _page(folder: Path, content: dict[str, Any]) -> str:
    parts = [
        "<!doctype html>",
        '<html lang="en"><head><meta charset="utf-8">',
        '<meta name="viewport" content="width=device-width, initial-scale=1">',
        f"<title>{escape(content['title'])}</title><style>{STYLE}</style></head><body><main>",
        f"<h1>{escape(content['title'])}</h1>",
        '<div class="lead">',
        *(f"<p>{escape(sentence)}</p>" for sentence in content["lead"]),
        "</div>",
    ]
    number = 0
    for section in content["sections"]:
        parts += ["<section>", f"<h2>{escape(section['title'])}</h2>"]
        parts += [f"<p>{escape(sentence)}</p>" for sentence in section.get("text", ())]
        drawn = [line for figure in section.get("figures", ()) for line in _figure(folder, figure)]
        parts += drawn if section.get("figures_first") else []
        for table in section.get("tables", ()):
            number += 1
            parts += _table(folder, table, f"table{number}")
        parts += [] if section.get("figures_first") else drawn
        parts.append("</section>")
    parts += ["<section><h2>How this was made</h2><dl>"]
    for name, value in content["made"].items():
        parts.append(f"<dt>{escape(str(name))}</dt><dd>{escape(str(value))}</dd>")
    parts += ["</dl></section></main><dialog></dialog>", f"<script>{SCRIPT}</script></body></html>", ""]
    return "\n".join(parts)


def _download(folder: Path, name: str, kind: str, label: str) -> str:
    encoded = base64.b64encode(_inside(folder, name).read_bytes()).decode()
    return f'<a download="{escape(Path(name).name)}" href="data:{kind};base64,{encoded}">{escape(label)}</a>'


def _inside(folder: Path, name: str) -> Path:
    """A file of the folder, wherever its links lead; the page never holds a file from elsewhere."""
    path = folder / name
    if not path.resolve().is_relative_to(folder.resolve()):
        raise CampaignError(
            f"report.json names the file {name}, which is not in {folder}; make the report again."
        )
    return path


def _table(folder: Path, table: dict[str, Any], identity: str) -> list[str]:
    path = _inside(folder, table["file"])
    rows, _ = from_parquet(path)
    columns = table["columns"]
    numeric = {key: all(not isinstance(row.get(key), str) for row in rows) for key in columns}
    kind = {key: "" if numeric[key] else ' class="word"' for key in columns}
    head = "".join(f'<th{kind[key]} tabindex="0">{escape(text)}</th>' for key, text in columns.items())
    body = []
    for row in rows:
        cells = []
        for key in columns:
            value = row.get(key)
            cells.append(
                f'<td{kind[key]} data-value="{escape(str(value))}">{escape(format_value(value, row.get(f"{key}_se")))}</td>'
            )
        body.append(f"<tr>{''.join(cells)}</tr>")
    links = [
        _download(folder, str(Path(table["file"]).with_suffix(suffix)), mime, label)
        for suffix, mime, label in (
            (".csv", "text/csv", "CSV"),
            (".tex", "text/plain", "LaTeX"),
            (".md", "text/plain", "Markdown"),
        )
    ]
    return [
        f'<p class="caption">{escape(table["caption"])}</p>',
        f'<div class="tools"><input type="search" placeholder="filter rows" aria-label="filter rows" data-for="{identity}">',
        f"<span>save: {' '.join(links)}</span></div>",
        f'<div class="wide"><table id="{identity}"><thead><tr>{head}</tr></thead><tbody>',
        *body,
        "</tbody></table></div>",
    ]


def _figure(folder: Path, figure: dict[str, Any]) -> list[str]:
    path = _inside(folder, figure["file"])
    drawing = safe_drawing(path.read_text(encoding="utf-8"), figure["file"])
    prefix = re.sub(r"\W", "-", path.stem)
    # Identifiers must not clash between the drawings of one page.
    drawing = (
        drawing.replace('id="', f'id="{prefix}-')
        .replace("url(#", f"url(#{prefix}-")
        .replace('href="#', f'href="#{prefix}-')
    )
    return [
        f'<figure><div class="drawing">{drawing}</div>',
        f"<figcaption>{escape(figure['caption'])}</figcaption>",
        '<div class="tools"><span>save: '
        + _download(folder, figure["file"], "image/svg+xml", "SVG")
        + " "
        + _download(folder, str(Path(figure["file"]).with_suffix(".pdf")), "application/pdf", "PDF")
        + "</span></div></figure>",
    ]
