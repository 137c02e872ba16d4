"""Autocorrelation and moment parametrisations: the spectrum as a few numbers instead of many lines.

Autocorrelation (a finite moving average): Phi(w) = r_0 + 2 sum_{l=1}^{L} r_l cos(l w) >= 0, linear information
M = sum_l r_l T_l, and nonnegativity everywhere by the positive-real lemma: r_l = trace of the l-th diagonal of some
positive semidefinite Q, (L+1) x (L+1) (trace parametrisation; B. Dumitrescu, Positive Trigonometric Polynomials). With
several inputs r_l are matrices R_l, Phi = R_0 + sum_l (R_l e^-jlw + R_l' e^jlw), and the entries of Q are blocks.

Moments: for a rational plant of one input with denominator A and numerators of degree d of the gradient,
M depends on Phi / |A A H|^2 through its moments m_0 ... m_d only; a sequence is one of moments exactly when its
Toeplitz matrix is positive semidefinite (Caratheodory), and then a few lines have these moments.
Source: R. Hildebrand, M. Gevers, "Identification for control: optimal input design with respect to a worst-case
nu-gap cost function", SIAM J. Control and Optimization 41 (2003) 1586-1608."""

from dataclasses import dataclass
from itertools import product
from typing import Any

import numpy as np
from numpy.typing import NDArray

from oed.covariances import square_root
from oed.criteria import Criterion
from oed.data import Spectrum
from oed.design.problem.criteria_by_name import criterion_of
from oed.design.problem.information_maps import InformationMap, information_map
from oed.design.problem.white import information_nodes
from oed.errors import InputError, SolverFailure
from oed.plants.plant import Plant
from oed.plants.systems import as_plant


@dataclass(frozen=True, eq=False)
class Autocorrelated:
    """The best spectrum of a parametrisation. `spectrum` as lines: of a density, the nodes of a quadrature
    that is exact for the information; `coefficients` (L + 1,) autocorrelation r_0 ... r_L, with several
    inputs (L + 1, nu, nu), E u(t + l) u(t)'; or moments m_0 ... m_d; `loss` loss per sample at the stated
    power; `kind` "autocorrelation" or "moments"; `power` input power as the optimiser's own variables have
    it."""

    spectrum: Spectrum
    coefficients: NDArray[np.float64]
    loss: float
    kind: str
    power: float

    def __repr__(self) -> str:
        return f"{self.kind} of {len(self.coefficients)} numbers: loss {self.loss:.9g}"


def conic(criterion: Criterion, constraints: list, M: Any, accuracy: float = 1e-11) -> NDArray[np.float64]:
    """Solve for the best value of a criterion over a matrix expression in CVXPY, by Clarabel: M (n, n)."""
    import warnings

    import cvxpy as cp

    V = criterion.columns
    stated = criterion.conic(cp, M, V, V @ V.T)
    if stated is None:
        raise InputError(
            f"the criterion {criterion.name} is not available with this parametrisation; use grid."
        )
    objective, largest = stated
    problem = cp.Problem(objective, constraints if largest is None else [*constraints, largest])
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        # Clarabel's scaling of the rows was seen to end some D designs in numerical failure at once.
        for asked, scaling in product((accuracy, 1e2 * accuracy, 1e4 * accuracy), (True, False)):
            try:
                problem.solve(
                    solver=cp.CLARABEL,
                    tol_gap_abs=asked,
                    tol_gap_rel=asked,
                    tol_feas=asked,
                    # Splitting small Hermitian cones by their zeros was seen to end in numerical failure.
                    chordal_decomposition_enable=False,
                    equilibrate_enable=scaling,
                )
                break
            except cp.error.SolverError as error:
                failure = error
        else:
            raise SolverFailure(f"Clarabel failed: {failure}") from None
    if problem.status not in (cp.OPTIMAL, cp.OPTIMAL_INACCURATE):
        raise SolverFailure(f"Clarabel stopped with status {problem.status}.")
    if largest is None:
        return criterion.direction(np.asarray(M.value, dtype=float))
    Z = np.asarray(largest.dual_value, dtype=float)
    return square_root((Z + Z.T) / 2)


def _prepared(
    model: Any, criterion: str | Criterion, omega: NDArray, weight: NDArray
) -> tuple[InformationMap, Criterion, Criterion, float, NDArray, NDArray]:
    """Map, criterion (own and scaled), factor of the losses, scaled factors (n, K, r, nu) and R of nodes with weights."""
    information = information_map(model)
    wanted = criterion_of(criterion, model, information)
    D = np.moveaxis(information.factor(omega), 1, 0)
    flat = D.reshape(information.n, -1)
    whole = (D * np.sqrt(weight)[:, None, None]).reshape(information.n, -1)
    rows = np.concatenate([whole.real, whole.imag], axis=1)
    R = np.asarray(np.linalg.qr(rows.T, mode="r"))
    scaled, factor = wanted.transformed(R)
    return information, wanted, scaled, factor, np.linalg.solve(R.T, flat).reshape(D.shape), R


