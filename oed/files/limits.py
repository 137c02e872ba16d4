"""How much a file may ask for: small files can declare columns, nesting and gigabytes that nobody recorded.

Each limit can be raised by an environment variable, which its message names."""

import errno
import math
import os
import stat
from pathlib import Path

from oed.errors import InputError

LIMITS = {
    # Bytes of a file, and of its content once expanded: 67 million numbers. Reading takes up to three times as much.
    "bytes": 2**29,
    # Columns or arrays: the largest of the published records has some hundred.
    "columns": 10_000,
    # Groups in groups, structs in structs: MATLAB's own have two or three.
    "depth": 32,
    # Seconds of a reader that works in a process of its own: a whole file of the largest size takes three.
    "seconds": 15,
}


def check_limit(what: str, value: float, source: str) -> float:
    """Raise if a file asks for more than the limit on `what`; the value that is left is the limit minus the value."""
    name = f"OED_MOST_{what.upper()}"
    given = os.environ.get(name, "")
    if given and not (given.isdecimal() and len(given) < 20):  # more digits than any file has bytes
        raise InputError(f"{name} is {given!r:.40}; give a whole number.")
    most = int(given) if given else LIMITS[what]
    if value > most:
        asked = f"{value:,.0f}" if value < math.inf else f"more than {most:,}"
        raise InputError(
            f"{source} asks for {asked} {what}, and at most {most:,} are read; if that is meant, set {name} higher."
        )
    return most - value


def plain_file(path: Path) -> Path:
    """A file that ends; an OSError, as of one that cannot be opened, where it is a pipe or a device."""
    if not (path.is_dir() or stat.S_ISREG(path.stat().st_mode)):
        raise OSError(errno.EINVAL, "it is a device or a pipe; give a file", str(path))
    return path


def own_file(path: Path) -> Path:
    """A file that is written in place; an OSError where it is a link: a folder from somebody else may hold one to any file."""
    if path.is_symlink():
        raise OSError(errno.ELOOP, "it is a link to another file; remove it", str(path))
    return path


def file_content(path: Path) -> bytes:
    """The bytes of a plain file of bounded size."""
    check_limit("bytes", plain_file(path).stat().st_size, path.name)
    return path.read_bytes()
