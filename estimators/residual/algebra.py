"""The algebra of a residual's correlations: noise filters, least squares, delayed columns, what a fit has taken, the spread left."""

from collections.abc import Callable, Iterable, Iterator, Sequence

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import svd as scipy_svd
from scipy.linalg.lapack import dpotrf, dpotrs

from oed.covariances import of_few

Parts = Sequence[NDArray[np.float64]]


def noise_filter(residuals: Parts, most: int | None = None) -> NDArray[np.float64]:
    """Autoregression that whitens a noise, its order chosen by Akaike's criterion: residuals (N,)."""
    total = sum(map(len, residuals))
    most = min(40, total // 20, min(map(len, residuals)) - 1) if most is None else most
    covariance = np.array(
        [sum(float(e[k:] @ e[: len(e) - k]) for e in residuals) for k in range(max(most, 0) + 1)]
    )
    if covariance[0] <= 0:
        return np.ones(1)
    fits = list(autoregressions(covariance / covariance[0]))
    return fits[int(np.argmin([total * np.log(v) + 2 * order for order, (_, v) in enumerate(fits)]))][0]


def autoregressions(covariance: NDArray[np.float64]) -> Iterator[tuple[NDArray[np.float64], float]]:
    """Whitening filter and variance of what it leaves, of every order from 0 on (Levinson), while they are stable: covariance (K,) of
    lags 0 to K - 1, 1 at lag 0."""
    a, variance = np.ones(1), 1.0
    yield a, variance
    for order in range(1, len(covariance)):
        reflection = -float(a @ covariance[order:0:-1]) / variance
        if not abs(reflection) < 1:
            return
        longer = np.append(a, 0.0)
        a = longer + reflection * longer[::-1]
        variance *= 1 - reflection**2
        yield a, variance


def bridged(y: NDArray, out: NDArray[np.bool_], keep: NDArray[np.bool_]) -> NDArray:
    """Samples (N,) with those that are `out` on lines between the nearest that count: what reads past outputs meets them there."""
    if out.any() and keep.any():
        y = np.where(out, np.interp(np.arange(len(y)), np.flatnonzero(keep), y[keep]), y)
    return y


def gapless(Y: NDArray) -> NDArray:
    """Signals (N, ny) with their missing samples on lines between their neighbours."""
    return np.column_stack([bridged(y, ~np.isfinite(y), np.isfinite(y)) for y in Y.T])


def stable(f: NDArray, limit: float = 1.0) -> bool:
    """Whether 1 + f1 z^-1 + ..., f (n,) without its leading 1, has all its roots inside the circle: all reflection coefficients below
    a limit."""
    from estimators.residual.root_kernels import inside

    return inside(f, limit)


SETTLED = 1e-6
"""Correction of a solution by its own residual, of the solution, up to which a root of the matrix bears it: the next correction
would be the square of it."""


def _corrected(H: NDArray, first: NDArray, left: Callable[[NDArray], NDArray]) -> NDArray | None:
    """Solution c of H c = `first` by a Cholesky root, corrected once by what it leaves; None where the root does not bear it."""
    root, failed = dpotrf(H)
    if failed:
        return None
    c, _ = dpotrs(root, first)
    more, _ = dpotrs(root, left(c))
    return c + more if more @ more <= SETTLED**2 * (c @ c) else None


def definite(A: NDArray, b: NDArray, rcond: float) -> NDArray:
    """Solution (n,) of a positive definite system A (n, n); where rounding leaves it none, of least squares (`rcond` as there)."""
    c = _corrected(A, b, lambda c: b - A @ c)
    return np.linalg.lstsq(A, b, rcond=rcond)[0] if c is None else c


def least_squares(X: NDArray, y: NDArray, rcond: float | None = None) -> NDArray:
    """Coefficients (m,) of columns X (N, m) by least squares for y (N,): by normal equations of unit columns and one correction, a
    tenth of the work of a decomposition of X, which is left to what these do not bear (`rcond` as there)."""
    H = X.T @ X
    size = np.sqrt(H.diagonal())
    if len(X) >= len(H) and size.min(initial=np.inf) > 0.0 and size.max(initial=0.0) < np.inf:
        left = lambda c: (X.T @ (y - X @ (c / size))) / size
        c = _corrected(H / size / size[:, None], (X.T @ y) / size, left)
        if c is not None:
            return c / size
    return decomposed(X, y, rcond)


def decomposed(X: NDArray, y: NDArray, rcond: float | None = None) -> NDArray:
    """The same by a decomposition of columns of like size: in their own units a constant beside an input of 1e-15 would be all
    there is."""
    size = powers_of_two(X, (0,))
    return np.linalg.lstsq(X / size, y, rcond=rcond)[0] / size


def powers_of_two(x: NDArray, axis: tuple[int, ...] | None = None) -> NDArray:
    """The power of two next to the largest value along axes; 1 where there is none."""
    top = np.max(np.abs(x), axis=axis, initial=0.0)
    return np.ldexp(1.0, np.frexp(np.where((top > 0) & (top < np.inf), top, 1.0))[1] - 1)


def unit(x: NDArray) -> NDArray:
    """A signal over the power of two next to its largest value: beside a constant, or squared, any unit is as good."""
    return x / powers_of_two(x)


def of_size_one(parts: Parts) -> list[NDArray]:
    """Signals (N,) over one power of two, next to the root of the sum of all their squares."""
    top = max(float(np.max(np.abs(x), initial=0.0)) for x in parts)
    if not 0 < top < np.inf:
        return list(parts)
    near = [x / 2.0 ** np.floor(np.log2(top)) for x in parts]  # whose squares are doubles
    return [x / 2.0 ** np.floor(0.5 * np.log2(sum(float(x @ x) for x in near))) for x in near]


def delayed(x: NDArray, lags: Iterable[int]) -> NDArray:
    """A signal at several lags: x (N, 1) -> (N, L)."""
    n, out = len(x), []
    for k in lags:
        column = np.zeros(n)
        if abs(k) < n:
            column[max(k, 0) : n + min(k, 0)] = x[max(-k, 0) : n - max(k, 0), 0]
        out.append(column)
    return np.column_stack(out)


def taken_up(
    per_output: list[list[NDArray]], sensitivity: Parts, weight: NDArray, influence: Parts | None
) -> list[list[NDArray]]:
    """What is left of the columns once the fit has taken its part: by least squares, or by the noise's
    influence; sensitivity (N, ny, n), weight (ny, ny), influence (N, ny, m)."""
    known = 0 if influence is None else influence[0].shape[2]
    cross = np.zeros((sensitivity[0].shape[2] - known, per_output[0][0].shape[1]))
    normal = np.zeros((len(cross), len(cross)))
    weighted = [np.einsum("tam,ab->tbm", j[:, :, known:], weight) for j in sensitivity]
    for r, (w, j) in enumerate(zip(weighted, sensitivity, strict=True)):
        normal += np.einsum("tam,tan->mn", w, j[:, :, known:])
        cross += np.sum([j[:, k, known:].T @ own[r] for k, own in enumerate(per_output)], axis=0)
    gain = inverse(normal) @ cross
    left = [
        [y - w[:, k] @ gain for y, w in zip(own, weighted, strict=True)] for k, own in enumerate(per_output)
    ]
    if influence is None:
        return left
    pull = sum(
        j[:, k, :known].T @ y for k, own in enumerate(left) for j, y in zip(sensitivity, own, strict=True)
    )
    return [
        [y + kappa[:, k] @ pull for y, kappa in zip(own, influence, strict=True)]
        for k, own in enumerate(left)
    ]


def spread_of(parts: Parts, per_output: list[list[NDArray]]) -> NDArray:
    """Covariance of columns times noise, sum_kl Y_k' Sigma_kl Y_l: parts (N, ny) -> (L, L). Noise k is white
    noise w_k filtered by 1 / A_k, the w correlated at equal times. A column against filtered noise is the
    column through the same filter, backwards in time, against w."""
    from scipy.signal import lfilter

    filters = [noise_filter([e[:, k] for e in parts]) for k in range(len(per_output))]
    white = [
        np.concatenate([np.asarray(lfilter(a, [1.0], e[:, k])) for e in parts]) for k, a in enumerate(filters)
    ]
    back = [
        np.concatenate([np.asarray(lfilter([1.0], a, y[::-1], axis=0))[::-1] for y in own])
        for a, own in zip(filters, per_output, strict=True)
    ]
    joint = np.cov(white, bias=True).reshape(len(white), len(white))
    total: NDArray | float = 0.0
    for k, one in enumerate(back):
        for m, other in enumerate(back):
            total = total + joint[k, m] * (one.T @ other)
    return np.asarray(total)


def inverse(matrix: NDArray) -> NDArray:
    """Pseudo-inverse of a positive semidefinite matrix in units that make its diagonal 1: matrix (n, n) ->
    (n, n)."""
    size = np.sqrt(np.maximum(np.diag(matrix), np.finfo(float).tiny))
    return np.linalg.pinv(matrix / np.outer(size, size), rcond=1e-12, hermitian=True) / np.outer(size, size)


NEAR = 3
"""Stretches that an error may last: with five blocks of four, as long as a block's own parameters act."""


def sum_error(off: NDArray[np.float64]) -> float:
    """Standard error of a sum of values off their mean, in the order of time (Bartlett's weights); no less than of independent ones."""
    m = len(off)
    own = float(off @ off)
    near = sum((1.0 - k / (NEAR + 1.0)) * float(off[k:] @ off[:-k]) for k in range(1, min(NEAR, m - 1) + 1))
    return float(np.sqrt(max(own, own + 2.0 * near) * m / max(m - 1, 1)))


INDEPENDENT = 8.0
"""Independent values for a degree of freedom of their own spread: 7 of squares of normal errors, whose kurtosis is 15 ((15 - 1) / 2), and
one for the memory, which is estimated too."""
FEWEST = 4.0
"""Degrees of freedom at least: a memory as long as the record's own is not told from it, and by fewer an interval would tell nothing (by
one, a measured heater's error was .66 within .011 to 39); of noises with memories of 1 to 2000 samples as many hold with it as without."""


def mean_error(series: NDArray[np.float64]) -> float:
    """Standard error of the mean of a series with memory, in the order of time, as wide as it must be for 1.96 of it to hold in 95 %."""
    off = series - series.mean()
    size = float(np.max(np.abs(off)))
    if not size:
        return 0.0
    off = off / size
    noise = noise_filter([off])
    white = np.convolve(off, noise)[: len(off)]
    own = float(off @ off)
    spread = max(own, float(white @ white) / float(noise.sum()) ** 2)
    freedom = max(FEWEST, len(off) * own / spread / INDEPENDENT)
    return size * of_few(float(np.sqrt(spread)) / len(off), freedom)


def thin_svd(
    matrix: NDArray[np.float64],
) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]]:
    """U, singular values and V' of a matrix; by LAPACK's slower routine where the faster one gives up, as it does on some finite
    matrices with many rows that depend on the others: 940 samples of steps, their lags and what a model makes of them."""
    try:
        return np.linalg.svd(matrix, full_matrices=False)
    except np.linalg.LinAlgError:
        return scipy_svd(matrix, full_matrices=False, lapack_driver="gesvd")
