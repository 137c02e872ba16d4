"""Steps of Nesterov and Todd over cones of Hermitian matrices: what several primal-dual interior-point methods share.

A cone is a batch of K positive semidefinite p x p matrices, real or Hermitian; numbers are matrices of order 1. In coordinates in which
a matrix and its multiplier are the same diagonal matrix `lam` (SIAM J. Optimization 8 (1998) 324-364) a step of both is one projection
onto the range of the constraints' matrix, done with an orthogonal basis of it or, where that is smaller, of what it leaves out."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

CORRECTED = 2
"""Corrections of a least-squares solution by what it leaves: each gains the digits that a product with the matrix has left."""
Vector = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class Cone:
    """`lam` (K, p); `down` (K, p, p) makes lam of a matrix, down P down^* = diag(lam), and `up`, its inverse, of the multiplier."""

    lam: NDArray[np.float64]
    down: NDArray
    up: NDArray

    @classmethod
    def of(cls, P: NDArray, Z: NDArray) -> "Cone":
        """From factors of the matrices and of their multipliers, (K, p, p) each."""
        U, lam, right = np.linalg.svd(Z.conj().swapaxes(1, 2) @ P)
        root = np.sqrt(lam)[:, None, :]
        return cls(lam, (Z @ U / root).conj().swapaxes(1, 2), P @ right.conj().swapaxes(1, 2) / root)

    @property
    def size(self) -> int:
        """Of a vector of it."""
        return len(self.lam) * self._entries

    @property
    def _entries(self) -> int:
        """Of one matrix."""
        p = self.lam.shape[1]
        return p**2 if np.iscomplexobj(self.down) else p * (p + 1) // 2

    def vector(self, A: NDArray) -> Vector:
        """Hermitian matrices (K, p, p) as a vector of the same length."""
        return vector(A, np.iscomplexobj(self.down)).ravel()

    def matrix(self, v: Vector) -> NDArray:
        """And back."""
        K, p = self.lam.shape
        upper = np.triu_indices(p, 1)
        A = np.zeros((K, p, p), dtype=self.down.dtype)
        v = v.reshape(K, self._entries)
        A[:, range(p), range(p)] = v[:, :p]
        k = len(upper[0])
        off = v[:, p : p + k] / np.sqrt(2.0)
        if np.iscomplexobj(A):
            off = off + 1j * v[:, p + k :] / np.sqrt(2.0)
        A[:, upper[0], upper[1]] = off
        A[:, upper[1], upper[0]] = off.conj()
        return A

    @property
    def here(self) -> NDArray:
        """diag(lam) (K, p, p)."""
        return self.lam[:, :, None] * np.eye(self.lam.shape[1])

    def wanted(self, target: float, second: NDArray) -> Vector:
        """The change of a matrix and of its multiplier together that leads to the centre of a target."""
        lam = self.lam
        rest = target * np.eye(lam.shape[1]) - self.here**2 - second
        return self.vector(rest / (0.5 * (lam[:, :, None] + lam[:, None, :])))

    def reach(self, v: Vector) -> float:
        """The longest step of a change that stays in the cone."""
        root = np.sqrt(self.lam)
        values = np.linalg.eigvalsh(self.matrix(v) / (root[:, :, None] * root[:, None, :]))
        lowest = float(values.min(initial=0.0))
        return -1 / lowest if lowest < 0 else np.inf

    def moved(self, v: Vector, length: float, of: NDArray) -> NDArray:
        """A factor after a step; `of` is up for the matrices, down^* for their multipliers."""
        return of @ np.linalg.cholesky(self.here + length * self.matrix(v))


def vector(A: NDArray, whole: bool) -> Vector:
    """Hermitian matrices (.., p, p) as vectors (.., d) of the same length, with their imaginary parts where the cone is whole."""
    upper = np.triu_indices(A.shape[-1], 1)
    off = np.sqrt(2.0) * A[..., upper[0], upper[1]]
    parts = [np.diagonal(A, axis1=-2, axis2=-1).real, off.real]
    return np.concatenate([*parts, off.imag] if whole else parts, axis=-1)


class Projection:
    """Onto the range of B = [[A, c], [I, 0]], A (N, M): `last` is what c adds to it, of length 1, and `size` how long that is."""

    def __init__(self, A: NDArray[np.float64], c: Vector) -> None:
        N, M = A.shape
        self.A, self.c, self.within = A, c, M < N
        if self.within:
            B = np.zeros((N + M, M + 1))
            B[:N, :M], B[:N, M] = A, c
            B[N:, :M] = np.eye(M)
            self.basis, self.T = np.linalg.qr(B)
            self.last, self.size = self.basis[:, M], float(self.T[M, M])
            return
        self.basis = _basis(np.concatenate([np.eye(N), -A.T]))
        added = self.basis @ (self.basis[:N].T @ c)
        self.size = float(np.linalg.norm(added))
        self.last = added / self.size

    def __call__(self, v: Vector) -> Vector:
        """Of a vector (N + M,)."""
        if self.within:
            return self.basis @ (self.basis.T @ v)
        return v - self.basis @ (self.basis.T @ v) + self.last * (self.last @ v)

    def solved(self, v: Vector) -> tuple[Vector, float]:
        """x (M,) and t of B (x, t) nearest to v."""
        if self.within:
            from scipy.linalg import solve_triangular

            x = solve_triangular(self.T, self.basis.T @ v)
            return x[:-1], float(x[-1])
        N, M = self.A.shape
        x, t, goal = np.zeros(M), 0.0, self(v)
        left = goal
        for _ in range(1 + CORRECTED):
            near = self(left)
            x, t = x + near[N:], t + float(self.last @ left) / self.size
            # Where A is large the last digits of x are seen: what they leave is a correction away.
            left = goal - np.concatenate([self.A @ x + self.c * t, x])
        return x, t


def _basis(B: NDArray[np.float64]) -> NDArray[np.float64]:
    """Of the range, with the largest rows first and pivots: small rows then keep their digits (A. J. Cox and N. J. Higham, 1998), of which
    six were lost otherwise."""
    from scipy.linalg import qr

    order = np.argsort(-np.abs(B).max(axis=1), kind="stable")
    basis = np.empty_like(B)
    basis[order] = qr(B[order], mode="economic", pivoting=True, check_finite=False)[0]
    return basis


def shared_step(cones: list[Cone], project: Projection, before: float) -> tuple[Vector, Vector, float, float]:
    """The predictor and corrector steps of Mehrotra: changes of the matrices and of the multipliers, and how far they go."""
    ends = np.cumsum([cone.size for cone in cones])
    parts = [slice(end - cone.size, end) for end, cone in zip(ends, cones, strict=True)]
    here = np.concatenate([cone.vector(cone.here) for cone in cones])
    degree, price = sum(cone.lam.size for cone in cones), project.last / project.size

    def step(target: float, second: list[NDArray]) -> tuple[Vector, Vector]:
        wanted = np.concatenate([cone.wanted(target, C) for cone, C in zip(cones, second, strict=True)])
        ahead = project(here + wanted) + price
        return ahead, wanted - ahead

    def reaches(d: Vector) -> float:
        return min(cone.reach(d[part]) for cone, part in zip(cones, parts, strict=True))

    mu = float(here @ here) / degree
    a, b = step(0.0, [np.zeros((1, 1, 1))] * len(cones))
    p, q = min(1.0, reaches(a)), min(1.0, reaches(b))
    after = float((here + p * a) @ (here + q * b)) / degree
    second = []
    for cone, part in zip(cones, parts, strict=True):
        C = cone.matrix(a[part]) @ cone.matrix(b[part])
        second.append((C + C.conj().swapaxes(1, 2)) / 2)
    a, b = step(mu * min(1.0, after / mu) ** 3, second)
    return a, b, min(1.0, before * reaches(a)), min(1.0, before * reaches(b))
