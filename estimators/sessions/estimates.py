"""The estimate that a session has so far, with its uncertainty."""

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from estimators.norm.peak_estimates import PeakEstimate, highest_peak
from estimators.residual.measures import stated
from estimators.rules.trace import Trace
from estimators.sessions.settings import Settings
from oed.errors import OedError, Status


@dataclass(frozen=True, eq=False)
class SessionEstimate:
    """Peak gain of what the session experiments on. `value` H-infinity norm; NaN before the first
    measurement; `standard_error` NaN where there is none yet; `interval` 95 % interval; `frequency` where the
    gain peaks, in rad/sample; `frequency_error` its standard error; infinite where the records do not say
    where the peak is: `frequency` is then only the place that was looked at; `direction` (nu,) complex: the
    worst-case input direction there; `estimator` which estimator the numbers are from; `status` whether they
    can be trusted; `gains` the method's own estimate after every iteration, where it has one; `noise_floor`
    standard deviation of the noise on one sample of each output, after averaging; from the scatter of the
    periods where there are several, otherwise from the estimator, the same for all outputs; `message` what a
    reader should know; `dt` sampling time in seconds."""

    value: float
    standard_error: float
    interval: tuple[float, float]
    frequency: float
    frequency_error: float
    direction: NDArray[np.complex128]
    estimator: str
    status: Status
    gains: tuple[float, ...] = ()
    noise_floor: tuple[float, ...] = ()
    message: str = ""
    dt: float = 1.0

    def __str__(self) -> str:
        if not np.isfinite(self.value):
            return self.message or self.status.value
        tail = "" if self.status.ok else f" ({self.message or self.status.value})"
        known = np.isfinite(self.frequency_error)
        turns = 2 * np.pi * self.dt
        where = (
            f"at {stated(self.frequency / turns, self.frequency_error / turns)} Hz"
            if known
            else "at no sure frequency"
        )
        return (
            f"peak gain {self.value:.6g}, 95 % interval {self.interval[0]:.6g} to {self.interval[1]:.6g}, {where}, "
            f"by {self.estimator}{tail}"
        )


def estimate_of(
    settings: Settings, records: Trace, own: Trace, scatter: NDArray[np.float64] | None = None
) -> SessionEstimate:
    """Estimate from what was measured: scatter (ny,)."""
    nan = float("nan")
    if not len(records):
        return SessionEstimate(
            nan, nan, (nan, nan), nan, nan, np.zeros(settings.n_inputs, complex), "none", Status.SINGULAR,
            message="there is no estimate yet: nothing is recorded.", dt=settings.dt,
        )  # fmt: skip
    found, name, why = _peak(settings, records)
    gains = _gains(own)
    direction = _direction(records)
    if not np.isfinite(found.value):  # the crude one, with an interval that says how crude
        value = next((g for g in reversed(gains) if np.isfinite(g)), _ratio(own))
        found = PeakEstimate(value, float("inf"), _frequency(records), nan, nan, nan, Status.INACCURATE)
        name = "gain"
    floor = scatter if scatter is not None and np.isfinite(scatter).all() else None
    noise = np.full(settings.n_outputs, found.noise_variance) if floor is None else floor
    low, high = found.interval() if np.isfinite(found.standard_error) else (0.0, float("inf"))
    return SessionEstimate(
        found.value, found.standard_error, (max(low, 0.0), high), found.frequency,
        found.frequency_error if found.located else float("inf"), direction, name, found.status, gains,
        tuple(float(np.sqrt(v)) if v >= 0 else nan for v in noise), why, settings.dt,
    )  # fmt: skip


def _peak(settings: Settings, records: Trace) -> tuple[PeakEstimate, str, str]:
    """The method's estimator, and the local model where that fails."""
    why = ""
    if settings.method in ("two-stage", "sequential"):
        try:
            return _by_model(settings, records), "model", ""
        except OedError as error:
            why = f"no model of the orders {settings.orders} fits yet: {error}"
    if settings.method == "bandit" and settings.periodic:  # from rest its lines leak into each other
        from estimators.rules.bandit import best_arm

        return best_arm(records), "best line", ""
    try:
        return highest_peak(records), "local model", why
    except OedError as error:
        nan = float("nan")
        return PeakEstimate(nan, nan, nan, nan, nan, nan, Status.SINGULAR), "none", str(error)


def _by_model(settings: Settings, records: Trace) -> PeakEstimate:
    from estimators.pem import identify

    fit = identify(list(records.records), "oe", settings.entry_orders, delay=settings.delay, offset=False)
    value, error, frequency = fit.hinf_norm
    return PeakEstimate(
        float(value), float(error), float(frequency), fit.hinf_frequency_error, float("nan"),
        float(fit.noise_variance), fit.status,
    )  # fmt: skip


def _gains(own: Trace) -> tuple[float, ...]:
    if own.kinds[0] not in ("power", "forward"):
        return ()
    from estimators.norm.gains import gain

    return tuple(map(float, gain(own).values))


def _ratio(own: Trace) -> float:
    last: Any = next((r for r in reversed(own.records) if r.u.any()), own.records[0])
    return float(np.linalg.norm(last.y) / max(float(np.linalg.norm(last.u)), 1e-300))


def _frequency(records: Trace) -> float:
    from estimators.norm.worst_inputs import dominant_frequency

    return dominant_frequency(records.records[records.iterations[-1].start].u)


def _direction(records: Trace) -> NDArray[np.complex128]:
    from estimators.norm.worst_inputs import worst_case

    return worst_case(records).input_direction
