"""Effects inside a plant: forces, elements with memory, rates and coefficients that change.

Forces are of the plant's position, velocity and input; coefficients follow time or what the input feeds.
"""

from collections.abc import Callable, Iterator
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from estimators.diagnosis.effects.effect import Clock, Effect, Grid, Nature, Sizes, Slot
from estimators.diagnosis.effects.input import LEAST
from estimators.diagnosis.effects.loops.ageing import CHANGES, MEMORIES, leaky, with_heat

Array = NDArray[Any]

MOVING = frozenset({"oscillator", "driven", "sensed", "modes", "integrator"})  # velocity is not position
DRIVEN = frozenset({"cascade", "driven"})  # the last state follows the input and drives the others
SWINGS = 0.9
"""Damping ratio below which a plant swings: two lags in a row are fitted as a pair just short of 1."""
SPRINGS = ("stiffness_cubic", "stiffness")


SOFTEST, SOFTENED, WARMED, BRIEF = 0.95, (-1.0, 0.5), (-0.5, 2.0), 0.02
"""Share of a stiffness that work takes from it, at most, as something holds the position still; shares, and dampings in those there are, that
are tried; and of a record, the time constant of what rests between two bursts."""
DRIVE, LAG = 2, 0.4
"""Poles of a drive before a play, at most, and where each starts: two are a servo, a third is hardly seen."""


def _grid(*shapes: list[float], sizes: list[float]) -> Grid:
    """Shapes in units of their sizes."""
    return [[a * b for a, b in zip(shape, sizes, strict=True)] for shape in shapes], sizes


def _stiff(s: Sizes, power: int) -> float:
    return s.su / s.sx**power


def _square(p, v, u, q, s, c):
    return c[0] * np.abs(p) * p


def _gaps(s: Sizes) -> Grid:
    return [[f * s.su] for f in (0.1, 0.25, 0.5, 0.9)], [s.su]


def _slack(p, v, u, q, s, c):
    stiff = 1.0 + np.abs(c[1])
    return np.minimum(np.maximum(stiff * u - p, -np.abs(c[0])), np.abs(c[0])) / stiff


def _loose(channel: Any, base: Any, others: tuple[int, ...]) -> Iterator[Any]:
    """The load as an oscillator, then one pole of the drive after the other before the play for as long as Schwarz's criterion
    falls: the linear model's poles belong to neither, as the play lets both swing by themselves."""
    from estimators.diagnosis.effects.profiled import firm
    from estimators.diagnosis.model.fitting import fit
    from estimators.diagnosis.model.linear import fit_linear, layout_starts
    from estimators.diagnosis.model.structure import Part

    s = base.structure
    if s.layout != "tf" or s.effects or s.order < 2:
        return
    plain = fit_linear(channel, replace(s, order=2, taps=2))
    new, p, scales = next(start for start in layout_starts(channel, plain) if start[0].layout == "oscillator")
    size, own, best = float(np.std(channel.u[:, new.inputs[0]])), len(p), np.inf
    p, scales = np.append(p, [0.5 * size, 0.2]), np.append(scales, [size, 1.0])
    for first in range(DRIVE + 1):
        begun = new.adding(Part(SLACK, new.inputs[0], first=first))
        f = fit(channel, begun, p, scales, noise=base.noise, iterations=30)
        if not firm(plain, float(np.sum(f.residual**2))) or not f.criterion < best:
            return
        yield f
        poles = np.polymul(np.append(1.0, f.p[own : own + first]), (1.0, -LAG))[1:]
        best, p = f.criterion, np.concatenate((f.p[:own], poles, f.p[-2:]))
        scales = np.insert(scales, own, 1.0)


def _corner(side: float, *levels: float, slopes: tuple[float, ...] = (0.3, 2.0, -0.3)) -> Any:
    """Slopes beyond corners at levels of the position; stops are stiff."""
    return lambda s: _grid(*([k, side * g] for k in slopes for g in levels), sizes=[s.su / s.sx, s.sx])


def _stop_levels(s: Sizes) -> Grid:
    top = float(np.max(np.abs(s.position)))
    return [[f * top] for f in (0.9, 0.75, 0.6, 0.45)], [s.sx]


