"""MAT files of version 5, read here: every tag and every size is checked before a byte of it is believed.

Malformed files end the process inside SciPy's compiled reader, which trusts them. Numbers, characters, cells and
structs are read; sparse matrices, objects and functions are None, as nothing here can use them."""

import zlib
from collections.abc import Iterator
from math import prod
from typing import Any

import numpy as np
from numpy.typing import NDArray

from oed.files.limits import check_limit

HEADER = 128
NUMBERS = {1: "i1", 2: "u1", 3: "i2", 4: "u2", 5: "i4", 6: "u4", 7: "f4", 9: "f8", 12: "i8", 13: "u8"}
"""NumPy's kinds of the elements that hold numbers."""
CLASSES = {6: "f8", 7: "f4", 8: "i1", 9: "u1", 10: "i2", 11: "u2", 12: "i4", 13: "u4", 14: "i8", 15: "u8"}
"""NumPy's kinds of the classes of numbers."""
TEXTS = {1: "latin-1", 2: "latin-1", 4: "utf-16", 16: "utf-8", 17: "utf-16", 18: "utf-32"}
INT32, UINT32, INT8, MATRIX, COMPRESSED = 5, 6, 1, 14, 15
CELL, STRUCT, CHAR = 1, 2, 4
COMPLEX, LOGICAL = 0x0800, 0x0200
MOST_AXES = 32
"""Axes of an array, as in NumPy before version 2."""


def is_mat5(content: bytes) -> bool:
    """Whether the header is that of version 5, in either byte order."""
    return content[124:128] in (b"\x00\x01IM", b"\x01\x00MI")


def read_mat5(content: bytes, source: str) -> dict[str, Any]:
    """The variables by name; a ValueError says what is wrong with the file, an InputError what it has too much of."""
    reader = _Reader("<" if content[126:128] == b"IM" else ">", source)
    found: dict[str, Any] = {}
    for kind, data in reader.elements(content[HEADER:], padded=False):
        if kind == COMPRESSED:
            unpacker = zlib.decompressobj()
            whole = unpacker.decompress(data, int(reader.left) + 1)
            reader.spend(len(whole))
            if not unpacker.eof:
                raise ValueError("a compressed variable is cut off")
            kind, data = next(reader.elements(whole), (0, b""))
        if kind != MATRIX:
            raise ValueError(f"an element of type {kind} stands where a variable should")
        name, value = reader.matrix(data, 0)
        if name in found:
            raise ValueError(f"it has two variables {name!r}")
        found[name] = value
    return found


