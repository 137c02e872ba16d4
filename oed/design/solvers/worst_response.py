"""G over a band: exchange on the response's variance, the other way round from the exchange of lines.

    minimise over the spectra   max over w in a band of trace(V(w)' M^-1 V(w))

A finite sample of the band gives a loss that is too small and a bound that holds: its certificate is a measure on the
sample. So the sample is exchanged until the maximum over the whole band, found between its lines, meets that bound. When both
show which lines and which places of the response belong to the optimum, Newton's method finds the last digits of all: of

    sum_k lambda_k f(v_k) / t + sum_j nu_j (sum_i a_i^* Q_j(w_i) a_i - 1),   f(v) = trace(V(v)' M^-1 V(v)),   sum_k lambda_k = 1,

the saddle point, least in the lines' frequencies w_i and amplitudes a_i, greatest in the shares lambda_k and the places v_k.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from oed.covariances import solved_below
from oed.criteria import d_criterion
from oed.design.problem.design import Design
from oed.design.problem.families import Family
from oed.design.problem.lines import Columns, Problem, factor_of, snapped, within_bands
from oed.design.solvers.column_generation import Exchange, exchange
from oed.design.solvers.merging_lines import at_clusters, collapsed, evaluated
from oed.design.solvers.polishing import (
    LARGEST,
    OUTSIDE,
    ROUNDING,
    Point,
    System,
    newton,
)
from oed.errors import SolverFailure

MOST_ROUNDS = 40
"""Exchanges of the sample; the gap falls by an order in two or three of them."""
SPENT = 1e-6
"""Share of the certificate below which a line of the sample leaves it."""
CLOSE = 0.9
"""Local maxima below this share of the largest variance are not worth a line."""
PATIENCE = 2
"""Rounds without a smaller gap after which rounding, not the sample, is what holds it up."""
EARLY = 0.05
"""A round is solved to this share of the gap that the round before left."""
NEARLY = 3e-2
"""Gap below which lines and places show well enough to try Newton's method on them."""
DROPPED = 8
"""Times that lines and places which Newton's method drives to nothing leave."""
LITTLE = 1e-2
"""Share of the largest below which a line or a place may leave."""
BELOW = 1e-7
"""What it is then worth less than the best, relative: one that belongs to the optimum is worth as much."""
AT_END = 1e-9
"""Distance from an end of the response's band, rad/sample, within which a place stays there: the variance rises outwards."""
LINES = (1e-2, SPENT)
"""Shares of the largest power from which on a line is taken for one of the optimum: most are heavy, and what an exchange leaves
beside them leads Newton's method astray."""


