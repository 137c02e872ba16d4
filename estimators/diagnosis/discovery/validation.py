"""What a discovered model is worth on data that it did not see: starts from a window, blocks left out, stability."""

import warnings
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import newton

from estimators.diagnosis.baseline import Block, Blocks
from estimators.diagnosis.discovery.fitting import REACH, Fitted, Piece, fit, run_piece, start_state
from estimators.diagnosis.discovery.form import NOTHING, Assembly, Filled

Array = NDArray[Any]
FIRM = 1.0  # error variances by which a carried or resting state is off
LONGEST = 0.98  # correlation from sample to sample of the model's error: beyond it a level is no error but the state
SECANTS = 20  # steps to the output that an output map reads as a value
STILL = 5  # samples without a change of the drive that are taken for rest
SETTLES, LONG = 10.0, 2000  # time constants, and samples at most, over which a model held at rest must stay
ALIKE = 3.0  # standard errors of the model within which it stays
CALM = 0.1  # share of its way that the model still goes in the second half of them where it comes to rest
STEPS = 5  # of the window's fit: its problem is nearly linear
FOLD_ROUNDS = 4  # of a fit that starts from that of all blocks
AHEAD = 0.3  # share of a record that the forward check leaves out
ANCHOR = 3.0  # samples that a start state is worth where its own record's first block is left out
TINY = 1e-6  # share of a state's variance below which it counts as that large


@dataclass(frozen=True, eq=False)
class StartPrior:
    """Chain states along the training records: mean (n,), covariance (n, n); the model's error: variance, correlation.

    The error lasts: what a window says of the state is weighed with the correlation (ny,) from sample to sample.
    """

    mean: Array
    covariance: Array
    mse: float
    correlation: Array

    def ridge(self, firm: bool) -> Array:
        """Inverse covariance of the expected state, in units of the error's variance."""
        return np.linalg.inv(self.covariance) * (1 / FIRM if firm else max(self.mse, 1e-12))

    def whitened(self, e: Array, weight: Array) -> Array:
        """Errors or their derivatives (N, ny, ...) as independent ones of the same variance (first-order correlation)."""
        out = (e.T * weight.T).T
        for i, r in enumerate(self.correlation):
            out[1:, i] = (out[1:, i] - r * out[:-1, i]) / np.sqrt(1 - r * r)
        return out


def start_prior(fitted: Fitted, pieces: Sequence[Piece]) -> StartPrior:
    """From the states and residuals of the fitted runs."""
    asm = Assembly(fitted.form)
    runs = [run_piece(asm, fitted.theta, s, p.d) for s, p in zip(fitted.starts, pieces)]
    x = np.vstack([r.states for r in runs])[:, : asm.chain_states]
    cov = np.cov(x.T).reshape(asm.chain_states, -1)
    cov += np.diag(TINY * np.diag(cov) + 1e-12)
    e = [(p.y - r.y) * p.weight for p, r in zip(pieces, runs)]
    power = sum((x**2).sum(axis=0) for x in e) + 1e-300
    correlation = np.clip(sum((x[1:] * x[:-1]).sum(axis=0) for x in e) / power, 0.0, LONGEST)
    return StartPrior(x.mean(axis=0), cov, fitted.mse, np.atleast_1d(correlation))


def rest(asm: Assembly, theta: Array, y0: Array, d0: Array) -> Array:
    """Whole state of rest at outputs y0 (ny,) and drive d0: no chain moves, as far as its order can hold it."""
    filled = asm.fill(theta)
    mats = filled.mats
    state = np.zeros(asm.chain_states)
    state[asm.first[:-1]] = y0
    x, _ = start_state(asm, filled, state, d0)
    for i, n in enumerate(asm.form.orders):
        f = asm.first[i]

        def off(value: float, x: Array = x, i: int = i, f: int = f) -> float:
            """By how much an output of this value is read as more than it is to be."""
            x[[f, asm.chain_states + i]] = value
            return value + float(mats[6][i] @ d0 + mats[7][i] @ filled.terms(x, d0)) - float(y0[i])

        with warnings.catch_warnings():  # of a map that is flat there
            warnings.simplefilter("ignore", RuntimeWarning)
            found: Any = newton(off, y0[i], maxiter=SECANTS, full_output=True, disp=False)
        off(found[0] if found[1].converged else y0[i] - off(y0[i]))
        w = filled.terms(x, d0)
        for m in range(n - 1):
            x[f + m + 1] = 0.0
            moved = mats[0][f + m] @ x + mats[1][f + m] @ d0 + mats[2][f + m] @ w - x[f + m]
            x[f + m + 1] = -moved / asm.form.paces[i]
    return x


def first_level(piece: Piece, most: int) -> Array:
    """(ny,) output at the start: the mean of the samples over which the drive has not moved yet, at most `most`."""
    still = np.all(piece.d[: max(most, 1)] == piece.d[0], axis=1)
    n = len(still) if still.all() else max(int(np.argmin(still)), 1)
    w = piece.weight[:n]
    return (piece.y[:n] * w).sum(axis=0) / np.maximum(w.sum(axis=0), 1.0)


def free_run(
    asm: Assembly, theta: Array, prior: StartPrior, piece: Piece, window: int, before: Array | None = None,
    carried: bool = False,
) -> Array:  # fmt: skip
    """(N, ny) from the state that the first `window` samples say, NaN where it explodes.

    The state is expected at rest where the drive stands still at first, else anywhere where the training records were;
    of the whole state `before` (where known) the slow states are taken, or all of it where it is `carried`.
    """
    filled = asm.fill(theta)
    if before is not None and carried:
        expected, firm = before, True
    else:
        expected, firm = expected_state(asm, theta, prior, piece, window)
    if before is not None:
        slow = asm.chain_states + len(asm.form.orders)
        expected[slow:] = before[slow:]
    x = _window_state(
        filled,
        asm,
        expected,
        Piece(piece.d[:window], piece.y[:window], piece.weight[:window]),
        prior,
        firm,
    )
    run = filled.run(x, piece.d)
    fine = run.fine and np.abs(run.y).max() < REACH
    return run.y if fine else np.full_like(run.y, np.nan)


