"""Which linear models are tried for one output, and in which order."""

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.signal import lfilter

from estimators.diagnosis.baseline.blocks import Blocks
from estimators.diagnosis.baseline.choice import NOTHING, Candidate, Trial, cheapest
from estimators.diagnosis.baseline.choice import tried as judged
from estimators.diagnosis.baseline.disturbances import noise_model
from estimators.diagnosis.baseline.individual import Individual
from estimators.diagnosis.baseline.linear_model import LinearModel, Prior
from estimators.diagnosis.baseline.output_error import (
    ENOUGH,
    PATIENT,
    STILL,
    OutputError,
    descended,
    realised,
)
from estimators.diagnosis.baseline.regression import Arx, Lagged, fitted_to_all, lagged
from oed.data import Record

Array = NDArray[Any]

ORDERS = (0, 1, 2, 3, 4, 5, 6, 8, 10)
"""Orders of ARX; ten lags are what every answer is compared with."""
LOW, MANY = 3, 10
"""Lags of the output in a model that cannot take a tone or a trend for its own dynamics and fit the rest; and its parameters."""
LONG = 20
"""Coefficients of a long numerator: enough for what few poles leave, few enough for a record of some hundred samples."""
DELAYS = (0, 1, 2, 3, 5, 8)
"""Delays tried on every record, beside those that its impulse response shows."""
REFINED = (1, 2, 3, 4, 5, 6, 8)
"""Orders refined to the least simulation error."""
PREFILTERED = 8
"""Iterations of Steiglitz and McBride, each an ARX of the records filtered by the one before: most of the way is made in five."""
NEARER = 0.95
"""Of the loss from a reduction or from ARX, below which the iteration's end is another minimum and not the same."""
REALISED = 30
"""Lags of the impulse response that a reduction to few poles keeps: three times the largest order."""
REDUCED, SAMPLES = 30, 10
"""Order of a long ARX, whose reduction knows light modes that noise hides from a short one, and samples that each of its coefficients has."""
BLIND = (0.5, 0.8)
"""Error of refined models, of that of ARX, below which ARX has seen next to nothing, and its delays are those of noise; and the same for
a patient search."""
MOVES = (4, 2, 1)
"""Samples by which a delay moves: what light modes still ring with hides the onset of an impulse response by more than one."""
STEPS = (4, 8, 4)
"""Gauss-Newton steps from each start, on from the best of them, and without one block from the optimum on all data."""
EARLY = 2
"""Samples before the onset of an impulse response at which its model may begin: the first of them drown in noise."""
OWN, SPARE, LONGER = (1, 2, 3, 4, 5, 6), 3, 40
"""Poles that each of several inputs may have to itself, coefficients beyond them (delays up to three samples), and steps:
such a fit starts from a model with poles in common, which is far."""
LATEST = 400
"""Longest delay looked for, in samples, and at most a quarter of a record."""
ONSET = (5.0, 0.2)
"""An impulse response begins where it is so many standard deviations, and so much of its largest value, above nothing."""


