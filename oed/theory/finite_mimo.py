"""Procedure 2 with experiments of finite length: the moments of its iterations, with the effects one by one.

With G the block Toeplitz matrix of N samples, one iteration is w = G' (G u + e) + n: e the noise of the first stage,
n what the second stage adds. In the right singular vectors of G, with singular values d_i and p_i the share of the
input's power in direction i (qN of them, sum p_i = 1),

    q_i = (d_i^2 a_i + d_i e_i + n_i)^2 / N,   a_i^2 = N p_i,   Q = sum q_i = mu^2,   next p_i = q_i / Q,

and n_i has the variance lambda_e r of all p outputs: r = p (second stage as it is), P (each scaled) or p P (one
factor), P the power of the first stage's output, which is random too. Linear in the shares, and exact, is the mean

    E q_i = d_i^4 E p_i + lambda_e (d_i^2 + E r) / N,      E P = sum_i d_i^2 E p_i + p lambda_e.

    "infinite"   N -> infinity: `oed.theory.mimo`
    "edge"       d_i of G_N; Q replaced by its mean
    "random-mu"  and the fluctuation of Q and of P, to second order

The mean of gamma_2^2 of an iteration is sum_i d_i^2 E p_i of its own input, exactly: its noise is new."""

from typing import Any

import numpy as np
from numpy.typing import NDArray

from oed.errors import InputError, check_names
from oed.plants.plant import Plant
from oed.theory.finite import EFFECTS, LARGEST, FiniteMoments, finite_norm, singular_values, within_expansion
from oed.theory.mimo import SCALINGS, mimo_limit_spectrum, mimo_recursion

DENSE = 1200
"""Most rows of the covariance that the command line waits for."""


def finite_mimo_moments(
    plant: Plant, samples: int, iterations: int = 60, *, effect: str = "edge", scaling: str = "none"
) -> FiniteMoments:
    """Means of gamma_2^2 and mu^2 of Procedure 2 from a white start, at finite N. [M] leaves the noise open;
    docs/theory/finite.md has one input and one output. With deterministic Q and P the recursion would be
    exact, so the second effect is all of their fluctuation: E[q_i / Q] is expanded in it, and the covariance
    of the shares is carried from iteration to iteration. Twin: campaigns of the compiled engine."""
    check_names([effect], EFFECTS, "description")
    check_names([scaling], SCALINGS, "scaling")
    variance = plant.noise_variance
    if not plant.white_noise or not np.allclose(plant.noise_covariance, variance * np.eye(plant.n_outputs)):
        raise InputError(
            "the noise is coloured, correlated or of unequal variances; the finite-sample theory of Procedure 2 is "
            "written for white noise of one variance on every output."
        )
    if effect == "infinite":
        gain2, mu2 = mimo_recursion(plant, iterations, scaling=scaling)
        if variance > 0:
            limit = mimo_limit_spectrum(plant, scaling=scaling)
            return FiniteMoments(effect, gain2, mu2, limit.gain2_mean, limit.mu2)
        return FiniteMoments(effect, gain2, mu2, float(np.sqrt(mu2[-1])), float(mu2[-1]))
    d2 = singular_values(plant, samples) ** 2
    fixed, following = _gathered(plant.n_outputs, scaling)
    gain2, mu2, holds = _moments(
        d2, samples, plant.n_outputs, variance, (fixed, following), iterations, effect
    )
    if effect == "random-mu":
        return FiniteMoments(effect, gain2, mu2, np.nan, np.nan, holds)
    limit = _limit(d2, samples, plant.n_outputs, variance, (fixed, following))
    return FiniteMoments(effect, gain2, mu2, *limit)


def _gathered(p: int, scaling: str) -> tuple[float, float]:
    """r = fixed + following P: what the noise of the second stage is multiplied by."""
    return {"none": (float(p), 0.0), "each": (0.0, 1.0), "common": (0.0, float(p))}[scaling]


