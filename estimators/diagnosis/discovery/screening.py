"""Screening: what each candidate would explain of the residual, by one linear regression on exact sensitivities."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import gaussian_filter1d

from estimators.diagnosis.discovery.dictionary import Candidate, candidates, values
from estimators.diagnosis.discovery.fitting import Fitted, Piece, run_piece, start_state
from estimators.diagnosis.discovery.form import FREE, LAST, Assembly, Term

__all__ = ["Screened", "screen"]

Array = NDArray[Any]
SMOOTH = 1.0  # samples over which measured outputs are smoothed before they enter a candidate, over the pace
LEAST = 1e-8  # share of a column that must be left once the model's own columns are taken out


@dataclass(frozen=True, eq=False)
class Screened:
    """A candidate in a slot: chain, shape, coefficients of a linearised fit, squared error that it would take away."""

    candidate: Candidate
    slot: str
    chain: int
    along: int
    coefficients: Array
    gain: float


def _signals(asm: Assembly, signals: Array) -> dict[str, Array]:
    return {name: np.ascontiguousarray(signals[:, i]) for i, name in enumerate(asm.signals)}


def _measured(asm: Assembly, own: dict[str, Array], piece: Piece, y: Array) -> dict[str, Array]:
    """The signals with the outputs (and rates) as measured: the simulated ones plus the smoothed residual."""
    out = dict(own)
    for i, pace in enumerate(asm.form.paces):
        e = (piece.y[:, i] - y[:, i]) * piece.weight[:, i]
        better = own[f"y{i}"] + gaussian_filter1d(e, SMOOTH / pace, mode="nearest")
        out[f"y{i}"] = better
        out[f"v{i}"] = np.diff(better, prepend=better[:1]) / asm.form.steps[i]
    return out


def _columns(
    asm: Assembly, fitted: Fitted, piece: Piece, state: Array, w: Array
) -> tuple[Array, Array, Array]:
    """Residual (N ny,), Jacobian of the model itself and, per chain and tap then output, that of exogenous w (N, m)."""
    form, p, nx, m = fitted.form, len(fitted.theta), asm.chain_states, w.shape[1]
    filled = asm.fill(fitted.theta)
    mats = filled.mats
    wide = tuple(np.hstack([x, np.zeros((len(x), m))]) if i in (1, 4, 6) else x for i, x in enumerate(mats))
    nd, ny = mats[1].shape[1], len(form.orders)
    rows, extra = [], []
    number = p + nx
    for i in range(ny):
        for r in range(form.orders[i]):
            rows += [(number + c, 1, asm.first[i] + r, nd + c) for c in range(m)]
            extra += [form.paces[i]] * m
            number += m
    for i in range(ny):
        rows += [(number + c, 6, i, nd + c) for c in range(m)]
        extra += [1.0] * m
        number += m
    x, dx = start_state(asm, filled, state, piece.d[0])
    begin = np.zeros((len(x), number))
    begin[:, p : p + nx] = dx
    entries = np.vstack([filled.moving[0], np.array(rows, dtype=np.int64)])
    got = filled._replace(mats=wide).moved(
        x,
        begin,
        np.hstack([piece.d, w]),
        entries,
        np.concatenate([filled.moving[1], extra]),
        filled.moving[2],
    )
    y, dy = got.y, got.dy
    J = (dy * piece.weight[:, :, None]).reshape(-1, number)
    return ((piece.y - y) * piece.weight).ravel(), J[:, : p + nx], J[:, p + nx :]


def screen(
    fitted: Fitted, pieces: Sequence[Piece], zeros: dict[str, float], measured: bool
) -> list[Screened]:
    """Every candidate in every slot with its gain; its arguments simulated, or measured where that is asked."""
    form = fitted.form
    asm = Assembly(form)
    own = []
    for piece, state in zip(pieces, fitted.starts):
        y, _, signals, _, _ = run_piece(asm, fitted.theta, state, piece.d)
        named = _signals(asm, signals)
        own.append(_measured(asm, named, piece, y) if measured else named)
    joined = {k: np.concatenate([o[k] for o in own]) for k in own[0]}
    listed = candidates(form, joined, zeros, 1 / max(form.paces))
    has = {(t.factors, t.slot) for t in form.terms}
    per_piece = []
    for o in own:
        columns = []
        for c in listed:
            s = dict(o)
            for t in c.terms[:-1]:
                s["s"] = values(t, o)
            columns.append(values(c.terms[-1], s))
        per_piece.append(np.array(columns).T)
    size = np.sqrt(np.mean(np.vstack(per_piece) ** 2, axis=0)) + 1e-300
    residual, X = _projected(asm, fitted, pieces, [w / size for w in per_piece])
    return _gains(form, fitted, listed, residual, X, size, has)


def _projected(asm, fitted, pieces, ws) -> tuple[Array, Array]:
    """Residual and candidates' columns with the model's own parameters and every record's start taken out."""
    p = len(fitted.theta)
    residuals, bases, columns = [], [], []
    for piece, state, w in zip(pieces, fitted.starts, ws):
        e, J, X = _columns(asm, fitted, piece, state, w)
        Q = _basis(J[:, p:])
        residuals.append(e - Q @ (Q.T @ e))
        bases.append(J[:, :p] - Q @ (Q.T @ J[:, :p]))
        columns.append(X - Q @ (Q.T @ X))
    Q = _basis(np.vstack(bases))
    e, X = np.concatenate(residuals), np.vstack(columns)
    before = np.einsum("ij,ij->j", X, X)
    X -= Q @ (Q.T @ X)
    after = np.einsum("ij,ij->j", X, X)
    X[:, after < LEAST * before] = 0.0
    return e - Q @ (Q.T @ e), X


