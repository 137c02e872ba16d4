"""The remainder: what is still explainable without a name, by a bounded mixture that unused blocks weigh and admit."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import nnls

from estimators.diagnosis.baseline import Baseline
from estimators.diagnosis.ladder import Gain, paired_gain
from estimators.diagnosis.policy import Effort, Policy
from estimators.diagnosis.remainder.footing import Footing
from estimators.diagnosis.remainder.members import Networks, scale_of, starts_of, trained
from estimators.diagnosis.remainder.mixture import Remainder
from estimators.diagnosis.remainder.ridge import PENALTIES, Ridge, Set, columns, normal_equations, ridge_of
from estimators.diagnosis.remainder.trees import Trees, grown, table
from estimators.diagnosis.share import Share
from estimators.diagnosis.share.feedback import autoregression, delayed, has_feedback, whitened
from estimators.diagnosis.share.signals import bank_of
from oed.data import Record

Array = NDArray[np.float64]

CLOCKED = ("disturbance", "time variation", "sampling")
"""Natures whose causes run by the clock."""
ECHOES = ("noise", "linear dynamics")
"""What the answer of a controller to the noise looks like to a regression on inputs."""
PIECES = 20
"""Stretches over which the size of what is left is compared: long enough for a mean square, short enough to be local."""


@dataclass(frozen=True)
class Limits:
    """How much work a remainder may be, and when it is taken.

    `shapes` states and neurons of the networks: a second-order force and a curve; more is for the thorough;
    `trees` whether trees are grown; `starts` of each shape: one in four ends within a tenth of the best on practice records; `reach` by how
    much of the training residual's span a correction may exceed it; `fade` spans beyond an input's training
    range at which the correction begins to fade, and is gone; `errors, least` gain on unused blocks that
    admits it: in standard errors, and as a share of the error there. With one standard error coloured noise
    of linear systems was taken up, and did harm; `light` A member with less weight than this is left out;
    `pull` of every weight to zero, relative to its member's own size: members are alike, their weights hardly
    known.
    """

    shapes: tuple[tuple[int, int], ...] = ((2, 4),)
    trees: bool = True
    starts: int = 8
    reach: float = 0.2
    fade: tuple[float, float] = (0.25, 1.0)
    errors: float = 2.0
    least: float = 0.01
    light: float = 0.05
    pull: float = 0.1

    @classmethod
    def of(cls, effort: Effort) -> Limits:
        """Limits of an effort."""
        shapes = {Effort.QUICK: (), Effort.NORMAL: ((2, 4),), Effort.THOROUGH: ((2, 4), (3, 6))}
        return cls(shapes=shapes[effort], trees=effort is not Effort.QUICK)


@dataclass(frozen=True, eq=False)
class _Task:
    """Data of one output, shared by all members."""

    base: Baseline
    records: list[Record]
    footing: Footing
    output: int
    counts: list[NDArray[np.bool_]]
    limits: Limits
    feedback: bool

    @property
    def y(self) -> list[Array]:
        return [np.nan_to_num(r.y[:, self.output]) for r in self.records]

    def residual(self, runs: Sequence[Array]) -> list[Array]:
        return [y - run[:, self.output] for y, run in zip(self.y, runs, strict=True)]

    def training(self, block: int) -> list[NDArray[np.bool_]]:
        blocks = self.base.blocks
        return [t & c for t, c in zip(blocks.training(blocks.blocks[block]), self.counts, strict=True)]

    def counted(self, signals: Sequence[Array]) -> Array:
        return np.concatenate([s[c] for s, c in zip(signals, self.counts, strict=True)])

    def bounds(self, signals: Sequence[Array]) -> tuple[float, float]:
        values = self.counted(signals)
        more = self.limits.reach * float(np.ptp(values))
        return float(values.min()) - more, float(values.max()) + more

    def empty(self) -> list[Array]:
        return [np.zeros(len(r)) for r in self.records]


def _ridge(task: _Task, which: Set) -> tuple[Ridge, list[Array]]:
    """A regression fitted to all blocks, and its change of the earlier run on blocks that it did not see."""
    alone = which is Set.INPUTS
    bank = bank_of(task.base, task.records, task.output)
    runs = task.footing.final

    def table(runs: Sequence[Array]) -> list[Array]:
        pairs = zip(task.records, runs, strict=True)
        return [columns(which, bank, r, run, task.output) for r, run in pairs]

    def target(runs: Sequence[Array]) -> list[Array]:
        return task.y if alone else task.residual(runs)

    X = table(runs)
    ridge = ridge_of(which, bank, task.counted(X), task.bounds(target(runs)))
    Z = [ridge.scaled(x) for x in X]
    weights = normal_equations(Z, target(runs), task.counts)
    trials = [task.empty() for _ in PENALTIES]
    for k, block in enumerate(task.base.blocks.blocks):
        own = task.footing.without[k]
        Zk = Z if alone else [ridge.scaled(x) for x in table(own)]
        rows = block.rows
        for trial, w in zip(trials, normal_equations(Zk, target(own), task.training(k)), strict=True):
            guess = ridge.predicted(Zk[block.record][rows], w)
            trial[block.record][rows] = guess - own[block.record][rows, task.output] if alone else guess
    left = task.residual(task.footing.unused(task.base.blocks))
    errors = [
        float(np.mean(task.counted([a - b for a, b in zip(left, trial, strict=True)]) ** 2))
        for trial in trials
    ]
    best = int(np.argmin(errors))
    return replace(ridge, weights=weights[best]), trials[best]


def _networks(task: _Task, shape: tuple[int, int]) -> tuple[Networks, list[Array]]:
    """Networks fitted to all blocks, and their change of the earlier run on blocks that they did not see.

    Of the starts those that win on all data are used for each block, from the beginning: which of eight it was is all
    that a block can know of the others' fit.
    """
    states, neurons = shape
    final = task.footing.final
    residual = task.residual(final)
    scale = scale_of([r.u for r in task.records], final, task.counted(residual))
    starts = starts_of(task.base.outputs[task.output], states, task.limits.starts)
    found, won = trained(task.records, final, residual, task.counts, scale, starts, neurons)
    whole = Networks(scale, found, task.bounds(residual))
    out = task.empty()
    for k, block in enumerate(task.base.blocks.blocks):
        own = task.footing.without[k]
        found, _ = trained(
            task.records, own, task.residual(own), task.training(k), scale, [starts[i] for i in won], neurons
        )
        r = block.record
        out[r][block.rows] = replace(whole, networks=found).run(task.records[r], own[r])[block.rows]
    return whole, out


def _trees(task: _Task) -> tuple[Trees, list[Array]]:
    """Trees fitted to all blocks, and their change of the earlier run on blocks that they did not see."""
    bank = bank_of(task.base, task.records, task.output)

    def of(runs: Sequence[Array], uses: Sequence[NDArray[np.bool_]]) -> tuple[Trees, list[Array]]:
        tables = [table(bank, r, run, task.output) for r, run in zip(task.records, runs, strict=True)]
        left = task.residual(runs)
        X, r = (np.concatenate([x[use] for x, use in zip(xs, uses, strict=True)]) for xs in (tables, left))
        return grown(bank, X, r, task.bounds(left)), tables

    out = task.empty()
    for k, block in enumerate(task.base.blocks.blocks):
        trees, tables = of(task.footing.without[k], task.training(k))
        out[block.record][block.rows] = trees.predicted(tables[block.record][block.rows])
    return of(task.footing.final, task.counts)[0], out


def _misled(task: _Task, changes: Sequence[Array], policy: Policy) -> bool:
    """Whether the inputs do not answer the noise, but tell trees the earlier model's error: it is most of what that leaves."""
    earlier = [run[:, task.output] for run in task.footing.unused(task.base.blocks)]
    unused = [run + change for run, change in zip(earlier, changes, strict=True)]
    return paired_gain(task.y, earlier, unused, task.counts, policy).meets(policy.overwhelming)


