"""A local rational model of the frequency response around the peak, and the estimate of the peak it gives.

G = B(x) / A(x), x the distance from the centre of a band in DFT lines, with a transient of its own in every
experiment, is fitted to all lines in the band by refined instruments (`estimators.norm.local_fits`), which is maximum
likelihood at its fixed point: nothing about the plant outside the band is assumed, and the standard error comes with it.
"""

from dataclasses import dataclass, field, replace
from math import sqrt

import numpy as np
from numpy.typing import NDArray

from estimators.norm.local_fits import Band, Spectra, fit_band, response
from estimators.rules.trace import Trace
from oed.covariances import NORMAL
from oed.errors import InputError, Status
from oed.plants.norms import largest_gain, refined_maximum

GRID = np.linspace(-1, 1, 401)
"""Distances from the centre of a band at which the peak is first sought."""


@dataclass(frozen=True, eq=False)
class PeakEstimate:
    """An estimate of the peak gain with its uncertainty. `value` estimate of the H-infinity norm;
    `standard_error` its standard error (NaN where the estimator has none); `frequency, frequency_error` where
    the peak lies, rad/sample; `curvature` H^ = -d2 sigma_max^2 / dw2 at the peak; `noise_variance` estimated
    variance of the noise per output; `status` INACCURATE where the peak lies at the edge of the band or the
    error is so large that a normal interval cannot be trusted; COMPETING where another peak may be the higher
    one; `shape` (2, K) frequencies of the band, rad/sample, and the local model's squared largest gain there;
    empty where the estimator has none."""

    value: float
    standard_error: float
    frequency: float
    frequency_error: float
    curvature: float
    noise_variance: float
    status: Status = Status.OK
    shape: NDArray = field(default_factory=lambda: np.empty((2, 0)), repr=False)

    def interval(self, level: float = 0.95) -> tuple[float, float]:
        """Normal confidence interval."""
        from scipy.stats import norm

        half = float(norm.ppf((1 + level) / 2)) * self.standard_error
        return self.value - half, self.value + half

    @property
    def located(self) -> bool:
        """Whether `frequency` can be taken as the peak's, within its error: no other peak competes."""
        return self.status.ok and bool(np.isfinite(self.frequency_error))

    def __repr__(self) -> str:
        tail = "" if self.status.ok else f" ({self.status.value})"
        at = f"at {self.frequency:.6g} +- {self.frequency_error:.2g}"
        where = at if self.located else f"near {self.frequency:.3g}"
        return f"peak gain {self.value:.6g} +- {self.standard_error:.2g} {where} rad/sample{tail}"


