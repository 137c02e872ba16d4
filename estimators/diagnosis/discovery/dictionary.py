"""The dictionary: terms of the model's own signals, in every slot, with the constants that their fit starts from."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.signal import lfilter

from estimators.diagnosis.discovery.form import Factor, Form, Term, flow_of
from estimators.diagnosis.discovery.recursion_kernels import factor_values
from estimators.diagnosis.record.measurement import switched

Array = NDArray[Any]


class Kind:
    """Numbers of the factors in `recursion_kernels.factor`."""

    (
        LINEAR,
        SQUARE,
        CUBE,
        ABS,
        SIGN,
        TANH,
        HINGE,
        SIGNED_SQUARE,
        SIN,
        COS,
        EXP,
        ROOT,
        LOG,
        INVERSE,
        SIGNED_ROOT,
        BELL,
    ) = range(16)


SHARP = 0.03  # width of a softened sign, in standard deviations of its signal
SAME, BESIDE = 1e-3, 0.01
"""A sign is as wide as its nearest samples are far (this quantile of the distances), those on its centre (this share of a standard
deviation) left out: between few levels nothing says where it jumps."""
QUANTILES = (0.1, 0.3, 0.5, 0.7, 0.9)  # where hinges start
PERIODS = (0.7, 1.0, 1.4, 2.0, 2.8, 4.0, 5.6, 8.0)  # wave numbers per standard deviation
SLOW = (8.0, 32.0, 128.0)  # time constants of slow states in samples over the model's own
BELOW = 0.15  # how far below the range a root's or logarithm's zero starts, in spans


NONE = -1  # chain of a candidate that is no mobility


@dataclass(frozen=True)
class Candidate:
    """Terms to be added together: the last one acts, those before it are slow states that it reads."""

    terms: tuple[Term, ...]

    @property
    def moves(self) -> int:
        """The chain whose mobility it is: of whose flow it is a share."""
        signal = self.terms[-1].factors[-1].signal
        return int(signal[1:]) if signal[0] == "f" else NONE

    @property
    def slow(self) -> int:
        """Number of slow states."""
        return sum(t.slot == "slow" for t in self.terms)

    @property
    def key(self) -> tuple:
        """What it is apart from its constants: the same function of the same signals."""
        return tuple((f.kind, f.signal) for t in self.terms for f in t.factors)


def values(term: Term, signals: Mapping[str, Array]) -> Array:
    """(N,) the product of a term's factors along signals; of a slow state its filtered value."""
    out = np.ones(len(next(iter(signals.values()))))
    for f in term.factors:
        out = out * factor_values(f.kind, np.ascontiguousarray(signals[f.signal]), f.p, f.q)
    if term.slot == "slow":
        pole = 1 - term.rate
        out = np.r_[out[:1], lfilter([1 - pole], [1, -pole], out, zi=[pole * out[0]])[0][:-1]]
    return out


def _functions(name: str, x: Array, zero: float, rest: float) -> list[Factor]:
    """Factors of one signal; `zero` is where the user's zero lies in its scale, `rest` its first value."""
    spread, low, high = max(float(x.std()), 1e-9), float(x.min()), float(x.max())
    mid, span = float(x.mean()), high - low
    out = [Factor(Kind.SQUARE, name, mid), Factor(Kind.CUBE, name, mid)]
    centres = {round(c, 9) for c in (zero, rest) if low + 0.02 * span < c < high - 0.02 * span}
    for c in sorted(centres):
        off = np.abs(x - c)[np.abs(x - c) > SAME * spread]
        width = max(SHARP * spread, float(np.quantile(off, BESIDE)) if len(off) else spread)
        out += [Factor(Kind.ABS, name, c), Factor(Kind.SIGN, name, c, width)]
        out += [Factor(Kind.SIGNED_SQUARE, name, c), Factor(Kind.SIGNED_ROOT, name, c)]
        out += [Factor(Kind.CUBE, name, c)] if abs(c - mid) > 0.1 * spread else []
        out += [Factor(Kind.BELL, name, c, w * spread, (False, True)) for w in (0.15, 0.5, 1.0)]
    out += [
        Factor(Kind.TANH, name, c, w * spread, (False, True)) for c in {mid, *centres} for w in (0.4, 1.2)
    ]
    out += [Factor(Kind.HINGE, name, float(np.quantile(x, a)), 1.0, (True, False)) for a in QUANTILES]
    out += [Factor(Kind.EXP, name, mid, s * w * spread, (False, True)) for s in (-1, 1) for w in (0.7, 2.0)]
    floor = min(zero, low - BELOW * span) if zero < low + 0.02 * span else low - BELOW * span
    out += [Factor(k, name, floor, 1.0) for k in (Kind.ROOT, Kind.LOG, Kind.INVERSE)]
    if zero <= low:
        out += [Factor(k, name, zero - 1e-6, 1.0) for k in (Kind.ROOT, Kind.LOG, Kind.INVERSE)]
    if name[0] == "y":
        centre = zero if low < zero < high else mid
        out += [f for k in (Kind.SIN, Kind.COS) for f in _waves(k, name, x, [centre], phase=False)]
    return out


