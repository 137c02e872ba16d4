"""Experiments of finite length: the finite-time norm, and the moments of the iterations.

In the orthonormal basis that diagonalises T G_N the second moments of the iterations stay diagonal. With
d_i the singular values of the lower-triangular Toeplitz matrix G_N and p_i the share of the input's power
in direction i (sum p_i = 1), one experiment and its normalisation are

    q_i = d_i^2 p_i + 2 d_i u_i e_i / N + e_i^2 / N,      Q = sum q_i = mu^2,      next p_i = q_i / Q.

Three descriptions, each with one effect more:

    "infinite"   N -> infinity: |G(e^jw)|^2 in place of d_i^2 (Lemma 6 of [S])
    "edge"       d_i of G_N; Q replaced by its mean
    "random-mu"  and the fluctuation of Q, to second order: Cov(q_i, q_j) follows exactly from Cov(p_i, p_j)

The third is an expansion, and tells itself where it ends. Shares are squares of what is nearly Gaussian, so that their
relative variance, sum Var p_i / sum p_i^2, is 2; where the recursion has left 2 its orders beyond the second are as large
as the second (little noise, long experiments: the power gathers in few directions whose shares wander), and it can be
further from the truth than "edge" or diverge. There Q is replaced by its mean again, `FiniteMoments.holds` says so, and
nothing is printed.

The mean of beta_2^2 is sum_i d_i^2 E p_i of the experiment before, exactly."""

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from oed.errors import InputError, check_names
from oed.plants.norms import peak
from oed.plants.plant import Plant

EFFECTS = ("infinite", "edge", "random-mu")
DENSE = 300
LARGEST = 3000
GAUSSIAN = 2.0
"""Relative variance of the square of a Gaussian variable."""
ASTRAY = 0.75
"""How far from it the shares may be: of 30 plants and lengths tried the correction helped in all within it, by a factor of
2.7 or more, and it began to harm at 1.2."""


def _check_samples(samples: int) -> None:
    if not isinstance(samples, int | np.integer) or samples < 2:
        raise InputError(
            f"samples is {samples!r}; the norm over an experiment needs an integer of at least 2."
        )


def dense(plant: Plant, samples: int) -> NDArray[np.float64]:
    """The plant over N samples from rest, block lower-triangular Toeplitz: returns (N ny, N nu)."""
    g = plant.impulse_response(samples)
    lag = np.subtract.outer(np.arange(samples), np.arange(samples))
    blocks = np.where((lag >= 0)[:, :, None, None], g[np.maximum(lag, 0)], 0.0)
    return np.asarray(blocks.transpose(0, 2, 1, 3).reshape(samples * g.shape[1], -1), dtype=np.float64)


def singular_values(plant: Plant, samples: int) -> NDArray[np.float64]:
    """Singular values of the plant over N samples from rest, largest first: returns (N nu,). [S] (6): for one
    channel they are the absolute eigenvalues of the symmetric T G_N."""
    _check_samples(samples)
    if samples * max(plant.n_inputs, plant.n_outputs) > LARGEST:
        raise InputError(
            f"{samples} samples of {max(plant.n_inputs, plant.n_outputs)} channels make a dense matrix of more "
            f"than {LARGEST} rows; take fewer samples, or finite_norm for the largest singular value alone."
        )
    N, ny, nu, G = samples, plant.n_outputs, plant.n_inputs, dense(plant, samples)
    if ny == nu == 1:
        values = np.sort(np.abs(np.linalg.eigvalsh(G[::-1])))[::-1]
    else:
        values = np.linalg.svd(G, compute_uv=False)
    return np.pad(values.astype(float), (0, max(0, N * nu - len(values))))


def finite_norm(plant: Plant, samples: int) -> float:
    """Norm of the plant over N samples from rest, ||G_N||, the largest singular value. Block Lanczos on G' G
    with products by the fast Fourier transform, started from what the worst inputs tend to: sinusoids at the
    peaks under the windows sin(k pi t / N). O(N log N); N = 1e5 takes a second. [S] (2), (5), Theorem 2;
    figures in docs/theory/finite.md. Twin: dense singular values in the tests."""
    _check_samples(samples)
    if samples * max(plant.n_inputs, plant.n_outputs) <= DENSE:
        return float(singular_values(plant, samples)[0])
    gram = _gram(plant, samples)
    block = np.linalg.qr(_starts(plant, samples))[0]
    basis, images, last = block, gram(block), 0.0
    while True:
        H = basis.T @ images
        value = float(np.sqrt(max(np.linalg.eigvalsh((H + H.T) / 2)[-1], 0.0)))
        if value - last <= (5e-13 if samples < 20000 else 1e-11) * value or basis.shape[1] > min(
            200, samples // 2
        ):
            return value
        last = value
        fresh = images[:, -block.shape[1] :]
        for _ in range(2):  # twice is enough, with the block made orthonormal in between
            fresh, triangle = np.linalg.qr(fresh - basis @ (basis.T @ fresh))
            size = np.abs(np.diag(triangle))
            fresh = fresh[:, size > 1e-10 * max(size.max(), 1e-300)]
        block = fresh
        basis, images = np.hstack([basis, block]), np.hstack([images, gram(block)])


