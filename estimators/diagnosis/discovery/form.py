"""What a discovered model is made of: chains of linear dynamics, and terms of factors of their signals."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from estimators.diagnosis.discovery.recursion_kernels import evaluate, recursion

Array = NDArray[Any]
MOST = 1e4  # in standard deviations of the output: a state that gets there has exploded
NOTHING = np.zeros((0, 4), np.int64), np.zeros(0), np.zeros((0, 3), np.int64)  # moves
FREE, LAST = -1, -2  # how a force enters: with taps of its own, or in the highest derivative alone


def flow_of(chain: int) -> str:
    """The signal by which a chain's first state, its output, moves of itself: its momentum, over the inertia."""
    return f"f{chain}"


@dataclass(frozen=True)
class Factor:
    """A function (see `recursion_kernels.factor`) of one signal; p and q are fitted where `free` says so."""

    kind: int
    signal: str
    p: float = 0.0
    q: float = 1.0
    free: tuple[bool, bool] = (False, False)


@dataclass(frozen=True)
class Difference:
    """A signal of terms: one signal less another, `weights` times each in their scales; inside terms within `bounds`."""

    first: str
    second: str
    weights: tuple[float, float]
    bounds: tuple[float, float]

    @property
    def name(self) -> str:
        """What terms call it."""
        return f"{self.first}-{self.second}"

    def of(self, signals: Mapping[str, Array]) -> Array:
        """(N,) its values."""
        return self.weights[0] * signals[self.first] - self.weights[1] * signals[self.second]


@dataclass(frozen=True)
class Term:
    """A product of factors in a slot: "force" into a chain, "output" on top of it, "mobility" of it, or "slow" into a slow state.

    A mobility is a share of the chain's own flow (`flow_of`) by which its output moves the more: its inertia, or its capacity, is less.
    A force enters along an input (number >= 0: that input is replaced by itself plus the term), with taps of its own (FREE) or in the
    highest derivative alone (LAST). A slow state follows its term with a rate near `rate`.
    """

    factors: tuple[Factor, ...]
    slot: str = "force"
    chain: int = 0
    along: int = FREE
    rate: float = 0.0


@dataclass(frozen=True)
class Form:
    """Structure: `orders` of the chains (one per output), inputs, pace of the delta operator per chain, terms.

    Chain i is y_i = x_1 + feedthrough, (q - 1) x_m = pace (x_{m+1} - alpha_m x_1 + beta_m u + force taps), which has
    no redundant parameter and keeps them of order one. `steps` is the size of one sample's change of each output.
    """

    orders: tuple[int, ...]
    inputs: int
    paces: tuple[float, ...]
    steps: tuple[float, ...]
    terms: tuple[Term, ...] = ()
    feedthrough: bool = False
    bounds: tuple[tuple[float, float], ...] = ()  # of y, v, u, du of all channels inside terms; () for none
    differences: tuple[Difference, ...] = ()

    @classmethod
    def of(cls, written: Mapping[str, Any]) -> Form:
        """The form whose `dataclasses.asdict` went through JSON."""

        def deep(x: Any) -> Any:
            return tuple(map(deep, x)) if isinstance(x, list) else x

        def flat(d: Mapping[str, Any]) -> dict[str, Any]:
            return {k: deep(v) for k, v in d.items()}

        def term(t: Mapping[str, Any]) -> Term:
            rest = {k: v for k, v in t.items() if k != "factors"}
            return Term(tuple(Factor(**flat(f)) for f in t["factors"]), **rest)

        terms = tuple(map(term, written["terms"]))
        differences = tuple(Difference(**flat(d)) for d in written.get("differences", ()))
        return cls(**flat(written) | {"terms": terms, "differences": differences})

    def taps(self, term: Term) -> int:
        """Number of coefficients of a term."""
        if term.slot == "slow":
            return 0
        return self.orders[term.chain] if term.slot == "force" and term.along == FREE else 1

    def size(self, term: Term) -> int:
        """Number of parameters of a term: coefficients, free constants, and the rate of a slow state."""
        return self.taps(term) + sum(sum(f.free) for f in term.factors) + (term.slot == "slow")

    @cached_property
    def linear_size(self) -> int:
        """Number of parameters of the chains."""
        own = sum(n * (1 + self.inputs) + 1 for n in self.orders)
        return own + len(self.orders) * self.inputs * self.feedthrough

    @cached_property
    def blocks(self) -> list[slice]:
        """Where each term's parameters are."""
        out, at = [], self.linear_size
        for term in self.terms:
            out.append(slice(at, at + self.size(term)))
            at += self.size(term)
        return out

    @property
    def parameters(self) -> int:
        """How many parameters the form has."""
        return self.blocks[-1].stop if self.terms else self.linear_size

    def with_terms(self, *terms: Term) -> Form:
        """The same chains with these terms."""
        return replace(self, terms=tuple(terms))


