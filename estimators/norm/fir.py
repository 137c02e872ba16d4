"""Impulse response by least squares, and its peak gain: the plug-in estimate.

y_t = sum_k g_k u_(t-k) + e_t with n taps g_k (ny x nu), from rest, over all records together:

    g^ = R^-1 F,   R = sum phi phi',   F = sum phi y',   cov = lambda_e R^-1

The number of taps is given, or chosen by an information criterion, or made harmless by a kernel that expects the
response to decay (TC: cov(g_i, g_j) = c a^max(i, j), c and a by marginal likelihood)."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import cast

import numpy as np
from numpy.typing import NDArray
from scipy.linalg.lapack import dpocon, dpotrf, dtrtrs

from estimators.norm.local_models import PeakEstimate
from estimators.rules.trace import Trace
from oed.data import Record, frozen
from oed.errors import InputError, Status, check_names
from oed.plants.norms import largest_gain, refined_maximum

CANDIDATES = (*range(1, 61), 90)
"""Numbers of taps to choose from: all up to 60, and 90 for what rings longer."""


@dataclass(frozen=True, eq=False)
class FirModel:
    """An estimated impulse response. `taps` (n, ny, nu); `covariance` (n nu, n nu) covariance of one output's
    taps per unit of noise variance, tap-major; `noise` (ny,) estimated noise variances; `loss` sum over
    outputs of log residual variance; `samples` samples used."""

    taps: NDArray[np.float64]
    covariance: NDArray[np.float64]
    noise: NDArray[np.float64]
    loss: float
    samples: int


def _records(data: Trace | Sequence[Record]) -> list[Record]:
    records = list(data.records) if isinstance(data, Trace) else list(data)
    if not records:
        raise InputError("there are no records; give at least one.")
    if not all(r.complete for r in records):
        raise InputError("a record has missing samples (NaN); this estimator needs complete records.")
    return records


def _moments(records: list[Record], taps: int) -> tuple[NDArray, NDArray, NDArray, int]:
    """R, F and sum y y' of all records, with zeros before the first sample. The first block row of R and all
    of F are correlations, by Fourier transforms of all records at once; down a diagonal of R every block
    loses the product of the two samples that leave at the end of the record, R[i+1, j+1] = R[i, j] -
    u_(N-1-i) u_(N-1-j)'."""
    from scipy.fft import irfft, next_fast_len

    nu, ny = records[0].n_inputs, records[0].n_outputs
    size = cast(int, next_fast_len(max(map(len, records)) + taps - 1, real=True))
    U, Y = (_transforms(signals, size) for signals in ([r.u for r in records], [r.y for r in records]))
    own = np.asarray(irfft(np.einsum("mak,mbk->abk", U, np.conj(U)), size))[..., :taps]
    crossed = np.asarray(irfft(np.einsum("mak,mok->aok", np.conj(U), Y), size))[..., :taps]
    ends = np.zeros((len(records), taps, nu))
    for record, end in zip(records, ends, strict=True):
        end[: len(record)] = record.u[::-1][:taps]
    ends = ends.reshape(len(records), taps * nu)
    lost = (ends.T @ ends).reshape(taps, nu, taps, nu)
    # Rows of taps + 1 blocks turn the diagonals into columns: all are summed at once. What lies below them is overwritten.
    along = np.zeros((taps + 1, taps, nu, nu))
    along[0] = own.transpose(2, 0, 1)
    along[1:-1, 1:] = -lost[:-1, :, :-1].transpose(0, 2, 1, 3)
    along = along.reshape(taps, taps + 1, nu, nu).cumsum(axis=0).reshape(taps + 1, taps, nu, nu)[:-1]
    R = along.transpose(0, 2, 1, 3).reshape(taps * nu, taps * nu)
    R = np.triu(R) + np.triu(R, 1).T
    S = sum((r.y.T @ r.y for r in records), start=np.zeros((ny, ny)))
    return R, crossed.transpose(2, 0, 1).reshape(taps * nu, ny), S, sum(map(len, records))


def _transforms(signals: list[NDArray], size: int) -> NDArray:
    """(records, channels, lines), zeros after the ends."""
    from scipy.fft import rfft

    padded = np.zeros((len(signals), signals[0].shape[1], size))
    for row, signal in zip(padded, signals, strict=True):
        row[:, : len(signal)] = signal.T
    return np.asarray(rfft(padded))


def _excited(R: NDArray, factor: NDArray | None = None) -> bool:
    """Whether least squares can tell the taps apart: the condition of R is below 1e12. With the Cholesky
    factor, where there is one, LAPACK's estimate of the condition spares most the eigenvalues."""
    if factor is not None and dpocon(factor, np.abs(R).sum(axis=0).max(), uplo="L")[0] > 1e-9:
        return True
    values = np.linalg.eigvalsh(R)
    return bool(values[0] > 1e-12 * values[-1])


def plug_in(data: Trace | Sequence[Record], taps: int | None = None, *, kernel: str = "none") -> FirModel:
    """Impulse response of given length from all records together."""
    check_names([kernel], ("none", "tc"), "kernel")
    records = _records(data)
    if taps is None:
        taps, (R, F, S, samples) = _selected(records, CANDIDATES)
        n = taps * records[0].n_inputs
        return _solve(R[:n, :n], F[:n], S, samples, taps, kernel)
    longest = max(map(len, records))
    if not isinstance(taps, int | np.integer) or not 1 <= taps < longest:
        raise InputError(f"taps is {taps!r}; it must be a positive integer below the {longest} samples.")
    R, F, S, samples = _moments(records, int(taps))
    if kernel == "none" and not _excited(R):
        raise InputError(
            f"the input does not excite {taps} taps (condition {np.linalg.cond(R):.1e}); "
            "take fewer taps, a richer input, or kernel='tc'."
        )
    return _solve(R, F, S, samples, int(taps), kernel)


