"""Criteria by name: D, A, E, and the variance of scalars of the model (peak gain, gain, damping, a pole, ...).

D, A, E, modified-E         of all parameters; modified-E is the condition number of the information
Ds:b1,b2                    D of the named parameters, the others being nuisance
hinf                        peak gain
static-gain, gain:0.5       largest singular value of G at 0, or at a frequency in rad/sample
pole:1, damping:1           modulus of, and damping ratio of, the pole with the smallest damping (1), the next (2)
I, G, I:0.1:1.0             variance of the frequency response over a band: its mean, its maximum"""

from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from oed.criteria import NAMED, Criterion, c_criterion, d_criterion, g_criterion
from oed.criteria.determinant import Determinant
from oed.criteria.trace import Trace
from oed.data import entry_name
from oed.design.problem.families import Family
from oed.design.problem.grid import frequency_grid
from oed.design.problem.information_maps import InformationMap
from oed.design.problem.orthonormal import Orthonormal
from oed.errors import InputError, check_names
from oed.models.model import Model
from oed.plants.norms import gain_gradient, peak
from oed.plants.plant import Plant
from oed.theory.quadrature import graded_edges, panel_nodes, resolved_edges

TOGETHER = 2**12
"""Nodes whose responses are held together."""
NAMES = (*sorted(NAMED), "Ds", "hinf", "static-gain", "gain", "pole", "damping", "I", "G")


def criterion_of(
    criterion: str | Criterion, model: Any, information: InformationMap, *, over_a_band: bool = False
) -> Criterion:
    """The criterion of a name, for a model."""
    if not over_a_band and (str(criterion).split(":")[0] == "G" or getattr(criterion, "family", None)):
        raise InputError(
            "the criterion G over a band is available in solve_design with its own solver only; give a "
            "g_criterion of the combinations that matter, or I, the mean over the band."
        )
    if isinstance(criterion, Criterion):
        if criterion.n != information.n:
            raise InputError(
                f"the criterion has {criterion.n} parameters and the model {information.n}; they must agree."
            )
        return criterion
    if not isinstance(criterion, str):
        raise InputError(
            f"the criterion is given as {type(criterion).__name__}; give its name or an object of oed.criteria, such as "
            "a_criterion(n)."
        )
    name, *arguments = criterion.split(":")
    check_names([name], NAMES, "criterion")
    n = information.n
    if name in NAMED:
        return NAMED[name](np.eye(n), name)
    if name == "Ds":
        chosen = [part for part in ":".join(arguments).split(",") if part]
        check_names(chosen, information.names, "parameter")
        if not chosen:
            raise InputError("the criterion Ds needs the parameters that matter, such as Ds:b1,b2.")
        return d_criterion(n, np.array([information.names.index(part) for part in chosen]), name=criterion)
    numbers = [_number(argument, criterion) for argument in arguments]
    if name == "hinf":
        return c_criterion(_peak_gradient(model), name="hinf")
    if name in ("static-gain", "gain"):
        omega = 0.0 if name == "static-gain" else _one(numbers, criterion, "a frequency, such as gain:0.5")
        if not 0 <= omega <= np.pi:
            raise InputError(
                f"the criterion {criterion} asks for {omega:g} rad/sample; it must lie in [0, pi]."
            )
        return c_criterion(_gain_gradient(model, omega), name=criterion)
    if name in ("I", "G"):
        low, high = numbers if len(numbers) == 2 else (0.0, np.pi)
        if not 0 <= low < high <= np.pi + 1e-12:
            raise InputError(f"the band is {low:g} to {high:g} rad/sample; it needs 0 <= low < high <= pi.")
        if name == "G":
            return _worst_response(model, information, (low, high), criterion)
        return Trace(_mean_response(model, information, (low, high)), name=criterion)
    which = int(_one(numbers, criterion, f"the pole's number, such as {name}:1")) if numbers else 1
    return c_criterion(_pole_gradient(model, which, name), name=criterion)


