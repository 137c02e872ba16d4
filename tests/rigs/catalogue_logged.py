"""The rigs, continued: what comes from sensors, from logging and from outside."""

from __future__ import annotations

import numpy as np

from tests.rigs import ode_kernels as ode
from tests.rigs.catalogue import (
    DISTURBANCE,
    DYNAMIC,
    NOISE,
    OUTPUT,
    SAMPLING,
    TIME,
    Draw,
    about,
    between,
    rig,
    state,
)


@rig(
    ode.rectifying_meter,
    [OUTPUT],
    r"rectif|absolute|\babs\b|\|\.?\|?|sign.?less|unsigned|magnitude|direction|even function|v.?shape",
    "pump and water column, second order, meter's lag",
    "tf y' = |q| - y: the flow meter does not see the direction",
    "output_nonlinearity",
)
def flow_rectifier(g):
    p = {"ta": about(g, 0.3), "tau": about(g, 0.8), "gain": about(g, 4), "tf": about(g, 0.15)}
    return Draw(p, 0.1, between(g, 0.6, 0.9), 0.9, 0.12, (0, 0, 0), state(2), order=3, units=("V", "l/min"))


@rig(
    ode.blind_encoder,
    [OUTPUT, DYNAMIC],
    r"rectif|absolute|\babs\b|sign.?less|unsigned|direction|odometer|single.?(track|channel)|counts? up",
    "motor with armature lag, integrated",
    "n' = c |w|: a single-track encoder counts up whichever way the shaft turns",
    "output_nonlinearity output_drift",
)
def blind_encoder(g):
    p = {"te": about(g, 0.06), "tm": about(g, 0.35), "gain": about(g, 12), "c": about(g, 0.8)}
    kinds = "steps operator prbs noise"
    return Draw(
        p, 0.03, between(g, 0.9, 1.2), 1.0, 0.06, (0, 0, 0), state(2), rest=0, noise=(0.002, 0.006), kinds=kinds, order=3,
        units=("V", "counts"), frozen="c",
    )  # fmt: skip


def resonant(g, wn=6.0):
    return {"wn": about(g, wn), "z": between(g, 0.2, 0.5), "gain": about(g, 3), "tf": about(g, 0.3 / wn)}


def shifted(u, p, k):
    """The true input where the input's log has lost d samples before sample kj of the common clock."""
    at = np.arange(len(u))
    return u[
        np.where(
            k < p["kj"], at, np.maximum(at - int(p["d"]), min(max(int(p["kj"]) - 1 - k[0], 0), len(u) - 1))
        )
    ]


@rig(
    ode.oscillator,
    [SAMPLING, TIME],
    r"lost|missing samples|dropped|time.?(jump|shift|skip)|shift in time|delay (jump|change|step)|(jump|change|step).{0,12}delay|synchron|clock|buffer",
    "second-order plant with sensor lag",
    "y[k] = plant of u[k - d] from sample kj on: the input's log lost d samples",
    "transport_delay dropouts parameter_change",
)
def lost_samples(g):
    p = resonant(g) | {"kj": float(g.integers(350, 700)), "d": float(g.integers(4, 9))}
    return Draw(
        p, 0.05, 2, 1.5, 0.22, (0, 0, 0), state(2), actual=shifted, frozen="kj d", order=3, units=("V", "bar")
    )


def polled(x, p, k, steps=20):
    """The value of the last refresh of an instrument that refreshes every q samples, read off the states of every step."""
    refreshed = np.floor(k / p["q"]) * p["q"] - k[0]
    return x[np.maximum(np.round(refreshed * steps).astype(int), 0), 2:3]


@rig(
    ode.oscillator,
    [SAMPLING],
    r"jitter|poll|stale|refresh|held|hold|asynchron|multi.?rate|slow(er)? (sampling|rate|sensor)|repeated|dropout|varying (delay|age)|resampl",
    "second-order plant with sensor lag",
    "y[k] = y(q floor(k/q) Ts): the logger polls an instrument that refreshes every q samples, q not whole",
    "dropouts transport_delay quantisation",
)
def polled_sensor(g):
    p = resonant(g, 8) | {"q": between(g, 2.6, 4.6)}
    return Draw(p, 0.05, 0, 1.5, 0.3, (0, 0, 0), polled, fine=True, frozen="q", order=3, units=("V", "mm"))


