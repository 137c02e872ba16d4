"""A declared figure with matplotlib, for papers: the same rows as on the page, as SVG and PDF."""

import io
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.page.charts import DASHES, SHAPES, style
from benchmarks.page.content import Figure, series_of
from oed.files.writing import write_figure, write_whole

LINES = ("-", "--", ":", "-.")
MARKERS = dict(zip(SHAPES, "os^DPv", strict=True))
ACROSS = 4
"""Panels in a row, and names in a row of the legend."""
LETTER, KEY, ROW = 0.062, 0.6, 0.17
"""Inches of a letter of the legend, of a line's sample and the space about it, and of a row."""
NUMBERED = 30
"""Ends of a logarithmic axis, as a ratio, within which the ticks at 2 and 5 have their numbers: beyond, two powers of ten do."""
RAISED = str.maketrans("-0123456789", "⁻⁰¹²³⁴⁵⁶⁷⁸⁹")


def drawn(figure: Figure) -> Any:
    """The figure, one axes per panel, scales shared."""
    from matplotlib.figure import Figure as Sheet

    panels = list(dict.fromkeys(str(row.get("panel") or "") for row in figure.rows))
    names, across = series_of(figure), min(len(panels), ACROSS)
    down = -(-len(panels) // across)
    height = 0.9 + 0.26 * len({row["y"] for row in figure.rows}) if figure.sideways else 3.0
    width = max(5.5, 2.8 * across + 0.8)
    in_a_row = int(np.clip(width / (LETTER * max(map(len, names), default=0) + KEY), 1, ACROSS))
    more = max(0, -(-len(names) // in_a_row) - -(-len(names) // ACROSS))
    sheet = Sheet(figsize=(width, 0.6 + height * down + ROW * more), layout="constrained")
    axes = sheet.subplots(down, across, squeeze=False, sharex=figure.shared, sharey=figure.shared)
    for ax, panel in zip(axes.flat, panels, strict=False):
        mine = [row for row in figure.rows if str(row.get("panel") or "") == panel]
        _panel(ax, figure, mine, names)
        ax.set_title(panel, fontsize=10, loc="left")
    for ax in axes.flat[len(panels) :]:
        ax.remove()
    for ax in axes.flat[: len(panels)]:
        _ticks(ax, figure)
    sheet.supxlabel(figure.x, fontsize=10)
    sheet.supylabel("" if figure.sideways else figure.y, fontsize=10)
    handles, labels = axes.flat[0].get_legend_handles_labels()
    if len(names) > 1:
        sheet.legend(handles, labels, loc="outside upper center", ncols=in_a_row, frameon=False, fontsize=8)
    return sheet


def panels(count: int, *, width: float, height: float, columns: int) -> tuple[Any, list[Any]]:
    """A figure with so many panels, in the style of all figures here."""
    from matplotlib.figure import Figure as Sheet

    sheet = Sheet(figsize=(width, height), layout="constrained")
    axes = [sheet.add_subplot(-(-count // columns), min(columns, count), k + 1) for k in range(count)]
    for ax in axes:
        _plain(ax)
    return sheet, axes


def stacked(figures: list[Figure]) -> Any:
    """Several figures one below the other, each with its caption and its own axes."""
    sheet, axes = panels(len(figures), width=7.0, height=2.7 * len(figures), columns=1)
    for ax, figure in zip(axes, figures, strict=True):
        names = series_of(figure)
        _panel(ax, figure, list(figure.rows), names)
        _ticks(ax, figure)
        ax.set_title(figure.caption, fontsize=10, loc="left")
        ax.set_xlabel(figure.x)
        ax.set_ylabel(figure.y)
        if len(names) > 1:
            ax.legend(frameon=False, fontsize=8)
    return sheet


def _plain(ax: Any) -> None:
    ax.spines[["top", "right"]].set_visible(False)
    ax.grid(True, color="#e3e6e8", linewidth=0.7)
    ax.set_axisbelow(True)


def _numbers(rows: list[dict[str, Any]], key: str) -> Any:
    return np.array([np.nan if row.get(key) is None else row[key] for row in rows], dtype=float)


def _panel(ax: Any, figure: Figure, rows: list[dict[str, Any]], names: list[str]) -> None:
    _plain(ax)
    order = list(dict.fromkeys(row["y"] for row in figure.rows)) if figure.sideways else []
    for value in figure.rules:
        (ax.axvline if figure.sideways else ax.axhline)(value, color="#5b6770", linewidth=1)
    for k, name in enumerate(names):
        mine = [row for row in rows if str(row.get("series") or "") == name]
        number = partial(_numbers, mine)
        x = number("x")
        y = np.array([-float(order.index(row["y"])) for row in mine]) if figure.sideways else number("y")
        ends, look = (number("low"), number("high")), style(k) | {"label": name}
        _series(ax, figure, figure.marks.get(name, "line"), x, y, ends, look)
    for key in figure.log:
        (ax.set_xscale if key == "x" else ax.set_yscale)("log")
    if figure.square:
        ax.set_aspect("equal")
    if figure.sideways:
        ax.set_yticks([-k for k in range(len(order))], order, fontsize=8)


def _ticks(ax: Any, figure: Figure) -> None:
    """Ticks of logarithmic axes at 1, 2 and 5, numbers as plain text: nine ticks to a decade and their powers of ten as
    formulas took half the time of a figure."""
    from matplotlib.ticker import FuncFormatter, LogLocator, NullFormatter

    for key in figure.log:
        axis, (low, high) = getattr(ax, f"{key}axis"), getattr(ax, f"get_{key}lim")()
        axis.set_major_formatter(FuncFormatter(_power))
        axis.set_minor_locator(LogLocator(subs=(2.0, 5.0)))
        axis.set_minor_formatter(FuncFormatter(_power) if high < NUMBERED * low else NullFormatter())


PLAIN = 2
"""Powers of ten, either way, whose numbers are written out."""


def _power(value: float, place: int | None = None) -> str:
    """A number of a logarithmic axis: 20, 10³, 5×10⁻⁴."""
    power = int(np.floor(np.log10(value) + 1e-9))
    if abs(power) <= PLAIN:
        return f"{value:.4g}"
    times, digits = f"10{str(power).translate(RAISED)}", f"{value / 10.0**power:.4g}"
    return times if digits == "1" else f"{digits}×{times}"


def _series(
    ax: Any, figure: Figure, mark: str, x: Any, y: Any, ends: tuple[Any, Any], look: dict[str, Any]
) -> None:
    low, high = ends
    colour = look["colour"]
    line = {"color": colour, "linewidth": 1.2, "linestyle": LINES[DASHES.index(tuple(look["dash"]))]}
    if mark in ("line", "step", "both"):
        how = {"drawstyle": "steps-post"} if mark == "step" else {}
        ax.plot(x, y, label=look["label"], **line, **how)
    if mark in ("line", "step") and np.isfinite(low).any():
        ax.fill_between(
            x, low, high, color=colour, alpha=0.15, linewidth=0, step="post" if mark == "step" else None
        )
    elif np.isfinite(low).any():
        (ax.hlines if figure.sideways else ax.vlines)(
            y if figure.sideways else x, low, high, color=colour, linewidth=1
        )
    label = {} if mark == "both" else {"label": look["label"]}
    if mark in ("points", "both", "stems"):
        ax.plot(x, y, MARKERS[look["shape"]], color=colour, markersize=4, **label)
    if mark == "stems":
        ax.vlines(x, 0, y, color=colour, linewidth=1.2)
    if mark == "ticks":
        ax.plot(
            x, y, "|" if figure.sideways else "_", color=colour, markersize=11, markeredgewidth=1.8, **label
        )
    if mark == "bars":
        ax.barh(y, x, height=0.6, color=colour, alpha=0.75, **label)


def save_as(file: Path, sheet: Any) -> Path:
    """A sheet in the format of the file's suffix, the same bytes for the same sheet."""
    import matplotlib
    from matplotlib.backend_bases import get_registered_canvas_class

    undated = {"svg": {"Date": None}, "pdf": {"CreationDate": None}}
    kind = file.suffix[1:].lower()
    with matplotlib.rc_context(
        {"svg.hashsalt": file.stem, "svg.fonttype": "none", "font.family": "sans-serif"}
    ):
        if kind not in undated:
            return write_figure(file, sheet)
        # `savefig` draws everything once before, to find places that the drawing finds anyway.
        canvas, stream = get_registered_canvas_class(kind)(sheet), io.BytesIO()
        getattr(canvas, f"print_{kind}")(stream, metadata=undated[kind])
        return write_whole(file, stream.getvalue())


def save_figure(folder: Path, named: tuple[str, Figure]) -> None:
    """Save a figure under its file's name as SVG and PDF, the same bytes for the same figure."""
    name, figure = named
    folder.mkdir(parents=True, exist_ok=True)
    sheet = drawn(figure)
    save_as(folder / f"{name}.svg", sheet)
    sheet.set_layout_engine("none")  # everything has its place by now, and finding it takes half the time
    save_as(folder / f"{name}.pdf", sheet)
