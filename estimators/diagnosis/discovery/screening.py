"""Screening: what each candidate would explain of the residual, by one linear regression on exact sensitivities."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import gaussian_filter1d

from estimators.diagnosis.discovery.dictionary import NONE, Candidate, candidates, placed, values
from estimators.diagnosis.discovery.fitting import Fitted, Piece, run_piece, start_state
from estimators.diagnosis.discovery.form import FREE, LAST, Assembly, Term, flow_of
from estimators.residual.algebra import thin_svd

Array = NDArray[Any]
SMOOTH = 1.0  # samples over which measured outputs are smoothed before they enter a candidate, over the pace
BEND = (
    0.03  # share of a term's spread that is not linear in its signals: below it the term is linear dynamics
)
LEAST = 1e-8  # share of a column that must be left once the model's own columns are taken out
ELEMENTS = (
    4_000_000  # of all candidates' sensitivities at once; a longer record is screened on its worst part
)
SHORT = 400  # samples that a part has at least
KEPT = 60  # candidates of a chain that go on where a part had to do for all
PAIRS = 3  # pairs of forces that are fitted beside the single candidates
ALIKE = 0.01  # share of a column that another must leave of it: else the two together are the difference of their errors


@dataclass(frozen=True, eq=False)
class Screened:
    """A candidate in a slot: chain, shape, coefficients of a linearised fit, squared error that it would take away."""

    candidate: Candidate
    slot: str
    chain: int
    along: int
    coefficients: Array
    gain: float
    beside: "Screened | None" = None  # a force that is to be added with it; the gain is that of both

    @property
    def parameters(self) -> int:
        """What it would add: coefficients, free constants, rates of slow states."""
        terms = self.candidate.terms
        own = (
            len(self.coefficients) + sum(sum(f.free) for t in terms for f in t.factors) + self.candidate.slow
        )
        return own + (0 if self.beside is None else self.beside.parameters)

    @property
    def key(self) -> tuple:
        """What it is apart from its constants, and where it acts."""
        own = (self.candidate.key, self.slot, self.chain, self.along == FREE)
        return (own,) if self.beside is None else tuple(sorted((own, *self.beside.key), key=str))


@dataclass(frozen=True, eq=False)
class _Part:
    """A stretch of a record with the chain state at its start."""

    piece: Piece
    state: Array


def _measured(asm: Assembly, own: dict[str, Array], piece: Piece, y: Array) -> dict[str, Array]:
    """The signals with the outputs (and rates) as measured: the simulated ones plus the smoothed residual."""
    out = dict(own)
    for i, pace in enumerate(asm.form.paces):
        e = (piece.y[:, i] - y[:, i]) * piece.weight[:, i]
        better = own[f"y{i}"] + gaussian_filter1d(e, SMOOTH / pace, mode="nearest")
        out[f"y{i}"] = better
        out[f"v{i}"] = np.diff(better, prepend=better[:1]) / asm.form.steps[i]
        out[flow_of(i)] = np.diff(better, append=better[-1:]) / pace
    return out | {d.name: d.of(out) for d in asm.form.differences}


def _parts(fitted: Fitted, pieces: Sequence[Piece], samples: int) -> list[_Part]:
    """The records themselves, or the stretch of each where the residual is largest."""
    asm, out = Assembly(fitted.form), []
    most = max(samples // len(pieces), SHORT)
    for p, state, y in zip(pieces, fitted.starts, fitted.outputs):
        if len(p.y) <= most:
            out.append(_Part(p, state))
            continue
        power = np.cumsum(np.r_[0.0, (((p.y - y) * p.weight) ** 2).sum(axis=1)])
        a = int(np.argmax(power[most:] - power[:-most]))
        states = run_piece(asm, fitted.theta, state, p.d[: a + 1]).states
        cut = Piece(p.d[a : a + most], p.y[a : a + most], p.weight[a : a + most])
        out.append(_Part(cut, states[a, : asm.chain_states].copy()))
    return out


def screen(fitted: Fitted, pieces: Sequence[Piece], zeros: dict[str, float]) -> list[Screened]:
    """Candidates in every slot with their gains over all data, arguments simulated and as measured; the better counts."""
    form = fitted.form
    asm = Assembly(form)
    listed = None
    parts = _parts(fitted, pieces, sum(len(p.y) for p in pieces))
    signals = _signals(asm, fitted, parts)
    joined = {k: np.concatenate([s[k] for pair in signals for s in pair]) for k in signals[0][0]}
    listed = candidates(form, joined, zeros, 1 / max(form.paces))
    taken = {(t.factors, t.slot) for t in form.terms}
    listed = [c for c in listed if not any((c.terms[-1].factors, s) in taken for s in ("force", "output"))]
    columns = 2 * len(listed) * (sum(form.orders) + len(form.orders)) * len(form.orders)
    room = ELEMENTS // columns
    if room < sum(len(p.y) for p in pieces):
        some = _parts(fitted, pieces, max(room, SHORT))
        best = sorted(_scored(fitted, some, _signals(asm, fitted, some), listed), key=lambda s: -s.gain)
        kept: dict[tuple, Candidate] = {}
        for i in range(len(form.orders)):
            for s in [s for s in best if s.chain == i][:KEPT]:
                kept.setdefault((s.candidate.key, s.candidate.terms), s.candidate)
        if not kept:  # all are linear in their signals
            return []
        listed = list(kept.values())
        columns = 2 * len(listed) * (sum(form.orders) + len(form.orders)) * len(form.orders)
        parts = _parts(fitted, pieces, max(ELEMENTS // columns, SHORT))
        signals = _signals(asm, fitted, parts)
    return _scored(fitted, parts, signals, listed)


def _signals(
    asm: Assembly, fitted: Fitted, parts: Sequence[_Part]
) -> list[tuple[dict[str, Array], dict[str, Array]]]:
    out = []
    for part in parts:
        run = run_piece(asm, fitted.theta, part.state, part.piece.d)
        own = {name: np.ascontiguousarray(run.signals[:, i]) for i, name in enumerate(asm.signals)}
        out.append((own, _measured(asm, own, part.piece, run.y)))
    return out


def _scored(fitted: Fitted, parts: Sequence[_Part], signals, listed: Sequence[Candidate]) -> list[Screened]:
    """Every listed candidate in every slot and shape, but for those that are linear in their signals.

    Signals as measured hold the residual itself, which such candidates would then explain.
    """
    form = fitted.form
    per_part = []
    for pair in signals:
        columns = []
        for own in pair:
            straight: dict[tuple[str, ...], Array] = {}
            for c in listed:
                s = dict(own)
                for t in c.terms[:-1]:
                    s["s"] = values(t, own)
                w = values(c.terms[-1], s)
                names = tuple(sorted({f.signal for f in c.terms[-1].factors if f.signal[0] != "s"}))
                if names not in straight:
                    straight[names] = np.linalg.qr(
                        np.array([np.ones(len(own["y0"])), *(own[n] for n in names)]).T
                    )[0]
                left = w - straight[names] @ (straight[names].T @ w)
                columns.append(w if left.std() > BEND * w.std() else 0.0 * w)
        per_part.append(np.array(columns).T)
    size = np.sqrt(np.mean(np.vstack(per_part) ** 2, axis=0)) + 1e-300
    residual, X = _projected(Assembly(form), fitted, parts, [w / size for w in per_part])
    share = fitted.sse / max(float(residual @ residual), 1e-300)  # a part stands for the whole
    return _gains(fitted, list(listed) * 2, residual, X, size, share)


def _columns(asm: Assembly, fitted: Fitted, part: _Part, w: Array) -> tuple[Array, Array, Array]:
    """Residual (N ny,), Jacobian of the model itself and, per chain and tap then output, that of exogenous w (N, m)."""
    form, p, nx, m = fitted.form, len(fitted.theta), asm.chain_states, w.shape[1]
    filled, piece = asm.fill(fitted.theta), part.piece
    mats = filled.mats
    wide = tuple(np.hstack([x, np.zeros((len(x), m))]) if i in (1, 4, 6) else x for i, x in enumerate(mats))
    nd, ny = mats[1].shape[1], len(form.orders)
    places = [(1, asm.first[i] + r, form.paces[i]) for i in range(ny) for r in range(form.orders[i])]
    places += [(6, i, 1.0) for i in range(ny)]
    rows = np.array(
        [(p + nx + m * k + c, a, b, nd + c) for k, (a, b, _) in enumerate(places) for c in range(m)],
        dtype=np.int64,
    )
    x, dx = start_state(asm, filled, part.state, piece.d[0])
    begin = np.zeros((len(x), p + nx + m * len(places)))
    begin[:, p : p + nx] = dx
    got = filled._replace(mats=wide).moved(
        x,
        begin,
        np.hstack([piece.d, w]),
        np.vstack([filled.moving[0], rows]),
        np.concatenate([filled.moving[1], np.repeat([v for *_, v in places], m)]),
        filled.moving[2],
    )
    J = (got.dy * piece.weight[:, :, None]).reshape(-1, begin.shape[1])
    return ((piece.y - got.y) * piece.weight).ravel(), J[:, : p + nx], J[:, p + nx :]


def _projected(asm, fitted, parts, ws) -> tuple[Array, Array]:
    """Residual and candidates' columns with the model's own parameters and every record's start taken out."""
    p = len(fitted.theta)
    residuals, bases, columns = [], [], []
    for part, w in zip(parts, ws):
        e, J, X = _columns(asm, fitted, part, w)
        Q = _basis(J[:, p:])
        residuals.append(e - Q @ (Q.T @ e))
        bases.append(J[:, :p] - Q @ (Q.T @ J[:, :p]))
        columns.append(X - Q @ (Q.T @ X))
    Q = _basis(np.vstack(bases))
    e, X = np.concatenate(residuals), np.vstack(columns)
    before = np.einsum("ij,ij->j", X, X)
    X -= Q @ (Q.T @ X)
    X[:, np.einsum("ij,ij->j", X, X) < LEAST * before] = 0.0
    return e - Q @ (Q.T @ e), X


