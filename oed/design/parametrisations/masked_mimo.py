"""Designs of several inputs under Hermitian frequency masks: no cell's density may exceed a matrix.

On cells of equal width every line satisfies P_k <= C_k (input mask and total power) and G_k P_k G_k^* <= Y_k (output
mask). For any X, any nu >= 0 and any positive semidefinite Gamma_k no admissible spectrum has more than

    h = nu P + sum_k tr(Y_k Gamma_k) + tr [C_k^1/2 (S_k - nu I - G_k^* Gamma_k G_k) C_k^1/2]_+

of tr(X' (M - M_0) X), S_k = D_k^* X X' D_k (weak duality; [.]_+ the positive part), so loss >= numerator(X) / (tr X' M_0 X + h).
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
from numpy.typing import NDArray

from oed.criteria import Criterion
from oed.data import Spectrum
from oed.design.parametrisations.autocorrelation import conic
from oed.design.problem.budgets import power_budgets
from oed.design.problem.certificate import Certificate
from oed.design.problem.design import Design
from oed.design.problem.information_maps import InformationMap
from oed.design.problem.lines import Problem
from oed.design.solvers.whole_grid import solve_cvxpy
from oed.errors import InfeasibleDesign, InputError, Status

__all__ = ["masked_mimo_design"]

Mask = Callable[[NDArray[np.float64]], NDArray[Any]]


def masked_mimo_design(
    information: InformationMap,
    criterion: Criterion,
    *,
    input_mask: Mask | None,
    output_mask: Mask | None,
    input_power: float,
    cells: int,
    tolerance: float,
) -> Design:
    """What `masked_design` does for several inputs.

    Parameters
    ----------
    information : InformationMap
        The model.
    criterion : Criterion
        A, c or E, or D of all parameters.
    input_mask, output_mask : callable, optional
        omega (K,) -> (K, nu, nu), (K, ny, ny) Hermitian, positive semidefinite: largest two-sided density.
    input_power : float
        Limit on the power summed over channels.
    cells : int
        Number of cells on [0, pi].
    tolerance : float
        Relative gap to reach.

    Returns
    -------
    Design
        Its certificate holds for spectra on these cells.

    Raises
    ------
    InputError
        If a mask is not Hermitian, not positive semidefinite or of the wrong shape.
    InfeasibleDesign
        If the masks leave no power at any frequency.
    """
    from scipy.optimize import minimize_scalar

    omega = (np.arange(cells) + 0.5) * np.pi / cells
    nu = information.n_inputs
    budgets = power_budgets(information, input_power)
    limit = budgets[0].limit
    G = information.gain(omega)
    C = None if input_mask is None else checked_mask(input_mask, omega, nu, "input mask") / cells
    Y = None if output_mask is None else checked_mask(output_mask, omega, G.shape[1], "output mask") / cells
    for mask, what in ((C, "input"), (Y, "output")):
        if mask is not None and not np.any(mask):
            raise InfeasibleDesign(
                f"the {what} mask is 0 at every frequency, so no input satisfies it; raise it somewhere."
            )
    problem = Problem(information, criterion, budgets, omega)
    D = problem.scaled_factor(omega)
    scaled = problem.criterion
    singular = scaled.kind == "A" and scaled.columns.shape[1] < information.n
    solve = _by_the_dual if singular else _by_the_spectrum
    X, lines, Gamma = solve(problem, D, G, C, Y, limit)
    lines = np.stack([_clipped(p, None if C is None else C[k]) for k, p in enumerate(lines)])
    if Y is not None:
        out = G @ lines @ G.conj().swapaxes(1, 2)
        lines = lines / np.maximum(_excess(out, Y), 1.0)[:, None, None]
    lines = lines * min(1.0, limit / float(np.einsum("kii->", lines).real))
    spectrum = Spectrum(omega, lines)
    own = information.of_spectrum(spectrum)
    loss = criterion.loss(own)
    E = np.einsum("knrq,ns->krsq", D, X).reshape(cells, -1, nu)
    S = E.conj().swapaxes(1, 2) @ E
    factor = 0.0
    if Y is not None:
        # Every factor gives a bound, and h is convex in it; CVXPY doubles the multipliers of complex cones.
        factor = float(
            minimize_scalar(
                lambda f: _most(S, G, C, Y, f * Gamma, limit)[0],
                bounds=(0.0, 3.0),
                method="bounded",
                options={"xatol": 1e-9},
            ).x
        )
    most, price = _most(S, G, C, Y, factor * Gamma, limit)
    fixed = float(np.sum(X * (problem.constant @ X)))
    bound = scaled.numerator(X) / (fixed + most) * problem.scale
    turned = np.asarray(np.linalg.solve(problem.R, X), dtype=np.float64)
    numerator = criterion.numerator(turned)
    unit = np.array([max(price, 1e-300) * limit])
    prices = problem.prices(X, unit).ratio
    total = spectrum.total_power
    return Design(
        spectrum=spectrum,
        criterion=criterion,
        loss=loss,
        bound=bound,
        certificate=Certificate(
            X=turned,
            multipliers={"input power": price},
            numerator=numerator,
            value=numerator / bound,
            bound=bound,
            largest_price=float(prices.max()),
            frequency=float(omega[np.argmax(prices)]),
            price=lambda frequencies: problem.prices_at(frequencies, X, unit).ratio,
        ),
        status=Status.OK if loss - bound <= tolerance * bound else Status.INACCURATE,
        information=own,
        map=information,
        power_used={"input power": total},
        limits={"input power": limit},
        solver="clarabel",
        rounds=1,
    )


def _by_the_spectrum(
    problem: Problem, D: NDArray, G: NDArray, C: NDArray | None, Y: NDArray | None, limit: float
) -> tuple[NDArray[np.float64], NDArray[np.complex128], NDArray[np.complex128]]:
    """X, lines and multipliers of the output mask from the problem as it stands: the information is nonsingular."""
    import cvxpy as cp

    (cells, n, _, nu), ny = D.shape, G.shape[1]
    # Re D P D^* as a linear map of the real and imaginary parts of P, (cells, n n, nu nu).
    maps = np.einsum("knpq,kmpr->knmqr", D, D.conj(), optimize=True).reshape(cells, n * n, nu * nu)
    P = [cp.Variable((nu, nu), hermitian=True) for _ in range(cells)]
    M: Any = problem.constant
    constraints: list[Any] = [sum(cp.real(cp.trace(p)) for p in P) <= limit]
    above = []
    for k, p in enumerate(P):
        flat = cp.reshape(p, (nu * nu,), order="C")
        part = maps[k].real @ cp.real(flat) - maps[k].imag @ cp.imag(flat)
        M = M + cp.reshape(part, (n, n), order="C")
        constraints.append(p >> 0)
        if C is not None:
            constraints.append(C[k] - p >> 0)
        if Y is not None:
            above.append(Y[k] - G[k] @ p @ G[k].conj().T >> 0)
    X = conic(problem.criterion, [*constraints, *above], (M + M.T) / 2, 1e-9)
    Gamma = (
        np.stack([_positive(np.asarray(a.dual_value)) for a in above])
        if above
        else np.zeros((cells, ny, ny), dtype=np.complex128)
    )
    return X, np.stack([np.asarray(p.value) for p in P]), Gamma


def _by_the_dual(
    problem: Problem, D: NDArray, G: NDArray, C: NDArray | None, Y: NDArray | None, limit: float
) -> tuple[NDArray[np.float64], NDArray[np.complex128], NDArray[np.complex128]]:
    """The same from Elfving's dual, which is exact where the optimal information is singular.

    maximise 2 tr(V'X) - tr(X' M_0 X) - nu P - sum_k tr(C_k U_k) - sum_k tr(Y_k Gamma_k), where S_k of X is at most
    nu I + U_k + G_k^* Gamma_k G_k at every cell; the multipliers of these inequalities are the spectrum.
    """
    import cvxpy as cp

    (cells, n, r, nu), V = D.shape, problem.criterion.columns
    X, price = cp.Variable(V.shape), cp.Variable(nonneg=True)
    values, vectors = np.linalg.eigh(problem.constant)
    root = (vectors * np.sqrt(np.clip(values, 0, None))).T
    gain: Any = 2 * cp.sum(cp.multiply(V, X)) - cp.sum_squares(root @ X) - limit * price
    bounded, constraints, Gamma = [], [], []
    for k in range(cells):
        most: Any = price * np.eye(nu)
        if C is not None:
            U = cp.Variable((nu, nu), hermitian=True)
            constraints.append(U >> 0)
            gain, most = gain - cp.real(cp.trace(C[k] @ U)), most + U
        if Y is not None:
            Gamma.append(cp.Variable((len(G[k]), len(G[k])), hermitian=True))
            constraints.append(Gamma[-1] >> 0)
            gain = gain - cp.real(cp.trace(Y[k] @ Gamma[-1]))
            most = most + G[k].conj().T @ Gamma[-1] @ G[k]
        flat = D[k].reshape(n, r * nu)
        E = cp.vstack(
            [
                cp.reshape(X[:, j] @ flat.real + 1j * (X[:, j] @ flat.imag), (r, nu), order="C")
                for j in range(V.shape[1])
            ]
        )
        H = cp.bmat([[most, E.H], [E, np.eye(r * V.shape[1])]])
        # In real numbers: the multiplier of a complex inequality does not come back whole.
        real, imaginary = cp.real(H), cp.imag(H)
        bounded.append(cp.bmat([[real, -imaginary], [imaginary, real]]) >> 0)
    best = cp.Problem(cp.Maximize(gain), [*constraints, *bounded])
    solve_cvxpy(best, 1e-9)
    lines = np.stack([_folded(np.asarray(b.dual_value), nu) for b in bounded])
    # More power is more information: the optimum is the largest multiple within the limits.
    most_used = float(np.einsum("kii->", lines).real) / limit
    if C is not None:
        most_used = max(most_used, float(_excess(lines, C).max()))
    if Y is not None:
        most_used = max(most_used, float(_excess(G @ lines @ G.conj().swapaxes(1, 2), Y).max()))
    return (
        np.asarray(X.value),
        lines / most_used,
        (
            np.stack([_positive(np.asarray(g.value)) for g in Gamma])
            if Gamma
            else np.zeros((cells, *2 * G.shape[1:2]), dtype=np.complex128)
        ),
    )


def checked_mask(mask: Mask, omega: NDArray[np.float64], size: int, name: str) -> NDArray[np.complex128]:
    """Values of a matrix mask.

    Parameters
    ----------
    mask : callable
        omega (K,) -> (K, size, size).
    omega : ndarray
        (K,) rad/sample.
    size : int
        Channels.
    name : str
        As in messages.

    Returns
    -------
    ndarray
        (K, size, size) Hermitian.

    Raises
    ------
    InputError
        If it is not Hermitian, not positive semidefinite, not finite or of another shape.
    """
    values = np.asarray(mask(omega), dtype=complex)
    wanted = (len(omega), size, size)
    if values.shape != wanted or not np.isfinite(values).all():
        raise InputError(
            f"the {name} has the shape {values.shape}; for this plant it must be finite and {wanted}: "
            "(frequencies, channels, channels)."
        )
    scale = max(float(np.abs(values).max()), 1e-300)
    skew = np.abs(values - values.conj().swapaxes(1, 2)).max(axis=(1, 2))
    if skew.max() > 1e-9 * scale:
        at = omega[int(np.argmax(skew))]
        raise InputError(
            f"the {name} is not Hermitian at {at:.6g} rad/sample (by {skew.max():g}); a bound on a spectrum must be: "
            "make every entry the conjugate of its transpose's, as (C + C^H) / 2 is."
        )
    lowest = np.linalg.eigvalsh(values)[:, 0]
    if lowest.min() < -1e-9 * scale:
        at = omega[int(np.argmin(lowest))]
        raise InputError(
            f"the {name} has the negative eigenvalue {lowest.min():g} at {at:.6g} rad/sample; no spectrum lies below it: "
            "make it positive semidefinite."
        )
    return values


def _folded(Z: NDArray, nu: int) -> NDArray[np.complex128]:
    """The leading block (nu, nu) of the complex matrix whose real form is Z."""
    half = len(Z) // 2
    Z = (Z + Z.T) / 2
    top, bottom, cross = Z[:nu, :nu], Z[half : half + nu, half : half + nu], Z[half : half + nu, :nu]
    return _positive(top + bottom + 1j * (cross - cross.T))


def _positive(matrix: NDArray) -> NDArray[np.complex128]:
    values, vectors = np.linalg.eigh((matrix + matrix.conj().T) / 2)
    return (vectors * np.clip(values, 0, None)) @ vectors.conj().T


def _root(matrices: NDArray) -> NDArray[np.complex128]:
    values, vectors = np.linalg.eigh(matrices)
    root = (vectors * np.sqrt(np.clip(values, 0, None))[:, None, :]) @ vectors.conj().swapaxes(1, 2)
    return np.asarray(root, dtype=np.complex128)


def _clipped(p: NDArray, C: NDArray | None) -> NDArray[np.complex128]:
    """The nearest line within 0 and its mask, up to the solver's accuracy."""
    p = _positive(p)
    if C is None:
        return p
    return np.asarray(p / max(1.0, float(_excess(p[None], C[None])[0])), dtype=np.complex128)


