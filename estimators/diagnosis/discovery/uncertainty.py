"""Covariance of a fitted form's parameters where its errors are correlated: the sandwich, whitened and with Bartlett weights."""

from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.stats import chi2

from estimators.diagnosis.discovery.fitting import Fitted, Piece, fit, forgets, sensitivities
from estimators.diagnosis.discovery.form import Assembly
from estimators.pem.uncertainty import long_run

Array = NDArray[Any]
LAGS = (
    3.0  # of the Bartlett window, in the model's own time constants: errors of the model last about as long
)
LEAST = 1e-9  # of a sample's own error left by the fit: one that alone tells a parameter has none
ALPHA, SEARCHED = 0.01, 1500  # rate of false terms in a model, and how many candidates it was the best of
MISSED = 0.05
"""Share by which the error may rise without a term. A coefficient beside a width of its own may be uncertain, as a tanh that
is nearly a cube is, where the term itself is beyond doubt: unused blocks judge it then."""
DIFFERENCE = 1e-5  # relative step of the delta method


def covariance(fitted: Fitted, pieces: Sequence[Piece]) -> Array:
    """(P, P) of theta alone, the start states taken out; every error counts as if its own sample had not been fitted."""
    asm = Assembly(fitted.form)
    p, nx = len(fitted.theta), asm.chain_states
    H, parts = np.zeros((p + nx * len(pieces),) * 2), []
    for r, (piece, state) in enumerate(zip(pieces, fitted.starts)):
        y, dy, *_ = sensitivities(asm, fitted.theta, state, piece.d)
        where = np.concatenate([np.arange(p), p + nx * r + np.arange(nx)])
        J = dy * piece.weight[:, :, None]
        flat = J.reshape(-1, J.shape[2])
        H[np.ix_(where, where)] += flat.T @ flat  # pyright: ignore[reportCallIssue]
        parts.append((where, J, (piece.y - y) * piece.weight))
    scale = np.sqrt(np.maximum(np.diag(H), 1e-300))
    inverse = np.linalg.pinv(H / np.outer(scale, scale), rcond=1e-12, hermitian=True) / np.outer(scale, scale)
    moves = []
    for where, J, e in parts:
        reach = J @ inverse[np.ix_(where, where)]
        kept = np.eye(e.shape[1]) - reach @ J.transpose(0, 2, 1)
        left = np.linalg.solve(kept + LEAST * np.eye(e.shape[1]), e[:, :, None])
        moves.append(np.einsum("kip,ki->kp", reach[:, :, :p], left[:, :, 0]))
    size = np.sqrt(np.mean(np.concatenate(moves) ** 2, axis=0)) + 1e-300
    lags = min(int(LAGS / min(fitted.form.paces)), min(len(q.y) for q in pieces) // 10)
    return long_run([m / size for m in moves], lags) * np.outer(size, size)


def beyond_linear(fitted: Fitted, pieces: Sequence[Piece]) -> Array:
    """(samples, terms that act): what each term moves in the outputs that neither the linear part nor the starts could.

    To first order; a term that is nearly proportional to its signal hides a part of the linear model, and moves little here.
    """
    asm, form = Assembly(fitted.form), fitted.form
    p, nx = form.linear_size, asm.chain_states
    acting = [(b, form.taps(t)) for t, b in zip(form.terms, form.blocks) if t.slot != "slow"]
    columns, bases = [], []
    for r, (piece, state) in enumerate(zip(pieces, fitted.starts)):
        _, dy, *_ = sensitivities(asm, fitted.theta, state, piece.d)
        J = (dy * piece.weight[:, :, None]).reshape(-1, dy.shape[2])
        columns.append(
            np.stack(
                [J[:, b.start : b.start + m] @ fitted.theta[b.start : b.start + m] for b, m in acting], 1
            )
        )
        base = np.zeros((len(J), p + nx * len(pieces)))
        base[:, :p], base[:, p + nx * r : p + nx * (r + 1)] = J[:, :p], J[:, len(fitted.theta) :]
        bases.append(base)
    X, B = np.vstack(columns), np.vstack(bases)
    B = B / np.maximum(np.linalg.norm(B, axis=0), 1e-300)
    return X - B @ np.linalg.lstsq(B, X, rcond=1e-9)[0]


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


def pruned(fitted: Fitted, pieces: Sequence[Piece], rounds: int) -> Fitted:
    """The model without the terms that are not significant in the joint fit, the weakest taken out first.

    The bar is that of the best of `SEARCHED` candidates, errors taken for as correlated as they are.
    """
    while fitted.form.terms:
        p_values = _p_values(fitted, covariance(fitted, pieces))
        weakest = max(p_values, key=lambda t: p_values[t])
        if p_values[weakest] < ALPHA / SEARCHED:
            return fitted
        less = _without(fitted, weakest, pieces, rounds)
        if less is None or less.sse > (1.0 + MISSED) * fitted.sse:
            return fitted
        fitted = less
    return fitted


def _p_values(fitted: Fitted, cov: Array) -> dict[int, float]:
    """Wald test of the coefficients of every term that acts, by its number."""
    out = {}
    for t, (term, block) in enumerate(zip(fitted.form.terms, fitted.form.blocks)):
        taps = fitted.form.taps(term)
        if taps:
            rows = slice(block.start, block.start + taps)
            k = fitted.theta[rows]
            out[t] = float(chi2.sf(k @ np.linalg.pinv(cov[rows, rows], hermitian=True) @ k, taps))
    return out


def _without(fitted: Fitted, number: int, pieces: Sequence[Piece], rounds: int) -> Fitted | None:
    """Refitted without a term and the slow states that only it reads."""
    form = fitted.form
    slow = [t for t, term in enumerate(form.terms) if term.slot == "slow"]
    kept = [t for t in range(len(form.terms)) if t != number]
    read = {f.signal for t in kept for f in form.terms[t].factors}
    gone = {t for m, t in enumerate(slow) if f"s{m}" not in read}
    kept = [t for t in kept if t not in gone]
    renamed = {f"s{slow.index(t)}": f"s{m}" for m, t in enumerate(t for t in kept if t in slow)}
    terms = [
        replace(
            form.terms[t],
            factors=tuple(replace(f, signal=renamed.get(f.signal, f.signal)) for f in form.terms[t].factors),
        )
        for t in kept
    ]
    theta = np.concatenate([fitted.theta[: form.linear_size], *(fitted.theta[form.blocks[t]] for t in kept)])
    less = fit(form.with_terms(*terms), theta, fitted.starts, pieces, iterations=rounds)
    return less if less is not None and forgets(less, pieces) else None