class Assembly:
    """The matrices of a form and where its parameters sit in them; built once per form, filled for each theta."""

    def __init__(self, form: Form):
        self.form = form
        ny, nu = len(form.orders), form.inputs
        self.first = np.concatenate([[0], np.cumsum(form.orders)])
        self.chain_states = nx = int(self.first[-1])
        slow = [i for i, t in enumerate(form.terms) if t.slot == "slow"]
        self.signals = (
            [f"y{i}" for i in range(ny)] + [f"v{i}" for i in range(ny)] + [f"u{j}" for j in range(nu)]
        )
        self.signals += [f"du{j}" for j in range(nu)] + [f"s{m}" for m in range(len(slow))]
        self.signals += [d.name for d in form.differences] + [flow_of(i) for i in range(ny)]
        self.bounds = np.tile([-np.inf, np.inf], (len(self.signals), 1))
        self.bounds[: len(form.bounds)] = np.array(form.bounds).reshape(-1, 2)
        for d in form.differences:
            self.bounds[self.signals.index(d.name)] = d.bounds
        n, ns, nt = nx + ny + len(slow), len(self.signals), len(form.terms)
        nd = 1 + 2 * nu  # constant, inputs, their changes
        self.shapes = [(n, n), (n, nd), (n, nt), (ns, n), (ns, nd), (ny, n), (ny, nd), (ny, nt)]
        self.base = [np.zeros(s) for s in self.shapes]
        self._linear: list[tuple[int, int, int, int, float]] = []  # parameter, matrix, row, column, factor
        self._products: list[tuple[int, int, int, int, int, float]] = []
        self.slow_rows = {t: nx + ny + m for m, t in enumerate(slow)}
        self._chains(ny, nu, nx)
        self._signals(ny, nu, nx, len(slow))
        self._terms()
        self._tables()

    def _chains(self, ny: int, nu: int, nx: int) -> None:
        A, C = self.base[0], self.base[5]
        at = 0
        self.alphas: list[slice] = []
        self.betas: list[Array] = []  # (nu, n) parameter numbers
        self.feeds: list[Array] = []  # (nu,) each, or none
        for i, n in enumerate(self.form.orders):
            f, pace = int(self.first[i]), self.form.paces[i]
            C[i, f] = 1.0
            A[nx + i, f] = 1.0  # the output before
            for m in range(n):
                A[f + m, f + m] += 1.0
                if m + 1 < n:
                    A[f + m, f + m + 1] += pace
                self._linear.append((at + m, 0, f + m, f, -pace))
            self.alphas.append(slice(at, at + n))
            at += n
            numbers = at + np.arange(nu * n).reshape(nu, n)
            self.betas.append(numbers)
            self._linear += [(int(numbers[j, m]), 1, f + m, 1 + j, pace) for j in range(nu) for m in range(n)]
            at += nu * n
            self._linear.append((at, 1, f + n - 1, 0, pace))
            at += 1
            feed = np.zeros(0, int)
            if self.form.feedthrough:
                feed = at + np.arange(nu)
                for j in range(nu):
                    self._linear += [(int(feed[j]), 6, i, 1 + j, 1.0), (int(feed[j]), 1, nx + i, 1 + j, 1.0)]
                at += nu
            self.feeds.append(feed)

    def _signals(self, ny: int, nu: int, nx: int, slow: int) -> None:
        S, T = self.base[3], self.base[4]
        for i in range(ny):
            f, step = int(self.first[i]), self.form.steps[i]
            S[i, f] = 1.0
            S[ny + i, f], S[ny + i, nx + i] = 1 / step, -1 / step
            feed = self.feeds[i]
            for j in range(len(feed)):
                self._linear += [(int(feed[j]), 4, i, 1 + j, 1.0), (int(feed[j]), 4, ny + i, 1 + j, 1 / step)]
        for j in range(nu):
            T[2 * ny + j, 1 + j] = 1.0
            T[2 * ny + nu + j, 1 + nu + j] = 1.0
        for m in range(slow):
            S[2 * ny + 2 * nu + m, nx + ny + m] = 1.0
        for i, n in enumerate(self.form.orders):
            row, f = self.signals.index(flow_of(i)), int(self.first[i])
            # all that the first state's own equation adds in one pace: the second state, or its constant
            S[row, f + 1 : f + n] = np.arange(n - 1) == 0
            self._linear.append((self.alphas[i].start, 3, row, f, -1.0))
            self._linear += [
                (int(number), 4, row, 1 + j, 1.0) for j, number in enumerate(self.betas[i][:, 0])
            ]
            self._linear += [(self.alphas[i].stop + nu, 4, row, 0, 1.0)] if n == 1 else []
        for difference in self.form.differences:
            row = self.signals.index(difference.name)
            for name, weight in zip((difference.first, difference.second), difference.weights, strict=True):
                own, signed = self.signals.index(name), weight if name == difference.first else -weight
                S[row] += signed * S[own]
                T[row] += signed * T[own]
                self._linear += [
                    (p, m, row, j, signed * v) for p, m, i, j, v in self._linear if (m, i) == (4, own)
                ]

    def _terms(self) -> None:
        form = self.form
        heads, kinds, signals, self._constants, slots = [0], [], [], [], []
        for t, (term, block) in enumerate(zip(form.terms, form.blocks)):
            self._coefficients(t, term, block.start)
            at = block.start + form.taps(term)
            for f in term.factors:
                kinds.append(f.kind)
                signals.append(self.signals.index(f.signal))
                self._constants += [f.p, f.q]
                for which in (0, 1):
                    if f.free[which]:
                        slots.append((at, len(kinds) - 1, which))
                        at += 1
            heads.append(len(kinds))
            if term.slot == "slow":
                row = self.slow_rows[t]
                self.base[0][row, row] = 1.0
                self._linear += [(at, 0, row, row, -term.rate), (at, 2, row, t, term.rate)]
        self.table = tuple(np.array(x, dtype=np.int64) for x in (heads, kinds, signals))
        self.slots = np.array(slots, dtype=np.int64).reshape(-1, 3)

    def _coefficients(self, t: int, term: Term, at: int) -> None:
        i = term.chain
        f, n, pace = int(self.first[i]), self.form.orders[i], self.form.paces[i]
        if term.slot == "output":
            self._linear.append((at, 7, i, t, 1.0))
        elif term.slot == "mobility":
            self._linear.append((at, 2, f, t, pace))
        elif term.slot == "force" and term.along == FREE:
            self._linear += [(at + m, 2, f + m, t, pace) for m in range(n)]
        elif term.slot == "force" and term.along == LAST:
            self._linear.append((at, 2, f + n - 1, t, pace))
        elif term.slot == "force":
            self._products += [
                (at, int(b), 2, f + m, t, pace) for m, b in enumerate(self.betas[i][term.along])
            ]
            feed = self.feeds[i]
            if len(feed):
                self._products.append((at, int(feed[term.along]), 7, i, t, 1.0))

    def _tables(self) -> None:
        lin, pro = self._linear, self._products
        self.sizes = np.array([a * b for a, b in self.shapes])
        start = np.concatenate([[0], np.cumsum(self.sizes)])
        flat = lambda m, i, j: int(start[m]) + i * self.shapes[m][1] + j
        self._l = (
            np.array([e[0] for e in lin]),
            np.array([flat(*e[1:4]) for e in lin]),
            np.array([e[4] for e in lin]),
        )
        self._p1 = np.array([e[0] for e in pro], dtype=int)
        self._p2 = np.array([e[1] for e in pro], dtype=int)
        self._pflat = np.array([flat(*e[2:5]) for e in pro], dtype=int)
        self._pc = np.array([e[5] for e in pro], dtype=float)
        rows = [e[:4] for e in lin] + [(e[0], *e[2:5]) for e in pro] + [(e[1], *e[2:5]) for e in pro]
        self.entries = np.array(rows, dtype=np.int64).reshape(-1, 4)
        self._flat = np.concatenate([b.ravel() for b in self.base])

    def fill(self, theta: Array) -> Filled:
        """The matrices and constants at theta, and the derivatives of their elements."""
        flat = self._flat.copy()
        np.add.at(flat, self._l[1], self._l[2] * theta[self._l[0]])
        a, b = theta[self._p1], theta[self._p2]
        np.add.at(flat, self._pflat, self._pc * a * b)
        parts = np.split(flat, np.cumsum(self.sizes)[:-1])
        matrices = tuple(p.reshape(s) for p, s in zip(parts, self.shapes))
        constants = np.array([*self._constants, 0.0, 1.0])
        for p, f, which in self.slots:
            constants[2 * f + which] = theta[p]
        values = np.concatenate([self._l[2], self._pc * b, self._pc * a])
        return Filled(matrices, (*self.table, constants, self.bounds), (self.entries, values, self.slots))


