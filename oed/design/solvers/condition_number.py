"""Modified E: the least condition number of the information matrix, with its certificate.

    minimise lambda_max(M) / lambda_min(M) over the spectra of a given power

With M homogenised by tau it is one semidefinite programme: maximise t subject to t I <= M(w, tau) <= I. For any
positive semidefinite Z_1 and Z_2 and every admissible M

    lambda_max(M) / lambda_min(M) >= (tr Z_2 M / tr Z_2) / (tr Z_1 M / tr Z_1),

so that k is a lower bound as soon as tr[(Z_2 / tr Z_2 - k Z_1 / tr Z_1) M] >= 0 for every admissible M: with
S_i(w) = D(w)^* Z_i D(w), traces 1 and the power P,

    tr[(Z_2 - k Z_1) M_0] + P min(0, least eigenvalue over all w of S_2(w) - k S_1(w)) >= 0."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from oed.design.assembling import TRIFLES, UNTOLD, assembled, spectrum_of_lines
from oed.design.problem.certificate import Certificate
from oed.design.problem.design import Design
from oed.design.problem.families import local_maxima, maxima_between
from oed.design.problem.grid import denser, within
from oed.design.problem.lines import Problem, factor_of, moved_by_rounding
from oed.design.solvers.merging_lines import at_clusters
from oed.design.solvers.polishing import polish
from oed.design.solvers.weights_clarabel import linear_matrix_programme, smat, svec
from oed.errors import NotIdentifiable

Bands = tuple[tuple[float, float], ...]
LOOKED_AT = 3
"""Certificates that are evaluated anew at the end, on the grid as it has grown: the last that were the best."""
LIFT = 1e-6
"""Most that a certificate is lifted by: more is not rounding but a line that is missing."""
OVER = 1e-9
"""Excess over a line's own price for the least eigenvalue from which on it comes in: of the greatest price of all lines it may be
a hundred times less and still hold up the bound."""
NEARLY = 1e-2
"""Gap below which the support shows well enough to try Newton's method on it."""
SPENT = 1e-5
"""Share of a multiplier's largest eigenvalue below which the others are what an interior point leaves of zero."""
PATIENCE = 2
"""Rounds that gain no fifth of the gap after which rounding of the programme holds it up."""
IDLE = 1e-12
"""Share of the most that a line tells below which another leaves: of the power it may be a billionth and still count."""
SAME = 1e-11
"""Relative difference below which fewer lines have the same information."""
WIDEST = 0.3
"""Distance over which a plant without resonances changes, rad/sample."""
BESIDE = 300
"""Points on either side of a resonance in the last look at a certificate: 3 % of the distance apart."""
HIGHEST = 60
"""Maxima that are looked at between the lines: the others are ripples of rounding, hundreds of them."""
REFINED = 6
"""Times that a bound is looked at between the lines, each time at the last one."""
ALIKE = 1e-9
"""Relative change of a bound at which it is the last."""
EVENLY = 4001
"""Points of the whole band in that look."""


@dataclass(frozen=True, eq=False)
class _Lines:
    """Lines of unit power: D v, in the units of the criterion, real and imaginary parts side by side."""

    omega: NDArray[np.float64]
    direction: NDArray[np.complex128]
    F: NDArray[np.float64]

    def __add__(self, other: _Lines) -> _Lines:
        pair = lambda name: np.concatenate([getattr(self, name), getattr(other, name)])
        return _Lines(pair("omega"), pair("direction"), pair("F"))


