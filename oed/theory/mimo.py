"""Limit spectrum of Procedure 2, which [M] leaves open.

One iteration maps the input spectrum Phi (q x q, trace of unit power) to

    Phi+ = ( M Phi M + |H|^2 (G* Lambda G + n^2 I) ) / mu^2,     M = G* G,

because w = G' (G u + e) + what the pq experiments of the second stage add: experiment (i, j) adds the noise of
output j to input i, so every input gathers the noise of all p outputs, divided by what the second-stage
inputs were multiplied with:

    n^2 = sum_j Lambda_jj r_j,   r_j = 1 (none), P_j (each), sum P (common), P_j the power of output j.

In the eigenvectors of M, with eigenvalues s_a^2, the limit is Phi_ab = Q_ab / (mu^2 - s_a^2 s_b^2), with Q the
noise term; for Lambda = lambda_e I and H = 1 it is phi_i = lambda_e (s_i^2 + p r) / (mu^2 - s_i^4).
mu normalises the two-stage map and tends to gamma^2. With one channel and scaled second stages it is
Algorithm 1's limit exactly: two of its steps."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from oed.data import Spectrum
from oed.errors import InputError, check_names
from oed.information import information_of_spectrum
from oed.plants.norms import Peak, gain_gradient, peak
from oed.plants.plant import Plant
from oed.theory.efficiency import losses
from oed.theory.limit import resolution
from oed.theory.quadrature import Nodes, graded_nodes

SCALINGS = ("none", "each", "common")


@dataclass(frozen=True, eq=False)
class MimoLimitSpectrum:
    """Limit of the first-stage input spectrum of Procedure 2. `plant` the plant with its noise; `scaling` how
    the second-stage inputs are scaled; `peak` H-infinity norm of the plant; `mu2_excess` mu^2 - gamma^4,
    solved for directly; `gain2_mean` limit of E gamma_2^2 = (1/2pi) int tr(G Phi G*) dw, [M] (12);
    `noise_gain` n^2: the noise variance that the second stage adds to every input; `spectrum` phi as the
    nodes of a quadrature; its powers sum to 1; `spectrum_max, spectrum_min` largest and smallest eigenvalue
    of the density over all frequencies."""

    plant: Plant
    scaling: str
    peak: Peak
    mu2_excess: float
    gain2_mean: float
    noise_gain: float
    spectrum: Spectrum = field(repr=False)
    spectrum_max: float = float("nan")
    spectrum_min: float = float("nan")

    @property
    def mu2(self) -> float:
        """mu^2, which tends to gamma^4 as the noise vanishes."""
        return self.peak.value**4 + self.mu2_excess

    def __repr__(self) -> str:
        return (
            f"MimoLimitSpectrum of {self.plant.name} at noise variance {self.plant.noise_variance:g}, second "
            f"stage scaled: {self.scaling}; mu^2 = {self.mu2:.12g} (gamma^4 + {self.mu2_excess:.6g}), "
            f"E gamma_2^2 = {self.gain2_mean:.9g}"
        )


@dataclass(frozen=True, eq=False)
class _Terms:
    """What the equations need at every node, in the eigenvectors of M."""

    nodes: Nodes
    V: NDArray  # (K, q, q) right singular vectors
    s2: NDArray  # (K, q) eigenvalues of M
    gap: NDArray  # (K, q, q) gamma^4 - s_a^2 s_b^2
    first: NDArray  # (K, q) diagonal of |H|^2 V* G* Lambda G V
    cross: NDArray  # (K, q, q) the same with its off-diagonal part
    shape: NDArray  # (K,) |H|^2
    outputs: NDArray  # (K, p, q) V* into outputs: G V


def mimo_limit_spectrum(plant: Plant, *, scaling: str = "none") -> MimoLimitSpectrum:
    """Limit of the input spectrum under Procedure 2 with noise. docs/theory/iterations.md, generalised to
    coloured and unequal noise. Twins: `mimo_recursion` iterated on a uniform grid, and simulation."""
    check_names([scaling], SCALINGS, "scaling")
    if not np.trace(plant.noise_covariance) > 0:
        raise InputError(
            f"the noise variance is {plant.noise_variance:g}; the limit spectrum needs a positive one "
            "(without noise the iterations end in sinusoids at the peaks, which have no density)."
        )
    top = peak(plant)
    terms = _terms(plant, top)
    variances = np.diag(plant.noise_covariance)
    if scaling == "none":
        n2 = float(variances.sum())
        delta = _excess(terms, n2)
    else:
        n2, delta = _scaled(plant, terms, scaling)
    Phi = _density(terms, n2, delta)
    power = np.einsum("k,kia,kab,kjb->kij", terms.nodes.weight, terms.V, Phi, np.conj(terms.V))
    eigenvalues = np.linalg.eigvalsh(Phi)
    gain2 = float(np.einsum("k,ka,kaa->", terms.nodes.weight, terms.s2, Phi).real)
    return MimoLimitSpectrum(
        plant, scaling, top, delta, gain2, n2, Spectrum(terms.nodes.omega, power), float(eigenvalues.max()),
        float(eigenvalues.min()),
    )  # fmt: skip


def _terms(plant: Plant, top: Peak) -> _Terms:
    poles = [r for row in plant.den for den in row for r in np.roots(den) if r.imag >= 0]
    poles += [r for r in np.roots(plant.noise_den) if r.imag >= 0]
    others = [w for w, _ in top.local_maxima] + [float(abs(np.angle(r))) for r in poles]
    exact = list(top.frequencies)
    nodes = graded_nodes(
        exact + [w for w in others if min(abs(w - e) for e in exact) > 1e-9], resolution(plant, top)
    )
    G = plant.transfer(nodes.omega)
    M = np.conj(np.swapaxes(G, 1, 2)) @ G
    s2, V = np.linalg.eigh(M)
    gap2 = top.value**2 - s2
    gap2[:, -1] = _close_gap(plant, top, nodes, gap2[:, -1])
    gap2 = np.maximum(gap2, 0.0)
    # gamma^4 - s_a^2 s_b^2 with s^2 = gamma^2 - g: gamma^2 (g_a + g_b) - g_a g_b, without cancellation
    gap = top.value**2 * (gap2[:, :, None] + gap2[:, None, :]) - gap2[:, :, None] * gap2[:, None, :]
    shape = np.abs(plant.noise_response(nodes.omega)) ** 2
    outputs = G @ V
    cross = shape[:, None, None] * (np.conj(np.swapaxes(outputs, 1, 2)) @ plant.noise_covariance @ outputs)
    return _Terms(nodes, V, s2, gap, np.einsum("kaa->ka", cross).real, cross, shape, outputs)


def _close_gap(plant: Plant, top: Peak, nodes: Nodes, direct: NDArray) -> NDArray:
    """gamma^2 - s_1^2 near the peaks, where the difference has lost its digits. There it is x^2 (H/2 + c_1 x
    + ... ), x the distance from the peak, with the c fitted to the direct differences a little farther out,
    where they are exact enough."""
    gap = direct.copy()
    scale = top.value**2
    for centre, curvature in zip(top.frequencies, top.curvatures, strict=True):
        if not curvature > 0:
            continue
        width = np.sqrt(2 * scale / curvature)
        reach = 0.05 * width
        x = reach * np.concatenate([-np.linspace(1, 0.2, 25), np.linspace(0.2, 1, 25)])
        omega = centre + x
        values = np.linalg.norm(plant.transfer(omega), 2, axis=(1, 2)) ** 2
        target = (scale - values) / x**2 - curvature / 2
        c = np.linalg.lstsq(np.vander(x / reach, 6, increasing=True)[:, 1:], target, rcond=None)[0]
        near = (nodes.centre == centre) & (np.abs(nodes.offset) < 0.3 * reach)
        z = nodes.offset[near]
        gap[near] = z**2 * (curvature / 2 + np.vander(z / reach, 6, increasing=True)[:, 1:] @ c)
    return gap


def _density(terms: _Terms, n2: float, delta: float) -> NDArray[np.complex128]:
    """Phi in the eigenvectors of M."""
    q = terms.s2.shape[1]
    noise = terms.cross + n2 * terms.shape[:, None, None] * np.eye(q)
    return np.asarray(noise / (delta + terms.gap), complex)


def _excess(terms: _Terms, n2: float) -> float:
    """delta with (1/2pi) int tr Phi dw = 1."""
    from scipy.optimize import brentq

    numerator = terms.first + n2 * terms.shape[:, None]
    diagonal = np.einsum("kaa->ka", terms.gap)
    power = lambda delta: float(terms.nodes.weight @ np.sum(numerator / (delta + diagonal), axis=1))
    upper = float(terms.nodes.weight @ numerator.sum(axis=1))
    lower = upper
    while power(lower) < 1:
        lower *= 1e-2
    if lower == upper:
        return upper
    f = lambda x: power(float(np.exp(x))) - 1
    return float(np.exp(np.asarray(brentq(f, np.log(lower), np.log(upper), xtol=1e-15))))


def _output_powers(plant: Plant, terms: _Terms, Phi: NDArray) -> NDArray[np.float64]:
    """Power of every output of the first stage, noise included, (p,)."""
    weight, outputs = terms.nodes.weight, terms.outputs
    signal = np.einsum("k,kja,kab,kjb->j", weight, outputs, Phi, np.conj(outputs)).real
    return signal + np.diag(plant.noise_covariance) * float(weight @ terms.shape)


def _noise_gain(plant: Plant, powers: NDArray, scaling: str) -> float:
    variances = np.diag(plant.noise_covariance)
    if scaling == "none":
        return float(variances.sum())
    return float(variances @ powers if scaling == "each" else variances.sum() * powers.sum())


def _scaled(plant: Plant, terms: _Terms, scaling: str) -> tuple[float, float]:
    """n^2 and delta where n^2 depends on the limit itself."""
    from scipy.optimize import brentq

    def off(n2: float) -> float:
        powers = _output_powers(plant, terms, _density(terms, n2, _excess(terms, n2)))
        return _noise_gain(plant, powers, scaling) - n2

    total = float(np.trace(plant.noise_covariance))
    noise_power = total * float(terms.nodes.weight @ terms.shape)
    most = float(terms.s2.max()) + noise_power
    low, high = 1e-9 * total * min(1.0, noise_power), 2 * total * most
    n2 = float(np.asarray(brentq(off, low, high, xtol=1e-14 * high, rtol=np.float64(1e-13))))
    return n2, _excess(terms, n2)


def mimo_recursion(
    plant: Plant, iterations: int, *, scaling: str = "none"
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """E gamma_2^2 and mu^2 of the first iterations of Procedure 2 from a white start, N -> infinity: returns
    (M,)."""
    check_names([scaling], SCALINGS, "scaling")
    gain2, mu2 = np.empty(iterations), np.empty(iterations)
    terms = _terms(plant, peak(plant))
    for m, (Phi, _, mu2[m]) in enumerate(_iterates(plant, terms, iterations, scaling)):
        gain2[m] = np.einsum("k,ka,kaa->", terms.nodes.weight, terms.s2, Phi).real
    return gain2, mu2


def _iterates(
    plant: Plant, terms: _Terms, iterations: int, scaling: str
) -> Iterator[tuple[NDArray, NDArray, float]]:
    """Input spectrum of the first stage in the eigenvectors of M, powers of its outputs, and mu^2, from a white start."""
    q = plant.n_inputs
    Phi = np.broadcast_to(np.eye(q) / q, terms.cross.shape).astype(complex)
    for _ in range(iterations):
        powers = _output_powers(plant, terms, Phi)
        new = terms.s2[:, :, None] * Phi * terms.s2[:, None, :] + terms.cross
        new = new + _noise_gain(plant, powers, scaling) * terms.shape[:, None, None] * np.eye(q)
        mu2 = float(np.einsum("k,kaa->", terms.nodes.weight, new).real)
        yield Phi, powers, mu2
        Phi = new / mu2


def procedure_2_efficiency(
    plant: Plant, marks: Sequence[int], optimum: float | None = None
) -> tuple[NDArray[np.float64], float]:
    """c-efficiency of all 1 + pq experiments of the first m iterations together, m in `marks`, and of the
    limit: returns (len(marks),). The second stage applies every output of the first, reversed and at unit
    power, to every input in turn; it is counted like the first. `optimum` is the certified least c' I^-1 c,
    lambda_e where it is not given. Twin: Procedure 2 simulated, its informations summed."""
    top = peak(plant)
    if not top.unique:
        return np.full(len(marks), np.nan), float("nan")
    c, terms = gain_gradient(plant, top), _terms(plant, top)
    variances = np.diag(plant.noise_covariance)
    p, q = plant.n_outputs, plant.n_inputs

    def density(Phi: NDArray, powers: NDArray) -> NDArray[np.complex128]:
        outputs = np.einsum("kia,kab,kib->ki", terms.outputs, Phi, np.conj(terms.outputs)).real
        second = ((outputs + variances * terms.shape[:, None]) / powers).sum(axis=1)
        first = np.einsum("kia,kab,kjb->kij", terms.V, Phi, np.conj(terms.V))
        return first + second[:, None, None] * np.eye(q)

    def share(total: NDArray, m: int) -> float:
        spectrum = Spectrum(terms.nodes.omega, terms.nodes.weight[:, None, None] * total / (m * (1 + p * q)))
        least = variances[0] if optimum is None else optimum
        return float(least / losses(information_of_spectrum(plant, spectrum), c).c)

    total, found = np.zeros(terms.cross.shape, complex), {}
    for m, (Phi, powers, _) in enumerate(_iterates(plant, terms, max(marks), "each"), 1):
        total += density(Phi, powers)
        if m in marks:
            found[m] = share(total, m)
    Phi = _density(terms, *_scaled(plant, terms, "each"))
    return np.array([found[m] for m in marks]), share(density(Phi, _output_powers(plant, terms, Phi)), 1)
