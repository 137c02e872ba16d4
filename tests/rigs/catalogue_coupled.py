"""The rigs, continued: several states that work on one another, and the linear controls, in which there is nothing to find."""

from __future__ import annotations

import numpy as np
from scipy.signal import lfilter

from tests.rigs import ode_kernels as ode
from tests.rigs.catalogue import (
    DISTURBANCE,
    DYNAMIC,
    INPUT,
    NOISE,
    NONE,
    TIME,
    Draw,
    about,
    between,
    rig,
    state,
)
from tests.rigs.catalogue_logged import resonant


def weighed(x, p, k, steps=20):
    """Load per metre laid down at the feeder, a belt's length later, behind the scale's lag."""
    v, s = x[:, 0], x[:, 1] - x[0, 1]
    v, s = np.r_[v[0], v], np.r_[-1.1 * p["L"], s]
    laid = np.interp(s[1:] - p["L"], s, p["q"] / np.maximum(v, 0.05))
    a = np.exp(-0.5 / steps / p["ts"])
    return lfilter([1 - a], [1, -a], laid, zi=[a * laid[0]])[0][::steps, None]


@rig(
    ode.conveyor,
    [DYNAMIC, TIME, INPUT],
    r"variable.*(delay|transport)|varying (delay|dead)|(speed|velocity|flow|input|state).?dependent.?(delay|transport|dead|gain)|conveyor|1/u|reciprocal|inverse",
    "belt drive and scale",
    "y = load laid down when int v = L ago, m = q/v: the delay goes with the belt's speed",
    "transport_delay hammerstein bilinear",
)
def conveyor(g):
    p = {"td": about(g, 0.8), "q": about(g, 12), "L": between(g, 3, 5), "ts": about(g, 0.7)}
    delays = (1, 4, 8, 11, 14, 18, 22)
    return Draw(
        p, 0.5, between(g, 0.7, 0.9), between(g, 0.18, 0.24), 0.12, (0.8, 0), weighed, lo=0.3, hi=1.6, settle=20, fine=True,
        delays=delays, units=("m/s", "kg/m"), noise=(0.01, 0.03), frozen="L",
    )  # fmt: skip


@rig(
    ode.gear_gap,
    [DYNAMIC],
    r"backlash|clearance|gap|play|dead.?(zone|band)|lost motion|gear|piecewise.?(linear )?stiff",
    "two inertias and a shaft",
    "torque = k dz + c |dz| phi', dz = dead zone of phi of half-width a: the coupling has clearance",
    "backlash input_deadzone duffing",
)
def coupling_clearance(g):
    p = {
        "K": about(g, 8),
        "b1": about(g, 1.5),
        "k": about(g, 120),
        "c": about(g, 120),
        "a": between(g, 0.08, 0.15),
        "J2": about(g, 1.2),
        "b2": between(g, 0.8, 1.5),
    }
    return Draw(
        p,
        0.02,
        0,
        1.0,
        0.16,
        (0, 0, 0),
        state(2),
        settle=0,
        order=3,
        units=("V", "rad/s"),
        kinds="prbs noise multisine steps",
    )


@rig(
    ode.slew_loop,
    [DYNAMIC],
    r"rate.?limit|slew|wind.?up|saturat|anti.?windup|actuator limit",
    "PI loop about two lags; the input is the set point",
    "|a'| < r, |v| < m, v = Kp e + I, I' = Kp e/Ti: slew limit and wind-up",
    "rate_limiter input_saturation",
)
def windup_loop(g):
    p = {
        "Kp": between(g, 1.3, 2),
        "Ti": about(g, 1.6),
        "t1": about(g, 1.2),
        "t2": about(g, 0.25),
        "m": between(g, 4.5, 6),
        "r": between(g, 3, 5),
        "gain": 1.0,
    }
    return Draw(
        p,
        0.06,
        2,
        between(g, 1.7, 2.3),
        0.05,
        (2, 2, 2, 2),
        state(3),
        frozen="gain",
        order=4,
        units=("bar", "bar"),
        kinds="steps operator prbs multisine",
    )


@rig(
    ode.mixing_tap,
    [DYNAMIC],
    r"product|bilinear|mixing|flow ?[x*] ?temperature|u1 ?\*|u2 ?\*|ratio|multiplicative|input.?dependent",
    "two valves, flow meter and thermometer, 2 inputs, 2 outputs",
    "V T' = q1 (T1 - T) + q2 (T2 - T): flow times temperature",
    "bilinear mimo_cross",
)
def mixing_tap(g):
    p = {
        "ta": about(g, 1.5),
        "V": about(g, 1.2),
        "T1": between(g, 60, 75),
        "T2": between(g, 8, 15),
        "tf": about(g, 1),
        "ts": about(g, 3),
    }
    u = [between(g, 4, 5), between(g, 4, 5)]
    return Draw(
        p, 1, u, [1.5, 1.5], 0.12, (4, 4, 35, 8, 35), state(3, 4), lo=0.6, hi=10, frozen="T1 T2", order=[2, 2], units=("l/min", "l/min, degC"),
        kinds="prbs noise multisine steps",
    )  # fmt: skip


