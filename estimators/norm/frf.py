"""Frequency responses on the DFT lines: the averaged ratio of spectra, and the local polynomial method.

    frf   G^(w_k) = (sum_m Y_m U_m*) (sum_m U_m U_m*)^-1
    lpm   G and a transient per experiment as polynomials in k over the neighbouring lines, by least squares

Both give the largest singular value over the lines with its standard error, refined between the lines."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from estimators.norm.local_models import PeakEstimate, local_peak
from estimators.rules.trace import Trace
from oed.data import frozen
from oed.errors import InputError, Status
from oed.plants.norms import largest_gain


@dataclass(frozen=True, eq=False)
class FrequencyResponse:
    """A nonparametric frequency response. `omega` (K,) rad/sample; `response` (K, ny, nu) complex;
    `deviation` (K,) standard deviation of the largest singular value; `noise_variance` per output."""

    omega: NDArray[np.float64]
    response: NDArray[np.complex128]
    deviation: NDArray[np.float64]
    noise_variance: float


def frequency_response(trace: Trace) -> FrequencyResponse:
    """Averaged ratio of cross- to input spectra on the DFT lines (the ETFE for one experiment and input)."""
    lengths = {len(r) for r in trace.records}
    first = trace.records[0]
    nu, ny, M = first.n_inputs, first.n_outputs, len(trace)
    if len(lengths) != 1 or nu > M:
        raise InputError(
            f"{M} experiments of {sorted(lengths)} samples; the frequency response of {nu} inputs needs at "
            f"least {nu} experiments of one length."
        )
    (N,) = lengths
    U = np.fft.rfft(np.stack([r.u for r in trace.records], 2), axis=0) / np.sqrt(N)  # (K, nu, M)
    Y = np.fft.rfft(np.stack([r.y for r in trace.records], 2), axis=0) / np.sqrt(N)
    S = U @ np.conj(np.swapaxes(U, 1, 2))
    use = np.linalg.eigvalsh(S)[:, 0] > 1e-8 * np.einsum("kii->k", S).real.max()
    if not use.any():
        raise InputError("no frequency is excited in every input; apply another input.")
    inverse = np.linalg.inv(S[use])
    G = Y[use] @ np.conj(np.swapaxes(U[use], 1, 2)) @ inverse
    rest = Y[use] - G @ U[use]
    noise = float(np.sum(np.abs(rest) ** 2) / (len(G) * ny * max(M - nu, 1))) if nu < M else float("nan")
    V = np.linalg.svd(G)[2][:, 0] if nu * ny > 1 else np.ones((len(G), 1))  # v*
    spread = np.einsum("ki,kij,kj->k", V, inverse, np.conj(V)).real
    omega = 2 * np.pi * np.flatnonzero(use) / N
    deviation = np.sqrt(np.maximum(noise * spread / 2, 0))
    return FrequencyResponse(frozen(omega), frozen(G, complex), frozen(deviation), noise)


def peak_of_response(found: FrequencyResponse) -> PeakEstimate:
    """Largest singular value over the lines, refined by a parabola through three of them."""
    square = largest_gain(found.response) ** 2
    k = int(np.argmax(square))
    value, omega, bend = float(square[k]), float(found.omega[k]), float("nan")
    if 0 < k < len(square) - 1:
        a, b, c = square[k - 1 : k + 2]
        step, curve = found.omega[k + 1] - found.omega[k], a - 2 * b + c
        if curve < 0 and abs(found.omega[k] - found.omega[k - 1] - step) < 1e-9:
            shift = (a - c) / (2 * curve)
            value, omega, bend = (
                float(b - (a - c) * shift / 4),
                float(omega + shift * step),
                float(-curve / step**2),
            )
    status = Status.OK if np.isfinite(value) else Status.NOT_FINITE
    error = float(found.deviation[k])
    return PeakEstimate(float(np.sqrt(value)), error, omega, float("nan"), bend, found.noise_variance, status)


def lpm(trace: Trace, *, lines: int = 6, order: int = 2) -> PeakEstimate:
    """Peak by the local polynomial method: G and the transients polynomial over 2 lines + 1 neighbours. R.
    Pintelon, J. Schoukens, System Identification: A Frequency Domain Approach, 2012, ch. 7."""
    plain = frequency_response(trace)
    N = len(trace.records[0])
    height = largest_gain(plain.response)
    sure = np.nan_to_num(plain.deviation)
    near = np.flatnonzero(height + 2 * sure >= 0.8 * np.max(height - 2 * sure))
    centres: list[int] = []
    for k in near[np.argsort(-height[near])]:
        line = round(float(plain.omega[k]) * N / (2 * np.pi))
        if all(abs(line - c) > lines for c in centres) and len(centres) < 40:
            centres.append(line)
    found = [local_peak(trace, lines=lines, orders=(order, 0, order), centre=c) for c in centres]
    return max(found, key=lambda f: f.value - 2 * f.standard_error if np.isfinite(f.value) else -np.inf)