@rig(
    ode.oscillator,
    [DISTURBANCE, SAMPLING],
    r"alias|tone|sinus|sine|hum|mains|periodic|harmonic|beat",
    "second-order plant with sensor lag",
    "y = x + A sin(2 pi f t + phi), f of 50 Hz folded by the sampling",
    "periodic_disturbance",
)
def aliased_hum(g):
    p = resonant(g) | {
        "A": between(g, 1.2, 2.4),
        "f": 50 + between(g, 0.04, 0.4) * float(g.choice([-1, 1])),
        "phi": between(g, 0, 6.28),
    }
    out = lambda x, p, k: x[:, 2:3] + p["A"] * np.sin(2 * np.pi * p["f"] * 0.04 * k + p["phi"])[:, None]
    return Draw(p, 0.04, 1, 1.2, 0.2, (0, 0, 0), out, frozen="f", order=3, units=("V", "bar"))


@rig(
    ode.oscillator,
    [NOISE],
    r"heterosc|heterosk|multiplicative|speckle|signal.?depend|grows with|proportional noise|noise (level|variance) (depends|varies|grows)|relative noise",
    "second-order plant with sensor lag",
    "y = x + (s0 + s1 |x|) e: the noise grows with the signal; no model predicts better than the linear one",
    "coloured_noise outliers",
    matters=False,
)
def speckle(g):
    out = state(2)
    return Draw(
        resonant(g),
        0.05,
        2,
        1.4,
        0.2,
        (0, 0, 0),
        out,
        noise=(0.01, 0.02),
        noise_gain=between(g, 0.08, 0.16),
        order=3,
    )


@rig(
    ode.magnetic_sensor,
    [OUTPUT, DYNAMIC],
    r"hysteres|preisach|prandtl|backlash|play|bouc|magneti|remanen",
    "mass on a spring",
    "y = a x + w1 play(x, r) + w2 play(x, 2.5 r): the sensor has hysteresis",
    "backlash",
    jump=ode.two_plays,
)
def hysteretic_sensor(g):
    p = {
        "wn": about(g, 8),
        "z": between(g, 0.2, 0.4),
        "gain": about(g, 2),
        "r": between(g, 0.4, 0.8),
        "a": between(g, 0.2, 0.4),
        "w1": about(g, 0.4),
        "w2": about(g, 0.5),
    }
    out = lambda x, p, k: p["a"] * x[:, :1] + p["w1"] * x[:, 2:3] + p["w2"] * x[:, 3:4]
    return Draw(p, 0.03, 0, 1.0, 0.16, (0, 0, 0, 0), out, coarse=True, units=("N", "V"), frozen="a")


@rig(
    ode.two_lags,
    [OUTPUT],
    r"titration|\bph\b|s.?curve|sigmoid|asinh|log(arithm)?|sensor (curve|nonlin)|output.?nonlin|wiener|arctan|tanh|sensor.?saturation",
    "mixing tank and electrode, two lags",
    "y = pK + s asinh((x - x0)/b): titration curve",
    "output_nonlinearity",
)
def titration(g):
    p = {
        "tau1": about(g, 60),
        "tau2": about(g, 10),
        "gain": about(g, 0.1),
        "x0": about(g, 5, 0.1),
        "b": between(g, 0.3, 0.6),
        "s": about(g, 1.2),
        "pK": between(g, 6.5, 7.5),
    }
    out = lambda x, p, k: p["pK"] + p["s"] * np.arcsinh((x[:, 1:2] - p["x0"]) / p["b"])
    return Draw(
        p,
        4,
        50,
        between(g, 18, 24),
        0.07,
        (5, 5),
        out,
        lo=0,
        hi=100,
        frozen="gain",
        units=("%", "pH"),
        noise=(0.005, 0.02),
    )
