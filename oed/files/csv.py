"""CSV: a header row, then numbers; every float is read to the last bit."""

import csv
import io
import math
import re
from codecs import BOM_UTF16_BE, BOM_UTF16_LE
from collections.abc import Sequence
from datetime import datetime

import numpy as np
from numpy.typing import NDArray

from oed.data import Record
from oed.errors import InputError
from oed.files.limits import check_limit
from oed.files.tables import Table, columns_of, seconds_per

BLANK = ("", "na", "n/a", "nan", "null", "none", "-nan")
"""Entries, in lower case, that mark a missing sample."""


def csv_table(content: bytes, source: str) -> Table:
    """Table of a CSV file: comma, semicolon, tab or bar between the columns, lines before the header that begin
    with # and Excel's `sep=;` are passed over. Decimal commas are read where semicolons or tabs part the columns and no number has a decimal
    point."""
    try:  # spreadsheets write "Unicode text" in UTF-16, with a mark
        text = content.decode("utf-16" if content.startswith((BOM_UTF16_LE, BOM_UTF16_BE)) else "utf-8-sig")
    except UnicodeDecodeError as error:
        raise InputError(
            f"{source} is not text in UTF-8 ({error}); save the table as CSV in UTF-8."
        ) from None
    if "\0" in text:
        raise InputError(
            f"{source} is not a text file (it has null characters, as a logger leaves that lost its power); export it again, or keep its whole rows."
        )
    text = text.replace("\r\n", "\n").replace("\r", "\n")  # whoever wrote it ended lines in one of three ways
    stream = io.StringIO(text, newline="")
    header, comment = "", ""
    for header in stream:
        if header.strip() and not header.startswith("#") and not re.fullmatch(r"sep=.\s*", header):  # Excel's
            break
        comment, header = header.strip() or comment, ""
    delimiter = next((mark for mark in (",", ";", "\t", "|") if mark in header), ",")
    check_limit("columns", header.count(delimiter), source)
    names = _fields(header, delimiter)
    body = stream.tell()
    if header and all(_is_number(name) for name in names):
        if len(names) != len(_fields(comment.lstrip("# "), delimiter)) or not comment:
            raise InputError(
                f"{source} has no header: its first row is {header.strip()[:60]!r}; "
                "the first row must name the columns, for example t,u,y."
            )
        names = _fields(comment.lstrip("# "), delimiter)  # NumPy's savetxt marks its header as a comment
        body -= len(header)
    first = _fields(text[body : body + 1000].lstrip("\r\n").partition("\n")[0], delimiter)
    if len(names) == len(first) == 1 and len(names[0].split()) == len(first[0].split()) > 1:
        raise InputError(
            f"the columns of {source} have blanks between them; write commas, semicolons, tabs or bars there."
        )
    if not any(map(seconds_per, names)):  # a column of dates is the clock, whatever it is called
        dates = [k for k, entry in enumerate(first[: len(names)]) if _is_date(entry)]
        names = ["t" if [k] == dates[:1] else name for k, name in enumerate(names)]
    if not any(names):
        raise InputError(f"{source} is empty; a CSV file has a header row such as t,u,y and rows of numbers.")

    def load(wanted: Sequence[str]) -> list[NDArray[np.float64]]:
        return _parse(text[body:], names, wanted, delimiter, source)

    return Table(source, tuple(names), load)


def _fields(line: str, delimiter: str) -> list[str]:
    return [name.strip() for name in next(csv.reader([line.strip("\r\n ")], delimiter=delimiter), [])]


def _is_number(entry: str) -> bool:
    try:
        float(entry)
    except ValueError:
        return False
    return True


def _parse(
    body: str, names: list[str], wanted: Sequence[str], delimiter: str, source: str
) -> list[NDArray[np.float64]]:
    """The fast reader; where it stops, the slow one either understands the entry or says where it stands."""
    if not body.strip():
        return [np.empty(0) for _ in wanted]
    where = [names.index(name) for name in wanted]
    # Decimal commas, and no point that they could group.
    if delimiter != "," and "," in body and "." not in body:
        body = body.replace(",", ".")
    try:
        table = np.loadtxt(io.StringIO(body), delimiter=delimiter, usecols=where, ndmin=2, comments=None)
        # loadtxt lets single rows be longer or shorter than the header, as one with a decimal comma is
        counts = [line.count(delimiter) for line in body.splitlines() if line.strip()]
        even = len(counts) == len(table) and {*counts} <= {len(names) - 1}
    except ValueError:
        even = False
    if not even:
        table = _parse_slowly(body, names, where, delimiter, source)
    return list(table.T.copy())


