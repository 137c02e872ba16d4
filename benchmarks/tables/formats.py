"""Tables of results: rows are dictionaries; as text, Markdown, LaTeX, CSV and Parquet.

A key `name_se` is the standard error of `name`: what people read shows both as 1.234 ± 0.012, what programs
read (CSV, Parquet) keeps two columns with all digits."""

import csv
import io
import json
import math
import os
from collections.abc import Mapping, Sequence
from numbers import Integral, Real
from pathlib import Path
from typing import Any

from oed.errors import InputError
from oed.files import write_bytes
from oed.files.limits import file_content
from oed.files.parquet import open_parquet, read_columns, table_bytes

Row = Mapping[str, Any]
Columns = Mapping[str, str] | Sequence[str] | None
ABSENT = "–"
METADATA = b"oed.table"


def format_value(value: Any, se: Any = None) -> str:
    """A value for people: with its standard error to two significant digits, such as 1.234 ± 0.012."""
    value = _plain(value)
    if not _is_number(value):
        return _words(value)
    number, error, exponent = _digits(float(value), se, isinstance(value, Integral))
    shown = number if error is None else f"{number} ± {error}"
    if exponent is None:
        return shown
    return f"{shown}e{exponent:+03d}" if error is None else f"({shown})e{exponent:+03d}"


def _is_number(value: Any) -> bool:
    return isinstance(value, Real) and not isinstance(value, bool) and math.isfinite(value)


def _words(value: Any) -> str:
    if value is None or (isinstance(value, Real) and math.isnan(value)):
        return ABSENT
    if isinstance(value, bool):
        return "yes" if value else "no"
    if isinstance(value, Real):
        return "∞" if float(value) > 0 else "-∞"
    return str(value)


def _digits(value: float, se: Any, whole: bool) -> tuple[str, str | None, int | None]:
    """Digits of a value, of its standard error, and the power of ten that both are multiplied by."""
    error = float(se) if _is_number(se) and float(se) >= 0 else None
    if error is None:
        if whole or (value.is_integer() and abs(value) < 1e6):
            return str(int(value)), None, None
        mantissa, exponent = f"{value:.3e}".split("e")
        if value and not -4 <= int(exponent) <= 5:
            return mantissa, None, int(exponent)
        shown = f"{value:.{max(0, 3 - int(exponent))}f}"
        # A setting such as 0.1 is exactly that; 0.1000 would say that it was measured.
        return (shown.rstrip("0") if float(shown) == value and "." in shown else shown), None, None
    if error == 0:
        return f"{value:.6g}", "0", None
    size = math.floor(math.log10(max(abs(value), error)))
    exponent = None if -4 <= size <= 5 else size
    scale = 10.0 ** -(exponent or 0)
    value, error = value * scale, error * scale
    decimals = 1 - int(f"{error:.1e}".split("e")[1])
    most = 4 - math.floor(math.log10(abs(value))) if value else decimals
    # Nobody reads a sixth digit: say that the error is smaller than the last one shown.
    if decimals > most + 1:
        most = max(0, most)
        return f"{value:.{most}f}", f"<{10.0**-most:.{most}f}", exponent
    value, error = round(value, decimals) + 0.0, round(error, decimals)  # no -0.00
    return f"{value:.{max(0, decimals)}f}", f"{error:.{max(0, decimals)}f}", exponent


def _layout(rows: Sequence[Row], columns: Columns) -> dict[str, str]:
    """Heading by key; by default all keys in the order in which they appear, without the standard errors."""
    if columns is None:
        keys = list(dict.fromkeys(key for row in rows for key in row))
        return {key: key for key in keys if not (key.endswith("_se") and key[:-3] in keys)}
    layout = dict(columns) if isinstance(columns, Mapping) else {key: key for key in columns}
    known = {key for row in rows for key in row}
    unknown = [key for key in layout if rows and key not in known]
    if unknown:
        raise InputError(
            f"no row has the columns {', '.join(unknown)}; the rows have {', '.join(sorted(known))}."
        )
    return layout


def _cells(row: Row, layout: Mapping[str, str]) -> list[tuple[Any, Any]]:
    return [(row.get(key), None if f"{key}_se" in layout else row.get(f"{key}_se")) for key in layout]


def _numeric(rows: Sequence[Row], key: str) -> bool:
    values = [row[key] for row in rows if row.get(key) is not None]
    return bool(values) and all(isinstance(v, Real) and not isinstance(v, bool) for v in values)


def to_text(rows: Sequence[Row], columns: Columns = None) -> str:
    """Table for a terminal, columns aligned, numbers to the right."""
    layout = _layout(rows, columns)
    right = [_numeric(rows, key) for key in layout]
    body = [[" ".join(format_value(*cell).split()) for cell in _cells(row, layout)] for row in rows]
    heads = list(layout.values())
    widths = [max(map(len, column)) for column in zip(heads, *body)]
    lines = [heads, ["-" * width for width in widths], *body]
    return "\n".join(
        "  ".join(c.rjust(w) if r else c.ljust(w) for c, w, r in zip(line, widths, right)).rstrip()
        for line in lines
    )


