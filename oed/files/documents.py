"""JSON and TOML documents, read strictly: one line that names the key for whatever is wrong with them.

A document is text of bounded size in UTF-8, in which no key occurs twice and every number is finite; a schema says
which keys it has. Its entries carry a `description`: the rule in words, as the message states it."""

import difflib
import json
import math
import tomllib
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from oed.errors import InputError, OedError
from oed.files.limits import file_content

LARGEST = 64 * 2**20
"""Bytes of a document: the largest models and settings here have some hundred kilobytes."""
LARGEST_TOML = 2**20
"""Bytes of a TOML document: its reader is slow, and those here are written by hand."""
MOST = 1_000_000
"""Values in a document: checked in seconds. A report of a campaign of 20 rows has 7000."""
LONGEST_NUMBER = 400
"""Digits of a number in a document: a double needs 17, written out at most 325."""
SHOWN = 60
"""Characters of a wrong value that a message repeats."""

TEXT = {"type": "string", "description": "a text"}
FLAG = {"type": "boolean", "description": "true or false"}
WHOLE = {"type": "integer", "description": "a whole number"}
NUMBER = {"type": "number", "description": "a number"}


def listed(items: Mapping[str, Any], what: str, **limits: int) -> dict[str, Any]:
    """Schema of a list of `what`."""
    return {"type": "array", "items": items, "description": f"a list of {what}", **limits}


def read_document(
    path: str | Path, schema: Mapping[str, Any], what: str, *, error: type[OedError] = InputError
) -> dict[str, Any]:
    """The content of a JSON or (by its suffix) TOML file that follows a schema; `what` names it, as "the plant file"."""
    path = Path(path)
    where = f"{what} {path}"
    try:
        size, most = path.stat().st_size, LARGEST_TOML if path.suffix == ".toml" else LARGEST
        text = file_content(path).decode("utf-8-sig") if size <= most else ""
    except OSError as reason:
        raise error(
            f"{where} cannot be read ({reason.strerror or reason}); check the name and the folder."
        ) from None
    except UnicodeDecodeError as reason:
        raise error(f"{where} is not text in UTF-8 (byte {reason.start}); save it as UTF-8.") from None
    except ValueError:  # a null byte in the path
        raise error(f"{what} {str(path)!r} has no name that a file can have.") from None
    if size > most:
        raise error(f"{where} has {size:,} bytes; at most {most:,} are read.")
    if path.suffix == ".toml":
        try:
            content: Any = tomllib.loads(text)
        except (tomllib.TOMLDecodeError, ValueError, RecursionError) as reason:
            raise error(f"{where} is not TOML ({_words(reason)}); mend that line.") from None
        return checked(content, schema, where, error=error)
    return checked(parsed_json(text, where, error=error), schema, where, error=error)


def parsed_json(text: str, where: str, *, error: type[OedError] = InputError) -> Any:
    """JSON text as Python values; refused are keys that occur twice, numbers that are not finite, deep nesting, and more
    values than can be checked in seconds."""
    if sum(map(text.count, ",[{")) > MOST:
        raise error(f"{where} has more than {MOST:,} values; that many are not read.")
    try:
        return json.loads(
            text, object_pairs_hook=_once, parse_constant=_constant, parse_float=_float, parse_int=_int
        )
    except json.JSONDecodeError as reason:
        raise error(f"{where} is not JSON (line {reason.lineno}: {reason.msg}); mend that line.") from None
    except RecursionError:
        raise error(f"{where} is nested too deeply to be read.") from None
    except ValueError as reason:
        raise error(f"{where}: {reason}") from None


def checked(
    content: Any, schema: Mapping[str, Any], where: str, *, error: type[OedError] = InputError
) -> Any:
    """The content, where it follows the schema and its numbers are finite; else the first wrong key in words."""
    from jsonschema import Draft202012Validator
    from jsonschema.exceptions import relevance

    try:
        _check_finite(content, "")
        wrong = sorted(Draft202012Validator(schema).iter_errors(content), key=relevance)
    except RecursionError:
        raise error(f"{where} is nested too deeply to be read.") from None
    except ValueError as reason:
        raise error(f"{where}: {reason}") from None
    if wrong:
        raise error(f"{where}: {_complaint(wrong[-1])}")
    return content


def keyed(
    properties: Mapping[str, Any], required: tuple[str, ...] = (), *, others: Mapping[str, Any] | None = None
) -> dict[str, Any]:
    """Schema of an object with these keys and no others, unless `others` says what those hold."""
    return {
        "type": "object",
        "properties": dict(properties),
        "required": list(required),
        "additionalProperties": False if others is None else dict(others),
        "description": "an object of " + ", ".join(properties or ("any keys",)),
    }


def _complaint(wrong: Any) -> str:
    path = "".join(f"[{p}]" if isinstance(p, int) else f".{p}" for p in wrong.absolute_path).lstrip(".")
    if wrong.validator == "additionalProperties":
        known = list(wrong.schema["properties"])
        key = next(k for k in wrong.instance if k not in known)
        close = difflib.get_close_matches(key, known, 1)
        hint = f" (did you mean {close[0]}?)" if close else ""
        inside = f" in {path}" if path else ""
        return f"the key {_shown(key)}{inside} is unknown{hint}; choose from {', '.join(known)}."
    if wrong.validator == "required":
        key = next(k for k in wrong.validator_value if k not in wrong.instance)
        return f"the key {f'{path}.{key}'.lstrip('.')!r} is missing."
    rule = wrong.schema.get("description") or f"{wrong.validator} {wrong.validator_value}"
    return f"{path or 'it'} is {_shown(wrong.instance)}; it must be {rule}."


def _shown(value: Any) -> str:
    text = repr(value)
    return text if len(text) <= SHOWN else f"{text[:SHOWN]}.."


def _words(reason: BaseException) -> str:
    return " ".join(str(reason).split())[:200] or type(reason).__name__


def _check_finite(value: Any, path: str) -> None:
    """Numbers of TOML and of Python may be infinite, or whole numbers beyond every double."""
    if isinstance(value, dict):
        for key, entry in value.items():
            _check_finite(entry, f"{path}.{key}".lstrip("."))
    elif isinstance(value, list | tuple):
        for k, entry in enumerate(value):
            _check_finite(entry, f"{path}[{k}]")
    elif isinstance(value, float) and not math.isfinite(value):
        raise ValueError(f"{path or 'it'} is {value}; numbers must be finite.")
    elif isinstance(value, int) and abs(value) > 10**308:
        raise ValueError(f"{path or 'it'} is a whole number beyond 1e308; numbers must be representable.")


def _once(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
    found: dict[str, Any] = {}
    for key, value in pairs:
        if key in found:
            raise ValueError(f"the key {_shown(key)} occurs twice; give it once.")
        found[key] = value
    return found


def _constant(name: str) -> Any:
    raise ValueError(f"it holds the number {name}; numbers must be finite.")


def _float(text: str) -> float:
    value = float(text) if len(text) <= LONGEST_NUMBER else math.inf
    if not math.isfinite(value):
        raise ValueError(f"it holds the number {_shown(text)}; numbers must be finite doubles.")
    return value


def _int(text: str) -> int:
    if len(text) > LONGEST_NUMBER:
        raise ValueError(f"it holds a number of {len(text)} digits; numbers must be finite doubles.")
    return int(text)
