"""Spectra of a given shape: combinations of fixed basis spectra (convex), and autoregressive ones (not convex).

Basis: Phi = sum_k x_k B_k with given densities B_k >= 0 and x_k >= 0. Every basis spectrum is one column of the
design problem, so the optimum has a certificate over all x; beside it stands the bound over all spectra.

Autoregressive: Phi = s / |A(e^jw)|^2. With free poles this is not convex, and without a limit on the poles the
best such spectrum degenerates into lines. Here the poles stay within a circle of radius rho < 1: A(z) = A_0(z / rho)
with A_0 by reflection coefficients tanh(x_i), which reach every stable polynomial. The result is the best of several
local searches; what it may lack is told by the certified bound over all spectra."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from oed.covariances import on_one_thread, square_root
from oed.criteria import Criterion
from oed.data import Spectrum
from oed.design.problem.budgets import power_budgets
from oed.design.problem.criteria_by_name import criterion_of
from oed.design.problem.information_maps import InformationMap, information_map
from oed.design.problem.lines import Columns, Problem
from oed.design.problem.white import information_nodes
from oed.design.solvers.column_generation import lower_bound, solve_weights
from oed.errors import InputError

Density = Callable[[NDArray[np.float64]], NDArray]


@dataclass(frozen=True, eq=False)
class Shaped:
    """The best spectrum of a shape. `spectrum` nodes of a quadrature that is exact for the information to
    about 1e-10; `coefficients` basis: (m,) power in each basis spectrum. Autoregressive: (p + 1,) A(z) in
    powers of z^-1, A[0] = 1; `loss` loss per sample at the stated power; `bound` no spectrum at all of this
    power has a smaller loss; `own_bound` no spectrum of this shape has a smaller loss; NaN where the search
    is local (autoregressive); `power` input power as the optimiser counts it; `kind` "basis" or "ar"."""

    spectrum: Spectrum
    coefficients: NDArray[np.float64]
    loss: float
    bound: float
    own_bound: float
    power: float
    kind: str

    @property
    def gap(self) -> float:
        """What the shape costs, certified: (loss - bound) / bound."""
        return (self.loss - self.bound) / self.bound

    def __repr__(self) -> str:
        return (
            f"{self.kind} spectrum of {len(self.coefficients)} numbers: loss {self.loss:.9g}, "
            f"at most {self.gap:.2%} above the optimum over all spectra"
        )


def band_basis(edges: ArrayLike) -> list[Density]:
    """Basis of flat bands of unit power each.

    Parameters
    ----------
    edges : array_like
        (m + 1,) increasing frequencies in [0, pi], rad/sample.

    Returns
    -------
    list of callable
        m densities.

    Raises
    ------
    InputError
        If the edges do not increase or leave [0, pi].
    """
    e = np.asarray(edges, dtype=float)
    if e.ndim != 1 or len(e) < 2 or not (np.diff(e) > 0).all() or e[0] < 0 or e[-1] > np.pi + 1e-12:
        raise InputError(f"the edges are {e.tolist()}; give increasing frequencies in [0, pi] rad/sample.")
    return [
        lambda w, low=low, high=high: ((w >= low) & (w < high)) * (np.pi / (high - low))
        for low, high in pairwise(e)
    ]


@on_one_thread
def basis_design(
    model: Any,
    criterion: str | Criterion = "D",
    basis: Sequence[Density] | None = None,
    *,
    input_power: float = 1.0,
    prior: ArrayLike | None = None,
) -> Shaped:
    """The best combination of given spectra, with certificates over the combinations and over all spectra.

    Parameters
    ----------
    model : Plant, Model or InformationMap
        What is to be identified.
    criterion : str or Criterion
        As for `solve_design`.
    basis : sequence of callable, optional
        omega (K,) -> density (K,) on one input, or (K, nu, nu) Hermitian positive semidefinite; two-sided, any
        scale: each is normalised to unit power. By default 20 flat bands.
    input_power : float
        Limit on the input power.
    prior : array_like, optional
        (n, n) information of experiments already done, per sample of the new one.

    Returns
    -------
    Shaped
        With `own_bound` and `bound`.

    Raises
    ------
    InputError
        If a density is negative, not Hermitian, not finite or without power.
    """
    from oed.design.solve import solve_design

    information = information_map(model)
    wanted = criterion_of(criterion, model, information)
    if prior is not None:
        information = information.with_prior(prior)
    budgets = power_budgets(information, input_power)
    given = band_basis(np.linspace(0, np.pi, 21)) if basis is None else list(basis)
    if not given:
        raise InputError("the basis is empty; give at least one density.")
    nu = information.n_inputs
    traces = lambda w: np.column_stack([_density(f, w, nu, k) for k, f in enumerate(given)])
    omega, weight = information_nodes(information, traces)
    B = np.stack([_normalised(f, omega, weight, nu, k) for k, f in enumerate(given)])
    problem = Problem(information, wanted, budgets, omega)
    D = problem.scaled_factor(omega)
    F = np.stack([_factor(D, P) for P in B * weight[:, None, None]]) * np.sqrt(input_power)
    columns = Columns(
        np.zeros(len(B)), np.full((len(B), nu), 1 / np.sqrt(nu), dtype=complex), F, np.ones((len(B), 1))
    )
    weights = solve_weights(problem, columns, None, 1e-12)
    w = weights.w / weights.w.sum()
    price = float(columns.prices(weights.X, weights.nu).max())
    own = lower_bound(problem, weights.X, weights.nu, price) * problem.scale
    spectrum = Spectrum(omega, np.einsum("m,mkqr->kqr", w * input_power, B) * weight[:, None, None])
    free = solve_design(information, wanted, input_power=input_power, tolerance=1e-6)
    loss = information.loss(wanted, spectrum)
    return Shaped(spectrum, w * input_power, loss, free.bound, own, float(w.sum()) * input_power, "basis")


def _density(function: Density, omega: NDArray, nu: int, k: int) -> NDArray[np.float64]:
    """Entries of a basis density at frequencies, real and imaginary parts side by side, checked: (K, 2 nu^2)."""
    values = np.asarray(function(omega), dtype=complex)
    values = values[:, None, None] * np.eye(1) if values.ndim == 1 and nu == 1 else values
    if values.shape != (len(omega), nu, nu) or not np.isfinite(values).all():
        raise InputError(
            f"basis density {k + 1} has the shape {values.shape}; it must be finite and {(len(omega), nu, nu)}."
        )
    scale = np.abs(values).max()
    if np.abs(values - values.conj().swapaxes(1, 2)).max() > 1e-9 * scale:
        raise InputError(f"basis density {k + 1} is not Hermitian; a spectrum must be.")
    if np.linalg.eigvalsh(values).min() < -1e-9 * scale:
        raise InputError(f"basis density {k + 1} is negative; a spectrum is positive semidefinite.")
    flat = values.reshape(len(omega), -1)
    return np.concatenate([flat.real, flat.imag], axis=1)


def _normalised(
    function: Density, omega: NDArray, weight: NDArray, nu: int, k: int
) -> NDArray[np.complex128]:
    """Values of a basis density, (K, nu, nu), of unit power."""
    real, imaginary = np.split(_density(function, omega, nu, k), 2, axis=1)
    values = (real + 1j * imaginary).reshape(-1, nu, nu)
    power = float(np.einsum("kii,k->", values, weight).real)
    if not power > 0:
        raise InputError(f"basis density {k + 1} is 0 everywhere; it has no power.")
    return values / power


def _factor(D: NDArray[np.complex128], P: NDArray[np.complex128]) -> NDArray[np.float64]:
    """Square root (n, n) of sum_k Re D P D^*."""
    M = np.einsum("knpq,kqr,kmpr->nm", D, P, D.conj(), optimize=True).real
    return square_root((M + M.T) / 2)


@on_one_thread
def autoregressive_design(
    model: Any,
    criterion: str | Criterion = "D",
    *,
    order: int = 4,
    radius: float = 0.98,
    input_power: float = 1.0,
) -> Shaped:
    """The best autoregressive spectrum whose poles stay within a circle.

    Parameters
    ----------
    model : Plant, Model or InformationMap
        One input.
    criterion : str or Criterion
        As for `solve_design`; not the worst of several (G).
    order : int
        Number of poles, at most 30.
    radius : float
        Largest modulus of a pole, below 1.
    input_power : float
        Limit on the input power.

    Returns
    -------
    Shaped
        The best of a few local searches, from white noise and from poles at the lines of the free optimum; the
        bound is that over all spectra.

    Raises
    ------
    InputError
        If the order or the radius breaks its rule, or the plant has several inputs.

    Notes
    -----
    Every stable A_0 is reached by reflection coefficients (Schur and Cohn). Twin: a fine grid over two poles.
    """
    from scipy.optimize import minimize

    from oed.design.solve import solve_design

    if int(order) != order or not 0 <= order <= 30:
        raise InputError(f"the order is {order}; it must be a whole number of 0 to 30.")
    if not 0 < radius < 1:
        raise InputError(f"the radius is {radius}; the poles of an autoregressive spectrum lie in (0, 1).")
    information = information_map(model)
    if information.n_inputs != 1:
        raise InputError(
            f"autoregressive spectra are for one input; the plant has {information.n_inputs}: use basis_design."
        )
    wanted = criterion_of(criterion, model, information)
    free = solve_design(information, wanted, input_power=input_power, tolerance=1e-6)
    omega, weight, flat, loss_of = _scaled_loss(information, wanted, radius, input_power)
    shape = lambda x: radius ** np.arange(order + 1) * step_up(np.tanh(x))

    def objective(x: NDArray) -> float:
        density = _density_of(shape(x), omega, weight)
        return float(np.log(loss_of(density @ flat)))

    starts = [np.zeros(order)]
    if order:
        for modulus in (0.6, 0.95):
            poles = _starting_poles(free.spectrum, order, modulus)
            starts.append(
                np.arctanh(
                    np.clip(step_down(np.asarray(np.poly(poles).real, dtype=np.float64)), -0.999, 0.999)
                )
            )
    # White noise has no coefficient to search for.
    found = [minimize(objective, x, method="L-BFGS-B", bounds=[(-9.0, 9.0)] * order) for x in starts if order]
    best = min(found, key=lambda one: float(one.fun)).x if found else np.zeros(0)
    A = shape(np.asarray(best, dtype=float))
    density = _density_of(A, omega, weight)
    spectrum = Spectrum(omega, density * weight * input_power)
    loss = information.loss(wanted, spectrum)
    power = input_power * float(weight @ density)
    return Shaped(spectrum, A, loss, free.bound, float("nan"), power, "ar")


def _scaled_loss(
    information: InformationMap, wanted: Criterion, radius: float, power: float
) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64], Callable[[NDArray], float]]:
    """Nodes, weights, flattened scaled atoms times their weights, and the scaled loss of their sum."""
    # No panel is wider than the distance of the spectrum's poles from the circle, wherever they are.
    omega, weight = information_nodes(information, width=1 - radius)
    problem = Problem(information, wanted, power_budgets(information, 1.0), omega)
    D = problem.scaled_factor(omega)[..., 0]
    atoms = np.einsum("knp,kmp->knm", D, D.conj(), optimize=True).real.reshape(len(omega), -1)
    constant, n = problem.constant, information.n
    return (
        omega,
        weight,
        atoms * (power * weight)[:, None],
        lambda total: problem.criterion.loss(total.reshape(n, n) + constant),
    )


def _density_of(A: NDArray, omega: NDArray, weight: NDArray) -> NDArray[np.float64]:
    """1 / |A|^2 of unit power."""
    density = 1 / np.abs(np.polyval(A[::-1], np.exp(-1j * omega))) ** 2
    return density / (weight @ density)


def _starting_poles(spectrum: Spectrum, order: int, modulus: float) -> NDArray[np.complex128]:
    """Poles at the strongest lines, pairs first, the rest near 0."""
    strongest = spectrum.omega[np.argsort(-spectrum.power[:, 0, 0].real)]
    poles: list[complex] = []
    for omega in strongest:
        pair = [modulus * np.exp(1j * omega), modulus * np.exp(-1j * omega)]
        own = pair[:1] if min(omega, np.pi - omega) < 1e-9 else pair
        if len(poles) + len(own) <= order:
            poles += own
    return np.array(poles + [0.0] * (order - len(poles)), dtype=complex)


def step_up(reflection: NDArray[np.float64]) -> NDArray[np.float64]:
    """Monic polynomial of reflection coefficients (Levinson's recursion)."""
    a = np.ones(1)
    for k in reflection:
        longer = np.append(a, 0.0)
        a = longer + k * longer[::-1]
    return a


def step_down(a: NDArray[np.float64]) -> NDArray[np.float64]:
    """Reflection coefficients of a monic polynomial: a (p + 1,) -> (p,)."""
    reflection = np.zeros(len(a) - 1)
    for i in range(len(a) - 1, 0, -1):
        k = a[i]
        reflection[i - 1] = k
        a = (a - k * a[::-1])[:i] / (1 - k**2)
    return reflection
