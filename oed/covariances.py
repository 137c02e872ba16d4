"""V' M^-1 V for information matrices that may be badly scaled or singular, and errors from few pieces. Numpy and scipy only.

And algebra of this size on one thread: waking the BLAS's others takes longer than the algebra does."""

from collections.abc import Callable
from functools import cache, wraps
from typing import Any, ParamSpec, TypeVar

import numpy as np
from numpy.typing import NDArray

P = ParamSpec("P")
T = TypeVar("T")

NORMAL = 1.959964
"""Two-sided 95 % of a normal deviate."""
OUTSIDE = 1e-9
"""Share of what is asked for beside the range of an information, told by its factor, up to which it is determined: lines lie where
they should to about 1e-11; with 1e-6 a pole that two lines did not tell had a loss 3e-5 below the truth."""
OUTSIDE_SQUARED = 1e-6
"""The same where only the information itself is there: double precision has its range to about that."""
ROUNDED_OFF = 1e-14
"""Eigenvalue of a matrix of unit diagonal over the largest below which it is rounding."""
HARDLY = 1e-12
"""Singular value of a factor over the largest below which a part of V' theta of rounding's size says nothing."""


def square_root(matrix: NDArray) -> NDArray:
    """R with R R^* = a positive semidefinite matrix, or each of a stack; what rounding leaves below 0 is cut off."""
    values, vectors = np.linalg.eigh(matrix)
    return vectors * np.sqrt(np.clip(values, 0, None))[..., None, :]


def root_in_own_units(matrix: NDArray[np.float64]) -> tuple[NDArray[np.float64], float]:
    """R (n, s) with R R' = a symmetric matrix, and its least eigenvalue over the largest; in units of its own diagonal, so that
    small entries keep their digits beside large ones."""
    scale = np.sqrt(np.abs(np.diag(matrix)))
    scale = np.where(scale > 0, scale, 1.0)
    values, vectors = np.linalg.eigh(matrix / np.outer(scale, scale))
    keep = values > ROUNDED_OFF * values[-1]
    root = scale[:, None] * vectors[:, keep] * np.sqrt(values[keep])
    return root, float(values[0] / values[-1]) if values[-1] > 0 else -np.inf


def solved_below(R: NDArray[np.float64], B: NDArray, finely: bool = False) -> NDArray[np.float64]:
    """R'^-1 B for an upper triangle R (n, n) and a real B (n, s); finely: in extended precision, rounded once at the
    end, for triangles so ill conditioned that rounding on the way would tell."""
    if not finely:
        from scipy.linalg import solve_triangular

        return np.asarray(solve_triangular(R, B, trans=1), dtype=np.float64)
    X, wide = np.array(B, dtype=np.longdouble), R.astype(np.longdouble)
    for i in range(len(R)):
        X[i] = (X[i] - wide[:i, i] @ X[:i]) / wide[i, i]
    return X.astype(np.float64)


def real_gram(F: NDArray) -> NDArray:
    """Re F F^* of a complex F (n, m): its real and imaginary parts side by side as one real factor, without a copy of either."""
    parts = np.ascontiguousarray(F).view(F.real.dtype)
    return parts @ parts.T


def of_few(error: float, freedom: float) -> float:
    """A standard error that is itself known from few pieces, as wide as it must be for 1.96 of it to hold in 95 % of
    cases: Student's quantile over the normal one."""
    from scipy.special import stdtrit

    return error * float(stdtrit(freedom, 0.975)) / NORMAL if freedom > 0 else float("nan")


def diagonal_blocks(matrix: NDArray[np.float64], count: int) -> NDArray[np.float64]:
    """Square blocks on the diagonal: matrix (K s, K s) -> (K, s, s)."""
    size = len(matrix) // count
    return np.einsum("kskt->kst", matrix.reshape(count, size, count, size))


