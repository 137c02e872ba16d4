"""Covariance of a fitted form's parameters where its errors are correlated: the sandwich of the errors' innovations."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.signal import lfilter
from scipy.stats import chi2

from estimators.diagnosis.discovery.fitting import Fitted, Piece, fit, forgets, run_piece, sensitivities
from estimators.diagnosis.discovery.form import Assembly
from estimators.residual.algebra import autoregressions, noise_filter

Array = NDArray[Any]
LEAST = 1e-9  # of a sample's own error left by the fit: one that alone tells a parameter has none
ALPHA, SEARCHED = 0.01, 1500  # rate of false terms in a model, and how many candidates it was the best of
MISSED = 0.05
"""Share by which the error may rise without a term. A coefficient beside a width of its own may be uncertain, as a tanh that
is nearly a cube is, where the term itself is beyond doubt: unused blocks judge it then."""
SEEN, FURTHER = 0.1, 3.0
"""Of the noise's variance, by which a fit must be worse at a standard error for the derivatives to be believed (by one, were the noise
white and the parameter alone), and by how much the distance grows until it is."""
ROUGH = 1e-6  # of a parameter: no record tells a change so small, and how the squares jump there is their roughness
DIFFERENCE = 1e-5  # relative step of the delta method
GAPS = 2  # times the noise is estimated with what it foretells itself in place of missing samples, after it took them for zero
BEFORE = 200  # samples before a record whose noise is still heard in it: of a pole of .98 all but 2 % is forgotten by then


@dataclass(frozen=True, eq=False)
class _Part:
    """One record: its place in the information, J (N, ny, own parameters) and errors e (N, ny), both zero where not `seen` (N, ny)."""

    where: NDArray[np.int64]
    J: Array
    e: Array
    seen: NDArray[np.bool_]


def covariance(fitted: Fitted, pieces: Sequence[Piece]) -> Array:
    """(P, P) of theta alone, the start states taken out.

    Errors are innovations w through 1 / A, so that what moves theta against the errors is that through 1 / A backwards in time against
    w, whose products have no memory of their own, be the variance constant or not. Every w counts as if its sample had not been fitted.
    """
    asm = Assembly(fitted.form)
    p, nx = len(fitted.theta), asm.chain_states
    H, parts = np.zeros((p + nx * len(pieces),) * 2), []
    for r, (piece, state) in enumerate(zip(pieces, fitted.starts)):
        y, dy, *_ = sensitivities(asm, fitted.theta, state, piece.d)
        where = np.concatenate([np.arange(p), p + nx * r + np.arange(nx)])
        J = dy * piece.weight[:, :, None]
        flat = J.reshape(-1, J.shape[2])
        H[np.ix_(where, where)] += flat.T @ flat  # pyright: ignore[reportCallIssue]
        parts.append(_Part(where, J, (piece.y - y) * piece.weight, piece.weight > 0.0))
    scale = np.sqrt(np.maximum(np.diag(H), 1e-300))
    inverse = np.linalg.pinv(H / np.outer(scale, scale), rcond=1e-12, hermitian=True) / np.outer(scale, scale)
    filters = _noises(parts, inverse)
    total = np.zeros((p, p))
    for q in parts:
        reach = q.J @ inverse[np.ix_(q.where, q.where)]
        back = np.stack([_backwards(a, reach[:, k]) for k, a in enumerate(filters)], axis=1)
        own = np.stack([lfilter(a, [1.0], q.J[:, k], axis=0) for k, a in enumerate(filters)], axis=1)
        e = [_foretold(q.e[:, k], q.seen[:, k], a) for k, a in enumerate(filters)]
        w = np.stack([lfilter(a, [1.0], x) for x, a in zip(e, filters, strict=True)], axis=1)
        kept = np.eye(w.shape[1]) - own @ back.transpose(0, 2, 1)
        left = np.linalg.solve(kept + LEAST * np.eye(w.shape[1]), w[:, :, None])
        moves = np.einsum("kip,ki->kp", back[:, :, :p], left[:, :, 0])
        total += moves.T @ moves
    wider = _wider(fitted, pieces, np.sqrt(np.diag(total)))
    return total * np.outer(wider, wider)


def _wider(fitted: Fitted, pieces: Sequence[Piece], errors: Array) -> Array:
    """(P,) factors from standard errors to the distance at which a fit is worse by the noise's variance, moved by that parameter alone.

    One where it is worse at the standard error. Dry friction that sticks and slips anew in every sample has derivatives that explode,
    and squares that are rough at the least distance: standard errors of next to nothing, of what moves no run.
    """
    asm, theta = Assembly(fitted.form), fitted.theta

    def squares(k: int, step: float) -> Array:
        off = np.zeros(2)
        for way in range(2):
            moved = theta + (1 - 2 * way) * step * np.eye(1, len(theta), k)[0]
            for piece, state in zip(pieces, fitted.starts):
                run = run_piece(asm, moved, state, piece.d)
                off[way] += np.sum(((piece.y - run.y) * piece.weight) ** 2) if run.fine else np.inf
        return off

    variance = fitted.sse / max(1, fitted.count)
    out = np.ones(len(theta))
    for k, error in enumerate(errors):
        size = max(abs(float(theta[k])), float(error))
        step = max(float(error), ROUGH * size)
        level = squares(k, ROUGH * size).max() + SEEN * variance
        while step < size and not squares(k, step).min() > level:
            step *= FURTHER
        if step > error > 0.0:
            out[k] = step / error
    return out


def _backwards(a: Array, x: Array) -> Array:
    """Signals (N, n) through 1 / A, from the last sample to the first."""
    return np.asarray(lfilter([1.0], a, x[::-1], axis=0))[::-1]


def _foretold(e: Array, seen: NDArray[np.bool_], a: Array) -> Array:
    """Errors (N,) with what those before foretell in place of the missing ones: innovations of zero."""
    order = len(a) - 1
    out = np.concatenate([np.zeros(order), e])
    for t in np.flatnonzero(~seen) if order else ():
        out[order + t] = -a[:0:-1] @ out[t : order + t]
    return out[order:]


def _noises(parts: Sequence[_Part], inverse: Array) -> list[Array]:
    """Whitening filter of each output's errors, the noise's and not the residual's: a fit takes what is slow out of it first.

    The covariances of the residuals are the noise's less what the fit takes, R - HR - RH + HRH with the projection H; that is added for
    the R of the residuals' own filter.
    """
    outputs = [[(q, q.J[:, k], q.e[:, k], q.seen[:, k]) for q in parts] for k in range(parts[0].e.shape[1])]
    filters, lags = zip(*(_of_residuals([e for *_, e, _ in own], [s for *_, s in own]) for own in outputs))
    spans = [
        [_coloured(a, c[0], J) * s[:, None] for _, J, _, s in own]
        for own, a, c in zip(outputs, filters, lags)
    ]
    taken = np.zeros_like(inverse)
    for own, span in zip(outputs, spans, strict=True):
        for (q, J, *_), RJ in zip(own, span, strict=True):
            taken[np.ix_(q.where, q.where)] += J.T @ RJ  # pyright: ignore[reportCallIssue]
    taken, found = inverse @ taken @ inverse, []
    for own, span, a, c in zip(outputs, spans, filters, lags, strict=True):
        n = sum(len(RJ) for RJ in span)
        for (q, J, *_), RJ in zip(own, span, strict=True):
            at = np.ix_(q.where, q.where)
            pairs = (J, RJ @ inverse[at]), (RJ @ inverse[at], J), (-J, J @ taken[at])
            c = c + [sum(float(np.sum(x[k:] * y[: len(y) - k])) for x, y in pairs) / n for k in range(len(a))]
        fits = list(autoregressions(c / c[0])) if c[0] > 0.0 else []
        found.append(fits[-1][0] if len(fits) == len(a) else a)
    return found


def _of_residuals(errors: Sequence[Array], seen: Sequence[NDArray[np.bool_]]) -> tuple[Array, Array]:
    """Whitening filter of one output's residuals (N,), its order chosen, and their covariances at as many lags and 0."""
    a = noise_filter(errors)
    for _ in range(0 if all(s.all() for s in seen) else GAPS):
        errors = [_foretold(e, s, a) for e, s in zip(errors, seen, strict=True)]
        a = noise_filter(errors)
    n = sum(map(len, errors))
    return a, np.array([sum(float(e[k:] @ e[: len(e) - k]) for e in errors) / n for k in range(len(a))])


def _coloured(a: Array, variance: float, x: Array) -> Array:
    """Covariance of a noise of that variance, white but for 1 / A, times signals (N, n)."""
    before = np.zeros((BEFORE if len(a) > 1 else 0, *x.shape[1:]))
    back = _backwards(a, np.concatenate([before, x]))
    pulse = np.asarray(lfilter([1.0], a, np.eye(1, BEFORE)[0]))
    return variance / float(pulse @ pulse) * np.asarray(lfilter([1.0], a, back, axis=0))[len(before) :]


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
