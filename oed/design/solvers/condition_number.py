"""Modified E: the least condition number of the information matrix, with its certificate.

    minimise lambda_max(M) / lambda_min(M) over the spectra of a given power

With M homogenised by tau it is one semidefinite programme: maximise t subject to t I <= M(w, tau) <= I. For any
positive semidefinite Z_1 and Z_2 and every admissible M

    lambda_max(M) / lambda_min(M) >= (tr Z_2 M / tr Z_2) / (tr Z_1 M / tr Z_1),

so that k is a lower bound as soon as tr[(Z_2 / tr Z_2 - k Z_1 / tr Z_1) M] >= 0 for every admissible M: with
S_i(w) = D(w)^* Z_i D(w), traces 1 and the power P,

    tr[(Z_2 - k Z_1) M_0] + P min(0, least eigenvalue over all w of S_2(w) - k S_1(w)) >= 0."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from oed.design.assembling import TRIFLES, UNTOLD, assembled, spectrum_of_lines
from oed.design.problem.certificate import Certificate
from oed.design.problem.design import Design
from oed.design.problem.families import local_maxima, maxima_between
from oed.design.problem.grid import denser, within
from oed.design.problem.lines import Problem
from oed.design.solvers.condition_lines import (
    Lines,
    Setting,
    conic_weights,
    explained,
    needed,
    own_weights,
    sparse,
    unit_trace,
)
from oed.design.solvers.merging_lines import at_clusters
from oed.design.solvers.polishing import polish
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
SPENT = (1e-5, 1e-3)
"""Shares of a multiplier's largest eigenvalue below which the others are what an interior point leaves of zero: both are tried."""
PATIENCE = 2
"""Rounds that gain no fifth of the gap after which rounding of the programme holds it up."""
CENTRED = 0.03
"""Share of the gap to which the next weights are found: multipliers at a vertex of their set jump from round to round."""
SHARED = 1e-4
"""Share of an entry of the plant in what a multiplier weighs below which it has none."""
LEFT = 1e-2
"""Share of the information, and of a line's price, below which it does not belong to the support."""
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


def condition_design(
    problem: Problem, *, refine: bool = True, tolerance: float = 1e-7, max_rounds: int = 12
) -> Design:
    """The spectrum with the least condition number; `solve_design` calls it for the criterion modified-E."""
    setting, omega, bands = Setting(problem), problem.omega, problem.bands
    q = setting.map.n_inputs
    lines = setting.lines(np.repeat(omega, q), np.tile(np.eye(q, dtype=complex), (len(omega), 1)))
    best_loss, best_bound, kept, proof, rounds = np.inf, 0.0, None, None, 0
    reference, stalled, start, accuracy, looked, gap = np.inf, 0, None, 1e-12, None, np.inf
    proofs: list[tuple[float, NDArray, NDArray]] = []
    while rounds < max_rounds:
        rounds += 1
        found = (
            (lines, *conic_weights(lines, setting))
            if start is None
            else own_weights(lines, setting, start, accuracy)
        )
        tries = [found]
        loss, tried, hints = np.inf, 0, None
        while tries and not best_loss <= best_bound * (1 + tolerance):
            own, w, Z_low, Z_high = tries.pop()
            loss = setting.loss(own, w)
            if loss < best_loss:
                # With its lines on the grid no certificate says more than its loss.
                best_loss, kept, omega = loss, (own, w), np.union1d(omega, own.omega[w > 0])
            Z_high = _lifted(setting, omega, Z_low, Z_high, loss)
            bound, omega = _bound(setting, omega, bands, Z_low, Z_high, loss, refine)
            if bound > best_bound:
                best_bound, proof = bound, (Z_low, Z_high)
                proofs.append((bound, *proof))
            tried += 1
            if tried > 1:
                hints = own + _dear(setting, omega, Z_low, Z_high, loss)
            if (
                refine
                and tried == 1
                and np.isfinite(loss)
                and tolerance < best_loss / max(best_bound, 1e-300) - 1 < NEARLY
            ):
                few = sparse(setting, own, w)
                tries = [
                    one
                    for Z in _supposed(setting, own, w, Z_low, Z_high)
                    for one in _polished(setting, *few, *Z)
                ]
        gap = best_loss / max(best_bound, 1e-300) - 1
        reference, stalled = (gap, 0) if gap < 0.8 * reference else (reference, stalled + 1)
        if gap <= tolerance and refine and looked is not proof:
            best_bound, proof, omega = _looked_at(setting, omega, bands, kept, proofs, best_loss)
            proofs, looked, gap = [(best_bound, *proof)], proof, best_loss / max(best_bound, 1e-300) - 1
        if gap <= tolerance or not np.isfinite(best_loss) or stalled == PATIENCE:
            break
        lines, w, Z_low, Z_high = found
        loss = setting.loss(lines, w)
        new = _dear(setting, omega, Z_low, Z_high, loss)
        if hints is not None:
            new = new + hints
        if not np.isfinite(loss) or not len(new.omega):
            break
        accuracy = max(1e-12, CENTRED * gap)
        old, w = needed(setting, lines, w, Z_low, Z_high, loss)
        lines, start = old + new, np.append(w, np.zeros(len(new.omega)))
    if proofs and refine and not (looked is proof and gap <= tolerance):
        best_bound, proof, omega = _looked_at(setting, omega, bands, kept, proofs, best_loss)
    if kept is None or proof is None:
        raise NotIdentifiable(
            "every spectrum leaves the information singular in double precision; give the parameters units in which "
            "they are of like size, fix some of them, or add prior information."
        )
    kept = sparse(setting, *kept)
    return _as_design(setting, *kept, *proof, best_bound, omega, rounds, tolerance)