def _hysteretic(c: Any) -> dict[str, float]:
    width = max(abs(float(c[1])), LEAST)
    return {"spring": float(c[0]) / width, "width": width}


def _dry(x: Any, c: Any, tilt: float = 0.0, excess: Any = 0.0) -> Any:
    return (np.abs(c[0]) + excess) * np.sign(x) * (1 + tilt * np.sign(x))


def _inside(key: str, cause: str, sentence: str, **fields: Any) -> Effect:
    return Effect(key=key, cause=cause, nature=Nature.DYNAMIC, slot=Slot.PLANT, sentence=sentence, **fields)


def _spring(key: str, sentence: str, **fields: Any) -> Effect:
    known: dict[str, Any] = {"against": "position", "layouts": MOVING} | fields
    return _inside(key, "duffing", sentence, **known)


def _changed(key: str, sentence: str, name: str, change: dict[str, tuple[float, ...]]) -> Effect:
    return Effect(
        key=key, cause="parameter_change", nature=Nature.TIME, slot=Slot.PLANT, sentence=sentence, change=change,
        parameters={name: "log", "time": "sample"}, trials=0.03, per_sample=True, amplitude=0, family="changes",
        starts=lambda s: ([[0.1, t] for t in s.times(20)], [1.0, 1.0]),
    )  # fmt: skip


def _bilinear_starts(s: Sizes) -> Grid:
    return _grid([0.05], [0.2], [-0.05], [-0.2], sizes=[1 / s.sx])


SLACK = _inside(
    "clearance_sprung", "backlash", "play between a drive and what it moves against a spring of its own", trials=10,
    parameters={"gap": "u", "spring": "1"}, against="position", layouts=frozenset({"oscillator"}), force=_slack, search=_loose,
)  # fmt: skip

