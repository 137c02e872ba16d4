"""Rows of one record that are also in another: by copying, or by chance where signals are coarse or periodic."""

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from oed.data import Record

FEWEST = 8
"""Consecutive rows from which on a copy is thought of; single rows agree by chance where signals are rounded."""


def copied_rows(train: Record, test: Record) -> int:
    """Length of the longest stretch of the test record that must have been copied from the training record."""
    rows = np.concatenate([np.concatenate((r.u, r.y), axis=1) for r in (train, test)])
    rows = np.where(np.isnan(rows), np.inf, rows)  # missing samples are equal
    _, names = np.unique(rows, axis=0, return_inverse=True)
    names = names.ravel()
    windows = _Windows(names)
    n, total = len(train), len(rows)

    def shared(length: int) -> bool:
        names = windows.of(length)
        return bool(np.intersect1d(names[: n - length + 1], names[n:]).size)

    def repeated(first: int, stop: int, length: int) -> bool:
        names = windows.of(length)[first : stop - length + 1]
        return len(np.unique(names)) < len(names)

    shorter = min(len(train), len(test))
    if shorter < FEWEST or not shared(FEWEST):
        return 0
    longest = _longest(shared, shorter)
    if longest == len(test):
        return longest
    of = windows.of(longest)
    _, here, there = np.intersect1d(of[: n - longest + 1], of[n:], return_indices=True)
    own = max(
        _longest(lambda k: repeated(0, n, k), n - 1), _longest(lambda k: repeated(n, total, k), total - n - 1)
    )
    return (
        longest
        if longest > 2 * max(own, _by_chance(names[:n], names[n:], int(here[0]), int(there[0]), longest))
        else 0
    )


def _by_chance(a: NDArray[np.int64], b: NDArray[np.int64], here: int, there: int, length: int) -> float:
    """Longest agreement to be expected of two repeats of one experiment, from how often their other rows agree.

    The records are laid so that the stretch from `here` in one and from `there` in the other meet. Runs of agreement at a
    rate q over n rows are log n / log(1/q) long at most, give or take a few 1/log(1/q).
    """
    first = min(here, there)
    count = min(len(a) - here, len(b) - there) + first
    same = a[here - first : here - first + count] == b[there - first : there - first + count]
    same[first : first + length] = False
    rest = max(count - length, 1)
    q = (same.sum() + 1.0) / (rest + 2.0)
    return float(np.log(max(count, 2)) / np.log(1.0 / q))


class _Windows:
    """Names of all windows of a sequence, equal where the windows are, by doubling their length."""

    def __init__(self, names: NDArray[np.int64]) -> None:
        self.known = {1: names}

    def of(self, length: int) -> NDArray[np.int64]:
        half = 1 << (length.bit_length() - 1)
        for k in (2**j for j in range(1, half.bit_length())):
            if k not in self.known:
                self.known[k] = self._joined(self.known[k // 2], k // 2)
        return self.known[half] if half == length else self._joined(self.known[half], length - half)

    @staticmethod
    def _joined(names: NDArray[np.int64], later: int) -> NDArray[np.int64]:
        pairs = names[: len(names) - later] * (int(names.max()) + 1) + names[later:]
        return np.unique(pairs, return_inverse=True)[1].ravel()


def _longest(found: Callable[[int], bool], most: int) -> int:
    """The largest length up to `most` that is found, where all shorter ones are."""
    low, high = 0, most
    while low < high:
        middle = (low + high + 1) // 2
        low, high = (middle, high) if found(middle) else (low, middle - 1)
    return low
