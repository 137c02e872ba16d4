"""Weighted Thompson sampling over frequencies: the input's power goes where the peak may still be.

Every DFT line is an arm. The posterior of its response after some experiments is complex normal with mean
sum Y U* / sum |U|^2 and variance lambda_e / sum |U|^2; an experiment's power is shared among the lines in
proportion to how often each has the largest gain when all are drawn from their posteriors."""

from collections.abc import Generator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from estimators.norm.local_models import PeakEstimate
from estimators.residual.algebra import powers_of_two
from estimators.rules.trace import Step, Trace, offered
from oed.errors import InputError, Status

DRAWS = 200
SURE = 5.0
"""Deviations after which a line is not drawn: sixteen bits reach 4.86."""
UNSENT = 1e-12
"""Share of the largest line's power below which a line counts as not sent: its response is unknown."""


@dataclass(frozen=True, eq=False)
class _Posterior:
    mean: NDArray[np.complex128]
    variance: NDArray[np.float64]
    noise: float

    def wins(self, rng: np.random.Generator) -> NDArray[np.float64]:
        """How often each line has the largest gain |m + s r e^(j phi)| among joint draws."""
        deviation = np.sqrt(self.variance / 2)
        gain = np.abs(self.mean)
        able = np.flatnonzero(gain + SURE * deviation >= np.max(gain - SURE * deviation))
        unit = powers_of_two(gain + deviation)  # single precision ends at 1e38
        m, s = ((x[able] / unit).astype(np.float32) for x in (gain, deviation))
        # r^2 exponential and phi uniform need no normal numbers; sixteen random bits for each are fine enough here.
        bits = np.frombuffer(rng.bytes(4 * DRAWS * len(able)), np.uint16)
        uniform = bits.reshape(2, DRAWS, len(able)).astype(np.float32)
        uniform += np.float32(0.5)
        uniform *= np.float32(2.0**-16)
        r = np.log(uniform[0], out=uniform[0])
        r *= np.float32(-2)
        np.sqrt(r, out=r)
        r *= s
        uniform[1] *= np.float32(np.pi)
        squares = np.cos(uniform[1], out=uniform[1])
        squares *= 2 * m
        squares += r
        squares *= r  # r (r + 2 m cos(phi)) + m^2
        squares += m * m
        return np.bincount(able[np.argmax(squares, axis=1)], minlength=len(gain)) / DRAWS


def _posterior(
    power: NDArray[np.float64], cross: NDArray[np.complex128], energy: float, experiments: int
) -> _Posterior:
    """From sum |U|^2 and sum Y U* of every line, and the sum of |Y|^2 over lines and experiments."""
    power = np.maximum(power, UNSENT * (power.max() or 1.0))
    mean = np.asarray(cross / power, complex)
    rest = max(energy - float(np.sum(np.abs(cross) ** 2 / power)), 1e-15 * energy)
    noise = rest / (len(power) * (experiments - 1)) if experiments > 1 else energy / len(power)
    return _Posterior(mean, noise / power, noise)


@offered("bandit", "Thompson sampling over the lines of the spectrum", one_channel=True)
def thompson_sampling(
    samples: int, n_inputs: int, n_outputs: int, rng: np.random.Generator, *, power: float = 1.0,
    explore: float = 0.05,
) -> Generator[Step, NDArray[np.float64], None]:  # fmt: skip
    """Multisines whose powers follow the chance of each line to be the peak. After Mueller, Valenzuela,
    Proutiere, Rojas, "A stochastic multi-armed bandit approach to nonparametric H-infinity norm estimation",
    CDC 2017 (the weighted variant), with lambda_e estimated."""
    if (n_inputs, n_outputs) != (1, 1):
        raise InputError(
            f"Thompson sampling over frequencies needs one input and one output, not {n_inputs} and {n_outputs}."
        )
    lines = np.arange(1, (samples - 1) // 2 + 1)
    if not len(lines):
        raise InputError(f"{samples} samples have no line inside (0, pi); give at least 3.")
    share = np.full(len(lines), 1 / len(lines))
    total, cross, energy, experiments = np.zeros(len(lines)), np.zeros(len(lines), complex), 0.0, 0
    while True:
        spectrum = np.zeros(samples // 2 + 1, complex)
        spectrum[lines] = samples * np.sqrt(power * share / 2) * np.exp(2j * np.pi * rng.random(len(lines)))
        u = np.fft.irfft(spectrum, samples)[:, None]
        y = yield Step(u, "bandit")
        U, Y = spectrum[lines] / np.sqrt(samples), np.fft.rfft(y[:, 0])[lines] / np.sqrt(samples)
        total, cross = total + np.abs(U) ** 2, cross + Y * np.conj(U)
        energy, experiments = energy + float(np.vdot(Y, Y).real), experiments + 1
        wins = _posterior(total, cross, energy, experiments).wins(rng)
        share = (1 - explore) * wins + explore / len(lines)


def best_arm(trace: Trace) -> PeakEstimate:
    """Gain of the line that is best under the posterior."""
    records = trace.records
    if records[0].n_inputs * records[0].n_outputs != 1:
        raise InputError("the best frequency is sought for one input and one output only.")
    N = len(records[0])
    lines = slice(1, (N - 1) // 2 + 1)
    U, Y = (
        np.array([np.fft.rfft(getattr(r, side)[:, 0])[lines] / np.sqrt(N) for r in records]) for side in "uy"
    )
    power, cross = np.sum(np.abs(U) ** 2, axis=0), np.sum(Y * np.conj(U), axis=0)
    posterior = _posterior(power, cross, float(np.vdot(Y, Y).real), len(U))
    wins = posterior.wins(np.random.default_rng(0))
    k = int(np.argmax(np.where(wins > 0, np.abs(posterior.mean), 0)))
    step = 2 * np.pi / N
    sure = bool(wins[k] >= 0.95)
    return PeakEstimate(
        float(np.abs(posterior.mean[k])),
        float(np.sqrt(posterior.variance[k] / 2)),
        (k + 1) * step,
        step / np.sqrt(12) if sure else float("inf"),  # uniform over the line, where the line is sure
        float("nan"),
        posterior.noise,
        Status.CONVERGED if sure else Status.OK,
    )
