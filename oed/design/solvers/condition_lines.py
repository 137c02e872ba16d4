"""Modified E: its lines, their information in the units of the criterion, and the weights with which it is best conditioned."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from oed.design.problem.lines import Problem, factor_of, moved_by_rounding
from oed.design.solvers.weights_clarabel import linear_matrix_programme, smat, svec
from oed.design.solvers.weights_e import condition_weights

IDLE = 1e-9
"""Share of the information, in coordinates in which all of it is the identity, below which a line tells of nothing by itself."""
HELD = 0.5
"""Price of a line, in units of what it takes, from which on it may be what holds the multipliers where they are."""
MOST = 150
"""Lines that stay besides those that are needed: a step of the interior-point method grows with their number cubed."""
SAME = 1e-11
"""Relative difference below which fewer lines have the same information."""


@dataclass(frozen=True, eq=False)
class Lines:
    """Lines of unit power: D v, in the units of the criterion, real and imaginary parts side by side."""

    omega: NDArray[np.float64]
    direction: NDArray[np.complex128]
    F: NDArray[np.float64]

    def __add__(self, other: Lines) -> Lines:
        pair = lambda name: np.concatenate([getattr(self, name), getattr(other, name)])
        return Lines(pair("omega"), pair("direction"), pair("F"))


class Setting:
    """The problem in the criterion's units, with a grid that grows."""

    def __init__(self, problem: Problem) -> None:
        self.problem, self.map, self.power = problem, problem.map, problem.budgets[0].limit
        self.turn = np.linalg.inv(problem.original.V)
        self.constant = self.turn @ self.map.constant @ self.turn.T
        self.skeleton = problem.omega[:: -(-len(problem.omega) * self.map.n_inputs // MOST)]

    def factor(self, omega: NDArray) -> NDArray[np.complex128]:
        """D in the units of the criterion: omega (K,) -> (K, n, r, nu)."""
        D = self.map.factor(omega)
        return (self.turn @ D.reshape(*D.shape[:2], D.shape[2] * D.shape[3])).reshape(D.shape)

    def lines(self, omega: NDArray, direction: NDArray) -> Lines:
        """Lines of unit power at frequencies and directions."""
        G = np.einsum("knrq,kq->knr", self.factor(omega), direction)
        return Lines(omega, direction, np.concatenate([G.real, G.imag], axis=2))

    def told(self, lines: Lines, w: NDArray) -> NDArray[np.float64]:
        """Information (n, n) of weights (m,)."""
        flat = factor_of(lines.F, w)
        return flat @ flat.T

    def loss(self, lines: Lines, w: NDArray) -> float:
        """From the factor, whose singular values have twice the digits of the information's eigenvalues."""
        flat = factor_of(lines.F, w, self.constant)
        values = np.linalg.svd(flat, compute_uv=False)
        return float(values[0] / values[-1]) ** 2 if len(values) == len(flat) and values[-1] > 0 else np.inf

    def rounding(self, lines: Lines, w: NDArray) -> float:
        """How far rounding alone moves the loss, relative."""
        again = lambda omega: self.loss(self.lines(omega, lines.direction), w)
        return moved_by_rounding(self.loss(lines, w), again, lines.omega)

    def forms(self, omega: NDArray, Z: NDArray) -> NDArray[np.complex128]:
        """D^* Z D: omega (K,) -> (K, nu, nu)."""
        D = self.factor(omega)
        K, n, r, q = D.shape
        valued = (Z @ D.reshape(K, n, r * q)).reshape(K, n * r, q)
        return np.asarray(D.reshape(K, n * r, q).conj().swapaxes(1, 2) @ valued, dtype=np.complex128)

    def excess(self, omega: NDArray, Z_low: NDArray, Z_high: NDArray, k: float) -> tuple[NDArray, NDArray]:
        """Largest eigenvalue of k S_1 - S_2 and its direction."""
        S = k * self.forms(omega, Z_low) - self.forms(omega, Z_high)
        values, vectors = np.linalg.eigh((S + S.conj().swapaxes(1, 2)) / 2)
        return values[:, -1], vectors[:, :, -1]

    def price(self, omega: NDArray, Z_low: NDArray) -> NDArray[np.float64]:
        """tr S_1 (K,), the unit of an excess: beside a resonance rounding is more than all there is elsewhere."""
        return np.maximum(np.trace(self.forms(omega, Z_low), axis1=1, axis2=2).real, 1e-300)

    def surplus(self, Z_low: NDArray, Z_high: NDArray, k: float) -> float:
        """What the constant part leaves of tr (Z_2 - k Z_1) M."""
        return float(np.sum((Z_high - k * Z_low) * self.constant))


def conic_weights(lines: Lines, setting: Setting) -> tuple[NDArray, NDArray, NDArray]:
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
    return w, unit_trace(Z_low), unit_trace(Z_high)


def own_weights(
    lines: Lines, setting: Setting, start: NDArray[np.float64], accuracy: float
) -> tuple[Lines, NDArray, NDArray, NDArray]:
    """The same by our own method, to the digits that Clarabel leaves, with the best directions at the lines' frequencies: between the
    directions that have been tried there are others, hardly dearer, without end; weights to begin with (m,)."""
    problem = setting.problem
    if np.any(setting.constant):
        return lines, *conic_weights(lines, setting)
    q = setting.map.n_inputs
    omega, at = np.unique(lines.omega, return_inverse=True)
    shares = np.zeros((len(omega), q))
    np.add.at(shares, at, start[:, None] * np.abs(lines.direction) ** 2)
    eye = np.tile(np.eye(q, dtype=complex), (len(omega), 1))
    whole = setting.lines(np.repeat(omega, q), eye)
    cells = (np.arange(len(eye)).reshape(-1, q),)
    F = problem.columns(whole.omega, eye).F
    r = whole.F.shape[2] // 2
    try:
        (power,), X_low, X_high, _ = condition_weights(
            F[:, :, ::2] + 1j * F[:, :, 1::2], problem.criterion.V, whole.F[:, :, :r] + 1j * whole.F[:, :, r:], shares.ravel(),
            cells=cells, tolerance=accuracy,
        )  # fmt: skip
    except np.linalg.LinAlgError:
        return lines, *conic_weights(lines, setting)
    low = problem.original.V.T @ np.linalg.solve(problem.R, X_low)
    ends = (omega == 0) | (omega == np.pi)
    power = np.where(ends[:, None, None], power.real, power)
    values, vectors = np.linalg.eigh(power)
    found, w = (
        setting.lines(np.repeat(omega, q), vectors.swapaxes(1, 2).reshape(-1, q)),
        np.maximum(values.ravel(), 0.0),
    )
    return found, w * setting.power / w.sum(), unit_trace(low @ low.T), unit_trace(X_high @ X_high.T)


def needed(
    setting: Setting, lines: Lines, w: NDArray[np.float64], Z_low: NDArray, Z_high: NDArray, loss: float
) -> tuple[Lines, NDArray[np.float64]]:
    """Few lines of the same information, with their weights; those that tell most of it; and those that hold the multipliers, now
    or, spread over the band, when others have gone: where those of the information matter little, they are free to move far."""
    n, m = len(Z_low), len(w)
    F = np.moveaxis(setting.problem.columns(lines.omega, lines.direction).F, 0, 1).reshape(n, -1)
    half = np.linalg.qr((F * np.repeat(np.sqrt(w), F.shape[1] // m)).T, mode="r").T
    told = w * np.sum(np.linalg.lstsq(half, F, rcond=None)[0].reshape(n, m, -1) ** 2, axis=(0, 2))
    worth, taken = (np.einsum("mnr,np,mpr->m", lines.F, Z, lines.F, optimize=True) for Z in (Z_low, Z_high))
    price = loss * worth / np.maximum(taken, 1e-300)
    few, own = sparse(setting, lines, w)
    stay = np.isin(lines.omega, setting.skeleton)
    for size, least in ((told, IDLE), (price, HELD)):
        stay[np.argsort(size)[-MOST:]] |= np.sort(size)[-MOST:] > least
    stay &= ~np.isin(lines.omega, few.omega)
    rest = Lines(lines.omega[stay], lines.direction[stay], lines.F[stay])
    return few + rest, np.append(own, w[stay])


def sparse(setting: Setting, lines: Lines, w: NDArray) -> tuple[Lines, NDArray[np.float64]]:
    """The same information by few lines (Caratheodory): a vertex of the weights with this M and power. The
    optimum is not unique in its lines, and an interior-point method returns their average: hundreds."""
    few, own, off = explained(lines, setting.told(lines, w), float(w.sum()))
    return (few, own) if off < SAME and len(own) < np.count_nonzero(w) else (lines, w)


def explained(lines: Lines, told: NDArray, power: float) -> tuple[Lines, NDArray[np.float64], float]:
    """Lines and weights of the information nearest to `told` at nearly this power, and how far off it is, relative."""
    from scipy.optimize import nnls

    # Scaled so that every line has unit information: what is solved for are shares of it.
    atoms = svec(lines.F @ lines.F.swapaxes(1, 2)).T
    size = np.linalg.norm(atoms, axis=0)
    unit = np.mean(1 / size)
    target = np.append(svec(told[None])[0], power / unit)
    shares, residual = nnls(np.vstack([atoms / size, 1 / size / unit]), target)
    few = shares > 0
    kept = Lines(lines.omega[few], lines.direction[few], lines.F[few])
    return kept, shares[few] / size[few], float(residual / np.linalg.norm(target))


def unit_trace(Z: NDArray[np.float64]) -> NDArray[np.float64]:
    """Z without what rounding leaves below 0, of trace 1."""
    values, vectors = np.linalg.eigh((Z + Z.T) / 2)
    values = np.clip(values, 0, None)
    return (vectors * (values / max(values.sum(), 1e-300))) @ vectors.T