def _centre(trace: Trace, spectra: Spectra) -> int:
    """The DFT line where the later first-stage inputs carry most power, smoothed over five lines."""
    first = [part.start for part in trace.iterations]
    power = np.sum(np.abs(spectra.U[:, first[len(first) // 3 :]]) ** 2, axis=(1, 2))
    return int(np.argmax(np.convolve(power, np.ones(5), "same")))


def local_peak(
    trace: Trace, *, lines: int = 30, orders: tuple[int, int, int] | None = None, centre: int | None = None,
    spectra: Spectra | None = None,
) -> PeakEstimate:  # fmt: skip
    """Peak of a local rational model fitted to all records of a trace."""
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
    spectra = spectra or Spectra.of(trace)
    place = _centre(trace, spectra) if centre is None else centre
    found, at = [(np.inf, _failed())], 0.0
    for _ in range(4):  # the band follows the peak it finds
        band = Band.of(spectra, place, half)
        fits = [_fit(band, each, N) for each in candidates]
        _, best, at = min(fits, key=lambda row: (not row[1].status.ok, row[0]))
        found = [row[:2] for row in fits]
        if abs(at) <= 0.5 or not np.isfinite(best.value):
            break
        moved = round(_folded((place + at * half) * 2 * np.pi / N) * N / (2 * np.pi))
        if moved == place:
            break
        place = moved
    return _average(found)


def _average(found: list[tuple[float, PeakEstimate]]) -> PeakEstimate:
    """The models' estimates with Akaike's weights; the error includes what the choice of the model leaves
    open. se = sum w_i sqrt(se_i^2 + (value_i - value)^2) (Buckland, Burnham and Augustin, Biometrics 1997)."""
    usable = [row for row in found if row[1].status.ok] or [row for row in found if np.isfinite(row[0])]
    if len(usable) < 2:
        return usable[0][1] if usable else found[0][1]
    criteria = np.array([row[0] for row in usable])
    weights = np.exp(criteria.min() - criteria)
    weights /= weights.sum()
    mean = lambda name: float(weights @ np.array([getattr(e, name) for _, e in usable]))
    best = usable[int(np.argmax(weights))][1]
    wide = lambda error, value: float(
        weights @ [np.hypot(getattr(e, error), getattr(e, value) - mean(value)) for _, e in usable]
    )
    return replace(
        best, value=mean("value"), standard_error=wide("standard_error", "value"), frequency=mean("frequency"),
        frequency_error=wide("frequency_error", "frequency"), curvature=mean("curvature"),
        noise_variance=mean("noise_variance"), shape=np.tensordot(weights, [e.shape for _, e in usable], 1),
    )  # fmt: skip


def _fit(band: Band, orders: tuple[int, int, int], N: int) -> tuple[float, PeakEstimate, float]:
    """Akaike's criterion, the estimate, and where in the band its peak lies."""
    fit = fit_band(band, orders)
    if fit is None:
        return np.inf, _failed(), 0.0
    shape = (band.n_inputs, band.n_outputs)
    estimate, x = _peak_of_model(fit.theta, fit.information, band, orders, shape, float(fit.noise.mean()), N)
    return fit.criterion if np.isfinite(estimate.value) else np.inf, estimate, x


def _gradient(theta: NDArray, x: NDArray, G: NDArray, orders: tuple[int, int, int]) -> NDArray:
    """(K, parameters) c with d sigma_max^2 = Re(c d theta): c = 2 sigma u* (dG / d theta) v, at the responses G."""
    nb, na, _ = orders
    X = x[:, None] ** np.arange(max(nb, na) + 1)
    A = 1 + X[:, 1 : na + 1] @ theta[len(theta) - na :]
    s, pairs = _principal(G)
    numerators = pairs[..., None] * (X[:, : nb + 1] / A[:, None])[:, None, None]
    denominators = -s * X[:, 1 : na + 1] / A[:, None]
    return 2 * s * np.hstack([numerators.reshape(len(x), -1), denominators])


def _principal(G: NDArray) -> tuple[NDArray, NDArray]:
    """(K, 1) largest singular values sigma and (K, ny, nu) their conj(u) v', so that sigma = Re sum conj(u) v' G."""
    if G.shape[1:] == (1, 1):
        s = np.abs(G[:, 0])
        return s, np.conj(G) / np.maximum(s, 1e-300)[:, None]
    u, s, vh = np.linalg.svd(G)
    return s[:, :1], np.conj(u[:, :, 0])[:, :, None] * np.conj(vh[:, 0])[:, None, :]


def _peak_of_model(
    theta: NDArray, information: NDArray, band: Band, orders: tuple[int, int, int], shape: tuple[int, int],
    noise: float, N: int,
) -> tuple[PeakEstimate, float]:  # fmt: skip
    nu, ny = shape

    def square(x: NDArray) -> NDArray:
        return largest_gain(response(theta, x, nu, ny, orders)) ** 2

    heights = square(GRID)
    if not np.isfinite(heights).all():
        return _failed(), 0.0
    k = int(heights.argmax())
    x, inside = float(GRID[k]), 0 < k < len(GRID) - 1
    if inside:
        x = refined_maximum(square, GRID[k - 1], GRID[k + 1])
    try:
        covariance = np.linalg.inv(information)
    except np.linalg.LinAlgError:
        return _failed(), 0.0
    h = 1e-3
    places = np.concatenate([[x - h, x, x + h], band.x])
    G = response(theta, places, nu, ny, orders)
    squares = largest_gain(G) ** 2
    value = sqrt(squares[1])
    bend = -float(squares[2] - 2 * squares[1] + squares[0]) / h**2
    below, height, above = _gradient(theta, places[:3], G[:3], orders)
    spread = lambda g: sqrt(max(float((g @ covariance @ np.conj(g)).real) / 2, 0.0))
    error = spread(height) / (2 * value)
    per_line = 2 * np.pi / N
    # The slope is zero within its error as far off as the bend, which is not known either, lets it (Fieller).
    sure = bend * abs(bend) - (NORMAL * spread((above - 2 * height + below) / h**2)) ** 2
    where_error = (
        spread((above - below) / (2 * h)) / sqrt(sure) * band.half * per_line if sure > 0 else np.inf
    )
    sharp = bend > 0 and where_error < 0.25 * band.half * per_line
    trusted = inside and sharp and error < 0.1 * value
    estimate = PeakEstimate(
        value, error, _folded((band.centre + band.half * x) * per_line), where_error,
        bend / (band.half * per_line) ** 2, noise, Status.OK if trusted else Status.INACCURATE,
        np.array([(band.centre + band.half * band.x) * per_line, squares[3:]]),
    )  # fmt: skip
    return estimate, x


def _folded(omega: float) -> float:
    """The frequency in [0, pi] of a real system's equal peaks at omega and -omega: a band may reach over 0 or pi."""
    return float(abs((omega + np.pi) % (2 * np.pi) - np.pi))


def _failed() -> PeakEstimate:
    nan = float("nan")
    return PeakEstimate(nan, nan, nan, nan, nan, nan, Status.SINGULAR)
