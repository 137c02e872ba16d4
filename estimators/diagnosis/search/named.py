"""The named stage: effects of the catalogue in one joint model, each kept only where unused blocks ask for it.

Significance says that a model without the effect is wrong, not that the effect is right: a claim needs both a gain on
blocks that no parameter saw, beyond its standard error, and significance in the joint fit.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.signal import lfilter

from estimators.diagnosis.baseline import Baseline
from estimators.diagnosis.effects import Nature, Slot
from estimators.diagnosis.effects.disturbances.added import OFFSET
from estimators.diagnosis.ladder import Gain, Kind, Step, paired_gain
from estimators.diagnosis.ladder.claims import Claim, Named
from estimators.diagnosis.ladder.steps import as_started, is_sane
from estimators.diagnosis.model.errors import parameters_of
from estimators.diagnosis.model.fitting import Channel, Fit
from estimators.diagnosis.model.forces import effective_samples
from estimators.diagnosis.model.structure import Part
from estimators.diagnosis.policy import Policy
from estimators.diagnosis.record.paired import as_good
from estimators.diagnosis.result.answers import LinearAnswer, NamedAnswer
from estimators.diagnosis.search.exchange import without, without_idle
from estimators.diagnosis.search.free_runs import blocked, denominator, lengthened, start_of
from estimators.diagnosis.search.naming import BENT, as_shown, bending, dated, scaled_runs, told_apart
from estimators.diagnosis.search.ratios import part_significance
from estimators.diagnosis.search.selection import Attribution
from estimators.diagnosis.search.selection import Claim as Option
from estimators.diagnosis.share.feedback import answered, autoregression, whitened
from estimators.diagnosis.share.news import FREE, Predictor
from estimators.residual.measures import p_stated
from oed.data import Record

Array = NDArray[Any]


def linear_step(base: Baseline, i: int, rest: bool, adds: tuple[str, ...] = ()) -> Step:
    """The best linear model of an output as the first step."""
    m = base.outputs[i]
    answer = LinearAnswer(i, m.inputs, m.model, m.prior, rest)
    size = m.model.order + m.model.num.size
    unused = tuple(u[:, i] for u in base.unused)
    return Step(Kind.LINEAR, adds, unused, answer, size, noise=m.noise[1:], linear=True)


NO_MORE = 1.1
"""Times the noise, that the squared error of unused blocks may be where nothing is left but noise: what parameters cost there."""


@dataclass(frozen=True, eq=False)
class Bench:
    """What the trials of one output share: data, blocks, how runs start, thresholds."""

    channel: Channel
    base: Baseline
    output: int
    train: Record
    thin: int
    rest: bool
    white: bool  # fits minimise the simulation error itself
    policy: Policy
    alpha: float
    family: int  # effects that the record is tested for
    # the input acts in the sample in which it is measured: it is taken one sample earlier
    ahead: bool = False
    # the input answers the noise: a model may then gain by hearing that echo, and one-step errors must fall too
    feedback: bool = False
    # the present input answers the present noise: a model may also be the controller's inverse, so that it gets no claims;
    # its free runs are judged as any other's, as one-step errors would be in favour of the inverse
    inverse: bool = False
    skip: int = 0  # samples of a test record that may set its initial state
    wanted: Record | None = None  # the record on which its run is wanted, without outputs
    # free runs of blocks by fits that were asked before, and their parameters without each block
    known: dict[Fit, tuple[Array, tuple[Array, ...]]] = field(default_factory=dict)

    @property
    def kept(self) -> NDArray[np.bool_]:
        """(n,) samples of the record, all but a rest of its thinning, that are measurements."""
        return np.repeat(self.channel.keep, self.thin)

    @property
    def linear(self) -> Array:
        """(N,) the linear model's run of unused blocks."""
        return self.base.unused[0][:, self.output]

    @property
    def counted(self) -> NDArray[np.bool_]:
        """(N,) samples that count: measured, after a block's window, neither held nor wild."""
        use = self.base.blocks.counting([self.train])[0][:, self.output].copy()
        kept = self.kept
        use[: len(kept)] &= kept[: len(use)]
        return use

    def stands(self, n: Named) -> bool:
        """Whether the ladder will not refuse a named model for how it starts, nor for a run that explodes where it is wanted: what drifts
        steadily does so beyond any end."""
        if n.step is None:
            return True
        steps = [linear_step(self.base, self.output, self.rest), n.step]
        bounded = True
        if self.wanted is not None:
            linear, run = (s.simulate(self.wanted, 0) for s in steps)
            bounded = is_sane(run, linear, self.train.y[:, self.output], self.policy)
        return bounded and as_started(steps, self.train, self.output, self.skip)[1].admitted

    def unused(self, f: Fit) -> Array:
        """(N,) free run of every block by parameters that did not see it."""
        if f not in self.known:
            start = start_of(f, self.channel, self.base.outputs[self.output].prior, self.rest)
            run, folds = blocked(self.channel, f, self.base.blocks, self.thin, start, white=self.white)
            self.known[f] = self.rounded(run), folds
        return self.known[f][0]

    def error(self, run: Array) -> float:
        """Root mean square error of a run of unused blocks."""
        return float(np.sqrt(np.mean((self.train.y[:, self.output] - run)[self.counted] ** 2)))

    def rounded(self, run: Array) -> Array:
        """As the sensor rounds."""
        step = self.channel.step
        return np.round(run / step) * step if step > 0 else run

    def answer(self, f: Fit) -> NamedAnswer:
        """A fit as the model of the output; its clock is the training record's."""
        start = start_of(f, self.channel, self.base.outputs[self.output].prior, self.rest)
        clock = (self.train.t0, self.train.dt, len(self.train))
        return NamedAnswer(
            self.output, f.structure, f.p, start, clock, self.thin, self.channel.step, self.ahead
        )

    def gain(self, first: Array, second: Array, part: Part) -> Gain:
        """Paired gain on the samples that count; for what runs by the clock, the least of all and of the last block.

        Only there is time extrapolated, as it is on a later record.
        """
        whole = self.over(second, first)
        if part.effect.nature not in CLOCKED:
            return whole
        return min(whole, self.over(second, first, self.base.blocks.blocks[-1].start), key=lambda g: g.value)

    def _answer(self, run: Array) -> float:
        """Share of the input's innovations that answers the error of a run of unused blocks, beyond chance."""
        errors = np.where(self.counted, np.nan_to_num(self.train.y[:, self.output]) - run, 0.0)
        return answered([self.train], [errors], [self.counted])

    def echoes(self, run: Array) -> bool:
        """Whether a run of unused blocks (N,) gains so little that it may only hear the answer of the input to the noise."""
        gain, policy = self.over(run, self.linear), self.policy
        weak = not gain.meets(policy.searched)
        return (self.feedback and weak) or (self.inverse and not gain.meets(policy.overwhelming))

    def hears(self, step: Step) -> bool:
        """Whether a step may only hear that answer, or is the inverse of a controller: it acts at once, and the linear model later."""
        late = self.feedback and min(self.base.outputs[self.output].delays) > 0
        return (late and step.at_once(self.train, self.base.blocks.window)) or self.echoes(step.unused[0])

    @cached_property
    def _inputs(self) -> Predictor:
        return Predictor.of([self.train], self.base.y_model[:1], self.output, [self.counted], past=False)

    def tells(self, f: Fit) -> bool:
        """Whether a fit's run of unused blocks is news to all that is linear in the inputs, its own dynamics at small ones among that;
        never where an input answers the noise, nor where what runs by the clock leaves an error as slow as it is itself."""
        if self.feedback or self.inverse:
            return False
        c, natures = self.channel, {part.effect.nature for part in f.structure.effects}
        left = self._left(f)
        if natures.intersection(CLOCKED) and not effective_samples(left) > INDEPENDENT:
            return False
        none, little, *_ = scaled_runs(f, c)  # what sticks at small inputs shows its poles by theirs alone
        small = () if Nature.TIME in natures else (little - none,)  # which change with time too
        known = self._inputs
        for signal in (*small, *lfilter([1.0], denominator(f), c.u - c.u.mean(axis=0), axis=0).T):
            if not np.all(np.isfinite(signal)):
                return False
            known = known.beside([lengthened(signal, self.thin, len(self.train))])
        return FREE < known.news([self.unused(f)]) < np.inf  # else there are too few samples

    def spent(self, f: Fit) -> bool:
        """Whether a fit leaves white noise, and hardly more of it in unused blocks: nothing in which a remainder could look for more."""
        if len(f.noise) or self.thin > 1:
            return False
        return float(np.mean(self._left(f)[self.counted] ** 2)) < NO_MORE * f.variance

    def _left(self, f: Fit) -> Array:
        """(N,) what a fit's run of unused blocks leaves of the samples that count."""
        return np.where(self.counted, np.nan_to_num(self.train.y[:, self.output]) - self.unused(f), 0.0)

    @cached_property
    def _answered(self) -> float:
        return self._answer(self.linear)

    def over(self, second: Array, first: Array, start: int = 0) -> Gain:
        """What one prediction (N,) of unused blocks gains over another from a sample on."""
        y, counted = np.nan_to_num(self.train.y[:, self.output]), self.counted
        counted[:start] = False
        gain = paired_gain([y], [first], [second], [counted], self.policy)
        if not self.feedback or not np.isfinite(gain.value):
            return gain
        if self._answer(second) < ANSWERED * self._answered:
            return gain  # what the input seemed to answer was an error of the linear model, and no noise
        errors = [np.where(counted, y - run, 0.0) for run in (first, second)]
        # each under a noise model of its own: that of a smooth model error makes much of the white noise that a better one leaves
        steps = [whitened(autoregression([e], [counted]), e) for e in errors]
        one_step = paired_gain([0.0 * y], steps[:1], steps[1:], [counted], self.policy)
        return min(gain, one_step, key=lambda g: g.share)