def fit_remainder(
    base: Baseline,
    records: Sequence[Record],
    footing: Footing,
    output: int = 0,
    *,
    limits: Limits | None = None,
    policy: Policy | None = None,
    counts: Sequence[NDArray[np.bool_]] | None = None,
    share: Share | None = None,
) -> Remainder:
    """Fit a remainder to what an earlier model of one output leaves."""
    limits = Limits() if limits is None else limits
    policy = Policy() if policy is None else policy
    records = list(records)
    own = [c[:, output] for c in base.blocks.counting(records)] if counts is None else list(counts)
    rest_of = [r.y[:, output] - run[:, output] for r, run in zip(records, footing.final, strict=True)]
    feedback = has_feedback(records, rest_of, own)
    task = _Task(base, records, footing, output, own, limits, feedback)
    trees = [_trees(task)] if limits.trees else []
    if feedback and any(_misled(task, changes, policy) for _, changes in trees):
        task = replace(task, feedback=False)
    elif feedback:
        task = replace(task, records=[delayed(r) for r in records])
        trees = [_trees(task)] if limits.trees else []
    records = task.records
    made = [_ridge(task, which) for which in Set] + [_networks(task, shape) for shape in limits.shapes]
    made += trees
    earlier = [run[:, output] for run in footing.unused(base.blocks)]
    left = task.counted(task.residual(footing.unused(base.blocks)))
    changes = np.stack([task.counted(change) for _, change in made], axis=1)
    owner = task.counted(_owners(base, records))
    weights = _mixed(changes, left, limits)
    mixed = np.empty(len(left))  # a block's own weights are those that the other blocks ask for
    for k in range(len(base.blocks.blocks)):
        mixed[owner == k] = changes[owner == k] @ _mixed(changes[owner != k], left[owner != k], limits)
    unused = tuple(np.array(run) for run in earlier)
    for run, use, part in zip(
        unused, own, np.split(mixed, np.cumsum([int(c.sum()) for c in own])[:-1]), strict=True
    ):
        run[use] += part
    gain = paired_gain(task.y, earlier, unused, own, policy)
    refused = _refused(task, earlier, unused, gain, policy, share)
    rest = task.counted([y - run for y, run in zip(task.y, unused, strict=True)])
    u = np.concatenate([r.u for r in records])
    kept = weights > 0
    return Remainder(
        output, tuple(m for (m, _), k in zip(made, kept, strict=True) if k), weights[kept], u.min(axis=0), u.max(axis=0),
        limits.fade, unused, float(np.sqrt(np.mean(rest**2))), gain, not refused, _words(gain, refused),
        tuple(np.quantile(rest, (0.025, 0.975)).tolist()), task.feedback,
    )  # fmt: skip