PLANT = (
    SLACK,
    _spring("stiffness_cubic", "a restoring force k3 x^3", parameters={"k3": "1/u^2"}, trials=2, family="springs",
            force=lambda p, v, u, q, s, c: c[0] * p**3, starts=lambda s: _grid([0.01], [0.05], [-0.02], sizes=[_stiff(s, 3)])),
    _spring("stiffness", "a restoring force k2 x^2 + k3 x^3", parameters={"k2": "1/u", "k3": "1/u^2"}, trials=2,
            family="springs", force=lambda p, v, u, q, s, c: (c[0] + c[1] * p) * p**2,
            starts=lambda s: _grid(*([a, b] for a in (-0.05, 0.05) for b in (-0.01, 0.03)),
                                   sizes=[_stiff(s, 2), _stiff(s, 3)])),
    _inside("coulomb", "coulomb_friction", "dry friction of constant level", parameters={"level": "u"}, trials=6,
            reversing=True, against="velocity", inside=lambda c: {"coulomb": abs(c[0])}, curve=_dry,
            starts=lambda s: _grid([0.03], [0.1], [0.2], [0.4], sizes=[s.su])),
    _inside("stribeck", "stribeck_friction", "dry friction that is larger at low speed", trials=15, reversing=True,
            parameters={"level": "u", "excess": "u", "speed": "u/sample"}, extends="coulomb", against="velocity",
            inside=lambda c: {"coulomb": abs(c[0]), "static": c[1], "speed": max(abs(c[2]), LEAST)},
            curve=lambda x, c: _dry(x, c, excess=abs(c[1]) * np.exp(-((x / max(abs(c[2]), 1e-300)) ** 2))),
            starts=lambda s: _grid(*([f, 0.6 * f, h] for f in (0.1, 0.25) for h in (0.2, 0.6)), sizes=[s.su, s.su, s.sv])),
    _inside("coulomb_asymmetric", "coulomb_friction", "dry friction, another level for each direction", trials=10,
            parameters={"level": "u", "asymmetry": "1"}, reversing=True, extends="coulomb", against="velocity",
            inside=lambda c: {"coulomb": abs(c[0]), "tilt": min(max(float(c[1]), -1.0), 1.0)},
            curve=lambda x, c: _dry(x, c, tilt=c[1]),
            starts=lambda s: _grid(*([f, g] for f in (0.1, 0.3) for g in (-0.3, 0.3)), sizes=[s.su, 1.0])),
    _inside("coulomb_grip", "coulomb_friction", "dry friction that grows in proportion to the deflection: a ring spring, the inside of a material",
            parameters={"share": "1"}, trials=6, reversing=True, layouts=MOVING,
            inside=lambda c: {"grip": abs(c[0])}, starts=lambda s: _grid([0.1], [0.3], [0.6], sizes=[1.0])),
    _inside("drag", "nonlinear_drag", "quadratic drag c |v| v", parameters={"drag": "u/(u/sample)^2"}, trials=2,
            force=lambda p, v, u, q, s, c: np.abs(c[0]) * np.abs(v) * v, against="velocity",
            starts=lambda s: _grid([0.02], [0.1], [0.3], sizes=[s.su / s.sv**2])),
    _inside("bilinear", "bilinear", "the input multiplies the state, beta u x", parameters={"beta": "1/u"}, trials=2,
            family="bilinear", force=lambda p, v, u, q, s, c: -c[0] * u * p, each=True, starts=_bilinear_starts),
    _inside("bilinear_driven", "bilinear", "the input, after a lag of its own, multiplies the state, beta u x", trials=2,
            parameters={"beta": "1/u"}, family="bilinear", layouts=DRIVEN,
            force=lambda p, v, u, q, s, c: -c[0] * q * p, starts=_bilinear_starts),
    _spring("stiffness_square", "a restoring force k |x| x", parameters={"k": "1/u"}, trials=4, refines=SPRINGS,
            force=_square, starts=lambda s: _grid([0.05], [0.3], [-0.1], sizes=[_stiff(s, 2)])),
    _spring("stiffness_quintic", "a restoring force k3 x^3 + k5 x^5", parameters={"k3": "1/u^2", "k5": "1/u^4"}, trials=4,
            refines=SPRINGS, force=lambda p, v, u, q, s, c: c[0] * p**3 + c[1] * p**5,
            starts=lambda s: _grid(*([a, b] for a in (0.0, 0.03) for b in (-0.003, 0.01)),
                                   sizes=[_stiff(s, 3), _stiff(s, 5)])),
    _spring("stiffness_gap", "a second spring beyond a gap on either side", parameters={"slope": "1", "gap": "u"}, trials=15,
            refines=SPRINGS, family="springs",
            force=lambda p, v, u, q, s, c: c[0] * (np.maximum(p - np.abs(c[1]), 0.0) + np.minimum(p + np.abs(c[1]), 0.0)),
            starts=_corner(1.0, 0.3, 0.8, 1.5, slopes=(0.3, 2.0, 10.0, -0.3))),
    _inside("clearance", "backlash", "play between the drive and what it moves: no force within a gap", trials=4,
            parameters={"gap": "u"}, layouts=frozenset({"oscillator"}), against="position",
            force=lambda p, v, u, q, s, c: np.minimum(np.maximum(u - p, -np.abs(c[0])), np.abs(c[0])), starts=_gaps),
    _inside("clearance_driven", "backlash", "play between the drive, after a lag of its own, and what it moves", trials=4,
            parameters={"gap": "u"}, layouts=DRIVEN, against="position",
            force=lambda p, v, u, q, s, c: np.minimum(np.maximum(q - p, -np.abs(c[0])), np.abs(c[0])), starts=_gaps),
    _spring("stiffness_upper", "another stiffness above a corner: a one-sided spring or an end stop", trials=15,
            parameters={"slope": "1", "corner": "u"}, refines=SPRINGS, family="springs",
            force=lambda p, v, u, q, s, c: c[0] * np.maximum(p - c[1], 0.0),
            starts=_corner(1.0, 0.0, 0.7, 1.5)),
    _spring("stiffness_lower", "another stiffness below a corner: a one-sided spring or an end stop", trials=15,
            parameters={"slope": "1", "corner": "u"}, refines=SPRINGS, family="springs",
            force=lambda p, v, u, q, s, c: c[0] * np.minimum(p - c[1], 0.0),
            starts=_corner(-1.0, 0.0, 0.7, 1.5)),
    _inside("end_stop", "duffing", "a stop on either side holds the position, without rebound", parameters={"limit": "u"},
            trials=10, refines=SPRINGS, family="springs", inside=lambda c: {"stop": abs(c[0])},
            starts=_stop_levels),
    _inside("position_damping", "nonlinear_drag", "a damping d x^2 v that depends on the position", trials=6,
            parameters={"d": "sample/u^2"}, refines=("drag", "stiffness_cubic"), layouts=MOVING,
            force=lambda p, v, u, q, s, c: c[0] * p**2 * v,
            starts=lambda s: _grid([0.05], [0.3], [-0.05], sizes=[s.su / (s.sx**2 * s.sv)])),
    _inside("hysteretic_spring", "hysteresis",
            "a hysteretic restoring force inside the plant (Bouc-Wen), which saturates at the level", trials=15,
            parameters={"level": "u", "width": "u"}, reversing=True, refines=("coulomb", "drag"), layouts=MOVING,
            inside=_hysteretic,
            starts=lambda s: _grid(*([f, w] for f in (0.15, 0.5) for w in (0.2, 0.7, 2.0)), sizes=[s.su, s.sx])),
    _changed("timescale_change", "the natural frequency or time constants change abruptly", "log_speed",
             {"first": (1,), "oscillator": (2, 1), "cascade": (1, 1), "driven": (2, 1, 0), "sensed": (2, 1, 0),
              "modes": (2, 1, 0, 0)}),
    _changed("damping_change", "the damping changes abruptly", "log_damping",
             {"oscillator": (0, 1), "driven": (0, 1, 0), "sensed": (0, 1, 0), "modes": (0, 1, 0, 0)}),
    _changed("pole_change", "one time constant changes abruptly", "log_speed",
             {"cascade": (1, 0), "driven": (0, 0, 1), "sensed": (0, 0, 1)}),
    _changed("loss_change", "a loss or a stiffness changes abruptly, and the gain with it", "log_loss",
             {"first": (1, -1), "oscillator": (1, 0, -1), "cascade": (1, 0, -1), "chain": (1, 0, -1), "driven": (1, 0, 0, -1),
              "sensed": (1, 0, 0, -1), "modes": (1, 0, 0, 0, -1)}),
)  # fmt: skip


