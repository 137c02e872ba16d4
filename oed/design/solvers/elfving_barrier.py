"""c and D_s designs, and A designs of few combinations, by a barrier method on Elfving's dual: all directions of a frequency at once.

    maximise log numerator(X) - tr(X' M_0 X) - sum_j nu_j   over X (n, s) and nu >= 0
    subject to Q_nu(w) - S_X(w) positive semidefinite at every frequency,  S_X = D^* X X' D,

and for a determinant to V'X symmetric and positive, as X X' does not see a turn. -log det(Q_nu - S_X) is self-concordant in (X, nu)
(a Schur complement of what is linear in them), so Newton's method follows the path of mu; there P_k = mu (Q_nu - S_X)^-1 is an
admissible spectrum with (M_0 + M(P)) X = half the numerator's slope, exact where the optimal information is singular. One rank-one
line at a time would have to find these directions one by one."""

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import block_diag

from oed.covariances import real_gram
from oed.criteria.determinant import Determinant
from oed.criteria.trace import Trace
from oed.design.problem.lines import Columns, Problem
from oed.design.solvers.column_generation import Exchange, better, evaluated_bound, lower_bound
from oed.errors import SolverFailure, Status

LARGEST = 150
PATIENCE = 4
ROUNDED = (
    "rounding ended the path of the design's dual: what the parameters make of the output differs by more digits than doubles have; "
    "give a plant of lower order, or poles farther from the circle."
)
LEFT = 0.3
"""Least share of the slack that a step leaves in every direction: nearer the boundary a way back doubles it once a step."""


def applies(problem: Problem) -> bool:
    """Whether this method is the one for a problem."""
    criterion = problem.criterion
    if not isinstance(criterion, Trace | Determinant):
        return False
    n, s = criterion.columns.shape
    if s == n or n * s > LARGEST:
        return False
    return bool(np.linalg.eigvalsh(problem.forms.sum(axis=1))[:, 0].min() > 1e-9)


