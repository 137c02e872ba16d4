"""Speed of prediction-error identification: output error of order 2 and 6, ours and the baselines in turn.

The same data, the same start, the same optimum (checked: the baseline's loss must not be lower). Times are
medians; the first call of each, which compiles or builds, is not counted."""

import subprocess
import sys

import numpy as np
from numpy.typing import NDArray

from benchmarks.tables.timings import in_turn, speed_row, timed
from oed.data import Record

RADIUS, NOISE = 0.9, 0.3


def _case(order: int, samples: int) -> tuple[Record, NDArray, NDArray]:
    """A record of a plant with resonances across the band, a start some per cent off, the true parameters."""
    from scipy.signal import lfilter

    rng = np.random.default_rng([order, samples])
    angles = np.linspace(0.4, 2.4, order // 2)
    f = np.real(np.poly(np.concatenate([RADIUS * np.exp(s * 1j * angles) for s in (1, -1)])))
    b = np.concatenate([[0.0], rng.normal(size=order)])
    u = rng.normal(size=samples)
    clean = np.asarray(lfilter(b, f, u))
    record = Record(u, clean + NOISE * clean.std() * rng.normal(size=samples))
    theta = np.concatenate([b[1:], f[1:]])
    return record, theta * (1 + 0.005 * rng.normal(size=len(theta))), theta


def against_scipy(order: int, samples: int, repeats: int = 15) -> dict:
    """Our fit against `scipy.optimize.least_squares` with `lfilter` and finite differences."""
    from scipy.optimize import least_squares
    from scipy.signal import lfilter

    from estimators.pem import identify

    record, start, _ = _case(order, samples)
    u, y = record.u[:, 0], record.y[:, 0]
    ours = lambda: identify(record, "oe", (order, order), start=start, offset=False)
    residual = lambda x: y - np.asarray(lfilter(np.r_[0.0, x[:order]], np.r_[1.0, x[order:]], u))
    theirs = lambda: least_squares(residual, start)
    fit = ours()
    (seconds, _), (other, solution) = in_turn(ours, theirs, rounds=repeats)
    same = fit.loss <= 2 * solution.cost / samples * (1 + 1e-6)
    target = 2.0 if samples >= 10_000 else 0.0
    size = f"order {order}, N = {samples}"
    return speed_row("pem-oe", size, seconds, "scipy least_squares with lfilter", other, target, same=same)


def against_casadi(order: int, samples: int) -> dict:
    """Our fit against the plain CasADi construction: mapaccum over the record, IPOPT with the exact Hessian."""
    from estimators.pem import identify
    from estimators.pem.predictors.plain import plain_output_error

    record, start, _ = _case(order, samples)
    ours = lambda: identify(record, "oe", (order, order), start=start, offset=False)
    fit = ours()
    ((seconds, _),) = in_turn(ours, rounds=5)
    solve = plain_output_error(record, order)
    other, (_, loss) = timed(lambda: solve(start))
    return speed_row(
        "pem-oe", f"order {order}, N = {samples}", seconds, "CasADi mapaccum with IPOPT", other, 100.0,
        same=fit.loss <= loss * (1 + 1e-6),
    )  # fmt: skip


def against_sippy(samples: int = 10_000) -> dict:
    """Our fit against SIPPY's output-error estimator, where it is installed."""
    from estimators.pem import identify

    record, _, _ = _case(2, samples)
    ours = lambda: identify(record, "oe", (2, 2), offset=False)
    fit = ours()
    ((seconds, _),) = in_turn(ours, rounds=5)
    size = f"order 2, N = {samples}"
    try:
        from sippy_unipi import system_identification  # pyright: ignore[reportMissingImports]
    except ImportError:
        return speed_row("pem-oe", size, seconds, "SIPPY", None, 100.0, note="sippy-unipi is not installed")
    from scipy.signal import lfilter

    theirs = lambda: system_identification(
        record.y.T, record.u.T, "OE", OE_orders=[2, 2, 0], max_iterations=300
    )
    other, model = timed(theirs)
    b, f = np.ravel(model.NUMERATOR), np.ravel(model.DENOMINATOR)
    loss = float(np.mean((record.y[:, 0] - np.asarray(lfilter(np.r_[0.0, b], f, record.u[:, 0]))) ** 2))
    return speed_row(
        "pem-oe", size, seconds, "SIPPY", other, 100.0, same=fit.loss <= loss * (1 + 1e-6),
        note=f"loss {fit.loss:.8g}, SIPPY's {loss:.8g}",
    )  # fmt: skip


def _fits(seeds: list[int], samples: int) -> float:
    """Fit one record for each seed; the sum of the losses, so that nothing is left out."""
    from scipy.signal import lfilter

    from estimators.pem import identify

    total = 0.0
    for seed in seeds:
        rng = np.random.default_rng([0, seed])
        u = rng.normal(size=samples)
        clean = np.asarray(lfilter([0, 0.2155, 0.2012], [1, -0.9854, 0.8187], u))
        total += identify(Record(u, clean + rng.normal(size=samples)), offset=False).loss
    return total


def monte_carlo(replicates: int = 1000, samples: int = 1000, jobs: int = 2) -> dict:
    """Many fits with their own starts and their own records, shared between processes."""
    from joblib import Parallel, delayed

    parts = [list(range(k, replicates, jobs)) for k in range(jobs)]
    with Parallel(n_jobs=jobs) as workers:
        workers(delayed(_fits)([0], samples) for _ in range(2 * jobs))  # imports and the compiled kernel
        seconds, losses = timed(lambda: list(workers(delayed(_fits)(part, samples) for part in parts)))
    row = speed_row("pem-monte-carlo", f"{replicates} fits, N = {samples}", seconds, "limit", 10.0, 1.0)
    mean = sum(map(float, losses)) / replicates
    return row | {"note": f"wall time of {jobs} processes; mean loss {mean:.4f}"}


def memory(order: int = 6, samples: int = 100_000) -> dict:
    """Peak memory of a fit above the process after its imports, measured in a fresh process."""
    script = (
        "import re, resource, sys, time\n"
        "from pathlib import Path\n"
        "from benchmarks.speed.pem import _case\n"
        "from estimators.pem import identify\n"
        "def peak():\n"
        "    status = Path('/proc/self/status')  # ru_maxrss would be that of the process that started this one\n"
        "    if status.exists():\n"
        "        return float(re.search(r'VmHWM:\\s+(\\d+)', status.read_text())[1]) / 1024\n"
        "    size = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss\n"
        "    return size / (2**20 if sys.platform == 'darwin' else 1024)\n"
        f"small, start, _ = _case({order}, 1000)\n"
        f"identify(small, 'oe', ({order}, {order}), start=start)\n"
        "before = peak()\n"
        f"record, start, _ = _case({order}, {samples})\n"
        "begin = time.perf_counter()\n"
        f"identify(record, 'oe', ({order}, {order}), start=start)\n"
        "print(time.perf_counter() - begin, peak() - before)\n"
    )
    done = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, check=True)
    seconds, peak = map(float, done.stdout.split())
    row = speed_row(
        "pem-memory", f"order {order}, N = {samples}", seconds, "limit 150 MB", None, 150.0, peak=peak
    )
    return row | {"holds": peak <= 150.0}


