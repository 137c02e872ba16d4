"""A few effects in place of the search's: models that unused blocks choose between, where its criterion may have been misled."""

from collections.abc import Iterable, Sequence
from dataclasses import replace

import numpy as np

from estimators.diagnosis.effects import Nature
from estimators.diagnosis.ladder.claims import Claim, Named
from estimators.diagnosis.model.fitting import Fit, fit
from estimators.diagnosis.search.candidates import Menu
from estimators.diagnosis.search.exchange import TREND, drifting, trending
from estimators.diagnosis.search.named import HALF, LEFT, Bench, bent, named_steps, spread
from estimators.diagnosis.search.selection import FULL, Attribution, second

TRIED = 8
"""Single effects that are put before unused blocks, least simulation error first: a tenth of a second each. On practice
records the right one stood among the first five where the search, which goes by one-step errors, preferred another."""
PAIRED = 4
"""Of them, those that a second effect is looked for beside: where two are needed, the right one need not be the best alone."""
SECOND = 6
"""Effects beside one of them that are put before unused blocks."""


def best_named(bench: Bench, a: Attribution, menu: Menu) -> Named:
    """The search's model or another of few effects: the simplest that unused blocks cannot tell from the best of them.

    The search goes by one-step errors under a noise model of high order, which predicts most of a smooth model error
    whatever its cause. Where no noise model stands in its answer there is nothing that it could have hidden.
    """

    def steps(f: Fit, rivals: dict[str, list[str]]) -> Named:
        """What holds of a model, or of the same with a trend for a pole that forgets nothing: where unused blocks are surely better
        with it, or the ladder would refuse how the one with the pole starts."""
        n = named_steps(bench, replace(a, final=f, rivals=rivals))
        if TREND not in menu.effects:
            return n
        passing = {p.key for p in f.structure.effects if p.effect.timed and p.effect.nature is Nature.ADDED}
        options = [trending(bench.channel, n.fit)]
        options += [drifting(bench.channel, n.fit)] if passing & {key for key, _ in n.dropped} else []
        for t in (t for t in options if t is not None):
            straight = named_steps(bench, replace(a, final=t, rivals=rivals))
            if straight.step is None or not bench.stands(straight):
                continue
            surely = n.step is None or bench.over(straight.step.unused[0], n.step.unused[0]).meets(
                bench.policy.searched
            )
            n = straight if surely or not bench.stands(n) else n
        return n

    first = steps(a.final, a.rivals)
    kept = [first] if bench.stands(first) else []
    # what unused blocks refuse may hide another that holds on them
    refused = first.step is None and bool(a.final.structure.effects)
    if kept and not refused and not len(a.final.noise) and not _loose(first):
        return first

    linear = bench.linear

    def judged(fits: Iterable[Fit], share: float, known: Iterable[Named]) -> list[Named]:
        """Those that hold; what is far off on the record itself is not put before unused blocks."""
        found, least = [], min((n.step_error(bench) for n in known if n.step is not None), default=np.inf)
        for f in fits:
            f = fit(bench.channel, f.structure, f.p, f.scales, iterations=40)
            if not spread(f) <= share * least:
                continue
            n = steps(f, {})
            if len(n.unused) and n.whole and bench.over(n.unused, linear).meets(bench.policy.claimed):
                found.append(n)  # each is significant in its own fit besides
                least = min(least, n.step_error(bench))
        return sorted(found, key=lambda n: n.step_error(bench))

    # what is only added has a search of its own, and fits any one record; but a trend has no time or frequency to choose, and a
    # step leaves little of a record that it is in only, or of unused blocks, where noise is more than little of what the record shows
    lasting = lambda e: e.nature is not Nature.ADDED
    steady = lambda e: lasting(e) or not e.per_sample
    of_record = lambda f: spread(f) ** 2 < LEFT * spread(a.base) ** 2
    of_blocks = lambda f: bench.error(bench.unused(f)) ** 2 < LEFT * bench.error(linear) ** 2
    stepped = lambda f: f.structure.effects[-1].effect.timed and (of_record(f) or of_blocks(f))
    alone = [f for f in a.alternatives if steady(f.structure.effects[-1].effect) or stepped(f)][:TRIED]
    singles = judged(alone, HALF, kept)
    few = max(1, round(PAIRED * min(1.0, FULL / len(bench.channel))))  # longer records tell more apart
    menu = replace(menu, effects=tuple(filter(lasting, menu.effects)))
    told = 1.0 / (1.0 - bench.policy.searched[1])
    pairs = []
    for n in singles[:few]:
        least = min(x.step_error(bench) for x in (*kept, *singles) if x.step is not None or x is n)
        if n.step_error(bench) > HALF * least:
            break
        needed = 2.0 * n.fit.n * float(np.log(max(spread(n.fit) / max(told * least, 1e-300), 1.0)))
        more = second(bench.channel, n.fit, menu, coloured=False, needed=needed)
        # a noise model may foretell what simulates worse than without a second effect
        able = [f for f in more if spread(f) <= HALF * spread(n.fit)]
        pairs += judged(able[:SECOND], told, (*kept, *singles, *pairs))
    options = sorted(
        (n for n in (*kept, *singles, *pairs) if n.step is not None and bench.stands(n)),
        key=lambda n: n.step_error(bench),
    )
    if not options:
        return first
    near = _nearest(bench, options)
    if all(_loose(n, n.claims[:1]) for n in near):
        beaten = lambda n: any(_dominates(bench, m, n) for m in options)
        # an effect at its limit is another one, which explains as much
        limit = HALF * options[0].step_error(bench)
        firm = [n for n in options if not _loose(n) and not beaten(n) and n.step_error(bench) <= limit]
        options = firm or options
        near = _nearest(bench, options)
    best = min(
        near, key=lambda n: (_loose(n), bent(n.claims[0]), len(n.claims), len(n.fit.p), n.step_error(bench))
    )
    head = best.claims[0]
    equal = [n.claims[0].cause for n in near if len(n.claims) <= len(best.claims)]
    rivals = tuple(name for name in dict.fromkeys((*head.rivals, *equal)) if name != head.cause)
    others = tuple(bench.answer(n.fit) for n in options
                   if n.claims[0].cause != head.cause and not _worse(bench, n, options[0]))  # fmt: skip
    step = None if best.step is None else replace(best.step, rivals=others)
    return replace(best, claims=(replace(head, rivals=rivals), *best.claims[1:]), step=step)