def onsets(records: Sequence[Record], output: int, runs: Sequence[Array]) -> tuple[int, ...]:
    """For each input the lag at which the output less a free run, (N,) per record, first answers it; 0 where it does not.

    It is the correlation of both after the input's own is filtered out.
    """
    lags = min(LATEST, min(len(r) for r in records) // 4)
    out = []
    for j in range(records[0].n_inputs):
        a, _ = noise_model([r.u[:, j] - r.u[:, j].mean() for r in records])
        total, scale, count = np.zeros(lags + 1), np.zeros(2), 0
        for r, run in zip(records, runs, strict=True):
            y = r.y[:, output] - run
            y = np.nan_to_num(y - np.nanmean(y))
            x, y = (np.asarray(lfilter(a, [1.0], v))[len(a) :] for v in (r.u[:, j] - r.u[:, j].mean(), y))
            spectrum = np.fft.rfft(y, 2 * len(y)) * np.conj(np.fft.rfft(x, 2 * len(x)))
            total += np.fft.irfft(spectrum)[: lags + 1]
            scale += [x @ x, y @ y]
            count += len(x)
        size = np.abs(total) / max(float(np.sqrt(scale.prod())), 1e-300)
        above = np.flatnonzero(size > max(ONSET[0] / np.sqrt(count), ONSET[1] * size.max()))
        out.append(int(above[0]) if len(above) else 0)
    return tuple(out)


@dataclass(frozen=True, eq=False)
class Search:
    """One output of some records, with all that comparing its models needs."""

    records: Sequence[Record]
    output: int
    blocks: Blocks
    prior: Prior
    offset: bool
    asked: tuple[Array, ...] = ()  # (M, inputs) on which the model is wanted
    moving: bool = False  # whether the records are known to begin away from rest
    limit: float = 1.0  # radius up to which a pole may lie; beyond 1 a model needs one outside the circle
    patient: bool = False  # whether descents begin from a long ARX too, and go on for long
    later: bool = False  # whether no input acts in its own sample
    # long ARX that were asked before: of these records, so that a search of others begins without
    long: dict[tuple, LinearModel] = field(default_factory=dict, init=False)

    @property
    def ends(self) -> tuple[float, float]:
        """Where descents end."""
        return PATIENT if self.patient else (STILL, ENOUGH)

    @property
    def inputs(self) -> int:
        """Number of inputs."""
        return self.records[0].n_inputs

    def arx(self, *, few: bool = False) -> list[Trial]:
        """Stable ARX over orders, numerators and delays: short ones, and those where the impulse responses begin; of `few` parameters."""
        found = self._grid((0,) * self.inputs, DELAYS[self.later :], few)
        first, runs = (0,) * self.inputs, [np.zeros(len(r)) for r in self.records]
        for _ in range(2):  # again in what is left: an input that answers strongly hides the onset of another
            seen = onsets(self.records, self.output, runs)
            late = tuple(
                max(0, d - EARLY) if d > max(DELAYS) else f for d, f in zip(seen, first, strict=True)
            )
            if late == first or not (found := found + self._grid(late, range(2 * EARLY), few)):
                break
            first, best = late, cheapest(found).candidate.models[-1]
            runs = [
                best.free_run(self.prior, r.u, r.y[:, self.output], self.blocks.window) for r in self.records
            ]
        return found

    def _grid(self, first: tuple[int, ...], later: Sequence[int], few: bool) -> list[Trial]:
        """ARX whose inputs are late by `first` and one of `later` more."""
        regressors = self._lagged(Arx(max(ORDERS), max(later) + LONG + 1, first, True))
        forms = [
            Arx(na, nb, tuple(d + more for d in first), self.offset)
            for more in later
            for na in ORDERS
            for nb in sorted({max(1, na - 1), max(1, na), na + 1, LONG})
        ]
        forms = [form for form in forms if not few or (form.na <= LOW and form.size <= MANY)]
        found = [self.tried(self._arx(regressors, form)) for form in forms]
        return [t for t in found if t is not None]

    def again(self, chosen: Candidate) -> Trial:
        """A model chosen on other parts of the records, fitted to these."""
        form = chosen.form
        if chosen.kind in ("ARX", "FIR"):
            candidate = self._arx(self._lagged(replace(form, offset=True)), form)
        else:
            problem = OutputError(self.records, self.output, form, self.prior, self.limit)
            rows = [np.ones(n, dtype=bool) for n in self.blocks.lengths]
            candidate = self._oe(problem, problem.fit(chosen.models[-1], rows, STEPS[1])[0], chosen.kind)
        trial = self.tried(candidate)
        return (
            self.tried(replace(chosen, models=[chosen.models[-1]] * (len(self.blocks.blocks) + 1)))
            if trial is None
            else trial
        )  # type: ignore[return-value]

    def _lagged(self, widest: Arx) -> Lagged:
        return lagged(self.records, self.output, self.blocks, widest, self.prior.rest)

    def _least(self, form: Arx) -> LinearModel:
        """ARX of a form, fitted to all blocks."""
        return fitted_to_all(self.records, self.output, form, self.prior.rest)

    def _arx(self, regressors: Lagged, form: Arx) -> Candidate:
        models = [regressors.fit(form, b) for b in [*range(len(self.blocks.blocks)), -1]]
        return Candidate("ARX" if form.na else "FIR", _words(form), form.size, models, form)

    def tried(self, candidate: Candidate | None) -> Trial | None:
        """A model's runs on unused blocks; None where they are not bounded, or it is not of the kind looked for."""
        if candidate is None or candidate.models[-1].radius <= 1.0 < self.limit:
            return None
        return judged(candidate, self.records, self.output, self.blocks, self.prior, self.asked, self.limit)

    def refined(self, known: Sequence[Trial]) -> list[Trial]:
        """Output-error models of every order, started from reductions of the best models known and from ARX."""
        best = sorted(known, key=lambda t: t.rmse)
        if not best:
            return []
        delays = list(dict.fromkeys(t.candidate.form.delay for t in best[:10]))[:2]
        found = self._orders(best, delays)
        short = tuple(d if d > max(DELAYS) else min(d, 1) for d in delays[0])
        if min((t.rmse for t in found), default=np.inf) < BLIND[self.patient] * best[0].rmse:
            if short not in delays:
                found += self._orders(sorted((*best, *found), key=lambda t: t.rmse), [short])
            moved = self._moved(min(found, key=lambda t: t.rmse))
            if moved is not None:
                found += [moved, *self._orders([moved, *best], [moved.candidate.form.delay])]
            best = sorted((*best, *found), key=lambda t: t.rmse)
        if self.inputs > 1:
            found += self._of_each(sorted((*best, *found), key=lambda t: t.rmse))
        return found

    def _orders(self, best: Sequence[Trial], delays: Sequence[tuple[int, ...]]) -> list[Trial]:
        """An output-error model of every order, of one of the delays."""
        found = []
        for n in REFINED:
            forms = [(n, tuple(max(d, 1) for d in delay)) for delay in delays] + [(n + 1, delays[0])]
            fits = [
                fit
                for nb, delay in dict.fromkeys(forms)
                if (fit := self._fitted(Arx(n, nb, delay, self.offset), best))
            ]
            if fits:
                _, problem, model = min(fits, key=lambda f: f[0])
                found.append(self.tried(self._oe(problem, model, "OE")))
        return [t for t in found if t is not None]

    def _moved(self, first: Trial) -> Trial | None:
        """The model with its delays moved on by ever smaller steps for as long as unused blocks get better; None where none is better."""
        top = first
        for step in (way * size for size in MOVES for way in (-1, 1)):
            while True:
                form = replace(
                    top.candidate.form, delay=tuple(max(1, d + step) for d in top.candidate.form.delay)
                )
                fit = self._fitted(form, [top], False) if form != top.candidate.form else None
                trial = fit and self.tried(self._oe(*fit[1:], "OE"))
                if not (trial and trial.rmse < (1.0 - NOTHING) * top.rmse):
                    break
                top = trial
        return None if top is first else top

    def _prefiltered(self, form: Arx) -> LinearModel | None:
        """The iteration of Steiglitz and McBride, which finds light modes in noise where ARX and descents from it do not.

        None where samples are missing, or no iterate is stable.
        """
        if not all(np.isfinite(r.y[:, self.output]).all() for r in self.records):
            return None
        records, stable = self.records, None
        for _ in range(PREFILTERED):
            model = replace(self, records=records)._least(form)
            roots = np.roots(model.den).astype(complex)
            outside = np.abs(roots) >= 1.0
            roots[outside] = 1.0 / np.conj(roots[outside])
            if not outside.any():
                stable = model
            den = np.real(np.poly(roots))
            records = [
                r.replace(u=lfilter([1.0], den, r.u, axis=0), y=lfilter([1.0], den, r.y, axis=0))
                for r in self.records
            ]
        return stable

    def _fitted(
        self, form: Arx, best: Sequence[Trial], anew: bool = True
    ) -> tuple[float, OutputError, LinearModel] | None:
        """Schwarz's criterion, problem and model of an output-error form, from a reduction of the best, ARX and its iteration; `anew` by a
        patient search, from that of a long ARX too."""
        patient = self.patient and anew
        rows = [np.ones(n, dtype=bool) for n in self.blocks.lengths]
        starts = [realised(best[0].candidate.models[-1], form, REALISED)]
        starts += [t.candidate.models[-1] for t in best if t.candidate.form.na == form.na][:1]
        problem = OutputError(self.records, self.output, form, self.prior, self.limit)
        ends = [
            problem.fit(m, rows, STEPS[0], self.ends)
            if m is not None and m.radius < self.limit
            else (None, np.inf)
            for m in (
                *starts,
                self._prefiltered(form),
                realised(self._long(form), form, 2 * REDUCED) if patient else None,
            )
        ]
        model, loss = min(ends[:-2], key=lambda end: end[1])
        if ends[-2][1] < NEARER * loss:
            model, loss = ends[-2]
        tops = [model] if ends[-1][1] > NEARER * loss else [model, ends[-1][0]]
        steps = LONGER if patient else STEPS[1]
        ends = [problem.fit(m, rows, steps, self.ends) for m in tops if m is not None]
        if not ends:
            return None
        model, loss = min(ends, key=lambda end: end[1])
        count = sum(self.blocks.lengths)
        return count * np.log(max(loss, 1e-300)) + form.size * np.log(count), problem, model

    def _long(self, form: Arx) -> LinearModel:
        """ARX long enough to hold any noise too, of the delay and offset of a form."""
        key = form.delay, form.offset
        if key not in self.long:
            order = min(REDUCED, sum(self.blocks.lengths) // (SAMPLES * (1 + self.inputs)))
            self.long[key] = self._least(replace(form, na=order, nb=order))
        return self.long[key]

    def of_form(self, form: Arx, *near: LinearModel) -> Candidate | None:
        """Output error of one form, from least squares, their iteration and reductions of models near by; `noise` is its mean square."""
        rows = [np.ones(n, dtype=bool) for n in self.blocks.lengths]
        starts = [self._least(form), self._prefiltered(form), *(realised(m, form, REALISED) for m in near)]
        problem = OutputError(self.records, self.output, form, self.prior, self.limit)
        ends = [problem.fit(m, rows, LONGER) for m in starts if m is not None and m.radius < self.limit]
        if not ends:
            return None
        model, loss = min(ends, key=lambda end: end[1])
        return replace(self._oe(problem, model, "OE"), noise=loss)

    def _of_each(self, known: Sequence[Trial]) -> list[Trial]:
        """Models with poles of its own for each input, from reductions of the best model known and of the best ARX, then one another."""
        best = known[0].candidate
        arx = next((t.candidate for t in known if t.candidate.kind == "ARX"), best)
        delay = tuple(d if d > max(DELAYS) else 1 for d in best.form.delay)
        rows, found = [np.ones(count, dtype=bool) for count in self.blocks.lengths], []
        theta: Array | None = None
        for n in OWN:
            problem = Individual(self.records, self.output, Arx(n, n + SPARE, delay, self.offset), self.prior)
            starts = [problem.start(c.models[-1], REALISED) for c in (best, arx)]
            starts += [] if theta is None else [problem.grown(theta)]
            ends = [
                descended(problem, s, rows, STEPS[1], self.ends)
                for s in starts
                if problem.model(s).radius < 1.0
            ]
            if not ends:
                break
            theta, loss = descended(problem, min(ends, key=lambda end: end[1])[0], rows, LONGER, self.ends)
            parts = [
                descended(problem, theta, self.blocks.training(b), STEPS[2], self.ends)[0]
                for b in self.blocks.blocks
            ]
            words = f"{n} poles of its own for each input, {n + SPARE} coefficients, delay {min(delay)}"
            models = [problem.model(t) for t in (*parts, theta)]
            found.append(self.tried(Candidate("OE", words, problem.size, models, problem.common, loss)))
        return [t for t in found if t is not None]

    def _oe(self, problem: OutputError, model: LinearModel, kind: str) -> Candidate:
        models = [
            problem.fit(model, self.blocks.training(b), STEPS[2], self.ends)[0] for b in self.blocks.blocks
        ]
        return Candidate(kind, _words(problem.form), problem.form.size, [*models, model], problem.form)


def _words(form: Arx) -> str:
    delays = sorted(set(form.delay))
    delay = str(delays[0]) if len(delays) == 1 else "/".join(map(str, form.delay))
    return f"{form.na} poles, {form.nb} coefficients of the input, delay {delay}"