def _owners(base: Baseline, records: Sequence[Record]) -> list[Array]:
    """Per record (N,) the number of the block of each sample."""
    out = [np.zeros(len(r)) for r in records]
    for k, b in enumerate(base.blocks.blocks):
        out[b.record][b.rows] = k
    return out


def _mixed(changes: Array, left: Array, limits: Limits) -> Array:
    """(members,) weights of least error on unused blocks: none negative, none light, in sum at most 1.

    Stretches where the earlier model is far off count less, so that one of them does not decide alone.
    """
    piece = np.arange(len(left)) * PIECES // len(left)
    size = np.sqrt(np.bincount(piece, left**2) / np.bincount(piece))
    scale = 1.0 / np.maximum(size, max(float(np.median(size)), 1e-300))[piece]
    C, r = changes * scale[:, None], left * scale
    weights, use = np.zeros(C.shape[1]), np.arange(C.shape[1])
    while use.size:
        pull = np.diag(np.sqrt(limits.pull * np.sum(C[:, use] ** 2, axis=0)))
        found = nnls(np.concatenate((C[:, use], pull)), np.concatenate((r, np.zeros(len(use)))))[0]
        found /= max(1.0, found.sum())
        if (heavy := found >= limits.light).all():
            weights[use] = found
            break
        use = use[heavy]
    return weights


def _refused(
    task: _Task, earlier: Sequence[Array], unused: Sequence[Array], gain: Gain, policy: Policy, share: Share | None
) -> str:  # fmt: skip
    """Why the remainder is not taken up; empty where it is."""
    limits = task.limits
    if not gain.meets((limits.errors, limits.least)):
        return "which is not enough"
    if share is not None and share.nature in CLOCKED and share.share > 1.0 - (1.0 - gain.share) ** 2:
        return "but what is left follows the clock, which this model only imitates"
    before = task.residual(task.footing.unused(task.base.blocks))
    if task.feedback:
        if share is not None and share.nature in ECHOES:
            return "but the input answers the noise, and a linear echo of it would be taken for dynamics"
        noise = autoregression(before, task.counts)
        steps = [[whitened(noise, np.where(c, y - run, 0.0)) for y, run, c in zip(task.y, runs, task.counts, strict=True)]
                 for runs in (earlier, unused)]  # fmt: skip
        none = task.empty()
        one_step = paired_gain(none, steps[0], steps[1], task.counts, policy)
        if not one_step.meets((limits.errors, limits.least)):
            return "but the input answers the noise, and the one-step prediction does not get better"
    return ""


def _words(gain: Gain, refused: str) -> str:
    taken = f", {refused}: it is left out" if refused else ": it is taken up and reported apart"
    return f"a model without a name lowers the error on unused blocks by {max(gain.share, 0.0):.0%}{taken}"