def subspace_over_its_rows(samples: int = 10_000, horizon: int = 100) -> dict:
    """A subspace model of the default horizon against one triangular factor of the rows that it could be made of: it took 2.6 of
    them with all horizons compared, pseudoinverses and a sum over each lag, and takes .7."""
    from scipy.signal import lfilter

    from estimators.pem import identify
    from estimators.pem.subspace.hankel import windows

    rng = np.random.default_rng(0)
    u = rng.normal(size=samples)
    record = Record(u, np.asarray(lfilter([0, 0.5], [1, -0.8], u)) + 0.3 * rng.normal(size=samples))
    joint = np.column_stack((record.u, record.y))
    (seconds, _), (other, _) = in_turn(
        lambda: identify(record, "ss", (1,), method="moesp", offset=False),
        lambda: np.linalg.qr(windows(joint, horizon, 0, samples - horizon + 1), mode="r"),
        rounds=3,
    )
    return speed_row("pem-subspace", f"order 1, N = {samples}", seconds, "QR of the rows", other, 1 / 1.5)


def rows() -> list[dict]:
    """Every row of this file."""
    table = [against_scipy(order, samples) for order in (2, 6) for samples in (1000, 10_000, 100_000)]
    return [
        *table, against_casadi(2, 100_000), against_sippy(), subspace_over_its_rows(), monte_carlo(),
        memory(),
    ]  # fmt: skip
