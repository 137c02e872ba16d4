"""Terms in the user's words and units: equation, nature, the catalogue's name where it says the same."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from estimators.diagnosis.discovery.dictionary import Kind
from estimators.diagnosis.discovery.form import Factor, Form, Term, flow_of

Array = NDArray[Any]
# power of a signal's scale in a factor's value
DEGREE = {
    Kind.LINEAR: 1.0, Kind.SQUARE: 2.0, Kind.CUBE: 3.0, Kind.ABS: 1.0, Kind.SIGN: 0.0, Kind.TANH: 1.0, Kind.HINGE: 1.0,
    Kind.SIGNED_SQUARE: 2.0, Kind.SIN: 0.0, Kind.COS: 0.0, Kind.EXP: 0.0, Kind.ROOT: 0.5, Kind.LOG: 0.0,
    Kind.INVERSE: -1.0, Kind.SIGNED_ROOT: 0.5, Kind.BELL: 0.0,
}  # fmt: skip
TEXT = {
    Kind.LINEAR: "{d}", Kind.SQUARE: "{b}^2", Kind.CUBE: "{b}^3", Kind.ABS: "|{s}|", Kind.SIGN: "sign({s})",
    Kind.TANH: "{q} tanh({b}/{q})", Kind.HINGE: "max(0, {s})", Kind.SIGNED_SQUARE: "{b} |{s}|", Kind.SIN: "sin({k} {b})",
    Kind.COS: "cos({k} {b})", Kind.EXP: "exp({b}/{q})", Kind.ROOT: "sqrt({s})", Kind.LOG: "log({s})",
    Kind.INVERSE: "1/{b}", Kind.SIGNED_ROOT: "sign({s}) sqrt|{s}|", Kind.BELL: "exp(-({b}/{q})^2)",
}  # fmt: skip
COEFFICIENTS = (
    "coefficient",
    "coefficient of the rate",
    *(f"coefficient of the {which} derivative" for which in ("second", "third", "fourth", "fifth")),
)
"""Of a force and of its derivatives."""
SURE = 2.0  # standard errors beyond which a tap of a force is there
NEAR_ZERO = 1e-3  # of a signal's scale: an offset below it is none


@dataclass(frozen=True)
class Axis:
    """How a scaled signal reads for the user: label, centre and scale of its values, unit."""

    label: str
    centre: float
    scale: float
    unit: str


def signal_axes(
    form: Form, terms: Sequence[Term], scales, names: Mapping[str, tuple[str, str]]
) -> dict[str, Axis]:
    """Axis of every signal; `names` gives label and unit of y0, u0, ...."""
    axes: dict[str, Axis] = {}
    for name, (centre, scale) in scales.centres.items():
        label, unit = names[("y" if name[0] in "yv" else "u") + name.lstrip("yvdu")]
        if name[0] in "vd":
            label, unit = f"rate({label})", f"{unit or '1'}/s"
        axes[name] = Axis(label, centre, scale, unit)
    for d in form.differences:
        first, second, (centre, scale) = axes[d.first], axes[d.second], scales.centre(d)
        axes[d.name] = Axis(f"({first.label} - {second.label})", centre, scale, first.unit)
    axes |= {flow_of(i): Axis("", 0.0, 1.0, "") for i in range(len(form.orders))}
    number = 0
    for t in terms:
        if t.slot == "slow":
            scale = float(np.prod([axes[f.signal].scale ** DEGREE[f.kind] for f in t.factors]))
            inner = " ".join(factor_text(f, axes[f.signal]) for f in t.factors)
            axes[f"s{number}"] = Axis(f"slow[{inner}; {_number(scales.dt / t.rate)} s]", 0.0, scale, "")
            number += 1
    return axes


def _number(x: float) -> str:
    return f"{x:.3g}"


def factor_text(f: Factor, axis: Axis) -> str:
    """One factor with its constants in the user's units."""
    p, q = axis.centre + axis.scale * f.p, axis.scale * f.q
    bare = abs(p) < NEAR_ZERO * axis.scale
    shifted = axis.label if bare else f"{axis.label} {'-' if p > 0 else '+'} {_number(abs(p))}"
    bracketed = shifted if bare else f"({shifted})"
    return TEXT[f.kind].format(d=bracketed, b=bracketed, s=shifted, q=_number(q), k=_number(f.q / axis.scale))


