"""Records of the classes that common rigs show: sensors that fold, processes that fill and empty, clocks, stores.

Each maker draws nothing but what it is given: an input, a generator and the effect's strength, 0 for the same rig without
it. Simulated with small Euler steps in plain Python, or filtered; shares no code with the models that are fitted.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from scipy.signal import lfilter

from tests.estimators.diagnosis.case_parts import (
    FINE,
    lag,
    linear,
    process,
    read,
    sensor,
    swing,
    wheel,
)

__all__ = ["CLASSES", "LOOKALIKES"]


def exponential(u, a):
    return linear(np.expm1(4.0 * a * lag(u, 0.6)) / (4.0 * a) if a else lag(u, 0.6))


def power(u, a):
    return linear(np.sign(u) * np.abs(u) ** (1.0 + a))


def saturating(u, a):
    return linear(np.tanh(1.2 * a * (u - 0.3)) / 1.2 / a if a else u)


def over_the_top(u, a):
    """A modulator that is driven past its brightest."""
    return linear(np.sin(1.3 * a * (u - 0.5)) / 1.3 / a if a else u)


def kink(u, a):
    return linear(u + a * np.tanh(6.0 * u))


def relay(u, a):
    state, out = -1.0, np.empty(len(u))
    for k, value in enumerate(u):
        state = 1.0 if value > 0.4 else -1.0 if value < -0.4 else state
        out[k] = state
    return linear(a * out + (1 - a) * u)


def stuck(u, a):
    stem, out = 0.0, np.empty(len(u))
    for k, command in enumerate(u):
        if abs(command - stem) > 0.5 * a:
            stem = command - 0.2 * a * np.sign(command - stem)
        out[k] = stem
    return linear(out)


def loose(u, a):
    """A mass that a spring pulls after the drive across a gap."""
    return swing(
        lambda x, v, f, t: (
            0.2 * (d := f - x) * (abs(d) > 0.4 * a) - 0.08 * a * np.sign(d) * (abs(d) > 0.4 * a) - 0.15 * v
        ),
        u,
    )


def sprung(u, a):
    """A mass on a spring of its own, which a servo moves by another spring across a gap."""
    gap = lambda d: d - min(max(d, -0.5 * a), 0.5 * a)
    return swing(lambda x, v, f, t: 0.3 * gap(f - x) - 0.05 * x - 0.2 * v, lag(lag(u, 0.5), 0.6))


def dragged(u, a):
    z, out = 0.0, np.empty(len(u))
    for k, value in enumerate(u):
        for _ in range(4 * FINE):
            d = value / (4 * FINE)
            z += (d - abs(d) * (z + np.sign(d) * abs(z)) / (2 * 1.5)) if d else 0.0
        out[k] = value + a * z / 1.5
    return linear(out)


def sigmoid(u, a):
    x = linear(u)
    return np.tanh(a * (x - 0.5) / np.std(x)) if a else x


def logarithm(u, a):
    x = linear(u) / 3.0
    return np.expm1(-a * x) / -a if a else x


def magnitude(u, a):
    x = linear(u)
    return np.abs(x) if a else x


def squared(u, a):
    x = linear(u)
    return x**2 if a else x


def rectified(u, a):
    x = linear(u)
    return np.maximum(x, 0.0) if a else x


def wrapped(u, a):
    x = 45.0 * linear(u)
    fine = np.interp(np.arange((len(x) - 1) * FINE + 1) / FINE, np.arange(len(x)), x)
    turned = (fine + 40.0 + 180.0) % 360.0 - 180.0 if a else fine
    return lag(turned, 0.5 ** (1.0 / FINE))[::FINE]


def rise_and_fall(u, a):
    return linear(process(lambda x, v: (0.04 + 0.12 * a * (v > x)) * (v - x), u, u[0]))


def orifice(u, a):
    rate = lambda d: (0.05 + 0.1 * a * (d > 0)) * (d / np.sqrt(abs(d) + 0.05) if a else d)
    return linear(process(lambda x, v: rate(v - x), u, u[0]))


def loss(u, a):
    x0 = np.roots([0.02 * a, 0.0, 1.0, -u[0]]) if a else np.array([u[0] + 0j])
    start = float(x0[np.argmin(np.abs(x0.imag))].real)
    return sensor(process(lambda x, v: 0.05 * (v - x - 0.02 * a * x**3), u, start), start)


def outflow(u, a):
    root = lambda x: np.sqrt(max(x, 0.0)) * 2.0 if a else x
    start = (u[0] / 2.0) ** 2 if a else u[0]
    return sensor(process(lambda x, v: 0.05 * (v - root(x)), u, start), start)


def vessel(u, a):
    area = lambda x: 1.0 + (0.4 * a * x) ** 2
    root = lambda x: np.sqrt(max(x, 0.0)) * 2.0 if a else x
    start = (u[0] / 2.0) ** 2 if a else u[0]
    return sensor(process(lambda x, v: 0.1 * (v - root(x)) / area(x), u, start), start)


def melting(u, a):
    capacity = lambda x: 1.0 + 4.0 * a * np.exp(-(((x - 3.8) / 0.6) ** 2))
    return linear(process(lambda x, v: 0.12 * (v - x) / capacity(x), u, u[0]))


def through_flow(u, a):
    if not a:
        return linear(u)
    heated = process(lambda x, v: 0.03 * (1.0 - v * x), u, 1.0 / u[0])
    through, k = np.cumsum(u), np.arange(len(u))
    entered = np.interp(through - 12.0, through, k, left=-1.0)
    left = np.interp(entered, np.arange(-1, len(u)), np.concatenate((heated[:1], heated)))
    return sensor(left, left[0], 0.6)


def pendulum_of_two(u, a):
    pull = lambda x: np.sin(0.7 * a * x) / 0.7 / a if a else x
    return swing(lambda x, v, f, t: 0.06 * (f[0] + 0.6 * f[1] - pull(x)) - 0.05 * v, u)


def pendulum(u, a):
    pull = lambda x: np.sin(0.7 * a * x) / 0.7 / a if a else x
    return swing(lambda x, v, f, t: 0.06 * (f - pull(x)) - 0.05 * v, u)


def pivot(u, a):
    moved = lag(u, 0.7)
    push = np.concatenate(([0.0], np.diff(moved))) * 5.0
    pull = lambda x: np.sin(0.7 * a * x) / 0.7 / a if a else x
    return swing(lambda x, v, f, t: 0.06 * (f * (np.cos(0.7 * x) if a else 1.0) - pull(x)) - 0.05 * v, push)


def eccentric(u, a):
    return wheel(u, 0.08, 0.8 * a, 0.25)


def eccentric_of_two(u, a):
    return eccentric(u[:, 0] + 0.4 * u[:, 1], a)


def filling(u, a):
    return swing(lambda x, v, f, t: (0.06 * (f - x) - 0.03 * v) / (1.0 + a * t / 700.0), u)


def softening(u, a):
    return swing(lambda x, v, f, t: 0.06 * (f - (1.0 - 0.5 * a * t / 700.0) * x) - 0.03 * v, u)


def charged(u, a):
    """A line that swings on an accumulator, whose gas is charged more and more."""
    return swing(lambda x, v, f, t: 0.06 * (1.0 + 0.6 * a * t / 700.0) * (f - x) - 0.03 * v, u)


def electrostatic(u, a):
    """A mass on a spring that the voltage softens, beside the force that it exerts."""
    return swing(lambda x, v, f, t: 0.06 * (f - (1.0 - 0.035 * a * f * f) * x) - 0.03 * v, u)


def fouled(u, a):
    """A process behind which a probe lags ever more."""
    x, z, out = lag(u, 0.8), u[0], np.empty(len(u))
    for k, value in enumerate(x):
        out[k] = z
        z += (value - z) * (1.0 - np.exp(-1.0 / (3.0 + 12.0 * a * (1.0 - np.exp(-k / 300.0)))))
    return out


def heated_gain(u, a):
    warm = np.asarray(lfilter([1 / 60.0], [1, -1 + 1 / 60.0], u**2))
    return linear(u * (1.0 + 0.4 * a * warm))


def steered(u, a):
    """A servo that rises and falls at limited speeds of its own; its mean over a sample acts."""
    x, out = u[0], np.zeros(len(u))
    for k, value in enumerate(u):
        for _ in range(FINE):
            speed = 0.5 * (value - x)
            x += (min(max(speed, -0.25), 0.15) if a else speed) / FINE
            out[k] += x / FINE
    return linear(out)


def wound_up(u, a):
    """A drive of its own controller, the set point as input: a limited torque, an integrator that knows nothing of it."""
    x = i = u[0]
    out, h = np.zeros(len(u)), 1.0 / FINE
    for k, value in enumerate(u):
        out[k] = x
        for _ in range(FINE):
            torque = 4.0 * (value - x) + i
            x += h * 0.08 * ((np.clip(torque, -1.2, 1.2) if a else torque) - x)
            i += h * 0.6 * (value - x)
    return out


def thermostat(u, a):
    """A cabinet whose fan carries off more from the upper level of its temperature on, until the lower one is reached."""
    x, on, out = u[0], False, np.zeros(len(u))
    for k, value in enumerate(u):
        out[k] = x
        for _ in range(FINE):
            on = x > 0.3 or (on and x > -0.2)
            x += 0.06 / FINE * (value - x - (a * 0.8 * (x + 1.5) if on else 0.0))
    return out


def stairs(u, a):
    return linear(0.8 * np.round((u - 0.1) / 0.8) if a else u)


def swaying(u, a):
    return linear(u * (1.0 + 0.5 * a * np.cos(0.05 * np.arange(len(u)) + 1.0)))


def breathing(u, a):
    return swing(lambda x, v, f, t: 0.06 * (f - (1.0 + 0.4 * a * np.cos(0.05 * t + 1.0)) * x) - 0.05 * v, u)


def modulated_flow(u, a):
    """The second input is a valve in the way of the first."""
    flow = u[:, 0] * u[:, 1]
    return linear(u[:, 0]) - 0.5 * linear(u[:, 1]) + a * 0.5 * linear(lag(flow, 0.6))


def carried_off(u, a):
    """The second input also carries off what the first has filled in: it multiplies the state."""
    slope = lambda x, v: 0.08 * (v[0] - 0.5 * v[1] - x - 0.5 * a * v[1] * x)
    start = (u[0, 0] - 0.5 * u[0, 1]) / (1.0 + 0.5 * a * u[0, 1])
    return sensor(process(slope, u, start), start)


def pushed_twice(u, a):
    """Two forces on one mass whose spring hardens."""
    return swing(lambda x, v, f, t: 0.06 * (f[0] - 0.7 * f[1] - x - 0.3 * a * x**3) - 0.03 * v, u)


def store(u, a):
    charge = np.concatenate(([0.0], np.cumsum(u)[:-1])) / 700.0
    curve = -0.5 * charge + a * (0.3 * np.expm1(-10.0 * charge) - 0.2 * np.exp(15.0 * (charge - 1.0)))
    return curve - 0.05 * lag(u, 0.9)


def clock_drift(u, a):
    return read(u, np.arange(len(u)) * (1.0 - 0.005 * a))


def warming_clock(u, a):
    k = np.arange(len(u))
    return read(u, k - 3.0 * a * (1.0 - np.exp(-(k + 30.0) / 150.0)))


def lost_samples(u, a):
    k = np.arange(len(u))
    return read(u, k - 2.0 * a * (k > 300))


def refreshed(u, a):
    k = np.arange(len(u))
    return read(u, np.maximum(np.floor((k - 0.7) / 3.37) * 3.37 + 0.7, 0.0) if a else k)


def cut_off(u, a):
    y = linear(u)
    return np.where(y > 3.5, y, 0.0) if a else y


def shown_in_steps(u, a):
    y = linear(u)
    return 1.5 * np.round(y / 1.5) if a else y


def in_turns(u, a):
    y = linear(u)
    return y - a * (np.arange(len(u)) % 5 == 2) * (0.25 * y + 0.3)


def running_in(u, a):
    return linear(u * (1.0 + 0.8 * a * np.exp(-np.arange(len(u)) / 120.0)))


def sweep(u, a):
    k = np.arange(len(u))
    return linear(u) + 0.3 * a * np.cos(0.3 * k + 0.5 * 0.002 * k**2 + 0.4)


_Maker = Callable[[np.ndarray, float], np.ndarray]
_LEVEL = {"mean": 4.0, "size": 1.5}
CLASSES: dict[str, tuple[_Maker, int, dict[str, float]]] = {
    # key of the effect: (record, order of the linear model, its input)
    "input_exponential": (exponential, 3, {"mean": 0.6, "size": 0.2}), "input_power": (power, 2, _LEVEL),
    "input_tanh": (saturating, 2, {}), "input_sine": (over_the_top, 2, {}), "input_kink": (kink, 2, {}), "relay": (relay, 2, {}),
    "stiction": (stuck, 2, {}), "clearance": (loose, 2, {}), "clearance_sprung": (sprung, 4, {}),
    "hysteresis_rate": (dragged, 2, {}), "output_sigmoid": (sigmoid, 2, {}), "output_exponential": (logarithm, 2, {}),
    "magnitude": (magnitude, 2, {}), "squared": (squared, 2, {}), "rectified": (rectified, 2, {}),
    "wrapped": (wrapped, 3, {}), "rise_and_fall": (rise_and_fall, 3, _LEVEL), "rise_and_fall of a switched heater": (rise_and_fall, 3, {**_LEVEL, "two": True}), "orifices": (orifice, 3, _LEVEL),
    "loss_cubic": (loss, 2, _LEVEL), "outflow_root": (outflow, 2, _LEVEL), "vessel": (vessel, 2, _LEVEL),
    "capacity_bump": (melting, 3, _LEVEL), "output_cutoff": (cut_off, 2, {"mean": 2.0, "size": 1.0}), "gain_settles": (running_in, 2, {}),
    "output_staircase": (shown_in_steps, 2, {}), "multiplexed": (in_turns, 2, {}),
    "through_flow": (through_flow, 2, {"mean": 4.0, "size": 1.2}), "pendulum": (pendulum, 2, {"size": 0.4}),
    "pendulum_pivot": (pivot, 3, {"size": 0.8}), "position_periodic": (eccentric, 2, {"mean": 3.0, "size": 0.6}),
    "inertia_drift": (filling, 2, {}), "stiffness_drift": (softening, 2, {}), "stiffness_squared": (electrostatic, 2, {"mean": 3.0, "size": 0.8}),
    "gain_heat": (heated_gain, 2, {}), "resonance_drift": (charged, 2, {}),
    "integral_curve": (store, 2, {"mean": 1.0, "size": 0.6}), "clock_drift": (clock_drift, 2, {}),
    "lost_samples": (lost_samples, 2, {}), "refreshed": (refreshed, 2, {}),
    "clock_settles": (warming_clock, 4, {}), "sweep": (sweep, 2, {}), "rate_limit_servo": (steered, 3, {}), "input_staircase": (stairs, 2, {}),
    "gain_periodic": (swaying, 2, {}), "stiffness_periodic": (breathing, 2, {}), "lag_drift": (fouled, 2, {}), "wind_up": (wound_up, 2, {}), "relay_feedback": (thermostat, 2, {}),
    "product_of_inputs": (modulated_flow, 3, {"mean": 2.0, "size": 0.7, "inputs": 2}),
    "bilinear": (carried_off, 2, {"mean": 2.0, "size": 0.7, "inputs": 2}),
    "stiffness_cubic": (pushed_twice, 2, {"inputs": 2}), "pendulum of two": (pendulum_of_two, 2, {"size": 0.35, "inputs": 2}),
    "position_periodic of two": (eccentric_of_two, 2, {"mean": 2.5, "size": 0.6, "inputs": 2}),
}  # fmt: skip

LOOKALIKES = {
    # effect: a record that looks like it and is not
    "input_exponential": "rise_and_fall", "input_tanh": "input_kink", "input_sine": "input_kink", "resonance_drift": "lag_drift", "relay": "hysteresis_rate", "magnitude": "squared",
    "squared": "magnitude", "rectified": "magnitude", "rise_and_fall": "input_power", "orifices": "vessel",
    "loss_cubic": "rise_and_fall", "vessel": "rise_and_fall", "capacity_bump": "loss_cubic", "output_cutoff": "magnitude", "gain_settles": "stiffness_drift", "output_staircase": "wrapped", "multiplexed": "gain_periodic", "pendulum": "inertia_drift", "inertia_drift": "pendulum",
    "stiffness_drift": "inertia_drift", "clock_drift": "inertia_drift", "lost_samples": "stiffness_drift", "refreshed": "lost_samples", "sweep": "pendulum",
    "stiffness_squared": "stiffness_drift", "gain_heat": "input_kink", "stiction": "relay", "clearance": "stiction", "clearance_sprung": "stiction",
    "product_of_inputs": "bilinear", "stiffness_cubic": "bilinear", "bilinear": "product_of_inputs",
    "rate_limit_servo": "rise_and_fall", "input_staircase": "input_kink", "gain_periodic": "stiffness_periodic",
    "stiffness_periodic": "gain_periodic", "lag_drift": "inertia_drift", "clock_settles": "lost_samples",
    "relay_feedback": "relay", "wind_up": "rate_limit_servo", "rate_limit": "wind_up",
}  # fmt: skip
