"""The H-infinity norm of a plant: the peak of its largest singular value, where it lies, how sharp it is.

The peak is found by refining every local maximum of sigma_max(G(e^jw)) on a grid that follows the poles, and
certified by the level-set test of Bruinsma and Steinbuch (1990): at a level slightly above the peak, a
symplectic pencil of the plant must have no eigenvalue on the unit circle. One input and one output are certified
by cells (`norm_kernels`), in a twentieth to a fifth of the time, and by the pencil where rounding leaves cells undecided."""

import math
from collections.abc import Callable
from dataclasses import dataclass
from functools import lru_cache
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from oed.errors import SolverFailure
from oed.plants.level_sets import LARGEST, crossings
from oed.plants.plant import Plant
from oed.plants.systems import as_plant

EQUAL = 1e-10
"""Relative difference below which two local maxima count as equal peaks."""
NEAR = 1e-4
"""Distance in rad/sample up to which rounding may split a flat top in two (a quartic one: eps^(1/4))."""
FLAT = 1e-13
"""Relative range of the squared gain below which it is constant (an all-pass plant)."""

Top = tuple[float, float]
"""A local maximum: its frequency and its height."""


@dataclass(frozen=True, eq=False)
class Peak:
    """The H-infinity norm of a plant and where it is attained. `value` gamma = max over w of
    sigma_max(G(e^jw)); `frequency` w^ in [0, pi], rad/sample; the lowest where several peaks are equal;
    `frequencies` all frequencies in [0, pi] with a peak of that height (to 1e-10 relative); 0 and pi where
    the gain is the same at all frequencies; `curvatures` H = -d2 sigma_max^2 / dw2 at each of them ([S]
    Theorem 9: H_mu); `output_direction, input_direction` left (ny,) and right (nu,) singular vectors at w^;
    the phase makes the largest entry of the input direction real and positive; `local_maxima` every local
    maximum found: (frequency, sigma_max), highest first; `upper_bound` certified: no frequency has a larger
    gain."""

    value: float
    frequency: float
    frequencies: tuple[float, ...]
    curvatures: tuple[float, ...]
    output_direction: NDArray[np.complex128]
    input_direction: NDArray[np.complex128]
    local_maxima: tuple[tuple[float, float], ...]
    upper_bound: float

    @property
    def curvature(self) -> float:
        """H_mu at the peak reported by `frequency`."""
        return self.curvatures[0]

    @property
    def unique(self) -> bool:
        """Whether only one frequency attains the norm."""
        return len(self.frequencies) == 1

    def __repr__(self) -> str:
        where = ", ".join(f"{w:.7g}" for w in self.frequencies)
        return f"H-infinity norm {self.value:.9g} at {where} rad/sample (no frequency exceeds {self.upper_bound:.9g})"


def largest_gain(G: NDArray) -> NDArray[np.float64]:
    """Largest singular value of every matrix of a stack (..., ny, nu), without a decomposition where it is a vector."""
    if G.shape[-2:] == (1, 1):
        return np.abs(G[..., 0, 0])
    if 1 in G.shape[-2:]:
        return np.linalg.norm(G, axis=(-2, -1))
    return np.linalg.norm(G, 2, axis=(-2, -1))


def refined_maximum(height: Callable[[NDArray], NDArray], low: float, high: float) -> float:
    """Where a smooth function with one maximum between two close points is largest: height (K,). Off by the
    order of the square of a hundredth of their distance, so that the height is by its fourth power."""
    points = np.linspace(low, high, 101)
    heights = height(points)
    k = int(heights.argmax())
    if k in (0, 100):
        return float(points[k])
    bend = heights[k + 1] - 2 * heights[k] + heights[k - 1]
    move = 0.5 * (heights[k - 1] - heights[k + 1]) / bend if bend < 0 else 0.0
    return float(points[k] + move * (points[1] - points[0]))


def response_derivatives(
    plant: Plant, omega: ArrayLike
) -> tuple[NDArray[np.complex128], NDArray[np.complex128], NDArray[np.complex128]]:
    """Frequency response with its first two derivatives in frequency: omega (K,)."""
    omega = np.atleast_1d(np.asarray(omega, dtype=float))
    most = max(len(p) for rows in (plant.num, plant.den) for row in rows for p in row)
    powers = np.exp(-1j * np.outer(omega, np.arange(most)))
    shape = (len(omega), plant.n_outputs, plant.n_inputs)
    G, G1, G2 = (np.zeros(shape, dtype=complex) for _ in range(3))
    for i, row in enumerate(plant.num):
        for j, num in enumerate(row):
            B, A = (_with_derivatives(p, powers) for p in (num, plant.den[i][j]))
            g = B[0] / A[0]
            g1 = (B[1] - g * A[1]) / A[0]
            G[:, i, j], G1[:, i, j] = g, g1
            G2[:, i, j] = (B[2] - 2 * g1 * A[1] - g * A[2]) / A[0]
    return G, G1, G2


