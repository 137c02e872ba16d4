"""What the polynomials and the noise of a plant must be, and the sentences that say so."""

from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from oed.data import frozen
from oed.errors import CUBES, InputError, check_size


def polynomial(values: ArrayLike, name: str) -> NDArray[np.float64]:
    """Coefficients of a polynomial in z^-1, checked to be finite real numbers."""
    try:
        array = np.atleast_1d(np.array(values, dtype=float))
    except (TypeError, ValueError):
        raise InputError(
            f"{name} is {values!r}; give a list of real coefficients of powers of z^-1."
        ) from None
    if array.ndim != 1 or array.size == 0 or not np.isfinite(array).all():
        raise InputError(f"{name} is {values!r}; give a flat, non-empty list of finite coefficients.")
    return array


def matrix_of_polynomials(values: Any, name: str) -> list[list[NDArray[np.float64]]]:
    """num[i][j] as arrays; one flat list is read as a single entry."""
    if not isinstance(values, list | tuple | np.ndarray) or len(values) == 0:
        raise InputError(
            f"{name} is {values!r}; give a list of coefficients of powers of z^-1, or a row per output of such lists."
        )
    if not np.iterable(values[0]):
        values = [[values]]
    rows = [
        [polynomial(entry, f"{name}[{i}][{j}]") for j, entry in enumerate(row)]
        for i, row in enumerate(values)
    ]
    if not rows or len({len(row) for row in rows}) != 1 or not rows[0]:
        raise InputError(
            f"{name} has rows of {[len(row) for row in rows]} entries; "
            "it needs one row per output, each with one entry per input."
        )
    return rows


def scaled(p: NDArray[np.float64], lead: float, name: str) -> NDArray[np.float64]:
    """A polynomial divided by a leading coefficient, which may be too small for that."""
    with np.errstate(over="ignore"):
        scaled = p / lead
    if not np.isfinite(scaled).all():
        raise InputError(
            f"{name} begins with {float(lead)!r}, and coefficients divided by it are not finite; scale them."
        )
    return frozen(scaled)


def check_stable(den: NDArray[np.float64], name: str) -> None:
    """InputError where a denominator has a pole on or outside the unit circle."""
    poles = np.roots(den)
    if poles.size and np.abs(poles).max() >= 1:
        worst = poles[np.argmax(np.abs(poles))]
        raise InputError(
            f"{name} has a pole at z = {worst:.6g} with modulus {abs(worst):.6g}; the plant must be stable "
            "(all moduli below 1): stabilise it and give the closed loop, or experiment on the stable part."
        )


def check_covariance(covariance: NDArray[np.float64], ny: int) -> None:
    """InputError where the noise covariance is not a symmetric, positive semidefinite (ny, ny) matrix."""
    if covariance.shape != (ny, ny) or not np.isfinite(covariance).all():
        raise InputError(
            f"the noise covariance has shape {covariance.shape}; it must be a finite {ny} x {ny} matrix or one number."
        )
    scale = np.abs(covariance).max()
    if not np.allclose(covariance, covariance.T, atol=1e-12 * scale):
        raise InputError("the noise covariance is not symmetric; a covariance matrix must be.")
    lowest = float(np.linalg.eigvalsh(covariance).min())
    if lowest < -1e-12 * scale:
        what = "variance is" if ny == 1 else "covariance has the eigenvalue"
        raise InputError(f"the noise {what} {lowest:g}; it must be at least 0: check its sign.")


def check_sizes(
    num: list[list[NDArray[np.float64]]], covariance: NDArray[np.float64], noise_num: NDArray[np.float64]
) -> None:
    """InputError where gains or noise are such that their squares are no doubles."""
    largest = max(float(np.abs(entry).max()) for row in num for entry in row)
    if not largest:
        raise InputError(
            "every numerator coefficient is zero; a plant that does nothing has no gain to estimate."
        )
    check_size("the largest entry of num, divided by the leading coefficient of den,", largest, CUBES)
    check_size("the noise's largest standard deviation", float(np.abs(covariance).max()) ** 0.5, CUBES)
    check_size("the largest entry of the noise filter's num", float(np.abs(noise_num).max()), CUBES)
