"""Sequential optimal design: experiment, fit, redesign. Rules that know a model structure but not its values.

Where orders and delay are None, both are chosen from the records. The optimal input depends on the plant that it is to find. `two_stage` spends a share of the experiments on white
noise, fits once and then applies the optimum for the fitted model; `sequential` redesigns again and again. What
earlier experiments have told enters every design as prior information, so that the designs need not determine again
what is known. For the peak gain `sequential` hedges: the optimum for a known plant is one sinusoid at the peak, which
tells nothing about whether the peak is elsewhere; it applies the mean of the optima of plants drawn from what is known
so far, a multisine as wide as the peak is uncertain."""

from collections.abc import Generator
from typing import Any

import numpy as np
from numpy.typing import NDArray

from estimators.residual.algebra import powers_of_two
from estimators.rules.trace import Rule, Step
from oed.data import Record, Spectrum
from oed.errors import InputError, OedError
from oed.plants.plant import Plant

Steps = Generator[Step, NDArray[np.float64], None]


def _white(samples: int, n_inputs: int, rng: np.random.Generator, power: float) -> Step:
    u = rng.standard_normal((samples, n_inputs))
    return Step(u * np.sqrt(power * samples / np.sum(u**2)), "white")


SEARCHED = 4
"""Experiments up to which every refit searches for the global optimum; later ones go on from the fit before."""


class _Refits:
    """Output-error fits to records that become more; without orders, these and the delay are chosen whenever the records have
    doubled, from the records alone."""

    def __init__(self, orders: Any, delay: Any) -> None:
        self._orders, self._delay = orders, delay
        self._last: NDArray[np.float64] | None = None
        self._blind, self._next = orders is None, 1

    def plant(self, records: list[Record]) -> Plant:
        """The plant fitted to all records so far."""
        from estimators.pem import identify
        from estimators.pem.choice import from_records

        if self._blind and len(records) >= self._next:
            self._next = 2 * len(records)
            fit = from_records(records)
            structure = fit.model.structure
            self._orders, self._delay = (structure.nb.tolist(), structure.nf.tolist()), structure.nk.tolist()
            self._last = fit.theta
            return fit.to_plant()
        known = self._last if self._blind or len(records) > SEARCHED else None
        fit = identify(
            records, "oe", self._orders, delay=self._delay, search="quick", start=known, offset=False
        )
        self._last = fit.theta
        return fit.to_plant()


def _designed(
    records: list[Record], fits: _Refits, criterion: str, ahead: int, power: float
) -> Spectrum | None:
    """Optimal spectrum for the model fitted to the records; None where no model can be fitted or designed for."""
    from oed.design import solve_design
    from oed.information import information_of_records

    try:
        plant = fits.plant(records)
        prior = information_of_records(plant, [r.u for r in records]) / ahead
        return solve_design(plant, criterion, input_power=power, prior=prior).spectrum
    except OedError:
        return None  # an unstable or unidentifiable fit: more white noise is the honest next input


def two_stage(
    orders: Any = (2, 2), delay: Any = 1, *, criterion: str = "hinf", experiments: int = 20, share: float = 0.2,
    power: float = 1.0,
) -> Rule:  # fmt: skip
    """White noise first, then the optimal input for the model fitted to it."""
    if not 0 < share < 1:
        raise InputError(f"share is {share:g}; the first stage takes a share strictly between 0 and 1.")
    first = max(1, round(share * experiments))
    return _redesigning(orders, delay, criterion, power, lambda done: done == first, first, experiments)


def sequential(
    orders: Any = (2, 2), delay: Any = 1, *, criterion: str = "hinf", experiments: int = 20, power: float = 1.0,
    draws: int = 32, inflation: float = 3.0,
) -> Rule:  # fmt: skip
    """White noise once, then redesign after 1, 2, 3, 4, 6, 8, 12, 16, 24, ... experiments. Optimal for the
    peak gain is the sinusoid at the peak in the direction of the largest singular value (gain-scaling
    theorem, `oed.theory.claim`); the mean of these sinusoids over the posterior is the design that is best on
    average to first order where the posterior is wide."""
    if draws < 0 or not inflation > 0:
        raise InputError(f"draws is {draws} and inflation {inflation:g}; give draws >= 0 and inflation > 0.")
    hedge = (draws, inflation) if draws and criterion == "hinf" else None
    return _redesigning(orders, delay, criterion, power, _twos_and_threes, 1, experiments, hedge)


def _twos_and_threes(done: int) -> bool:
    """Whether a number is a power of two, or three times one."""
    return any(done == factor * 2**k for factor in (1, 3) for k in range(done.bit_length()))