def _with_derivatives(p: NDArray, powers: NDArray) -> NDArray:
    """A polynomial in z = e^-jw and its first two derivatives in w, (3, K), from the powers of z, (K, n)."""
    return (powers[:, : len(p)] @ (np.asarray(p)[:, None] * _factors(len(p)))).T


@lru_cache(maxsize=64)
def _factors(n: int) -> NDArray[np.complex128]:
    """What k-th powers of e^-jw are multiplied by in the first two derivatives: 1, -jk, (-jk)^2."""
    k = -1j * np.arange(n)
    return np.stack([np.ones(n, dtype=complex), k, k**2], axis=1)


def _grid(plant: Plant, points: int) -> NDArray[np.float64]:
    """Frequencies that follow every pole: spacing proportional to the distance from it."""
    offsets = np.concatenate([[0.0], *(s * np.geomspace(0.05, 20, 12) for s in (-1, 1))])
    parts = [np.linspace(0, np.pi, points)]
    for row in plant.den:
        for den in row:
            roots = np.roots(den)
            for pole in roots[roots.imag >= 0]:
                parts.append(abs(np.angle(pole)) + max(1 - abs(pole), 1e-9) * offsets)
    omega = np.unique(np.concatenate(parts))
    return omega[(omega >= 0) & (omega <= np.pi)]


def _slope(plant: Plant, omega: NDArray) -> tuple[NDArray, NDArray]:
    """sigma_max^2 and its derivative in frequency, both (K,)."""
    G, G1, _ = response_derivatives(plant, omega)
    if 1 in G.shape[1:]:  # the only singular value is a length, which needs no decomposition
        return np.sum(np.abs(G) ** 2, axis=(1, 2)), 2 * np.sum((G.conj() * G1).real, axis=(1, 2))
    U, s, Vh = np.linalg.svd(G)
    slope = np.einsum("kp,kpq,kq->k", U[:, :, 0].conj(), G1, Vh[:, 0].conj())
    return s[:, 0] ** 2, 2 * s[:, 0] * slope.real


def _height(plant: Plant, omega: NDArray) -> NDArray[np.float64]:
    """sigma_max^2 alone, (K,): by Horner's rule, for many frequencies."""
    z = np.exp(-1j * omega)
    G = np.empty((len(omega), plant.n_outputs, plant.n_inputs), dtype=complex)
    for i, row in enumerate(plant.num):
        for j, num in enumerate(row):
            G[:, i, j] = np.polyval(num[::-1], z) / np.polyval(plant.den[i][j][::-1], z)
    if 1 in G.shape[1:]:
        return np.sum(np.abs(G) ** 2, axis=(1, 2))
    return np.linalg.svd(G, compute_uv=False)[:, 0] ** 2


def singular_value_curvature(plant: Plant, omega: float) -> float:
    """H = -d2 sigma_max(G(e^jw))^2 / dw2, by second-order perturbation of the eigenvalue of G* G."""
    G, G1, G2 = (m[0] for m in response_derivatives(plant, [omega]))
    M1 = G1.conj().T @ G + G.conj().T @ G1
    M2 = G2.conj().T @ G + 2 * G1.conj().T @ G1 + G.conj().T @ G2
    values, vectors = np.linalg.eigh(G.conj().T @ G)
    v = vectors[:, -1]
    second = (v.conj() @ M2 @ v).real
    for value, other in zip(values[:-1], vectors[:, :-1].T, strict=True):
        second += 2 * abs(other.conj() @ M1 @ v) ** 2 / max(values[-1] - value, 1e-300)
    return float(-second)


