"""Greedy search: from linear fits of several orders, the candidates with the best score are fitted, the best kept."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from estimators.diagnosis.discovery.dictionary import PERIODS, SHARP, Kind
from estimators.diagnosis.discovery.fitting import Fitted, Piece, fit, forgets, run_piece
from estimators.diagnosis.discovery.form import FREE, LAST, Assembly
from estimators.diagnosis.discovery.recursion_kernels import factor_values
from estimators.diagnosis.discovery.screening import BEND, Screened, screen, terms_of
from estimators.diagnosis.discovery.starts import Scales, linear_fit

Array = NDArray[Any]
WAVES, STEPS = (Kind.SIN, Kind.COS), (Kind.TANH, Kind.BELL)
FINEST_WAVE, FINEST_STEP = 2.0 * PERIODS[-1], 1.0 / SHARP
"""Per standard deviation of the signal: twice the wave number of the finest start, and a step as sharp as a softened sign."""
ROUGH = 1e-3
"""Share of the squared error that a round must gain for another: enough to rank candidates, the few that are left are ended."""
GAINED = 0.01
"""By how much a further term must lower the criterion per sample for another to be looked for: half a percent of the error."""


@dataclass(frozen=True)
class Budget:
    """How much is tried: the work is proportional to orders x width x terms.

    `width` candidates are fitted per model and level, `beam` models of each first order go on, up to `terms` terms; `rounds` of each fit.
    """

    orders: tuple[int, ...] = (1, 2, 3, 4)
    rivals: tuple[int, ...] = (5, 6)  # further linear models that terms have to beat
    width: int = 6
    beam: int = 1
    terms: int = 4
    rounds: int = 12
    late: tuple[tuple[str, ...], ...] = ()
    # per output, the inputs that do not act on it in their own sample by the linear model: a term that passes one straight on to
    # it would be the inverse of a controller that answers the output at once
    closed: bool = False  # whether there is such a controller: no linear part passes inputs straight on then either that are late for all outputs

    def about(self, orders: tuple[int, ...], terms: int) -> Budget:
        """For a second search, of chains as long as those of a model and of no more terms; other lengths stay rivals."""
        every = {*self.orders, *self.rivals}
        return replace(
            self, orders=tuple(sorted({*orders})), rivals=tuple(sorted(every - {*orders})), terms=terms
        )


CANDIDATES = 500
"""Of which a term is the best, some hundred: to say which one it is costs as much as two parameters do."""


def acting(f: Fitted) -> int:
    """Number of terms, slow states not counted."""
    return sum(t.slot != "slow" for t in f.form.terms)


def criterion(f: Fitted) -> float:
    """Bayes's criterion with the errors taken for white: for ranking, not for claims."""
    size = f.free * math.log(f.count) + 2.0 * math.log(CANDIDATES) * acting(f)
    return f.count * math.log(max(f.mse, 1e-300)) + size


def complexity(f: Fitted) -> float:
    """Number of parameters, the choice of every term counted as two."""
    return f.free + 2.0 * acting(f)


def _ranked(
    fitted: Fitted, pieces: Sequence[Piece], zeros: dict[str, float], budget: Budget
) -> list[Screened]:
    """The best candidates by either way of taking the arguments; of one function and slot only the best shape."""
    late = budget.late or ((),) * len(fitted.form.orders)
    found = [
        s
        for s in screen(fitted, pieces, zeros)
        if s.slot != "output"
        or not any(n in late[s.chain] for f in s.candidate.terms[-1].factors for n in f.signal.split("-"))
    ]
    n = fitted.count

    def merit(s: Screened) -> float:
        return n * math.log(max(1 - s.gain / fitted.sse, 1e-6)) + s.parameters * math.log(n)

    out: dict[tuple, Screened] = {}
    for s in sorted(found, key=merit):
        if s.beside is not None or sum(x.beside is None for x in out.values()) < budget.width:
            out.setdefault(s.key, s)
    return [*out.values()]