def solved(M: NDArray[np.float64], V: NDArray[np.float64]) -> NDArray[np.float64]:
    """M^-1 V, scaled to a unit diagonal first: M (n, n), V (n, s) -> (n, s)."""
    from scipy.linalg import cho_factor, cho_solve

    scale = 1 / np.sqrt(np.diag(M))
    return scale[:, None] * cho_solve(cho_factor(M * np.outer(scale, scale)), scale[:, None] * V)


def covariance_of(M: NDArray[np.float64], V: NDArray[np.float64]) -> NDArray[np.float64] | None:
    """V' M^-1 V, or None where M does not determine V' theta: M (n, n), V (n, s) -> (s, s)."""
    if not np.isfinite(M).all():
        return None
    scale = _usable(np.sqrt(np.clip(np.diag(M), 0, None)), V)
    if scale is None:
        return None
    values, vectors = np.linalg.eigh(M / np.outer(scale, scale))
    root = np.sqrt(np.clip(values, 0, None))
    return _inverted(vectors.T @ (V / scale[:, None]), root, root <= 3e-7 * root.max(), OUTSIDE_SQUARED)


def covariance_of_factor(
    factor: NDArray[np.float64], V: NDArray[np.float64], alike: bool = False
) -> NDArray[np.float64] | None:
    """V' (F F')^-1 V from the factor itself, to the full precision; None where F F' does not determine V'
    theta. Every parameter is taken in units of what is known of it, but where they are `alike` in any spectrum."""
    if not np.isfinite(factor).all():
        return None
    scale = _usable(np.ones(len(factor)) if alike else np.linalg.norm(factor, axis=1), V)
    if scale is None:
        return None
    rows = factor / scale[:, None]
    if rows.shape[1] > 2 * len(rows):  # a triangle of few rows first: as exact, and an order faster
        rows = np.linalg.qr(rows.T, mode="r").T
    U, values, _ = np.linalg.svd(rows, full_matrices=True)
    root = np.concatenate([values, np.zeros(len(U) - len(values))])
    T, noise = U.T @ (V / scale[:, None]), len(U) * np.finfo(float).eps
    # A direction that is known a little may be most of what V' theta's variance is made of: only rounding is left out, be it
    # of the direction or, where it is hardly known, of what V' theta has of it.
    hardly = (root <= HARDLY * root.max()) & (np.linalg.norm(T, axis=1) <= 10 * noise * np.linalg.norm(T))
    return _inverted(T, root, hardly | (root <= noise * root.max()), OUTSIDE)


def _usable(scale: NDArray[np.float64], V: NDArray[np.float64]) -> NDArray[np.float64] | None:
    """The scale with 1 for parameters of which nothing is known; None where V needs one of those."""
    if np.any((scale <= 0) & np.any(V != 0, axis=1)):
        return None
    return np.where(scale > 0, scale, 1.0)


def _inverted(
    T: NDArray[np.float64], root: NDArray[np.float64], null: NDArray[np.bool_], outside: float
) -> NDArray[np.float64] | None:
    """T' root^-2 T without the null directions, T = U' V; None where V leaves the range."""
    if np.any(null):
        length = np.linalg.norm(T, axis=0)
        if np.any(np.linalg.norm(T[null], axis=0) > outside * length):
            return None
        root, T = root[~null], T[~null]
    half = T / root[:, None]
    return half.T @ half


@cache
def _libraries() -> Any:
    """What threadpoolctl knows of the BLAS of NumPy and of SciPy, which are two; both are loaded by then."""
    import numpy.linalg  # noqa: F401
    import scipy.linalg  # noqa: F401
    from threadpoolctl import ThreadpoolController

    return ThreadpoolController().select(user_api="blas")


def on_one_thread(verb: Callable[P, T]) -> Callable[P, T]:
    """The same function with the BLAS limited to one thread while it runs, and as it was afterwards."""

    @wraps(verb)
    def limited(*args: P.args, **kwargs: P.kwargs) -> T:
        with _libraries().limit(limits=1):
            return verb(*args, **kwargs)

    return limited
