"""Peak-gain estimates from the iterations' records without the bias of [S] Theorem 12.

The bias of beta_2 is what the input's white floor costs: (1/2pi) int (gamma^2 - |G|^2) Phi dw = lambda_e - delta.
Two estimators subtract its expectation, the third does not need to:

    theorem_12    gamma^2 = mean beta_2^2 + lambda^ - lambda^^2 / (2 H^),   lambda^ = mean(mu^2 - beta_2^2)
    fixed_point   gamma^2 such that a resonance of curvature H^ taken through the recursion (8) gives mean mu^2
    corrected     gamma = the peak of a local rational model of G fitted where the iterations put their power

The first still carries the transient of the iterations, both carry the edge effect (theory.md section 6). The model
G = B(x) / A(x), x the distance from the peak in DFT lines, with a transient of its own in every experiment, is
fitted to all lines in the band by refined instruments, which is maximum likelihood at its fixed point: nothing
about the plant outside the band is assumed, and the standard error comes with it.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial

import numpy as np
from numpy.typing import NDArray

from estimators.gains import gain, mu
from estimators.trace import Trace
from oed.errors import InputError, Status

__all__ = ["PeakEstimate", "corrected", "fixed_point", "local_peak", "theorem_12"]


@dataclass(frozen=True, eq=False)
class PeakEstimate:
    """An estimate of the peak gain with its uncertainty.

    Attributes
    ----------
    value : float
        Estimate of the H-infinity norm.
    standard_error : float
        Its standard error (NaN where the estimator has none).
    frequency, frequency_error : float
        Where the peak lies, rad/sample.
    curvature : float
        H^ = -d2 sigma_max^2 / dw2 at the peak.
    noise_variance : float
        Estimated variance of the noise per output.
    status : Status
        INACCURATE where the peak lies at the edge of the band or the error is so large that a normal
        interval cannot be trusted.
    """

    value: float
    standard_error: float
    frequency: float
    frequency_error: float
    curvature: float
    noise_variance: float
    status: Status = Status.OK

    def interval(self, level: float = 0.95) -> tuple[float, float]:
        """Normal confidence interval.

        Parameters
        ----------
        level : float
            Coverage asked for.

        Returns
        -------
        tuple of float
            Lower and upper end; trust it where the status is OK.
        """
        from scipy.stats import norm

        half = float(norm.ppf((1 + level) / 2)) * self.standard_error
        return self.value - half, self.value + half

    def __repr__(self) -> str:
        tail = "" if self.status.ok else f" ({self.status.value})"
        return (
            f"peak gain {self.value:.6g} +- {self.standard_error:.2g} at "
            f"{self.frequency:.6g} +- {self.frequency_error:.2g} rad/sample{tail}"
        )


def _centre(trace: Trace) -> int:
    """The DFT line where the later first-stage inputs carry most power, smoothed over five lines."""
    inputs = [trace.records[part][0].u for part in trace.iterations]
    power = sum(np.sum(np.abs(np.fft.rfft(u, axis=0)) ** 2, axis=1) for u in inputs[len(inputs) // 3 :])
    return int(np.argmax(np.convolve(np.asarray(power), np.ones(5), "same")))


@dataclass(frozen=True, eq=False)
class _Band:
    """DFT lines around a centre: U (K, M, nu), Y (K, M, ny), x (K,) in [-1, 1].

    A band that reaches over 0 or pi holds some lines and their conjugates: the model then has the symmetry of a
    real system, and the information counts those lines twice (`repeats`).
    """

    U: NDArray
    Y: NDArray
    x: NDArray
    centre: int
    half: int
    repeats: float


def _band(trace: Trace, centre: int, half: int) -> _Band:
    N = len(trace.records[0])
    k = np.arange(centre - half, centre + half + 1)
    transform = lambda signals: np.stack([np.fft.fft(s, axis=0)[k % N] for s in signals], 1) / np.sqrt(N)
    U, Y = transform([r.u for r in trace.records]), transform([r.y for r in trace.records])
    across = k[0] < 0 or k[-1] > N // 2
    return _Band(U, Y, (k - centre) / half, centre, half, 2.0 if across else 1.0)


def local_peak(
    trace: Trace, *, lines: int = 30, orders: tuple[int, int, int] | None = None, centre: int | None = None
) -> PeakEstimate:
    """Peak of a local rational model fitted to all records of a trace.

    Parameters
    ----------
    trace : Trace
        Records of one length, of any method.
    lines : int
        DFT lines on each side of the centre.
    orders : tuple of int, optional
        Orders in x of the numerators, of the common denominator and of the transients' numerators; by default
        Akaike's criterion chooses between (2, 1, 2) and (3, 2, 2).
    centre : int, optional
        DFT line to begin from; default where the inputs carry most power.

    Returns
    -------
    PeakEstimate
        Largest gain of the model in the band.

    Raises
    ------
    InputError
        If the records differ in length or are too short for the band.
    """
    lengths = {len(r) for r in trace.records}
    if len(lengths) != 1:
        raise InputError(
            f"the records have {sorted(lengths)} samples; this estimator needs them of one length."
        )
    (N,) = lengths
    candidates = [orders] if orders else [(2, 1, 2), (3, 2, 2)]
    half = min(lines, max(N // 8, 1))
    if 2 * half + 1 < sum(candidates[-1]) + 4:
        raise InputError(f"records of {N} samples have too few DFT lines for a local model; use longer ones.")
    place = _centre(trace) if centre is None else centre
    found = (np.inf, _failed(), 0.0)
    for _ in range(4):  # the band follows the peak it finds
        band = _band(trace, place, half)
        found = min(
            (_fit(band, each, N) for each in candidates), key=lambda row: (not row[1].status.ok, row[0])
        )
        if abs(found[2]) <= 0.5 or not np.isfinite(found[1].value):
            break
        moved = int(np.clip(place + round(found[2] * half), 0, N // 2))
        if moved == place:
            break
        place = moved
    return found[1]


def _fit(band: _Band, orders: tuple[int, int, int], N: int) -> tuple[float, PeakEstimate, float]:
    """Akaike's criterion, the estimate, and where in the band its peak lies."""
    nb, na, nt = orders
    K, M, nu = band.U.shape
    ny = band.Y.shape[2]
    X = np.vander(band.x, max(orders) + 1, increasing=True).astype(complex)
    a, model = np.zeros(na, complex), band.Y
    weights, noise, freedom = np.ones(ny), np.ones(ny), 1.0
    theta, normal, information = np.zeros(0, complex), np.eye(1), np.eye(1)
    nparameters = nu * ny * (nb + 1) + na
    for _ in range(8):
        A = 1 + X[:, 1 : na + 1] @ a
        filtered = partial(_without_transients, q=np.linalg.qr(X[:, : nt + 1] / A[:, None])[0], A=A)
        inputs = [filtered(X[:, k, None, None] * band.U) for k in range(nb + 1)]
        outputs = [filtered(-X[:, k, None, None] * band.Y) for k in range(1, na + 1)]
        instruments = [filtered(-X[:, k, None, None] * model) for k in range(1, na + 1)]
        target = filtered(band.Y)
        normal = np.zeros((nparameters, nparameters), complex)
        information = np.zeros_like(normal)
        right = np.zeros(nparameters, complex)
        for i in range(ny):
            own = range(i * nu * (nb + 1), (i + 1) * nu * (nb + 1))
            index = np.array([*own, *range(nparameters - na, nparameters)])
            common = [part[:, :, j].ravel() for j in range(nu) for part in inputs]
            R = np.array(common + [part[:, :, i].ravel() for part in outputs])
            Z = np.array(common + [part[:, :, i].ravel() for part in instruments])
            normal[index[:, None], index] += weights[i] * (np.conj(Z) @ R.T)
            information[index[:, None], index] += weights[i] * (np.conj(Z) @ Z.T)
            right[index] += weights[i] * (np.conj(Z) @ target[:, :, i].ravel())
        try:
            theta = np.linalg.solve(normal, right)
        except np.linalg.LinAlgError:
            return np.inf, _failed(), 0.0
        a = theta[nparameters - na :]
        A = 1 + X[:, 1 : na + 1] @ a
        G = _response(theta, X, nu, ny, orders)
        q = np.linalg.qr(X[:, : nt + 1] / A[:, None])[0]
        rest = band.Y - np.einsum("kij,kmj->kmi", G, band.U)
        model = band.Y - _without_transients(rest, q=q, A=np.ones(K))
        freedom = max(M * (K - nt - 1) - nparameters / ny, 1.0)
        noise = np.sum(np.abs(band.Y - model) ** 2, axis=(0, 1)) / freedom
        weights = 1 / np.maximum(noise, 1e-300)
    size = M * K * ny / band.repeats
    criterion = size * float(np.mean(np.log(noise * freedom / (M * K)))) + 2 * nparameters / band.repeats
    estimate, x = _peak_of_model(
        theta, information / band.repeats, band, orders, (nu, ny), float(noise.mean()), N
    )
    return criterion if np.isfinite(estimate.value) else np.inf, estimate, x