def named_steps(bench: Bench, a: Attribution) -> Named:
    """Prune the joint model of a search until unused blocks ask for every effect left; what is also significant is claimed.

    An effect that unused blocks ask for stays in the model though it is not significant: without it they get worse, and
    the effects beside it would be judged in a wrong model.
    """
    f, dropped = a.final, []
    unused = bench.unused(f) if f.structure.effects else np.zeros(0)
    while f.structure.effects:
        if (gone := without_idle(bench.channel, f)) is not None:
            dropped.append((f.structure.parts[gone[0]].key, "it changes nothing of the run"))
            f = min(gone[1], _best_without(bench, a, f, gone[0]), key=lambda g: bench.error(bench.unused(g)))
            unused = bench.unused(f)
            continue
        claims, rests = [], []
        for position, part in enumerate(f.structure.parts):
            if position < f.structure.base:
                continue
            form = part.effect.slot is Slot.FORM
            if form and not part.effect.block and len(f.structure.effects) > 1:
                continue  # the others were fitted in this form: without it there is no model of them
            rest = a.base if form else _best_without(bench, a, f, position)
            rests.append((rest, bench.unused(rest)))
            gain = bench.gain(rests[-1][1], unused, part)
            claims.append(Claim(part, gain, part_significance(rest, f, part, bench.family, bench.channel.u)))
        weak = [i for i, c in enumerate(claims) if not _gains(c, bench)]
        if not weak:
            known = lambda c, f=f: dated(c, f, bench.channel) and told_apart(c, f, bench.channel)
            sure = (c for c in claims if _holds(c, bench) and known(c))
            held = _surest(sorted(sure, key=lambda c: -c.gain.value), bench)
            dropped += [(c.key, _why(c, bench)) for c in claims if c not in held]
            shown = [replace(c, part=as_shown(c.part, f, bench.channel)) for c in held]
            held = bending(bench, f, shown, unused, a.alternatives)
            held.sort(key=lambda c: c.part.effect.key == "order")  # dynamics without a name come last
            dynamics = [c.part.effect.nature is Nature.LINEAR for c in claims]
            bare = [rest for (rest, _), plain in zip(rests, dynamics, strict=True) if not plain]
            other, told = _as_linear(bench, a, f) if len(held) == 1 and bent(held[0]) else (None, False)
            claims = tuple(_with_rivals(held, a, f))
            left = float(np.sum(f.residual**2) / max(np.sum(a.base.residual**2), 1e-300))
            linear = other is not None or all(_foretold(c, bench, left) for c in claims)
            step = replace(_step(bench, f, held, unused, bare), linear=linear) if held else None
            alike = None if other is None else (other.effect, bench.answer(other.fit))
            n = Named(f, claims, tuple(dropped), step, unused, alike)
            return n if told else n.as_linear()
        worst = min(weak, key=lambda i: claims[i].gain.value)
        dropped.append((claims[worst].key, _why(claims[worst], bench)))
        f, unused = rests[worst]
    step = None
    if bench.channel.step > 0:  # the linear model as a coarse sensor reads it
        step = Step(Kind.NAMED, ("quantised",), (bench.unused(f),), bench.answer(f), len(f.p), linear=True)
    return Named(f, (), tuple(dropped), step)