def _hedged(
    records: list[Record], fits: _Refits, power: float, hedge: tuple[int, float], rng: np.random.Generator
) -> Spectrum | None:
    """Mean of the optimal sinusoids of plants drawn from the fit, on the lines of an experiment."""
    from oed.information import information_of_records

    draws, inflation = hedge
    try:
        plant = fits.plant(records)
        information = information_of_records(plant, [r.u for r in records])
        root = inflation * np.linalg.cholesky(np.linalg.inv(information))
    except (OedError, np.linalg.LinAlgError):
        return None  # as in _designed
    N, n_lines = len(records[0]), (len(records[0]) - 1) // 2
    found: dict[int, NDArray[np.complex128]] = {}
    kept = tried = 0
    while kept < draws and tried < 8 * draws:
        theta = plant.theta + rng.standard_normal((min(draws - kept, 8 * draws - tried), len(root))) @ root.T
        tried += len(theta)
        for G in _stable_responses(plant, theta, N)[:, 1 : n_lines + 1]:
            k, direction = _peak_line(G)
            found[k] = found.get(k, 0) + power * np.outer(direction, direction.conj())
            kept += 1
    if not kept:
        return None
    chosen = sorted(found)
    return Spectrum(2 * np.pi * (np.array(chosen) + 1) / N, np.array([found[k] / kept for k in chosen]))


def _stable_responses(plant: Plant, theta: NDArray[np.float64], N: int) -> NDArray[np.complex128]:
    """Responses of the plants with these parameters on the N // 2 + 1 DFT lines, (plants, lines, ny, nu).
    Unstable plants are none that could be measured, and are left out."""
    rows = {row[0]: row[1:5] for row in plant._parameters()}
    shape = (len(theta), plant.n_outputs, plant.n_inputs)
    length = max(len(p) for side in (plant.num, plant.den) for row in side for p in row)
    polynomials = {"b": np.zeros((*shape, length)), "a": np.zeros((*shape, length))}
    for letter, side in (("b", plant.num), ("a", plant.den)):
        for i, row in enumerate(side):
            for j, p in enumerate(row):
                polynomials[letter][:, i, j, : len(p)] = p
    for name, values in zip(plant.free, theta.T, strict=True):
        letter, power, i, j = rows[name]
        polynomials[letter][:, i, j, power] = values
    companion = np.zeros((*shape, length - 1, length - 1))
    companion[..., 0, :] = -polynomials["a"][..., 1:]
    companion[..., range(1, length - 1), range(length - 2)] = 1.0
    stable = (np.abs(np.linalg.eigvals(companion)) < 1).all(axis=(1, 2, 3))
    G = np.fft.rfft(polynomials["b"][stable], N) / np.fft.rfft(polynomials["a"][stable], N)
    return np.moveaxis(G, 3, 1)


def _peak_line(G: NDArray[np.complex128]) -> tuple[int, NDArray[np.complex128]]:
    """Line with the largest gain, and the input direction there."""
    if G.shape[1:] == (1, 1):
        return int(np.argmax(np.abs(G[:, 0, 0]))), np.ones(1, dtype=complex)
    _, s, vh = np.linalg.svd(G)
    k = int(np.argmax(s[:, 0]))
    return k, vh[k, 0].conj()


def _redesigning(
    orders: Any, delay: Any, criterion: str, power: float, due: Any, first: int, budget: int,
    hedge: tuple[int, float] | None = None,
) -> Rule:  # fmt: skip
    def rule(samples: int, n_inputs: int, n_outputs: int, rng: np.random.Generator) -> Steps:
        from oed.signals.synthesis import realise

        records: list[Record] = []
        spectrum: Spectrum | None = None
        fits = _Refits(orders, delay)
        # In units in which the power is about one: a design refuses powers that are far from it.
        unit = float(powers_of_two(np.sqrt(power)))
        near_one = power / unit / unit
        while True:
            done = len(records)
            if done >= first and (due(done) or spectrum is None):
                ahead = samples * max(budget - done, 1)
                if hedge:
                    spectrum = _hedged(records, fits, near_one, hedge, rng)
                else:
                    spectrum = _designed(records, fits, criterion, ahead, near_one)
            if spectrum is None:
                step = _white(samples, n_inputs, rng, near_one)
            else:
                step = Step(realise(spectrum, samples, rng=rng), "designed")
            y = yield Step(unit * step.u, step.kind)
            records.append(Record(step.u, y / unit))

    return rule
