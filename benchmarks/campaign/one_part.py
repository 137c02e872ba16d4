"""One unit of work of a campaign: a few replicates of one input on one plant, and every estimator on its records.

Seeds are functions of names: the noise of (seed, plant, replicate, experiment) and the generator of (seed,
plant, method, replicate). All methods meet the same plants and the same noise."""

import re
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import lru_cache
from hashlib import blake2b
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.campaign.deadline import TimeLimit, within
from benchmarks.campaign.plants import content_of, load_plant
from benchmarks.campaign.registry import ESTIMATORS, Estimate, compatible, fits, method_for
from benchmarks.campaign.settings import Settings
from oed.covariances import on_one_thread
from oed.errors import CampaignError, Status, interruption
from oed.experiments import simulated
from oed.information import information_of_each
from oed.signals.noise import noise_key

ENDED = (Exception, SystemExit, GeneratorExit)
"""What may come out of code of a user's own without anybody having ended the campaign."""
CHUNK = 5
"""Replicates of the first parts: small enough that a kill loses seconds."""
LARGEST = 1000
"""Replicates of the largest parts: a million are about a thousand files."""

SEVERAL_TENS, MOST_NOISE = 32, 2**16
"""Replicates of a part from which on the noise of many is computed together, and samples of each up to which it is."""

Row = dict[str, Any]


@dataclass(frozen=True)
class Part:
    """One unit of work: a few replicates of one method on one plant at one noise level. `plant` name;
    `noise_variance` level; `method` name; `start, stop` first replicate, and the one after the last."""

    plant: str
    noise_variance: float
    method: str
    start: int
    stop: int

    @property
    def combination(self) -> tuple[str, float, str]:
        """Plant, noise variance and method."""
        return self.plant, self.noise_variance, self.method

    @property
    def key(self) -> str:
        """File name of the part."""
        digest = blake2b(repr(self.combination).encode(), digest_size=6).hexdigest()
        name = re.sub(
            r"[^\w.+-]+", "-", f"{Path(self.plant).stem[:60]}-{Path(self.method).stem[:60]}", flags=re.ASCII
        )
        return f"{name}-{digest}-{self.start:07d}-{self.stop:07d}"