def _basis(J: Array) -> Array:
    size = np.linalg.norm(J, axis=0)
    U, s, _ = np.linalg.svd(J[:, size > 0] / size[size > 0], full_matrices=False)
    return U[:, s > 1e-7 * s.max(initial=0.0)]


def _gains(form, fitted, listed, residual, X, size, has) -> list[Screened]:
    m, ny = len(listed), len(form.orders)
    first = np.concatenate([[0], np.cumsum(form.orders)])
    X = X.reshape(len(X), -1, m)  # (N, taps of all chains then outputs, candidates)
    g = np.einsum("n,ntm->tm", residual, X)
    squares = np.einsum("ntm,ntm->tm", X, X)
    betas = Assembly(form).betas
    out = []
    for c, candidate in enumerate(listed):
        if (candidate.terms[-1].factors, "force") in has or (candidate.terms[-1].factors, "output") in has:
            continue
        for i in range(ny):
            at = slice(first[i], first[i + 1])
            Xi, gi = X[:, at, c], g[at, c]
            G = Xi.T @ Xi
            out += _forces(candidate, i, G, gi, size[c], [fitted.theta[b] for b in betas[i]])
            o = first[-1] + i
            if squares[o, c] > 0:
                k = g[o, c] / squares[o, c]
                out.append(
                    Screened(candidate, "output", i, FREE, np.array([k / size[c]]), float(k * g[o, c]))
                )
    return out


def _forces(candidate, chain, G, g, size, betas) -> list[Screened]:
    """The force's shapes: own taps, highest derivative alone, along each input."""
    out = []
    if not np.any(np.diag(G) > 0):
        return out
    n = len(g)
    scale = np.sqrt(np.maximum(np.diag(G), 1e-300))
    Gs = G / np.outer(scale, scale)
    k = np.linalg.lstsq(Gs + 1e-8 * np.eye(n), g / scale, rcond=None)[0] / scale
    if n > 1:
        out.append(Screened(candidate, "force", chain, FREE, k / size, float(k @ g)))
    if G[-1, -1] > 0:
        k1 = g[-1] / G[-1, -1]
        out.append(Screened(candidate, "force", chain, LAST, np.array([k1 / size]), float(k1 * g[-1])))
    for j, b in enumerate(betas):
        power = b @ G @ b
        if power > 0:
            kj = (b @ g) / power
            out.append(Screened(candidate, "force", chain, j, np.array([kj / size]), float(kj * (b @ g))))
    return out


def terms_of(screened: Screened, fitted: Fitted) -> tuple[tuple[Term, ...], Array]:
    """The terms to add and their parameters to start from."""
    from estimators.diagnosis.discovery.dictionary import placed

    terms = placed(screened.candidate, fitted.form, screened.slot, screened.chain, screened.along)
    theta = []
    for t in terms:
        theta += [1.0] if t.slot == "slow" else list(screened.coefficients)
        tail = [x for f in t.factors for x, free in ((f.p, f.free[0]), (f.q, f.free[1])) if free]
        theta = theta[:-1] + tail + theta[-1:] if t.slot == "slow" else theta + tail
    return terms, np.array(theta)