def _best_without(bench: Bench, a: Attribution, f: Fit, position: int) -> Fit:
    """Of the models without a part, each from starts of its own, the one that simulates unused blocks best: what is closest on the
    record itself may be far off there, and would make the part seem to explain what the others do alone."""
    options = without(bench.channel, f, position, a.alternatives)
    same = len(a.base.residual) == len(options[0].residual)  # not of a record thinned less
    if same and all(q.effect.slot is Slot.FORM for q in options[0].structure.effects):
        options.append(a.base)
    return min(options, key=lambda g: bench.error(bench.unused(g)))


ANSWERED = 0.3
"""Of the share of the input that answers the linear model's error, below which a model has explained what was answered: noise
stays in the error of any model, and its answer with it."""
CLOCKED = (Nature.TIME, Nature.ADDED)
"""Natures of causes that run by the clock: between two stretches of one record they can imitate anything."""
INDEPENDENT = 80
"""Samples, independent ones, that the error has beside a cause that runs by the clock: slow noise leaves slow noise. Trends that gained
what a claim asks, and were news, left so many in 4 % of random walks of 400 to 1000 samples, in .3 % of noises with memories of 30 to 500."""


def _gains(c: Claim, bench: Bench) -> bool:
    """Whether unused blocks ask for it: of a start they say nothing, and times were searched on them, which asks for more."""
    limit = bench.policy.searched if c.part.effect.nature in CLOCKED else bench.policy.claimed
    return c.key == "initial" or c.gain.meets(limit)