def _without_transients(Z: NDArray, *, q: NDArray, A: NDArray) -> NDArray:
    """Z / A less its part in the span of the transients."""
    Z = Z / A[:, None, None]
    return Z - np.tensordot(q, np.tensordot(np.conj(q.T), Z, 1), 1)


def _response(theta: NDArray, X: NDArray, nu: int, ny: int, orders: tuple[int, int, int]) -> NDArray:
    nb, na, _ = orders
    B = theta[: nu * ny * (nb + 1)].reshape(ny, nu, nb + 1)
    A = 1 + X[:, 1 : na + 1] @ theta[len(theta) - na :]
    return np.einsum("kl,ijl->kij", X[:, : nb + 1], B) / A[:, None, None]


def _peak_of_model(
    theta: NDArray,
    information: NDArray,
    band: _Band,
    orders: tuple[int, int, int],
    shape: tuple[int, int],
    noise: float,
    N: int,
) -> tuple[PeakEstimate, float]:
    from scipy.optimize import minimize_scalar

    nu, ny = shape
    vander = lambda x: np.vander(np.atleast_1d(x), max(orders) + 1, increasing=True).astype(complex)
    square = lambda x, t=theta: np.linalg.norm(_response(t, vander(x), nu, ny, orders), 2, axis=(1, 2)) ** 2
    grid = np.linspace(band.x[0], band.x[-1], 401)
    heights = square(grid)
    if not np.isfinite(heights).all():
        return _failed(), 0.0
    k = int(np.argmax(heights))
    x = float(grid[k])
    if 0 < k < 400:
        x = float(
            minimize_scalar(
                lambda s: -float(square(s)[0]),
                bounds=(grid[k - 1], grid[k + 1]),
                method="bounded",
                options={"xatol": 1e-9},
            ).x
        )
    try:
        covariance = np.linalg.inv(information)
    except np.linalg.LinAlgError:
        return _failed(), 0.0
    h = 1e-3
    value = float(np.sqrt(square(x)[0]))
    bend = -float((square(x + h) - 2 * square(x) + square(x - h))[0]) / h**2
    # Derivatives of the height and of the slope with respect to every complex coefficient.
    height = np.zeros(len(theta), complex)
    slope = np.zeros(len(theta), complex)
    for n in range(len(theta)):
        step = 1e-6 * max(1e-3, abs(theta[n]))
        for unit in (1, 1j):
            up, down = theta.copy(), theta.copy()
            up[n] += unit * step
            down[n] -= unit * step
            change = (square(np.array([x - h, x, x + h]), up) - square(np.array([x - h, x, x + h]), down)) / (
                2 * step
            )
            height[n] += np.conj(unit) * change[1]
            slope[n] += np.conj(unit) * (change[2] - change[0]) / (2 * h)
    spread = lambda g: float(np.sqrt(max(np.real(g @ covariance @ np.conj(g)) / 2, 0.0)))
    error = spread(height) / (2 * value)
    per_line = 2 * np.pi / N
    inside = 0 < k < 400
    where_error = spread(slope) / bend * band.half * per_line if bend > 0 else float("inf")
    sharp = bend > 0 and where_error < 0.25 * band.half * per_line
    trusted = inside and sharp and error < 0.1 * value
    estimate = PeakEstimate(
        value,
        error,
        float(np.clip((band.centre + band.half * x) * per_line, 0, np.pi)),
        where_error,
        bend / (band.half * per_line) ** 2,
        noise,
        Status.OK if trusted else Status.INACCURATE,
    )
    return estimate, x