class _Reader:
    """What all elements of a file share: byte order, and how much may still be expanded."""

    def __init__(self, order: str, source: str) -> None:
        self.order, self.source = order, source
        self.spent = 0.0
        self.left = check_limit("bytes", 0, source)

    def spend(self, size: float) -> None:
        """Count what was expanded or declared."""
        self.spent += size
        self.left = check_limit("bytes", self.spent, self.source)

    def elements(self, data: bytes, padded: bool = True) -> Iterator[tuple[int, bytes]]:
        """Type and bytes of one element after the other; compressed ones are not padded to eight bytes."""
        at = 0
        while at + 8 <= len(data):
            kind, size = (int(v) for v in np.frombuffer(data, f"{self.order}u4", 2, at))
            if kind >> 16:  # a small element: its type, size and up to four bytes in one tag
                kind, size = kind & 0xFFFF, kind >> 16
                if size > 4:
                    raise ValueError(f"a small element of {size} bytes")
                yield kind, data[at + 4 : at + 4 + size]
                at += 8
                continue
            start = at + 8
            if start + size > len(data):
                raise ValueError(f"an element of {size} bytes where {len(data) - start} are left")
            yield kind, data[start : start + size]
            at = start + size + (-size % 8 if padded or kind != COMPRESSED else 0)
        if data[at:].strip(b"\0"):
            raise ValueError(f"{len(data) - at} bytes too many at the end of an element")

    def matrix(self, data: bytes, depth: int) -> tuple[str, Any]:
        """Name and value of a variable, a cell or a field."""
        check_limit("depth", depth, self.source)
        if not data:
            return "", np.zeros((0, 0))
        parts = self.elements(data)
        flags = self.integers(next(parts, (0, b"")), UINT32, "flags")
        if len(flags) != 2:
            raise ValueError("the flags of a variable are damaged")
        kind = int(flags[0]) & 0xFF
        if kind not in CLASSES and kind not in (CELL, STRUCT, CHAR):
            return self.name_of_unread(parts), None
        shape = tuple(int(n) for n in self.integers(next(parts, (0, b"")), INT32, "size"))
        if not 2 <= len(shape) <= MOST_AXES or min(shape) < 0:
            raise ValueError(f"a variable of the size {shape}")
        size = prod(shape)
        self.spend(8.0 * size)
        name_kind, name = next(parts, (0, b""))
        if name_kind != INT8:
            raise ValueError("a variable without a name")
        return name.decode("latin-1"), self.value(kind, int(flags[0]), shape, size, parts, depth)

    def value(
        self, kind: int, flags: int, shape: tuple[int, ...], size: int, parts: Iterator[tuple[int, bytes]],
        depth: int,
    ) -> Any:  # fmt: skip
        """What follows the name: numbers, characters, cells or the fields of a struct."""
        if kind in CLASSES:
            real = self.numbers(next(parts, (0, b"")), size)
            if flags & COMPLEX:
                return (real + 1j * self.numbers(next(parts, (0, b"")), size)).reshape(shape, order="F")
            return real.astype(bool if flags & LOGICAL else CLASSES[kind]).reshape(shape, order="F")
        if kind == CHAR:
            return self.characters(next(parts, (0, b"")), shape, size)
        if kind == CELL:
            cells = np.empty(size, dtype=object)
            for k in range(size):
                cells[k] = self.child(parts, depth)
            return cells.reshape(shape, order="F")
        width = self.integers(next(parts, (0, b"")), INT32, "length of names")
        names = next(parts, (0, b""))[1]
        if len(width) != 1 or not 0 < width[0] <= len(names) + 1 or len(names) % int(width[0]):
            raise ValueError("the names of a struct's fields are damaged")
        step = int(width[0])
        check_limit("columns", len(names) // step, self.source)
        fields = [names[k : k + step].split(b"\0")[0].decode("latin-1") for k in range(0, len(names), step)]
        if len(set(fields)) != len(fields):
            raise ValueError("a struct has two fields of one name")
        if size != 1:  # nothing here has a use for arrays of structs
            return None
        return {field: self.child(parts, depth) for field in fields}

    def child(self, parts: Iterator[tuple[int, bytes]], depth: int) -> Any:
        """The next cell or field."""
        kind, data = next(parts, (0, b""))
        if kind != MATRIX:
            raise ValueError(f"an element of type {kind} stands where a cell or field should")
        return self.matrix(data, depth + 1)[1]

    def name_of_unread(self, parts: Iterator[tuple[int, bytes]]) -> str:
        """Name of a variable that is not read; objects have it in another place, so that it may be of its class."""
        return next((data.decode("latin-1") for kind, data in parts if kind == INT8), "")

    def integers(self, element: tuple[int, bytes], wanted: int, what: str) -> NDArray:
        """Whole numbers of 32 bits."""
        kind, data = element
        if kind not in (INT32, UINT32) or (kind != wanted and what == "flags") or len(data) % 4:
            raise ValueError(f"the {what} of a variable is an element of type {kind}")
        return np.frombuffer(data, self.order + NUMBERS[kind])

    def numbers(self, element: tuple[int, bytes], size: int) -> NDArray:
        """Numbers in the kind in which they are stored, which may be smaller than that of their class."""
        kind, data = element
        if kind not in NUMBERS and not (size == 0 and not data):
            raise ValueError(f"numbers of type {kind}")
        found = np.frombuffer(data, self.order + NUMBERS.get(kind, "f8"))
        if len(found) != size:
            raise ValueError(f"{len(found)} numbers where {size} are declared")
        return found.astype(found.dtype.newbyteorder("="))

    def characters(self, element: tuple[int, bytes], shape: tuple[int, ...], size: int) -> NDArray[np.str_]:
        """One text per row."""
        kind, data = element
        if not size:
            return np.array([], dtype=str)
        if kind not in TEXTS or len(shape) != 2:
            raise ValueError(f"characters of type {kind} and size {shape}")
        suffix = {"<": "-le", ">": "-be"}[self.order] if TEXTS[kind].startswith("utf-") and kind != 16 else ""
        letters = list(data.decode(TEXTS[kind] + suffix))
        if len(letters) != size:
            raise ValueError(f"{len(letters)} characters where {size} are declared")
        return np.array(["".join(letters[row :: shape[0]]) for row in range(shape[0])], dtype=str)