def autocorrelation_design(
    model: Any, criterion: str | Criterion = "D", *, lags: int = 20, input_power: float = 1.0
) -> Autocorrelated:
    """The best moving-average spectrum with a given number of lags (MOOSE2's FIR parametrisation).

    Parameters
    ----------
    model : Plant, Model or InformationMap
        One input or several.
    criterion : str or Criterion
        D, A, E or c.
    lags : int
        L: the signal is white noise through a filter of L + 1 taps.
    input_power : float
        r_0, or the trace of R_0.

    Returns
    -------
    Autocorrelated
        Its loss is above the grid design's and falls towards it as L grows.
    """
    import cvxpy as cp

    if int(lags) != lags or lags < 0:
        raise InputError(f"the number of lags is {lags}; it must be a whole number of at least 0.")
    # A panel of ten nodes integrates two turns of the longest lag to 1e-9.
    omega, weight = information_nodes(information_map(model), width=2 * np.pi / max(lags, 1))
    information, wanted, scaled, _, F, R = _prepared(model, criterion, omega, weight)
    size, nu, n = lags + 1, information.n_inputs, information.n
    turns = np.exp(-1j * np.outer(np.arange(size), omega))
    # What entry (p, q) of R_l tells, its transpose included: (size, nu, nu, n, n).
    pairs = np.einsum("nkrp,mkrq->kpqnm", F, F.conj(), optimize=True).reshape(len(omega), -1)
    pairs = pairs * weight[:, None]
    lagged = (turns @ pairs).reshape(size, nu, nu, n, n).real
    lagged[1:] += (turns[1:].conj() @ pairs).reshape(lags, nu, nu, n, n).real.swapaxes(1, 2)
    inverse = np.linalg.inv(R)
    constant = inverse.T @ information.constant @ inverse
    from scipy import sparse

    Q = cp.Variable((size * nu, size * nu), PSD=True)
    # R_l is the sum of the blocks (i + l, i) of Q: one sparse matrix, for Q's entries column by column.
    i, j, p, q = (x.ravel() for x in np.meshgrid(*map(np.arange, (size, size, nu, nu)), indexing="ij"))
    i, j, p, q = (x[i >= j] for x in (i, j, p, q))
    blocks = sparse.csr_matrix(
        (np.ones(len(i)), (((i - j) * nu + p) * nu + q, (i * nu + p) + (j * nu + q) * (size * nu))),
        shape=(size * nu * nu, (size * nu) ** 2),
    )
    r = blocks @ cp.vec(Q, order="F")
    M = constant + input_power * cp.reshape(lagged.reshape(-1, n * n).T @ r, (n, n), order="C")
    conic(scaled, [cp.trace(Q) == 1], (M + M.T) / 2)
    found = np.asarray(Q.value, dtype=float)
    power = input_power * float(np.trace(found))
    values, vectors = np.linalg.eigh((found + found.T) / 2)
    found = (vectors * np.clip(values, 0, None)) @ vectors.T
    coefficients = (blocks @ found.ravel(order="F")).reshape(size, nu, nu)
    coefficients = coefficients * (input_power / np.trace(coefficients[0]))
    half = (turns.T @ coefficients.reshape(size, -1)).reshape(-1, nu, nu) - coefficients[0] / 2
    values, vectors = np.linalg.eigh(half + half.conj().swapaxes(1, 2))
    density = (vectors * np.clip(values, 0, None)[:, None, :]) @ vectors.conj().swapaxes(1, 2)
    density = density * weight[:, None, None]
    spectrum = Spectrum(omega, density * (input_power / np.einsum("kii->", density).real))
    loss = information.loss(wanted, spectrum)
    return Autocorrelated(
        spectrum, coefficients[:, 0, 0] if nu == 1 else coefficients, loss, "autocorrelation", power
    )


