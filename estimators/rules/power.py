"""Power iterations on one channel: [S] Algorithm 1 and [M] Procedure 1, as a rule for `run`."""

from collections.abc import Generator

import numpy as np
from numpy.typing import ArrayLike, NDArray

from estimators.rules.limits import Limits, scaled, white_start
from estimators.rules.trace import Step, offered
from oed.data import as_signal
from oed.errors import InputError


@offered(
    "power",
    "the power iterations: the next input is the last output, reversed in time and scaled",
    one_channel=True,
    iterations=True,
)
def power_iterations(
    samples: int,
    n_inputs: int,
    n_outputs: int,
    rng: np.random.Generator,
    *,
    limits: Limits | None = None,
    start: ArrayLike | None = None,
    reversal: bool = True,
    symmetric: bool = False,
) -> Generator[Step, NDArray[np.float64], None]:
    """Power iterations, one experiment each.

        u^(n+1) = T y^(n) / mu^(n),   mu^(n) = ||y^(n)||_2 / sqrt(N)

    T reverses time. Without noise this is the power method for the symmetric matrix T G, so u^(n) tends to
    the worst-case input of the N samples.

    Parameters
    ----------
    samples : int
        Length N of every experiment.
    n_inputs, n_outputs : int
        Number of channels; one each, unless `symmetric`.
    rng : numpy.random.Generator
        For the start.
    limits : Limits, optional
        Limits that every input is scaled to; default unit power, [S] (3).
    start : array_like, optional
        (N, nu) first input, scaled to the limits; default white noise.
    reversal : bool
        False leaves out the time reversal: the failure of [S] Remark 3, which finds |g_0|.
    symmetric : bool
        Says that G_ij = G_ji, so that the iterations are those of T G for several channels too ([M] (8)).

    Yields
    ------
    Step
        The next input, of kind "power" ("unreversed" without the reversal).

    Raises
    ------
    InputError
        If the system has several channels and is not said to be symmetric.

    Notes
    -----
    [S] Algorithm 1 and (3); [M] Procedure 1 with the scaling (13).
    """
    if (n_inputs, n_outputs) != (1, 1) and not (symmetric and n_inputs == n_outputs):
        raise InputError(
            f"power iterations with one experiment each need one input and one output, and the system has "
            f"{n_inputs} and {n_outputs}; use Procedure 2 (procedure_2), or say symmetric=True if G = G'."
        )
    limits = limits or Limits()
    u = first_input(samples, n_inputs, rng, limits, start)
    kind = "power" if reversal else "unreversed"
    while True:
        y = yield Step(u, kind)
        u = scaled(y[::-1] if reversal else y, limits)


def first_input(
    samples: int, n_inputs: int, rng: np.random.Generator, limits: Limits, start: ArrayLike | None
) -> NDArray[np.float64]:
    """The start of the iterations: what the user gave, or white noise, scaled to the limits; start (N, nu) ->
    (N, nu)."""
    if start is None:
        return white_start(samples, n_inputs, rng, limits)
    u = as_signal(start, "the start")
    if u.shape != (samples, n_inputs):
        raise InputError(f"the start has shape {u.shape}; it must be {(samples, n_inputs)}.")
    if not u.any():
        raise InputError("the start is zero; power iterations need a start that excites the system.")
    return scaled(u, limits)