def summed(terms: Sequence[str]) -> str:
    """Terms one after another, each with its own sign."""
    return " + ".join(terms).replace(" + -", " - ")


def sum_of_rates(text: str, taps: Mapping[int, tuple[float, float]]) -> str:
    """A term with its coefficient and error, and those of its derivatives, by how often it is derived; itself only where it is sure
    or nothing else is."""
    (k, error), further = taps[0], {m: t for m, t in taps.items() if m}
    parts = [] if further and abs(k) < SURE * error else [f"{k:.3g} +- {error:.2g} * {text}"]
    for m, (k, error) in further.items():
        power = f"^{m}" if m > 1 else ""
        parts.append(f"{k:.3g} +- {error:.2g} s{power} * d{power}/dt{power}[{text}]")
    return summed(parts)


def term_text(term: Term, axes: Mapping[str, Axis]) -> str:
    """A product of factors, that of a mobility without the flow that it is a share of."""
    return " * ".join(factor_text(f, axes[f.signal]) for f in shown(term))


def _side(f: Factor) -> str:
    """The kind of a factor's signal: y, v, u, d for an input's rate, s for a slow state, m for a difference."""
    return "m" if "-" in f.signal else f.signal[0]


def shown(term: Term) -> tuple[Factor, ...]:
    """The factors of a term but for the flow that a mobility is a share of."""
    return term.factors[:-1] if term.slot == "mobility" else term.factors


def _letters(term: Term) -> set[str]:
    """The kinds of the signals of a term, those of a difference too."""
    return {n[0] for f in shown(term) for n in f.signal.split("-")}


def nature(term: Term) -> str:
    """Where a term of one kind of signal sits; memory or feedback makes it dynamic."""
    letters = _letters(term)
    if letters == {"u"} and term.slot != "mobility":
        return "static input nonlinearity"
    if term.slot == "output" and {f.signal for f in term.factors} == {f"y{term.chain}"}:
        return "static output nonlinearity"
    return "dynamic nonlinearity"


SAME = {
    ("force", "v", Kind.SIGN): "coulomb_friction", ("force", "v", Kind.TANH): "coulomb_friction",
    ("force", "v", Kind.BELL): "stribeck_friction", ("force", "v", Kind.SIGNED_SQUARE): "nonlinear_drag",
    ("force", "v", Kind.CUBE): "nonlinear_drag", ("force", "v", Kind.SIGNED_ROOT): "coulomb_friction",
    ("force", "y", Kind.ROOT): "square_root_outflow",
    ("force", "y", Kind.SIN): "pendulum", ("force", "y", Kind.COS): "pendulum", ("force", "u", Kind.TANH): "input_saturation",
    ("output", "y", Kind.ABS): "magnitude_sensor",
}  # fmt: skip
"""What the catalogue calls a term of one factor: by slot, kind of signal and kind of function; what grows less than the speed is
friction, what grows more is drag."""
WHOLE = {
    ("force", "u"): "hammerstein",
    ("output", "y"): "output_nonlinearity",
    ("force", "v"): "asymmetric_rise_and_fall",
}
"""The same for any other function of one signal, but for forces of the output."""
SPRINGS = (Kind.SQUARE, Kind.CUBE, Kind.SIGNED_SQUARE, Kind.ABS, Kind.HINGE)
"""Forces of the output that are a spring's where something swings: others keep their equation and have no name."""
NARROW = 0.3
"""Of a signal's standard deviation, width of a force that saturates, below which it is dry friction."""


COUPLED = "coriolis_coupling"
EASED = "its inertia or capacity depends on %s: the whole of its motion, inputs and losses alike, is faster or slower"