def _holds(c: Claim, bench: Bench) -> bool:
    """Whether it is significant in the joint fit, or gains more on unused blocks than needs a test; dynamics, what a search asks."""
    if c.part.effect.nature is Nature.LINEAR and not c.gain.meets(bench.policy.searched):
        return False
    return c.p_value < bench.alpha or c.gain.meets(bench.policy.overwhelming)


def _surest(held: list[Claim], bench: Bench) -> list[Claim]:
    """Those that are significant, where any is: beside one, what the record itself does not ask for only bends to it."""
    return [c for c in held if c.p_value < bench.alpha] or held


HALF = 1.5
"""Simulation error on the record itself, of another model's, from which on a model is neither as good as it nor half of an answer:
in one-step errors, under a noise model of its own each, the two may still be alike."""
LEFT = 0.05
"""Of a linear model's squared error, what a joint model may leave for an added signal to be no slow noise: a step or a passing
disturbance takes up to nine tenths of a random walk."""


def _foretold(c: Claim, bench: Bench, left: float) -> bool:
    """Whether linear predictors know of it: dynamics, a level, an added signal of a size that slow noise is not taken for."""
    sure = c.gain.meets(bench.policy.overwhelming) or (left < LEFT and c.gain.meets(bench.policy.searched))
    added = c.part.effect.nature is Nature.ADDED and sure
    return c.part.effect.nature is Nature.LINEAR or c.key == OFFSET.key or added