def grown(fitted: Fitted, s: Screened, pieces: Sequence[Piece], rounds: int) -> Fitted | None:
    """The model with a candidate added, fitted by simulation error; smaller first steps where the full one explodes."""
    terms, theta = terms_of(s, fitted)
    form = fitted.form.with_terms(*fitted.form.terms, *terms)
    new = range(len(fitted.form.terms), len(form.terms))
    taps = [form.blocks[t].start - fitted.free + m for t in new for m in range(form.taps(form.terms[t]))]
    for share in (1.0, 0.3, 0.0):
        start = theta.copy()
        start[taps] *= share
        f = fit(
            form,
            np.concatenate([fitted.theta, start]),
            fitted.starts,
            pieces,
            iterations=rounds,
            tolerance=ROUGH,
        )
        if (
            f is not None
            and f.sse < fitted.sse * (1 + 1e-9)
            and forgets(f, pieces)
            and bends(f, pieces, len(terms))
        ):
            return f
    return None


AXIS = 2
"""Poles of an inertia on a spring, which axes that push each other have however many the linear model takes to mimic that."""
FAST = 0.7
"""What the pole that a longer chain starts with forgets in a sample: a lag that sampling hardly resolves changes least at first."""


def lengthened(fitted: Fitted, chain: int, pieces: Sequence[Piece], rounds: int) -> Fitted | None:
    """The model with a chain one longer, fitted by simulation error from where it is the same: numerators, denominator and states
    times the same fast pole. A lag beside what is missing shows only once that is there."""
    form, theta = fitted.form, fitted.theta
    if any((t.slot, t.chain) == ("mobility", chain) for t in form.terms):  # of another first state
        return None
    n, first = form.orders[chain], sum(form.orders[:chain])
    c = FAST / form.paces[chain]
    longer = lambda x: np.convolve(x, (1.0, c))
    orders = (*form.orders[:chain], n + 1, *form.orders[chain + 1 :])
    own = lambda t: t.slot == "force" and t.chain == chain
    opened = lambda t: n == 1 and own(t) and t.along == LAST  # of one state the last tap is all there is
    terms = tuple(replace(t, along=FREE) if opened(t) else t for t in form.terms)
    parts, at, level = [], 0, 0.0
    for i, m in enumerate(form.orders):
        size = m * (1 + form.inputs) + 1 + form.inputs * form.feedthrough
        mine = theta[at : at + size]
        if i == chain:
            rows = mine[m : m * (1 + form.inputs)].reshape(form.inputs, m)
            level = float(mine[m * (1 + form.inputs)])
            parts += [longer(np.r_[1.0, mine[:m]])[1:], *map(longer, rows), [c * level]]
            mine = mine[m * (1 + form.inputs) + 1 :]
        parts.append(mine)
        at += size
    for t, block in zip(form.terms, form.blocks):
        mine, taps = theta[block], form.taps(t)
        if own(t) and (t.along == FREE or opened(t)):
            parts += [longer(mine[:taps]), mine[taps:]]
        else:
            parts.append(np.r_[mine[:taps] * (c if own(t) and t.along == LAST else 1.0), mine[taps:]])
    held = np.r_[np.zeros(n), level]  # a constant acts on the last state, which is another one now
    starts = [np.r_[s[:first], longer(s[first : first + n]) + held, s[first + n :]] for s in fitted.starts]
    form = replace(form, orders=orders, terms=terms)
    f = fit(form, np.concatenate(parts), starts, pieces, iterations=rounds, tolerance=ROUGH)
    return f if f is not None and f.sse < fitted.sse and forgets(f, pieces) else None