def _solve(R: NDArray, F: NDArray, S: NDArray, samples: int, taps: int, kernel: str) -> FirModel:
    n, ny = F.shape
    nu = n // taps
    g, noise = np.zeros((n, ny)), np.zeros(ny)
    covariance = np.linalg.inv(R) if kernel == "none" else np.linalg.pinv(R, hermitian=True)
    plain = covariance @ F
    for i in range(ny):
        g[:, i] = plain[:, i]
        noise[i] = max(S[i, i] - F[:, i] @ plain[:, i], 1e-300) / max(samples - n, 1)
        if kernel == "tc":
            P = _tc(R, F[:, i], noise[i], taps, nu)
            g[:, i] = P @ np.linalg.solve(R @ P + noise[i] * np.eye(n), F[:, i])
            covariance = P @ np.linalg.inv(R @ P / noise[i] + np.eye(n)) / noise[i]
    loss = float(np.sum(np.log(np.maximum(noise * max(samples - n, 1) / samples, 1e-300))))
    response = g.reshape(taps, nu, ny).transpose(0, 2, 1)
    return FirModel(frozen(response), frozen((covariance + covariance.T) / 2), frozen(noise), loss, samples)


def _tc(R: NDArray, f: NDArray, noise: float, taps: int, nu: int) -> NDArray:
    """The TC kernel that makes the data likeliest, (n nu, n nu) tap-major."""
    from scipy.optimize import minimize

    later = np.maximum.outer(np.arange(taps), np.arange(taps)) + 1.0
    decay = lambda x: float(1 / (1 + np.exp(-x)))
    kernel = lambda x: np.exp(x[0]) * np.kron(decay(x[1]) ** later, np.eye(nu))

    def minus_log_likelihood(x: NDArray) -> float:
        P = kernel(x)
        L = np.linalg.cholesky(P + 1e-12 * np.trace(P) / len(P) * np.eye(len(P)))
        inner = np.eye(len(P)) + L.T @ R @ L / noise
        v = L.T @ f / noise
        return float(np.linalg.slogdet(inner)[1] - v @ np.linalg.solve(inner, v))

    found = minimize(minus_log_likelihood, [0.0, 2.0], method="Nelder-Mead", options={"maxiter": 200})
    return kernel(found.x)


def select_taps(data: Trace | Sequence[Record], candidates: Sequence[int] = CANDIDATES) -> int:
    """Number of taps with the smallest Bayesian information criterion."""
    return _selected(_records(data), candidates)[0]


def _selected(
    records: list[Record], candidates: Sequence[int]
) -> tuple[int, tuple[NDArray, NDArray, NDArray, int]]:
    """The number of taps, and the moments of the largest number tried."""
    longest = max(min(len(r) for r in records) // 2, 1)
    tried = sorted(n for n in candidates if n <= longest) or [1]
    nu = records[0].n_inputs
    R, F, S, samples = moments = _moments(records, max(tried))
    factor = None
    while tried:
        size = tried[-1] * nu
        factor, failed = dpotrf(R[:size, :size], lower=1)
        if not failed and _excited(R[:size, :size], factor):
            break
        tried.pop()  # the condition of a leading block grows with it
    if factor is None or not tried:
        raise InputError("the input is zero or excites no tap; apply another input.")
    # One factor serves all: what the first n taps explain are the first rows of L^-1 F.
    explained = np.cumsum(dtrtrs(factor, F[: len(factor)], lower=1)[0] ** 2, axis=0)
    scores = {}
    for n in tried:
        rest = np.maximum((np.diag(S) - explained[n * nu - 1]) / samples, 1e-300)
        scores[n] = samples * float(np.sum(np.log(rest))) + np.log(samples) * n * nu * F.shape[1]
    return min(scores, key=scores.__getitem__), moments


def peak_of_fir(model: FirModel, points: int = 4096) -> PeakEstimate:
    """Largest gain of an impulse response, with the delta method's standard error."""
    n, ny, _ = model.taps.shape
    k = np.arange(n)
    response = lambda w: np.tensordot(np.exp(-1j * np.multiply.outer(w, k)), model.taps, 1)
    height = lambda w: largest_gain(response(w))
    heights = largest_gain(np.fft.rfft(model.taps, max(points, 2 * n), axis=0))
    step = np.pi / (len(heights) - 1)
    at = int(np.argmax(heights))
    omega = at * step
    if 0 < at < len(heights) - 1:
        omega = refined_maximum(height, omega - step, omega + step)
    U, s, Vh = np.linalg.svd(response(omega))
    wave = np.exp(-1j * omega * k)
    variance = 0.0
    for i in range(ny):  # d sigma = Re(u^* dG v)
        c = np.real(np.conj(U[i, 0]) * wave[:, None] * np.conj(Vh[0])[None, :]).ravel()
        variance += model.noise[i] * float(c @ model.covariance @ c)
    h = 1e-4
    squares = height(omega + h * np.array([-1.0, 0.0, 1.0])) ** 2
    bend = -(squares[2] - 2 * squares[1] + squares[0]) / h**2
    status = Status.OK if np.isfinite(s[0]) else Status.NOT_FINITE
    error = float(np.sqrt(max(variance, 0.0)))
    return PeakEstimate(float(s[0]), error, omega, np.nan, float(bend), float(model.noise.mean()), status)