class _Best:
    """The least of the largest variances so far, and the best bound; each of its own round."""

    def __init__(self, family: Family) -> None:
        self.family, self.least = family, np.inf
        self.kept: Exchange | None = None
        self.proof: Exchange | None = None

    def taken(self, found: Exchange) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Where the variance of an outcome has its maxima, and what they are."""
        omega, variance = self.family.maxima(_root(found))
        if variance.max() < self.least:
            self.least, self.kept = float(variance.max()), found
        if self.proof is None or _bound(found) > _bound(self.proof):
            self.proof = found
        return omega, variance

    @property
    def gap(self) -> float:
        """Relative."""
        return self.least / _bound(self.proof) - 1 if self.proof is not None else np.inf


def worst_response_design(problem: Problem, family: Family, *, refine: bool, tolerance: float) -> Design:
    """The design for the largest variance over a family; `problem` holds the first sample."""
    from oed.design.assembling import certified

    problem, columns = _started(problem, family, refine)
    best, asked, stalled = _Best(family), 1e-2, 0
    for _ in range(MOST_ROUNDS):
        before = best.gap
        found = exchange(problem, columns=columns, refine=refine, tolerance=asked)
        omega, variance = best.taken(found)
        if refine and tolerance < best.gap < NEARLY:
            for least in LINES:
                try:
                    polished = _polished(found, family, omega, least)
                except np.linalg.LinAlgError:  # lines of so little power are as good as none to doubles
                    continue
                if polished is not None and best.taken(polished) and best.gap <= tolerance:
                    break
        stalled = stalled + 1 if best.gap > 0.9 * before else 0
        if best.gap <= tolerance or stalled == PATIENCE:
            break
        asked = max(0.5 * tolerance, min(asked, EARLY * best.gap))
        sample, new = problem.original.V, family.at(omega[variance > CLOSE * variance.max()])
        parts = np.linalg.norm(found.X.reshape(len(found.X), len(sample), -1), axis=(0, 2))
        sample = np.concatenate([sample[parts**2 > SPENT * np.max(parts) ** 2], new])
        problem = found.problem.for_criterion(replace(problem.original, V=sample))
        columns = found.columns.take(found.w > SPENT * found.w.max())
    if best.proof is None or best.kept is None:  # not reached: every round finds weights and a bound
        raise SolverFailure("the exchange of the response's lines did not begin.")
    found = replace(
        best.proof, columns=best.kept.columns, w=best.kept.w, loss=best.least / best.proof.problem.scale
    )
    return certified(found, tolerance=tolerance, solver="newton")


def _bound(found: Exchange) -> float:
    return found.bound * found.problem.scale


def _polished(found: Exchange, family: Family, omega: NDArray[np.float64], least: float) -> Exchange | None:
    """After Newton's method on the lines' clusters and the maxima of the variance, (K,), that hold it up; None where it fails."""
    from scipy.optimize import nnls

    problem = found.problem
    columns, w = _few(problem, found, least)
    V = scaled_responses(problem, family, omega)
    W = np.linalg.solve(problem.constant + columns.information(w), V)
    # Shares of the places and prices of the budgets with which every line is worth what it costs.
    worth = np.sum(np.einsum("mnr,kns->mkrs", columns.F, W) ** 2, axis=(2, 3)) / np.einsum("kns,kns->k", V, W)
    balance = np.vstack(
        [np.concatenate([worth, -columns.q], axis=1), np.repeat([1.0, 0.0], [len(V), columns.q.shape[1]])]
    )
    shares, nu = np.split(nnls(balance, np.append(np.zeros(len(w)), 1.0))[0], [len(V)])
    hold = shares > SPENT * shares.max()
    if not nu.any() or not hold.any():
        return None
    polished = polish_worst(problem, family, columns, w, nu, omega[hold], shares[hold] / shares[hold].sum())
    if polished is None:
        return None
    V = family.at(polished.places)
    problem = problem.for_criterion(replace(problem.original, V=V))
    M = problem.constant + polished.columns.information(polished.w)
    X = problem.criterion.direction(M, polished.shares)
    return evaluated(replace(found, problem=problem), polished.columns, polished.w, X, polished.nu)


def _few(problem: Problem, found: Exchange, least: float) -> tuple[Columns, NDArray[np.float64]]:
    """One line for each cluster, with the weights whose information is nearest to that of all."""
    from scipy.optimize import nnls

    columns = at_clusters(problem, found.columns, found.w)
    half = np.linalg.cholesky(problem.constant + found.columns.information(found.w))
    turned = np.linalg.solve(half, columns.F)
    atoms = (turned @ turned.swapaxes(1, 2)).reshape(len(columns), -1)
    told = np.linalg.solve(half, factor_of(found.columns.F, found.w))
    w = nnls(atoms.T, (told @ told.T).ravel())[0]
    used = w > least * w.max()
    columns, w = columns.take(used), w[used]
    return columns, w / (columns.q.T @ w).max()


def _started(problem: Problem, family: Family, refine: bool) -> tuple[Problem, Columns]:
    """Lines and sample of the D design, which is the G design where nothing but the power is limited (Kiefer, Wolfowitz)."""
    wanted = problem.original
    found = exchange(problem.for_criterion(d_criterion(wanted.n)), refine=refine, tolerance=1e-6)
    found = collapsed(found, 1e-6) if refine else found
    used = found.w > SPENT * found.w.max()
    omega = np.unique(found.columns.omega[used])
    inside = omega[(omega >= family.grid[0]) & (omega <= family.grid[-1])]
    sample = family.at(np.union1d(inside, family.maxima(_root(found))[0]))
    columns = sample.swapaxes(0, 1).reshape(wanted.n, -1)
    scale = np.maximum(np.linalg.norm(columns, axis=1), 1e-300)
    if np.linalg.matrix_rank(columns / scale[:, None], 1e-6) < wanted.n:
        sample = np.concatenate([sample, wanted.V])
    return found.problem.for_criterion(replace(wanted, V=sample)), found.columns.take(used)


def _root(found: Exchange) -> NDArray[np.float64]:
    """A root of the covariance in the model's own parameters, from the scaled information, which is well conditioned."""
    problem = found.problem
    half = np.linalg.cholesky(problem.constant + found.columns.information(found.w))
    return np.asarray(np.linalg.inv(problem.R.T @ half), dtype=np.float64)


