"""What a rig's test error is held against: the best linear model, a black box, and the true structure fitted to the training record."""

from __future__ import annotations

from collections.abc import Callable
from itertools import combinations_with_replacement

import numpy as np
from scipy.optimize import least_squares, minimize
from scipy.signal import lfilter
from sklearn.ensemble import GradientBoostingRegressor

ORDERS, DELAYED_ORDERS = range(1, 7), range(1, 4)
VALIDATION = 0.3  # last part of the training record on which the black box is chosen by free run
POLYNOMIALS = [(2, 2, 16), (2, 3, 16), (2, 3, 30), (4, 2, 16), (4, 3, 16), (4, 3, 30)]  # lags, degree, terms
TREE_LAGS = [2, 4]
WINDOWS = (0.12, 0.35, 1.0)  # growing parts of train on which the true structure is fitted
CLOSE = 1.15  # mean square of the residual over the noise at which a fit of the true structure has arrived


def rms(x: np.ndarray) -> float:
    return float(np.sqrt(np.mean(np.square(x))))


# -- output-error models ------------------------------------------------------------------------------------------------------------


def split(theta: np.ndarray, n: int, channels: int) -> tuple[np.ndarray, np.ndarray, float]:
    """(numerators (channels, n), denominator (n + 1,), offset)."""
    return theta[: n * channels].reshape(channels, n), np.r_[1.0, theta[n * channels : -1]], theta[-1]


def lagged(x: np.ndarray, by: int) -> np.ndarray:
    return np.r_[np.zeros(by), x[: len(x) - by]]


def output_error(theta: np.ndarray, u: np.ndarray, n: int, nk: int) -> np.ndarray:
    b, f, c = split(theta, n, u.shape[1])
    return c + sum(lfilter(np.r_[np.zeros(nk), row], f, u[:, j]) for j, row in enumerate(b))


def slopes(theta: np.ndarray, u: np.ndarray, n: int, nk: int) -> np.ndarray:
    _, f, c = split(theta, n, u.shape[1])
    filtered = [lfilter([1.0], f, u[:, j]) for j in range(u.shape[1])]
    back = lfilter([1.0], f, output_error(theta, u, n, nk) - c)
    columns = [lagged(x, nk + i) for x in filtered for i in range(n)] + [
        -lagged(back, i + 1) for i in range(n)
    ]
    return np.column_stack([*columns, np.ones(len(u))])


def stabilised(f: np.ndarray) -> np.ndarray:
    roots = np.roots(f).astype(complex)
    size = np.abs(roots)
    roots[size > 0.999] /= size[size > 0.999] * np.maximum(size[size > 0.999], 1.001)
    return np.real(np.poly(roots))


def first_guess(u: np.ndarray, y: np.ndarray, n: int, nk: int) -> np.ndarray:
    """Iterated least squares on filtered signals (Steiglitz and McBride), the best of 12."""
    m, f, best = u.shape[1], np.r_[1.0, np.zeros(n)], (np.inf, np.zeros((u.shape[1] + 1) * n + 1))
    for _ in range(12):
        uf, yf, one = lfilter([1.0], f, u, axis=0), lfilter([1.0], f, y), lfilter([1.0], f, np.ones(len(y)))
        columns = (
            [lagged(uf[:, j], nk + i) for j in range(m) for i in range(n)]
            + [-lagged(yf, i + 1) for i in range(n)]
            + [one]
        )
        found = np.linalg.lstsq(np.column_stack(columns)[n + nk :], yf[n + nk :], rcond=None)[0]
        f = stabilised(np.r_[1.0, found[m * n : -1]])
        theta = np.r_[found[: m * n], f[1:], found[-1]]
        theta[-1] += np.mean(y - output_error(theta, u, n, nk))
        best = min(
            best, (float(np.sum((y - output_error(theta, u, n, nk)) ** 2)), theta), key=lambda pair: pair[0]
        )
    return best[1]


