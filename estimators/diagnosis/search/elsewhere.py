"""One cause seen at several outputs: linear dynamics behind what another output's model simulates."""

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from estimators.diagnosis.baseline import Options, best_linear, of_output
from estimators.diagnosis.ladder import Kind, Step
from estimators.diagnosis.ladder.claims import Claim, Named
from estimators.diagnosis.model.fitting import leaving
from estimators.diagnosis.result.answers import LinearAnswer, ThroughAnswer
from estimators.diagnosis.search.named import Bench
from estimators.residual.algebra import decomposed, delayed
from oed.data import Record

Array = NDArray[Any]

TAPS = 30
"""Lags of what an effect changes at one output that must show in another's residual: half as many again as a long numerator has,
as one output may be late behind the other."""


def seen_elsewhere(
    record: Record, benches: Sequence[Bench], named: Sequence[Named], options: Options
) -> list[Named]:
    """The named models of all outputs, of some of them in place of their own that of another output and dynamics behind it.

    A displacement and its rate have one spring: from the input alone its effect on the rate is much harder to find.
    """
    out = list(named)
    if options.diagonal:
        return out
    for i, bench in enumerate(benches):
        for j, (other, cause) in enumerate(zip(benches, named, strict=True)):
            step = cause.step
            if (
                j != i
                and step is not None
                and cause.claims
                and not step.linear
                and bench.thin == other.thin == 1
            ):
                out[i] = _behind(record, bench, out[i], other, cause, step, options)
    return out


def _behind(
    record: Record, bench: Bench, own: Named, other: Bench, cause: Named, step: Step, options: Options
) -> Named:  # fmt: skip
    """The output's model behind another output's where unused blocks ask for it by what a search must gain, else its own."""
    i, policy, linear = bench.output, bench.policy, bench.linear
    known = own.unused if own.step is not None and len(own.unused) else linear
    plain = other.base.y_model[0][:, other.output]
    drive = np.where(np.isfinite(cause.unused), cause.unused, plain)
    if not _shows(bench, known, drive - plain):
        return own
    # Of every block what the other model simulates of it unseen, so that no error on unused blocks has seen its block.
    inputs = np.column_stack((record.u, drive))
    single = of_output(record, i).replace(u=inputs, input_names=(), input_units=())
    base = best_linear([single], options)
    m, unused = base.outputs[0], base.unused[0][:, 0]
    if not bench.over(unused, known).meets(policy.searched):
        return own
    behind = LinearAnswer(i, m.inputs, m.model, m.prior, bench.rest)
    answer = ThroughAnswer(i, step.answer, behind)
    run = answer.simulate(record, bench.base.blocks.window)[: len(bench.channel)]
    total = bench.over(unused, linear)
    scale = total.value / max(sum(c.gain.value for c in cause.claims), 1e-300)
    claims = tuple(
        Claim(c.part, replace(total, value=scale * c.gain.value), c.p_value, c.rivals) for c in cause.claims
    )
    whole = Step(Kind.NAMED, step.adds, (unused,), answer, step.size + m.model.order + m.model.num.size, {},
                 step.sentences, noise=m.noise[1:], nature=step.nature,
                 folds=tuple(replace(answer, through=f) for f in step.folds))  # fmt: skip
    return Named(
        leaving(own.fit, np.where(bench.channel.keep, bench.channel.y - run, 0.0)),
        claims,
        own.dropped,
        whole,
        unused,
    )


def _shows(bench: Bench, known: Array, changed: Array) -> bool:
    """Whether what an effect changes (N,) at another output foretells what the best model (N,) of this one leaves."""
    use = bench.counted & np.isfinite(known)
    left = bench.train.y[use, bench.output] - known[use]
    X = np.column_stack((np.ones(use.sum()), delayed(changed[:, None], range(TAPS))[use]))
    X[~np.isfinite(X)] = 0.0
    rest = left - X @ decomposed(X, left)
    return float(rest @ rest) < (1.0 - bench.policy.searched[1]) ** 2 * float(left @ left)
