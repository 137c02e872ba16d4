"""A model as one step in CasADi's symbols: the states of its parts, where they start and how they move on."""

from collections.abc import Sequence
from typing import Any, NoReturn

import numpy as np
from numpy.typing import NDArray

from estimators.diagnosis.effects.symbols.terms import with_numpy
from oed.errors import InputError

Array = NDArray[Any]


class State:
    """States of one part: symbols `x`, numbers `start`, and the expression `after` of the next sample, set once it is known."""

    def __init__(self, x: Any, start: Array):
        self.x, self.start = x, start
        self.after: Any = None


class Wiring:
    """A step under construction: inputs `u` and sample `k` as symbols, and all states so far.

    `level` (nu,) constant inputs before the first sample; `output` whose model is being built, for messages.
    """

    def __init__(self, level: Array, output: str = ""):
        self.ca = with_numpy()
        self.level, self.output = np.asarray(level, dtype=float), output
        self.u = [self.ca.SX.sym(f"u{j}") for j in range(len(level))]
        self.k = self.ca.SX.sym("k")
        self.states: list[State] = []
        self.shared: dict[str, list[Any]] = {}  # outputs of models that several answers read

    def state(self, start: Any = 0.0) -> State:
        """States of a part that starts at `start`, a number or (n,)."""
        start = np.atleast_1d(np.asarray(start, dtype=float))
        self.states.append(State(self.ca.SX.sym(f"x{len(self.states)}", len(start)), start))
        return self.states[-1]

    def refuse(self, what: str, remedy: str) -> NoReturn:
        """Say which part of the model has no twin, and what to do."""
        raise InputError(f"the model of {self.output} cannot be exported: {what}; {remedy}.")

    def value(self, signal: Any) -> float:
        """A signal at the start, under the constant inputs."""
        f = self.ca.Function("at", [self._x(), self.ca.vertcat(*self.u), self.k], [signal])
        return float(f(self.start, self.level, 0.0))

    def rational(
        self, num: Any, den: Any, signals: Sequence[Any], constant: float = 0.0, start: Any = None
    ) -> Any:
        """y(k) = sum of num[j][l] u_j(k - l) + constant - sum of den[i] y(k - i), from rest or from states `start`."""
        m = max(len(den), max(len(b) for b in num)) - 1
        b, a = ([np.concatenate((c, np.zeros(m + 1 - len(c)))) for c in rows] for rows in (num, [den]))
        s = self.state(np.zeros(m) if start is None else start)
        total = lambda i: sum(float(c[i]) * v for c, v in zip(b, signals, strict=True))
        y = (s.x[0] if m else 0.0) + total(0) + constant
        s.after = self.ca.vertcat(
            *((s.x[i] if i < m else 0.0) + total(i) - float(a[0][i]) * y for i in range(1, m + 1))
        )
        return y

    def late(self, signal: Any, by: int) -> Any:
        """A signal some samples ago, zero before the first."""
        return signal if by == 0 else self.rational([np.eye(by + 1)[-1]], np.ones(1), [signal])

    def _x(self) -> Any:
        return self.ca.vertcat(self.ca.SX(0, 1), *(s.x for s in self.states))

    @property
    def start(self) -> Array:
        """(n,) where all states start."""
        return np.concatenate([np.zeros(0), *(s.start for s in self.states)])

    def run(self, u: Array, at: Array) -> None:
        """Let the start be where the states are after inputs (m, nu) at the samples `at` (m,)."""
        step, x = self.step([]), self.start
        for inputs, k in zip(u, at, strict=True):
            x = np.array(step(x, inputs, float(k))[0]).ravel()
        for s, part in zip(self.states, np.split(x, np.cumsum([len(s.start) for s in self.states])[:-1])):
            s.start = part

    def ahead(self, signal: Any) -> Any:
        """A signal of the states, read after they have moved on."""
        return self.ca.substitute(signal, self._x(), self.ca.vertcat(*(s.after for s in self.states)))

    def step(self, y: list[Any]) -> Any:
        """The CasADi function (x, u, k) -> (x_next, y)."""
        after = self.ca.vertcat(self.ca.SX(0, 1), *(s.after for s in self.states))
        given = [self._x(), self.ca.vertcat(*self.u), self.k]
        return self.ca.Function("step", given, [after, self.ca.vertcat(*y)], ["x", "u", "k"], ["x_next", "y"])


def linear_matrices(step: Any) -> tuple[Array, ...] | None:
    """A, B, C and D of a step that is linear in its state and input, up to what does not depend on them; None otherwise."""
    ca = with_numpy()
    x, u, k = (ca.SX.sym(name, step.size1_in(i)) for i, name in enumerate(("x", "u", "k")))
    out = [ca.jacobian(f, of) for f in step(x, u, k) for of in (x, u)]
    if any(ca.symvar(m) for m in out):
        return None
    return tuple(np.array(ca.evalf(m)).reshape(m.shape) for m in out)
