"""[M] Procedure 2: power iterations for any number of inputs and outputs, 1 + pq experiments each."""

from collections.abc import Generator
from functools import partial

import numpy as np
from numpy.typing import ArrayLike, NDArray

from estimators.rules.limits import Limits, scaled
from estimators.rules.power import first_input
from estimators.rules.trace import Step, offered
from oed.errors import check_names

SCALINGS = ("none", "each", "common")


def procedure_2(
    samples: int, n_inputs: int, n_outputs: int, rng: np.random.Generator, *, limits: Limits | None = None,
    scaling: str = "none", start: ArrayLike | None = None,
) -> Generator[Step, NDArray[np.float64], None]:  # fmt: skip
    """Power iterations for G' G by experiments on G alone.

        x = T G u,   z = sum_ij I_ij G (I_ij x),   w = T z = G' G u,   next u = w / mu

    I_ij puts output j in place of input i: every experiment of the sum has one input that is not zero, and
    one output of it is used. With one channel this is the two-experiment scheme of [S] Remark 4.

    Shapes: start (N, nu).

    [M] Procedure 2 and Sec. III-C. An output that is exactly zero makes no experiment void: its input is
    applied as zero, so that there are always 1 + pq.
    """
    check_names([scaling], SCALINGS, "scaling")
    limits = limits or Limits()
    u = first_input(samples, n_inputs, rng, limits, start)
    while True:
        y = yield Step(u, "forward")
        x = y[::-1]
        common = _common_factor(x, n_inputs, limits) if scaling == "common" else 1.0
        z = np.zeros((samples, n_inputs))
        for i in range(n_inputs):
            for j in range(n_outputs):
                second = _fed(x, i, j, n_inputs)
                factor = common
                if scaling == "each" and second.any():
                    factor = _factor(second, limits)
                answer = yield Step(factor * second, f"transpose {i + 1} {j + 1}")
                z[:, i] += answer[:, j] / factor
        u = scaled(z[::-1], limits)


_IN_TURN = "the iterations with the plant and its transpose in turn"
offered("two-experiment", _IN_TURN, one_channel=True, iterations=True)(partial(procedure_2, scaling="each"))
offered("procedure-2", "the iterations for several channels; 1 + pq experiments each", iterations=True)(
    partial(procedure_2, scaling="each")
)


def _fed(x: NDArray[np.float64], i: int, j: int, n_inputs: int) -> NDArray[np.float64]:
    """I_ij x: output j in place of input i."""
    second = np.zeros((len(x), n_inputs))
    second[:, i] = x[:, j]
    return second


def _factor(x: NDArray[np.float64], limits: Limits) -> float:
    """By what `scaled` multiplies."""
    return float(np.linalg.norm(scaled(x, limits)) / np.linalg.norm(x))


def _common_factor(x: NDArray[np.float64], n_inputs: int, limits: Limits) -> float:
    seconds = [_fed(x, i, j, n_inputs) for i in range(n_inputs) for j in range(x.shape[1])]
    factors = [_factor(second, limits) for second in seconds if second.any()]
    energy = float(np.sum(np.square(x)))
    if energy > 0:
        if limits.power is not None:
            factors.append(float(np.sqrt(limits.power * len(x) / energy)))
        if limits.energy is not None:
            factors.append(float(np.sqrt(limits.energy / energy)))
    return min(factors, default=1.0)
