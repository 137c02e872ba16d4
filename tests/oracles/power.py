"""The iterations as dense matrix algebra: [S] Algorithm 1, [M] Procedures 1 and 2, and their second moments.

Everything is written with the N x N (or pN x qN) matrices of the papers; noise comes in as an argument.
"""

from __future__ import annotations

import numpy as np

from tests.oracles import lti


def reversal(samples: int, channels: int = 1) -> np.ndarray:
    """The involution T of [S] (6), one block per channel as in [M] (8)."""
    return np.kron(np.eye(channels), np.eye(samples)[::-1])


def finite_norm(plant, samples: int) -> float:
    """The finite-time l2-induced norm ||G_N||, by a dense singular value decomposition."""
    return float(np.linalg.svd(lti.toeplitz(plant, samples), compute_uv=False)[0])


def algorithm_1(plant, u, noise) -> dict[str, np.ndarray]:
    """[S] Algorithm 1 from u (N,), noise (n, N): inputs, outputs and the three estimates of every experiment.

    beta is [S] (4) and beta2_squared the square of [S] (7), both with theory.md 1's division by N; beta2 of the first
    experiment needs the experiment before it and is nan.
    """
    experiments, samples = noise.shape
    g_h = reversal(samples) @ lti.toeplitz(plant, samples)
    t = reversal(samples)
    u = np.asarray(u, dtype=float) / np.sqrt(np.mean(np.square(u)))
    inputs, outputs, beta, beta2_squared, mu = [], [], [], [], []
    for n in range(experiments):
        reversed_output = g_h @ u + t @ noise[n]
        inputs.append(u)
        outputs.append(t @ reversed_output)
        beta.append(u @ reversed_output / samples)
        beta2_squared.append(mu[-1] * (inputs[-2] @ reversed_output) / samples if n else np.nan)
        mu.append(np.sqrt(np.mean(reversed_output**2)))
        u = reversed_output / mu[-1]
    return {
        "u": np.array(inputs),
        "y": np.array(outputs),
        "beta": np.array(beta),
        "beta2_squared": np.array(beta2_squared),
        "mu": np.array(mu),
    }


def two_experiment(plant, u, noise) -> dict[str, np.ndarray]:
    """The scheme of Wahlberg et al. (2010a) as [S] Remark 4 has it: G^T G = T G T G, one normalisation per pair.

    noise has shape (n, 2, N). The first experiment applies u of unit power; the second applies the reversed output of the
    first as it is; its reversed output, normalised to unit power, is the next u. gain_squared = u' w / N.
    """
    samples = noise.shape[2]
    g, t = lti.toeplitz(plant, samples), reversal(samples)
    u = np.asarray(u, dtype=float) / np.sqrt(np.mean(np.square(u)))
    rows: dict[str, list] = {"u": [], "y": [], "x": [], "z": [], "gain_squared": [], "mu": []}
    for first, second in noise:
        y = g @ u + first
        x = t @ y
        z = g @ x + second
        w = t @ z
        mu = np.sqrt(np.mean(w**2))
        for name, value in zip(rows, (u, y, x, z, u @ w / samples, mu)):
            rows[name].append(value)
        u = w / mu
    return {name: np.array(value) for name, value in rows.items()}


def procedure_2(plant, u, first_noise, second_noise, scaling: str = "none") -> dict[str, np.ndarray]:
    """[M] Procedure 2, u (qN,) stacked by channel, normalised to unit total power ||u||^2 / N = 1.

    first_noise (n, p, N) is on the outputs of the first experiment; second_noise (n, q, p, p, N) on all p outputs of the
    second-stage experiment (i, j), which applies I_ij x: reversed output j on input i, of which output j is kept.
    scaling "none" applies I_ij x as it is; "each" scales every second-stage input to unit power by itself and undoes that
    on what comes back; "common" divides all of them by the root of the total power of x, and undoes it.
    """
    num, _ = plant
    p, q = len(num), len(num[0])
    iterations, samples = first_noise.shape[0], first_noise.shape[-1]
    g = lti.toeplitz(plant, samples)
    u = np.asarray(u, dtype=float) / np.sqrt(np.sum(np.square(u)) / samples)
    inputs, gains, mus = [], [], []
    for n in range(iterations):
        y = g @ u + first_noise[n].ravel()
        x = reversal(samples, p) @ y
        z = np.zeros(q * samples)
        for i in range(q):
            for j in range(p):
                pick = np.zeros((q, p))
                pick[i, j] = 1.0
                pick = np.kron(pick, np.eye(samples))
                applied = pick @ x
                if scaling == "each":
                    factor = np.sqrt(np.sum(applied**2) / samples)
                elif scaling == "common":
                    factor = np.sqrt(np.sum(x**2) / samples)
                else:
                    factor = 1.0
                z = z + pick @ (factor * (g @ (applied / factor) + second_noise[n, i, j].ravel()))
        w = reversal(samples, q) @ z
        inputs.append(u)
        gains.append(u @ w / (u @ u))
        mus.append(np.sqrt(np.sum(w**2) / samples))
        u = w / mus[-1]
    return {"u": np.array(inputs), "gain_squared": np.array(gains), "mu": np.array(mus)}


