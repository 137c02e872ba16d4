"""Whether an input follows the innovations of a model: feedback, which a fit with effects is told by."""

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.stats import chi2

from estimators.diagnosis.effects.profiled import gained
from estimators.diagnosis.model.fitting import Channel, Fit, innovations
from estimators.diagnosis.share.feedback import MATTERS, beside, between_jumps, filtered, wald
from estimators.residual.algebra import thin_svd, unit

Array = NDArray[Any]

SHIFTS = 40
"""Innovations come at any other time as well: what they explain of an input then, where its own past leaves a smooth rest of it, as of
a sweep, is what chance explains."""


def feedback_test(u: Array, e: Array, lags: int = 5, memory: int = 12, more: Sequence[Array] = ()) -> float:
    """Likelihood-ratio p-value of 'the input u (N,) does not follow the noise': past innovations e (N,) help to predict it.

    Innovations at lags 1 to `lags`, beside `memory` past inputs and whatever columns `more` tell of it; the larger p-value of
    equal and of unequal variances.
    """
    u, e, n = unit(u), unit(e), len(u)
    own = [np.concatenate((np.zeros(i), u[: n - i])) for i in range(1, memory + 1)]
    own += [*more, np.ones(n)]
    past = [np.concatenate((np.zeros(i), e[: n - i])) for i in range(1, lags + 1)]
    X0, X1 = np.stack(own, axis=1)[memory:], np.stack(own + past, axis=1)[memory:]
    target = u[memory:]
    rows = between_jumps(X0, target, 1e-7 * float(np.std(u)))
    Q, E, count = _basis(X0[rows]), X1[:, X0.shape[1] :], lags
    r0 = target[rows] - Q @ (Q.T @ target[rows])
    rss0, chance = float(r0 @ r0), count / len(r0)

    def ratio(by: int) -> float:
        Z = np.roll(E, by, axis=0)[rows]
        Z = _basis(Z - Q @ (Q.T @ Z))
        return -len(r0) * float(np.log1p(-min(float(np.sum((Z.T @ r0) ** 2)) / rss0, 1.0 - 1e-12)))

    if rss0 <= 1e-12 * float(u @ u) or (found := ratio(0)) < -len(r0) * np.log1p(-min(MATTERS + chance, 0.5)):
        return 1.0  # nothing left to predict, or a share too small for a loop
    shifts = np.linspace(0, len(target), SHIFTS + 2)[1:-1].astype(int)
    wider = max(1.0, float(np.mean([ratio(by) for by in shifts])) / count)
    return max(float(chi2.sf(found / wider, count)), wald(X0[rows], E[rows], target[rows]))


def _basis(X: Array) -> Array:
    """Orthonormal columns of all that those of a matrix tell apart."""
    U, size, _ = thin_svd(X)
    return U[:, size > 1e-13 * size[0]]


def _follows_input(u: Array, e: Array, lags: int = 20) -> bool:
    """Whether innovations are predicted by the past input or its cube, which noise is not (p < 1e-8)."""
    u, n = unit(u), len(e)
    columns = [np.concatenate((np.zeros(i), x[: n - i])) for x in (u, u**3) for i in range(1, lags + 1)]
    X = np.stack(columns, axis=1)
    X = X / (np.sqrt(np.mean(X**2, axis=0)) + 1e-300)
    r = e - X @ np.linalg.lstsq(X, e, rcond=None)[0]
    return bool(chi2.sf(gained(n, float(e @ e), float(r @ r)), 2 * lags) < 1e-8)


FIRST = 0.01
"""Level from which on an input's own past is given what bends and other inputs tell of it: where it follows nothing without, it does not with."""


def feedback_of(channel: Channel, final: Fit) -> float:
    """p-value of 'no input follows the noise' by the innovations of a model; 1 where they are model error, not noise."""
    if channel.step > 0:
        return 1.0
    e, inputs = innovations(final.residual, final.noise), final.structure.inputs
    if any(_follows_input(channel.u[:, j], e) for j in inputs):
        return 1.0  # the input would seem to follow it
    alone = {j: feedback_test(channel.u[:, j], e) for j in inputs if not filtered(channel.u[:, j])}
    p = (
        max(one, feedback_test(channel.u[:, j], e, more=list(beside(channel.u, j).T))) if one < FIRST else one
        for j, one in alone.items()
    )
    return min(1.0, min(p, default=1.0) * len(inputs))