@rig(
    ode.wind_tunnel,
    [DYNAMIC],
    r"drag|quadratic|v\^2|velocity.?squared|turbulent|aerodynamic|v ?\|v\||square.?root|nonlinear.?damping",
    "fan, moving air, hot wire",
    "v' = F - c v |v|: quadratic drag",
    "nonlinear_drag output_nonlinearity",
)
def wind_tunnel(g):
    p = {"ta": about(g, 0.5), "a": about(g, 0.08), "c": about(g, 0.02), "tf": about(g, 0.2)}
    return Draw(
        p,
        0.25,
        between(g, 40, 50),
        between(g, 19, 24),
        0.1,
        (4, 14, 14),
        state(2),
        lo=1,
        hi=100,
        frozen="c",
        units=("%", "m/s"),
        noise=(0.01, 0.03),
    )


@rig(
    ode.day_room,
    [DISTURBANCE],
    r"ambient|outdoor|outside|diurnal|\bday|daily|24 ?h|period|sinus|sine|weather",
    "room: air and wall",
    "C T' = u - h (T - Ta) - hw (T - Tw), Ta = T0 + A sin(2 pi t/day + phi)",
    "periodic_disturbance output_drift",
)
def day_swing(g):
    p = {
        "C": about(g, 6e4),
        "h": about(g, 30),
        "hw": about(g, 60),
        "Cw": about(g, 2.5e5),
        "T0": between(g, 6, 14),
        "A": between(g, 4, 7),
        "phi": between(g, 0, 6.28),
    }
    return Draw(
        p,
        120,
        500,
        between(g, 220, 300),
        0.07,
        (25, 25),
        state(0),
        lo=0,
        hi=1500,
        frozen="T0",
        units=("W", "degC"),
    )


@rig(
    ode.peltier,
    [DYNAMIC, INPUT],
    r"peltier|bilinear|product|joule|quadratic|u\^2|current squared|u ?\* ?[ty]|input.?(polynomial|nonlin)|hammerstein|parabol",
    "cold plate with sensor lag",
    "C T' = -a u (T + 273) + R u^2/2 + h (Ta - T)",
    "bilinear hammerstein",
)
def peltier(g):
    p = {
        "C": about(g, 25),
        "a": about(g, 0.05, 0.1),
        "R": between(g, 3.5, 4.5),
        "h": about(g, 0.7),
        "Ta": between(g, 18, 26),
        "ts": about(g, 4),
    }
    return Draw(
        p,
        2,
        between(g, 1.3, 1.7),
        between(g, 0.6, 0.8),
        0.08,
        (0, 0),
        state(1),
        lo=0,
        hi=4,
        frozen="Ta",
        units=("A", "degC"),
    )


def control(rhs, names, lin, near="", nature=(NONE,)):
    return rig(rhs, list(nature), names, lin, "linear", near, matters=False)


def coloured(std):
    return lambda g, n: std * lfilter([np.sqrt(1 - 0.94**2)], [1, -0.94], g.standard_normal(n))


@control(
    ode.oscillator,
    r"process noise|coloured|colored",
    "second order, disturbed at its input",
    "coloured_noise",
    (NONE, NOISE),
)
def linear_disturbed(g):
    return Draw(
        resonant(g), 0.05, 0, 1.3, 0.2, (0, 0, 0), state(2), hidden=coloured(between(g, 0.15, 0.3)), order=3
    )


@control(
    ode.two_lags,
    r"feedback|closed.?loop",
    "tank with heater, PI control in train, open loop in test",
    "closed_loop",
    (NONE, NOISE),
)
def linear_closed_loop(g):
    p = {"tau1": about(g, 25), "tau2": about(g, 6), "gain": about(g, 0.6)}
    return Draw(
        p,
        2,
        0,
        12,
        0.06,
        (0, 0),
        state(1),
        noise=(0.03, 0.06),
        gains=(2.5, 0.25),
        kinds="steps operator",
        units=("%", "K"),
    )


@control(ode.oscillator, r"no effect|operating", "second order about a level far from zero")
def linear_level(g):
    out = state(2, shift=between(g, 20, 200))
    return Draw(resonant(g), 0.05, between(g, 10, 40), 1.3, 0.2, (0, 0, 0), out, order=3, units=("%", "degC"))


@control(
    ode.coupled_springs,
    r"no effect|coupling|mimo",
    "two coupled masses, 2 inputs, 2 outputs",
    "mimo_cross",
    (NONE, "linear dynamics"),
)
def linear_two_by_two(g):
    p = {
        "g1": about(g, 10),
        "k1": about(g, 30),
        "c1": about(g, 2),
        "g2": about(g, 8),
        "k2": about(g, 50),
        "c2": about(g, 2.5),
        "k": about(g, 12),
    }
    return Draw(
        p,
        0.05,
        [0, 0],
        [1, 1],
        0.2,
        (0, 0, 0, 0),
        state(0, 2),
        order=[4, 4],
        units=("N", "mm"),
        kinds="prbs noise multisine",
    )