def _refine(plant: Plant, low: NDArray, high: NDArray) -> NDArray[np.float64]:
    """The frequency in every [low, high] where the slope of sigma_max^2 changes from rising to falling."""
    from scipy.optimize import minimize_scalar

    left, right = _slope(plant, low)[1], _slope(plant, high)[1]
    found = np.where(left <= 0, low, high)
    height = lambda w: -float(_slope(plant, np.array([w]))[0][0])
    for k in np.flatnonzero(~((left > 0) & (right < 0))):
        # Directions cross inside the bracket, so that the slope jumps: the height alone decides.
        options = {"xatol": 1e-14}
        found[k] = minimize_scalar(height, bounds=(low[k], high[k]), method="bounded", options=options).x
    active = np.flatnonzero((left > 0) & (right < 0))
    x1, x2, f1, f2 = low[active], high[active], left[active], right[active]
    t = f1 / (f1 - f2)
    # Chandrupatla (1997): inverse quadratic interpolation where it is safe, else bisection. SciPy's own
    # (optimize.elementwise.find_root) takes 0.9 ms for itself, which is all the time there is at order 20.
    for _ in range(200):
        if not len(active):
            break
        x = x1 + t * (x2 - x1)
        fx = _slope(plant, x)[1]
        same = np.sign(fx) == np.sign(f1)
        x3, f3 = np.where(same, x1, x2), np.where(same, f1, f2)
        x2, f2 = np.where(same, x2, x1), np.where(same, f2, f1)
        x1, f1 = x, fx
        found[active] = np.where(np.abs(f1) <= np.abs(f2), x1, x2)
        least = 4e-16 / np.maximum(np.abs(x2 - x1), 1e-300)
        going = (least < 0.5) & (f1 != 0)
        active, x1, x2, x3 = active[going], x1[going], x2[going], x3[going]
        f1, f2, f3, least = f1[going], f2[going], f3[going], least[going]
        with np.errstate(all="ignore"):  # where the formula has no value, bisection takes over
            xi, phi = (x1 - x2) / (x3 - x2), (f1 - f2) / (f3 - f2)
            inverse = f1 / (f2 - f1) * f3 / (f2 - f3)
            inverse += (x3 - x1) / (x2 - x1) * f1 / (f3 - f1) * f2 / (f3 - f2)
            safe = (phi**2 < xi) & ((1 - phi) ** 2 < 1 - xi) & np.isfinite(inverse)
        t = np.clip(np.where(safe, inverse, 0.5), least, 1 - least)
    return found


def _local_maxima(plant: Plant, omega: NDArray) -> list[Top]:
    height = _height(plant, omega)
    if np.ptp(height) <= FLAT * height.max():  # every frequency is a peak: its ends stand for all of them
        return [(w, float(np.sqrt(height[k]))) for w, k in ((0.0, 0), (np.pi, -1))]
    padded = np.concatenate([[-np.inf], height, [-np.inf]])
    tops = np.flatnonzero((padded[1:-1] >= padded[:-2]) & (padded[1:-1] >= padded[2:]))
    # By symmetry the slope vanishes at 0 and pi: an end is a peak unless the height rises inwards.
    at_end = ((tops == 0) | (tops == len(omega) - 1)) & ((omega[tops] == 0.0) | (omega[tops] == np.pi))
    found = [(float(omega[k]), float(np.sqrt(height[k]))) for k in tops[at_end]]
    inside = tops[~at_end]
    if not len(inside):
        return _gathered(plant, found, [], found)
    w = _refine(plant, omega[np.maximum(inside - 1, 0)], omega[np.minimum(inside + 1, len(omega) - 1)])
    values = np.sqrt(_slope(plant, np.concatenate([w, [0.0, np.pi]]))[0]).tolist()
    tops_inside = list(zip(w.tolist(), values[:-2], strict=True))
    return _gathered(plant, found, tops_inside, [(0.0, values[-2]), (np.pi, values[-1])])


def _gathered(plant: Plant, found: list[Top], inside: list[Top], ends: list[Top]) -> list[Top]:
    """The maxima at the ends that were found and those inside, the highest first: one beside an end is exactly there, from where
    rounding may have moved it."""
    for top in inside:
        end = ends[top[0] >= np.pi / 2]
        found.append(end if _same_top(plant, *sorted([top, end])) else top)
    return sorted(_distinct(plant, found), key=lambda row: -row[1])


def _distinct(plant: Plant, found: list[Top]) -> list[Top]:
    """The maxima without their doubles: rounding near a flat top makes two of one, with no dip between them."""
    distinct: list[Top] = []
    for w, s in sorted(found):
        if not distinct or not _same_top(plant, distinct[-1], (w, s)):
            distinct.append((w, s))
        elif distinct[-1][0] != 0.0 and (w == np.pi or s > distinct[-1][1]):
            distinct[-1] = (w, s)  # an end of the axis is exact, else the higher of the two
    return distinct


def _same_top(plant: Plant, one: Top, other: Top) -> bool:
    """Whether two maxima, the lower frequency first, have no dip between them that rounding could not make."""
    distance = other[0] - one[0]
    if distance <= 1e-9 or distance > NEAR:
        return distance <= 1e-9
    between = _slope(plant, np.linspace(one[0], other[0], 11)[1:-1])[0]
    return bool(between.min() >= min(one[1], other[1]) ** 2 * (1 - 8 * np.finfo(float).eps))


