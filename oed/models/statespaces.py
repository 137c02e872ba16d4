"""State-space models in innovations form, in the overlapping observable form that has no redundant parameter.

    x(t+1) = A x(t) + B u(t) + K e(t),     y(t) = C x(t) + D u(t) + e(t)

The state holds predictions: of output i the next n_i samples, y_i(t|t-1), ..., y_i(t + n_i - 1|t-1), with
n_1 + ... + n_ny = n. So C picks entries, A shifts within each block, and what is free is the last row of each
block of A, all of B and K (and D): n (2 ny + nu) numbers, as many as the model has degrees of freedom."""

from dataclasses import dataclass, field
from functools import cached_property

import numpy as np
from numpy.typing import ArrayLike, NDArray

from oed.errors import InputError


@dataclass(frozen=True, eq=False)
class StateSpace:
    """Structure of an innovations model. `blocks` n_i >= 1, the number of states that belong to each output;
    `n_inputs` number of inputs nu; `feedthrough` whether D is free (a delay of 0); otherwise it is zero;
    `noise` whether K is free; otherwise it is zero, an output-error model; `names` A12 is row 1, column 2 of
    A; B, K, D likewise; from (10) on with an underscore, A1_10."""

    blocks: tuple[int, ...]
    n_inputs: int = 1
    feedthrough: bool = False
    noise: bool = True
    names: tuple[str, ...] = field(default=(), init=False)

    def __post_init__(self) -> None:
        blocks = tuple(int(k) for k in self.blocks)
        if not blocks or min(blocks) < 1 or self.n_inputs < 1:
            raise InputError(
                f"a state-space model with {list(blocks)} states per output and {self.n_inputs} inputs; each output "
                "needs at least one state, and one input is needed: raise the order or leave outputs out."
            )
        object.__setattr__(self, "blocks", blocks)
        object.__setattr__(self, "names", tuple(self._names()))

    @property
    def kind(self) -> str:
        """The word for it on the command line."""
        return "ss"

    @property
    def order(self) -> int:
        """Number of states."""
        return sum(self.blocks)

    @property
    def n_outputs(self) -> int:
        """Number of outputs ny."""
        return len(self.blocks)

    @property
    def n(self) -> int:
        """Number of parameters."""
        return len(self.names)

    @property
    def last_rows(self) -> list[int]:
        """The last row of each output's block, the free rows of A."""
        return [int(k) - 1 for k in np.cumsum(self.blocks)]

    def entries(self) -> list[tuple[str, int, int]]:
        """Matrix, row and column of every parameter."""
        return self._entries

    @cached_property
    def _entries(self) -> list[tuple[str, int, int]]:
        n, nu, ny = self.order, self.n_inputs, self.n_outputs
        free = [("A", i, j) for i in self.last_rows for j in range(n)]
        free += [("B", i, j) for i in range(n) for j in range(nu)]
        free += [("K", i, j) for i in range(n) for j in range(ny if self.noise else 0)]
        return free + [("D", i, j) for i in range(ny) for j in range(nu if self.feedthrough else 0)]

    def _names(self) -> list[str]:
        between = "_" if max(self.order, self.n_inputs) > 9 else ""
        return [f"{letter}{i + 1}{between}{j + 1}" for letter, i, j in self.entries()]

    def matrices(self, theta: ArrayLike) -> dict[str, NDArray[np.float64]]:
        """A, B, C, D and K: theta (n,)."""
        n, nu, ny = self.order, self.n_inputs, self.n_outputs
        shapes = {"A": (n, n), "B": (n, nu), "C": (ny, n), "D": (ny, nu), "K": (n, ny)}
        made = {letter: np.zeros(shape) for letter, shape in shapes.items()}
        first = 0
        for i, count in enumerate(self.blocks):
            made["C"][i, first] = 1.0
            made["A"][range(first, first + count - 1), range(first + 1, first + count)] = 1.0
            first += count
        for (letter, i, j), value in zip(self.entries(), np.asarray(theta, dtype=float), strict=True):
            made[letter][i, j] = value
        return made

    def theta_of(self, A: NDArray, B: NDArray, C: NDArray, D: NDArray, K: NDArray) -> NDArray[np.float64]:
        """Parameters of a model given in any coordinates: returns (n,)."""
        rows = []
        for i, count in enumerate(self.blocks):
            row = C[i]
            for _ in range(count):
                rows.append(row)
                row = row @ A
        T = np.array(rows)
        if np.linalg.cond(T) > 1e12:
            raise InputError(
                f"the blocks {self.blocks} are not an observable basis of this model; choose other blocks."
            )
        inverse = np.linalg.inv(T)
        made = {"A": T @ A @ inverse, "B": T @ B, "K": T @ K, "D": D}
        return np.array([made[letter][i, j] for letter, i, j in self.entries()])

    def response(self, theta: ArrayLike, omega: ArrayLike) -> tuple[NDArray, NDArray]:
        """Frequency response of the input channel and its derivatives: theta (n,), omega (K,) -> (K, ny, nu),
        (K, n, ny, nu)."""
        return self._channel(theta, omega, "B", "D")

    def noise_response(self, theta: ArrayLike, omega: ArrayLike) -> tuple[NDArray, NDArray]:
        """Frequency response of the noise model and its derivatives: theta (n,), omega (K,) -> (K, ny, ny),
        (K, n, ny, ny)."""
        h, dh = self._channel(theta, omega, "K", "")
        return h + np.eye(self.n_outputs), dh

    def _channel(
        self, theta: ArrayLike, omega: ArrayLike, drive: str, through: str
    ) -> tuple[NDArray, NDArray]:
        m = self.matrices(theta)
        z = np.exp(1j * np.atleast_1d(np.asarray(omega, dtype=float)))
        inverse = np.linalg.inv(z[:, None, None] * np.eye(self.order) - m["A"])
        left, right = m["C"] @ inverse, inverse @ m[drive]
        g = left @ m[drive] + (m[through] if through else 0.0)
        dg = np.zeros((len(z), self.n, *g.shape[1:]), complex)
        for k, (letter, i, j) in enumerate(self.entries()):
            if letter == "A":
                dg[:, k] = left[:, :, i, None] * right[:, None, j, :]
            elif letter == drive:
                dg[:, k, :, j] = left[:, :, i]
            elif letter == through:
                dg[:, k, i, j] = 1.0
        return g, dg

    def fractions(self, theta: ArrayLike) -> list[list[tuple[NDArray, NDArray]]]:
        """Numerator and denominator in powers of z^-1 of each entry of G, row by row: theta (n,)."""
        from scipy.signal import ss2tf

        m = self.matrices(theta)
        columns = [ss2tf(m["A"], m["B"], m["C"], m["D"], input=j) for j in range(self.n_inputs)]
        return [
            [(np.asarray(num)[i], np.asarray(den)) for num, den in columns] for i in range(self.n_outputs)
        ]

    def noise_fractions(self, theta: ArrayLike) -> list[tuple[NDArray, NDArray]]:
        """None: what drives one output by the noise of another is told by K."""
        return []

    def poles(self, theta: ArrayLike) -> list[NDArray[np.complex128]]:
        """Eigenvalues of A: theta (n,)."""
        return [np.linalg.eigvals(self.matrices(theta)["A"]).astype(complex)]

    def simulate(self, theta: ArrayLike, u: NDArray) -> NDArray[np.float64]:
        """Noise-free output from rest: theta (n,), u (N, nu) -> (N, ny)."""
        m = self.matrices(theta)
        states, x = np.zeros((len(u), self.order)), np.zeros(self.order)
        forced = u @ m["B"].T
        for t in range(len(u)):
            states[t] = x
            x = m["A"] @ x + forced[t]
        return states @ m["C"].T + u @ m["D"].T

    def to_dict(self) -> dict:
        """The orders as plain numbers."""
        return {
            "kind": "ss",
            "blocks": list(self.blocks),
            "n_inputs": self.n_inputs,
            "feedthrough": self.feedthrough,
            "noise": self.noise,
        }

    def __repr__(self) -> str:
        more = ", no noise model" if not self.noise else ""
        return f"SS(n={self.order}, {self.n_outputs} outputs, {self.n_inputs} inputs{more})"


def state_space(
    order: int, *, n_outputs: int = 1, n_inputs: int = 1, delay: int = 1, noise: bool = True
) -> StateSpace:
    """Innovations model of some order, its states shared evenly among the outputs."""
    if delay not in (0, 1):
        raise InputError(
            f"the delay is {delay}; a state-space model takes 0 or 1: shift the input, or raise the order."
        )
    if order < n_outputs:
        raise InputError(f"{order} states for {n_outputs} outputs; give at least one state per output.")
    share, rest = divmod(int(order), n_outputs)
    blocks = tuple(share + (i < rest) for i in range(n_outputs))
    return StateSpace(blocks, n_inputs, delay == 0, noise)
