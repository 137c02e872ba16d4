"""Compile the loops ahead, so that no run waits for them: `python -m estimators.compiled`.

Numba compiles a function when it first meets its arguments, and keeps the result beside its file, or in NUMBA_CACHE_DIR, until the
file changes. `make setup` calls this once; without it, two workers that begin together would both compile the same, and the first
diagnosis takes half a minute more."""

from concurrent.futures import ProcessPoolExecutor

import numpy as np
from numpy.typing import NDArray
from scipy.signal import lfilter


def _local_models() -> None:
    from estimators.norm.local_models import local_peak
    from estimators.rules.power import power_iterations
    from estimators.rules.trace import run
    from oed.experiments import simulated
    from oed.plants.named import named_plant

    experiment = simulated(named_plant("reference"))
    local_peak(run(power_iterations, experiment, samples=100, experiments=6, rng=np.random.default_rng(0)))


def _iterations() -> None:
    from estimators.montecarlo.engine import monte_carlo
    from estimators.montecarlo.noise_ahead import noise_of_replicates
    from oed.plants.named import named_plant
    from oed.plants.norms import peak

    peak(named_plant("reference"))
    monte_carlo(named_plant("reference"), 20, 2, 2)
    noise_of_replicates((1, 2), 0, 1, 20)


def _predictors() -> None:
    from estimators.pem import identify
    from oed.data import Record

    rng = np.random.default_rng(0)
    u, e = rng.normal(size=(2, 200))
    record = Record(u, np.convolve(u, [0.0, 1.0, 0.5])[:200] + e)
    for structure, orders in (("oe", (1, 1)), ("ss", (1,))):
        identify(record, structure, orders, search="quick")


def _named_effects() -> None:
    from estimators import diagnose
    from oed.data import Record

    rng = np.random.default_rng(0)
    u = np.repeat(rng.normal(size=80), 5)
    diagnose(Record(u, _answer(np.clip(u, -0.8, 0.8)) + 0.02 * rng.normal(size=400)))


def _discoveries() -> None:
    from estimators import diagnose
    from oed.data import Record

    rng = np.random.default_rng(0)
    u = np.repeat(rng.normal(size=(80, 2)), 5, axis=0)
    bent = u[:, 0] + np.sin(2.0 * _answer(u[:, 0])) * u[:, 1] ** 2
    diagnose(Record(u, _answer(bent) + 0.02 * rng.normal(size=400)))


def _answer(u: NDArray[np.float64]) -> NDArray[np.float64]:
    """(N,) of a lag to an input."""
    return np.asarray(lfilter([0.0, 0.3], [1.0, -0.7], u))


def compile_all() -> None:
    """Compile on two processes what is not yet in the cache."""
    parts = (_discoveries, _named_effects, _local_models, _iterations, _predictors)
    with ProcessPoolExecutor(2) as pool:
        for task in [pool.submit(part) for part in parts]:
            task.result()


if __name__ == "__main__":
    compile_all()