def _gram(plant: Plant, N: int) -> Any:
    """X -> G' G X, columns of time-major signals."""
    from scipy.fft import irfft, next_fast_len, rfft

    size = next_fast_len(2 * N, real=True)
    response = np.asarray(rfft(plant.impulse_response(N), size, axis=0))
    single = plant.n_inputs == plant.n_outputs == 1

    def apply(x: NDArray, pattern: str) -> NDArray:
        spectrum = np.asarray(rfft(x, size, axis=0))
        product = response[:, 0] * spectrum if single else np.einsum(pattern, response, spectrum)
        return np.asarray(irfft(product, size, axis=0))[:N]

    def gram(X: NDArray) -> NDArray:
        columns = [apply(x.reshape(N, plant.n_inputs), "kij,kj->ki") for x in X.T]
        return np.column_stack([apply(y[::-1], "kij,ki->kj")[::-1].ravel() for y in columns])

    return gram


def _starts(plant: Plant, N: int) -> NDArray[np.float64]:
    """Windowed sinusoids at the peaks that may count at N samples, in the worst directions."""
    top = peak(plant)
    t = np.arange(N) + 0.5
    columns, windows, least = [], 4 if N < 20000 else 2, max(0.8, 1 - 1e4 / N**1.5)
    for frequency in [w for w, s in top.local_maxima if s >= least * top.value]:
        v = np.conj(np.linalg.svd(plant.transfer([frequency])[0])[2][0])
        wave = np.exp(1j * frequency * t)[:, None] * v
        for k in range(1, windows + 1):
            window = np.sin(k * np.pi * t / N)[:, None]
            columns += [(window * np.real(phase * wave)).ravel() for phase in (1, 1j)]
    matrix = np.column_stack(columns)
    sizes = np.linalg.norm(matrix, axis=0)
    return matrix[:, sizes > 1e-6 * sizes.max()]  # at 0 and pi the sines vanish


@dataclass(frozen=True, eq=False)
class FiniteMoments:
    """Means over the noise, per experiment, as one of the three descriptions gives them. `effect` "infinite",
    "edge" or "random-mu"; `beta2` (M,) mean of beta_2^2 of experiments 1..M (NaN for the first); `mu2` (M,)
    mean of mu^2; `limit_beta2, limit_mu2` their limits over the iterations; NaN for "random-mu", which has
    none that is known; `holds` whether the expansion holds up to the last experiment; True for the
    descriptions that are not expansions."""

    effect: str
    beta2: NDArray[np.float64]
    mu2: NDArray[np.float64]
    limit_beta2: float
    limit_mu2: float
    holds: bool = True

    def average(self, first: int, last: int) -> float:
        """Root of the mean of beta_2^2 over experiments first..last."""
        return float(np.sqrt(np.mean(self.beta2[first - 1 : last])))


def finite_moments(
    plant: Plant, samples: int, iterations: int = 60, *, effect: str = "edge"
) -> FiniteMoments:
    """Means of beta_2^2 and mu^2 of Algorithm 1 from a white start, at finite N. docs/theory/finite.md gives
    the first two; the third expands E[q_i / Q] in the fluctuation of Q and carries the covariance of the
    shares through C+ = J Cov(q) J' / Q^2, J = I - p+ 1'."""
    check_names([effect], EFFECTS, "description")
    _check_single(plant)
    _check_samples(samples)
    variance = float(plant.noise_covariance[0, 0])
    if effect == "infinite":
        from oed.theory.limit import limit_spectrum
        from oed.theory.limit_on_grid import spectra_of_iterations

        nodes, Phi, mu2 = spectra_of_iterations(plant, iterations)
        gain2 = np.abs(plant.transfer(nodes.omega)[:, 0, 0]) ** 2
        beta2 = np.concatenate([[np.nan], (Phi @ (nodes.weight * gain2))[:-1]])
        limit = limit_spectrum(plant) if variance > 0 else None
        mu2_limit = limit.mu2 if limit else peak(plant).value ** 2
        return FiniteMoments(effect, beta2, mu2, mu2_limit - variance, mu2_limit)
    d2 = singular_values(plant, samples) ** 2
    if effect == "edge":
        beta2, mu2 = _edge(d2, variance, iterations)
        mu2_limit = _edge_limit(d2, variance)
        return FiniteMoments(effect, beta2, mu2, mu2_limit - variance, mu2_limit)
    beta2, mu2, holds = _random_mu(d2, variance, iterations)
    return FiniteMoments(effect, beta2, mu2, np.nan, np.nan, holds)


def _check_single(plant: Plant) -> None:
    if plant.n_inputs * plant.n_outputs != 1:
        raise InputError(
            f"the plant has {plant.n_outputs} outputs and {plant.n_inputs} inputs; the finite-sample theory is "
            "written for one of each."
        )
    if not plant.white_noise:
        raise InputError("the finite-sample theory is written for white noise; give a plant with H = 1.")