def _failed() -> PeakEstimate:
    nan = float("nan")
    return PeakEstimate(nan, nan, nan, nan, nan, nan, Status.SINGULAR)


def corrected(trace: Trace) -> PeakEstimate:
    """Bias-corrected estimate from the iterations' records: the peak of the local model.

    Parameters
    ----------
    trace : Trace
        Of power iterations, the two-experiment scheme or Procedure 2.

    Returns
    -------
    PeakEstimate
        With standard error; free of the biases of [S] Theorem 12, of the edges and of the transient.
    """
    _need_iterations(trace)
    return local_peak(trace)


def _need_iterations(trace: Trace) -> None:
    if not trace.kinds or trace.kinds[0] not in ("power", "forward"):
        raise InputError(
            "this estimator is for the records of power iterations; for other inputs use lpm, a frequency "
            "response or a model."
        )


def _averages(trace: Trace, discard: float) -> tuple[int, float, float]:
    """First iteration used, means of mu^2 and of lambda^ = mu^2 - beta_2^2 from there on."""
    if not trace.kinds or trace.kinds[0] != "power" or len(trace) < 4:
        raise InputError("this estimator needs at least 4 experiments of Algorithm 1 (kind power).")
    first = max(int(len(trace) * discard), 1)
    mu2, beta2 = mu(trace).squares[first:], gain(trace).squares[first:]
    return first, float(mu2.mean()), float((mu2 - beta2).mean())