def boundaries(replicates: int) -> list[tuple[int, int]]:
    """First replicate of every part and the one after its last."""
    found, start = [], 0
    while start < replicates:
        size = min(LARGEST, max(CHUNK, 10 ** (len(str(start)) - 1) // 2))
        found.append((start, min(start + size, replicates)))
        start += size
    return found


def parts(settings: Settings, replicates: int) -> list[Part]:
    """All units of work of a campaign, in a fixed order."""
    found = []
    for plant in settings.plants:
        loaded = load_plant(plant)
        for variance in settings.noise_variances:
            for method in settings.methods:
                if fits(method, loaded):
                    runs = settings.replicates_of(replicates, plant, method, noise_variance=variance)
                    found += [Part(plant, variance, method, *ends) for ends in boundaries(runs)]
    return sorted(found, key=lambda part: part.start)  # stable: plants, noise and methods stay in order


def checkpoints(experiments: int) -> list[int]:
    """Numbers of experiments after which the information is kept."""
    marks = [m * 10**e for e in range(7) for m in (1, 2, 5)]
    return sorted({m for m in marks if m < experiments} | {experiments})


SEVERAL = 3
"""Replicates of a data profile on a plant with several channels, whose fits take most of a campaign."""


def profile_replicates(settings: Settings, plant: Any) -> int:
    """In how many replicates the estimators also run after parts of the budget."""
    most = settings.profile_replicates
    return most if plant.n_inputs * plant.n_outputs == 1 else min(most, SEVERAL)


def profile_marks(settings: Settings, plant: Any) -> list[int]:
    """After how many experiments."""
    channels = plant.n_inputs * plant.n_outputs
    return [m for m in checkpoints(settings.experiments) if channels == 1 or m > channels]


def seed_for(*names: object) -> np.random.Generator:
    """A generator whose seed is a function of names."""
    digest = blake2b(repr(names).encode(), digest_size=16).digest()
    return np.random.default_rng(int.from_bytes(digest, "little"))


@lru_cache(maxsize=64)
def _prepared(plant: str, noise_variance: float, method: str, content: str) -> tuple[Any, Callable[..., Any]]:
    """Plant and method, built once per process and content of the plant's file."""
    loaded = load_plant(plant, noise_variance)
    return loaded, method_for(method, loaded)


@on_one_thread
def run_part(
    settings: Settings,
    part: Part,
    *,
    time_limit: float | None = None,
    own: Mapping[str, Callable[..., Any]] | None = None,
) -> list[Row]:
    """Run the replicates of a part."""
    import scipy.signal  # noqa: F401 - before the clock starts: loading it is no part of a run

    check_contents(settings, part.plant)
    own = own or {}
    rows: list[Row] = []
    sums: dict[int, Row] = {}
    noise = _Noise(settings, part)
    for replicate in range(part.start, part.stop):
        head, names = _head(part, replicate), _estimators(settings, part, replicate)
        try:
            plant, trace = within(time_limit, _run, settings, part, replicate, own, noise)
        except ENDED as error:  # a method that raises is a row of the table, not the end of the campaign
            rows += [_row(head, name, final=True, **_failure(error)) for name in names or [""]]
            continue
        _add_information(sums, head, settings, plant, trace)
        for name in names:
            marks = profile_marks(settings, plant) if replicate < profile_replicates(settings, plant) else []
            for k in (*(m for m in marks if m < len(trace)), len(trace)):
                estimator = own.get(name) or ESTIMATORS[name]
                rows.append(_estimated(head, name, estimator, trace.first(k), plant, time_limit))
                rows[-1]["final"] = k == len(trace)
    check_contents(settings, part.plant)
    return rows + [sums[k] | {"information": sums[k]["information"].tolist()} for k in sorted(sums)]


def killed_rows(settings: Settings, part: Part) -> list[Row]:
    """The rows of a part whose process is killed whenever it is run."""
    return [
        _row(_head(part, replicate), name, final=True, message="the process that ran it was killed")
        for replicate in range(part.start, part.stop)
        for name in _estimators(settings, part, replicate) or [""]
    ]


def _head(part: Part, replicate: int) -> Row:
    plant, noise_variance, method = part.combination
    return {"plant": plant, "noise_variance": noise_variance, "method": method, "replicate": replicate}


def _estimators(settings: Settings, part: Part, replicate: int) -> list[str]:
    """Which estimates a replicate has, by the pairs that fit and the limits."""
    plant, variance, method = part.combination
    return [
        name
        for name in settings.estimators
        if compatible(method, name)
        and replicate < settings.replicates_of(part.stop, plant, method, name, variance)
    ]


def check_contents(settings: Settings, *plants: str) -> None:
    """Raise where a plant's file is no longer what the settings were made with."""
    known = dict(settings.contents)
    for plant in plants:
        if content_of(plant) != known.get(plant, ""):
            raise CampaignError(
                f"the plant file {plant} was changed while the campaign ran; what was finished is kept: restore it, or "
                "give another --out."
            )


class _Noise:
    """The noise of the replicates of a large part, computed for many of them at once."""

    def __init__(self, settings: Settings, part: Part) -> None:
        self.settings, self.part = settings, part
        # together: a run that is given up may be interrupted between two
        self.held: tuple[int, Any] = (0, ())

    def of(self, plant: Any, replicate: int) -> dict[int, Any] | None:
        """By experiment; None where the part is small or its noise large: it is then computed run by run."""
        size = (self.settings.experiments, self.settings.samples, plant.n_outputs)
        if self.part.stop - self.part.start < SEVERAL_TENS or np.prod(size) > MOST_NOISE:
            return None
        first, block = self.held
        if not first <= replicate < first + len(block):
            from estimators.montecarlo.noise_ahead import noise_of_replicates

            block = noise_of_replicates(noise_key(self.settings.seed, plant.name), replicate, *size)
            first, self.held = replicate, (replicate, block)
        return dict(enumerate(block[replicate - first]))


def _run(
    settings: Settings, part: Part, replicate: int, own: Mapping[str, Any], noise: _Noise
) -> tuple[Any, Any]:
    if part.method in own:
        plant = load_plant(part.plant, part.noise_variance)
        method = own[part.method](plant)
    else:
        plant, method = _prepared(*part.combination, content_of(part.plant))
    experiment = simulated(
        plant, seed=settings.seed, replicate=replicate, expected=settings.experiments, computed=noise.of(plant, replicate),
    )  # fmt: skip
    rng = seed_for(settings.seed, part.plant, part.method, replicate)
    return plant, method(experiment, samples=settings.samples, iterations=settings.experiments, rng=rng)


def _failure(error: BaseException) -> Row:
    if stop := interruption(error):
        raise stop from None
    if isinstance(error, TimeLimit):
        return {"status": Status.TIME_LIMIT.name, "message": str(error)}
    return {"message": f"{type(error).__name__}: {error}"}


def _add_information(sums: dict[int, Row], head: Row, settings: Settings, plant: Any, trace: Any) -> None:
    """Add what the inputs of a trace carry to the sums over the replicates of the part."""
    n = len(plant.free)
    information, energy = np.zeros((n, n)), 0.0
    inputs = [r.u for r in trace.records]
    each = information_of_each(plant, inputs)
    done = 0
    for k in checkpoints(settings.experiments):
        if k > len(inputs):
            break
        information = information + each[done:k].sum(axis=0)
        energy += sum(float(np.vdot(u, u)) for u in inputs[done:k])
        done = k
        blank = {"information": np.zeros(n * n), "energy": 0.0, "peak_amplitude": 0.0}
        row = sums.setdefault(k, _row(head, "", status=Status.OK.name, **blank))
        row["information"] += information.ravel()
        row |= {
            "count": row["count"] + 1, "experiments": k, "samples": sum(len(r) for r in trace.records[:k]),
            "energy": row["energy"] + energy, "peak_amplitude": max(row["peak_amplitude"], trace.usage.peak),
        }  # fmt: skip


def _estimated(
    head: Row, name: str, estimator: Callable[..., Any], trace: Any, plant: Any, time_limit: float | None
) -> Row:
    usage = trace.usage
    head = head | {"experiments": usage.experiments, "samples": usage.samples}
    head |= {"energy": usage.energy, "peak_amplitude": usage.peak}
    try:
        estimate = within(time_limit, estimator, trace, plant)
        if not isinstance(estimate, Estimate):  # one's own estimator may return a plain number
            estimate = Estimate(float(estimate))
    except ENDED as error:
        return _row(head, name, **_failure(error))
    status, message = estimate.status, estimate.message
    if not np.isfinite(estimate.value) and status.ok:
        status, message = Status.NOT_FINITE, message or Status.NOT_FINITE.value
    value, error = estimate.value, estimate.standard_error
    return _row(head, name, estimate=value, standard_error=error, status=status.name, message=message)


def _row(head: Row, estimator: str, **values: Any) -> Row:
    blank = {
        "experiments": 0, "samples": 0, "energy": float("nan"), "peak_amplitude": float("nan"),
        "estimate": float("nan"), "standard_error": float("nan"), "status": Status.FAILED.name, "message": "",
        "final": False, "count": 0, "information": [float("nan")],
    }  # fmt: skip
    return blank | head | {"estimator": estimator} | values
