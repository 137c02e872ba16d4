"""What the fit needs of a structure: its kernel, the samples that feed it, its scales, and whether it is stable."""

from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from estimators.pem.predictors.compiled import polynomial_kernel, state_space_kernel
from estimators.pem.predictors.kalman import kalman_recursion, state_space_kalman_recursion
from estimators.pem.predictors.kernel import Kernel, kernel_of
from estimators.pem.search.starts import reflected
from estimators.residual.algebra import stable
from oed.models.model import Polynomial, StateSpace

Structure = Polynomial | StateSpace
EDGE = 1e-7
"""How far inside the unit circle the roots of a predictor stay."""


@lru_cache(maxsize=128)
def _cached_kernel(structure: tuple, levels: bool, initial: bool, variant: str) -> Kernel:
    kind, *rest = structure
    made = StateSpace(*rest) if kind == "ss" else Polynomial(*map(np.array, rest), kind)  # pyright: ignore[reportCallIssue]
    if isinstance(made, StateSpace):
        if variant == "missing":
            return kernel_of(state_space_kalman_recursion(made, levels, initial))
        return state_space_kernel(made, levels, initial, variant == "weighted")
    if variant == "missing":
        return kernel_of(kalman_recursion(made, levels, initial))
    return polynomial_kernel(made, levels, initial, variant == "weighted")


def kernel_for(structure: Structure, levels: bool, initial: bool, variant: str = "") -> Kernel:
    """The kernel of a structure; made once per process."""
    if isinstance(structure, StateSpace):
        key = ("ss", structure.blocks, structure.n_inputs, structure.feedthrough, structure.noise)
        return _cached_kernel(key, levels, initial, variant)
    frozen = lambda a: tuple(map(tuple, a.tolist())) if a.ndim == 2 else tuple(a.tolist())
    nk = structure.nk if initial and variant != "missing" else np.ones_like(structure.nk)
    orders = [*(getattr(structure, x) for x in ("na", "nb", "nc", "nd", "nf")), nk]
    return _cached_kernel((structure.kind, *map(frozen, orders)), levels, initial, variant)


def predictor_is_stable(structure: Structure, z: NDArray) -> bool:
    """Whether the predictor forgets: every C and F stable, or A - K C; z (n,)."""
    if isinstance(structure, StateSpace):
        m = structure.matrices(z)
        closed = m["A"] - m["K"] @ m["C"]
        return bool(np.isfinite(closed).all()) and float(np.abs(np.linalg.eigvals(closed)).max()) < 1
    return all(stable(z[part]) for part in _forgotten(structure))


def _forgotten(structure: Polynomial) -> list[slice]:
    """Where the C and F are whose roots say whether the predictor forgets."""
    parts = [part for place in structure.places() for part in (*place["c"], *place["f"])]
    return [part for part in parts if part.stop > part.start]


def projected(structure: Structure, z: NDArray, mirror: bool = True) -> NDArray:
    """Parameters with the unstable roots of C and F mirrored into the unit circle; of state space, as they
    are."""
    if isinstance(structure, StateSpace) or predictor_is_stable(structure, z):
        return z
    z = np.array(z)
    for part in _forgotten(structure):
        if not stable(z[part]):
            z[part] = reflected(z[part], 1 - EDGE, mirror)
    return z


def walls(structure: Structure, z: NDArray) -> NDArray[np.float64]:
    """Where roots of C and F lie on the edge of stability, the gradient of their modulus: z (n,) -> (m, n).
    With p(r) = 0 the root moves by dr = -r^(n-k) dz_k / p'(r), its modulus by Re(conj(r) dr) / |r|."""
    found: list[NDArray] = []
    if isinstance(structure, StateSpace):
        return np.zeros((0, len(z)))
    for part in _forgotten(structure):
        degree, factor = part.stop - part.start, 1 / (1 - 20 * EDGE)
        if stable(z[part] * factor ** np.arange(1, degree + 1)):
            continue
        whole = np.concatenate([[1.0], z[part]])
        slope = np.polyder(whole)
        for root in np.roots(whole):
            if abs(root) < 1 - 20 * EDGE or root.imag < 0:
                continue
            speed = np.polyval(slope, root)
            if abs(speed) < 1e-8:
                continue  # a double root splits as a square root: its modulus has no gradient
            moved = -(root ** np.arange(degree - 1, -1, -1)) / speed
            normal = np.zeros(len(z))
            normal[part] = np.real(np.conj(root) * moved) / abs(root)
            if np.isfinite(normal).all():
                found.append(normal)
    return np.array(found).reshape(len(found), len(z))


def parameter_scale(structure: Structure, su: NDArray, sy: NDArray) -> NDArray[np.float64]:
    """Factors from the parameters of scaled channels to those of the user's units: su, sy (nu,) -> (n,)."""
    if isinstance(structure, StateSpace):
        sx = np.repeat(sy, structure.blocks)
        sides = {"A": (sx, sx), "B": (sx, su), "K": (sx, sy), "D": (sy, su)}
        return np.array([sides[x][0][i] / sides[x][1][j] for x, i, j in structure.entries()])
    scale = np.ones(structure.n)
    for i, place in enumerate(structure.places()):
        for j, part in enumerate(place["b"]):
            scale[part] = sy[i] / su[j]
    return scale


def samples(structure: Structure, u: NDArray, y: NDArray) -> NDArray[np.float64]:
    """The rows that a kernel reads: inputs delayed entry by entry, outputs, pulse; u, y (N, nu) -> (N, nd)."""
    pulse = np.zeros(len(u))
    pulse[0] = 1.0
    if isinstance(structure, StateSpace):
        return np.ascontiguousarray(np.column_stack([u, y, pulse]))
    columns = []
    for i in range(structure.n_outputs):
        for j in range(structure.n_inputs):
            if structure.nb[i, j]:
                nk = min(int(structure.nk[i, j]), len(u))
                columns.append(np.concatenate([np.zeros(nk), u[: len(u) - nk, j]]))
    return np.ascontiguousarray(np.column_stack([*columns, y, pulse]))
