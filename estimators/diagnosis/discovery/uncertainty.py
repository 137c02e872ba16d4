"""Covariance of a fitted form's parameters where its errors are correlated: the sandwich with Bartlett weights."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from estimators.diagnosis.discovery.fitting import Fitted, Piece, sensitivities
from estimators.diagnosis.discovery.form import Assembly

__all__ = ["covariance", "error_of"]

Array = NDArray[Any]
LAGS = (
    3.0  # of the Bartlett window, in the model's own time constants: errors of the model last about as long
)
DIFFERENCE = 1e-5  # relative step of the delta method


def covariance(fitted: Fitted, pieces: Sequence[Piece]) -> Array:
    """(P, P) of theta alone, the start states taken out."""
    asm = Assembly(fitted.form)
    p, nx = len(fitted.theta), asm.chain_states
    size = p + nx * len(pieces)
    H, S = np.zeros((size, size)), np.zeros((size, size))
    for r, (piece, state) in enumerate(zip(pieces, fitted.starts)):
        y, dy, *_ = sensitivities(asm, fitted.theta, state, piece.d)
        e = (piece.y - y) * piece.weight
        where = np.concatenate([np.arange(p), p + nx * r + np.arange(nx)])
        J = dy * piece.weight[:, :, None]
        flat = J.reshape(-1, J.shape[2])
        score = np.einsum("kip,ki->kp", J, e)
        lags = min(int(LAGS / min(fitted.form.paces)), len(piece.y) // 10)
        own = score.T @ score
        for k in range(1, lags + 1):
            cross = score[k:].T @ score[:-k]
            own += (1 - k / (lags + 1)) * (cross + cross.T)
        H[np.ix_(where, where)] += flat.T @ flat
        S[np.ix_(where, where)] += own
    scale = np.sqrt(np.maximum(np.diag(H), 1e-300))
    inverse = np.linalg.pinv(H / np.outer(scale, scale), rcond=1e-12, hermitian=True) / np.outer(scale, scale)
    return (inverse @ S @ inverse)[:p, :p]


def error_of(function: Callable[[Array], Array], theta: Array, cov: Array) -> Array:
    """Standard errors of a function (m,) of theta by the delta method."""
    middle = np.atleast_1d(function(theta))
    slopes = np.zeros((len(middle), len(theta)))
    for i in range(len(theta)):
        step = DIFFERENCE * max(abs(theta[i]), 1e-3)
        moved = theta.copy()
        moved[i] += step
        slopes[:, i] = (np.atleast_1d(function(moved)) - middle) / step
    return np.sqrt(np.maximum(np.einsum("mi,ij,mj->m", slopes, cov, slopes), 0.0))