def criterion_in(
    basis: Orthonormal, criterion: str | Criterion, wanted: Criterion, information: InformationMap
) -> tuple[Criterion, float]:
    """What was asked of a model, asked in other coordinates, whose information this is; and the factor between the losses.

    What has a derivative by the coordinates is not found by way of the model's parameters, whose last digits matter."""
    if of_the_model(criterion):
        return criterion_of(criterion, basis, information, over_a_band=True), 1.0
    if isinstance(wanted, Determinant) and np.array_equal(wanted.V, np.eye(wanted.n)):
        return wanted, float(np.exp(-2 * basis.logdet / wanted.n))
    return replace(wanted, V=basis.times(wanted.V, "inverse")), 1.0


def of_the_model(criterion: str | Criterion) -> bool:
    """Whether what is asked for follows from the model, whatever its parameters are."""
    return isinstance(criterion, str) and criterion.split(":")[0] not in (*NAMED, "Ds")


def _responses(model: Any, omega: NDArray[np.float64]) -> NDArray[np.float64]:
    """V (K, n, 2 ny nu) such that trace(V' M^-1 V) is the variance of the frequency response at a frequency."""
    dG = model.response(omega)[1]
    flat = dG.reshape(*dG.shape[:2], -1)
    return np.concatenate([flat.real, flat.imag], axis=2)