def _looked_at(
    setting: Setting, omega: NDArray, bands: Bands, kept: tuple[Lines, NDArray] | None,
    proofs: list[tuple[float, NDArray, NDArray]], loss: float,
) -> tuple[float, tuple[NDArray, NDArray], NDArray[np.float64]]:  # fmt: skip
    """The best bound of the last certificates on a finer grid, and that grid: early rounds may have missed a maximum that theirs did
    not show."""
    support = kept[0].omega if kept else omega
    centres, widths = setting.map.resonances.T
    scale = np.hypot(support[:, None] - centres, widths).min(axis=1, initial=WIDEST)
    # The excess is a difference of two that are large beside a resonance: its maxima are narrower than the grid's.
    sides = np.geomspace(1e-2, np.maximum(1.0, 0.3 / widths), BESIDE)
    beside = np.abs(centres + widths * np.concatenate([-sides, 0 * sides[:1], sides])).ravel()
    more = within(np.append(beside, np.linspace(0, np.pi, EVENLY)), bands)
    omega = np.unique(np.concatenate([omega, denser(omega, bands, support, scale), more]))
    best, proof = 0.0, proofs[-1][1:]
    for before, *one in proofs[: -LOOKED_AT - 1 : -1]:
        if before <= best:
            break  # a finer grid raises no bound
        bound, omega = _bound(setting, omega, bands, one[0], one[1], loss, True)
        if bound > best:
            best, proof = bound, (one[0], one[1])
    return best, proof, omega


def _without_others(setting: Setting, told: NDArray, Z: NDArray) -> NDArray[np.float64]:
    """A multiplier without its parts of entries of the plant that do not hold up its eigenvalue: an interior point leaves there what
    a hair's breadth of price decides."""
    from scipy.sparse.csgraph import connected_components

    reached = np.any(setting.factor(setting.problem.omega[:1]) != 0, axis=0).reshape(len(Z), -1)
    _, entry = connected_components((reached[:, None] == reached).all(axis=2))
    share = np.bincount(entry, np.diag(Z) * np.diag(told))
    keep = (share > SHARED * share.sum())[entry]
    return unit_trace(Z * np.outer(keep, keep))


def _supposed(
    setting: Setting, lines: Lines, w: NDArray, Z_low: NDArray, Z_high: NDArray
) -> list[tuple[NDArray, NDArray, float]]:
    """What the multipliers may be at the optimum, the likeliest last: theirs, or those without other entries, each with those of
    `SPENT` that leave it different ranks."""
    told, found = setting.told(lines, w), {}
    for low, high in ((Z_low, Z_high), tuple(_without_others(setting, told, Z) for Z in (Z_low, Z_high))):
        values = [np.linalg.eigvalsh(Z) for Z in (low, high)]
        for spent in SPENT:
            kept = tuple(int(np.sum(v > spent * v[-1])) for v in values)
            found[kept, tuple(np.count_nonzero(Z) for Z in (low, high))] = (low, high, spent)
    return list(found.values())