class _Dual:
    """The dual on some frequencies."""

    def __init__(self, problem: Problem, omega: NDArray[np.float64]) -> None:
        self.criterion, self.constant = problem.criterion, problem.constant
        self.V = problem.criterion.columns
        self.omega = omega
        self.D, self.Q = problem.scaled_factor(omega), problem.forms_at(omega)
        # (K, n, r, q) -> rows of one frequency: D_i as r x q.
        self.n, self.s, self.J = *self.V.shape, self.Q.shape[1]
        self.size = self.Q.shape[-1] * len(omega) + self.J
        self.basis = _symmetric(self.V) if isinstance(self.criterion, Determinant) else np.eye(self.V.size)

    def slack(self, X: NDArray, nu: NDArray) -> tuple[NDArray, NDArray]:
        """Q_nu - S_X (K, q, q) and E = X'D (K, s, r, q)."""
        E = np.einsum("ns,knrq->ksrq", X, self.D, optimize=True)
        flat = E.reshape(len(E), -1, E.shape[-1])
        return np.einsum("j,kjqp->kqp", nu, self.Q) - flat.conj().swapaxes(1, 2) @ flat, E

    def barrier(self, X: NDArray, nu: NDArray, mu: float, root: NDArray | None = None) -> float:
        """The barrier function; infinite outside, and where little is left of the slack whose inverse is root^* root."""
        if nu.min() <= 0:
            return np.inf
        H = self.slack(X, nu)[0]
        try:
            L = np.linalg.cholesky(H)
            if root is not None:
                np.linalg.cholesky(root @ H @ root.conj().swapaxes(1, 2) - LEFT * np.eye(H.shape[-1]))
        except np.linalg.LinAlgError:
            return np.inf
        W = self.V.T @ X
        sizes = np.linalg.eigvalsh(W) if isinstance(self.criterion, Determinant) else np.array([np.trace(W)])
        if sizes.min() <= 0:
            return np.inf
        logdet = 2 * float(np.log(np.einsum("kqq->kq", L).real).sum()) + float(np.log(nu).sum())
        return float(self._cost(X, nu) - 2 * np.log(sizes).mean()) / mu - logdet

    def _cost(self, X: NDArray, nu: NDArray) -> float:
        return float(nu.sum() + np.sum(X * (self.constant @ X)))

    def along_the_ray(self, X: NDArray, nu: NDArray, mu: float) -> tuple[NDArray, NDArray]:
        """The best of t X, t^2 nu, all of them as far from the boundary: Newton's steps, which are straight, need hundreds for it."""
        t2 = (1 + mu * self.size) / self._cost(X, nu)
        return np.sqrt(t2) * X, t2 * nu

    def newton(self, X: NDArray, nu: NDArray, mu: float) -> tuple[NDArray, NDArray, float, NDArray]:
        """Newton's step in X and nu, the square of its length, and the root of the slack's inverse."""
        H, E = self.slack(X, nu)
        root = np.linalg.inv(np.linalg.cholesky(H))  # T = root^* root
        half = self.D @ root.conj().swapaxes(1, 2)[:, None]  # D_i T^1/2, (K, n, r, q)
        Eh = E @ root.conj().swapaxes(1, 2)[:, None]
        # T^1/2 (D_i^* E_s + E_s^* D_i) T^1/2, (K, n, s, q, q); and minus the forms for nu.
        cross = np.einsum("knrq,ksrp->knsqp", half.conj(), Eh, optimize=True)
        cross = cross + cross.conj().swapaxes(-1, -2)
        K, q = len(H), H.shape[-1]
        forms = root[:, None] @ self.Q @ root.conj().swapaxes(1, 2)[:, None]
        A = np.concatenate([cross.reshape(K, -1, q, q), -forms], axis=1)
        hessian = real_gram(np.moveaxis(A, 1, 0).reshape(A.shape[1], -1))
        own = 2 * real_gram(np.moveaxis(half, 1, 0).reshape(self.n, -1)) + 2 * self.constant / mu
        m = self.n * self.s
        hessian[:m, :m] += np.kron(own, np.eye(self.s))
        hessian[m:, m:] += np.diag(1 / nu**2)
        gradient = np.einsum("kiqq->i", A).real
        rise, bend = self.criterion.log_derivatives(X)
        hessian[:m, :m] -= bend / mu
        gradient[:m] -= (rise - 2 * self.constant @ X).ravel() / mu
        gradient[m:] += 1 / mu - 1 / nu
        whole = block_diag(self.basis, np.eye(self.J))
        hessian, gradient = whole @ hessian @ whole.T, whole @ gradient
        scale = 1 / np.sqrt(np.diag(hessian))
        try:
            step = -scale * np.linalg.solve(hessian * np.outer(scale, scale), scale * gradient)
        except np.linalg.LinAlgError:
            # a direction that no frequency tells anything of: the shortest step leaves it
            step = -scale * np.linalg.lstsq(hessian * np.outer(scale, scale), scale * gradient, rcond=None)[0]
        length, step = float(-gradient @ step), step @ whole
        return step[:m].reshape(self.n, self.s), step[m:], length, root

    def follow(self, X: NDArray, nu: NDArray, mu: float, final: float) -> tuple[NDArray, NDArray, float, int]:
        """From a strictly feasible point along the path to the last mu."""
        steps = 0
        while True:
            for _ in range(40):
                steps += 1
                X, nu = self.along_the_ray(X, nu, mu)
                dX, dnu, length, root = self.newton(X, nu, mu)
                if not np.isfinite(length) or length < 1e-12:
                    break
                now, factor = self.barrier(X, nu, mu), 1.0
                if length > 0.05:
                    while factor > 1e-10 and not (
                        self.barrier(X + factor * dX, nu + factor * dnu, mu, root)
                        <= now - 0.1 * factor * length
                    ):
                        factor *= 0.6
                elif not np.isfinite(self.barrier(X + dX, nu + dnu, mu)):
                    break
                if factor <= 1e-10:
                    break
                X, nu = X + factor * dX, nu + factor * dnu
                if length < 1e-3:
                    break
            if mu <= final:
                return X, nu, mu, steps
            mu = max(mu / 20, final)

    def powers(self, X: NDArray, nu: NDArray, mu: float) -> NDArray[np.complex128]:
        """The spectrum that belongs to a point of the path, (K, q, q)."""
        return np.asarray(mu * np.linalg.inv(self.slack(X, nu)[0]), dtype=np.complex128)


def _symmetric(V: NDArray) -> NDArray[np.float64]:
    """Basis (m, n s) of the X with V'X symmetric, for orthonormal V (n, s)."""
    s = V.shape[1]
    beside = np.linalg.qr(V, mode="complete")[0][:, s:]
    unit = np.eye(s)
    turns = [
        V @ (np.outer(unit[a], unit[b]) + np.outer(unit[b], unit[a])) for a in range(s) for b in range(a + 1)
    ]
    return np.stack([X.ravel() for X in [*turns, *(np.outer(z, e) for z in beside.T for e in unit)]])


