"""Diagnose, then ask: the next experiment is the one that best tells the two likeliest causes apart."""

from collections.abc import Generator, Sequence
from dataclasses import dataclass, field
from itertools import count

import numpy as np
from numpy.typing import NDArray

from estimators.rules.trace import Step
from oed.data import Record
from oed.errors import InputError, OedError

Array = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class Proposal:
    """The next input, and what it is for. `u` (N,) input; `causes` the two causes between which it decides;
    empty where none could be told apart; `power` predicted probability of the right decision with it; NaN
    where there is none; `white` the same with white noise of the same length within the same limits;
    `candidates` all that were considered."""

    u: Array
    causes: tuple[str, ...] = ()
    power: float = float("nan")
    white: float = float("nan")
    candidates: tuple[str, ...] = field(default=())


def diagnose_next(
    samples: int, n_inputs: int, n_outputs: int, rng: np.random.Generator, *, power: float = 1.0,
    amplitude: float = 3.0, seed: int = 0, known: Sequence[Array] = (),
) -> Generator[Step, Array, None]:  # fmt: skip
    """Experiments that find out what a linear model lacks: each decides between the two likeliest causes so
    far."""
    if (n_inputs, n_outputs) != (1, 1):
        raise InputError(
            f"experiments that diagnose need one input and one output, not {n_inputs} and {n_outputs}."
        )
    if samples < 120:
        raise InputError(f"experiments that diagnose have {samples} samples; give at least 120.")
    records: list[Record] = []
    for k in count():
        if k < len(known):
            u = known[k]
        else:
            u = propose(records, samples, power, amplitude, np.random.default_rng([seed, k])).u[:, None]
        y = yield Step(u, "decide" if k else "levels")
        records.append(Record(u, y))


def joined(records: Sequence[Record]) -> Record:
    """One record of several that each begin and end at rest."""
    return records[0].replace(
        u=np.concatenate([r.u for r in records]), y=np.concatenate([r.y for r in records])
    )


def propose(
    records: Sequence[Record], samples: int, power: float, amplitude: float, rng: np.random.Generator
) -> Proposal:
    """The next input of `diagnose_next`."""
    length = samples - samples // 8
    levels = Proposal(_silenced(_levels(length, power, amplitude, rng), samples))
    if not records:
        return levels
    from estimators.diagnosis.next_experiment import discriminate
    from estimators.diagnosis.policy import Setting
    from estimators.diagnosis.search.examination import examine

    try:
        found = examine(joined(records), 0, Setting()).attribution
        rivals = {c.cause: c.fit for c in reversed(found.claims[:6])}
        names = tuple(reversed(rivals))
        pair = [(name, rivals[name]) for name in names[:2]]
        if len(pair) < 2:
            pair.append(("none", found.base))
        if len(pair) < 2 or pair[0][1] is pair[1][1]:
            return levels
        (a, first), (b, second) = pair
        design = discriminate(
            first, second, length=length, amplitude=amplitude, power=power, rng=rng, rounds=4, size=10
        )
    except OedError:
        return levels  # nothing could be fitted: another general-purpose experiment is the honest next one
    if not design.distance > 0:
        return levels
    from scipy.stats import norm

    white = float(norm.cdf(np.sqrt(design.white) / 2))
    return Proposal(_silenced(design.u, samples), (a, b), design.power, white, names)


def _levels(length: int, power: float, amplitude: float, rng: np.random.Generator) -> Array:
    """Random levels held for 1 to 16 samples: they show statics and dynamics."""
    u = np.zeros(0)
    while len(u) < length:
        u = np.append(u, np.full(int(2 ** rng.integers(0, 5)), rng.uniform(-1, 1)))
    u = u[:length] * amplitude
    return u * min(1.0, float(np.sqrt(power / np.mean(u**2))))


def _silenced(u: Array, samples: int) -> Array:
    return np.concatenate((u, np.zeros(samples - len(u))))
