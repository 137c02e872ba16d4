"""Experiments: the system under test as a callable u -> y, with its limits and a count of what was used."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from oed.covariances import square_root
from oed.data import Record, as_signal
from oed.errors import ExperimentError, InputError, check_sampling_time
from oed.plants.plant import Plant
from oed.plants.systems import as_plant
from oed.signals.noise import noise_key, noise_series

AHEAD = 2**16
"""Most samples of noise that are computed together."""


@dataclass(frozen=True)
class Usage:
    """What a series of experiments has cost. `experiments` number of experiments; `samples` samples over all
    experiments; `energy` input energy: squares summed over samples, experiments and channels; `peak` largest
    absolute input."""

    experiments: int = 0
    samples: int = 0
    energy: float = 0.0
    peak: float = 0.0

    def add(self, u: NDArray[np.float64]) -> Usage:
        """The usage after one more experiment with the input u, (N, nu)."""
        return Usage(
            self.experiments + 1,
            self.samples + len(u),
            self.energy + float(np.vdot(u, u)),
            max(self.peak, float(u.max()), -float(u.min())),
        )


class Experiment:
    """The system under test.

    Calling it applies an input from rest and returns the output; it checks the input against the limits
    before the system sees it and the output before anybody uses it, and it counts what was used.

    Parameters
    ----------
    apply : callable
        u (N, nu) -> y (N, ny), or (N,) where ny = 1; starts from rest at every call.
    n_inputs, n_outputs : int
        Number of channels.
    dt : float
        Sampling time in seconds.
    amplitude : float, optional
        Largest absolute input allowed.
    """

    def __init__(
        self,
        apply: Callable[[NDArray[np.float64]], object],
        n_inputs: int = 1,
        n_outputs: int = 1,
        *,
        dt: float = 1.0,
        amplitude: float | None = None,
    ) -> None:
        if not callable(apply):
            raise InputError(
                f"apply is {apply!r}; it must be a function from an input (N, nu) to an output (N, ny)."
            )
        check_sampling_time(dt)
        self._apply = apply
        self.n_inputs, self.n_outputs, self.dt, self.amplitude = n_inputs, n_outputs, dt, amplitude
        self.used = Usage()

    def __call__(self, u: object) -> NDArray[np.float64]:
        """Apply an input.

        Parameters
        ----------
        u : array_like
            (N, nu).

        Returns
        -------
        ndarray
            (N, ny) measured output; ExperimentError if the system returned anything else.
        """
        u = as_signal(u, "the input")  # type: ignore[arg-type]
        if u.shape[1] != self.n_inputs:
            raise InputError(
                f"the input has {u.shape[1]} channels and the system {self.n_inputs}; give (N, {self.n_inputs})."
            )
        if self.amplitude is not None and np.abs(u).max() > self.amplitude * (1 + 1e-12):
            t, channel = np.unravel_index(np.argmax(np.abs(u)), u.shape)
            raise InputError(
                f"the input reaches {u[t, channel]:g} at sample {t}, channel {channel + 1}; the limit is "
                f"{self.amplitude:g}: scale the input down. Nothing was applied."
            )
        try:
            y = as_signal(self._apply(u), "the measured output")  # type: ignore[arg-type]
        except InputError as error:
            raise ExperimentError(f"experiment {self.used.experiments + 1}: {error}") from None
        if y.shape != (len(u), self.n_outputs):
            raise ExperimentError(
                f"experiment {self.used.experiments + 1} returned an output of shape {y.shape}; "
                f"it must be {(len(u), self.n_outputs)}, one row per input sample: check the rig's recording."
            )
        self.used = self.used.add(u)
        return y


def simulated(
    plant: Any,
    *,
    seed: int = 0,
    replicate: int = 0,
    first: int = 0,
    expected: int = 1,
    computed: Mapping[int, NDArray[np.float64]] | None = None,
) -> Experiment:
    """An experiment on a simulated plant; experiment k of replicate r always meets the same noise.

    Parameters
    ----------
    plant : Plant or what `oed.plants.systems.as_plant` takes
        The plant, with its noise.
    seed, replicate : int
        Coordinates of the noise (`oed.signals.noise`).
    first : int
        Number of the first experiment.
    expected : int
        How many experiments will follow, if that is known: the noise of short ones is then computed together, which is
        faster and changes nothing.
    computed : mapping, optional
        (N, ny) standard normal noise of some experiments by their number, where it is known already (that of many
        replicates is computed faster together); it must be what `noise_series` gives.

    Returns
    -------
    Experiment
        From rest at every call.
    """
    plant = as_plant(plant)
    key = noise_key(seed, plant.name)
    factor = noise_factor(plant)
    count = first
    white = plant.white_noise
    ahead = dict(computed or {})

    def apply(u: NDArray[np.float64]) -> NDArray[np.float64]:
        nonlocal count
        noise = ahead.pop(count, None)
        if noise is None or len(noise) != len(u):
            most = max(1, AHEAD // (len(u) * plant.n_outputs))
            numbers = range(count, count + min(max(first + expected - count, 1), most))
            ahead.clear()
            ahead.update(
                zip(numbers, noise_series(key, replicate, numbers, len(u), plant.n_outputs), strict=True)
            )
            noise = ahead.pop(count)
        count += 1
        noise = noise @ factor.T
        return plant.simulate(u) + (noise if white else coloured(plant, noise))

    return Experiment(apply, plant.n_inputs, plant.n_outputs, dt=plant.dt)


def noise_factor(plant: Plant) -> NDArray[np.float64]:
    """A square root L of the noise covariance, L L' = Lambda (also where Lambda is singular)."""
    deviations = np.sqrt(np.diag(plant.noise_covariance))
    if np.count_nonzero(plant.noise_covariance) == np.count_nonzero(deviations):
        return np.diag(deviations)
    return square_root(plant.noise_covariance)


def coloured(plant: Plant, e: NDArray[np.float64]) -> NDArray[np.float64]:
    """White noise through the plant's noise filter H, from rest: e (N, ny) -> (N, ny)."""
    if plant.white_noise:
        return e
    from scipy.signal import lfilter

    return np.asarray(lfilter(plant.noise_num, plant.noise_den, e, axis=0))


def decoloured(plant: Plant, v: NDArray[np.float64]) -> NDArray[np.float64]:
    """Noise through the inverse of the plant's noise filter, H^-1 v, from rest: undoes `coloured`; v (N, ny)
    -> (N, ny)."""
    if plant.white_noise:
        return v
    from scipy.signal import lfilter

    return np.asarray(lfilter(plant.noise_den, plant.noise_num, v, axis=0))


def replayed(records: Sequence[Record]) -> Experiment:
    """An experiment that plays back records in their order, and refuses an input that was not recorded.

    Parameters
    ----------
    records : sequence of Record
        What was measured.

    Returns
    -------
    Experiment
        It returns the recorded output for the recorded input.
    """
    if not records:
        raise InputError("there are no records to replay; give at least one.")
    waiting = iter(enumerate(records, 1))

    def apply(u: NDArray[np.float64]) -> NDArray[np.float64]:
        number, record = next(waiting, (0, None))
        if record is None:
            raise ExperimentError(
                f"all {len(records)} records have been replayed; there is no further experiment."
            )
        if record.u.shape != u.shape or not np.allclose(record.u, u, rtol=1e-9, atol=1e-12):
            raise ExperimentError(
                f"the input differs from that of record {number}; a replay answers only what was asked."
            )
        return record.y

    return Experiment(apply, records[0].n_inputs, records[0].n_outputs, dt=records[0].dt)