def theorem_12(trace: Trace, discard: float = 0.5) -> PeakEstimate:
    """[S] Theorem 12 solved for gamma, with lambda_e estimated as mu^2 - beta_2^2.

    Parameters
    ----------
    trace : Trace
        Of Algorithm 1.
    discard : float
        Share of the iterations left out at the beginning.

    Returns
    -------
    PeakEstimate
        Without a standard error. A small-noise statement: at lambda_e near gamma^2 its delta is far too small.
    """
    _, mu2, variance = _averages(trace, discard)
    local = local_peak(trace)
    alone = min(local.frequency, np.pi - local.frequency) < 2 * np.pi / len(trace.records[0])
    factor = 0.5 if alone else 2.0  # one peak in (-pi, pi], or two
    delta = factor * max(variance, 0.0) ** 2 / local.curvature if local.curvature > 0 else 0.0
    return _from_square(mu2 - delta, local, variance)


def fixed_point(trace: Trace, discard: float = 0.2) -> PeakEstimate:
    """The recursion of the spectra, [S] (8), whose fixed point is (9)-(10), solved for gamma.

    A resonance with the peak frequency and curvature of the local model, |G|^2 = g / (1 + H s^2 / (2 g)) with
    s = (cos w - cos w^) / sin w^, is taken through the experiments from the first input's own periodogram; g =
    gamma^2 is such that the mean of mu^2 + beta_2^2 over the later experiments is what was measured.

    Parameters
    ----------
    trace : Trace
        Of Algorithm 1.
    discard : float
        Share of the iterations left out at the beginning.

    Returns
    -------
    PeakEstimate
        Without a standard error. The noise variance is that of the local model's residuals.
    """
    from scipy.optimize import brentq

    first, mu2, variance = _averages(trace, discard)
    local = local_peak(trace)
    noise = local.noise_variance
    if not (noise > 0 and local.curvature > 0):
        return _from_square(mu2, local, variance)
    start = np.abs(np.fft.rfft(trace.records[0].u[:, 0])) ** 2
    w = 2 * np.pi * np.arange(len(start)) / len(trace.records[0])
    start[1 : (len(trace.records[0]) + 1) // 2] *= 2
    flat = np.where((w == 0) | (w == np.pi), 1.0, 2.0)
    flat /= flat.sum()
    away = ((np.cos(w) - np.cos(local.frequency)) / max(np.sin(local.frequency), 1e-2)) ** 2
    measured = 2 * mu2 - variance

    def predicted(square: float) -> float:
        shape = square / (1 + away * local.curvature / (2 * square))
        p, total = start / start.sum(), 0.0
        for m in range(len(trace)):
            beta2 = shape @ p
            total += 2 * beta2 + noise if m >= first else 0.0
            p = (shape * p + noise * flat) / (beta2 + noise)
        return total / (len(trace) - first)

    low, high = 1e-2 * mu2, 4 * mu2
    if predicted(low) > measured or predicted(high) < measured:
        return _from_square(mu2, local, variance)
    root = brentq(lambda square: predicted(square) - measured, low, high, xtol=1e-10)
    return _from_square(float(np.asarray(root)), local, variance)


def _from_square(square: float, local: PeakEstimate, variance: float) -> PeakEstimate:
    ok = square > 0 and np.isfinite(square)
    return PeakEstimate(
        float(np.sqrt(square)) if ok else float("nan"),
        float("nan"),
        local.frequency,
        local.frequency_error,
        local.curvature,
        variance,
        Status.OK if ok else Status.NEGATIVE_SQUARE,
    )