def _couples(term: Term) -> bool:
    """Whether a force on one axis comes from rates and positions of others: centrifugal, Coriolis, an inertia they change."""
    others = {f.signal[1:] for f in term.factors if _side(f) in "yv"} - {str(term.chain)}
    rates = [f.kind for f in term.factors if _side(f) == "v"]
    moving = bool(rates) and all(k in (Kind.LINEAR, Kind.SQUARE) for k in rates)
    bent = len(term.factors) > 1 or rates == [Kind.SQUARE]
    return term.slot == "force" and bool(others) and moving and bent and _letters(term) <= {"y", "v"}


DELAYED = "flow_dependent_delay"


def _delays(term: Term) -> bool:
    """Whether an input times the rate of what is read is read with it: the first order of a delay that goes with the input."""
    return term.slot == "output" and {f.signal for f in term.factors if _side(f) == "v"} == {f"v{term.chain}"}


def same_as(term: Term, swings: bool = True) -> str:
    """The catalogue's name for a term that says the same in a chain that can swing or not, or nothing."""
    if _couples(term):
        return COUPLED
    if term.slot == "mobility":
        own = {"u": "flow_dependent_lag", f"y{term.chain}": "level_dependent_lag"}
        signal = term.factors[0].signal
        return own.get(signal, own.get(signal[0], COUPLED))
    if len(term.factors) == 2:
        plain = all(f.kind == Kind.LINEAR for f in term.factors)
        several = len({f.signal for f in term.factors}) > 1
        kinds = "".join(sorted(map(_side, term.factors)))
        if kinds == "mu":
            kinds = "".join(sorted("u" + ("y" if "y" in _letters(term) else "u")))
        names = {
            "uy": "bilinear",
            "uu": "product_of_inputs" if several else "",
            "uv": DELAYED if _delays(term) else "",
        }
        return names.get(kinds, "") if plain else ""
    f = term.factors[0]
    side = _side(f)
    found = SAME.get((term.slot, side, f.kind)) or WHOLE.get((term.slot, side), "")
    flat = f.kind == Kind.SIGN or (f.kind == Kind.TANH and abs(f.q) < NARROW)
    if term.slot == "output" and f.signal != f"y{term.chain}":
        return ""  # another output is no sensor of this one
    if (term.slot, side) != ("force", "y") or found == "square_root_outflow":
        return found
    if swings:
        return found or ("duffing" if f.kind in SPRINGS else "")
    # a speed, or a level: nothing swings without a mass
    return "coulomb_friction" if flat else "nonlinear_loss"


CARRIED = "an input times a difference (a flow that carries: a gain and a time constant at once)"


def carried(term: Term, terms: Sequence[Term]) -> bool:
    """Whether a product of inputs stands beside that of one of them with the output: `CARRIED` is what the two are."""
    inputs = {f.signal for f in term.factors}
    loops = [t for t in terms if (t.slot, t.chain) == ("force", term.chain) and same_as(t) == "bilinear"]
    return term.slot == "force" and any(inputs & {f.signal for f in t.factors} for t in loops)


LAGGED = "static curve of the input behind a lag of its own (actuator nonlinearity, input nonlinearity)"


def lagged(term: Term, slow: Sequence[Term]) -> Term | None:
    """The state that a force is alone, where inputs alone drive it: `LAGGED`, where it is not slow beside the chain."""
    f = term.factors[0]
    if len(term.factors) > 1 or term.slot != "force" or f.signal[0] != "s" or f.kind != Kind.LINEAR:
        return None
    driver = slow[int(f.signal[1:])]
    return driver if _letters(driver) == {"u"} else None


OF_RATE: Mapping[str, tuple[Callable[[Array], Array], ...]] = {
    "coulomb_friction": (np.sign, lambda v: np.sign(v) * np.sqrt(np.abs(v))), "nonlinear_drag": (lambda v: v * np.abs(v), lambda v: v**3),
    "asymmetric_rise_and_fall": (np.abs, lambda v: np.maximum(v, 0.0)),
}  # fmt: skip
"""Shapes that a force of the rate may have beside its linear part, by name."""