def peak(plant: Any, *, tolerance: float = 1e-9) -> Peak:
    """H-infinity norm of a plant, gamma = max_w sigma_max(G(e^jw)), with a certified upper bound.

    Parameters
    ----------
    plant : Plant or what `oed.plants.systems.as_plant` takes
        The plant.
    tolerance : float
        Relative distance of the upper bound from the value.

    Returns
    -------
    Peak
        Value (to rounding), frequencies, curvatures, directions and upper bound.

    Raises
    ------
    SolverFailure
        If the level-set test keeps contradicting the refined grid.
    InputError
        If the plant has more states than the test is made for.

    Notes
    -----
    Twin: dense grid and `control.system_norm` in the tests. Source: N. A. Bruinsma, M. Steinbuch, Systems &
    Control Letters 14 (1990) 287-293.
    """
    return _peak(as_plant(plant), tolerance)


@lru_cache(maxsize=32)  # plants do not change, and one command asks for the same peak many times
def _peak(plant: Plant, tolerance: float) -> Peak:
    by_cells = _certified_by_cells(plant, tolerance)
    if by_cells is not None:
        return by_cells
    omega = _grid(plant, 512)
    maxima = _local_maxima(plant, omega)
    for _ in range(30):
        value = maxima[0][1]
        level = value * (1 + tolerance)
        at = crossings(plant, level)
        # Eigenvalues near the circle need not lie on it: the heights between and at them decide.
        trial = np.unique(np.concatenate([at, (at[1:] + at[:-1]) / 2]))
        if not len(trial) or np.sqrt(_slope(plant, trial)[0].max()) <= level:
            return _assemble(plant, maxima, level)
        omega = np.unique(np.concatenate([omega, trial]))
        maxima = _local_maxima(plant, omega)
    raise SolverFailure(
        f"the largest gain found is {maxima[0][1]:.9g}, but the level-set test still finds larger ones after 30 "
        "rounds; the plant is too badly scaled: rescale its channels or lower its order."
    )


def _certified_by_cells(plant: Plant, tolerance: float) -> Peak | None:
    """The peak of a plant with one input and one output; None for others, where it is flat, and where rounding hides the level."""
    num, den = plant.num[0][0], plant.den[0][0]
    at, last = num.nonzero()[0], den.nonzero()[0][-1]
    if plant.n_inputs * plant.n_outputs != 1 or not len(at) or not 0 < max(at[-1] - at[0], last) <= LARGEST:
        return None
    # without its delay, which moves no gain
    b, a = np.array(num[at[0] : at[-1] + 1]), np.array(den[: last + 1])
    from oed.plants.norm_kernels import response_at, siso_peak

    found, *at_end, sure = siso_peak(b, a, tolerance)
    if not sure:
        return None
    tops = [(w, math.sqrt(square)) for w, square in found.tolist()]
    ends = tops[-2:]
    maxima = _gathered(plant, [end for end, top in zip(ends, at_end, strict=True) if top], tops[:-2], ends)
    value = maxima[0][1]
    highest = sorted(w for w, s in maxima if s >= value * (1 - EQUAL))
    responses = [response_at(b, a, w, at[0]) for w in highest]
    g = responses[0][0]
    return Peak(
        abs(g), highest[0], tuple(highest), tuple(curvature for _, curvature in responses), np.array([g / abs(g)]), np.array([1.0 + 0j]),
        tuple(maxima), value * (1 + tolerance),
    )  # fmt: skip


def _assemble(plant: Plant, maxima: list[Top], upper_bound: float) -> Peak:
    value = maxima[0][1]
    tops = sorted(w for w, s in maxima if s >= value * (1 - EQUAL))
    U, s, Vh = np.linalg.svd(response_derivatives(plant, [tops[0]])[0][0])
    u, v = U[:, 0], Vh[0].conj()
    phase = v[np.argmax(np.abs(v))]
    phase = phase / abs(phase)
    curvatures = tuple(singular_value_curvature(plant, w) for w in tops)
    return Peak(
        value=float(s[0]), frequency=tops[0], frequencies=tuple(tops), curvatures=curvatures,
        output_direction=u / phase, input_direction=v / phase, local_maxima=tuple(maxima), upper_bound=upper_bound,
    )  # fmt: skip


def gain_gradient(plant: Plant, at: Peak | None = None) -> NDArray[np.float64]:
    """Derivative of the H-infinity norm with respect to the unknown parameters, c = d gamma / d theta:
    returns (n,). By the envelope theorem c_i = Re(u^* dG_i(e^jw^) v), with the singular vectors at the peak,
    which must be unique and simple."""
    at = peak(plant) if at is None else at
    dG = plant.response([at.frequency])[1][0]
    return np.einsum("p,npq,q->n", at.output_direction.conj(), dG, at.input_direction).real