def bends(f: Fitted, pieces: Sequence[Piece], count: int) -> bool:
    """Whether each of the last `count` terms differs, where the model goes, from a linear combination of its signals, and every
    term is a curve there: waves and steps far finer than samples lie are noise, and fed back they let no run find its way twice.
    """
    asm = Assembly(f.form)
    signals = np.vstack([run_piece(asm, f.theta, s, p.d).signals for s, p in zip(f.starts, pieces)])
    clipped = np.clip(signals, asm.bounds[:, 0], asm.bounds[:, 1])
    heads, kinds, which, q, _ = asm.fill(f.theta).table
    for t, term in enumerate(f.form.terms):
        value = np.ones(len(signals))
        for k in range(heads[t], heads[t + 1]):
            x = np.ascontiguousarray(clipped[:, which[k]])
            value *= factor_values(kinds[k], x, q[2 * k], q[2 * k + 1])
            fine = (
                abs(q[2 * k + 1]) * x.std() if kinds[k] in WAVES else x.std() / max(abs(q[2 * k + 1]), 1e-300)
            )
            if kinds[k] in (*WAVES, *STEPS) and fine > (FINEST_WAVE if kinds[k] in WAVES else FINEST_STEP):
                return False
        if term.slot == "slow" or t < len(f.form.terms) - count:
            continue
        own = sorted(
            i for i in {*which[heads[t] : heads[t + 1]]} if asm.signals[i][0] != "s"
        )  # a slow state bends already
        X = np.column_stack([np.ones(len(value)), signals[:, own]])
        left = value - X @ np.linalg.lstsq(X, value, rcond=None)[0]
        if left.std() < BEND * value.std() + 1e-12:
            return False
    return True


def greedy_search(
    pieces: Sequence[Piece], scales: Scales, outputs: Sequence[Array], zeros: dict[str, float], budget: Budget,
    own: tuple[int, ...],
) -> list[Fitted]:  # fmt: skip
    """All models fitted on the way, the best by the criterion first; linear ones among them.

    `own` orders of the best linear model. Chains of every order go a way of their own, and of several outputs those of their own
    orders and of the least of them: longer chains mimic what is missing, also in the linear model alone, and would crowd out the
    short ones that need more terms for it.
    """
    ny, nu = pieces[0].y.shape[1], (pieces[0].d.shape[1] - 1) // 2
    straight = not budget.closed or any(len(late) < nu for late in budget.late)

    def linear(orders: Sequence[tuple[int, ...]]) -> list[Fitted]:
        fits = [linear_fit(n, pieces, scales, outputs, feedthrough=straight) for n in orders]
        return [f for f in fits if f is not None and forgets(f, pieces)]

    beam, rivals = linear([(n,) * ny for n in budget.orders]), linear([(n,) * ny for n in budget.rivals])
    ways = [[f] for f in beam] if ny == 1 else [beam]
    if ny > 1:
        own = tuple(min(max(n, 1), max(budget.orders)) for n in own)
        for way in dict.fromkeys((own, (min(own),) * ny, (AXIS,) * ny)):
            ways.append([f for f in beam if f.form.orders == way] or linear([way]))
    every = {id(f): f for f in (*beam, *rivals, *(f for way in ways for f in way))}
    climbed = [
        f for way in ways for f in _climbed(way, budget.beam, ny * budget.terms, pieces, zeros, budget)
    ]
    return sorted((*every.values(), *climbed), key=criterion)


def _climbed(
    beam: list[Fitted],
    width: int,
    terms: int,
    pieces: Sequence[Piece],
    zeros: dict[str, float],
    budget: Budget,
) -> list[Fitted]:
    """Models with more and more terms; the best `width` of each number go on while the criterion falls."""
    every: list[Fitted] = []
    best = math.inf
    for _ in range(terms):
        trials = ((f, s) for f in beam for s in _ranked(f, pieces, zeros, budget))
        new = [g for f, s in trials if (g := grown(f, s, pieces, budget.rounds)) is not None]
        extended = (
            (f, i)
            for f in beam
            if f.form.terms
            for i, n in enumerate(f.form.orders)
            if n < max(budget.orders)
        )
        new += [g for f, i in extended if (g := lengthened(f, i, pieces, budget.rounds)) is not None]
        if not new:
            break
        every += new
        beam = sorted(new, key=criterion)[:width]
        if criterion(beam[0]) > best - GAINED * beam[0].count:
            break
        best = criterion(beam[0])
    return every