def _mean_response(model: Any, information: InformationMap, band: tuple[float, float]) -> NDArray[np.float64]:
    """V (n, s) with trace(V' M^-1 V) the mean variance of the frequency response over the band, to 1e-12.

    From the responses at the nodes: in their squares, 1e17 apart at order 12, the smallest directions are rounding."""
    edges = graded_edges(*band, information.resonances)
    # In units in which every parameter matters alike: small entries keep their digits.
    unit = np.sqrt(np.mean(_responses(model, edges) ** 2, axis=(0, 2)))
    unit = np.where(unit > 0, unit, 1.0)
    # Rounding moves the parameters of B and of A apart, and what is known of nearly equal effects is a difference.
    wide = np.longdouble if isinstance(model, Plant | Model) else float

    def rows(omega: NDArray) -> NDArray[np.float64]:
        return np.asarray(_responses(model, omega.astype(wide)) / unit[:, None], dtype=np.float64)

    edges = resolved_edges(lambda omega: np.sum(rows(omega) ** 2, axis=2), edges)
    omega, weight = (part.ravel() for part in panel_nodes(edges[:-1], edges[1:]))
    triangle = np.zeros((0, len(unit)))
    for part in np.array_split(np.arange(len(omega)), 1 + len(omega) // TOGETHER):
        V = rows(omega[part]) * np.sqrt(weight[part] / (band[1] - band[0]))[:, None, None]
        triangle = np.linalg.qr(np.vstack([triangle, V.swapaxes(1, 2).reshape(-1, len(unit))]), mode="r")
    _, sizes, turned = np.linalg.svd(triangle)
    known = sizes > len(unit) * np.finfo(float).eps * sizes[0]
    return unit[:, None] * (turned[: len(sizes)][known].T * sizes[known])


def _worst_response(
    model: Any, information: InformationMap, band: tuple[float, float], name: str
) -> Criterion:
    """G over the band; its sample to begin with is spread over it as the information of white noise is."""
    grid = frequency_grid(information, (band,), 400)
    family = Family(lambda omega: _responses(model, omega), grid)
    V = family.at(grid)
    leverage = np.cumsum(np.sum(V**2 / np.maximum(np.mean(V**2, axis=(0, 2)), 1e-300)[:, None], axis=(1, 2)))
    count = 2 * information.n + 10
    at = np.searchsorted(leverage, (np.arange(count) + 0.5) / count * leverage[-1])
    return replace(g_criterion(V[np.unique(np.minimum(at, len(grid) - 1))], name=name), family=family)


def _number(text: str, criterion: str) -> float:
    try:
        return float(text)
    except ValueError:
        raise InputError(f"the criterion {criterion} has the argument {text!r}; give a number.") from None


def _one(numbers: list[float], criterion: str, what: str) -> float:
    if len(numbers) != 1:
        raise InputError(f"the criterion {criterion} needs {what}.")
    return numbers[0]


def _plant(model: Any, name: str) -> Plant:
    model = model.plant if isinstance(model, Orthonormal) else model
    if not isinstance(model, Plant):
        raise InputError(f"the criterion {name} needs a Plant; convert the model with its to_plant().")
    return model


def _peak_gradient(model: Any) -> NDArray[np.float64]:
    found = peak(_plant(model, "hinf"))
    if not found.unique:
        raise InputError(
            f"the peak gain is attained at {len(found.frequencies)} frequencies, so it has no derivative; "
            "design for the gain at one of them."
        )
    return gain_gradient(model, found)


def _gain_gradient(model: Any, omega: float) -> NDArray[np.float64]:
    G, dG = model.response(np.array([omega]))
    u, s, vh = np.linalg.svd(G[0])
    if s[0] == 0:
        raise InputError(f"the gain at {omega:g} rad/sample is 0 and has no derivative; choose another.")
    return np.einsum("p,npq,q->n", u[:, 0].conj(), dG[0], vh[0].conj()).real


def _pole_gradient(model: Any, which: int, name: str) -> NDArray[np.float64]:
    """Gradient of a pole's modulus or damping ratio."""
    plant, poles = _plant(model, name), []
    for i, row in enumerate(plant.den):
        for j, A in enumerate(row):
            for p in np.roots(A):
                if p.imag >= 0 and abs(p) > 0:
                    poles.append((_damping(p), i, j, complex(p)))
    poles.sort(key=lambda entry: entry[0])
    if not 1 <= which <= len(poles):
        raise InputError(f"the criterion {name}:{which} asks for pole {which}; the plant has {len(poles)}.")
    _, i, j, p = poles[which - 1]
    slope = np.polyval(np.polyder(plant.den[i][j]), p)
    if abs(slope) < 1e-9:
        raise InputError(f"the pole {p:.6g} is multiple, so it has no derivative; choose another.")
    by_coefficients = not isinstance(model, Orthonormal)
    dp = _slope_of_pole(plant, i, j, p, slope) if by_coefficients else model.slope_of_pole(i, j, p)
    c = (p.conjugate() * dp).real / abs(p) if name == "pole" else _damping_slope(p, dp)
    if not np.any(c):
        raise InputError(
            f"the pole {p:.6g} does not depend on the unknown parameters; nothing is to be learnt."
        )
    return c


def _slope_of_pole(plant: Plant, i: int, j: int, p: complex, slope: complex) -> NDArray[np.complex128]:
    """Derivative of a pole of an entry by the parameters, by implicit differentiation of A(z) = 0; slope A'(p)."""
    order, dp = len(plant.den[i][j]) - 1, np.zeros(len(plant.free), dtype=complex)
    several = plant.n_outputs * plant.n_inputs > 1
    tail = f"_{entry_name(i, j, plant.n_outputs, plant.n_inputs)}" if several else ""
    for power in range(1, order + 1):
        if f"a{power}{tail}" in plant.free:
            dp[plant.free.index(f"a{power}{tail}")] = -(p ** (order - power)) / slope
    return dp


def _damping(p: complex) -> float:
    s = np.log(complex(p))  # a plant of real poles only has them as real numbers
    return float(-s.real / abs(s))


def _damping_slope(p: complex, dp: NDArray[np.complex128]) -> NDArray[np.float64]:
    s, ds = np.log(complex(p)), dp / p
    modulus = abs(s)
    return -ds.real / modulus + s.real * (s.conjugate() * ds).real / modulus**3
