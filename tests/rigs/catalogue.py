"""The rigs: each a plant from physics with ONE effect that the log does not declare, and four that have none.

One function per rig draws its numbers. What it says in `@rig` is what the grader accepts: natures, words that name the effect,
labels that hold a part of it.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np

from tests.rigs import ode_kernels as ode

OUTPUT, INPUT, DYNAMIC = "static output nonlinearity", "static input nonlinearity", "dynamic nonlinearity"
TIME, DISTURBANCE, SAMPLING, NOISE, NONE = "time variation", "disturbance", "sampling", "noise", "none"
Parameters = dict[str, float]


@dataclass(frozen=True, eq=False)
class Draw:
    """One drawn rig: how it is simulated, excited and logged."""

    p: Parameters
    ts: float
    u: Any  # middle of the input, one number or one per channel
    amp: Any  # rms about the middle
    band: float  # excitation's corner in rad per sample
    x0: tuple[float, ...]  # state from which the rest is reached
    out: Callable[[np.ndarray, Parameters, np.ndarray], np.ndarray]  # states, p, sample numbers -> outputs
    lo: float | None = None
    hi: float | None = None
    rest: Any = None  # input at rest, `u` where not given
    settle: int = 400  # samples at rest before the record
    steps: int = 20
    fine: bool = False  # `out` takes the states of every step
    actual: Callable[[np.ndarray, Parameters, np.ndarray], np.ndarray] | None = None  # logged -> true input
    hidden: Callable[[np.random.Generator, int], np.ndarray] | None = (
        None  # disturbance that no model can know
    )
    noise: tuple[float, float] = (0.01, 0.05)  # sensor noise over the output's standard deviation
    noise_gain: float = 0.0  # part of the noise that goes with the signal
    kinds: str = "prbs steps noise multisine swept operator"
    frozen: str = ""  # parameters that the fit of the true structure is given
    coarse: bool = False  # the error is not smooth in the parameters
    delays: tuple[int, ...] = (1,)
    gains: tuple[float, float] | None = (
        None  # PI level control of the training record: gain, integral per sample
    )
    order: Any = 2
    units: tuple[str, str] = ("V", "V")


@dataclass(frozen=True, eq=False)
class Rig:
    """A rig by name, with what counts as having found its effect."""

    draw: Callable[[np.random.Generator], Draw]
    rhs: Any
    jump: Any
    nature: list[str]
    names: str
    near: list[str]
    linear_part: str
    equation: str
    matters: bool = True  # the true model predicts better than the best linear one


RIGS: dict[str, Rig] = {}


def rig(rhs, nature, names, lin, eq, near="", jump=ode.smooth, matters=True):
    def register(draw):
        RIGS[draw.__name__] = Rig(draw, rhs, jump, nature, names, near.split(), lin, eq, matters)
        return draw

    return register


def about(g: np.random.Generator, value: float, part: float = 0.2) -> float:
    return float(value * g.uniform(1 - part, 1 + part))


def between(g: np.random.Generator, low: float, high: float) -> float:
    return float(g.uniform(low, high))


def state(*which: int, scale: float = 1.0, shift: float = 0.0):
    """The output is these states."""
    return lambda x, p, k: scale * x[:, list(which)] + shift


@rig(
    ode.reactor,
    [DYNAMIC],
    r"arrhenius|exponential|reaction|kinetic|exp\(|temperature.?depend|bilinear",
    "stirred tank with jacket: concentration and temperature",
    "c' = q (cf - c) - k c, T' = q (Tf - T) + H k c + U (Tj - T), k = k0 exp(-E (1/T - 1/350))",
    "output_nonlinearity bilinear hammerstein",
)
def arrhenius(g):
    p = {
        "k0": about(g, 0.01),
        "E": between(g, 9000, 11000),
        "tj": about(g, 30),
        "q": about(g, 0.01),
        "cf": 1.0,
        "Tf": between(g, 322, 330),
    }
    p |= {"H": between(g, 35, 55), "U": about(g, 0.025, 0.1)}
    return Draw(
        p, 10, between(g, 68, 74), between(g, 11, 15), 0.07, (343, 0.5, 343), state(1, scale=100.0), frozen="cf Tf", lo=30, hi=110,
        order=3, units=("degC", "%"), noise=(0.01, 0.03),
    )  # fmt: skip


@rig(
    ode.warm_motor,
    [DYNAMIC, TIME],
    r"thermal|temperature|warm|heating|resistance|copper|slow (hidden )?state|winding|self.?heat",
    "DC motor with viscous load",
    "J w' = K i - b w, i = (u - K w)/R, R = R0 (1 + .0039 T), C T' = R i^2 - T/Rth: the winding warms up",
    "gain_drift parameter_change bilinear nonlinear_drag",
)
def warm_motor(g):
    p = {
        "R0": about(g, 1),
        "K": about(g, 0.05, 0.1),
        "b": about(g, 0.003, 0.1),
        "J": about(g, 6e-4),
        "Rth": between(g, 5, 8),
        "C": between(g, 1.5, 3),
    }
    return Draw(p, 0.05, 12, between(g, 5, 6.5), 0.12, (0, 0), state(0), rest=2, lo=-2, units=("V", "rad/s"), noise=(0.01, 0.03), order=1)  # fmt: skip


@rig(
    ode.two_outlets,
    [DYNAMIC],
    r"piecewise|two outlet|second outlet|overflow|threshold|level.?depend|kink|breakpoint|switch|regime|max\(|hinge",
    "tank with pump, first outlet",
    "A h' = ku q - k1 h - k2 max(h - h2, 0): a second outlet higher up",
    "output_nonlinearity nonlinear_drag parameter_change",
)
def two_outlets(g):
    p = {
        "tp": about(g, 4),
        "ku": about(g, 1),
        "k1": about(g, 2.2),
        "k2": between(g, 5, 9),
        "h2": 0.0,
        "A": about(g, 60),
    }
    p["h2"] = 50 * p["ku"] / p["k1"] * between(g, 0.75, 0.95)
    return Draw(p, 1.5, 52, between(g, 17, 22), 0.06, (50, 15), state(1), lo=5, hi=100, units=("%", "cm"))


@rig(
    ode.slack_belt,
    [DYNAMIC],
    r"backlash|play|slack|clearance|dead.?(zone|band)|gap|lost motion|belt|piecewise.?(linear )?stiff",
    "servo, elastic belt, load mass",
    "x'' = wn^2 dz + 2 z wn |dz| (s' - x') - d x', dz = dead zone of s - x of half-width b",
    "backlash input_deadzone duffing",
)
def belt_play(g):
    p = {
        "ts": about(g, 0.06),
        "wn": about(g, 22),
        "z": between(g, 0.02, 0.05),
        "b": between(g, 1.8, 3.2),
        "d": between(g, 1.5, 3),
    }
    return Draw(
        p,
        0.02,
        0,
        between(g, 7, 10),
        0.14,
        (0, 0, 0),
        state(1),
        order=3,
        units=("mm", "mm"),
        settle=0,
        steps=80,
    )


@rig(
    ode.copying_cylinder,
    [DYNAMIC],
    r"asymmetr|direction|one.?sided|area|up.?(and|/).?down|differential|piston|extend|retract|piecewise",
    "copying valve and cylinder: a first-order servo, with valve and transducer lag",
    "x' = k (s - x), k = k1 where s > x, k2 else: piston and annulus differ in area",
    "rate_limiter backlash",
)
def differential_cylinder(g):
    k1 = between(g, 2, 3)
    p = {"ta": about(g, 0.06), "k1": k1, "k2": k1 * between(g, 2.2, 3.5), "tf": about(g, 0.05)}
    return Draw(
        p,
        0.03,
        between(g, 40, 60),
        between(g, 14, 20),
        0.1,
        (50, 50, 50),
        state(2),
        order=3,
        units=("mm", "mm"),
        lo=0,
        hi=120,
    )


@rig(
    ode.solenoid,
    [DYNAMIC, INPUT],
    r"solenoid|reluctance|magnet|1/\(?gap|inverse.?square|gap|air.?gap|square of (the )?current|i\^2|u\^2|quadratic",
    "coil lag, armature on a spring",
    "x''/wn^2 = F i^2/(1 - x/g)^2 - x - 2 z x'/wn",
    "hammerstein duffing",
)
def solenoid(g):
    p = {
        "tl": about(g, 0.012),
        "wn": about(g, 60),
        "z": between(g, 0.25, 0.5),
        "F": between(g, 0.28, 0.34),
        "g": between(g, 4.5, 5.5),
    }
    return Draw(
        p,
        0.006,
        0.95,
        between(g, 0.25, 0.3),
        0.12,
        (1, 0.4, 0),
        state(1),
        lo=0.1,
        hi=1.35,
        order=3,
        frozen="g",
        units=("A", "mm"),
    )


@rig(
    ode.lamp,
    [DYNAMIC, INPUT],
    r"radiat|t\^?4|fourth power|resistance|square of (the )?voltage|u\^2|filament|quadratic|nonlinear.?(loss|cooling)",
    "filament with one heat store, pyrometer's lag",
    "C T' = u^2/R(T) - s (T^4 - 300^4), R = R0 (T/300)^1.2",
    "hammerstein output_nonlinearity nonlinear_drag bilinear",
)
def filament_lamp(g):
    p = {"R0": about(g, 69), "s": about(g, 1.5), "C": about(g, 0.025), "tf": about(g, 0.08)}
    return Draw(
        p, 0.05, between(g, 125, 150), between(g, 50, 60), 0.1, (2000, 2000), state(1, shift=-273.0), lo=20, hi=260,
        units=("V", "degC"), noise=(0.006, 0.02),
    )  # fmt: skip


@rig(
    ode.bump_stop,
    [DYNAMIC],
    r"bump|stop|piecewise|hardening|nonlinear.?(stiffness|spring|restoring)|stiffness|duffing|contact|impact|end.?stop",
    "quarter car: body and wheel",
    "force = wn^2 (z + ks (|z| - z0) sign z where |z| > z0) + c z', z = suspension's deflection",
    "duffing",
)
def quarter_car(g):
    p = {
        "wn": about(g, 8),
        "z": between(g, 0.15, 0.3),
        "mu": about(g, 0.12),
        "z0": between(g, 14, 20),
        "ks": between(g, 6, 12),
        "kt": about(g, 600),
    }
    return Draw(
        p, 0.02, 0, between(g, 24, 32), 0.22, (0, 0, 0, 0), lambda x, p, k: x[:, :1] - x[:, 2:3], order=4, settle=0, steps=24,
        units=("mm", "mm"), kinds="prbs steps noise multisine",
    )  # fmt: skip


@rig(
    ode.saturated_generator,
    [DYNAMIC, OUTPUT],
    r"saturat|magneti[sz]|flux|iron|field|cubic|inductance",
    "field winding and armature lag",
    "tf psi' = u - psi - b psi^3, ta y' = E psi - y: the iron saturates",
    "output_nonlinearity nonlinear_drag hammerstein input_saturation duffing",
)
def flux_saturation(g):
    p = {"b": between(g, 0.7, 1.4), "tf": about(g, 0.6), "E": about(g, 220), "ta": about(g, 0.04)}
    return Draw(
        p,
        0.03,
        between(g, 1.6, 2),
        between(g, 0.9, 1.1),
        0.09,
        (0.9, 200),
        state(1),
        lo=0,
        units=("V", "V"),
        noise=(0.01, 0.03),
    )


@rig(
    ode.three_lags,
    [DYNAMIC, INPUT],
    r"stiction|stick|jump|friction|coulomb|backlash|play|hysteres|dead.?band",
    "valve and two lags",
    "the stem stays while |u - s| < S, then jumps to u - D sign(u - s)",
    "backlash coulomb_friction stribeck_friction input_deadzone",
    jump=ode.stiction,
)
def sticky_valve(g):
    S = between(g, 4.5, 7)
    p = {
        "S": S,
        "D": S * between(g, 0.3, 0.5),
        "gain": about(g, 0.8),
        "tau1": about(g, 9),
        "tau2": about(g, 3),
    }
    kinds = "noise multisine swept operator"
    return Draw(
        p,
        1,
        between(g, 45, 55),
        between(g, 5, 7.5),
        0.12,
        (50, 40, 40),
        state(2),
        kinds=kinds,
        coarse=True,
        units=("%", "degC"),
    )


@rig(
    ode.three_lags,
    [INPUT, DYNAMIC],
    r"relay|hysteres|on.?off|bang|schmitt|switch|two.?(level|state|position)|binary|threshold|comparator",
    "heater and two lags",
    "the heater is on after u > u1 and off after u < u2",
    "backlash input_saturation hammerstein",
    jump=ode.schmitt,
)
def relay_heater(g):
    p = {
        "u1": between(g, 5.4, 5.8),
        "u2": between(g, 4, 4.5),
        "gain": about(g, 60),
        "tau1": about(g, 12),
        "tau2": about(g, 3),
    }
    out = lambda x, p, k: 18.0 + x[:, 2:3]
    return Draw(
        p,
        1,
        5,
        between(g, 1.1, 1.5),
        0.16,
        (0, 0, 0),
        out,
        kinds="noise multisine operator steps",
        coarse=True,
        units=("V", "degC"),
    )
