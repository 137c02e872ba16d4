"""Where the search begins: several models got by linear algebra alone, so that the best optimum is the global one.

1. A high-order ARX model by least squares, from correlations (Ljung 1999, section 10.1).
2. From it, by weighted null-space fitting (Galrinho, Rojas, Hjalmarsson 2019, IEEE TAC 64(7)), the entry
   B / F: with G = B_n / A_n of high order, F B_n - B A_n = 0 is linear in the coefficients of B and F.
3. Steiglitz-McBride iterations on the data (1965): least squares of F y = B u on data filtered by 1 / F.
4. The noise model by two-stage least squares (Hannan, Rissanen 1982)."""

from collections.abc import Iterable, Sequence

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.linalg.lapack import dposv, dpotrf, dtrtrs

from estimators.residual.algebra import stable

Signals = list[tuple[NDArray[np.float64], NDArray[np.float64]]]
"""One (y (N,), u (N, nu)) per record; the inputs are already delayed."""


def filtered(b: ArrayLike, a: ArrayLike, x: NDArray) -> NDArray:
    """x filtered by b / a from rest, along the last axis."""
    from scipy.signal import lfilter

    return np.asarray(lfilter(b, a, x))


def reflected(tail: NDArray, most: float = 0.999, mirror: bool = True) -> NDArray:
    """A monic polynomial with its unstable roots mirrored into the unit circle."""
    tail = np.array(tail, dtype=float)
    if stable(tail / most ** np.arange(1, len(tail) + 1)):
        return tail
    roots = np.roots(np.concatenate([[1.0], tail])).astype(complex)
    size = np.abs(roots)
    out = size > 1
    if mirror:
        roots[out] = 1 / np.conj(roots[out])
    size = np.abs(roots)
    roots = np.where(size > most, roots * (most / np.maximum(size, 1e-300)), roots)
    mirrored = np.real(np.poly(roots))[1:]
    return np.concatenate([mirrored, np.zeros(len(tail) - len(mirrored))])


def lagged_gram(channels: Iterable[NDArray], lags: int) -> NDArray[np.float64]:
    """Sums over t of x_c(t - i) x_d(t - j) with zeros before the record, in O(N lags) by the shift structure."""
    records = list(channels)
    width = records[0].shape[1]
    gap = np.zeros((lags, width))
    joined = np.ascontiguousarray(np.concatenate([part for x in records for part in (x, gap)]).T)
    tails = np.zeros((len(records), width, lags))
    for tail, x in zip(tails, records, strict=True):
        last = x[::-1][:lags]
        tail[:, : len(last)] = last.T
    gram = -np.einsum("rci,rdj->cidj", tails, tails)
    length, total = joined.shape[1], np.zeros((width, lags, width, lags))
    for c in range(width):
        for d in range(width):  # sum_t x_c(t - k) x_d(t) for every lag k
            total[c, :, d, 0] = np.correlate(joined[d], joined[c, : length - lags + 1])
            total[d, 0, c, :] = total[c, :, d, 0]
    for i in range(1, lags):
        total[:, i, :, 1:] = total[:, i - 1, :, :-1] + gram[:, i - 1, :, :-1]
    return total


def high_order(gram: NDArray, order: int, lead: int) -> tuple[NDArray, list[NDArray], NDArray]:
    """ARX model of high order: A y = sum_j B_j u_j, all of `order` coefficients; returns (order,)."""
    width, lags = gram.shape[:2]
    flat = gram.reshape(width * lags, width * lags)
    index = [k + 1 for k in range(order)]
    for c in range(1, width):
        index += [c * lags + k + 1 - lead for k in range(order)]
    precision = flat[np.ix_(index, index)].copy()
    size = np.sqrt(np.maximum(np.diag(precision), np.finfo(float).tiny))
    inverse = np.linalg.inv(precision / np.outer(size, size) + 1e-10 * np.eye(len(size)))
    covariance = inverse / np.outer(size, size)
    parts = np.split(covariance @ flat[index, 0], width)
    return -parts[0], parts[1:], covariance


def null_space_fit(
    A: NDArray, B: NDArray, covariance: NDArray, nb: int, nf: int, iterations: int = 3
) -> tuple[NDArray, NDArray]:
    """B / F of low order from a high-order pair, by weighted null-space fitting: A, B (n,), covariance (2n,
    2n) -> (nb,)."""
    n = len(B)
    full = np.concatenate([[1.0], A])[:n]
    shifted = lambda x, k: np.concatenate([np.zeros(min(k, n)), x[: max(n - k, 0)]])
    # B = design (b, f)
    design = np.column_stack(
        [shifted(full, k) for k in range(nb)] + [-shifted(B, k) for k in range(1, nf + 1)]
    )
    system = np.column_stack([design, B])
    theta = np.linalg.lstsq(design, B, rcond=None)[0]
    for _ in range(iterations):
        b, f = theta[:nb], reflected(theta[nb:])
        # The slope of F B - B_low A in (-A, B), the order of the regression: two Toeplitz blocks, diagonal by diagonal.
        slope = np.zeros((n, 2 * n))
        for k, c in enumerate(b[: n - 1], 1):
            slope.flat[2 * n * k :: 2 * n + 1] = c
        for k, c in enumerate([1.0, *f][:n]):
            slope.flat[2 * n * k + n :: 2 * n + 1] = c
        spread = slope @ covariance @ slope.T
        spread.flat[:: n + 1] += 1e-12 * spread.trace() / n
        factor, failed = dpotrf(spread, lower=1)
        if failed:
            break
        whitened = dtrtrs(factor, system, lower=1)[0]
        theta = np.linalg.lstsq(whitened[:, :-1], whitened[:, -1], rcond=None)[0]
    return theta[:nb], reflected(theta[nb:])


