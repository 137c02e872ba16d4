"""Monte-Carlo campaigns: plants x noise x methods x replicates, resumable, the same on any number of workers.

Seeds are functions of names: the noise of (seed, plant, replicate, experiment) and the generator of (seed,
plant, method, replicate). All methods meet the same plants and the same noise.
"""

from __future__ import annotations

import os
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import asdict, dataclass
from functools import lru_cache
from hashlib import blake2b
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.methods import ESTIMATORS, METHODS, compatible, method_for
from benchmarks.plants import load_plant, plant_names
from benchmarks.store import Store
from oed.errors import InputError, Status, check_names
from oed.experiments import simulated
from oed.information import information_of_signal

__all__ = ["Settings", "run_campaign"]

CHUNK = 5
"""Replicates per part: small enough that a kill loses seconds."""


@dataclass(frozen=True)
class Settings:
    """What decides the numbers of a campaign.

    Attributes
    ----------
    plants : tuple of str
        Names or files.
    noise_variances : tuple of float
        For every plant (for hair-dryer in multiples of the identified variance).
    methods, estimators : tuple of str
        Names; pairs that do not fit are left out.
    samples, experiments : int
        N of every experiment, and how many.
    seed : int
        Of everything random.
    """

    plants: tuple[str, ...] = ("reference", "hair-dryer")
    noise_variances: tuple[float, ...] = (1.0, 4.0, 9.0)
    methods: tuple[str, ...] = ("white", "multisine", "power", "oracle-D", "oracle-hinf")
    estimators: tuple[str, ...] = ("rayleigh", "gain", "mu", "pem")
    samples: int = 1000
    experiments: int = 20
    seed: int = 0

    def __post_init__(self) -> None:
        check_names([p for p in self.plants if not p.endswith(".json")], plant_names(), "plant")
        check_names(self.methods, tuple(METHODS), "method")
        check_names(self.estimators, tuple(ESTIMATORS), "estimator")
        for name, least in (("samples", 10), ("experiments", 1)):
            if getattr(self, name) < least:
                raise InputError(f"{name} is {getattr(self, name)}; it must be at least {least}.")
        for variance in self.noise_variances:
            if not (np.isfinite(variance) and variance > 0):
                raise InputError(
                    f"the noise variance is {variance:g}; a comparison needs positive, finite ones."
                )
        for name in ("plants", "noise_variances", "methods", "estimators"):
            values = getattr(self, name)
            if not values or len(set(values)) != len(values):
                raise InputError(f"{name} is {values}; give at least one, and each once.")


@dataclass(frozen=True)
class Part:
    """One unit of work: a few replicates of one method on one plant at one noise level."""

    plant: str
    noise_variance: float
    method: str
    start: int
    stop: int

    @property
    def key(self) -> str:
        """File name of the part."""
        digest = blake2b(
            repr((self.plant, self.noise_variance, self.method)).encode(), digest_size=6
        ).hexdigest()
        return f"{Path(self.plant).stem}-{self.method}-{digest}-{self.start:07d}-{self.stop:07d}"


def parts(settings: Settings, replicates: int) -> list[Part]:
    """All units of work of a campaign, in a fixed order.

    Parameters
    ----------
    settings : Settings
        The campaign.
    replicates : int
        Monte-Carlo runs of every combination.

    Returns
    -------
    list of Part
        The first replicates of everything come first, so that a campaign cut short has something of all.
    """
    return [
        Part(plant, variance, method, start, min(start + CHUNK, replicates))
        for start in range(0, replicates, CHUNK)
        for plant in settings.plants
        for variance in settings.noise_variances
        for method in settings.methods
    ]


def checkpoints(experiments: int) -> list[int]:
    """Numbers of experiments after which the information is kept.

    Parameters
    ----------
    experiments : int
        The budget.

    Returns
    -------
    list of int
        1, 2, 5, 10, ... and the budget itself.
    """
    marks = [m * 10**e for e in range(7) for m in (1, 2, 5)]
    return sorted({m for m in marks if m < experiments} | {experiments})


@lru_cache(maxsize=64)
def _prepared(plant: str, noise_variance: float, method: str) -> tuple[Any, Callable[..., Any]]:
    """Plant and method, built once per process."""
    loaded = load_plant(plant, noise_variance)
    return loaded, method_for(method, loaded)


def seed_for(*names: object) -> np.random.Generator:
    """A generator whose seed is a function of names.

    Parameters
    ----------
    *names : object
        Their `repr` is hashed.

    Returns
    -------
    numpy.random.Generator
        The same on every machine and worker.
    """
    return np.random.default_rng(
        int.from_bytes(blake2b(repr(names).encode(), digest_size=16).digest(), "little")
    )


