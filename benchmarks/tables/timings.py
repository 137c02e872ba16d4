"""The rows of `oed speed`: what a call takes beside a baseline, in turn in one run, and whether that meets its target."""

import statistics
import time
import tracemalloc
from collections.abc import Callable
from typing import Any

Call = Callable[[], Any]


def timed(call: Call) -> tuple[float, Any]:
    """Seconds of a call, and its result."""
    begin = time.perf_counter()
    result = call()
    return time.perf_counter() - begin, result


def in_turn(*calls: Call, rounds: int) -> list[tuple[float, Any]]:
    """Median seconds and last result of each call, measured one after the other, round by round."""
    found = [[timed(call) for call in calls] for _ in range(rounds)]
    return [
        (statistics.median(seconds for seconds, _ in each), each[-1][1]) for each in zip(*found, strict=True)
    ]


def peak_mb(call: Call) -> float:
    """Most memory that Python's allocator held during a call."""
    tracemalloc.start()
    call()
    most = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    return most / 2**20


def speed_row(
    name: str, size: str, seconds: float, baseline: str | None, other: float | None, target: float | None, *,
    peak: float | None = None, same: bool = True, **more: Any,
) -> dict[str, Any]:  # fmt: skip
    """A row; it holds where the baseline takes `target` times as long, and the two results are the `same`."""
    ratio = None if other is None else other / seconds
    holds = None if ratio is None or target is None else bool(ratio >= target and same)
    return {
        "name": name, "size": size, "seconds": seconds, "baseline": baseline, "baseline_seconds": other, "ratio": ratio,
        "target": target, "holds": holds, "peak_mb": peak, **more,
    }  # fmt: skip
