"""Output-error estimation by scipy's least squares with lfilter, over any number of experiments, each from rest."""

from __future__ import annotations

import numpy as np
from scipy import optimize, signal


def filters(theta, numerator: int, delay: int):
    """(num, den) from theta = (b_delay .. , f_1 ..)."""
    return np.r_[np.zeros(delay), theta[:numerator]], np.r_[1.0, theta[numerator:]]


def residuals(theta, experiments, numerator: int, delay: int, offset: bool = False) -> np.ndarray:
    """y - G u - c of all experiments in a row; the offset c, if any, is the last of theta."""
    theta = np.asarray(theta, dtype=float)
    constant = theta[-1] if offset else 0.0
    num, den = filters(theta[:-1] if offset else theta, numerator, delay)
    return np.concatenate([y - signal.lfilter(num, den, u) - constant for u, y in experiments])


def output_error(experiments, start, numerator: int, delay: int, offset: bool = False) -> dict:
    """theta, covariance lambda (J'J)^-1 with J by central differences, noise variance (per degree of freedom), loss."""
    return least_squares(lambda x: residuals(x, experiments, numerator, delay, offset), start)


def least_squares(errors, start) -> dict:
    """The same for any errors(theta), started near the optimum."""

    def function(x):
        with np.errstate(over="ignore", invalid="ignore"):
            e = errors(x)
        return np.nan_to_num(e, nan=1e6, posinf=1e6, neginf=-1e6).clip(-1e6, 1e6)

    theta = np.asarray(start, dtype=float)
    for _ in range(3):
        theta = optimize.least_squares(
            function, theta, jac="3-point", xtol=1e-15, ftol=1e-15, gtol=1e-15, x_scale="jac", max_nfev=300
        ).x
    jacobian = np.empty((function(theta).size, theta.size))
    for k in range(theta.size):
        step = np.zeros(theta.size)
        step[k] = 1e-5 * max(1.0, abs(theta[k]))
        jacobian[:, k] = (function(theta + step) - function(theta - step)) / (2 * step[k])
    e = function(theta)
    variance = float(e @ e) / (e.size - theta.size)
    return {
        "theta": theta,
        "covariance": variance * np.linalg.inv(jacobian.T @ jacobian),
        "gram": jacobian.T @ jacobian,
        "noise_variance": variance,
        "loss": float(e @ e) / e.size,
        "gradient": jacobian.T @ e,
    }


def box_jenkins(theta, experiments, nb: int, nc: int, nd: int, nf: int, delay: int) -> np.ndarray:
    """e = (D / C) (y - (B / F) u), theta = b, c, d, f."""
    b, c, d, f = np.split(np.asarray(theta, dtype=float), np.cumsum([nb, nc, nd]))
    return np.concatenate(
        [
            signal.lfilter(
                np.r_[1.0, d],
                np.r_[1.0, c],
                y - signal.lfilter(np.r_[np.zeros(delay), b], np.r_[1.0, f], u),
            )
            for u, y in experiments
        ]
    )


def armax(theta, experiments, na: int, nb: int, nc: int, delay: int) -> np.ndarray:
    """e = (A y - B u) / C, theta = a, b, c."""
    a, b, c = np.split(np.asarray(theta, dtype=float), np.cumsum([na, nb]))
    return np.concatenate(
        [
            signal.lfilter(
                [1.0],
                np.r_[1.0, c],
                signal.lfilter(np.r_[1.0, a], [1.0], y) - signal.lfilter(np.r_[np.zeros(delay), b], [1.0], u),
            )
            for u, y in experiments
        ]
    )


def free_response_errors(theta, experiments, numerator: int, denominator: int, delay: int) -> np.ndarray:
    """Output error with each experiment's initial state (of lfilter's transposed form) among the parameters, behind b and f."""
    theta = np.asarray(theta, dtype=float)
    num, den = filters(theta[: numerator + denominator], numerator, delay)
    order = max(len(num), len(den)) - 1
    parts = []
    for k, (u, y) in enumerate(experiments):
        first = numerator + denominator + k * order
        parts.append(y - signal.lfilter(num, den, u, zi=theta[first : first + order])[0])
    return np.concatenate(parts)


def several_outputs(rows, start, rounds: int = 30) -> dict:
    """Gaussian maximum likelihood for several outputs: rows(theta) -> (N, ny), weighted by the inverse of its own moment in turn."""
    theta, weight = np.asarray(start, dtype=float), None
    for _ in range(rounds):
        if weight is None:
            weight = np.eye(rows(theta).shape[1])
        root = np.linalg.cholesky(weight)
        found = least_squares(lambda x, r=root: (rows(x) @ r).ravel(), theta)
        theta, e = found["theta"], rows(found["theta"])
        weight = np.linalg.inv(e.T @ e / len(e))
    gram = least_squares(lambda x: (rows(x) @ np.linalg.cholesky(weight)).ravel(), theta)["gram"]
    return {"theta": theta, "moment": e.T @ e / len(e), "gram": gram}


def arx(u, y, na: int, nb: int, delay: int, first: int | None = None) -> np.ndarray:
    """Least squares a_1..a_na, b_delay.. from t = first on, no assumption about what came before the record."""
    first = max(na, nb + delay - 1) if first is None else first
    rows = [
        [*(-y[t - k] for k in range(1, na + 1)), *(u[t - delay - k] for k in range(nb))]
        for t in range(first, len(y))
    ]
    return np.linalg.lstsq(np.array(rows), y[first:], rcond=None)[0]


def fir(u, y, taps: int) -> np.ndarray:
    """g_0 .. g_{taps-1} by least squares with the input zero before the record."""
    rows = np.zeros((len(u), taps))
    for k in range(taps):
        rows[k:, k] = u[: len(u) - k]
    return np.linalg.lstsq(rows, y, rcond=None)[0]