class _Setting:
    """The problem in the criterion's units, with a grid that grows."""

    def __init__(self, problem: Problem) -> None:
        self.problem, self.map, self.power = problem, problem.map, problem.budgets[0].limit
        self.turn = np.linalg.inv(problem.original.V)
        self.constant = self.turn @ self.map.constant @ self.turn.T

    def factor(self, omega: NDArray) -> NDArray[np.complex128]:
        return np.einsum("ij,kjrq->kirq", self.turn, self.map.factor(omega))

    def lines(self, omega: NDArray, direction: NDArray) -> _Lines:
        G = np.einsum("knrq,kq->knr", self.factor(omega), direction)
        return _Lines(omega, direction, np.concatenate([G.real, G.imag], axis=2))

    def told(self, lines: _Lines, w: NDArray) -> NDArray[np.float64]:
        flat = factor_of(lines.F, w)
        return flat @ flat.T

    def loss(self, lines: _Lines, w: NDArray) -> float:
        """From the factor, whose singular values have twice the digits of the information's eigenvalues."""
        flat = factor_of(lines.F, w, self.constant)
        values = np.linalg.svd(flat, compute_uv=False)
        return float(values[0] / values[-1]) ** 2 if len(values) == len(flat) and values[-1] > 0 else np.inf

    def rounding(self, lines: _Lines, w: NDArray) -> float:
        """How far rounding alone moves the loss, relative."""
        again = lambda omega: self.loss(self.lines(omega, lines.direction), w)
        return moved_by_rounding(self.loss(lines, w), again, lines.omega)

    def forms(self, omega: NDArray, Z: NDArray) -> NDArray[np.complex128]:
        D = self.factor(omega)
        return np.einsum("knrq,nm,kmrs->kqs", D.conj(), Z, D, optimize=True)

    def excess(self, omega: NDArray, Z_low: NDArray, Z_high: NDArray, k: float) -> tuple[NDArray, NDArray]:
        """Largest eigenvalue of k S_1 - S_2 and its direction."""
        S = k * self.forms(omega, Z_low) - self.forms(omega, Z_high)
        values, vectors = np.linalg.eigh((S + S.conj().swapaxes(1, 2)) / 2)
        return values[:, -1], vectors[:, :, -1]

    def surplus(self, Z_low: NDArray, Z_high: NDArray, k: float) -> float:
        return float(np.sum((Z_high - k * Z_low) * self.constant))


def condition_design(
    problem: Problem, *, refine: bool = True, tolerance: float = 1e-7, max_rounds: int = 12
) -> Design:
    """The spectrum with the least condition number; `solve_design` calls it for the criterion modified-E."""
    setting, omega, bands = _Setting(problem), problem.omega, problem.bands
    q = setting.map.n_inputs
    lines = setting.lines(np.repeat(omega, q), np.tile(np.eye(q, dtype=complex), (len(omega), 1)))
    best_loss, best_bound, kept, proof, rounds = np.inf, 0.0, None, None, 0
    reference, stalled = np.inf, 0
    proofs: list[tuple[NDArray, NDArray]] = []
    while rounds < max_rounds:
        rounds += 1
        found = _weights(lines, setting)
        tries = [(lines, *found)]
        loss, tried = np.inf, 0
        while tries:
            own, w, Z_low, Z_high = tries.pop()
            loss = setting.loss(own, w)
            if loss < best_loss:
                best_loss, kept = loss, (own, w)
            Z_high = _lifted(setting, omega, Z_low, Z_high, loss)
            bound, omega = _bound(setting, omega, bands, Z_low, Z_high, loss, refine)
            if bound > best_bound:
                best_bound, proof = bound, (Z_low, Z_high)
                proofs.append(proof)
            tried += 1
            if refine and tried == 1 and tolerance < best_loss / max(best_bound, 1e-300) - 1 < NEARLY:
                tries = _polished(setting, *_sparse(setting, own, w), Z_low, Z_high)
        gap = best_loss / max(best_bound, 1e-300) - 1
        reference, stalled = (gap, 0) if gap < 0.8 * reference else (reference, stalled + 1)
        if gap <= tolerance or not np.isfinite(best_loss) or stalled == PATIENCE:
            break
        w, Z_low, Z_high = found
        high, direction = setting.excess(omega, Z_low, Z_high, setting.loss(lines, w))
        # The own lines are at 0 already; what lies above can come in.
        at = local_maxima(high)
        own = setting.loss(lines, w) * np.trace(setting.forms(omega[at], Z_low), axis1=1, axis2=2).real
        at = at[high[at] > OVER * own]
        told = w * np.sum(lines.F**2, axis=(1, 2))
        stay = told > IDLE * told.max()
        if not len(at):
            break
        old = _Lines(lines.omega[stay], lines.direction[stay], lines.F[stay])
        lines = old + setting.lines(omega[at], direction[at])
    if proof is not None and refine:
        # Bounds of early rounds may have missed a maximum that the grid did not show then.
        support = kept[0].omega if kept else omega
        centres, widths = setting.map.resonances.T
        scale = np.hypot(support[:, None] - centres, widths).min(axis=1, initial=WIDEST)
        # The excess is a difference of two that are large beside a resonance: its maxima are narrower than the grid's.
        sides = np.geomspace(1e-2, np.maximum(1.0, 0.3 / widths), BESIDE)
        beside = np.abs(centres + widths * np.concatenate([-sides, 0 * sides[:1], sides])).ravel()
        more = within(np.append(beside, np.linspace(0, np.pi, EVENLY)), bands)
        omega = np.unique(np.concatenate([omega, denser(omega, bands, support, scale), more]))
        best_bound, proof = 0.0, proofs[-1]
        for one in proofs[-LOOKED_AT:]:
            bound, omega = _bound(setting, omega, bands, *one, best_loss, refine)
            if bound > best_bound:
                best_bound, proof = bound, one
    if kept is None or proof is None:
        raise NotIdentifiable(
            "every spectrum leaves the information singular in double precision; give the parameters units in which "
            "they are of like size, fix some of them, or add prior information."
        )
    kept = _sparse(setting, *kept)
    return _as_design(setting, *kept, *proof, best_bound, omega, rounds, tolerance)


