"""The certificate of a design: a lower bound on the loss of every admissible spectrum, computed here.

For every X, loss(M) >= numerator(X) / trace(X' M X) (`oed.criteria`). For every spectrum within its budgets
and every nu >= 0, trace(X' M X) <= trace(X' M_0 X) + rho sum_j nu_j, where rho is the largest price

    rho = max_w largest eigenvalue of S(w) against Q_nu(w) = sum_j nu_j Q_j(w),  S(w) = D(w)^* X X' D(w),

by weak duality. So the pair (X, nu), wherever it came from, gives a bound; the solver's word is not needed."""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray


@dataclass(frozen=True, eq=False)
class Certificate:
    """Evidence that no admissible spectrum is better than `bound`.

    Attributes
    ----------
    X : ndarray
        (n, s) direction in the model's own parameters; Z = X X'. Doubles of parameters that double precision hardly tells
        apart prove the bound to fewer digits than the solver's coordinates did: to 1e-3 at a condition of 1e14.
    multipliers : dict
        Budget name -> nu_j, the loss of one unit (of the budget's limit) less.
    numerator : float
        numerator(X) of the criterion.
    value : float
        Largest trace(X' M X) over all admissible spectra, constant part included.
    bound : float
        numerator / value.
    largest_price : float
        rho before it was divided out: 1 + what the last refinement could not remove.
    frequency : float
        Where the largest price lies, rad/sample.
    price : callable
        omega (K,) -> largest eigenvalue of S against Q_nu, divided by rho: at most 1.
    outside : float
        Length of what the criterion asks for that lies outside the range of the reported information,
        relative: 0 where the information is nonsingular, rounding where a singular design is exact.
    elsewhere : float
        Of a design on a fixed grid: the largest price in the band beside the grid. Where it exceeds 1 the bound
        holds on the grid only, and a line at `elsewhere_frequency` lowers the loss.
    elsewhere_frequency : float
        Where that is, rad/sample.
    rounding : float
        How far rounding alone moves the loss, relative; the bound is no surer than that.
    """

    X: NDArray[np.float64]
    multipliers: dict[str, float]
    numerator: float
    value: float
    bound: float
    largest_price: float
    frequency: float
    price: Callable[[NDArray[np.float64]], NDArray[np.float64]]
    outside: float = 0.0
    elsewhere: float = 1.0
    elsewhere_frequency: float = float("nan")
    rounding: float = 0.0

    @property
    def Z(self) -> NDArray[np.float64]:
        """(n, n) supergradient direction X X'."""
        return self.X @ self.X.T

    def sensitivity(self, omega: ArrayLike) -> NDArray[np.float64]:
        """Price of a line at any frequency against what it costs: at most 1, and 1 at the support.

        Parameters
        ----------
        omega : array_like
            (K,) rad/sample.

        Returns
        -------
        ndarray
            (K,).
        """
        return self.price(np.atleast_1d(np.asarray(omega, dtype=float)))

    def check(self, low: float = 0.0, high: float = np.pi, points: int = 100_001) -> float:
        """Largest sensitivity on a fresh uniform grid that the solver never saw.

        Parameters
        ----------
        low, high : float
            Band in rad/sample.
        points : int
            How many frequencies.

        Returns
        -------
        float
            At most 1 where the certificate holds between its own grid lines too.
        """
        chunks = np.array_split(np.linspace(low, high, points), max(1, points // 5000))
        return float(max(self.sensitivity(chunk).max() for chunk in chunks))

    def __repr__(self) -> str:
        return (
            f"Certificate: every admissible spectrum has a loss of at least {self.bound:.12g} "
            f"(largest price 1{self.largest_price - 1:+.1e} at {self.frequency:.6g} rad/sample)"
        )
