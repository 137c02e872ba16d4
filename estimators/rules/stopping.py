"""When to stop iterating: the estimate changes by less than its own standard error.

The budget of experiments is an argument of `run`; this is its `stop`."""

from collections.abc import Callable

import numpy as np

from estimators.norm.gains import Gains, gain
from estimators.rules.trace import Trace
from oed.errors import InputError


def settled(
    estimator: Callable[[Trace], Gains] = gain, *, window: int = 10, share: float = 1.0
) -> Callable[[Trace], bool]:
    """A stopping rule: the last iterations agree with those before them. Two neighbouring windows of
    iterations are compared: their means differ by less than `share` times the standard error of the
    difference, computed from their own scatter. Without noise the scatter is the remaining drift itself, and
    a relative change below 1e-6 stops."""
    if window < 3 or not share > 0:
        raise InputError(f"window is {window} and share {share}; they must be at least 3 and positive.")

    def stop(trace: Trace) -> bool:
        parts = trace.iterations
        sizes = [part.stop - part.start for part in parts]
        if len(parts) < 2 * window + 1 or sizes[-1] < sizes[0]:
            return False  # too early, or in the middle of an iteration
        values = estimator(trace).values[-2 * window :]
        if not np.isfinite(values).all():
            return False
        before, now = values[:window], values[window:]
        change = abs(now.mean() - before.mean())
        if change < 1e-6 * abs(now.mean()):
            return True
        rough = [np.mean(np.diff(half) ** 2) / 2 for half in (before, now)]  # scatter without the drift
        return bool(change < share * np.sqrt(sum(rough) / window))

    return stop