def _nearest(bench: Bench, options: list[Named]) -> list[Named]:
    """Those that unused blocks cannot tell from the first and best, but for what others of no more effects surely beat."""
    near = [n for n in options if not _told_apart(bench, n, options[0])]
    return [n for n in near if not any(_dominates(bench, m, n) for m in near)]


def _loose(n: Named, claims: Sequence[Claim] | None = None) -> bool:
    """Whether the record says nothing of a parameter of what bends, of some claims or all: it has run to a limit in which the effect
    is another one."""
    claimed, s = n.claims if claims is None else claims, n.fit.structure
    named = {q.key for q in s.effects}
    shown = {c.key for c in claimed} <= named
    keys = [c.key for c in claimed if bent(c)] if shown else named - {c.key for c in n.claims}
    rows = {} if n.step is None else n.step.parameters
    at = [
        sl.start + i
        for q, sl in zip(s.parts, s.slices(), strict=True)
        for i in range(len(q.parameters(s.order)))
    ]
    sizes = dict(zip(rows, n.fit.scales[at], strict=True)) if rows else {}
    return any(e > UNTOLD * sizes[name] for name, (_, e, _) in rows.items() if name.split(".")[0] in keys)


UNTOLD = 4.0
"""Sizes of a parameter, as of the signals that it is set against, from which on its standard error leaves it open altogether."""
ODDS = 6.0
"""Of Schwarz's criterion, by which a model must be the better one: odds of twenty to one."""


def _dominates(bench: Bench, m: Named, n: Named) -> bool:
    """Whether one of no more effects and parameters is the better one on the record, surely in one-step errors and in simulation by
    what a search must gain: what neither a noise model nor blocks of few transients can have turned about."""
    surely = m.fit.criterion < n.fit.criterion - ODDS
    return (
        surely
        and len(m.claims) <= len(n.claims)
        and len(m.fit.p) <= len(n.fit.p)
        and spread(m.fit) < (1.0 - bench.policy.searched[1]) * spread(n.fit)
    )


def _worse(bench: Bench, n: Named, best: Named) -> bool:
    """Whether unused blocks are worse with a model than with the best, beyond an error."""
    if n.step is None or best.step is None:
        return True
    return bench.over(best.step.unused[0], n.step.unused[0]).meets(bench.policy.claimed)


def _told_apart(bench: Bench, n: Named, best: Named) -> bool:
    """Whether unused blocks tell a model from the best: beyond an error, or by what even a search of many must gain."""
    return _worse(bench, n, best) or n.step_error(bench) * (1.0 - bench.policy.searched[1]) > best.step_error(
        bench
    )
