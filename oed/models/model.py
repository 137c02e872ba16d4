"""Parametric models: a structure (the polynomial family, state space) with its parameters.

What information and design ask of any model is `response(omega) -> (G, dG)`."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from oed.data import frozen
from oed.errors import InputError
from oed.files.documents import FLAG, LARGEST, NUMBER, TEXT, WHOLE, checked, keyed, listed, parsed_json
from oed.files.limits import file_content
from oed.models.polynomials import Orders, Polynomial, polynomial
from oed.models.statespaces import StateSpace
from oed.models.structures import STRUCTURES

if TYPE_CHECKING:
    from oed.plants.plant import Plant


@dataclass(frozen=True, eq=False)
class Model:
    """A structure with its parameters: G, H and the noise covariance. `structure` the structure; `theta` (n,)
    parameters; `noise_covariance` (ny, ny) covariance of the white noise e; `dt` sampling time in seconds."""

    structure: Polynomial | StateSpace
    theta: NDArray[np.float64]
    noise_covariance: NDArray[np.float64] = field(default_factory=lambda: np.array(1.0))
    dt: float = 1.0

    def __post_init__(self) -> None:
        theta, ny = frozen(np.atleast_1d(self.theta)), self.structure.n_outputs
        if theta.shape != (self.structure.n,):
            raise InputError(
                f"theta has the shape {theta.shape}; {self.structure!r} has {self.structure.n} parameters."
            )
        covariance = np.array(self.noise_covariance, dtype=float)
        if covariance.ndim == 0:
            covariance = covariance * np.eye(ny)
        if covariance.shape != (ny, ny):
            raise InputError(f"the noise covariance has the shape {covariance.shape}; it must be {(ny, ny)}.")
        object.__setattr__(self, "theta", theta)
        object.__setattr__(self, "noise_covariance", frozen(covariance))
        object.__setattr__(self, "dt", float(self.dt))

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the parameters."""
        return self.structure.names

    def response(self, omega: ArrayLike) -> tuple[NDArray, NDArray]:
        """Frequency response G (K, ny, nu) and its derivatives dG (K, n, ny, nu)."""
        return self.structure.response(self.theta, omega)

    def noise_response(self, omega: ArrayLike) -> tuple[NDArray, NDArray]:
        """Frequency response H (K, ny, ny) of the noise model and its derivatives dH (K, n, ny, ny)."""
        return self.structure.noise_response(self.theta, omega)

    def simulate(self, u: NDArray) -> NDArray[np.float64]:
        """Noise-free output from rest: u (N, nu) -> (N, ny)."""
        return self.structure.simulate(self.theta, u)

    def to_control(self) -> Any:
        """G as a python-control object."""
        import control

        if isinstance(self.structure, StateSpace):
            m = self.structure.matrices(self.theta)
            return control.StateSpace(m["A"], m["B"], m["C"], m["D"], self.dt)
        whole = self.structure.fractions(self.theta)
        padded = lambda p, q: np.pad(p, (0, max(len(q) - len(p), 0)))
        num = [[padded(b, a) for b, a in row] for row in whole]
        den = [[padded(a, b) for b, a in row] for row in whole]
        return control.TransferFunction(num, den, self.dt)

    def to_plant(self, name: str = "identified") -> Plant:
        """The model's G and noise as a plant to design experiments for; InputError if it is unstable, or if outputs have
        different noise filters."""
        from oed.plants.plant import Plant

        structure = self.structure
        if isinstance(structure, StateSpace):
            return Plant.from_control(self.to_control(), noise_covariance=self.noise_covariance, name=name)
        whole = structure.fractions(self.theta)
        num, den = ([[entry[k] for entry in row] for row in whole] for k in (0, 1))
        filters = structure.noise_fractions(self.theta)
        first = filters[0]
        if any(len(p) != len(q) or np.any(p != q) for f in filters for p, q in zip(f, first, strict=True)):
            raise InputError(
                "the outputs have different noise filters; a plant has one for all: use an output-error model."
            )
        return Plant(
            num=num, den=den, dt=self.dt, noise_covariance=self.noise_covariance,
            noise_num=first[0], noise_den=first[1], name=name,
        )  # fmt: skip

    def poles(self) -> list[NDArray[np.complex128]]:
        """Poles of G, entry by entry."""
        return self.structure.poles(self.theta)

    def written(self, inputs: Sequence[str] = ("u",), outputs: Sequence[str] = ("y",)) -> list[str]:
        """G and, where it is not 1, H as they stand in a book, a line per entry; none of more than `LONGEST_WRITTEN` terms."""
        one = len(inputs) == len(outputs) == 1
        rows = [
            ("G" if one else f"G from {u} to {y}", num, den)
            for y, row in zip(outputs, self.structure.fractions(self.theta), strict=True)
            for u, (num, den) in zip(inputs, row, strict=True)
            if np.any(num)
        ]
        filters = self.structure.noise_fractions(self.theta)
        rows += [
            ("H" if one else f"H of {y}", *f)
            for y, f in zip(outputs, filters, strict=False)
            if max(map(len, f)) > 1
        ]
        kept = [row for row in rows if max(map(np.count_nonzero, row[1:])) <= LONGEST_WRITTEN]
        return [
            f"{name}(z) = {_terms(num)}" + (f" / {_terms(den)}" if len(den) > 1 else "")
            for name, num, den in kept
        ]

    @property
    def stable(self) -> bool:
        """Whether every pole of G lies inside the unit circle."""
        return all(np.abs(p).max(initial=0.0) < 1 for p in self.poles())

    def to_dict(self) -> dict:
        """Plain numbers, from which `model_from_json` makes the same model bit for bit."""
        return {
            "structure": self.structure.to_dict(),
            "names": list(self.names),
            "theta": self.theta.tolist(),
            "noise_covariance": self.noise_covariance.tolist(),
            "dt": self.dt,
        }

    def to_json(self) -> str:
        """The model as JSON text; reading it back gives the same bits."""
        return json.dumps(self.to_dict())

    def __repr__(self) -> str:
        values = ", ".join(f"{k} = {v:.5g}" for k, v in zip(self.names, self.theta, strict=True))
        return f"{self.structure!r}: {values}"


