"""Inputs that do not depend on what was measured, as rules for `run`: the yardsticks of the comparison.

Every input has exactly the power asked for (summed over channels); each experiment draws a new one."""

from collections.abc import Generator

import numpy as np
from numpy.typing import ArrayLike, NDArray

from estimators.rules.limits import Limits, scaled
from estimators.rules.trace import Rule, Step, offered
from oed.data import as_signal
from oed.errors import InputError

Steps = Generator[Step, NDArray[np.float64], None]


@offered("white", "white Gaussian noise")
def white(
    samples: int, n_inputs: int, n_outputs: int, rng: np.random.Generator, *, power: float = 1.0
) -> Steps:
    """White Gaussian noise, independent between channels and experiments."""
    limits = Limits(power)
    while True:
        yield Step(scaled(rng.standard_normal((samples, n_inputs)), limits), "white")


@offered("multisine", "sinusoids of one size at all frequencies, random phases")
def multisine(
    samples: int, n_inputs: int, n_outputs: int, rng: np.random.Generator, *, power: float = 1.0
) -> Steps:
    """Random-phase multisine, flat over all lines 2 pi k / N inside (0, pi)."""
    lines = (samples - 1) // 2
    if lines < 1:
        raise InputError(f"a multisine of {samples} samples has no line inside (0, pi); give at least 3.")
    limits = Limits(power)
    while True:
        U = np.zeros((samples // 2 + 1, n_inputs), dtype=complex)
        U[1 : lines + 1] = np.exp(2j * np.pi * rng.random((lines, n_inputs)))
        yield Step(scaled(np.fft.irfft(U, samples, axis=0), limits), "multisine")


@offered("prbs", "a pseudo-random binary signal")
def prbs(
    samples: int, n_inputs: int, n_outputs: int, rng: np.random.Generator, *, power: float = 1.0
) -> Steps:
    """Pseudo-random binary sequence: pieces of a maximum-length sequence at random places."""
    from scipy.signal import max_len_seq

    bits = max(8, int(np.ceil(np.log2(16 * samples * n_inputs))))  # pieces seldom overlap
    sequence = 2.0 * max_len_seq(bits)[0] - 1
    level = np.sqrt(power / n_inputs)
    while True:
        shift = rng.integers(len(sequence))
        places = shift + samples * np.arange(n_inputs) + np.arange(samples)[:, None]
        yield Step(level * sequence[places % len(sequence)], "prbs")


@offered("sweep", "a sinusoid whose frequency runs through the band")
def sweep(
    samples: int, n_inputs: int, n_outputs: int, rng: np.random.Generator, *, power: float = 1.0
) -> Steps:
    """Linear sine sweep from 0 to pi with a random initial phase; channel j is delayed by j N / nu."""
    t = np.arange(samples)
    limits = Limits(power)
    while True:
        chirp = np.sin(np.pi * t**2 / (2 * samples) + 2 * np.pi * rng.random())
        columns = [np.roll(chirp, j * samples // n_inputs) for j in range(n_inputs)]
        yield Step(scaled(np.column_stack(columns), limits), "sweep")


def fixed(u: ArrayLike, kind: str = "fixed") -> Rule:
    """A rule that repeats one signal, such as a designed one, as it is: u (N, nu)."""
    signal = as_signal(u, "the fixed input")

    def rule(samples: int, n_inputs: int, n_outputs: int, rng: np.random.Generator) -> Steps:
        if signal.shape != (samples, n_inputs):
            raise InputError(
                f"the fixed input has shape {signal.shape}; the experiment needs {(samples, n_inputs)}."
            )
        while True:
            yield Step(signal, kind)

    return rule