def scaled_responses(problem: Problem, family: Family, omega: NDArray[np.float64]) -> NDArray[np.float64]:
    """V (K, n, s) of a family in the coordinates of a problem; omega (K,)."""
    V = np.swapaxes(family.at(omega), 0, 1)
    below = solved_below(problem.R, V.reshape(len(V), -1), problem.finely)
    return np.swapaxes(below.reshape(V.shape), 0, 1)


@dataclass(frozen=True, eq=False)
class Saddle(Point):
    """With the places of the response (K,), their shares (K,), and the level of the variance in units of what it was at first."""

    places: NDArray[np.float64]
    shares: NDArray[np.float64]
    level: float = 1.0


class _WorstSystem:
    """Unknowns: of the lines, the shares, the places, the multipliers of the budgets, the level."""

    def __init__(
        self, problem: Problem, family: Family, columns: Columns, w: NDArray, nu: NDArray, places: NDArray, shares: NDArray,
    ) -> None:  # fmt: skip
        nothing = np.zeros((columns.F.shape[1], 1))
        self.problem, self.priced = problem, True
        self.inner = System(problem, columns, w, nothing, nu, np.ones(1), solved=True)
        self.family, self.place_unit, K = family, problem.length_scale(places), len(places)
        inside = np.abs(places[:, None] - family.grid[[0, -1]]).min(axis=1) >= AT_END
        self.lines, active = self.inner.strided, self.inner.active
        own = self.inner.free[: self.lines]
        self.free = np.concatenate([own, np.ones(K, bool), inside, active, [True]])
        self.strided = self.lines + 2 * K
        told, V = columns.information(w), self.responses(places)[0]
        W: NDArray[Any] = np.linalg.solve(problem.constant + told, V)
        self.size = float(np.einsum("kns,kns->k", V, W).max())
        share = float(np.einsum("k,kns,nm,kms->", shares, W, told, W)) / self.size
        nu = np.where(active, nu, 0.0)
        at = self.inner.start
        self.start = Saddle(at.omega, at.z, nu * (share / float(nu @ (columns.q.T @ w))), W, places, shares)

    def responses(self, places: NDArray[np.float64]) -> list[NDArray[np.float64]]:
        """V (K, n, s) in the coordinates of the problem, and its two derivatives."""
        return self.inner.expanded(
            lambda omega: scaled_responses(self.problem, self.family, omega), places, self.place_unit
        )

    def symmetries(self, point: Any) -> NDArray[np.float64]:
        """None that count: power has a price."""
        return np.zeros((0, len(point.omega)))

    def moved(self, point: Any, step: NDArray[np.float64]) -> Saddle:
        """The point after a step in all unknowns."""
        K, J = len(point.places), len(point.nu)
        lines, shares, places, nu, level = np.split(step, np.cumsum([self.lines, K, K, J]))
        on = self.inner.moved(point, np.concatenate([lines, nu]))
        return Saddle(
            on.omega, on.z, on.nu, on.X, point.places + places * self.place_unit, point.shares * (1 + shares),
            point.level + float(level[0]),
        )  # fmt: skip

    def conditions(
        self, point: Any, derivatives: bool = True
    ) -> tuple[NDArray[np.float64], NDArray[np.float64] | None]:
        """Residual and Jacobian in the scaled unknowns that are free."""
        K, shares, nu = len(point.places), point.shares, point.nu
        V, V1, V2 = self.responses(point.places)
        root = np.sqrt(shares / self.size)[:, None, None]
        beside = lambda parts: np.swapaxes(parts, 0, 1).reshape(V.shape[1], -1)
        part = self.inner.lines_part(point, lambda M: beside(np.linalg.solve(M, V) * root), derivatives)
        W, W1 = np.linalg.solve(part.M, V), np.linalg.solve(part.M, V1)
        f, f1 = np.einsum("kns,kns->k", V, W) / self.size, 2 * np.einsum("kns,kns->k", V1, W) / self.size
        residual = np.concatenate(
            [part.slope * part.weigh, f - point.level, f1, (part.used - 1) * nu.sum(), [shares.sum() - 1]]
        )[self.free]
        if not derivatives:
            return residual, None
        p, J = len(part.slope), len(nu)
        line, share, place, budget = (
            slice(a, b) for a, b in np.cumsum([0, p, K, K, J])[np.arange(4)[:, None] + [0, 1]]
        )
        H = np.zeros((p + 2 * K + J + 1,) * 2)
        H[line, line] = part.own + self.problem.criterion.second(part.M, part.X, part.turned)
        H[line, budget], H[budget, line] = part.steep.T, part.steep * nu.sum()
        turned = part.turned.reshape(p, V.shape[1], K, -1)
        H[line, share] = -np.einsum("kns,pnks->pk", W * root, turned)
        H[line, place] = -2 * np.einsum("kns,pnks->pk", W1 * root, turned)
        H[share, line], H[place, line] = (
            H[line, share].T / shares[:, None],
            H[line, place].T / shares[:, None],
        )
        k = np.arange(K)
        H[share, place][k, k], H[share, -1] = f1, -1.0
        bend = 2 * (np.einsum("kns,kns->k", V1, W1) + np.einsum("kns,kns->k", V2, W)) / self.size
        H[place, place][k, k] = bend
        H[-1, share] = shares
        H[line] *= part.weigh[:, None]
        return residual, H[np.ix_(self.free, self.free)]