def _excess(P: NDArray, C: NDArray) -> NDArray[np.float64]:
    """The least factor f with P <= f C, per line; a floor keeps singular masks invertible."""
    values, vectors = np.linalg.eigh(C)
    root = vectors / np.sqrt(np.maximum(values, 1e-12 * values[:, -1:] + 1e-300))[:, None, :]
    return np.asarray(np.linalg.eigvalsh(root.conj().swapaxes(1, 2) @ P @ root)[:, -1], dtype=np.float64)


def _most(
    S: NDArray, G: NDArray, C: NDArray | None, Y: NDArray | None, Gamma: NDArray, limit: float
) -> tuple[float, float]:
    """Least h over the price of power, and that price."""
    from scipy.optimize import minimize_scalar

    rest = S - G.conj().swapaxes(1, 2) @ Gamma @ G
    # The power limit is itself a mask: no line has more than all of it.
    root = np.sqrt(limit) * np.eye(S.shape[1])[None] if C is None else _root(C)
    fixed = 0.0 if Y is None else float(np.einsum("kij,kji->", Y, Gamma).real)
    turned, square = root @ rest @ root, root @ root

    def h(price: float) -> float:
        return (
            price * limit + fixed + float(np.clip(np.linalg.eigvalsh(turned - price * square), 0, None).sum())
        )

    top = max(float(np.linalg.eigvalsh(rest)[:, -1].max()), 1e-300)
    found = minimize_scalar(h, bounds=(0.0, top), method="bounded", options={"xatol": 1e-12 * top})
    candidates = [(h(x), x) for x in (0.0, float(found.x), top)]
    return min(candidates)