def _why(c: Claim, bench: Bench) -> str:
    if not c.gain.beyond(bench.policy.claimed[0]):
        return "blocks not used do not get better by more than their standard error"
    if c.gain.share <= bench.policy.claimed[1]:
        return f"it explains {100 * max(c.gain.share, 0.0):.3g} % of the error on unused blocks"
    if c.part.effect.timed and _gains(c, bench) and c.p_value < bench.alpha:
        return "unused blocks get better with it, but the record does not tell when it happens"
    if not _gains(c, bench):
        return "unused blocks get better with it, but not by what a search of times asks"
    if c.part.effect.nature in CLOCKED and c.p_value < bench.alpha:
        return "unused blocks get better with it, but an input comes again at the same times: what repeats may be its answer"
    if c.part.effect.nature is Nature.LINEAR and c.p_value < bench.alpha:
        return "unused blocks get better with it, but not by what a search of linear models asks"
    return f"unused blocks get better with it, but it is not significant in the joint fit ({p_stated(c.p_value)})"


def bent(c: Claim) -> bool:
    """Whether it is no linear dynamics: what a pole or a delay explains as well is that."""
    return c.part.effect.nature in BENT


def _as_linear(bench: Bench, a: Attribution, f: Fit) -> tuple[Option | None, bool]:
    """Linear dynamics that fit the record as well as a model of one bent effect, and whether unused blocks tell the two apart: by
    what the best of a search must gain, or by more than is linear in the inputs."""
    alike = [o for o in a.claims if o.effect.nature is Nature.LINEAR and _near(f, o.fit)]
    told = [bench.over(bench.unused(f), bench.unused(o.fit)).meets(bench.policy.searched) for o in alike]
    first = next((o for o, apart in zip(alike, told, strict=True) if not apart), alike[0] if alike else None)
    return first, first is None or all(told) or bench.tells(f)


def spread(f: Fit) -> float:
    """Root mean square simulation error on the record that a fit saw."""
    return float(np.sqrt(np.sum(f.residual**2) / f.n)) if np.isfinite(f.deviance) else float("inf")


def _near(f: Fit, g: Fit) -> bool:
    """Whether the record cannot tell that a model is worse than another, neither in one-step errors nor in simulation."""
    return as_good(f, g) and spread(g) < HALF * spread(f)


def _with_rivals(claims: list[Claim], a: Attribution, f: Fit) -> list[Claim]:
    """Single effects that fit as well as the first one does, and what the search noted for the others."""
    out = []
    for c in claims:
        names = list(a.rivals.get(c.key, []))
        if len(claims) == 1:
            names += [o.cause for o in a.claims if o.cause != c.cause and _near(f, o.fit)]
        out.append(Claim(c.part, c.gain, c.p_value, tuple(n for n in dict.fromkeys(names) if n != c.cause)))
    return out


def _step(bench: Bench, f: Fit, claims: list[Claim], unused: Array, bare: list[Fit]) -> Step:
    answer = bench.answer(f)
    return Step(
        Kind.NAMED, tuple(c.key for c in claims), (unused,), answer, len(f.p), parameters_of(f, bench.channel),
        tuple(c.part.effect.sentence for c in claims), noise=f.noise, nature=claims[0].part.effect.nature.value,
        folds=tuple(replace(answer, p=p) for p in bench.known[f][1]), without=bench.answer(bare[0]) if len(bare) == 1 else None,
    )  # fmt: skip