def _inverses(name: str, x: Array, zero: float) -> list[Factor]:
    """1/x of a signal that keeps to one side of the user's zero, from there and from a zero of its own; of no other."""
    low = float(x.min())
    floor = low - BELOW * (float(x.max()) - low)
    return (
        [Factor(Kind.INVERSE, name, zero), Factor(Kind.INVERSE, name, min(zero, floor), 1.0, (True, False))]
        if zero < low
        else []
    )


def candidates(
    form: Form, signals: Mapping[str, Array], zeros: Mapping[str, float], samples: float
) -> list[Candidate]:
    """All candidates over the signals y, v of every chain and u, du of every input; `samples` is the model's time constant."""
    ny, nu = len(form.orders), form.inputs
    y, v, u = [f"y{i}" for i in range(ny)], [f"v{i}" for i in range(ny)], [f"u{j}" for j in range(nu)]
    linear = lambda name: Factor(Kind.LINEAR, name, zeros.get(name, 0.0))
    out = []
    for name in [*y, *v, *u, *(d.name for d in form.differences)]:
        x = signals[name]
        single = _functions(name, x, zeros.get(name, 0.0), float(x[0]) if name[0] != "v" else 0.0)
        out += [Candidate((Term((f,)),)) for f in single]
    names = [*y, *v, *u]
    centred = lambda name: Factor(Kind.LINEAR, name, float(signals[name].mean()))
    for a in range(len(names)):
        for b in range(a + 1, len(names)):
            out.append(Candidate((Term((centred(names[a]), centred(names[b]))),)))
    crossing = {
        n for n in names if signals[n].min() < zeros.get(n, 0.0) < signals[n].max()
    }  # elsewhere |x| is x
    magnitude = lambda name: Factor(Kind.ABS, name, zeros.get(name, 0.0))
    sign = lambda name: Factor(
        Kind.SIGN, name, zeros.get(name, 0.0), SHARP * max(float(signals[name].std()), 1e-9)
    )
    square = lambda name: Factor(Kind.SQUARE, name, float(signals[name].mean()))
    for a in names:
        for b in names:
            if a != b:
                out += [
                    Candidate((Term((f(a), centred(b))),)) for f in (magnitude, square)[a not in crossing :]
                ]
                out += [Candidate((Term((sign(a), centred(b))),))] if a[0] in "vu" and a in crossing else []
                out += [Candidate((Term((sign(a), square(b))),))] if a[0] == "v" and a[1:] != b[1:] else []
                # friction that grows with the deflection, as of a ring spring
                grips = a[0] == "v" and b[0] == "y" and {a, b} <= crossing
                out += [Candidate((Term((sign(a), magnitude(b))),))] if grips else []
                # centrifugal, of an inertia that the other sets
                if a[0] == "v" and b in y and a[1:] != b[1:]:
                    sets = [
                        centred(b),
                        square(b),
                        *_waves(Kind.SIN, b, signals[b], _centres(signals[b], zeros.get(b, 0.0))),
                    ]
                    out += [Candidate((Term((square(a), f)),)) for f in sets]
    for _i, name in enumerate(y):
        low, zero = float(signals[name].min()), zeros.get(name, 0.0)
        if zero < low:
            root = Factor(Kind.ROOT, name, zero)
            out += [Candidate((Term((root, linear(b))),)) for b in u]
    for name in [*y, *u, *(d.name for d in form.differences if d.first[0] != "v")]:
        # what a power drives into a level, or carries over a lift or a flow
        out += [Candidate((Term((f, linear(b))),)) for f in _inverses(name, signals[name], zeros.get(name, 0.0))
                for b in u if b != name]  # fmt: skip
    for d in (d for d in form.differences if d.first[0] != "v"):  # through an opening
        for b in (b for b in u if b not in (d.first, d.second)):
            flow = Factor(Kind.SIGNED_ROOT, d.name, zeros[d.name]), Factor(Kind.LINEAR, d.name, zeros[d.name])
            out += [Candidate((Term((f, linear(b))),)) for f in flow]
    out += _slow(names, signals, zeros, samples, y, u, v)
    for i in range(ny):
        out += [
            Candidate((Term((f, Factor(Kind.LINEAR, flow_of(i)))),))
            for f in _shares(signals, zeros, [*y, *u])
        ]
    two_levels = {name for name in u if switched(signals[name])}
    return [
        c
        for c in out
        if not any(f.signal in two_levels and f.kind != Kind.LINEAR for t in c.terms for f in t.factors)
    ]