def descend(theta: np.ndarray, u: np.ndarray, y: np.ndarray, n: int, nk: int) -> tuple[np.ndarray, float]:
    """Levenberg-Marquardt; a step to an unstable model is no step."""
    e = y - output_error(theta, u, n, nk)
    cost, damping = e @ e, 1e-3
    for _ in range(40):
        J = slopes(theta, u, n, nk)
        H, gradient, gained = J.T @ J, J.T @ e, 0.0
        for _ in range(7):
            trial = theta + np.linalg.solve(H + damping * np.diag(np.diag(H) + 1e-12), gradient)
            if np.max(np.abs(np.roots(split(trial, n, u.shape[1])[1]))) < 0.9997:
                residual = y - output_error(trial, u, n, nk)
                if residual @ residual < cost:
                    gained, theta, e, cost = (
                        1 - residual @ residual / cost,
                        trial,
                        residual,
                        residual @ residual,
                    )
                    break
            damping *= 7
        damping = max(damping / 9, 1e-10)
        if gained < 1e-7:
            break
    return theta, float(cost)


def best_linear(
    u: np.ndarray, y: np.ndarray, ut: np.ndarray, delays: tuple[int, ...]
) -> tuple[np.ndarray, list[dict]]:
    """Simulation of test by the output-error model with the smallest BIC on train, for each output; both start at rest."""
    predicted, notes = [], []
    scale, N = np.maximum(u.std(0), 1e-12), len(y)
    v, vt = (u - u[0]) / scale, (ut - u[0]) / scale
    for column in y.T:
        middle, spread = column.mean(), column.std()
        fits = []
        for nk in delays:
            for n in ORDERS if nk == 1 else DELAYED_ORDERS:
                theta, cost = descend(first_guess(v, z := (column - middle) / spread, n, nk), v, z, n, nk)
                fits.append((N * np.log(cost / N) + len(theta) * np.log(N), n, nk, theta, cost))
        _, n, nk, theta, cost = min(fits, key=lambda fit: fit[0])
        predicted.append(middle + spread * output_error(theta, vt, n, nk))
        notes.append({"order": n, "nk": nk, "train": float(spread * np.sqrt(cost / N))})
    return np.column_stack(predicted), notes


# -- black boxes --------------------------------------------------------------------------------------------------------------------


def regressors(u: np.ndarray, y: np.ndarray, lags: int, nk: int) -> tuple[np.ndarray, np.ndarray, int]:
    first = lags + nk - 1
    past = [y[first - i : len(y) - i] for i in range(1, lags + 1)]
    past += [u[first - i : len(u) - i, j] for j in range(u.shape[1]) for i in range(nk, nk + lags)]
    return np.column_stack(past), y[first:], first


Step = Callable[[np.ndarray], float]


def polynomial(u: np.ndarray, y: np.ndarray, lags: int, degree: int, terms: int, nk: int) -> Step:
    """Monomials of the regressors, the linear ones first, then by orthogonal forward selection."""
    X, target, _ = regressors(u, y, lags, nk)
    middle, spread = X.mean(0), X.std(0) + 1e-12
    Z = np.column_stack(
        [np.ones(len(X)), (X - middle) / spread]
    )  # column 0: the constant pads short products
    d = Z.shape[1]
    near = [*range(1, min(lags, 2) + 1), *range(lags + 1, d, lags)]
    index = [(0, 0, i) for i in range(d)] + [
        (0, i, j) for i, j in combinations_with_replacement(range(1, d), 2)
    ]
    index = np.array(index + (list(combinations_with_replacement(near, 3)) if degree > 2 else []))
    P = Z[:, index].prod(2)
    chosen, size = list(range(d)), (P**2).sum(0)
    Q = np.linalg.qr(P[:, :d])[0]
    left, W = target - Q @ (Q.T @ target), P - Q @ (Q.T @ P)
    while len(chosen) < terms:
        power = (W**2).sum(0)
        gain = np.where(power > 1e-8 * size, (W.T @ left) ** 2 / np.maximum(power, 1e-12), 0)
        gain[chosen] = 0
        chosen.append(int(np.argmax(gain)))
        q = W[:, chosen[-1]] / np.sqrt(max(power[chosen[-1]], 1e-12))
        left, W = left - q * (q @ left), W - np.outer(q, q @ W)
    weights, index = np.linalg.lstsq(P[:, chosen], target, rcond=None)[0], index[chosen]
    padded = np.ones(d)

    def step(x):
        padded[1:] = (x - middle) / spread
        return float(weights @ padded[index].prod(1))

    return step