def _inertia_by(p, v, u, q, s, c):
    g = np.maximum(1.0 + c[0] * s, 0.05)
    return (1.0 - 1.0 / g) * (u - p - c[1] * v)


def _stiffness_by(p, v, u, q, s, c):
    return c[0] * s * p


def _worked_by(p, v, u, q, s, c):
    return -np.minimum(c[0], SOFTEST) * s / (s + np.abs(c[1]) + LEAST) * p


def _thickened_by(p, v, u, q, s, c):
    return c[0] * s / (s + np.abs(c[1]) + LEAST) * v


def _spring_by(p, v, u, q, s, c):
    return c[0] * s * (p - u)


def _damping_by(p, v, u, q, s, c):
    return c[0] * s * v


def _time(U: Array, channel: int, p: Array, clock: Clock) -> Array:
    return clock.turn


def _nearing(U: Array, channel: int, p: Array, clock: Clock) -> Array:
    """From none at the start to one at the record's end, ever more slowly by a rate per record, the last parameter; below zero ever
    faster, and evenly at none."""
    rate = float(np.clip(p[-1], -FASTEST, FASTEST))
    rate = rate if abs(rate) > STEADY else STEADY
    return np.expm1(-rate * np.maximum(clock.turn, 0.0)) / np.expm1(-rate)


def _heat(U: Array, channel: int, p: Array, clock: Clock) -> Array:
    """Leaky mean of the squared input; the last parameter is its time constant."""
    return leaky(U[:, 0] ** 2, p[-1])


def _squared(U: Array, channel: int, p: Array, clock: Clock) -> Array:
    return U[:, 0] ** 2


def _with_square(s: Sizes) -> Grid:
    size = s.su**2 + float(np.mean(s.u)) ** 2
    return [[f / size] for f in CHANGES], [1.0 / size]


def _with_motion(s: Sizes, unit: float = 1.0, shares: tuple[float, ...] = SOFTENED) -> Grid:
    size, n = float(np.mean(s.position**2)) + LEAST, len(s.u)
    return [[f * unit, size, m * n] for f in shares for m in (BRIEF, *MEMORIES)], [unit, size, n / 10.0]


def _paced(c: Any) -> dict[str, float]:
    """Never below a sample: what follows at once is no state."""
    return {"pace": 1.0 / max(abs(float(c[2])), 1.0)}


