"""Right-hand sides of the rigs, d = x', and one Runge-Kutta integrator for all of them.

w holds the input(s) of the sample, then a hidden disturbance where there is one, then the time in seconds; p the parameters in the
order of the rig's table. `jumps` are what a state does at once, between two steps: plays, stiction, relays.
"""

from __future__ import annotations

import numpy as np
from numba import njit, types

VECTOR = types.float64[::1]
RATE = types.void(VECTOR, VECTOR, VECTOR, VECTOR)
JUMP = types.void(VECTOR, VECTOR, VECTOR)
rate = njit(RATE, cache=True, error_model="numpy")
jump = njit(JUMP, cache=True, error_model="numpy")


@njit(
    types.float64[:, ::1](
        types.FunctionType(RATE),
        types.FunctionType(JUMP),
        VECTOR,
        types.float64[:, ::1],
        VECTOR,
        types.float64,
        types.int64,
        types.int64,
        types.int64,
    ),
    cache=True,
    error_model="numpy",
)
def integrate(f, event, p, u, x, h, first, steps, stride):
    """States every `stride` of the `steps` Runge-Kutta steps per sample of h seconds; x is left at the end of the record."""
    n, m = x.size, u.shape[1]
    log = np.empty((u.shape[0] * (steps // stride), n))
    a, b, c, d, s, w = np.empty(n), np.empty(n), np.empty(n), np.empty(n), np.empty(n), np.empty(m + 1)
    dt, row = h / steps, 0
    for k in range(u.shape[0]):
        w[:m] = u[k]
        for j in range(steps):
            t = (first + k) * h + j * dt
            if j % stride == 0:
                log[row] = x
                row += 1
            event(x, w, p)
            w[m] = t
            f(x, w, p, a)
            w[m] = t + 0.5 * dt
            for i in range(n):
                s[i] = x[i] + 0.5 * dt * a[i]
            f(s, w, p, b)
            for i in range(n):
                s[i] = x[i] + 0.5 * dt * b[i]
            f(s, w, p, c)
            w[m] = t + dt
            for i in range(n):
                s[i] = x[i] + dt * c[i]
            f(s, w, p, d)
            for i in range(n):
                x[i] += dt * (a[i] + 2 * b[i] + 2 * c[i] + d[i]) / 6
    return log


@jump
def smooth(x, w, p):
    pass


@rate
def rectifying_meter(x, w, p, d):  # pump lag, column of water, electronics
    d[0] = (w[0] - x[0]) / p[0]
    d[1] = (p[2] * x[0] - x[1]) / p[1]
    d[2] = (abs(x[1]) - x[2]) / p[3]


@rate
def blind_encoder(x, w, p, d):  # armature, speed, pulses counted
    d[0] = (w[0] - x[0]) / p[0]
    d[1] = (p[2] * x[0] - x[1]) / p[1]
    d[2] = p[3] * abs(x[1])


@rate
def reactor(x, w, p, d):  # jacket, concentration, temperature in K
    r = p[0] * np.exp(-p[1] * (1 / x[2] - 1 / 350.0)) * x[1]
    d[0] = (w[0] + 273.0 - x[0]) / p[2]
    d[1] = p[3] * (p[4] - x[1]) - r
    d[2] = p[3] * (p[5] - x[2]) + p[6] * r + p[7] * (x[0] - x[2])


@rate
def warm_motor(x, w, p, d):  # speed, winding's excess temperature
    resistance = p[0] * (1 + 0.0039 * x[1])
    i = (w[0] - p[1] * x[0]) / resistance
    d[0] = (p[1] * i - p[2] * x[0]) / p[3]
    d[1] = (resistance * i * i - x[1] / p[4]) / p[5]


@rate
def two_outlets(x, w, p, d):  # pump, level
    d[0] = (w[0] - x[0]) / p[0]
    d[1] = (p[1] * x[0] - p[2] * x[1] - p[3] * max(x[1] - p[4], 0.0)) / p[5]


@rate
def slack_belt(x, w, p, d):  # motor position, load position and speed
    z = x[0] - x[1]
    v = (w[0] - x[0]) / p[0]
    gap = z - p[3] if z > p[3] else (z + p[3] if z < -p[3] else 0.0)
    d[0] = v
    d[1] = x[2]
    d[2] = p[1] * p[1] * gap + 2 * p[2] * p[1] * abs(gap) * (v - x[2]) - p[4] * x[2]


@rate
def copying_cylinder(x, w, p, d):  # valve, piston, transducer
    e = x[0] - x[1]
    d[0] = (w[0] - x[0]) / p[0]
    d[1] = (p[1] if e > 0 else p[2]) * e
    d[2] = (x[1] - x[2]) / p[3]


@rate
def solenoid(x, w, p, d):  # current, armature position in mm and speed
    d[0] = (w[0] - x[0]) / p[0]
    d[1] = x[2]
    d[2] = (
        p[1] * p[1] * (p[3] * x[0] * x[0] / (1 - min(x[1] / p[4], 0.8)) ** 2 - x[1]) - 2 * p[2] * p[1] * x[2]
    )


@rate
def lamp(x, w, p, d):  # filament in K, pyrometer
    d[0] = (w[0] * w[0] / (p[0] * (x[0] / 300) ** 1.2) - p[1] * 1e-12 * (x[0] ** 4 - 300.0**4)) / p[2]
    d[1] = (x[0] - x[1]) / p[3]


@rate
def bump_stop(x, w, p, d):  # body, wheel: positions and speeds
    z = x[0] - x[2]
    stop = p[4] * (abs(z) - p[3]) * np.sign(z) if abs(z) > p[3] else 0.0
    force = p[0] * p[0] * (z + stop) + 2 * p[1] * p[0] * (x[1] - x[3])
    d[0] = x[1]
    d[1] = -force
    d[2] = x[3]
    d[3] = (force - p[5] * (x[2] - w[0])) / p[2]


@rate
def saturated_generator(x, w, p, d):  # flux, terminal voltage
    d[0] = (w[0] - x[0] - p[0] * x[0] ** 3) / p[1]
    d[1] = (p[2] * x[0] - x[1]) / p[3]


@rate
def three_lags(x, w, p, d):  # x0 is set by a jump; two lags behind it
    d[0] = 0.0
    d[1] = (p[2] * x[0] - x[1]) / p[3]
    d[2] = (x[1] - x[2]) / p[4]


@jump
def stiction(x, w, p):
    e = w[0] - x[0]
    if abs(e) > p[0]:
        x[0] = w[0] - np.sign(e) * p[1]


@jump
def schmitt(x, w, p):
    if w[0] > p[0]:
        x[0] = 1.0
    elif w[0] < p[1]:
        x[0] = 0.0


@rate
def oscillator(x, w, p, d):  # second order with a sensor's lag; a hidden disturbance at the input
    d[0] = x[1]
    d[1] = p[0] * p[0] * (p[2] * (w[0] + (w[1] if w.size > 2 else 0.0)) - x[0]) - 2 * p[1] * p[0] * x[1]
    d[2] = (x[0] - x[2]) / p[3]


@rate
def magnetic_sensor(x, w, p, d):  # second order; x2 and x3 are the plays of the sensor
    d[0] = x[1]
    d[1] = p[0] * p[0] * (p[2] * w[0] - x[0]) - 2 * p[1] * p[0] * x[1]
    d[2] = 0.0
    d[3] = 0.0


@jump
def two_plays(x, w, p):
    x[2] = min(max(x[2], x[0] - p[3]), x[0] + p[3])
    x[3] = min(max(x[3], x[0] - 2.5 * p[3]), x[0] + 2.5 * p[3])


@rate
def two_lags(x, w, p, d):
    d[0] = (p[2] * w[0] - x[0]) / p[0]
    d[1] = (x[0] - x[1]) / p[1]


@rate
def conveyor(x, w, p, d):  # belt speed, length that has passed
    d[0] = (w[0] - x[0]) / p[0]
    d[1] = x[0]


@rate
def gear_gap(x, w, p, d):  # motor speed, twist, load speed
    gap = x[1] - p[4] if x[1] > p[4] else (x[1] + p[4] if x[1] < -p[4] else 0.0)
    # Damping grows with the contact, as Hunt and Crossley's: the torque has no jump.
    torque = p[2] * gap + p[3] * abs(gap) * (x[0] - x[2])
    d[0] = p[0] * w[0] - p[1] * x[0] - torque
    d[1] = x[0] - x[2]
    d[2] = (torque - p[6] * x[2]) / p[5]


@rate
def slew_loop(x, w, p, d):  # integral, actuator, two lags; the input is the set point
    e = w[0] - x[3]
    v = min(max(p[0] * e + x[0], -p[4]), p[4])
    d[0] = p[0] * e / p[1]
    d[1] = min(max((v - x[1]) / 0.02, -p[5]), p[5])
    d[2] = (p[6] * x[1] - x[2]) / p[2]
    d[3] = (x[2] - x[3]) / p[3]


@rate
def mixing_tap(x, w, p, d):  # hot and cold flow in l/min, temperature, flow meter, thermometer
    d[0] = (w[0] - x[0]) / p[0]
    d[1] = (w[1] - x[1]) / p[0]
    d[2] = (x[0] * (p[2] - x[2]) + x[1] * (p[3] - x[2])) / 60 / p[1]
    d[3] = (x[0] + x[1] - x[3]) / p[4]
    d[4] = (x[2] - x[4]) / p[5]


@rate
def wind_tunnel(x, w, p, d):  # thrust, air speed, hot wire
    d[0] = (p[1] * w[0] - x[0]) / p[0]
    d[1] = x[0] - p[2] * x[1] * abs(x[1])
    d[2] = (x[1] - x[2]) / p[3]


@rate
def day_room(x, w, p, d):  # air and wall
    outside = p[4] + p[5] * np.sin(2 * np.pi * w[1] / 86400 + p[6])
    d[0] = (w[0] - p[1] * (x[0] - outside) - p[2] * (x[0] - x[1])) / p[0]
    d[1] = p[2] * (x[0] - x[1]) / p[3]


@rate
def peltier(x, w, p, d):  # cold plate, sensor
    heat = -p[1] * w[0] * (x[0] + 273) + 0.5 * p[2] * w[0] * w[0] + p[3] * (p[4] - x[0])
    d[0] = heat / p[0]
    d[1] = (x[0] - x[1]) / p[5]


@rate
def coupled_springs(x, w, p, d):  # two masses, each with its force, and a spring between them
    d[0] = x[1]
    d[1] = p[0] * w[0] - p[1] * x[0] - p[2] * x[1] - p[6] * (x[0] - x[2])
    d[2] = x[3]
    d[3] = p[3] * w[1] - p[4] * x[2] - p[5] * x[3] - p[6] * (x[2] - x[0])
