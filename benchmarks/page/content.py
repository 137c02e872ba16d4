"""What a page holds: words, tables and figures as plain data, kept in report.json and checked when it is read back.

A figure is declared, not drawn: rows with x, y and where there are any low, high, series, panel and text. The page
draws it with Vega, `figures_static` the same rows with matplotlib for papers. No drawing and no program comes from the
file, so a folder from somebody else can fill a page with wrong numbers and with nothing else."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import MISSING, asdict, dataclass, field, fields
from math import isfinite
from pathlib import Path
from typing import Any

import oed
from benchmarks.tables.formats import format_value
from oed.errors import CampaignError, InputError
from oed.files.documents import FLAG, NUMBER, TEXT, keyed, listed, read_document
from oed.files.limits import file_content

Row = dict[str, Any]
MARKS = ("line", "points", "both", "ticks", "stems", "bars", "step")
MOST_POINTS = 4000
"""Points of a signal on a page: more cannot be told apart on any screen, and the page stays small."""


@dataclass(frozen=True, eq=False)
class Figure:
    """A figure as data. `rows` one per point: x, y, and low, high (drawn as a band or as error bars), series,
    panel, text (what is said of the point), and keys that the page's filters know; `marks` how each series is
    drawn (default "line"); `log` the axes with a logarithmic scale, "x", "y" or "xy"; `sideways` y is a name
    and x the value; `rules` values with a thin line; `zoom` whether the page zooms along x; `shared` whether
    all panels have one scale; `square` equal axes."""

    name: str
    caption: str
    alt: str
    rows: Sequence[Row]
    x: str = ""
    y: str = ""
    marks: Mapping[str, str] = field(default_factory=dict)
    log: str = ""
    sideways: bool = False
    rules: Sequence[float] = ()
    zoom: bool = False
    shared: bool = True
    square: bool = False


@dataclass(frozen=True, eq=False)
class Table:
    """A table: `columns` key -> heading; `shade` columns coloured by value; `repeat` a button per row with its command."""

    name: str
    caption: str
    columns: Mapping[str, str]
    rows: Sequence[Row]
    shade: Sequence[str] = ()
    repeat: bool = False


@dataclass(frozen=True, eq=False)
class Section:
    """A heading with what stands under it."""

    title: str
    text: Sequence[str] = ()
    tables: Sequence[Table] = ()
    figures: Sequence[Figure] = ()


@dataclass(frozen=True, eq=False)
class Page:
    """One result: the answer in a sentence, how sure it is, what to do, and the sections. `filters` key of
    rows -> heading; `matrix` name of the table whose rows (plant, noise_variance, method, c_efficiency) fill
    the answer matrix; `repeat` the words of the command that repeats a row, before and after its own; `runs`
    key of a row -> its files; `names` what the names of inputs and estimators mean; `downloads` file name ->
    text; `progress` done and of how many."""

    kind: str
    title: str
    answer: str
    sure: Sequence[str] = ()
    todo: Sequence[str] = ()
    hero: Sequence[Figure] = ()
    sections: Sequence[Section] = ()
    made: Mapping[str, str] = field(default_factory=dict)
    filters: Mapping[str, str] = field(default_factory=dict)
    matrix: str = ""
    repeat: Mapping[str, str] = field(default_factory=dict)
    runs: Mapping[str, str] = field(default_factory=dict)
    names: Mapping[str, str] = field(default_factory=dict)
    downloads: Mapping[str, str] = field(default_factory=dict)
    progress: Sequence[int] = ()

    @property
    def figures(self) -> list[Figure]:
        """All figures in the order of the page."""
        return [*self.hero, *(figure for section in self.sections for figure in section.figures)]

    @property
    def tables(self) -> list[Table]:
        """All tables in the order of the page."""
        return [table for section in self.sections for table in section.tables]

    def to_dict(self) -> dict[str, Any]:
        """Plain data, as report.json holds it."""
        return asdict(self)


VALUE = {
    "type": ["string", "number", "boolean", "null"],
    "description": "a text, a number, true, false or null",
}
ROWS, WORDS = listed(keyed({}, others=VALUE), "rows"), keyed({}, others=TEXT)
NUMBERS = listed(NUMBER, "numbers")
KINDS = {"str": TEXT, "bool": FLAG, "Sequence[str]": listed(TEXT, "texts"), "Sequence[Row]": ROWS, "Sequence[float]": NUMBERS,
         "Sequence[int]": NUMBERS, "Mapping[str, str]": WORDS}  # fmt: skip
"""What a field holds, by its annotation."""


def _schema(kind: Any, **own: Any) -> dict[str, Any]:
    """Schema of a dataclass from its fields; `own` of those that hold more than their annotation says."""
    needed = [f.name for f in fields(kind) if f.default is MISSING and f.default_factory is MISSING]
    return keyed({f.name: own.get(f.name) or KINDS[str(f.type)] for f in fields(kind)}, tuple(needed))


DRAWN = keyed({}, others={"enum": list(MARKS), "description": "one of " + ", ".join(MARKS)})
FIGURE = _schema(Figure, log={"enum": ["", "x", "y", "xy"]}, marks=DRAWN)
FIGURES = listed(FIGURE, "figures")
SECTION = _schema(Section, tables=listed(_schema(Table), "tables"), figures=FIGURES)
PAGE = _schema(Page, hero=FIGURES, sections=listed(SECTION, "sections"))
"""What report.json holds."""


def read_page(folder: Path) -> Page:
    """The page of a results folder, as report.json has it."""
    file = folder / "report.json"
    if not file.is_file():
        raise InputError(
            f"{folder} has no report.json; it is not a finished result of oed compare, diagnose, identify or design with "
            "--out, nor a session: make one first."
        )
    try:
        content = read_document(file, PAGE, "the report", error=CampaignError)
    except CampaignError as error:
        raise CampaignError(f"{error}{_written_by(file)}") from None
    sections = [
        Section(**{k: v for k, v in s.items() if k in ("title", "text")},
                tables=[Table(**t) for t in s.get("tables", ())], figures=[Figure(**f) for f in s.get("figures", ())])
        for s in content.get("sections", ())
    ]  # fmt: skip
    plain = {f.name: content[f.name] for f in fields(Page) if f.name in content}
    return Page(**(plain | {"sections": sections, "hero": [Figure(**f) for f in content.get("hero", ())]}))


def _written_by(file: Path) -> str:
    """Which version wrote a report that this one does not read, and what to do; nothing where it is no report."""
    try:
        made = json.loads(file_content(file))["made"]
        version = f"oed {dict(made).get('version of oed', 'before 0.2.0')}"
    except (OSError, ValueError, KeyError, TypeError):
        return ""
    return (
        f" It was written by {version}, and this is oed {oed.__version__}: its report.html can be opened as it is; for a new "
        "page run its command again, into a new folder."
    )


def series_of(figure: Figure) -> list[str]:
    """Names of the series in the order in which they appear."""
    return list(dict.fromkeys(str(row.get("series") or "") for row in figure.rows))


def headed(*keys: str, **others: str) -> dict[str, str]:
    """Headings of a table's columns: keys that are words already, then those with a heading of their own."""
    return {key: key.replace("_", " ") for key in keys} | others