def run_part(settings: Settings, part: Part) -> list[dict[str, Any]]:
    """Run the replicates of a part.

    Parameters
    ----------
    settings : Settings
        The campaign.
    part : Part
        Which.

    Returns
    -------
    list of dict
        One row per replicate and estimator, and one per replicate and checkpoint with the information of the
        inputs so far (estimator "").
    """
    plant, method = _prepared(part.plant, part.noise_variance, part.method)
    rows = []
    for replicate in range(part.start, part.stop):
        experiment = simulated(plant, seed=settings.seed, replicate=replicate)
        rng = seed_for(settings.seed, part.plant, part.method, replicate)
        head = {
            "plant": part.plant,
            "noise_variance": part.noise_variance,
            "method": part.method,
            "replicate": replicate,
        }
        try:
            trace = method(experiment, samples=settings.samples, iterations=settings.experiments, rng=rng)
        except Exception as error:  # a method that raises is a row of the table, not the end of the campaign
            rows += [
                _row(head, name, message=f"{type(error).__name__}: {error}") for name in settings.estimators
            ]
            continue
        usage = trace.usage
        cost = {
            "experiments": usage.experiments,
            "samples": usage.samples,
            "energy": usage.energy,
            "peak_amplitude": usage.peak,
        }
        information = np.zeros((len(plant.free), len(plant.free)))
        marks = checkpoints(settings.experiments)
        energy = 0.0
        for k, record in enumerate(trace.records, 1):
            information = information + information_of_signal(plant, record.u)
            energy += float(np.sum(record.u**2))
            if k in marks:
                spent = {
                    "experiments": k,
                    "samples": k * settings.samples,
                    "energy": energy,
                    "peak_amplitude": usage.peak,
                }
                rows.append(
                    _row(head | spent, "", status=Status.OK.name, information=information.ravel().tolist())
                )
        for name in settings.estimators:
            if compatible(part.method, name):
                rows.append(_estimated(head | cost, name, trace, plant))
    return rows


def _estimated(head: dict[str, Any], name: str, trace: Any, plant: Any) -> dict[str, Any]:
    try:
        estimate = ESTIMATORS[name](trace, plant)
    except Exception as error:
        return _row(head, name, message=f"{type(error).__name__}: {error}")
    return _row(
        head,
        name,
        estimate=estimate.value,
        standard_error=estimate.standard_error,
        status=estimate.status.name,
        message=estimate.message,
    )


def _row(head: dict[str, Any], estimator: str, **values: Any) -> dict[str, Any]:
    blank = {
        "experiments": 0,
        "samples": 0,
        "energy": float("nan"),
        "peak_amplitude": float("nan"),
        "estimate": float("nan"),
        "standard_error": float("nan"),
        "status": Status.FAILED.name,
        "message": "",
        "information": [float("nan")],
    }
    return blank | head | {"estimator": estimator} | values


def run_campaign(
    settings: Settings,
    replicates: int,
    folder: Path,
    *,
    jobs: int | None = None,
    scheduler: str | None = None,
    progress: Callable[[int, int], None] | None = None,
) -> list[dict[str, Any]]:
    """Run or resume a campaign.

    Parameters
    ----------
    settings : Settings
        What decides the numbers.
    replicates : int
        Monte-Carlo runs; a folder with fewer is extended.
    folder : Path
        Where the parts are kept.
    jobs : int, optional
        Worker processes; default one per core.
    scheduler : str, optional
        Address of a Dask scheduler to run on instead (needs the extra `dask`).
    progress : callable, optional
        Called with the number of parts done and in all.

    Returns
    -------
    list of dict
        All rows, in an order that depends on nothing but the settings.
    """
    if replicates < 2:
        raise InputError(f"replicates is {replicates}; standard errors need at least 2.")
    store = Store(folder, asdict(settings))
    todo = parts(settings, replicates)
    rows = {part: store.read(part.key) for part in todo}
    missing = [part for part in todo if rows[part] is None]
    report = progress or (lambda done, total: None)
    report(len(todo) - len(missing), len(todo))
    for count, (part, result) in enumerate(
        _results(settings, missing, jobs, scheduler), len(todo) - len(missing) + 1
    ):
        store.write(part.key, result)
        rows[part] = result
        report(count, len(todo))
    return [row for part in todo for row in rows[part] or []]


def _results(
    settings: Settings, missing: list[Part], jobs: int | None, scheduler: str | None
) -> Iterator[tuple[Part, list[dict[str, Any]]]]:
    """Parts with their rows, as they are finished; the same code whoever does the work."""
    jobs = min(jobs or os.cpu_count() or 1, max(len(missing), 1))
    if scheduler is None and jobs <= 1:
        for part in missing:
            yield part, run_part(settings, part)
        return
    from joblib import Parallel, delayed, parallel_config

    if scheduler is None:
        backend: dict[str, Any] = {"backend": "loky", "inner_max_num_threads": 1, "n_jobs": jobs}
    else:
        backend = {"backend": "dask", "wait_for_workers_timeout": 30}
    with _connected(scheduler), parallel_config(**backend):
        work = Parallel(return_as="generator_unordered")  # type: ignore[arg-type]
        yield from work(delayed(_with_part)(settings, part) for part in missing)  # type: ignore[misc]


@contextmanager
def _connected(scheduler: str | None) -> Iterator[None]:
    """A client of the scheduler while the block runs; nothing without a scheduler."""
    if scheduler is None:
        yield
        return
    try:
        from distributed import Client
    except ImportError:
        raise InputError(
            '--scheduler needs the package distributed; install the extra: pip install "oed[dask]".'
        ) from None
    try:
        client = Client(scheduler, timeout=10)
    except (OSError, TimeoutError, ValueError) as error:
        raise InputError(
            f"no Dask scheduler answers at {scheduler} ({type(error).__name__}); start one with `dask scheduler` and "
            "give its address, such as tcp://127.0.0.1:8786."
        ) from None
    with client:
        yield


def _with_part(settings: Settings, part: Part) -> tuple[Part, list[dict[str, Any]]]:
    return part, run_part(settings, part)