def named_by_shape(rate: Array, force: Array) -> str:
    """The name of the shape nearest to a curve of the rate that several terms make up together, its linear part left free."""
    size = float(np.max(np.abs(rate)))

    def left(shape: Callable[[Array], Array]) -> float:
        X = np.stack((np.ones_like(rate), rate / size, shape(rate / size)), axis=1)
        return float(np.sum((force - X @ np.linalg.lstsq(X, force, rcond=None)[0]) ** 2))

    return min(OF_RATE, key=lambda name: min(left(shape) for shape in OF_RATE[name]))


DAMPS = "damping or time constant that depends on the level (the rate of a curve of the output)"
BETWEEN = "flow or force that the difference of two signals drives (a valve, a flap, a spring or an exchange between them)"


def _single(term: Term, f: Factor) -> str:
    side = _side(f)
    if side == "m":
        return BETWEEN if term.slot != "output" else "the reading depends on the difference of two signals"
    if side == "u":
        return "static curve of the input (actuator nonlinearity, input nonlinearity)"
    if side == "d":
        return "what acts depends on how fast the input moves"
    if side == "s":
        return "a slow hidden state acts"
    if term.slot == "output":
        return (
            {
                Kind.ABS: "magnitude sensor (rectified output)",
                Kind.SIN: "periodic sensor curve",
                Kind.COS: "periodic sensor curve",
            }.get(f.kind, "static curve of the output (sensor nonlinearity, output nonlinearity)")
            if side == "y"
            else ("the reading depends on how fast the output moves")
        )
    if side == "y":
        return {
            Kind.SIN: "force periodic in the position (gravity, pendulum, eccentric, cogging)",
            Kind.COS: "force periodic in the position (gravity, pendulum, eccentric, cogging)",
            Kind.ROOT: "square root of the level (outflow)",
        }.get(
            f.kind,
            "output-dependent restoring force (nonlinear stiffness, or nonlinear loss that depends on the level)",
        )
    return {
        Kind.SIGN: "dry friction",
        Kind.TANH: "friction that saturates with speed",
        Kind.BELL: "friction that falls with speed (Stribeck)",
        Kind.SIGNED_SQUARE: "drag (nonlinear damping)",
        Kind.CUBE: "nonlinear damping",
        Kind.SIGNED_ROOT: "nonlinear damping (square root of the speed)",
    }.get(f.kind, "direction-dependent damping (asymmetric rise and fall)")


def meaning(term: Term) -> str:
    """What a term is in physical words."""
    coupling = "nonlinear coupling of the axes (product of their motions: centrifugal, Coriolis)"
    if _couples(term):
        return coupling
    if term.slot == "mobility":
        return EASED % {"u": "an input", "y": "a position or level"}[_side(term.factors[0])]
    if len(term.factors) == 1:
        return _single(term, term.factors[0])
    sides = [*map(_side, term.factors)]
    chains = {f.signal[1:] for f in term.factors if _side(f) in "yv"}
    if "s" in sides:
        return "a slow hidden state changes a coefficient"
    if "m" in sides:
        if same_as(term) == "bilinear":
            return CARRIED
        return "flow through an opening that another signal sets (a valve between the two)"
    if len(chains) > 1:
        return coupling
    pair = "".join(sorted(sides))
    if pair == "uv" and _delays(term):
        return "a delay that the input sets (the rate of what is read, times the input)"
    return {
        "uy": "output-dependent gain (input times output; state-dependent gain or time constant)",
        "uv": "the input acts differently with speed and direction (product of input and rate)",
        "vy": "output-dependent damping or time constant (level-dependent)",
        "uu": "product of the inputs",
        "yy": "output-dependent restoring force (nonlinear stiffness)",
        "vv": "nonlinear damping",
    }.get(pair, "product of two signals")