def second_moments(plant, samples: int, noise_variance: float, experiments: int) -> dict[str, np.ndarray]:
    """theory.md 6: S+ = T (G S G' + lambda_e I) T / mu^2 from S = I; mu2[n] and E beta2^2 per experiment (nan first).

    E beta2^2 of experiment n is tr(G S_{n-1} G') / N: u_{n-1}' T G u_n mu = u' T G T (G u + e) and T G T = G'.
    """
    g, t = lti.toeplitz(plant, samples), reversal(samples)
    s = np.eye(samples)
    mu2, beta2_squared = [], [np.nan]
    for _ in range(experiments):
        output = g @ s @ g.T + noise_variance * np.eye(samples)
        mu2.append(np.trace(output) / samples)
        beta2_squared.append(np.trace(g @ s @ g.T) / samples)
        s = t @ output @ t / mu2[-1]
    return {"mu2": np.array(mu2), "beta2_squared": np.array(beta2_squared[:-1]), "covariance": s}


def second_moments_diagonal(
    plant, samples: int, noise_variance: float, experiments: int
) -> dict[str, np.ndarray]:
    """The same recursion in the eigenvectors of G_H = T G, in which S stays diagonal from S = I: s+ = (d^2 s + lambda) / mu^2."""
    d2 = np.linalg.eigvalsh(reversal(samples) @ lti.toeplitz(plant, samples)) ** 2
    s = np.ones(samples)
    mu2, beta2_squared = [], [np.nan]
    for _ in range(experiments):
        output = d2 * s + noise_variance
        mu2.append(output.mean())
        beta2_squared.append((d2 * s).mean())
        s = output / mu2[-1]
    return {"mu2": np.array(mu2), "beta2_squared": np.array(beta2_squared[:-1])}


def second_moments_procedure_2(plant, samples: int, noise_variance: float, iterations: int) -> np.ndarray:
    """theory.md 3 at finite N (unscaled): S+ = (G' (G S G' + lambda I) G + p lambda I) / mu^2, from white; mu^2 per iteration."""
    p, q = len(plant[0]), len(plant[0][0])
    g = lti.toeplitz(plant, samples)
    s = np.eye(q * samples) / q
    mu2 = []
    for _ in range(iterations):
        first = g @ s @ g.T + noise_variance * np.eye(p * samples)
        w = g.T @ first @ g + p * noise_variance * np.eye(q * samples)
        mu2.append(np.trace(w) / samples)
        s = w / mu2[-1]
    return np.array(mu2)


def mimo_limit(
    plant, noise_variance, *, lines: int = 2048, rounds: int = 20000, scaling: str = "none", shape=None
) -> dict[str, object]:
    """theory.md 3 by its recursion on a uniform grid, not by its solution: Phi+ = (M Phi M + G* Lambda G + noise I) / mu^2.

    noise_variance is lambda_e or the matrix Lambda, shape(omega) the |H|^2 common to all outputs. The noise of the second stage is
    sum_j Lambda_jj (unscaled), sum_j Lambda_jj P_j (each) or sum_j Lambda_jj sum P (common), P_j the power of output j in the first
    stage: what comes back is multiplied by the factor that the input was divided by.
    """
    omega = -np.pi + (np.arange(lines) + 0.5) * 2 * np.pi / lines
    g = lti.response(plant, omega)
    p, q = g.shape[1:]
    covariance = np.eye(p) * noise_variance if np.ndim(noise_variance) == 0 else np.asarray(noise_variance)
    colour = np.ones(lines) if shape is None else shape(omega)
    adjoint = g.conj().transpose(0, 2, 1)
    m = adjoint @ g
    first = colour[:, None, None] * (adjoint @ covariance @ g)
    phi = np.broadcast_to(np.eye(q) / q, (lines, q, q)).astype(complex)
    variances, before = np.diag(covariance), 0.0
    for _ in range(rounds):
        outputs = np.einsum("kaa->ka", g @ phi @ adjoint).real.mean(axis=0) + variances * colour.mean()
        gathered = {
            "none": variances.sum(),
            "each": variances @ outputs,
            "common": variances.sum() * outputs.sum(),
        }[scaling]
        output = m @ phi @ m + first + gathered * colour[:, None, None] * np.eye(q)
        mu2 = float(np.trace(output, axis1=1, axis2=2).real.mean())
        change = float(np.abs(output / mu2 - phi).max()) / float(np.abs(phi).max())
        phi = output / mu2
        if abs(mu2 - before) < 1e-15 * mu2 and change < 1e-13:
            break
        before = mu2
    gain2 = float(np.trace(m @ phi, axis1=1, axis2=2).real.mean())
    return {"omega": omega, "spectrum": phi, "mu2": mu2, "gain2_mean": gain2}