def low_order_fits(
    gram: NDArray, order: int, nb: Sequence[int], nf: Sequence[int]
) -> tuple[list[NDArray], list[NDArray]]:
    """B / F of every input from one long ARX model, by weighted null-space fitting: returns (nb,)."""
    A, B, spread = high_order(gram, order, 1)
    bs, fs = [], []
    for j, (b_long, n_b, n_f) in enumerate(zip(B, nb, nf, strict=True)):
        at = np.r_[0:order, (j + 1) * order : (j + 2) * order]
        b, f = null_space_fit(A, b_long, spread[np.ix_(at, at)], n_b, n_f)
        bs.append(b)
        fs.append(f)
    return bs, fs


def steiglitz_mcbride(signals: Signals, nb: int, f: NDArray, iterations: int = 10) -> tuple[NDArray, NDArray]:
    """Least squares of F y = B u on data filtered by 1 / F, repeated; one input; signals (y, u), f (nf,) ->
    (nb,)."""
    nf, longest = len(f), max(len(y) for y, _ in signals)
    seen = np.zeros((len(signals), longest))
    both = np.zeros((2, len(signals), longest))
    for r, (y, u) in enumerate(signals):
        seen[r, : len(y)], both[0, r, : len(y)], both[1, r, : len(y)] = 1.0, y, u[:, 0]
    b = np.zeros(nb)
    columns = np.zeros((nb + nf, len(signals), longest))
    for _ in range(iterations):
        shaped = filtered([1.0], np.concatenate([[1.0], f]), both) * seen
        for k in range(nb):
            columns[k, :, k:] = shaped[1, :, : longest - k]
        for k in range(nf):
            columns[nb + k, :, k + 1 :] = -shaped[0, :, : longest - k - 1]
        flat = (columns * seen).reshape(nb + nf, -1)
        with np.errstate(over="ignore", invalid="ignore"):  # of far too many orders; the next line looks
            gram, right = flat @ flat.T, flat @ shaped[0].ravel()
        if not np.isfinite(gram).all():
            break
        _, theta, failed = dposv(gram, right)
        if failed:
            theta = np.linalg.lstsq(gram, right, rcond=1e-13)[0]
        before, b, f = f, theta[:nb], reflected(theta[nb:])
        if np.abs(f - before).max(initial=0.0) < 1e-4:
            break
    return b, f


def _least_squares(blocks: list[tuple[list[NDArray], NDArray]]) -> NDArray:
    gram, right = 0.0, 0.0
    for columns, target in blocks:
        x = np.column_stack(columns)
        gram, right = gram + x.T @ x, right + x.T @ target
    return np.linalg.lstsq(np.atleast_2d(gram), np.atleast_1d(right), rcond=1e-13)[0]


def _delayed(x: NDArray, k: int) -> NDArray:
    return np.concatenate([np.zeros(min(k, len(x))), x[: max(len(x) - k, 0)]])


def arma_start(noise: list[NDArray], nc: int, nd: int, order: int = 30) -> tuple[NDArray, NDArray]:
    """C and D of D v = C e by two-stage least squares: returns (nc,)."""
    if not nc + nd:
        return np.zeros(0), np.zeros(0)
    order = max(1, min(order, min(map(len, noise)) // 4))
    long_ar, _, _ = high_order(lagged_gram((v[:, None] for v in noise), order + 1), order, 1)
    white = [filtered(np.concatenate([[1.0], long_ar]), [1.0], v) for v in noise]
    theta = _least_squares(
        [
            ([-_delayed(v, k + 1) for k in range(nd)] + [_delayed(e, k + 1) for k in range(nc)], v)
            for v, e in zip(noise, white, strict=True)
        ]
    )
    return reflected(theta[nd:], 0.98), reflected(theta[:nd], 0.98)


def armax_start(
    signals: Signals, na: int, nb: list[int], nc: int, order: int, rounds: int = 4
) -> list[NDArray[np.float64]]:
    """A, B, C of A y = B u + C e by extended least squares, its residuals first those of a long ARX model:
    signals (y, u)."""
    channels = [np.column_stack([y, u]) for y, u in signals]
    A, B, _ = high_order(lagged_gram(channels, order + 1), order, 1)
    long_a = np.concatenate([[1.0], A])
    white = [
        filtered(long_a, [1.0], y) - sum((filtered(b, [1.0], u[:, j]) for j, b in enumerate(B)), 0 * y)
        for y, u in signals
    ]
    found = []
    for _ in range(rounds):
        blocks = []
        for (y, u), e in zip(signals, white, strict=True):
            columns = [-_delayed(y, k + 1) for k in range(na)]
            columns += [_delayed(u[:, j], k) for j, count in enumerate(nb) for k in range(count)]
            blocks.append((columns + [_delayed(e, k + 1) for k in range(nc)], y))
        theta = _least_squares(blocks)
        theta[len(theta) - nc :] = reflected(theta[len(theta) - nc :], 0.98)
        found.append(theta)
        a, c = np.concatenate([[1.0], theta[:na]]), np.concatenate([[1.0], theta[len(theta) - nc :]])
        white = []
        for y, u in signals:
            v, at = filtered(a, [1.0], y), na
            for j, count in enumerate(nb):
                v = v - filtered(theta[at : at + count], [1.0], u[:, j]) if count else v
                at += count
            white.append(filtered([1.0], c, v))
    return found