def _dear(setting: Setting, omega: NDArray, Z_low: NDArray, Z_high: NDArray, loss: float) -> Lines:
    """The lines of a grid that can come in: where k S_1 - S_2 has its maxima, above 0, where the own lines are."""
    high, direction = setting.excess(omega, Z_low, Z_high, loss if np.isfinite(loss) else 0.0)
    high = high / setting.price(omega, Z_low) / (loss if np.isfinite(loss) else 1.0)
    above = np.flatnonzero(high > OVER)
    peaks = np.intersect1d(local_maxima(high), above)
    # Where the multipliers have let go of a whole stretch, its maxima would come in one by one.
    at = np.union1d(peaks[np.argsort(high[peaks])[-HIGHEST:]], above[:: 1 + len(above) // HIGHEST])
    return setting.lines(omega[at], direction[at])


def _polished(
    setting: Setting, lines: Lines, w: NDArray, Z_low: NDArray, Z_high: NDArray, spent: float
) -> list[tuple[Lines, NDArray, NDArray, NDArray]]:
    """The same after Newton's method on the support and the eigenvectors of both eigenvalues; nothing where it fails."""
    problem = setting.problem
    merged = at_clusters(problem, problem.columns(lines.omega, lines.direction), w, spent=0.0)
    lines, w, _ = explained(
        setting.lines(merged.omega, merged.direction), setting.told(lines, w), float(w.sum())
    )
    # White noise may tell a billionth of what these lines do: in its coordinates the certificate is rounding.
    problem = Problem(
        problem.map, problem.original, problem.budgets, lines.omega, problem.bands, lines.direction * np.sqrt(w)[:, None],
    )  # fmt: skip
    parts = []
    for Z in (Z_low, Z_high):
        values, vectors = np.linalg.eigh(Z)
        own = values > spent * values[-1]
        parts.append(problem.R @ setting.turn.T @ (vectors[:, own] * np.sqrt(values[own])))
    signs = np.repeat([1.0, -1.0], [part.shape[1] for part in parts])
    columns = problem.columns(lines.omega, lines.direction)
    # Of the information, here the identity, these tell little, and cost more than they are worth: what is left of a search.
    tells = w * np.sum(columns.F**2, axis=(1, 2))
    low, high = (np.sum((columns.F.swapaxes(1, 2) @ part) ** 2, axis=(1, 2)) for part in parts)
    balance = np.sum(w * high) / np.sum(w * low)
    stay = (tells > LEFT) | (low * balance > (1 - LEFT) * high)
    columns, w, X = columns.take(stay), w[stay], np.concatenate(parts, axis=1)
    used = (columns.q.T @ w).max()
    # Without a prior any power will do, and costs nothing.
    nu = np.full(1, float(np.any(setting.constant)))
    found = polish(problem, columns, w / used, X, nu, signs)
    if found is None:
        return []
    V = problem.original.V
    Y = V.T @ np.linalg.solve(problem.R, found.X)
    low, high = (unit_trace(Y[:, signs == sign] @ Y[:, signs == sign].T) for sign in (1, -1))
    return [(setting.lines(found.columns.omega, found.columns.direction), found.w, low, high)]


def _lifted(
    setting: Setting, omega: NDArray, Z_low: NDArray, Z_high: NDArray, k: float
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
    return unit_trace(Z_high + (worst if 0 < worst < LIFT else 0.0) * np.eye(n))


def _bound(
    setting: Setting, omega: NDArray, bands: Bands, Z_low: NDArray, Z_high: NDArray, loss: float, refine: bool,
) -> tuple[float, NDArray[np.float64]]:  # fmt: skip
    """Largest certified k, and the grid with the maxima that decided it."""
    if not np.isfinite(loss):
        return 0.0, omega
    k = loss
    for _ in range(REFINED if refine else 0):
        # Between the lines the maxima of the excess at k itself decide, and there are others at the loss.
        high, own = setting.excess(omega, Z_low, Z_high, k)[0], setting.price(omega, Z_low)
        at, before = local_maxima(high), k
        at = np.sort(at[np.argsort(high[at] / own[at])[-HIGHEST:]])
        left, right = omega[np.maximum(at - 1, 0)], omega[np.minimum(at + 1, len(omega) - 1)]
        found = maxima_between(lambda w, k=k: setting.excess(w, Z_low, Z_high, k)[0], left, right)
        omega = np.union1d(omega, within(found, bands))
        k = _on_grid(setting, omega, Z_low, Z_high, loss)
        if k >= before * (1 - ALIKE):
            return k, omega
    return _on_grid(setting, omega, Z_low, Z_high, loss), omega


def _on_grid(setting: Setting, omega: NDArray, Z_low: NDArray, Z_high: NDArray, loss: float) -> float:
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
    setting: Setting, lines: Lines, w: NDArray, Z_low: NDArray, Z_high: NDArray, bound: float, omega: NDArray,
    rounds: int, tolerance: float,
) -> Design:  # fmt: skip
    # A line of 1e-10 of the power may be all that a parameter is known by: only those go of which the loss does not tell.
    most = setting.loss(lines, w) * (1 + UNTOLD)
    for share in TRIFLES:
        keep = w > share * w.max()
        if setting.loss(lines, w * keep) <= most:
            break
    lines, w = Lines(lines.omega[keep], lines.direction[keep], lines.F[keep]), w[keep]
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
