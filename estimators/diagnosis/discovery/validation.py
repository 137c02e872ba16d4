"""What a discovered model is worth on data that it did not see: starts from a window, blocks left out, stability."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from estimators.diagnosis.baseline import Blocks
from estimators.diagnosis.discovery.fitting import Fitted, Piece, fit, start_state
from estimators.diagnosis.discovery.form import NOTHING, Assembly

__all__ = ["first_level", "rest", "simulated", "trust", "unused", "window_start"]

Array = NDArray[Any]
SPREAD = (
    0.3  # standard deviations of the output by which a start may differ from rest, where nothing says rest
)
TRUST = 3.0  # samples of the model's own (correlated) error that a carried or resting state is worth
STILL = 5  # samples without a change of the drive that are taken for rest
STEPS = 4  # of the window's fit: its problem is nearly linear
FOLD_ROUNDS = 4  # of a fit that starts from that of all blocks


def rest(asm: Assembly, theta: Array, y0: Array, d0: Array) -> Array:
    """Whole state of rest at outputs y0 (ny,) and drive d0: no chain moves, as far as its order can hold it."""
    filled = asm.fill(theta)
    mats = filled.mats
    state = np.zeros(asm.chain_states)
    state[asm.first[:-1]] = y0
    x, _ = start_state(asm, filled, state, d0)
    for i, n in enumerate(asm.form.orders):
        f = asm.first[i]
        w = filled.terms(x, d0)
        offset = float(mats[6][i] @ d0 + mats[7][i] @ w)  # what the output map adds, at its first value
        x[f] = y0[i] - offset
        x[asm.chain_states + i] = x[f]
        w = filled.terms(x, d0)
        for m in range(n - 1):
            x[f + m + 1] = 0.0
            moved = mats[0][f + m] @ x + mats[1][f + m] @ d0 + mats[2][f + m] @ w - x[f + m]
            x[f + m + 1] = -moved / asm.form.paces[i]
    return x


def window_start(
    asm: Assembly, theta: Array, expected: Array, piece: Piece, window: int, ridge: float
) -> Array:
    """Whole state from the first `window` samples, about the expected one that the ridge holds."""
    if window <= 0:
        return expected
    filled = asm.fill(theta)
    nx, ny = asm.chain_states, len(asm.form.orders)
    dx = np.zeros((len(expected), nx))
    dx[:nx] = np.eye(nx)
    for i in range(ny):
        dx[nx + i, asm.first[i]] = 1.0
    weight = piece.weight[:window].ravel()
    x, best, cost = expected, expected, np.inf
    for _ in range(STEPS):
        y, dy, _, _, fine = filled.moved(x, dx, piece.d[:window], *NOTHING)
        if not fine:
            break
        e = (piece.y[:window] - y).ravel() * weight
        off = (x - expected)[:nx]
        now = float(e @ e + ridge * off @ off)
        if now >= cost * (1 - 1e-6):
            break
        best, cost = x, now
        J = dy.reshape(len(e), nx) * weight[:, None]
        x = x + dx @ np.linalg.solve(J.T @ J + ridge * np.eye(nx), J.T @ e - ridge * off)
    return best


def simulated(asm: Assembly, theta: Array, x0: Array, d: Array) -> tuple[Array, Array, bool]:
    """Outputs (N, ny) and states from a whole state; not finite where the run explodes."""
    y, _, _, states, fine = asm.fill(theta).run(x0, d)
    if not fine:
        y = np.full_like(y, np.nan)
    return y, states, fine


def trust(piece: Piece, mse: float) -> float:
    """Ridge of a record's start: firm where its drive stands still at first, loose where nothing says rest."""
    return TRUST if np.all(piece.d[:STILL] == piece.d[0]) else max(mse, 1e-12) / SPREAD**2


def first_level(piece: Piece, most: int) -> Array:
    """(ny,) output at the start: the mean of the samples over which the drive has not moved yet, at most `most`."""
    still = np.all(piece.d[: max(most, 1)] == piece.d[0], axis=1)
    n = len(still) if still.all() else max(int(np.argmin(still)), 1)
    w = piece.weight[:n]
    return (piece.y[:n] * w).sum(axis=0) / np.maximum(w.sum(axis=0), 1.0)


def unused(fitted: Fitted, pieces: Sequence[Piece], blocks: Blocks, starts_at: int) -> list[Array] | None:
    """Per record (N, ny): every block by the form fitted to the others, its state from its window; None if one explodes."""
    asm = Assembly(fitted.form)
    out = [np.full_like(p.y, np.nan) for p in pieces]
    for block in blocks.blocks:
        use = blocks.training(block)
        kept = [Piece(p.d, p.y, p.weight * u[:, None]) for p, u in zip(pieces, use)]
        f = fit(fitted.form, fitted.theta, fitted.starts, kept, iterations=FOLD_ROUNDS, anchor=TRUST)
        if f is None:
            return None
        piece, r = pieces[block.record], block.record
        x0, _ = start_state(asm, asm.fill(f.theta), f.starts[r], piece.d[0])
        _, states, fine = simulated(asm, f.theta, x0, piece.d)
        part = Piece(piece.d[block.rows], piece.y[block.rows], piece.weight[block.rows])
        expected = states[block.start] if fine else rest(asm, f.theta, part.y[0], part.d[0])
        x = window_start(asm, f.theta, expected, part, blocks.window, TRUST if fine else f.mse / SPREAD**2)
        out[r][block.rows] = simulated(asm, f.theta, x, part.d)[0]
    return out