def to_markdown(rows: Sequence[Row], columns: Columns = None) -> str:
    """Table in Markdown."""
    layout = _layout(rows, columns)
    rule = ["---:" if _numeric(rows, key) else "---" for key in layout]
    body = [[_escape_markdown(format_value(*cell)) for cell in _cells(row, layout)] for row in rows]
    lines = [[_escape_markdown(head) for head in layout.values()], rule, *body]
    return "".join(f"| {' | '.join(line)} |\n" for line in lines)


def _escape_markdown(text: str) -> str:
    for mark in ("\\", "|", "*", "_", "`", "<", "["):
        text = text.replace(mark, f"\\{mark}")
    return " ".join(text.split())


def to_latex(rows: Sequence[Row], columns: Columns = None, caption: str = "", label: str = "") -> str:
    r"""Table in LaTeX, for the package booktabs."""
    layout = _layout(rows, columns)
    align = "".join("r" if _numeric(rows, key) else "l" for key in layout)
    lines = [rf"\begin{{tabular}}{{{align}}}", r"\toprule"]
    lines += [" & ".join(map(escape_latex, layout.values())) + r" \\", r"\midrule"]
    lines += [" & ".join(_latex_cell(*cell) for cell in _cells(row, layout)) + r" \\" for row in rows]
    lines += [r"\bottomrule", r"\end{tabular}"]
    if caption or label:
        head = [r"\begin{table}", r"\centering"]
        head += [rf"\caption{{{caption}}}"] if caption else []
        head += [rf"\label{{{label}}}"] if label else []
        lines = [*head, *lines, r"\end{table}"]
    return "\n".join(lines) + "\n"


def _latex_cell(value: Any, se: Any) -> str:
    value = _plain(value)
    if not _is_number(value):
        return escape_latex(_words(value))
    number, error, exponent = _digits(float(value), se, isinstance(value, Integral))
    shown = number if error is None else rf"{number} \pm {error}"
    if exponent is not None:
        shown = (shown if error is None else f"({shown})") + rf" \times 10^{{{exponent}}}"
    return f"${shown}$"


LATEX = {
    "\\": r"\textbackslash{}", "~": r"\textasciitilde{}", "^": r"\textasciicircum{}", "<": r"\textless{}",
    ">": r"\textgreater{}", "|": r"\textbar{}", '"': r"\textquotedbl{}", "–": "--", "∞": r"$\infty$", "±": r"$\pm$",
    **{mark: f"\\{mark}" for mark in "&%$#_{}"},
}  # fmt: skip


def escape_latex(text: str) -> str:
    """Text in which nothing is a command of LaTeX."""
    return " ".join("".join(LATEX.get(mark, mark) for mark in text).split())


def _keys(rows: Sequence[Row], columns: Columns) -> list[str]:
    keys = list(dict.fromkeys(key for row in rows for key in row)) if columns is None else list(columns)
    if not rows or not keys:
        raise InputError("there are no rows to write; a table has at least one row and one column.")
    if columns is not None:
        _layout(rows, columns)
    return keys


def _plain(value: Any) -> Any:
    """NumPy's numbers and arrays as Python's."""
    return value.tolist() if type(value).__module__ == "numpy" else value


def to_csv(
    rows: Sequence[Row], path: str | os.PathLike[str], columns: Columns = None, *, overwrite: bool = False
) -> Path:
    """Table as CSV with all digits; None is an empty entry."""
    keys = _keys(rows, columns)
    stream = io.StringIO(newline="")
    writer = csv.writer(stream, lineterminator="\n")
    writer.writerow(keys)
    writer.writerows([_plain(row.get(key)) for key in keys] for row in rows)
    return write_bytes(path, stream.getvalue().encode(), overwrite=overwrite)


def to_parquet(
    rows: Sequence[Row], path: str | os.PathLike[str], metadata: Mapping[str, Any] | None = None,
    columns: Columns = None, *, overwrite: bool = False,
) -> Path:  # fmt: skip
    """Table as Parquet, with metadata that says what made it."""
    import pyarrow as pa

    arrays = {}
    for key in _keys(rows, columns):
        try:
            arrays[key] = pa.array([_plain(row.get(key)) for row in rows], from_pandas=False)
        except pa.ArrowException as error:
            message = str(error).splitlines()[0]
            raise InputError(
                f"the column {key} cannot be stored ({message}); give it one type of values."
            ) from None
    table = pa.table(arrays).replace_schema_metadata({METADATA: json.dumps(dict(metadata or {})).encode()})
    return write_bytes(path, table_bytes(table), overwrite=overwrite)


def from_parquet(path: str | os.PathLike[str]) -> tuple[list[dict[str, Any]], dict[str, Any]]:
    """Rows and metadata of a file that `to_parquet` wrote."""
    import pyarrow as pa

    try:
        table = read_columns(open_parquet(file_content(Path(path))))
        metadata = json.loads((table.schema.metadata or {}).get(METADATA, b"{}"))
    except (OSError, pa.ArrowException, ValueError) as error:
        message = (str(error).splitlines() or [type(error).__name__])[0]
        raise InputError(f"the table {str(path)!r} cannot be read ({message}); make it again.") from None
    return table.to_pylist(), metadata