def _polished(
    setting: _Setting, lines: _Lines, w: NDArray, Z_low: NDArray, Z_high: NDArray
) -> list[tuple[_Lines, NDArray, NDArray, NDArray]]:
    """The same after Newton's method on the support and the eigenvectors of both eigenvalues; nothing where it fails."""
    problem = setting.problem
    merged = at_clusters(problem, problem.columns(lines.omega, lines.direction), w, spent=0.0)
    lines, w, _ = _explained(
        setting.lines(merged.omega, merged.direction), setting.told(lines, w), float(w.sum())
    )
    # White noise may tell a billionth of what these lines do: in its coordinates the certificate is rounding.
    problem = Problem(
        problem.map, problem.original, problem.budgets, lines.omega, problem.bands, lines.direction * np.sqrt(w)[:, None],
    )  # fmt: skip
    parts = []
    for Z in (Z_low, Z_high):
        values, vectors = np.linalg.eigh(Z)
        own = values > SPENT * values[-1]
        parts.append(problem.R @ setting.turn.T @ (vectors[:, own] * np.sqrt(values[own])))
    signs = np.repeat([1.0, -1.0], [part.shape[1] for part in parts])
    X = np.concatenate(parts, axis=1)
    columns = problem.columns(lines.omega, lines.direction)
    used = (columns.q.T @ w).max()
    # Without a prior any power will do, and costs nothing.
    nu = np.full(1, float(np.any(setting.constant)))
    found = polish(problem, columns, w / used, X, nu, signs)
    if found is None:
        return []
    V = problem.original.V
    Y = V.T @ np.linalg.solve(problem.R, found.X)
    low, high = (_unit_trace(Y[:, signs == sign] @ Y[:, signs == sign].T) for sign in (1, -1))
    return [(setting.lines(found.columns.omega, found.columns.direction), found.w, low, high)]