def _shares(signals: Mapping[str, Array], zeros: Mapping[str, float], names: Sequence[str]) -> list[Factor]:
    """Shares of a mobility: straight in a signal, its square about its middle or the user's zero, and waves of an output."""
    out = []
    for name in names:
        x = signals[name]
        centres = _centres(x, zeros.get(name, 0.0))
        out += [Factor(Kind.LINEAR, name, float(x.mean()))] + [Factor(Kind.SQUARE, name, c) for c in centres]
        out += _waves(Kind.COS, name, x, centres) if name[0] == "y" else []
    return out


def _centres(x: Array, zero: float) -> list[float]:
    """The middle of a signal and the user's zero."""
    return sorted({float(x.mean()), zero})


def _waves(kind: int, name: str, x: Array, centres: Sequence[float], phase: bool = True) -> list[Factor]:
    """Waves of a signal with a free wave number, and a free `phase` or none."""
    spread = max(float(x.std()), 1e-9)
    return [Factor(kind, name, c, w / spread, (phase, True)) for c in centres for w in PERIODS]


def _slow(names, signals, zeros, samples, y, u, v) -> list[Candidate]:
    """Slow states driven by an input, its square or magnitude, or by a rate's magnitude, and what they may modulate."""
    out = []
    length = len(signals[names[0]])
    for factor_ in SLOW:
        rate = 1 / min(factor_ * samples, length / 2)
        drivers = [Factor(k, b, zeros.get(b, 0.0)) for b in u for k in (Kind.LINEAR, Kind.SQUARE, Kind.ABS)]
        drivers += [Factor(k, b, 0.0) for b in v for k in (Kind.ABS, Kind.SQUARE)] + [
            Factor(Kind.SQUARE, b, 0.0) for b in y
        ]
        for d in drivers:
            first = Term((d,), "slow", rate=rate)
            state = Factor(Kind.LINEAR, "s", float(values(first, signals).mean()))
            out += [
                Candidate((first, Term((state, Factor(Kind.LINEAR, b, float(signals[b].mean()))))))
                for b in [*u, *y, *v]
            ]
            if d.kind != Kind.LINEAR:
                out.append(Candidate((first, Term((state,)))))
    return out


def placed(candidate: Candidate, form: Form, slot: str, chain: int, along: int) -> tuple[Term, ...]:
    """The candidate's terms in their slot, its slow state numbered after those of the form."""
    number = sum(t.slot == "slow" for t in form.terms)
    last = candidate.terms[-1]
    factors = tuple(replace(f, signal=f"s{number}") if f.signal == "s" else f for f in last.factors)
    return (*candidate.terms[:-1], replace(last, factors=factors, slot=slot, chain=chain, along=along))
