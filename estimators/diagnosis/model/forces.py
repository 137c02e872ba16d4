"""Force balance of a motion: mass, viscous and dry friction by least squares, and the simulation that starts from it."""

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import minimize
from scipy.signal import butter, sosfiltfilt

from estimators.diagnosis.effects import named
from estimators.diagnosis.effects.disturbances.added import OFFSET
from estimators.diagnosis.model.fitting import Channel, Fit, fit
from estimators.diagnosis.model.simulation import simulate
from estimators.diagnosis.model.structure import Part, Structure
from oed.data import Record
from oed.errors import InputError

Array = NDArray[Any]


@dataclass(frozen=True)
class ForceBalance:
    """gain u = mass q'' + viscous q' + coulomb sign(q') + offset, each coefficient with its standard error.

    `mass, viscous, coulomb, offset` value and standard error, in units of gain times input per unit of the
    derivative of the output; `share` share of the force's variance that the balance explains.
    """

    mass: tuple[float, float]
    viscous: tuple[float, float]
    coulomb: tuple[float, float]
    offset: tuple[float, float]
    share: float


def force_balance(record: Record, *, gain: float = 1.0, cutoff: float | None = None) -> ForceBalance:
    """Inverse dynamics of one degree of freedom by least squares on filtered derivatives of the position.

    Both sides pass the same low-pass filter without delay, so that differentiation amplifies no noise. Valid
    in closed loop as long as the force is known: the input is the regressand.
    """
    if record.n_inputs != 1 or record.n_outputs != 1:
        raise InputError(
            f"a force balance needs one input and one output, not {record.n_inputs} and {record.n_outputs}."
        )
    n = len(record)
    if n < 400:
        raise InputError(f"the record has {n} samples; a force balance needs at least 400: measure longer.")
    rate = 1.0 / record.dt
    corner = 0.1 * rate if cutoff is None else float(cutoff)
    narrow = butter(4, min(corner, 0.45 * rate) / (0.5 * rate), output="sos")
    wide = butter(4, min(corner / 4, 0.2 * rate) / (0.5 * rate), output="sos")
    q = sosfiltfilt(narrow, record.y[:, 0])
    v = np.gradient(q, record.dt)
    X = np.stack([np.gradient(v, record.dt), v, np.sign(v), np.ones(n)], axis=1)
    edge = n // 50
    X = sosfiltfilt(wide, X, axis=0)[edge : n - edge]
    target = gain * sosfiltfilt(wide, record.u[:, 0])[edge : n - edge]
    size = np.sqrt(np.mean(X**2, axis=0)) + 1e-300

    theta = np.linalg.lstsq(X / size, target, rcond=None)[0] / size
    rest = target - X @ theta
    spread = float(np.sqrt(np.mean(rest**2) * len(rest) / effective_samples(rest)))
    error = spread * np.sqrt(np.diag(np.linalg.pinv((X / size).T @ (X / size)))) / size
    pairs = [(float(a), float(b)) for a, b in zip(theta, error, strict=True)]
    return ForceBalance(*pairs, share=1.0 - float(np.var(rest) / (np.var(target) + 1e-300)))


def balanced_fit(channel: Channel, dt: float, balance: ForceBalance) -> Fit | None:
    """Integrator with dry friction, its simulation error minimised from the force balance's parameters.

    The simulation error over a long run has corners (the axis sticks a sample earlier or later), so that
    Gauss-Newton is followed by a simplex search. The start is the measured one: left free, it would take up
    part of the drift, which no new record repeats.
    """
    m, f, c, o = balance.mass[0], balance.viscous[0], balance.coulomb[0], balance.offset[0]
    if min(m, f, c) <= 0 or channel.u.shape[1] != 1:
        return None
    rate = f / m * dt
    gain = dt * dt / m / rate
    s = replace(Structure(2, (0,), layout="integrator").adding(Part(OFFSET)), base=1)
    s = s.adding(Part(named("coulomb_asymmetric")))
    p = np.array([np.log(rate), gain, 0.0, channel.y[0], c, np.clip(o / c, -0.9, 0.9)])
    scales = np.array([1.0, gain, gain, 0.0, c, 1.0])
    few = fit(channel, s, p, scales, iterations=30, colour=False)
    free = np.array([0, 1, 4, 5])

    def error(z: Array) -> float:
        q = p.copy()
        q[free] = z * scales[free]
        out = simulate(s, q, channel.u, channel.clock)
        return float(np.mean((channel.y - out)[channel.keep] ** 2)) if np.all(np.isfinite(out)) else 1e30

    best = p
    for start in (p, few.p):
        z = start[free] / scales[free]
        z = minimize(error, z, method="Nelder-Mead", options={"maxfev": 300, "xatol": 1e-6, "fatol": 0.0}).x
        if error(z) < error(best[free] / scales[free]):
            best = p.copy()
            best[free] = z * scales[free]
    found = fit(channel, s, best, scales, iterations=0)
    J = fit(channel, s, best, scales, iterations=1, colour=False).jacobian
    # the errors are correlated over most of the record: standard errors by the number of independent samples
    r = found.residual
    variance = float(np.mean(r**2)) * len(r) / effective_samples(r)
    return replace(
        found, jacobian=J * np.sqrt(found.variance / variance), weight=found.noise, whitened=found.noise
    )


def effective_samples(r: Array) -> float:
    """Number of independent samples in a correlated residual, n over its integrated correlation time.

    Shapes: r (N,).
    """
    n = len(r)
    e = r - np.mean(r)
    power = np.abs(np.fft.rfft(e, 2 * n)) ** 2
    rho = np.fft.irfft(power)[:n]
    rho = rho / (rho[0] + 1e-300)
    negative = np.flatnonzero(rho < 0)
    last = int(negative[0]) if len(negative) else n
    return float(np.clip(n / (2.0 * np.sum(rho[:last]) - 1.0), 8.0, n))
