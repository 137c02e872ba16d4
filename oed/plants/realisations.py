"""State-space realisations of plants, and plants from state-space or python-control systems."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from oed.covariances import square_root
from oed.errors import InputError

if TYPE_CHECKING:
    from oed.plants.plant import Plant

StateSpace = tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]]


def state_space(plant: Plant, *, delays: bool = True) -> StateSpace:
    """State-space realisation of a plant's G: one companion block per entry. Without `delays` those that a
    whole row or column has are left out: no singular value of the response changes. x_(t+1) = A x_t + B u_t,
    y_t = C x_t + D u_t. Entries with a common denominator are realised apart, so the realisation of a plant
    with several entries is in general not minimal (the response is exact)."""
    blocks = _blocks(plant, delays)
    n = sum(block[2] for block in blocks)
    A, B = np.zeros((n, n)), np.zeros((n, plant.n_inputs))
    C, D = np.zeros((plant.n_outputs, n)), np.zeros((plant.n_outputs, plant.n_inputs))
    at = 0
    for i, j, order, b, a in blocks:
        D[i, j] = b[0]
        if order:
            rows = slice(at, at + order)
            A[at, rows] = -a[1:]
            A[at + 1 : at + order, at : at + order - 1] = np.eye(order - 1)
            B[at, j] = 1
            C[i, rows] = b[1:] - b[0] * a[1:]
            at += order
    return A, B, C, D


def n_states(plant: Plant, *, delays: bool = True) -> int:
    """The states of `state_space`, whose matrices may be too large to be made."""
    return sum(block[2] for block in _blocks(plant, delays))


def _blocks(plant: Plant, delays: bool) -> list[tuple[int, int, int, NDArray, NDArray]]:
    """Row, column, order, numerator and denominator of each entry."""
    blocks = []
    padded = lambda p, order: np.pad(p, (0, order + 1 - len(p)))
    left_out = np.zeros((plant.n_outputs, plant.n_inputs), int) if delays else _common_delays(plant)
    for i, row in enumerate(plant.num):
        for j, entry in enumerate(row):
            num = entry[left_out[i, j] :] if np.any(entry) else entry[:1]
            order = max(len(num), len(plant.den[i][j])) - 1
            blocks.append((i, j, order, padded(num, order), padded(plant.den[i][j], order)))
    return blocks


def _common_delays(plant: Plant) -> NDArray[np.int64]:
    """(ny, nu): the delay of each row, and what its columns then have in common."""
    most = max(len(entry) for row in plant.num for entry in row)
    delay = lambda entry: np.flatnonzero(entry)[0] if np.any(entry) else most
    first = np.array([[delay(entry) for entry in row] for row in plant.num])
    rows = first.min(axis=1, keepdims=True)
    return np.where(first < most, rows + (first - rows).min(axis=0, keepdims=True), 0)


def entries_of_state_space(
    A: ArrayLike, B: ArrayLike, C: ArrayLike, D: ArrayLike | None = None
) -> dict[str, Any]:
    """num and den of a discrete-time state-space system (n, n), (n, nu), (ny, n), (ny, nu): each entry of `Plant` minimal."""
    try:
        A, B, C = (np.atleast_2d(np.array(m, dtype=float)) for m in (A, B, C))
        D = np.zeros((len(C), B.shape[1])) if D is None else np.atleast_2d(np.array(D, dtype=float))
    except (TypeError, ValueError):
        raise InputError("A, B, C and D must be real matrices, each row of equal length.") from None
    n, nu, ny = len(A), B.shape[1], len(C)
    if A.shape != (n, n) or B.shape != (n, nu) or C.shape != (ny, n) or D.shape != (ny, nu):
        raise InputError(
            f"A is {A.shape}, B {B.shape}, C {C.shape}, D {D.shape}; they must be (n, n), (n, nu), (ny, n), (ny, nu)."
        )
    if not all(np.isfinite(m).all() for m in (A, B, C, D)):
        raise InputError("A, B, C or D has entries that are not finite; give finite numbers.")
    num, den = [], []
    for i in range(ny):
        try:
            with np.errstate(over="raise", invalid="raise", divide="raise"):
                entries = [_minimal_entry(A, B[:, j], C[i], D[i, j]) for j in range(nu)]
        except (FloatingPointError, np.linalg.LinAlgError):
            raise InputError(
                f"A, B, C, D have entries of up to {max(np.abs(m).max(initial=0) for m in (A, B, C, D)):.3g}: their products "
                "are not finite; scale the signals, or give num and den."
            ) from None
        num.append([entry[0] for entry in entries])
        den.append([entry[1] for entry in entries])
    return {"num": num, "den": den}


def _minimal_entry(A: NDArray, b: NDArray, c: NDArray, d: float) -> tuple[NDArray, NDArray]:
    """Numerator and denominator in z^-1 of one entry, with cancelling poles and zeros removed."""
    poles = np.linalg.eigvals(A)
    g = [d]
    x = b
    for _ in range(2 * len(A)):
        g.append(float(c @ x))
        x = A @ x
    # Poles that this entry does not see are dropped by the rank of its Hankel matrix; those kept are the
    # ones whose modes carry weight.
    n = len(A)
    hankel = np.array([[g[1 + r + s] for s in range(n)] for r in range(n)])
    singular = np.linalg.svd(hankel, compute_uv=False)
    order = int((singular > 1e-10 * max(singular[0], 1e-300)).sum()) if n else 0
    if order < n:
        poles = _poles_seen(A, b, c, order)
    a = np.real(np.poly(poles)) if order else np.ones(1)
    num = np.convolve(a, g)[: order + 1]
    num[np.abs(num) < 1e-13 * max(np.abs(num).max(), 1e-300)] = 0.0
    return num, a


def _poles_seen(A: NDArray, b: NDArray, c: NDArray, order: int) -> NDArray:
    """Poles of the balanced truncation to the minimal order (exact, since what is cut is zero)."""
    from scipy.linalg import solve_discrete_lyapunov, svd

    if np.abs(np.linalg.eigvals(A)).max(initial=0) >= 1:
        return np.linalg.eigvals(A)  # unstable: kept whole, so that the check of the plant can say so
    reached, seen = solve_discrete_lyapunov(A, np.outer(b, b)), solve_discrete_lyapunov(A.T, np.outer(c, c))
    R, L = square_root((reached + reached.T) / 2), square_root((seen + seen.T) / 2)
    U, s, V = svd(L.T @ R)
    U, V, scale = U[:, :order], V[:order].T, 1 / np.sqrt(s[:order])
    return np.linalg.eigvals((scale[:, None] * U.T) @ L.T @ A @ R @ (V * scale))


def entries_of_control(system: Any, dt: float | None = None, hold: str | None = None) -> dict[str, Any]:
    """num, den and dt of a python-control system, sampled first where it is in continuous time."""
    import control

    if not isinstance(system, control.StateSpace | control.TransferFunction):
        raise InputError(
            f"a {type(system).__name__} is not a control.StateSpace or control.TransferFunction; convert it first."
        )
    if system.isctime(strict=True) or (system.dt is None and dt is not None):
        if dt is None or hold is None:
            raise InputError(
                "the system is in continuous time; sample it first, for example "
                'oed.Plant.from_control(system, dt=0.01, hold="zoh").'
            )
        system = control.sample_system(system, dt, method=hold)
    elif dt is not None:
        raise InputError(
            f"the system is already sampled (dt = {system.dt}); leave dt = {dt} out, or resample it."
        )
    step = 1.0 if system.dt in (True, None) else float(system.dt)
    if isinstance(system, control.StateSpace):
        return entries_of_state_space(system.A, system.B, system.C, system.D) | {"dt": step}
    num, den = [], []
    for Bs, As in zip(system.num_list, system.den_list, strict=True):
        num.append([])
        den.append([])
        for B, A in zip(Bs, As, strict=True):
            B, A = np.trim_zeros(np.array(B), "f"), np.trim_zeros(np.array(A), "f")
            if len(B) > len(A):
                raise InputError(
                    f"an entry has numerator degree {len(B) - 1} over denominator degree {len(A) - 1}, which is "
                    "improper (it knows the future); the numerator's degree must not exceed the denominator's."
                )
            # Powers of z written out as zeros at the end are delay, not parameters whose value happens to be 0.
            num[-1].append(np.trim_zeros(np.concatenate([np.zeros(len(A) - len(B)), B]), "b"))
            den[-1].append(np.trim_zeros(A, "b"))
            if not num[-1][-1].size:
                num[-1][-1] = np.zeros(1)
    return {"num": num, "den": den, "dt": step}
