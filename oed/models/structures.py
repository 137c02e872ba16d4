"""The polynomial structures by name: which of A, B, C, D, F each has. A new one is a row here. Light: no imports."""

from dataclasses import dataclass


@dataclass(frozen=True)
class Structure:
    """A y = (B / F) u + (C / D) e with those polynomials that it has. `letters` its polynomials, in the order
    in which their orders are given; `first` order of each where none is given; `step` what is added to each
    where the order is searched."""

    letters: str
    first: int = 2
    step: int = 1

    @property
    def orders(self) -> tuple[str, ...]:
        """Names of its orders."""
        return tuple(f"n{letter}" for letter in self.letters)


# An impulse response needs as many coefficients as it has samples before it has decayed.
STRUCTURES = {
    "fir": Structure("b", first=20, step=10),
    "arx": Structure("ab"),
    "armax": Structure("abc"),
    "oe": Structure("bf"),
    "bj": Structure("bcdf"),
}
ORDERS = {name: one.orders for name, one in STRUCTURES.items()} | {"ss": ("n",)}
"""Names of the orders of every structure, state space included."""