def _lifted(
    setting: _Setting, omega: NDArray, Z_low: NDArray, Z_high: NDArray, k: float
) -> NDArray[np.float64]:
    """Z_high with so much of the identity that S_2 - k S_1 is nowhere negative on the grid: rounding of the
    programme. Most where a line tells little, for which the bound pays nothing this way; without it pays the
    whole relative error."""
    n = len(Z_low)
    if not np.isfinite(k):
        return Z_high
    all_of_it = setting.forms(omega, np.eye(n))
    short = k * setting.forms(omega, Z_low) - setting.forms(omega, Z_high)
    values, vectors = np.linalg.eigh(all_of_it)
    root = vectors / np.sqrt(np.maximum(values, 1e-14 * values[:, -1:]))[:, None, :]
    worst = float(np.linalg.eigvalsh(root.conj().swapaxes(1, 2) @ short @ root)[:, -1].max())
    return _unit_trace(Z_high + (worst if 0 < worst < LIFT else 0.0) * np.eye(n))


def _weights(lines: _Lines, setting: _Setting) -> tuple[NDArray, NDArray, NDArray]:
    """Weights within the power, and multipliers of trace 1."""
    m, n, _ = lines.F.shape
    atoms = lines.F @ lines.F.swapaxes(1, 2)
    # Every line in units of its own information: what the programme leaves of a line's condition is a share of that.
    size = np.einsum("mii->m", atoms) / n
    size = np.maximum(size, 1e-30 * size.max())
    atoms, unit = atoms / size[:, None, None], 1.0
    prior = bool(np.any(setting.constant))
    parts = [svec(atoms / unit).T]
    if prior:
        parts.append(svec(setting.constant[None] / unit).T)
    S = np.concatenate(parts, axis=1)
    eye = svec(np.eye(n)[None])[0]
    # Variables w, [tau], t;  M - t I >= 0,  I - M >= 0,  w >= 0,  [tau P - sum w >= 0].
    low = np.concatenate([-S, eye[:, None]], axis=1)
    high = np.concatenate([S, np.zeros((len(S), 1))], axis=1)
    count = S.shape[1]
    positive = np.concatenate([-np.eye(count), np.zeros((count, 1))], axis=1)
    if prior:
        positive = np.vstack([positive, np.concatenate([1 / size, [-setting.power, 0.0]])])
    blocks = [low, high, positive]
    offsets = [np.zeros(len(S)), eye, np.zeros(len(positive))]
    objective = np.zeros(count + 1)
    objective[-1] = -1.0
    _, x, z, _ = linear_matrix_programme(objective, blocks, offsets, [n, n], 1e-11)
    Z_low, Z_high = (smat(part, n) for part in (z[: len(S)], z[len(S) : 2 * len(S)]))
    w = np.maximum(x[:m], 0.0) / size
    tau = float(x[m]) if prior else float(w.sum()) / setting.power
    w = w / max(tau, float(w.sum()) / setting.power, 1e-300)
    return w, _unit_trace(Z_low), _unit_trace(Z_high)


def _sparse(setting: _Setting, lines: _Lines, w: NDArray) -> tuple[_Lines, NDArray[np.float64]]:
    """The same information by few lines (Caratheodory): a vertex of the weights with this M and power. The
    optimum is not unique in its lines, and an interior-point method returns their average: hundreds."""
    few, own, off = _explained(lines, setting.told(lines, w), float(w.sum()))
    return (few, own) if off < SAME and len(own) < np.count_nonzero(w) else (lines, w)


def _explained(lines: _Lines, told: NDArray, power: float) -> tuple[_Lines, NDArray[np.float64], float]:
    """Lines and weights of the information nearest to `told` at nearly this power, and how far off it is, relative."""
    from scipy.optimize import nnls

    # Scaled so that every line has unit information: what is solved for are shares of it.
    atoms = svec(lines.F @ lines.F.swapaxes(1, 2)).T
    size = np.linalg.norm(atoms, axis=0)
    unit = np.mean(1 / size)
    target = np.append(svec(told[None])[0], power / unit)
    shares, residual = nnls(np.vstack([atoms / size, 1 / size / unit]), target)
    few = shares > 0
    kept = _Lines(lines.omega[few], lines.direction[few], lines.F[few])
    return kept, shares[few] / size[few], float(residual / np.linalg.norm(target))