def moment_design(
    plant: Plant, criterion: str | Criterion = "D", *, input_power: float = 1.0
) -> Autocorrelated:
    """The optimum by finitely many moments: exact, without any frequency grid in the problem.

    Parameters
    ----------
    plant : Plant
        One input and one output.
    criterion : str or Criterion
        D, A, E or c.
    input_power : float
        Limit on the input power.

    Returns
    -------
    Autocorrelated
        Its spectrum has the few lines of the moments' Caratheodory representation.
    """
    import cvxpy as cp

    plant = as_plant(plant)
    if plant.n_inputs * plant.n_outputs > 1:
        raise InputError("the moment parametrisation needs a Plant of one input and one output; use grid.")
    A = plant.den[0][0]
    weight = np.convolve(np.convolve(A, A), plant.noise_num)
    # Gradient numerators over A A C / D: information and power are trigonometric polynomials against the
    # measure Phi / |A A C|^2, of a degree that the numerators and the weight itself bound.
    degree = max(len(weight), len(plant.num[0][0]) + len(A) + len(plant.noise_den)) - 1
    points = 4 * (degree + 1) + 64
    omega = (np.arange(points) + 0.5) * np.pi / points
    _, _, scaled, factor, F, _ = _prepared(plant, criterion, omega, np.full(points, 1 / points))
    atoms = np.einsum("nkrp,mkrp->knm", F, F.conj()).real
    modulus = np.abs(np.polyval(weight[::-1], np.exp(-1j * omega))) ** 2
    basis = np.cos(np.outer(omega, np.arange(degree + 1)))
    rows = np.column_stack([(atoms * modulus[:, None, None]).reshape(len(omega), -1), modulus])
    coefficients = np.linalg.lstsq(basis, rows, rcond=None)[0]
    misfit = np.abs(basis @ coefficients - rows).max() / np.abs(rows).max()
    if misfit > 1e-9:
        raise SolverFailure(
            f"the moments of degree {degree} miss the information by {misfit:.1e}; use the grid parametrisation."
        )
    # Coordinates in which white noise has the identity as its Toeplitz matrix: the resonance would spoil others.
    lag = np.abs(np.subtract.outer(np.arange(degree + 1), np.arange(degree + 1)))
    white = (basis / modulus[:, None]).mean(axis=0)
    inverse = np.linalg.inv(np.linalg.cholesky(white[lag]))
    toeplitz = np.stack([inverse @ (lag == k) @ inverse.T for k in range(degree + 1)])
    scale = np.abs(toeplitz).max(axis=(1, 2))
    n = scaled.n
    x = cp.Variable(degree + 1)
    T = cp.reshape((toeplitz / scale[:, None, None]).reshape(degree + 1, -1).T @ x, lag.shape, order="C")
    M = cp.reshape((coefficients[:, :-1] / scale[:, None]).T @ x, (n, n), order="C")
    conic(scaled, [(T + T.T) / 2 >> 0, (coefficients[:, -1] / scale) @ x == 1], (M + M.T) / 2)
    moments = np.asarray(x.value, dtype=float) / scale
    information = (coefficients[:, :-1].T @ moments).reshape(n, n) * input_power
    loss = factor * scaled.loss(information)
    lines = caratheodory(moments)
    at_lines = np.cos(np.outer(np.arange(degree + 1), lines))
    from scipy.optimize import nnls

    strength, _ = nnls(at_lines / np.abs(moments[0]), moments / np.abs(moments[0]))
    power = strength * np.abs(np.polyval(weight[::-1], np.exp(-1j * lines))) ** 2
    keep = power > 1e-6 * power.max()
    spectrum = Spectrum(lines[keep], power[keep] * input_power / power[keep].sum())
    total = float(coefficients[:, -1] @ moments) * input_power
    return Autocorrelated(spectrum, moments * input_power, loss, "moments", total)


def caratheodory(moments: NDArray[np.float64], tolerance: float = 1e-6) -> NDArray[np.float64]:
    """Frequencies in [0, pi] of the lines that have given cosine moments, from the Toeplitz matrix's null
    space: moments (d + 1,)."""
    d = len(moments) - 1
    T = moments[np.abs(np.subtract.outer(np.arange(d + 1), np.arange(d + 1)))]
    values, vectors = np.linalg.eigh(T)
    null = vectors[:, values < tolerance * values[-1]]
    if null.shape[1] == 0:
        null = vectors[:, :1]
    # On the lines sum |p_i(e^jw)|^2 over the null vectors vanishes.
    grid = np.linspace(0, np.pi, 40 * (d + 1) + 1)
    height = lambda w: np.sum(np.abs(np.exp(-1j * np.outer(w, np.arange(d + 1))) @ null) ** 2, axis=1)
    h = np.concatenate([[np.inf], height(grid), [np.inf]])
    at = np.flatnonzero((h[1:-1] <= h[:-2]) & (h[1:-1] <= h[2:]))
    low, high = grid[np.maximum(at - 1, 0)], grid[np.minimum(at + 1, len(grid) - 1)]
    for _ in range(12):
        trial = low[:, None] + (high - low)[:, None] * np.linspace(0, 1, 9)
        best = np.argmin(height(trial.ravel()).reshape(trial.shape), axis=1)
        rows = np.arange(len(best))
        low, high = trial[rows, np.maximum(best - 1, 0)], trial[rows, np.minimum(best + 1, 8)]
    omega = (low + high) / 2
    return omega[height(omega) < 1e-2 * null.shape[1]]