class Filled(NamedTuple):
    """What `recursion_kernels.recursion` takes: matrices A to G, the table of the terms, what the parameters move."""

    mats: tuple[Array, ...]
    table: tuple[Array, ...]
    moving: tuple[Array, Array, Array]

    def run(self, x0: Array, d: Array) -> Run:
        """From a whole state."""
        return self.moved(x0, np.zeros((len(x0), 0)), d, *NOTHING)

    def sensitivities(self, x0: Array, dx0: Array, d: Array) -> Run:
        """With the derivatives by all parameters, of which dx0 holds those of the start."""
        return self.moved(x0, dx0, d, *self.moving)

    def moved(self, x0: Array, dx0: Array, d: Array, entries: Array, values: Array, slots: Array) -> Run:
        """With the derivatives by what is said to move."""
        return Run(*recursion(self.mats, self.table, x0, dx0, d, (entries, values, slots), MOST))

    def terms(self, x: Array, d0: Array) -> Array:
        """Values of the terms at a whole state."""
        w, ws = np.zeros(len(self.table[0]) - 1), np.zeros(len(self.table[1]))
        evaluate(self.mats[3] @ x + self.mats[4] @ d0, self.table, w, ws, np.zeros((len(ws), 2)))
        return w


class Run(NamedTuple):
    """Outputs (N, ny), derivatives (N, ny, P), signals (N, ns), states (N, n), whether they stayed finite."""

    y: Array
    dy: Array
    signals: Array
    states: Array
    fine: bool