@dataclass(frozen=True, eq=False)
class PolishedWorst:
    """Lines and weights (m,) within the budgets, their multipliers (J,), and the places and shares of the response (K,)."""

    columns: Columns
    w: NDArray[np.float64]
    nu: NDArray[np.float64]
    places: NDArray[np.float64]
    shares: NDArray[np.float64]
    residual: float


def polish_worst(
    problem: Problem, family: Family, columns: Columns, w: NDArray, nu: NDArray, places: NDArray, shares: NDArray,
) -> PolishedWorst | None:  # fmt: skip
    """Newton's method from lines, weights (m,), places and shares (K,) that are nearly right; None where it leads nowhere."""
    low, high = family.grid[[0, -1]]
    try:
        for _ in range(DROPPED):
            columns = snapped(problem, columns)
            system = _WorstSystem(problem, family, columns, w, nu, places, shares)
            if np.count_nonzero(system.free) > LARGEST:
                return None
            point, residual = newton(system)
            if not (point.power > 0).all() or (point.nu < 0).any() or not (point.shares > 0).all():
                return None
            q, w, nu, shares = point.z.shape[1] // 2, point.power, point.nu, point.shares
            omega, places = within_bands(problem, point.omega), np.clip(point.places, low, high)
            columns = problem.columns(omega, (point.z[:, :q] + 1j * point.z[:, q:]) / np.sqrt(w)[:, None])
            w = w / (columns.q.T @ w).max()
            settled = max(np.abs(omega - point.omega).max(), np.abs(places - point.places).max()) < OUTSIDE
            line, place = _leaving(system, point, columns, w)
            if settled and (residual < ROUNDING or (line.all() and place.all())):
                return PolishedWorst(columns, w, nu, places, shares, residual)
            columns, w, places = (
                columns.take(line),
                w[line] / (columns.q[line].T @ w[line]).max(),
                places[place],
            )
            shares = shares[place] / shares[place].sum()
    except np.linalg.LinAlgError:  # the lines that Newton's method led to leave the information singular
        pass
    return None


def _leaving(
    system: _WorstSystem, point: Saddle, columns: Columns, w: NDArray
) -> tuple[NDArray[np.bool_], NDArray[np.bool_]]:
    """Which lines (m,) and places (K,) stay: those go that have little left and are worth less than they cost."""
    V = system.responses(point.places)[0]
    W: NDArray[Any] = np.linalg.solve(system.problem.constant + columns.information(w), V)
    f = np.einsum("kns,kns->k", V, W) / system.size
    X = np.swapaxes(W * np.sqrt(point.shares / system.size)[:, None, None], 0, 1).reshape(V.shape[1], -1)
    price = columns.prices(X, point.nu)
    place = (point.shares > LITTLE * point.shares.max()) | (f >= f.max() * (1 - BELOW))
    return (w > LITTLE * w.max()) | (price >= price.max() * (1 - BELOW)), place
