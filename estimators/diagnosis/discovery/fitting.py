"""Fits of a form by simulation error: Levenberg-Marquardt with exact sensitivities, states of every record with it."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from estimators.diagnosis.discovery.form import Assembly, Filled, Form, Run

Array = NDArray[Any]
REACH = 10.0  # standard deviations of the training output that no free run may leave
DISTURBED = 0.3  # of a state's standard deviation, by which it is disturbed
FORGETS = 40.0  # time constants over which that is followed
GROWTH, NOTICED = (
    1.5,
    0.02,
)  # how much more of it may be seen in the end than at first; an integrator keeps all of it
DAMPING, LOWEST, HIGHEST = 1e-2, 1e-9, 1e8  # of the Levenberg-Marquardt steps


@dataclass(frozen=True, eq=False)
class Piece:
    """One record as discovery sees it, centred and scaled: d (N, 1 + 2 nu) drive, y (N, ny), weight (N, ny) 0 or 1."""

    d: Array
    y: Array
    weight: Array


@dataclass(frozen=True, eq=False)
class Fitted:
    """A fitted form: theta, the start states per record, squared error, residuals and Jacobian (both weighted)."""

    form: Form
    theta: Array
    starts: tuple[Array, ...]
    sse: float
    count: int
    outputs: tuple[Array, ...]

    @property
    def free(self) -> int:
        """Number of parameters without the start states."""
        return len(self.theta)

    @property
    def mse(self) -> float:
        """Mean square of the simulation error."""
        return self.sse / max(self.count, 1)


def start_state(asm: Assembly, filled: Filled, chain_state: Array, d0: Array) -> tuple[Array, Array]:
    """Whole state of a chain state (output before as now, slow states settled) and its derivative (n, chain states)."""
    nx, ny = asm.chain_states, len(asm.form.orders)
    n = asm.shapes[0][0]
    x, dx = np.zeros(n), np.zeros((n, nx))
    x[:nx] = chain_state
    dx[:nx] = np.eye(nx)
    for i in range(ny):
        x[nx + i] = chain_state[asm.first[i]]
        dx[nx + i, asm.first[i]] = 1.0
    for t, row in asm.slow_rows.items():  # a slow state reads none but those before it
        x[row] = filled.terms(x, d0)[t]
    return x, dx


def run_piece(asm: Assembly, theta: Array, state: Array, d: Array) -> Run:
    """From a chain state."""
    filled = asm.fill(theta)
    return filled.run(start_state(asm, filled, state, d[0])[0], d)


def sensitivities(asm: Assembly, theta: Array, state: Array, d: Array) -> Run:
    """`run_piece` with the derivatives (N, ny, P + chain states) of the outputs."""
    filled = asm.fill(theta)
    x, dx = start_state(asm, filled, state, d[0])
    start = np.zeros((len(x), len(theta) + dx.shape[1]))
    start[:, len(theta) :] = dx
    return filled.sensitivities(x, start, d)


def forgets(f: Fitted, pieces: Sequence[Piece]) -> bool:
    """Whether runs from disturbed states stay beside the fitted one, and slow states follow what drives them: an unstable mode that
    only this start hides is refused."""
    asm = Assembly(f.form)
    rates = [
        t.rate * f.theta[block.stop - 1] for t, block in zip(f.form.terms, f.form.blocks) if t.slot == "slow"
    ]
    if not all(0.0 < rate <= 1.0 for rate in rates):
        return False
    filled = asm.fill(f.theta)
    nx = asm.chain_states
    piece = max(pieces, key=lambda q: len(q.y))
    base = run_piece(asm, f.theta, f.starts[[q is piece for q in pieces].index(True)], piece.d)
    if not base.fine or np.abs(base.y).max() > REACH:
        return False
    size, axes = np.linalg.eigh(np.atleast_2d(np.cov(base.states[:, :nx].T)))
    long = int(min(FORGETS / min(f.form.paces), len(piece.y) // 2))
    for at in (0, len(piece.y) // 2 - 1):
        for k in range(nx):
            x = base.states[at].copy()
            x[:nx] += DISTURBED * np.sqrt(max(size[k], 0.0)) * axes[:, k]
            run = filled.run(x, piece.d[at : at + long])
            off = np.abs(run.y - base.y[at : at + long]).max(axis=1)
            early = off[: max(long // 5, 1)].max()
            if not run.fine or off[-(long // 5) :].max() > GROWTH * early + NOTICED:
                return False
    return True


def normal_equations(
    asm: Assembly, theta: Array, states: Sequence[Array], pieces: Sequence[Piece]
) -> tuple[Array, Array] | None:
    """J'J and J'e over all records (parameters, then the start of each), None where a derivative explodes."""
    p, nx = len(theta), asm.chain_states
    size = p + nx * len(pieces)
    H, g = np.zeros((size, size)), np.zeros(size)
    for r, (piece, state) in enumerate(zip(pieces, states)):
        got = sensitivities(asm, theta, state, piece.d)
        e = ((piece.y - got.y) * piece.weight).ravel()
        J = (got.dy * piece.weight[:, :, None]).reshape(len(e), -1)
        where = np.concatenate([np.arange(p), p + nx * r + np.arange(nx)])
        H[np.ix_(where, where)] += J.T @ J  # pyright: ignore[reportCallIssue]
        g[where] += J.T @ e
    return (H, g) if np.isfinite(H).all() else None


def fit(
    form: Form,
    theta: Array,
    states: Sequence[Array],
    pieces: Sequence[Piece],
    *,
    iterations: int = 20,
    tolerance: float = 1e-4,
    anchor: float = 0.0,
) -> Fitted | None:
    """Least simulation error from theta and start states on; None where already the start explodes.

    `anchor` is the weight that holds the start states where they were.
    """
    asm = Assembly(form)
    p, nx = len(theta), asm.chain_states
    point = np.concatenate([theta, *states]) if len(states) else theta.copy()
    split = lambda v: (v[:p], [v[p + nx * r : p + nx * (r + 1)] for r in range(len(pieces))])
    first = point

    def strayed(at: Array) -> Array:
        return np.where(np.arange(len(at)) >= p, at - first, 0.0) if anchor else np.zeros(len(at))

    def cost(at: Array) -> float:
        theta, states = split(at)
        runs = [run_piece(asm, theta, s, q.d) for s, q in zip(states, pieces)]
        if not all(r.fine for r in runs):
            return np.inf
        off = strayed(at)
        return sum(
            float(np.sum(((q.y - r.y) * q.weight) ** 2)) for r, q in zip(runs, pieces)
        ) + anchor * float(off @ off)

    def equations(at: Array) -> tuple[Array, Array] | None:
        found = normal_equations(asm, *split(at), pieces)
        if found is None or not anchor:
            return found
        H, g = found
        H[range(p, len(at)), range(p, len(at))] += anchor
        return H, g - anchor * strayed(at)

    with np.errstate(over="ignore", invalid="ignore"):
        sse = cost(point)
        here = equations(point) if np.isfinite(sse) else None
        if here is None:
            return None
        damping = DAMPING
        for k in range(iterations):
            H, g = here
            scale = np.sqrt(np.maximum(np.diag(H), 1e-12 * np.diag(H).max(initial=1e-300)))
            Hs, gs = H / np.outer(scale, scale), g / scale
            there = None
            while damping < HIGHEST:
                trial = point + np.linalg.lstsq(Hs + damping * np.eye(len(Hs)), gs, rcond=None)[0] / scale
                less = cost(trial)
                ended = less < sse and (sse - less < tolerance * sse or k == iterations - 1)
                there = equations(trial) if less < sse and not ended else None
                if ended or there is not None:
                    break
                damping *= 6.0
            else:
                break
            point, sse = trial, less
            if there is None:
                break
            damping, here = max(damping / 8.0, LOWEST), there
    theta, states = split(point)
    outputs = tuple(run_piece(asm, theta, s, q.d).y for s, q in zip(states, pieces))
    count = int(sum(q.weight.sum() for q in pieces))
    return Fitted(form, theta, tuple(states), sse, count, outputs)
