"""Lanczos on the experiments: the same products with G as power iterations, used all together.

Power iterations keep the last vector only; Lanczos keeps the span of all of them and takes the largest gain
in it, so that without noise the same experiments give a lower bound that is never worse, and far better
where singular values lie close together."""

from collections.abc import Generator

import numpy as np
from numpy.typing import ArrayLike, NDArray

from estimators.norm.gains import Gains, from_squares, transposed_output
from estimators.rules.limits import Limits, scaled
from estimators.rules.power import first_input
from estimators.rules.procedure2 import procedure_2
from estimators.rules.trace import Step, Trace, offered
from oed.errors import InputError


@offered("krylov", "Lanczos iterations on all records so far", one_channel=True, iterations=True)
def lanczos(
    samples: int, n_inputs: int, n_outputs: int, rng: np.random.Generator, *, limits: Limits | None = None,
    start: ArrayLike | None = None,
) -> Generator[Step, NDArray[np.float64], None]:  # fmt: skip
    """Lanczos vectors as inputs: one experiment each for one channel, 1 + pq for several. The next input is
    the part of T y (of G' G u) that is orthogonal to all inputs before it."""
    limits = limits or Limits()
    u = first_input(samples, n_inputs, rng, limits, start)
    single = n_inputs == n_outputs == 1
    basis = np.zeros((samples * n_inputs, 0))
    while True:
        if single:
            y = yield Step(u, "krylov")
            w = y[::-1]
        else:
            inner = procedure_2(samples, n_inputs, n_outputs, rng, limits=limits, start=u)
            step = next(inner)
            for _ in range(1 + n_inputs * n_outputs):
                y = yield step
                step = inner.send(y)
            inner.close()
            w = step.u
        basis = np.column_stack([basis, u.ravel() / np.linalg.norm(u)])
        rest = np.array(w).ravel()
        for _ in range(2):
            rest = rest - basis @ (basis.T @ rest)
        if np.linalg.norm(rest) <= 1e-12 * np.linalg.norm(w):
            return  # the span is invariant: no further experiment adds anything
        u = scaled(rest.reshape(samples, n_inputs), limits)


def ritz(trace: Trace) -> Gains:
    """Largest gain in the span of the inputs so far, one value per iteration."""
    if not trace.kinds or trace.kinds[0] not in ("krylov", "power", "forward"):
        raise InputError("Ritz values need the experiments of lanczos, power iterations or Procedure 2.")
    single = trace.kinds[0] != "forward"
    inputs, images = [], []
    for part in trace.iterations:
        first = trace.records[part][0]
        image = first.y[::-1] if single else transposed_output(trace, part)
        size = np.linalg.norm(first.u)
        inputs.append(first.u.ravel() / size)
        images.append(np.array(image).ravel() / size)
    W = np.column_stack(images)
    V, triangle = np.linalg.qr(np.column_stack(inputs))
    usable = (np.abs(np.diag(triangle)) >= 1e-8) & np.isfinite(W).all(axis=0)
    count = len(inputs) if usable.all() else int(np.argmin(usable))
    # The matrices of the first m inputs are the leading parts of those of all.
    H = np.linalg.solve(triangle[:count, :count].T, (V[:, :count].T @ W[:, :count]).T).T
    H = (H + H.T) / 2
    squares = np.full(len(inputs), np.nan)
    for m in range(1, count + 1):
        values = np.linalg.eigvalsh(H[:m, :m])
        squares[m - 1] = np.abs(values).max() ** 2 if single else values.max()
    if count:
        squares[count:] = squares[count - 1]
    return from_squares("krylov", squares)
