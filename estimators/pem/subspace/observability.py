"""The range of the extended observability matrix by its singular values, and A and C from it."""

from dataclasses import dataclass
from functools import partial

import numpy as np
from numpy.typing import NDArray

from estimators.pem.subspace.hankel import Factor
from estimators.residual.algebra import thin_svd
from oed.errors import InputError

TOLD = 1e-6
"""Least eigenvalue of products of rows, over the largest, that leaves their vectors ten digits."""


@dataclass(frozen=True, eq=False)
class Range:
    """Range of the extended observability matrix, as estimated. `A, C` (n, n), (ny, n) in some coordinates;
    `basis` (i ny, n) its columns; `singular_values` (i ny,) all of them; n should stand out; `factor` the
    data; `weight, unweight` (i ny, i ny) what the future outputs were multiplied by before the decomposition,
    and its inverse; `method` how; `right` (n, ...) its right vectors."""

    A: NDArray[np.float64]
    C: NDArray[np.float64]
    basis: NDArray[np.float64]
    singular_values: NDArray[np.float64]
    factor: Factor
    weight: NDArray[np.float64]
    unweight: NDArray[np.float64]
    method: str
    right: NDArray[np.float64]

    @property
    def instruments(self) -> NDArray[np.float64]:
        """(i (nu + ny), n): the past, free of the future inputs, times this is the state, each over its singular value
        squared."""
        _, L21, L22, *_ = self.factor.blocks()
        size = self.singular_values[: len(self.A)]
        over = partial(self.factor.divided, L22)
        # the state is q = left' weight Theta S S|u^-1 (past given the future inputs); moesp and cva have S = S|u
        if self.method != "n4sid":
            return over(self.right.T * size, transposed=True) / size**2
        known, own = np.split(self.right.T * size, [L21.shape[1]])
        return over(own + over(L21 @ known), transposed=True) / size**2


@dataclass(frozen=True, eq=False)
class Subspace:
    """How a subspace method came to its model. `method` moesp, n4sid or cva; `horizon` block rows that look
    back, and as many that look forward; `singular_values` (horizon ny,) from which the order is read: as many
    as the model has states should stand out; `tried` root mean square of the simulation error on the data,
    over the outputs' sizes, for each horizon that gave a stable model; `influence` (N, ny, n + levels) of
    each record: what noise in each output at each sample adds to the estimate."""

    method: str
    horizon: int
    singular_values: NDArray[np.float64]
    tried: dict[int, float]
    influence: list[NDArray[np.float64]]

    def to_dict(self) -> dict:
        """Plain numbers."""
        return {
            "method": self.method,
            "horizon": self.horizon,
            "singular_values": self.singular_values.tolist(),
            "tried": {str(horizon): error for horizon, error in self.tried.items()},
        }

    def __repr__(self) -> str:
        many, shown = len(self.tried), ", ".join(f"{s:.3g}" for s in self.singular_values[:8])
        tried = f" (the best of {many} from {min(self.tried)} to {max(self.tried)})" if many > 1 else ""
        return f"by {self.method} with {self.horizon} block rows{tried}; singular values {shown} ..."


def range_of(factor: Factor, order: int, method: str, leading: bool = False) -> Range:
    """Range of the observability matrix, and A and C from it; leading: with no more singular values and vectors than
    the order where products have their digits, for horizons that are only compared."""
    _, L21, L22, _, L32, L33 = factor.blocks()
    rows, ny = len(L32), factor.n_outputs
    weight = unweight = np.eye(rows)
    if method == "cva":
        values, vectors = np.linalg.eigh(L32 @ L32.T + L33 @ L33.T)
        kept = values > 1e-14 * values[-1]
        root = np.sqrt(np.where(kept, values, 1.0))
        weight = (vectors * np.where(kept, 1 / root, 0.0)) @ vectors.T
        unweight = (vectors * np.where(kept, root, 0.0)) @ vectors.T
    along = weight @ L32
    if method == "n4sid":
        # L32 L22^-1 [L21, L22]: of the second block nothing is lost by taking L32 itself where the factor has its digits
        known = factor.divided(L22, L32.T, transposed=True).T
        along = np.hstack([known @ L21, known @ L22 if factor.gram is None else L32])
    left, singular, right = _decomposed(along, order if leading else len(along))
    if singular[order - 1] <= 1e-11 * singular[0]:
        shown = int(np.sum(singular > 1e-11 * singular[0]))
        raise InputError(
            f"the data show {shown} states, of {order} asked for: singular value {order} of the future given the past is "
            f"{singular[order - 1] / max(singular[0], 1e-300):.1e} of the first; lower the order, or excite more."
        )
    basis = unweight @ left[:, :order]
    A = np.linalg.lstsq(basis[:-ny], basis[ny:], rcond=None)[0].astype(float)
    return Range(A, basis[:ny], basis, singular, factor, weight, unweight, method, right[:order])


def _decomposed(along: NDArray, count: int) -> tuple[NDArray, NDArray, NDArray]:
    """The first singular vectors and values, from the products of the rows where those tell them."""
    from scipy.linalg import eigh

    rows = len(along)
    values, left = eigh(along @ along.T, subset_by_index=[rows - count, rows - 1], check_finite=False)
    if not values[0] > TOLD * values[-1]:
        return thin_svd(along)
    singular = np.sqrt(values[::-1])
    return left[:, ::-1], singular, (left[:, ::-1] / singular).T @ along
