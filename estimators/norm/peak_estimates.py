"""Peak-gain estimates from the iterations' records without the bias of [S] Theorem 12.

The bias of beta_2 is what the input spends away from the peak, (1/2pi) int (gamma^2 - |G|^2) Phi dw: in the limit
lambda_e - delta, nearly all of it on the white floor; before the limit also on the lines beside the peak.

    corrected     gamma = the peak of a local rational model of G fitted where the iterations put their power
    fixed_point   gamma^2 such that |G|^2 taken through the recursion (8) gives the measured mean of mu^2 + beta_2^2
    theorem_12    gamma^2 = mean beta_2^2 + the floor's share of lambda^ + what was measured beside the peak

`corrected` is the one to use: it alone has a standard error. The other two show what the theory of the limit spectrum
is good for: at variance 1 they remove 95 to 99 % of the bias. They take how |G|^2 falls beside the peak from the
local model and |G|^2 elsewhere from the records, and say INACCURATE where the inputs' spectra there are not those that
they assume, where a second peak is so nearly as high that its share has not settled (`two-peaks`), or where lambda^ is
so large beside gamma^2 that a small-noise formula says little."""

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from estimators.norm.gains import gain, mu
from estimators.norm.local_fits import Spectra
from estimators.norm.local_models import PeakEstimate, local_peak
from estimators.rules.trace import Trace
from oed.errors import InputError, Status
from oed.plants.norms import largest_gain

WINDOW = 5
"""DFT lines that a rough gain is averaged over."""
SMALL = 0.5
"""Share of gamma^2 from which on lambda_e is not small for Theorem 12."""
SETTLED = 0.2
"""Share of its first power that a second peak may have kept at the first experiment used."""
TOLERATED = 0.05
"""Share of lambda_e, the bias of beta_2^2, that an estimator by the limit spectrum may leave unexplained."""
NARROW = 20
"""Lines on each side of the narrower band, two thirds of the other's, that shows whether the width matters."""
RIVALS = 8
"""Bands that are looked at beside the first."""


def corrected(trace: Trace) -> PeakEstimate:
    """Bias-corrected estimate from the iterations' records: the highest peak of local models."""
    if not trace.kinds or trace.kinds[0] not in ("power", "averaged", "forward"):
        raise InputError(
            "this estimator is for the records of power iterations; for other inputs use lpm, a frequency "
            "response or a model."
        )
    return highest_peak(trace)