def _moments(
    d2: NDArray, N: int, p: int, variance: float, gathered: tuple[float, float], iterations: int, effect: str
) -> tuple[NDArray[np.float64], NDArray[np.float64], bool]:
    """Means of gamma_2^2 and mu^2 per iteration, and whether the expansion holds; the covariance of the shares is dense, (qN, qN)."""
    n = len(d2)
    fixed, following = gathered
    shares = np.full(n, 1 / n)
    covariance = (np.eye(n) - 1 / n) * 2 / (n * (n + 2))  # white on the sphere, exactly
    gain2, mu2 = np.empty(iterations), np.empty(iterations)
    noise, holds = variance / N, True
    for m in range(iterations):
        gain2[m] = d2 @ shares
        if effect == "random-mu":
            holds = holds and within_expansion(float(np.trace(covariance)), shares)
        r = fixed + following * (gain2[m] + p * variance)
        own = noise * (d2 + r)
        q = d2**2 * shares + own
        Q = mu2[m] = q.sum()
        new = q / Q
        if effect == "random-mu" and holds and m + 1 < iterations:
            slope = noise * following  # dq_i / dP, the same in every direction
            # with the noise of the first stage, given the shares: Cov(q_i, P) and Var(P)
            joint = noise * (4 * d2**2 * shares + 2 * d2 * noise)
            power = noise * (4 * gain2[m] + 2 * p * variance)
            moved = covariance @ d2
            covariance *= d2[:, None] ** 2 * d2**2
            covariance.flat[:: n + 1] += own * (4 * d2**2 * shares + 2 * own)
            cross = slope * (d2**2 * moved + joint)
            covariance += cross[:, None] + cross + slope**2 * (d2 @ moved + power)
            row = covariance.sum(axis=1)
            total = row.sum()
            covariance += total * np.outer(new, new) - np.outer(new, row) - np.outer(row, new)
            covariance /= Q**2
            shares = new - row / Q**2 + new * total / Q**2
        else:
            shares = new
    return gain2, mu2, holds


def _limit(
    d2: NDArray, N: int, p: int, variance: float, gathered: tuple[float, float]
) -> tuple[float, float]:
    """Limits over the iterations with Q replaced by its mean: shares ~ (d_i^2 + r) / (mu^2 - d_i^4), of sum 1."""
    from scipy.optimize import brentq

    top, (fixed, following) = float(d2.max()), gathered
    if variance <= 0:
        return top, top**2
    gaps = top**2 - d2**2

    def shares(r: float) -> tuple[NDArray, float]:
        own = variance / N * (d2 + r)
        total = lambda x: float(np.sum(own / (np.exp(x) + gaps))) - 1
        high = float(np.log(own.sum()))
        excess = float(
            np.exp(np.asarray(brentq(total, float(np.log(own[np.argmin(gaps)])) - 1, high + 1, xtol=1e-14)))
        )
        return own / (excess + gaps), excess

    if not following:
        r = fixed
    else:
        off = lambda r: following * (float(d2 @ shares(r)[0]) + p * variance) - r
        low, high = following * p * variance, following * (top + p * variance)
        r = float(np.asarray(brentq(off, low * (1 - 1e-9), high * (1 + 1e-9), xtol=1e-12)))
    found, excess = shares(r)
    return float(d2 @ found), top**2 + excess


def finite_mimo_prediction(plant: Plant, samples: int, scaling: str = "none") -> dict[str, Any]:
    """What experiments of N samples change in the limits of Procedure 2: the keys of `oed theory --samples`."""
    payload: dict[str, Any] = {"samples": int(samples), "finite_norm": finite_norm(plant, samples)}
    if samples * max(plant.n_inputs, plant.n_outputs) <= LARGEST:
        edge = finite_mimo_moments(plant, samples, 1, effect="edge", scaling=scaling)
        payload |= {"finite_mu2": edge.limit_mu2, "finite_beta2_mean": edge.limit_beta2}
    if samples * plant.n_inputs <= DENSE and "finite_mu2" in payload:
        both = finite_mimo_moments(plant, samples, effect="random-mu", scaling=scaling)
        if both.holds:
            payload["finite_beta2_mean_random_mu"] = float(both.beta2[-1])
    return payload