def edge_shares(d2: NDArray, variance: float, iterations: int) -> NDArray[np.float64]:
    """Shares (M, N) of the input's power with mu replaced by its mean."""
    shares = np.full((iterations, len(d2)), 1 / len(d2))
    for m in range(1, iterations):
        q = d2 * shares[m - 1] + variance / len(d2)
        shares[m] = q / q.sum()
    return shares


def _edge(d2: NDArray, variance: float, iterations: int) -> tuple[NDArray, NDArray]:
    told = edge_shares(d2, variance, iterations) @ d2
    return np.concatenate([[np.nan], told[:-1]]), told + variance


def _edge_limit(d2: NDArray, variance: float) -> float:
    """mu^2 with (1/N) sum lambda_e / (mu^2 - d_i^2) = 1."""
    from scipy.optimize import brentq

    top = float(d2.max())
    if variance <= 0:
        return top
    f = lambda x: float(np.mean(variance / (np.exp(x) + (top - d2)))) - 1
    low = np.log(variance / len(d2)) - 1
    return top + float(np.exp(np.asarray(brentq(f, low, np.log(variance) + 1, xtol=1e-15))))


def _random_mu(d2: NDArray, variance: float, iterations: int) -> tuple[NDArray, NDArray, bool]:
    """Means with the fluctuation of Q, to second order, for as long as that holds; from there on Q is its
    mean; d2 (N,) -> (M,). The covariance of the shares is kept as a diagonal and, from every
    experiment, two more directions."""
    N = len(d2)
    noise = variance / N
    p = np.full(N, 1 / N)
    diagonal = np.full(N, 2 / (N * (N + 2)))  # white on the sphere, exactly
    columns = np.empty((N, 2 * iterations + 1), order="F")
    columns[:, 0] = 1.0
    weights = [np.array([[-2 / (N**2 * (N + 2))]])]
    shares = np.empty((iterations, N))
    used, holds = 1, True
    for m in range(iterations):
        shares[m] = p
        q = d2 * p + noise
        Q = q.sum()
        holds = holds and within_expansion(_total_variance(diagonal, columns[:, :used], weights), p)
        if not holds:
            p = q / Q
            continue
        diagonal = d2**2 * diagonal + 4 * d2 * p * noise + 2 * noise**2
        U = columns[:, :used]
        U *= d2[:, None]
        sums = U.sum(axis=0)
        middle = np.concatenate(
            [W @ part for W, part in zip(weights, np.split(sums, np.arange(1, used, 2)), strict=True)]
        )
        row = diagonal + U @ middle
        total = row.sum()
        share = q / Q
        columns[:, used], columns[:, used + 1] = share, row
        weights.append(np.array([[total, -1.0], [-1.0, 0.0]]))
        used += 2
        diagonal /= Q**2
        columns[:, :used] /= Q
        p = share - row / Q**2 + share * total / Q**2
    told = shares @ d2
    return np.concatenate([[np.nan], told[:-1]]), told + variance, holds


def within_expansion(variance: float, shares: NDArray[np.float64]) -> bool:
    """Whether the sum of the shares' variances is still that of squared Gaussians of these means."""
    return abs(variance / float(shares @ shares) - GAUSSIAN) <= ASTRAY


def _total_variance(diagonal: NDArray, U: NDArray, weights: list[NDArray]) -> float:
    """Trace of diag(diagonal) + U W U', W block diagonal."""
    parts = np.split(U, np.arange(1, U.shape[1], 2), axis=1)
    return float(
        diagonal.sum() + sum(np.sum((part.T @ part) * W) for part, W in zip(parts, weights, strict=True))
    )


def finite_prediction(plant: Plant, samples: int) -> dict[str, Any]:
    """What experiments of N samples change in the limits: the keys of `oed theory --samples`."""
    _check_single(plant)
    _check_samples(samples)
    variance = float(plant.noise_covariance[0, 0])
    payload: dict[str, Any] = {"samples": int(samples), "finite_norm": finite_norm(plant, samples)}
    if samples <= LARGEST:
        mu2 = _edge_limit(singular_values(plant, samples) ** 2, variance)
    else:
        limit = finite_moments(plant, samples, 1, effect="infinite").limit_mu2
        sizes = np.array([1000, 1500])
        off = [_edge_limit(singular_values(plant, int(n)) ** 2, variance) - limit for n in sizes]
        a = np.linalg.solve(np.column_stack([1 / sizes, 1 / sizes**2]), off)
        mu2 = limit + a[0] / samples + a[1] / samples**2
    payload |= {"finite_mu2": mu2, "finite_beta2_mean": mu2 - variance}
    if samples <= 2000:
        moments = finite_moments(plant, samples, 60, effect="random-mu")
        if moments.holds:
            payload["finite_beta2_mean_random_mu"] = float(moments.beta2[-1])
    return payload
