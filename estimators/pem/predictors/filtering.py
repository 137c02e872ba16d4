"""The polynomial predictor by whole-record filters: what runs where no C compiler is there.

The same residuals and sensitivities as the CasADi recursion, signal by signal through scipy's compiled filter
instead of sample by sample; the tests hold the two together to 1e-9.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from estimators.pem.predictors.kernel import Kernel
from estimators.pem.predictors.recursion import initial_counts
from estimators.pem.search.starts import filtered
from oed.models.model import Polynomial

__all__ = ["filter_kernel"]


def _delayed(x: NDArray, k: int) -> NDArray:
    return x if k == 0 else np.concatenate([np.zeros(min(k, len(x))), x[: max(len(x) - k, 0)]])


def filter_kernel(structure: Polynomial, levels: bool, initial: bool, weighted: bool = False) -> Kernel:
    """A kernel of a polynomial structure that needs neither CasADi nor a compiler."""
    ny, nu = structure.n_outputs, structure.n_inputs
    paths, noise = initial_counts(structure) if initial else ([[0] * nu] * ny, [0] * ny)
    first_x0 = structure.n + ny * levels
    n = first_x0 + sum(map(sum, paths)) + sum(noise)
    places = structure.places()

    def record(data: NDArray, p: NDArray) -> tuple[NDArray, NDArray]:
        """Residuals (ny, N) and jacobian (ny, n, N)."""
        length, column, at = len(data), 0, first_x0
        present = int((structure.nb > 0).sum())
        e_all, jacobian = np.zeros((ny, length)), np.zeros((ny, n, length))
        pulse = data[:, present + ny]
        for i, place in enumerate(places):
            J = jacobian[i]
            poly = {x: [np.r_[1.0, p[s]] for s in place[x]] for x in "acdf"}
            a, c, d = (poly[x][0] for x in "acd")
            y = data[:, present + i] - (p[structure.n + i] if levels else 0.0)
            v, inputs = filtered(a, [1.0], y), []
            for j in range(nu):
                if not structure.nb[i, j]:
                    continue
                u, b, f = data[:, column], p[place["b"][j]], poly["f"][j]
                forced = filtered(b, [1.0], u)
                if paths[i][j]:
                    forced = forced + filtered(p[at : at + paths[i][j]], [1.0], pulse)
                w = filtered([1.0], f, forced) if len(f) > 1 else forced
                v = v - w
                inputs.append((j, u, w, f, at))
                at, column = at + paths[i][j], column + 1
            driven = filtered(d, [1.0], v)
            if noise[i]:
                driven = driven + filtered(p[at : at + noise[i]], [1.0], pulse)
            e = filtered([1.0], c, driven) if len(c) > 1 else driven
            e_all[i] = e
            for j, u, w, f, start in inputs:
                den = np.convolve(c, f)
                u_f = filtered(d, den, u)
                for k in range(structure.nb[i, j]):
                    J[place["b"][j].start + k] = -_delayed(u_f, k)
                if len(f) > 1:
                    w_f = filtered(d, den, w)
                    for k in range(len(f) - 1):
                        J[place["f"][j].start + k] = _delayed(w_f, k + 1)
                if paths[i][j]:
                    x_f = filtered(d, den, pulse)
                    for k in range(paths[i][j]):
                        J[start + k] = -_delayed(x_f, k)
            for letter, value, sign in (("a", y, 1.0), ("c", e, -1.0), ("d", v, 1.0)):
                part = place[letter][0]
                if part.stop > part.start:
                    shaped = filtered(d if letter == "a" else [1.0], c, value)
                    for k in range(part.stop - part.start):
                        J[part.start + k] = sign * _delayed(shaped, k + 1)
            if levels:
                J[structure.n + i] = -filtered(np.convolve(a, d), c, np.ones(length))
            if noise[i]:
                x_f = filtered([1.0], c, pulse)
                for k in range(noise[i]):
                    J[at + k] = _delayed(x_f, k)
                at += noise[i]
        if weighted:
            roots = data[:, -ny:].T
            e_all, jacobian = e_all * roots, jacobian * roots[:, None]
        return e_all, jacobian

    def fold(data: NDArray, lengths: NDArray, parameters: NDArray, weight: NDArray) -> NDArray:
        raw, start = [], 0
        weight = np.eye(1) if ny == 1 else weight
        for length, p in zip(lengths, parameters, strict=True):
            with np.errstate(over="ignore", invalid="ignore"):
                e, jacobian = record(data[start : start + length], p)
                start += length
                weighted_e = weight @ e
                gradient = np.sum([jacobian[i] @ weighted_e[i] for i in range(ny)], axis=0)
                hessian = np.zeros((n, n))
                for i in range(ny):
                    for k in range(ny):
                        if weight[i, k]:
                            hessian += weight[i, k] * (jacobian[i] @ jacobian[k].T)
                outer = e @ e.T
                raw.append(
                    np.concatenate(
                        [
                            [np.sum(e * weighted_e)],
                            gradient,
                            hessian[np.tril_indices(n)],
                            outer[np.tril_indices(ny)],
                        ]
                    )
                )
        return np.array(raw)

    def trace(data: NDArray, parameters: NDArray, with_jacobian: bool) -> tuple[NDArray, NDArray | None]:
        e, jacobian = record(data, parameters)
        return np.ascontiguousarray(e.T), jacobian.transpose(2, 0, 1).copy() if with_jacobian else None

    return Kernel(fold, trace, n, ny, compiled=False)