def line(x: Any, y: Any, series: str, error: Any = None, **more: Any) -> list[Row]:
    """A series as rows, x and y (N,); with `error` (N,) the interval y +- error, where that is finite."""
    rows = [{"x": float(a), "y": float(b), "series": series, **more} for a, b in zip(x, y, strict=True)]
    if error is None:
        return rows
    ends = [
        {"low": row["y"] - float(e), "high": row["y"] + float(e)} for row, e in zip(rows, error, strict=True)
    ]
    return [row | end for row, end in zip(rows, ends, strict=True) if isfinite(end["high"])]


def thinned(x: Any, columns: Mapping[str, Any]) -> list[Row]:
    """Rows of long signals, x (N,) and each (N,): the least and the largest of every piece where there are too many."""
    import numpy as np

    size = -(-2 * len(x) // MOST_POINTS)
    rows = []
    for name, y in columns.items():
        at = np.arange(len(x))
        if len(x) > MOST_POINTS:
            pieces = [at[k : k + size] for k in range(0, len(at), size)]
            filled = np.nan_to_num(y)
            at = np.unique([k for p in pieces for k in (p[filled[p].argmin()], p[filled[p].argmax()])])
        rows += line(x[at], y[at], name)
    return rows


def cell(row: Row, key: str) -> str:
    """What a reader sees of a value: with its standard error where the row has one."""
    return format_value(row.get(key), row.get(f"{key}_se"))
