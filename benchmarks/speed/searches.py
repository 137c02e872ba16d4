"""Speed of searches for orders above the plant's, and of the first fit on a machine, against limits in CPU seconds."""

import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from typing import Any

import numpy as np
from numpy.typing import NDArray

from benchmarks.tables.timings import speed_row
from oed.data import Record

SAMPLES, SEEDS, ROUNDS = 2000, 2, 2


def _plant(rng: np.random.Generator, order: int) -> tuple[NDArray, NDArray]:
    """A stable B / F with one sample of delay."""
    roots: list[complex] = []
    while len(roots) < order:
        size = rng.uniform(0.3, 0.95)
        if order - len(roots) > 1:
            root = size * np.exp(1j * rng.uniform(0.1, 3.0))
            roots += [root, root.conjugate()]
        else:
            roots.append(size)
    return np.r_[0.0, rng.normal(size=order)], np.real(np.poly(roots))


def _record(
    rng: np.random.Generator, channels: int, colour: tuple[list[float], list[float]] = ([1.0], [1.0])
) -> Record:
    """Second-order responses from every input to every output, with noise of a third of each output's size."""
    from scipy.signal import lfilter

    u, e = rng.normal(size=(2, SAMPLES, channels))
    y = np.zeros((SAMPLES, channels))
    for i in range(channels):
        for j in range(channels):
            y[:, i] += lfilter(*_plant(rng, 2), u[:, j])
    noise = np.asarray(lfilter(colour[0], colour[1], e, axis=0))
    return Record(u, y + 0.3 * y.std(axis=0) * noise / noise.std(axis=0))


def _states(rng: np.random.Generator, order: int) -> Record:
    """Modes that four inputs drive and four outputs see."""
    from scipy.signal import lfilter

    u, e = rng.normal(size=(2, SAMPLES, 4))
    modes = np.column_stack([
        lfilter(*_plant(rng, 2), u @ rng.normal(size=4)) for _ in range(order // 2)
    ])  # fmt: skip
    y = modes @ rng.normal(size=(order // 2, 4))
    return Record(u, y + 0.2 * y.std(axis=0) * e)


def searched(
    name: str, made: Callable[[np.random.Generator], Record], structure: str, orders: Any, limit: float
) -> dict:
    """The slowest of some records, with levels and initial states estimated and without, each the least of some rounds."""
    from estimators.pem import identify

    found, ends = [], []
    for seed in range(SEEDS):
        record = made(np.random.default_rng(seed))
        for offset in (False, True):
            least = np.inf
            for _ in range(ROUNDS):
                begin = time.process_time()
                fit = identify(record, structure, orders, offset=offset)
                least = min(least, time.process_time() - begin)
                ends.append(fit.status.name)
            found.append(least)
    size = f"{name}, N = {SAMPLES}"
    return speed_row(f"search-{structure}", size, max(found), "limit", limit, 1.0) | {
        "note": f"CPU seconds; ends: {', '.join(sorted(set(ends)))}"
    }


def first_fit(limit: float = 5.0) -> dict:
    """CPU seconds that the first fit takes more than the second, where nothing is compiled yet."""
    script = (
        "import time\n"
        "import numba, scipy.linalg, scipy.signal\n"
        "import numpy as np\n"
        "from estimators.pem import identify\n"
        "from oed.data import Record\n"
        "u, e = np.random.default_rng(0).normal(size=(2, 500))\n"
        "record, spent = Record(u, np.r_[0.0, u[:-1]] + 0.1 * e), []\n"
        "for _ in range(2):\n"
        "    begin = time.process_time()\n"
        "    identify(record, 'oe', (2, 2))\n"
        "    spent.append(time.process_time() - begin)\n"
        "print(spent[0] - spent[1])\n"
    )
    with tempfile.TemporaryDirectory() as folder:
        own = os.environ | {"NUMBA_CACHE_DIR": folder}
        done = subprocess.run(
            [sys.executable, "-c", script], capture_output=True, text=True, check=True, env=own
        )
    return speed_row(
        "search-first", "oe of order 2, nothing compiled", float(done.stdout), "limit", limit, 1.0
    )


def rows() -> list[dict]:
    """Every row of this file."""
    coloured = lambda rng: _record(rng, 1, ([1.0, 0.5], [1.0, -0.8]))
    return [
        searched("OE(3,3), 3 x 3, plant of order 2", lambda rng: _record(rng, 3), "oe", (3, 3), 3.0),
        searched("order 8, 4 x 4, plant of order 8", lambda rng: _states(rng, 8), "ss", (8,), 3.0),
        searched("order 8, 4 x 4, plant of order 6", lambda rng: _states(rng, 6), "ss", (8,), 3.0),
        searched("OE(4,4), plant of order 2", lambda rng: _record(rng, 1), "oe", (4, 4), 0.2),
        searched("BJ(10,10,10,10), plant of order 2", coloured, "bj", (10, 10, 10, 10), 1.0),
        searched("OE(30,30), plant of order 2", lambda rng: _record(rng, 1), "oe", (30, 30), 2.0),
        first_fit(),
    ]  # fmt: skip