def boosted(u: np.ndarray, y: np.ndarray, lags: int, nk: int, seed: int) -> Step:
    """Least squares, and boosted trees on what it leaves."""
    X, target, _ = regressors(u, y, lags, nk)
    weights = np.linalg.lstsq(np.column_stack([np.ones(len(X)), X]), target, rcond=None)[0]
    trees = GradientBoostingRegressor(
        n_estimators=100, max_depth=4, learning_rate=0.1, subsample=0.7, min_samples_leaf=8, random_state=seed
    )
    trees.fit(X, target - weights[0] - X @ weights[1:])
    return lambda x: float(weights[0] + weights[1:] @ x + trees.predict(x[None])[0])


def free_run(
    step: Step, u: np.ndarray, y: np.ndarray, lags: int, nk: int, limits: tuple[float, float]
) -> np.ndarray:
    """Simulation from the first measured outputs."""
    first, out = lags + nk - 1, y.copy()
    for k in range(first, len(u)):
        past = [
            out[k - lags : k][::-1],
            *(u[k - nk - lags + 1 : k - nk + 1, j][::-1] for j in range(u.shape[1])),
        ]
        out[k] = min(max(step(np.concatenate(past)), limits[0]), limits[1])
    return out


def black_box(u, y, ut, yt, delays: tuple[int, ...], seed: int) -> tuple[np.ndarray, list[dict]]:
    """Polynomial or boosted trees, whichever runs freely with the smaller error over the last part of train; refitted on all of it."""
    outputs, notes = [], []
    cut = int((1 - VALIDATION) * len(u))
    nks = delays[:: max(1, len(delays) // 3)][:3]
    for y1, yt1 in zip(y.T, yt.T):
        reach = np.ptp(y1)
        limits = (y1.min() - 0.6 * reach, y1.max() + 0.6 * reach)
        makers = {
            ("poly", L, nk, d, t): lambda a, b, L=L, d=d, t=t, nk=nk: polynomial(a, b, L, d, t, nk)
            for L, d, t in POLYNOMIALS
            for nk in nks
        }
        makers |= {
            ("tree", L, nk): lambda a, b, L=L, nk=nk: boosted(a, b, L, nk, seed)
            for L in TREE_LAGS
            for nk in nks[:2]
        }
        errors = {}
        for key, make in makers.items():
            errors[key] = rms(
                free_run(make(u[:cut], y1[:cut]), u[cut:], y1[cut:], key[1], key[2], limits) - y1[cut:]
            )
        best = min(errors, key=lambda key: errors[key])
        run = free_run(makers[best](u, y1), ut, yt1, best[1], best[2], limits)
        outputs.append(run)
        notes.append(
            {"kind": best[0], "lags": best[1], "nk": best[2], "valid": errors[best], "test": rms(run - yt1)}
        )
    return np.column_stack(outputs), notes


# -- the true structure -------------------------------------------------------------------------------------------------------------


def fitted(
    simulate: Callable[[np.ndarray, int], np.ndarray],
    y: np.ndarray,
    sigma: np.ndarray,
    free: int,
    g: np.random.Generator,
    coarse: bool,
) -> tuple[np.ndarray, float]:
    """Factors of the free parameters that fit train, from starts 20, 10 and 5 % away; and the fit's error over the noise.

    Over growing parts of the record: where contacts or limits are reached at other times, errors far on say nothing of the parameters.
    """
    best = None

    def residual(factors, rows):
        with np.errstate(all="ignore"):
            e = (y[:rows] - simulate(factors, rows)) / sigma
        return np.clip(np.nan_to_num(e.ravel(), nan=1e4), -1e4, 1e4)

    for spread in (0.2, 0.1, 0.05):
        factors = np.exp(spread * g.standard_normal(free))
        for part in WINDOWS:
            settings = {"bounds": (0.05, 20), "max_nfev": 25, "diff_step": 1e-2 if coarse else 1e-4}
            fit = least_squares(residual, factors, args=(int(part * len(y)),), **settings)
            factors = fit.x
        best = fit if best is None or fit.cost < best.cost else best
        if 2 * best.cost / y.size < CLOSE:
            break
    factors, cost = best.x, best.cost
    if 2 * cost / y.size >= CLOSE:  # where something jumps, slopes do not lead to the end
        simplex = factors * (1 + 0.02 * np.eye(free + 1, free, -1))
        options = {"maxfev": 250, "initial_simplex": simplex}
        polished = minimize(
            lambda f: 0.5 * np.sum(residual(f, len(y)) ** 2), factors, method="Nelder-Mead", options=options
        )
        factors, cost = polished.x, polished.fun
    return factors, float(np.sqrt(2 * cost / y.size))