def _parse_slowly(
    body: str, names: list[str], where: list[int], delimiter: str, source: str
) -> NDArray[np.float64]:
    rows: list[list[float]] = []
    origin: list[datetime] = []
    for fields in csv.reader(io.StringIO(body, newline=""), delimiter=delimiter):
        if not any(field.strip() for field in fields):
            continue
        row = len(rows)
        if len(fields) < len(names) or any(field.strip() for field in fields[len(names) :]):
            raise InputError(
                f"row {row} (counting from 0) of {source} has {len(fields)} entries where the header has {len(names)} "
                "columns; they must be equal: the file may be cut off, or have commas for decimal points."
            )
        if row == 0 and not any(map(_is_value, fields[: len(names)])):
            raise InputError(
                f"the row after the header of {source} has no number ({','.join(fields)[:60]!r}); one row names the columns: "
                "write units into it, as u [V], and take the other row out."
            )
        dates = {k for k in where if seconds_per(names[k]) == 1 and (origin or _is_date(fields[k]))}
        rows.append(
            [
                _seconds(fields[k], row, names[k], source, origin)
                if k in dates
                else _number(fields[k], row, names[k], source)
                for k in where
            ]
        )
    return np.array(rows, dtype=float).reshape(len(rows), len(where))


def _seconds(entry: str, row: int, column: str, source: str, origin: list[datetime]) -> float:
    """A date of a column of times, in seconds from the first of them."""
    try:
        date = datetime.fromisoformat(entry.strip())
        return (date - (origin or origin.append(date) or origin)[0]).total_seconds()
    except (ValueError, TypeError):
        raise InputError(
            f"row {row} (counting from 0), column {column} of {source} is {entry[:40]!r}; times are numbers or dates like "
            "2024-01-31 12:00:00.05, all of one kind and time zone: correct it or leave the column out."
        ) from None


def _is_date(entry: str) -> bool:
    return re.match(r"\s*\d{4}-\d\d-\d\d", entry) is not None


def _is_value(entry: str) -> bool:
    """Whether an entry may be of a row of data: it has a digit, or marks a missing sample."""
    return any(map(str.isdigit, entry)) or entry.strip().lower() in BLANK


def _number(entry: str, row: int, column: str, source: str) -> float:
    entry = entry.strip()
    if entry.lower() in BLANK:
        return math.nan
    if _is_number(entry) and "_" not in entry:
        return float(entry)
    hint = "correct it or leave the column out"
    if "," in entry and _is_number(entry.replace(",", ".")):
        hint = "write decimal points, not commas"
    elif _is_number(re.sub("[\\u2212\\u2013]", "-", entry)) and "_" not in entry:
        hint = "write minus as -, not as a dash"
    elif _is_number(re.sub(r"[,'\s_\u2019]", "", entry)):
        hint = "write them without marks between the thousands"
    elif re.match(r"\d{1,4}[-./]\d{1,2}[-./]\d{1,4}", entry):
        hint = "write dates like 2024-01-31 12:00:00.05, or the time in seconds"
    elif entry.lower() in ("true", "false"):
        hint = "write 1 and 0"
    elif re.fullmatch(r"[-+]?[\d.]+(e[-+]?\d+)? ?[^\d\s]+", entry, re.IGNORECASE):
        hint = "write its unit into the header, as u [V], not into the cells"
    raise InputError(
        f"row {row} (counting from 0), column {column} of {source} is {entry[:40]!r}; entries must be numbers: {hint}."
    )


def csv_bytes(record: Record) -> bytes:
    """A record as CSV: the column t, the inputs, the outputs, each number with all its digits."""
    stream = io.StringIO(newline="")
    writer = csv.writer(stream, lineterminator="\n")
    writer.writerow(["t", *columns_of(record)])
    writer.writerows(np.column_stack([record.t, record.u, record.y]).tolist())
    return stream.getvalue().encode()