def _unit_trace(Z: NDArray[np.float64]) -> NDArray[np.float64]:
    values, vectors = np.linalg.eigh((Z + Z.T) / 2)
    values = np.clip(values, 0, None)
    return (vectors * (values / max(values.sum(), 1e-300))) @ vectors.T


def _bound(
    setting: _Setting, omega: NDArray, bands: Bands, Z_low: NDArray, Z_high: NDArray, loss: float, refine: bool,
) -> tuple[float, NDArray[np.float64]]:  # fmt: skip
    """Largest certified k, and the grid with the maxima that decided it."""
    if not np.isfinite(loss):
        return 0.0, omega
    k = loss
    for _ in range(REFINED if refine else 0):
        # Between the lines the maxima of the excess at k itself decide, and there are others at the loss.
        high = setting.excess(omega, Z_low, Z_high, k)[0]
        at, before = local_maxima(high), k
        at = np.sort(at[np.argsort(high[at])[-HIGHEST:]])
        left, right = omega[np.maximum(at - 1, 0)], omega[np.minimum(at + 1, len(omega) - 1)]
        found = maxima_between(lambda w, k=k: setting.excess(w, Z_low, Z_high, k)[0], left, right)
        omega = np.union1d(omega, within(found, bands))
        k = _on_grid(setting, omega, Z_low, Z_high, loss)
        if k >= before * (1 - ALIKE):
            return k, omega
    return _on_grid(setting, omega, Z_low, Z_high, loss), omega


def _on_grid(setting: _Setting, omega: NDArray, Z_low: NDArray, Z_high: NDArray, loss: float) -> float:
    """Largest k that is certified on a grid."""
    low_forms, high_forms = setting.forms(omega, Z_low), setting.forms(omega, Z_high)

    def holds(k: float) -> bool:
        worst = float(np.linalg.eigvalsh(high_forms - k * low_forms)[:, 0].min())
        return setting.surplus(Z_low, Z_high, k) + setting.power * min(0.0, worst) >= 0

    small, large = 0.0, loss
    if holds(large):
        return large
    for _ in range(60):
        middle = (small + large) / 2
        small, large = (middle, large) if holds(middle) else (small, middle)
    return small


def _as_design(
    setting: _Setting, lines: _Lines, w: NDArray, Z_low: NDArray, Z_high: NDArray, bound: float, omega: NDArray,
    rounds: int, tolerance: float,
) -> Design:  # fmt: skip
    # A line of 1e-10 of the power may be all that a parameter is known by: only those go of which the loss does not tell.
    most = setting.loss(lines, w) * (1 + UNTOLD)
    for share in TRIFLES:
        keep = w > share * w.max()
        if setting.loss(lines, w * keep) <= most:
            break
    lines, w = _Lines(lines.omega[keep], lines.direction[keep], lines.F[keep]), w[keep]
    spectrum = spectrum_of_lines(lines.omega, lines.direction, w)
    information = setting.map.of_spectrum(spectrum)
    scale = bound * float(np.sum(Z_low * (setting.turn @ information @ setting.turn.T)))
    offset = setting.surplus(Z_low, Z_high, bound)

    def price(frequency: NDArray) -> NDArray[np.float64]:
        excess = setting.excess(frequency, Z_low, Z_high, bound)[0]
        return 1 + (setting.power * excess - offset) / scale

    prices = price(omega)
    top = int(np.argmax(prices))
    values, vectors = np.linalg.eigh(Z_low)
    X = np.asarray(setting.turn.T @ vectors * np.sqrt(np.clip(values, 0, None)), dtype=np.float64)
    certificate = Certificate(
        X, {"input power": 0.0}, 1.0, 1 / bound, bound, float(prices[top]), float(omega[top]), price,
        rounding=setting.rounding(lines, w),
    )  # fmt: skip
    return assembled(
        setting.problem, spectrum, certificate, setting.loss(lines, w),
        used={"input power": spectrum.total_power}, tolerance=tolerance, solver="clarabel", rounds=rounds,
    )  # fmt: skip