def _with_time(s: Sizes) -> Grid:
    return [[f] for f in CHANGES], [1.0]


def _coefficient(
    key: str, cause: str, nature: Nature, sentence: str, force: Callable[..., Any], signal: Any, starts: Any,
    parameters: dict[str, str],
) -> Effect:  # fmt: skip
    return Effect(
        key=key, cause=cause, nature=nature, slot=Slot.PLANT, sentence=sentence, force=force, signal=signal, starts=starts,
        parameters=parameters, trials=6, layouts=MOVING - {"integrator"},
        family={_heat: "heat", _squared: "bilinear"}.get(signal, "drifts"),
    )  # fmt: skip


FURTHER, RATES = (1.0, 2.5), (2.5, 7.0)
"""Times the changes of a steady drift, and rates per record, that are tried of one that nears an end: most of it is over early."""
FASTEST, STEADY = 50.0, 1e-6
"""Rates per record: of what is over within a few samples, and of what no number tells from a steady drift."""


def _ending(drift: Effect) -> Effect:
    """A steady drift whose coefficient nears an end instead: what cures, settles, runs in."""
    starts, (slope, *others) = drift.starts, drift.parameters.items()

    def grid(s: Sizes) -> Grid:
        begun, sizes = starts(s)  # pyright: ignore[reportOptionalCall]
        return [[f * c[0], *c[1:], rate] for c in begun for f in FURTHER for rate in RATES], [*sizes, 1.0]

    return replace(
        drift, key=drift.key.replace("_drift", "_settles"), sentence=drift.sentence.replace("steadily with time", "with time towards an end"),
        parameters={"change": {"1/record": "1"}.get(slope[1], slope[1].removesuffix("/record")), **dict(others), "rate": "1/record"},
        signal=_nearing, starts=grid, extends=drift.key,
    )  # fmt: skip


def _inertias(s: Sizes) -> Grid:
    return [[f, s.damping] for f in CHANGES], [1.0, s.damping]


DRIFTS = (
    _coefficient("inertia_drift", "parameter_drift", Nature.TIME, "the inertia changes steadily with time", _inertia_by, _time,
                 _inertias, {"slope": "1/record", "damping": "sample"}),
    _coefficient("stiffness_drift", "parameter_drift", Nature.TIME, "the stiffness changes steadily with time", _stiffness_by,
                 _time, _with_time, {"slope": "1/record"}),
    _coefficient("resonance_drift", "parameter_drift", Nature.TIME, "the stiffness that it is driven through changes steadily with time: "
                 "the resonance moves, the gain stays", _spring_by, _time, _with_time, {"slope": "1/record"}),
    _coefficient("damping_drift", "parameter_drift", Nature.TIME, "the damping changes steadily with time", _damping_by, _time,
                 lambda s: ([[f * s.damping] for f in CHANGES], [s.damping]), {"slope": "sample/record"}),
)  # fmt: skip
MODULATED = (
    *DRIFTS,
    *map(_ending, DRIFTS),
    _coefficient("stiffness_heat", "slow_hidden_state", Nature.DYNAMIC,
                 "the stiffness follows a slow state that the squared input feeds", _stiffness_by, _heat, with_heat,
                 {"share": "1/u^2", "time": "sample"}),
    _coefficient("stiffness_squared", "bilinear", Nature.DYNAMIC,
                 "the squared input changes the stiffness at once, as a voltage softens an electrostatic spring", _stiffness_by,
                 _squared, _with_square, {"share": "1/u^2"}),
    _inside("stiffness_worked", "slow_hidden_state", "the stiffness follows a slow state that the squared deflection feeds: rubber that softens "
            "as it is worked, and stiffens again at rest", parameters={"share": "1", "half": "u^2", "time": "sample"}, trials=20,
            force=_worked_by, inside=_paced, starts=_with_motion, layouts=MOVING - {"integrator"}, family="heat"),
    _inside("damping_worked", "slow_hidden_state", "the damping follows a slow state that the squared deflection feeds: a damper that its work warms",
            parameters={"share": "sample", "half": "u^2", "time": "sample"}, trials=20, force=_thickened_by, inside=_paced,
            layouts=MOVING - {"integrator"}, starts=lambda s: _with_motion(s, s.damping, WARMED), family="heat"),
)  # fmt: skip