def highest_peak(trace: Trace) -> PeakEstimate:
    """The peak of the local model. Where the records do not exclude that another peak is higher, a local model is fitted there
    too. The one of the highest lower bound is returned; where another may be as high, within two standard errors, the
    status is COMPETING. Where no local model can be trusted, a value far off the plain gain of five lines is replaced by it."""
    spectra = Spectra.of(trace) if len({len(r) for r in trace.records}) == 1 else None
    first = local_peak(trace, spectra=spectra)
    if not np.isfinite(first.value):
        return first
    N = len(trace.records[0])
    height, deviation = _rough_gain(spectra or Spectra.of(trace), first.noise_variance)
    upper = 1.15 * height + 3 * deviation  # the ends of the records and the window hide some of a sharp peak
    line = np.arange(len(upper))
    rough = lambda k: PeakEstimate(
        float(height[k]), float(deviation[k]), 2 * np.pi * k / N, 0.0, 0.0, first.noise_variance, Status.INACCURATE,
    )  # fmt: skip
    reach = min(30, max(N // 8, 1))
    peaks, apart = [first], np.abs(line - first.frequency * N / (2 * np.pi)) > reach
    for _ in range(RIVALS):
        best = max(peaks, key=_lowest)
        open_ = np.where(apart, upper, -np.inf)
        k = int(np.argmax(open_))
        if not open_[k] > best.value - 3 * best.standard_error:
            break
        apart &= np.abs(line - k) > reach
        found = local_peak(trace, centre=k, spectra=spectra)
        if not np.isfinite(found.value):
            found = rough(k)
        if not any(_same(found, other, N) for other in peaks):
            peaks.append(found)
    trusted = [p for p in peaks if p.status.ok]
    if not trusted:  # the local model's value may be anything; that of five lines is coarse, but not wild
        plain = rough(round(first.frequency * N / (2 * np.pi)))
        return first if abs(first.value - plain.value) < 3 * plain.standard_error else plain
    best = max(trusted, key=lambda p: p.value - 2 * p.standard_error)
    rivals = [p for p in peaks if p is not best]
    wide = lambda p: 2 * float(np.hypot(p.standard_error, best.standard_error))
    competing = any(p.value + wide(p) >= best.value for p in rivals)
    best = width_left_open(best, trace, spectra)
    return replace(best, status=Status.COMPETING) if competing else best


def width_left_open(best: PeakEstimate, trace: Trace, spectra: Spectra | None = None) -> PeakEstimate:
    """The estimate with the error that the width of its band leaves open: what one from a narrower band differs is added to the
    variance. Were the model right, some of it would be expected (Hausman, Econometrica 1978); taking that off left the frequency of a
    peak among ten (`order-20`), which the local model has nearly, held in .92."""
    centre = round(best.frequency * len(trace.records[0]) / (2 * np.pi))
    narrow = local_peak(trace, lines=NARROW, centre=centre, spectra=spectra)
    wider = {}
    for value, error in (("value", "standard_error"), ("frequency", "frequency_error")):
        difference = getattr(narrow, value) - getattr(best, value)
        if np.isfinite(difference):  # the narrow band may have no number
            wider[error] = float(np.hypot(getattr(best, error), difference))
    return replace(best, **wider)


def _lowest(p: PeakEstimate) -> float:
    return p.value - 3 * p.standard_error if p.status.ok else -np.inf


def _same(a: PeakEstimate, b: PeakEstimate, N: int) -> bool:
    """Whether two bands found one peak."""
    errors = [e for e in (a.frequency_error, b.frequency_error) if np.isfinite(e)]
    return abs(a.frequency - b.frequency) < max(3 * 2 * np.pi / N, *(4 * e for e in errors), 0.0)


def _rough_gain(spectra: Spectra, noise: float) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Largest gain at every DFT line by least squares over a few lines and all records, and its deviation."""
    U, Y = spectra.U, spectra.Y
    smooth = lambda a: np.apply_along_axis(lambda v: np.convolve(v, np.ones(WINDOW), "same"), 0, a)
    powers = smooth(np.swapaxes(U, 1, 2) @ np.conj(U))
    cross = smooth(np.swapaxes(Y, 1, 2) @ np.conj(U))
    floor = 1e-12 * np.einsum("kii->k", powers).real.max() * np.eye(U.shape[2])
    inverse = np.linalg.inv(powers + floor)
    return largest_gain(cross @ inverse), np.sqrt(noise * largest_gain(inverse))


@dataclass(frozen=True, eq=False)
class _Inputs:
    """What the estimators by the limit spectrum need of a trace of Algorithm 1."""

    local: PeakEstimate
    first: int  # the first iteration used
    mu2: float  # mean of mu^2 from there on
    beta2: float  # mean of beta_2^2
    flat: NDArray  # (K,) white noise of unit power on half DFT lines
    power: NDArray  # (M, K) the inputs' periodograms of unit power
    near: NDArray  # (K,) whether the line belongs to the band of the local model
    loss: NDArray  # (K,) gamma^2 - |G|^2 of the local model, there
    far: NDArray  # (K,) |G|^2 measured elsewhere
    apart: NDArray  # (K,) whether the line lies more than three half-widths from the peak

    def squares(self, square: float) -> NDArray[np.float64]:
        """|G|^2 with the peak `square`."""
        return np.where(self.near, np.maximum(square - self.loss, 0.0), self.far)

    def tail(self, noise: float, trace: Trace) -> float:
        """Output power that the end of the record cuts off: what rings on decays by the half-width."""
        half_width = np.sqrt(2 * self.local.value**2 / self.local.curvature)
        last = max(4, round(2 / half_width))
        end = np.mean([np.mean(r.y[-last:] ** 2) for r in trace.records[self.first :]]) - noise
        return float(max(end, 0.0) / (2 * half_width * len(trace.records[0])))

    def status(self, square: float, difference: NDArray, variance: float) -> Status:
        """INACCURATE where what the far lines cost differs from what was assumed by a share of the bias
        removed. And where another peak's share of the power, which falls as (|G|^2 / gamma^2)^n, has not
        settled before the first experiment that is used."""
        off = abs(float(np.where(self.near, 0.0, square - self.far) @ difference))
        rival = float(np.max(self.far, where=self.apart & ~self.near, initial=0.0)) / max(square, 1e-300)
        settled = rival**self.first < SETTLED
        return Status.OK if off < TOLERATED * variance and settled else Status.INACCURATE


def _inputs(trace: Trace, discard: float) -> _Inputs:
    if not trace.kinds or trace.kinds[0] != "power" or len(trace) < 4:
        raise InputError("this estimator needs at least 4 experiments of Algorithm 1 (kind power).")
    first = max(int(len(trace) * discard), 1)
    local = corrected(trace)
    N = len(trace.records[0])
    u = np.array([r.u[:, 0] for r in trace.records])
    power = np.abs(np.fft.rfft(u, 2 * N, axis=1)) ** 2
    omega = np.pi * np.arange(N + 1) / N
    flat = np.full(N + 1, 2.0)
    flat[[0, -1]] = 1.0
    power *= flat
    band, squares = local.shape
    near, loss = np.zeros(N + 1, bool), np.zeros(N + 1)
    if band.size:
        near = (omega >= band[0]) & (omega <= band[-1])
        loss[near] = squares.max() - np.interp(omega[near], band, squares)
    far = np.interp(omega, omega[::2], _far_squares(trace, local.noise_variance))
    apart = np.abs(omega - local.frequency) > 3 * np.sqrt(2 * local.value**2 / max(local.curvature, 1e-300))
    return _Inputs(
        local, first, float(mu(trace).squares[first:].mean()), float(gain(trace).squares[first:].mean()),
        flat / flat.sum(), power / power.sum(axis=1, keepdims=True), near, loss, far, apart,
    )  # fmt: skip


def _far_squares(trace: Trace, noise: float) -> NDArray[np.float64]:
    """|G|^2 on the DFT lines by least squares over the records, less what the noise adds, smoothed over lines."""
    U, Y = (
        np.fft.rfft([s[:, 0] for s in side], axis=1)
        for side in zip(*((r.u, r.y) for r in trace.records), strict=True)
    )
    power = np.maximum(np.sum(np.abs(U) ** 2, axis=0), 1e-300)
    squares = np.abs(np.sum(Y * np.conj(U), axis=0) / power) ** 2 - noise * len(trace.records[0]) / power
    smooth = lambda v: np.convolve(v, np.ones(2 * WINDOW + 1), "same")
    return np.maximum(smooth(squares * power) / smooth(power), 0.0)


def theorem_12(trace: Trace, discard: float = 0.3) -> PeakEstimate:
    """[S] Theorem 12 solved for gamma, with lambda_e estimated as mu^2 - beta_2^2.

        gamma^2 = mean beta_2^2 + f lambda^ + (1/2pi) int_near (gamma^2 - |G|^2) Phi^ dw + tail

    On the share f of all frequencies that does not belong to the peak the limit spectrum (9) loses f
    lambda_e. Beside the peak the limit is not reached in tens of iterations (the width falls as the root of
    their number), so the loss there, and what the end of the record cuts off, are measured instead of taken
    from the limit.
    """
    inputs = _inputs(trace, discard)
    local, variance = inputs.local, inputs.mu2 - inputs.beta2
    if not (local.curvature > 0 and inputs.near.any()):
        return _from_square(inputs.beta2 + variance, local, variance, Status.INACCURATE)
    used = inputs.power[inputs.first - 1 : -1].mean(axis=0)
    far = float(inputs.flat @ ~inputs.near)
    found = inputs.beta2 + far * variance + float(used @ inputs.loss) + inputs.tail(max(variance, 0.0), trace)
    assumed = variance * inputs.flat / np.maximum(inputs.mu2 - inputs.far, 1e-300)
    status = inputs.status(found, used - assumed, variance)
    return _from_square(found, local, variance, status if variance < SMALL * found else Status.INACCURATE)


def fixed_point(trace: Trace, discard: float = 0.2) -> PeakEstimate:
    """The recursion of the spectra, [S] (8), whose fixed point is (9)-(10), solved for gamma. |G|^2 = gamma^2
    less the local model's fall from its peak, in its band, and as measured elsewhere, is taken through the
    experiments from the first input's own periodogram. In the band, where the inputs' spectra keep their
    random differences for as long as the iterations last, every experiment begins from its measured
    periodogram. gamma^2 is such that the mean of mu^2 + beta_2^2 over the later experiments is what was
    measured."""
    from scipy.optimize import brentq

    inputs = _inputs(trace, discard)
    local, first, near, power = inputs.local, inputs.first, inputs.near, inputs.power
    noise, variance = local.noise_variance, inputs.mu2 - inputs.beta2
    if not (noise > 0 and local.curvature > 0 and near.any()):
        return _from_square(inputs.mu2, local, variance, Status.INACCURATE)
    beside = power[:, near].sum(axis=1)
    measured = inputs.mu2 + inputs.beta2 + 2 * inputs.tail(noise, trace)
    expected = np.zeros_like(power[0])

    def predicted(square: float) -> float:
        squares, p, total = inputs.squares(square), power[0], 0.0
        expected[:] = 0.0
        for m in range(len(power)):
            beta2 = squares @ p
            if m >= first:
                total += 2 * beta2 + noise
                expected[:] += p
            if m + 1 < len(power):
                new = (squares * p + noise * inputs.flat) / (beta2 + noise)
                p = power[m + 1].copy()
                p[~near] = new[~near] * (1 - beside[m + 1]) / max(new[~near].sum(), 1e-300)
        return total / (len(power) - first)

    low, high = 1e-2 * inputs.mu2, 4 * inputs.mu2
    if predicted(low) > measured or predicted(high) < measured:
        return _from_square(inputs.mu2, local, variance, Status.INACCURATE)
    root = float(np.asarray(brentq(lambda square: predicted(square) - measured, low, high, xtol=1e-10)))
    difference = power[first:].mean(axis=0) - expected / (len(power) - first)
    return _from_square(root, local, variance, inputs.status(root, difference, noise))


def _from_square(square: float, local: PeakEstimate, variance: float, status: Status) -> PeakEstimate:
    local = replace(local, standard_error=float("nan"), noise_variance=variance)
    if not (square > 0 and np.isfinite(square)):
        return replace(local, value=float("nan"), status=Status.NEGATIVE_SQUARE)
    return replace(local, value=float(np.sqrt(square)), status=local.status if status.ok else status)