def direction_exchange(problem: Problem, *, refine: bool, tolerance: float, max_rounds: int = 25) -> Exchange:
    """Frequencies are added where the price is high; their directions come by themselves."""
    grid, n = problem.omega, problem.map.n
    white = np.cumsum(np.einsum("ncKrq->K", problem.grid**2))
    count = 2 * n + 10
    at = np.searchsorted(white, (np.arange(count) + 0.5) / count * white[-1])
    chosen = np.unique(np.concatenate([at, np.linspace(0, len(grid) - 1, 40).astype(int)]))
    spread = grid[np.clip(chosen, 0, len(grid) - 1)]
    dual = _Dual(problem, spread)
    nu, mu = np.full(dual.J, 1.0 / dual.J), 1.0
    X = dual.V / np.sqrt(2 * problem.prices_at(spread, dual.V, nu).ratio.max())
    best: Exchange | None = None
    accuracy, stalled, status = 1e-2, 0, Status.MAX_ITERATIONS
    for rounds in range(1, max_rounds + 1):
        try:
            X, nu, mu, _ = dual.follow(X, nu, mu, accuracy / dual.size)
        except np.linalg.LinAlgError as error:  # rounding has put a point of the path on the cone's boundary
            if best is None:
                raise SolverFailure(ROUNDED) from error
            status = Status.INACCURATE
            break
        columns, w = _lines(problem, dual, X, nu, mu)
        loss = problem.loss(columns, w)
        prices = problem.prices(X, nu)
        if refine:
            where, peaks = problem.refined_maxima(prices, X, nu, 0.9, divisions=7)
            ratio = peaks.ratio
        else:
            where, ratio = grid, prices.ratio
        price = max(float(ratio.max(initial=0.0)), float(prices.ratio.max()))
        bound = lower_bound(problem, X, nu, price)
        here = Exchange(columns, w, loss, X, nu * price, bound, price, float("nan"), rounds, status, problem)
        before = np.inf if best is None else best.gap
        best = here if best is None else better(best, here)
        gap = best.gap
        stalled = 0 if gap < 0.8 * before else stalled + 1
        if gap <= tolerance or stalled >= PATIENCE:
            status = Status.CONVERGED if gap <= tolerance else Status.INACCURATE
            break
        accuracy = max(min(accuracy, 0.1 * gap), 0.05 * tolerance)
        new = where[ratio > 1 + 0.1 * tolerance]
        new = new[np.argsort(-ratio[ratio > 1 + 0.1 * tolerance])][:40]
        own = problem.prices_at(dual.omega, X, nu).ratio
        if refine and len(new):
            problem = problem.extended(new)
        # The first ones stay: on the few of a singular optimum X is unbounded where none of them looks, and the search begins anew.
        dual = _Dual(problem, np.unique(np.concatenate([spread, dual.omega[own > 0.5], new])))
        # Strictly feasible for the new frequencies too.
        X = X * np.sqrt(0.9 / max(price, 1.0))
        mu = 10 * mu
    if best is None:  # not reached: the first round sets it
        raise SolverFailure("no round was run; allow at least one.")
    bound, price, frequency = evaluated_bound(problem, best.X, best.nu, refine=refine)
    return replace(
        best, bound=bound, nu=best.nu * price, price=best.price * price, frequency=frequency, rounds=rounds,
        status=status, problem=problem,
    )  # fmt: skip


def _lines(
    problem: Problem, dual: _Dual, X: NDArray, nu: NDArray, mu: float
) -> tuple[Columns, NDArray[np.float64]]:
    """The spectrum of a point of the path, as lines of one direction each, within the budgets."""
    P = dual.powers(X, nu, mu)
    edge = (dual.omega < 1e-12) | (dual.omega > np.pi - 1e-12)
    P = np.where(edge[:, None, None], P.real, P)
    values, vectors = np.linalg.eigh(P)
    keep = values > 1e-13 * values.max()
    k, j = np.nonzero(keep)
    columns = problem.columns(dual.omega[k], vectors[k, :, j])
    w = values[k, j]
    return columns, w / (columns.q.T @ w).max()
