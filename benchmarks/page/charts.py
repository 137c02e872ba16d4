"""A declared figure as a Vega-Lite specification, by Altair; the page puts the rows of every panel into it."""

import json
import math
from collections.abc import Mapping, Sequence
from textwrap import wrap
from typing import Any

from benchmarks.page.content import Figure, series_of

COLOURS = ("#3b82c4", "#d1603d", "#2a9d73", "#a56cc1", "#b08a1e", "#7d8790")
"""Told apart with any colour vision (by their lightness and by dash and shape too), at least 3 : 1 on white and on dark."""
DASHES = ((1, 0), (6, 3), (2, 2), (8, 3, 2, 3))
SHAPES = ("circle", "square", "triangle-up", "diamond", "cross", "triangle-down")
ROOM = 0.04
"""Of a scale that stays free beside the values."""


def style(k: int) -> dict[str, Any]:
    """Colour, dash and shape of the k-th series; the dash changes when the colours begin again."""
    n = len(COLOURS)
    return {"colour": COLOURS[k % n], "dash": list(DASHES[(k // n) % len(DASHES)]), "shape": SHAPES[k % n]}


def extent(
    rows: Sequence[Mapping[str, Any]], keys: Sequence[str], log: bool, at: Sequence[float] = ()
) -> list[float]:
    """The limits of a scale: all values, half-intervals and rules, with a little room."""
    found = [float(row[k]) for row in rows for k in keys if isinstance(row.get(k), int | float)] + list(at)
    found = [v for v in found if math.isfinite(v) and (v > 0 or not log)]
    if not found:
        return [0.1, 1.0] if log else [0.0, 1.0]
    low, high = min(found), max(found)
    if log:
        room = max((high / low) ** ROOM, 1.05)
        return [_near(low / room), _near(high * room)]
    room = ROOM * (high - low) or ROOM * abs(high) or 1.0
    return [_near(low - room * (low != 0), room), _near(high + room * (high != 0), room)]


def _near(limit: float, room: float = 0.0) -> float:
    """A limit with as many digits as a pixel is worth."""
    return round(limit, 3 - math.floor(math.log10(room or limit)))


def chart(figure: Figure) -> dict[str, Any]:
    """The specification without rows: layers by the marks of the series, one colour scale, no legend (the page has its own)."""
    import altair as alt

    names = series_of(figure)
    styles = [style(k) for k in range(len(names))]
    encodings: list[Any] = [
        kind("series:N", legend=None, scale=alt.Scale(domain=names, range=[s[key] for s in styles]))
        for kind, key in ((alt.Color, "colour"), (alt.StrokeDash, "dash"), (alt.Shape, "shape"))
    ]
    colour, dash, shape = encodings
    value, place = ("x", "y") if figure.sideways else ("y", "x")
    axis = {key: _axis(figure, key, alt) for key in "xy"}
    base = alt.Chart(alt.NamedData("rows"))
    data = {"x": axis["x"], "y": axis["y"], "color": colour}
    ends = {value: axis[value].copy(), f"{value}2": "high:Q"}
    ends[value].shorthand = "low:Q"
    layers = []
    for mark in dict.fromkeys(figure.marks.get(name, "line") for name in names):
        group = [name for name in names if figure.marks.get(name, "line") == mark]
        part = base.transform_filter(alt.FieldOneOfPredicate(field="series", oneOf=group))
        sure = part.transform_filter("isValid(datum.low) && isValid(datum.high)")
        line: dict[str, Any] = {
            "strokeWidth": 1.6,
            "clip": True,
            "interpolate": "step-after" if mark == "step" else "linear",
        }
        if any(row.get("low") is not None and str(row.get("series") or "") in group for row in figure.rows):
            band = mark in ("line", "step")
            curve: dict[str, Any] = (
                {"opacity": 0.18, "interpolate": line["interpolate"]} if band else {"strokeWidth": 1.4}
            )
            drawn = (sure.mark_area if band else sure.mark_rule)(clip=True, **curve)
            layers.append(drawn.encode(**{place: axis[place], "color": colour}, **ends))
        if mark in ("line", "step", "both"):
            layers.append(part.mark_line(**line).encode(**data, strokeDash=dash, order=alt.Order("_at:Q")))
        if mark in ("points", "both", "stems") or (mark == "line" and _lonely(figure, group)):
            layers.append(
                part.mark_point(filled=True, size=45, opacity=1, clip=True).encode(**data, shape=shape)
            )
        if mark == "stems":
            layers.append(part.mark_rule(strokeWidth=1.6).encode(**data, y2=alt.datum(0)))
        if mark == "ticks":
            layers.append(
                part.mark_tick(thickness=2.5, orient="vertical" if figure.sideways else "horizontal").encode(
                    **data
                )
            )
        if mark == "bars":
            layers.append(part.mark_bar(opacity=0.75, height=14, clip=True).encode(**data))
    if figure.rules:
        at = axis[value].copy()
        at.shorthand = f"{value}:Q"
        ruled = alt.Chart(alt.InlineData([{value: v} for v in figure.rules]))
        layers.insert(
            0, ruled.mark_rule(color="currentColor", opacity=0.45, strokeDash=[4, 3]).encode(**{value: at})
        )
    whole = alt.layer(*layers).properties(width="container", height=_height(figure))
    if figure.zoom:
        whole = whole.add_params(*(alt.param(name=f"{'from' if k == 0 else 'to'}_x", value=v)
                                   for k, v in enumerate(_limits(figure, "x"))))  # fmt: skip
    spec = whole.to_dict()
    spec.pop("$schema", None)
    return spec


CONFIG = {
    "background": "transparent",
    "font": "system-ui, sans-serif",
    "view": {"stroke": None},
    "aria": False,
    "axis": {"labelColor": "currentColor", "titleColor": "currentColor", "tickColor": "currentColor", "titleFontWeight": 500,
             "domainColor": "currentColor", "gridColor": "currentColor", "gridOpacity": 0.12, "labelFontSize": 11,
             "titleFontSize": 12, "labelLimit": 220, "tickOpacity": 0.5, "domainOpacity": 0.5},
}  # fmt: skip
"""Colours are the page's own (`currentColor`), so that light, dark and print need no second drawing."""


def _height(figure: Figure) -> int:
    if figure.square:
        return 340
    if figure.sideways:
        panels = {str(row.get("panel") or "") for row in figure.rows}
        most = max(len({row["y"] for row in figure.rows if str(row.get("panel") or "") == p}) for p in panels)
        lines = max(len(wrap(str(row["y"]), LABEL[1])) for row in figure.rows)
        return max(60, max(24, 2 + 14 * lines) * most + 10)
    return 240


LABEL = 185, 28
"""Of a name beside a sideways figure: pixels, and the letters that fit into a line of so many."""


def _in_lines(names: Sequence[str]) -> str:
    """The expression that breaks the long ones of the names into lines."""
    broken = {name: wrap(name, LABEL[1]) for name in names if len(name) > LABEL[1]}
    return f"{json.dumps(broken)}[datum.label] || datum.label"


def _lonely(figure: Figure, names: Sequence[str]) -> bool:
    """Whether none of the series has two points in a panel, so that a line of it would not be seen."""
    places = [
        (row.get("panel"), row.get("series") or "")
        for row in figure.rows
        if str(row.get("series") or "") in names
    ]
    return len(set(places)) == len(places)


def _limits(figure: Figure, key: str) -> list[float]:
    value = "x" if figure.sideways else "y"
    keys = (key, "low", "high") if key == value else (key,)
    at = [
        *figure.rules,
        *([0.0] if set(figure.marks.values()) & {"bars", "stems"} and key not in figure.log else []),
    ]
    return extent(figure.rows, keys, key in figure.log, at if key == value else ())


def _axis(figure: Figure, key: str, alt: Any) -> Any:
    kind = alt.X if key == "x" else alt.Y
    title = getattr(figure, key)
    if figure.sideways and key == "y":
        order = list(dict.fromkeys(str(row["y"]) for row in figure.rows))
        return kind(
            "y:N",
            title=title or None,
            sort=order,
            axis=alt.Axis(labelLimit=LABEL[0], labelExpr=_in_lines(order)),
        )
    log = key in figure.log
    scale: dict[str, Any] = (
        {"type": "log", "nice": False} if log else {"type": "linear", "nice": False, "zero": False}
    )
    if figure.zoom and key == "x":
        scale |= {"domainMin": alt.ExprRef("from_x"), "domainMax": alt.ExprRef("to_x")}
    elif figure.shared or figure.square:
        scale["domain"] = _limits(figure, key)
    marks: dict[str, Any] = {"labelOverlap": True, "tickCount": 5}
    if all(float(row[key]).is_integer() for row in figure.rows if isinstance(row.get(key), int | float)):
        marks["tickMinStep"] = 1  # there is no half of an experiment
    if key == "x" and log:
        places = sorted(
            {row["x"] for row in figure.rows if isinstance(row["x"], int | float) and row["x"] > 0}
        )
        marks |= {"values": places} if len(places) <= 8 and not figure.sideways else {}
    return kind(f"{key}:Q", title=title or None, scale=alt.Scale(**scale), axis=alt.Axis(**marks))