def _basis(J: Array) -> Array:
    size = np.linalg.norm(J, axis=0)
    if not np.isfinite(size).all() or not size.any():
        return np.zeros((len(J), 0))
    U, s, _ = thin_svd(J[:, size > 0] / size[size > 0])
    return U[:, s > 1e-7 * s.max(initial=0.0)]


def _gains(fitted: Fitted, listed, residual: Array, X: Array, size: Array, share: float) -> list[Screened]:
    """All shapes at once: own taps, highest derivative alone, along each input, on top of the output; mobilities in the first state."""
    form, m = fitted.form, len(listed)
    first = np.concatenate([[0], np.cumsum(form.orders)])
    X = X.reshape(len(X), -1, m)  # (N, taps of all chains then outputs, candidates)
    g = np.einsum("n,ntm->tm", residual, X, optimize=True)
    betas = Assembly(form).betas
    out: list[Screened] = []
    moved = np.array([c.moves for c in listed])

    def add(slot: str, chain: int, along: int, k: Array, gain: Array) -> None:
        """k (m, taps) coefficients, gain (m,)."""
        own = moved == (chain if slot == "mobility" else NONE)
        for c in np.flatnonzero(own & np.isfinite(gain) & (gain > 0)):
            out.append(Screened(listed[c], slot, chain, along, k[c] / size[c], float(gain[c] * share)))

    for i, n in enumerate(form.orders):
        at = slice(int(first[i]), int(first[i + 1]))
        Xi, gi = X[:, at], g[at].T
        G = np.matmul(Xi.transpose(2, 1, 0), Xi.transpose(2, 0, 1))  # (m, n, n)
        scale = np.sqrt(np.maximum(np.diagonal(G, axis1=1, axis2=2), 1e-300))
        Gs = G / (scale[:, :, None] * scale[:, None, :]) + LEAST * np.eye(n)
        if n > 1:
            k = np.linalg.solve(Gs, (gi / scale)[:, :, None])[:, :, 0] / scale
            add("force", i, FREE, k, np.einsum("mn,mn->m", k, gi))
        state = gi[:, :1] / scale[:, :1] ** 2
        add("mobility", i, FREE, state, state[:, 0] * gi[:, 0])
        last = gi[:, -1:] / scale[:, -1:] ** 2
        add("force", i, LAST, last, last[:, 0] * gi[:, -1])
        pairs = _pairs(listed, i, LAST, Xi[:, -1], gi[:, -1], size, share)
        for j, numbers in enumerate(betas[i]):
            b = fitted.theta[numbers]
            power = np.maximum(np.einsum("a,mab,b->m", b, G, b), 1e-300)
            add("force", i, j, (gi @ b / power)[:, None], (gi @ b) ** 2 / power)
            if n > 1:
                pairs += _pairs(listed, i, j, np.einsum("ntm,t->nm", Xi, b), gi @ b, size, share)
        out += sorted(pairs, key=lambda s: -s.gain)[:PAIRS]
        o = int(first[-1]) + i
        power = np.maximum(np.einsum("nm,nm->m", X[:, o], X[:, o]), 1e-300)
        add("output", i, FREE, (g[o] / power)[:, None], g[o] ** 2 / power)
    return out


