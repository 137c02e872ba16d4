"""A discovered model in the user's units: it simulates, says its equation with errors, and is written and read."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

from estimators.diagnosis.discovery.dictionary import values
from estimators.diagnosis.discovery.fitting import Piece
from estimators.diagnosis.discovery.form import FREE, LAST, Assembly, Form, Term
from estimators.diagnosis.discovery.found import Curve, FoundTerm
from estimators.diagnosis.discovery.starts import Scales, drive
from estimators.diagnosis.discovery.uncertainty import error_of
from estimators.diagnosis.discovery.validation import STILL, StartPrior, expected_state, free_run
from estimators.diagnosis.discovery.wording import (
    CARRIED,
    COEFFICIENTS,
    DAMPS,
    DEGREE,
    LAGGED,
    SURE,
    Axis,
    carried,
    lagged,
    meaning,
    named_by_shape,
    nature,
    same_as,
    signal_axes,
    sum_of_rates,
    summed,
    term_text,
)
from estimators.diagnosis.effects.plant import SWINGS
from oed.covariances import NORMAL
from oed.data import Record

Array = NDArray[Any]
GRID = 41  # points of a curve
EDGE = 0.005  # quantile of the training signal where a curve ends
BAND = 1.96
UNTOLD = 2.0  # relative error of forces in units of an input, of that in others, from which on it is most of it the input's own


@dataclass(frozen=True, eq=False)
class DiscoveredModel:
    """A fitted form with the scales of its signals, covariance of theta, prior of its start, names and units."""

    form: Form
    theta: Array
    scales: Scales
    covariance: Array
    prior: StartPrior
    names: Mapping[str, tuple[str, str]]
    ranges: Mapping[str, tuple[float, float]]

    @cached_property
    def assembly(self) -> Assembly:
        return Assembly(self.form)

    def simulate(self, record: Record, window: int) -> Array:
        """(N, ny) free run; the first `window` samples set the state. NaN where it explodes."""
        y = (record.y - self.scales.y) / self.scales.sy
        fine = np.isfinite(y)
        piece = Piece(drive(record.u, self.scales), np.where(fine, y, 0.0), fine.astype(float))
        return free_run(self.assembly, self.theta, self.prior, piece, window) * self.scales.sy + self.scales.y

    def start(self, level: Array) -> Array:
        """Whole state from which a record starts whose inputs stay at `level` (nu,) at first and whose outputs are not known."""
        d, none = drive(np.tile(level, (STILL, 1)), self.scales), np.zeros((STILL, len(self.scales.y)))
        return expected_state(self.assembly, self.theta, self.prior, Piece(d, none, none), 0)[0]

    def resolved(self, theta: Array | None = None) -> list[tuple[Term, Array]]:
        """Every term with its fitted constants, and its coefficients."""
        theta = self.theta if theta is None else theta
        out = []
        for term, block in zip(self.form.terms, self.form.blocks):
            own, taps = theta[block], self.form.taps(term)
            at, factors = taps, []
            for f in term.factors:
                p, q = f.p, f.q
                if f.free[0]:
                    p, at = float(own[at]), at + 1
                if f.free[1]:
                    q, at = float(own[at]), at + 1
                factors.append(replace(f, p=p, q=q))
            rate = term.rate * float(own[at]) if term.slot == "slow" else term.rate
            out.append((replace(term, factors=tuple(factors), rate=rate), own[:taps]))
        return out

    @cached_property
    def _drivers(self) -> tuple[int | None, ...]:
        """Per chain, the input in whose units the forces on it are given: the one that moves it most; none where the record hardly
        tells what it does, as beside a curve of the same input: then they are given in units of the highest derivative."""
        out: list[int | None] = []
        for chain, rows in enumerate(self.assembly.betas):
            j = int(np.argmax(np.abs(self.theta[rows][:, -1])))
            own = [n for n, t in enumerate(self.form.terms) if self._free(t) and t.chain == chain]
            unsure = [max((self._relative_error(n, k) for n in own), default=0.0) for k in (j, None)]
            out.append(None if unsure[0] > UNTOLD * unsure[1] else j)
        return tuple(out)

    @staticmethod
    def _free(term: Term) -> bool:
        """Whether a term is a force with coefficients of its own, in no input's place."""
        return term.slot == "force" and term.along < 0

    def _relative_error(self, number: int, j: int | None) -> float:
        """Standard error of a force's coefficient, of itself, in units of an input or of the highest derivative."""
        k = abs(self._coefficient(number, self.theta, j))
        error = error_of(
            lambda theta: np.array([self._coefficient(number, theta, j)]), self.theta, self.covariance
        )
        return float(error[0]) / max(k, 1e-300)

    def _coefficient(self, number: int, theta: Array, j: int | None, rate: int = 0) -> float:
        """Of a force, or of its derivative by so many seconds, in its scaled signals and the units of input j or of the highest
        derivative."""
        term, block = self.form.terms[number], self.form.blocks[number]
        taps = theta[block][: self.form.taps(term)]
        own = float(taps[-1 - rate]) * (self.scales.dt / self.form.paces[term.chain]) ** rate
        if j is None:
            return own * self._highest(term.chain)
        b = theta[self.assembly.betas[term.chain][j]]
        if self._static(term, j):
            return own * float(self.scales.su[j]) / float(b[-1])
        return 0.0 if rate else float(taps @ b) * float(self.scales.su[j]) / float(b @ b)

    def _static(self, term: Term, j: int) -> bool:
        """Whether input j, in whose units a force is given, acts on the highest derivative itself, as the force does."""
        b = self.theta[self.assembly.betas[term.chain][j]]
        return term.along == LAST or abs(b[-1]) > 1e-2 * float(np.linalg.norm(b))

    def _highest(self, chain: int) -> float:
        """The highest derivative of an output, in its unit and seconds, of a force of one."""
        pace = self.form.paces[chain] / self.scales.dt
        return float(self.scales.sy[chain]) * pace ** self.form.orders[chain]

    def amplitude(self, number: int, theta: Array, rate: int = 0) -> float:
        """Coefficient of a term, or of its derivative by so many seconds, in the user's units: of its input for a force, of the
        output for a map."""
        term, taps = self.resolved(theta)[number]
        axes = self.axes
        size = float(np.prod([axes[f.signal].scale ** -DEGREE[f.kind] for f in term.factors]))
        if term.slot == "mobility":
            return float(taps[0]) * size
        if term.slot == "output":
            return float(taps[0]) * size * float(self.scales.sy[term.chain])
        if term.along >= 0:
            return float(taps[0]) * size * float(self.scales.su[term.along])
        return size * self._coefficient(number, theta, self._drivers[term.chain], rate)

    def _sure(self, number: int, rate: int = 0) -> tuple[float, float]:
        """An `amplitude` and its standard error."""
        amplitude = lambda theta: np.array([self.amplitude(number, theta, rate)])
        return float(amplitude(self.theta)[0]), float(error_of(amplitude, self.theta, self.covariance)[0])

    def _rates(self, number: int, term: Term) -> dict[int, tuple[float, float]]:
        """Amplitudes with their errors of the derivatives by which a force with taps of its own surely acts too."""
        many = self.form.taps(term) if self._free(term) and term.along == FREE else 1
        found = {m: self._sure(number, m) for m in range(1, many)}
        return {m: (k, e) for m, (k, e) in found.items() if abs(k) > SURE * e}

    @cached_property
    def axes(self) -> dict[str, Axis]:
        terms = [t for t, _ in self.resolved()]
        return signal_axes(self.form, terms, self.scales, self.names)

    def _poles(self, chain: int) -> Array:
        """Poles of a chain, per sample, its forces of the output taken at their mean slopes over the record's range."""
        alphas, signal = self.theta[self.assembly.alphas[chain]].copy(), f"y{chain}"
        grid = np.linspace(*self.ranges[signal], GRID)
        for term, k in self.resolved():
            if (term.slot, term.chain, {f.signal for f in term.factors}) == ("force", chain, {signal}):
                along = self.theta[self.assembly.betas[chain][term.along]] if term.along >= 0 else 1.0
                alphas[-len(k * along) :] -= k * along * np.polyfit(grid, values(term, {signal: grid}), 1)[0]
        roots = np.roots(np.concatenate(([1.0], alphas)))
        return np.log(1.0 + self.form.paces[chain] * roots + 0j)

    def _swings(self, chain: int) -> bool:
        """Whether a chain has light poles."""
        poles = self._poles(chain)
        # a negative pole's logarithm turns by half a circle a sample
        swinging = np.abs(poles.imag) % np.pi > 0.0
        return bool(np.any(swinging & (-poles.real < SWINGS * np.abs(poles))))

    def _unit(self, term: Term) -> str:
        if term.slot == "mobility":
            return "1"
        if term.slot == "output":
            return self.names[f"y{term.chain}"][1]
        if term.along >= 0:
            return self.names[f"u{term.along}"][1]
        return self._force_unit(term.chain)[1]

    def _force_unit(self, chain: int) -> tuple[str, str]:
        """What forces on a chain are given in, in words, and the unit."""
        j, order = self._drivers[chain], self.form.orders[chain]
        if j is None:
            unit = f"{self.names[f'y{chain}'][1] or '1'}/s" + (f"^{order}" if order > 1 else "")
            return f"in {unit}", unit
        name, unit = self.names[f"u{j}"]
        return f"in {unit or 'units'} of {name}", unit

    def found(self) -> list[FoundTerm]:
        """The terms that act (slow states stand inside them), with errors, in the user's units."""
        out = []
        for number, (term, _) in enumerate(self.resolved()):
            if term.slot == "slow":
                continue
            (k, error), rates, unit = self._sure(number), self._rates(number, term), self._unit(term)
            taps = {0: (k, error)} | rates
            curve, swings = self._curve(number, term, unit), self._swings(term.chain)
            damps = 1 in rates and self._damps(term, curve, rates[1][0] / k)
            out.append(
                FoundTerm(
                    sum_of_rates(term_text(term, self.axes), taps),
                    term.slot,
                    term.chain,
                    nature(term),
                    DAMPS if damps else meaning(term),
                    "position_damping" if damps else same_as(term, swings),
                    self._parameters(number, term, taps, unit),
                    curve,
                    sure=any(abs(value) > NORMAL * off for value, off in taps.values()),
                )
            )
        return self._renamed(out)

    def _damps(self, term: Term, curve: Curve, seconds: float) -> bool:
        """Whether a force that is a curve of its own output and, so many times, the curve's rate is mostly the latter."""
        if [f.signal for f in term.factors] != [f"y{term.chain}"]:
            return False
        slope = np.gradient(curve.value, curve.grid)
        moved = abs(seconds) * np.sqrt(np.mean(slope**2)) * self.axes[f"v{term.chain}"].scale
        return bool(moved > np.std(curve.value))

    def _renamed(self, found: list[FoundTerm]) -> list[FoundTerm]:
        """The terms; of several that are one curve of a rate, each with the name of the whole curve's shape."""
        terms = [t for t, _ in self.resolved()]
        kinds, states = ([t for t in terms if (t.slot == "slow") is slow] for slow in (False, True))
        groups: dict[int, list[int]] = {}
        for i, t in enumerate(kinds):
            if len(t.factors) == 1 and t.slot == "force" and t.factors[0].signal == f"v{t.chain}":
                groups.setdefault(t.chain, []).append(i)
        out = list(found)
        for group in (g for g in groups.values() if len(g) > 1):
            name = named_by_shape(
                found[group[0]].curve.grid, np.sum([found[i].curve.value for i in group], axis=0)
            )
            for i in group:
                out[i] = replace(found[i], same_as=name)
        for i, t in enumerate(kinds):
            if out[i].same_as == "input_saturation" and not self._saturates(t, found[i].curve):
                out[i] = replace(found[i], same_as="hammerstein")
            if out[i].same_as == "product_of_inputs" and carried(t, kinds):
                out[i] = replace(out[i], same_as="bilinear", nature="dynamic nonlinearity", meaning=CARRIED)
            slow = lagged(t, states)
            if slow is not None and slow.rate > -self._poles(t.chain).real.max():
                out[i] = replace(out[i], same_as="hammerstein", nature=nature(slow), meaning=LAGGED)
        return out

    def _saturates(self, term: Term, curve: Curve) -> bool:
        """Whether the input acts less and less with its size: what its curve takes from the linear path may open as it grows."""
        j, signal = self._drivers[term.chain], term.factors[0].signal
        direct = float(signal == f"u{j}")
        if j is None and signal.startswith("u"):  # the linear path in units of the force
            b = self.theta[self.assembly.betas[term.chain][int(signal[1:])]]
            direct = float(b[-1]) * self._highest(term.chain) / self.axes[signal].scale
        slope = np.abs(direct + np.gradient(curve.value, curve.grid))
        inner = np.abs(curve.grid - curve.grid.mean()) < 0.25 * np.ptp(curve.grid)
        return float(slope[~inner].mean()) < float(slope[inner].mean())

    def _parameters(self, number: int, term: Term, taps: Mapping[int, tuple[float, float]], unit: str):
        out = {COEFFICIENTS[m]: (*k, f"{unit} s{f'^{m}' * (m > 1)}" if m else unit) for m, k in taps.items()}
        at = self.form.blocks[number].start + self.form.taps(term)
        for f in term.factors:
            axis = self.axes[f.signal]
            for name, free, value, shift in (
                ("at", f.free[0], f.p, axis.centre),
                ("width", f.free[1], f.q, 0.0),
            ):
                if free:
                    spread = float(np.sqrt(max(self.covariance[at, at], 0.0)))
                    scaled = shift + axis.scale * value, axis.scale * spread, axis.unit
                    out[f"{name} of {axis.label}"] = scaled
                    at += 1
        return out

    def _curve(self, number: int, term: Term, unit: str) -> Curve:
        first = term.factors[0].signal
        low, high = self.ranges[first]
        grid = np.linspace(low, high, GRID)
        axes = self.axes

        def value(theta: Array) -> Array:
            one = self.resolved(theta)[number][0]
            others = {f.signal: np.full(GRID, axes[f.signal].scale and 1.0) for f in one.factors}
            raw = values(one, others | {first: grid})
            size = float(np.prod([axes[f.signal].scale ** DEGREE[f.kind] for f in one.factors]))
            return self.amplitude(number, theta) * size * raw

        axis = axes[first]
        return Curve(
            axis.label, axis.unit, axis.centre + axis.scale * grid, value(self.theta),
            BAND * error_of(value, self.theta, self.covariance), unit,
        )  # fmt: skip

    def equation(self, found: Sequence[FoundTerm]) -> str:
        """One line per output and slot, of terms in this order."""
        lines = []
        for i in range(len(self.form.orders)):
            label, unit = self.names[f"y{i}"]
            forces = [f.text for f in found if f.slot == "force" and f.output == i]
            shares = [f.text for f in found if f.slot == "mobility" and f.output == i]
            maps = [f.text for f in found if f.slot == "output" and f.output == i]
            if forces:
                lines.append(f"force on {label} ({self._force_unit(i)[0]}) = " + summed(forces))
            if shares:
                lines.append(
                    f"mobility of {label} (inverse inertia or capacity, relative) = 1 + " + summed(shares)
                )
            if maps:
                lines.append(f"{label} read (in {unit or 'its units'}) = {label} + " + summed(maps))
        return "; ".join(lines)

    def to_json(self) -> str:
        """Everything that `from_json` needs."""
        s = self.scales
        return json.dumps(
            {
                "form": asdict(self.form),
                "theta": self.theta.tolist(),
                "covariance": self.covariance.tolist(),
                "prior": {k: np.asarray(v).tolist() for k, v in vars(self.prior).items()},
                "scales": {k: np.asarray(v).tolist() for k, v in vars(s).items() if k != "differences"},
                "names": dict(self.names),
                "ranges": dict(self.ranges),
            }
        )

    @classmethod
    def from_json(cls, text: str) -> DiscoveredModel:
        """The model that `to_json` wrote."""
        d = json.loads(text)
        s = d["scales"]
        u, su, y, sy, delay = (np.array(s[k]) for k in ("u", "su", "y", "sy", "delay"))
        scales = Scales(
            u, su, y, sy, delay=delay,
            paces=tuple(s["paces"]),
            steps=tuple(s["steps"]),
            dt=s["dt"],
            bounds=tuple(tuple(b) for b in s["bounds"]),
        )  # fmt: skip
        start = d["prior"]
        arrays = {k: np.array(start[k]) for k in ("mean", "covariance", "correlation")}
        prior = StartPrior(arrays["mean"], arrays["covariance"], start["mse"], arrays["correlation"])
        pairs = lambda key: {k: tuple(v) for k, v in d[key].items()}
        return cls(
            Form.of(d["form"]),
            np.array(d["theta"]),
            scales,
            np.array(d["covariance"]),
            prior,
            pairs("names"),
            pairs("ranges"),
        )