LONGEST_WRITTEN = 8
"""Terms of a polynomial that are read at a glance; more are read in the list of parameters."""


def _terms(p: NDArray[np.float64]) -> str:
    """A polynomial in z^-1, without the terms that are zero."""
    terms = [(f"{c:+.5g}", f" z^-{k}" if k else "") for k, c in enumerate(p) if c]
    text = " ".join(f"{c[0]} {c[1:]}{z}" for c, z in terms).removeprefix("+ ")
    return f"({text})" if len(terms) > 1 else text


LONGEST_ORDER = 20_000
"""Of a saved model, as many as a plant file's coefficients."""
_ORDER = WHOLE | {
    "minimum": 0,
    "maximum": LONGEST_ORDER,
    "description": f"a whole number from 0 to {LONGEST_ORDER}",
}
_PER_OUTPUT = listed(_ORDER, "orders, one per output", minItems=1)
_PER_ENTRY = listed(listed(_ORDER, "orders", minItems=1), "orders per input, a row per output", minItems=1)
_VALUES = listed(NUMBER, "numbers", minItems=1)
_POLYNOMIAL = keyed(
    {"kind": {"enum": list(STRUCTURES), "description": f"one of {', '.join(STRUCTURES)}"}}
    | dict.fromkeys(("na", "nc", "nd"), _PER_OUTPUT)
    | dict.fromkeys(("nb", "nf", "nk"), _PER_ENTRY),
    ("na", "nb", "nc", "nd", "nf", "nk"),
)
_STATE_SPACE = keyed(
    {"kind": TEXT, "blocks": _PER_OUTPUT, "n_inputs": _ORDER, "feedthrough": FLAG, "noise": FLAG}, ("blocks",)
)
MODEL = keyed(
    {
        "structure": {"type": "object", "required": ["kind"], "description": "an object with the kind and the orders"},
        "theta": listed(NUMBER, "numbers"),
        "noise_covariance": listed(_VALUES, "rows of numbers", minItems=1),
        "dt": {"type": "number", "exclusiveMinimum": 0, "description": "a positive number"},
    },
    ("structure", "theta", "noise_covariance", "dt"),
    others={},
)  # fmt: skip
"""What makes the model of a saved file; what a fit says beside it decides nothing here."""


def model_from_json(text: str | dict) -> Model:
    """The model that `Model.to_json` wrote."""
    where = "this is not a saved model"
    given = parsed_json(text, where) if isinstance(text, str) else text
    checked(given, MODEL, where)
    orders = dict(given["structure"])
    of_states = orders["kind"] == "ss"
    checked(orders, _STATE_SPACE if of_states else _POLYNOMIAL, f"{where}: structure")
    for name, rows in (*orders.items(), ("noise_covariance", given["noise_covariance"])):
        if isinstance(rows, list) and len({len(row) for row in rows if isinstance(row, list)}) > 1:
            raise InputError(f"{where}: the rows of {name} are of different lengths.")
    # More orders than parameters would be counted before they are compared: gigabytes of names.
    if of_states:
        del orders["kind"]
        ny, n, nu = len(orders["blocks"]), sum(orders["blocks"]), orders.get("n_inputs", 1)
        wanted = (
            n * (ny + nu) + n * ny * orders.get("noise", True) + ny * nu * orders.get("feedthrough", False)
        )
    else:
        wanted = sum(map(sum, (orders["na"], orders["nc"], orders["nd"], *orders["nb"], *orders["nf"])))
    if wanted > len(given["theta"]):
        raise InputError(
            f"{where}: its orders ask for more parameters than the {len(given['theta'])} of theta."
        )
    structure = StateSpace(**orders) if of_states else Polynomial(**orders)
    return Model(structure, given["theta"], given["noise_covariance"], given["dt"])


def saved_model(source: Any) -> Model | None:
    """The model in a file that `oed identify --out` wrote, or in its parsed mapping; None where it holds something else."""
    try:
        given = source
        if isinstance(source, str | Path) and Path(source).stat().st_size <= LARGEST:
            given = parsed_json(file_content(Path(source)).decode(), str(source))
    except (OSError, ValueError):
        return None
    wanted = {"structure", "theta", "noise_covariance", "dt"}
    return model_from_json(dict(given)) if isinstance(given, Mapping) and wanted <= set(given) else None


def fir(nb: Orders, delay: Orders = 1) -> Polynomial:
    """Finite impulse response: y = B u + e."""
    return polynomial("fir", [nb], delay)


def arx(na: int, nb: int, delay: int = 1) -> Polynomial:
    """A y = B u + e."""
    return polynomial("arx", [na, nb], delay)


def armax(na: int, nb: int, nc: int, delay: int = 1) -> Polynomial:
    """A y = B u + C e."""
    return polynomial("armax", [na, nb, nc], delay)


def oe(nb: int, nf: int, delay: int = 1) -> Polynomial:
    """Output error: y = (B / F) u + e."""
    return polynomial("oe", [nb, nf], delay)


def bj(nb: int, nc: int, nd: int, nf: int, delay: int = 1) -> Polynomial:
    """Box-Jenkins: y = (B / F) u + (C / D) e."""
    return polynomial("bj", [nb, nc, nd, nf], delay)