def _pairs(listed, i: int, along: int, X: Array, g: Array, size: Array, share: float) -> list[Screened]:
    """Two forces at once that enter alike, by exact regression on both; the best `PAIRS` of them.

    A product with a difference, as a flow that carries warmth, is two terms of which neither need explain anything alone; a curve
    of an input may be two.
    """
    at = np.flatnonzero([c.slow == 0 and c.moves == NONE for c in listed])
    X, g = X[:, at], g[at]
    scale = np.sqrt(np.einsum("nm,nm->m", X, X))
    fine = scale > 0
    at, X, g, scale = at[fine], X[:, fine] / scale[fine], g[fine] / scale[fine], scale[fine]
    r = X.T @ X
    left = 1.0 - r**2
    gain = (g[:, None] ** 2 + g**2 - 2.0 * r * g[:, None] * g) / np.maximum(left, 1e-12)
    gain[(left < ALIKE) | np.tri(len(g), dtype=bool) | ~np.isfinite(gain)] = 0.0
    out: dict[tuple, Screened] = {}
    while gain.size and len(out) < PAIRS:  # few of them are looked at: no sorting
        a, b = np.unravel_index(np.argmax(gain), gain.shape)
        best, gain[a, b] = float(gain[a, b]), 0.0
        if best <= 0.0:
            break
        k = np.array([g[a] - r[a, b] * g[b], g[b] - r[a, b] * g[a]]) / (
            left[a, b] * scale[[a, b]] * size[at[[a, b]]]
        )
        first, second = (
            Screened(listed[at[c]], "force", i, along, k[m : m + 1], 0.0) for m, c in enumerate((a, b))
        )
        if first.candidate.key != second.candidate.key:
            pair = replace(first, gain=best * share, beside=second)
            out.setdefault(pair.key, pair)
    return [*out.values()]


def terms_of(screened: Screened, fitted: Fitted) -> tuple[tuple[Term, ...], Array]:
    """The terms to add and their parameters to start from."""
    if screened.beside is not None:
        pairs = [terms_of(x, fitted) for x in (replace(screened, beside=None), screened.beside)]
        return (*pairs[0][0], *pairs[1][0]), np.concatenate([p[1] for p in pairs])
    terms = placed(screened.candidate, fitted.form, screened.slot, screened.chain, screened.along)
    theta: list[float] = []
    for t in terms:
        theta += [] if t.slot == "slow" else list(screened.coefficients)
        theta += [x for f in t.factors for x, free in ((f.p, f.free[0]), (f.q, f.free[1])) if free]
        theta += [1.0] if t.slot == "slow" else []
    return terms, np.array(theta)