def expected_state(
    asm: Assembly, theta: Array, prior: StartPrior, piece: Piece, window: int
) -> tuple[Array, bool]:
    """Whole state before any output is looked at, and whether it is one of rest."""
    filled = asm.fill(theta)
    expected = rest(asm, theta, first_level(piece, window), piece.d[0])
    settled = _settled(asm, filled, expected, piece, prior.mse)
    if settled is None:
        return start_state(asm, filled, prior.mean, piece.d[0])[0], False
    return settled, True


def _settled(asm: Assembly, filled: Filled, x: Array, piece: Piece, mse: float) -> Array | None:
    """Where the model comes to rest if held as the drive stands at first, so that the noise of what was read there is no state, or where
    it began if it never does; None where the drive moves at once, or the model does not stay where the record starts."""
    if not np.all(piece.d[:STILL] == piece.d[0]):
        return None
    long = int(min(SETTLES / min(asm.form.paces), LONG))
    run = filled.run(x, np.tile(piece.d[0], (long, 1)))
    if not (run.fine and np.abs(run.y - run.y[0]).max() < ALIKE * np.sqrt(mse)):
        return None
    rests = np.abs(run.y[-1] - run.y[long // 2]) <= CALM * np.abs(run.y[-1] - run.y[0])
    return run.states[-1].copy() if rests.all() else x


def _window_state(
    filled: Filled, asm: Assembly, expected: Array, window: Piece, prior: StartPrior, firm: bool
) -> Array:
    """Whole state by Gauss-Newton on the window's errors and the distance from the expected one."""
    if not len(window.y):
        return expected
    nx, ny = asm.chain_states, len(asm.form.orders)
    ridge = prior.ridge(firm)
    dx = np.zeros((len(expected), nx))
    dx[:nx] = np.eye(nx)
    dx[nx + np.arange(ny), asm.first[:-1]] = 1.0
    x, best, cost = expected, expected, np.inf
    for _ in range(STEPS):
        y, dy, _, _, fine = filled.moved(x, dx, window.d, *NOTHING)
        if not fine:
            break
        e = prior.whitened(window.y - y, window.weight).ravel()
        off = (x - expected)[:nx]
        now = float(e @ e + off @ ridge @ off)
        if now >= cost * (1 - 1e-6):
            break
        best, cost = x, now
        J = prior.whitened(dy, window.weight).reshape(len(e), nx)
        x = x + dx @ np.linalg.lstsq(J.T @ J + ridge, J.T @ e - ridge @ off, rcond=None)[0]
    return best


def predicted(
    fitted: Fitted, pieces: Sequence[Piece], blocks: Sequence[Block], window: int, carried: bool
) -> dict[Block, Array]:
    """Every block (rows, ny) from a start of its own, about the state `carried` on from the record's run or not.

    Without a window, as where a record begins at rest, nothing else says where a later block starts: the linear model is carried too.
    """
    carried = carried or not window
    asm, prior = Assembly(fitted.form), start_prior(fitted, pieces)
    out = {}
    for b in blocks:
        p = pieces[b.record]
        run = run_piece(asm, fitted.theta, fitted.starts[b.record], p.d)
        before = run.states[b.start].copy() if run.fine else None
        part = Piece(p.d[b.rows], p.y[b.rows], p.weight[b.rows])
        out[b] = free_run(asm, fitted.theta, prior, part, window, before, carried and run.fine)
    return out


def without_each(fitted: Fitted, pieces: Sequence[Piece], blocks: Blocks) -> list[Fitted] | None:
    """The form fitted to the rest of the records, for every block; None if one explodes."""
    folds = [_left_out(fitted, pieces, blocks.training(block)) for block in blocks.blocks]
    fits = [f for f in folds if f is not None]
    return fits if len(fits) == len(folds) else None


def unused(folds: Sequence[Fitted], pieces: Sequence[Piece], blocks: Blocks, carried: bool) -> list[Array]:
    """Per record (N, ny): every block by the form fitted to the others, its state from its window."""
    out = [np.full_like(p.y, np.nan) for p in pieces]
    for block, f in zip(blocks.blocks, folds, strict=True):
        out[block.record][block.rows] = predicted(f, pieces, [block], blocks.window, carried)[block]
    return out


def ahead(fitted: Fitted, pieces: Sequence[Piece], window: int) -> dict[Block, Array] | None:
    """The last part of every record by the form fitted to the first parts: what varies with time shows."""
    ends = [Block(r, int((1 - AHEAD) * len(p.y)), len(p.y)) for r, p in enumerate(pieces)]
    use = [np.arange(len(p.y)) < b.start for p, b in zip(pieces, ends)]
    f = _left_out(fitted, pieces, use)
    return None if f is None else predicted(f, pieces, ends, window, True)


def _left_out(fitted: Fitted, pieces: Sequence[Piece], use: Sequence[Array]) -> Fitted | None:
    kept = [Piece(p.d, p.y, p.weight * u[:, None]) for p, u in zip(pieces, use)]
    return fit(fitted.form, fitted.theta, fitted.starts, kept, iterations=FOLD_ROUNDS, anchor=ANCHOR)
