"""One sample of the predictor of a polynomial or state-space model in CasADi: what the compiled loops are held against.

Output i of the family: A y = sum_j (B_j / F_j) u_j + (C / D) e. With w_j = (B_j / F_j) u_j and
v = A y - sum_j w_j the residual is e = (D / C) v, and its derivatives are delayed filtered signals
(Ljung 1999, section 10.3):

    de/da_k =  q^-k (D / C) y           de/dc_k = -q^-k (1 / C) e       de/dd_k = q^-k (1 / C) v
    de/db_k = -q^-k (D / (C F)) u       de/df_k =  q^-k (D / (C F)) w

so the sensitivities of a sample cost O(n) operations, whatever the orders. An unknown initial state is
one pulse more into every path, (X_j delta) / F_j, and into the noise filter, X delta / C; an unknown level
of the output is subtracted from y.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np

from estimators.pem.predictors.compiled import initial_counts
from estimators.pem.predictors.recursion import Recursion, differentiated
from oed.models.model import Polynomial, StateSpace

__all__ = ["polynomial_recursion", "state_space_recursion", "weighted"]


def weighted(recursion: Recursion) -> Recursion:
    """The recursion with a weight for every sample and output, which the loss multiplies and the state
    ignores.
    """
    import casadi as ca

    root = ca.SX.sym("root", recursion.residual.numel())
    return replace(
        recursion,
        sample=ca.vertcat(recursion.sample, root),
        residual=root * recursion.residual,
        jacobian=ca.diag(root) @ recursion.jacobian,
    )


class _Line:
    """A delay line: `past` holds x(t-1), x(t-2), ...; `now` is set to x(t)."""

    def __init__(self, ca: Any, name: str, length: int) -> None:
        self.past = [ca.SX.sym(f"{name}_{k + 1}") for k in range(length)]
        self.now: Any = ca.SX(0)

    def __getitem__(self, k: int) -> Any:
        return self.now if k == 0 else self.past[k - 1]

    @property
    def next(self) -> list:
        return [self.now, *self.past[:-1]] if self.past else []


def polynomial_recursion(structure: Polynomial, levels: bool, initial: bool) -> Recursion:
    """The predictor of a polynomial structure whose inputs have already been delayed by nk."""
    import casadi as ca

    ny, nu = structure.n_outputs, structure.n_inputs
    paths, noise = initial_counts(structure) if initial else ([[0] * nu] * ny, [0] * ny)
    entries = [(i, j) for i in range(ny) for j in range(nu) if structure.nb[i, j]]
    symbols = {ij: ca.SX.sym(f"u_{ij[0]}_{ij[1]}") for ij in entries}
    y, pulse = [ca.SX.sym(f"y_{i}") for i in range(ny)], ca.SX.sym("pulse")
    theta = ca.SX.sym("theta", structure.n)
    level = ca.SX.sym("level", ny if levels else 0)
    x0 = ca.SX.sym("x0", sum(map(sum, paths)) + sum(noise))
    first_x0 = structure.n + level.numel()
    jacobian = ca.SX(ny, first_x0 + x0.numel())
    lines: list[_Line] = []

    def line(name: str, length: int) -> _Line:
        lines.append(_Line(ca, name, length))
        return lines[-1]

    def applied(numerator: list, signal: _Line) -> Any:
        """(1 + n_1 q^-1 + ...) signal."""
        return signal.now + sum((n * signal[k + 1] for k, n in enumerate(numerator)), ca.SX(0))

    def divided(name: str, value: Any, denominator: list, length: int) -> _Line:
        """value / (1 + d_1 q^-1 + ...), remembered for at least `length` samples."""
        out = line(name, max(length, len(denominator)))
        out.now = value - sum((d * out[k + 1] for k, d in enumerate(denominator)), ca.SX(0))
        return out

    nd_most = max(structure.nd)
    pulses = line("pulse", max([0, *(p - 1 for row in paths for p in row), *(p - 1 for p in noise), nd_most]))
    pulses.now = pulse
    residual, at = [], 0
    for i, place in enumerate(structure.places()):
        letters = {x: [[theta[k] for k in range(s.start, s.stop)] for s in place[x]] for x in "abcdf"}
        a, c, d = (letters[x][0] for x in "acd")
        na, nc, nd = len(a), len(c), len(d)
        deviation = line(f"y{i}", max(na, nd))
        deviation.now = y[i] - level[i] if levels else y[i]
        total, inputs = applied(a, deviation), []
        for j in range(nu):
            if not structure.nb[i, j]:
                continue
            b, f = letters["b"][j], letters["f"][j]
            u = line(f"u{i}{j}", max(len(b) - 1, nd))
            u.now = symbols[i, j]
            forced = sum((bk * u[k] for k, bk in enumerate(b)), ca.SX(0))
            forced += sum((x0[at + k] * pulses[k] for k in range(paths[i][j])), ca.SX(0))
            w = divided(f"w{i}{j}", forced, f, nd)
            total -= w.now
            inputs.append((j, u, w, f, at))
            at += paths[i][j]
        v = line(f"v{i}", nd)
        v.now = total
        started = sum((x0[at + k] * pulses[k] for k in range(noise[i])), ca.SX(0))
        e = divided(f"e{i}", applied(d, v) + started, c, 0)
        residual.append(e.now)

        def shaped(name: str, signal: _Line, f: list, length: int, c: list = c, d: list = d) -> _Line:
            """(D / (C F)) signal."""
            inner = divided(name + "c", applied(d, signal), c, 0 if f else length)
            return divided(name, inner.now, f, length) if f else inner

        for j, u, w, f, at_path in inputs:
            b_at, f_at = place["b"][j].start, place["f"][j].start
            filtered = shaped(f"uf{i}{j}", u, f, structure.nb[i, j] - 1)
            for k in range(structure.nb[i, j]):
                jacobian[i, b_at + k] = -filtered[k]
            if f:
                filtered = shaped(f"wf{i}{j}", w, f, len(f))
                for k in range(len(f)):
                    jacobian[i, f_at + k] = filtered[k + 1]
            if paths[i][j]:
                filtered = shaped(f"xf{i}{j}", pulses, f, paths[i][j] - 1)
                for k in range(paths[i][j]):
                    jacobian[i, first_x0 + at_path + k] = -filtered[k]
        if na:
            filtered = shaped(f"yf{i}", deviation, [], na)
            for k in range(na):
                jacobian[i, place["a"][0].start + k] = filtered[k + 1]
        if nc:
            filtered = divided(f"ef{i}", e.now, c, nc)
            for k in range(nc):
                jacobian[i, place["c"][0].start + k] = -filtered[k + 1]
        if nd:
            filtered = divided(f"vf{i}", v.now, c, nd)
            for k in range(nd):
                jacobian[i, place["d"][0].start + k] = filtered[k + 1]
        if levels:
            one = line(f"one{i}", na)
            one.now = ca.SX(1)
            risen = line(f"risen{i}", nd)
            risen.now = applied(a, one)
            jacobian[i, structure.n + i] = -shaped(f"level{i}", risen, [], 0).now
        if noise[i]:
            filtered = divided(f"x{i}", pulse, c, noise[i] - 1)
            for k in range(noise[i]):
                jacobian[i, first_x0 + at + k] = filtered[k]
            at += noise[i]
    return Recursion(
        state=ca.vertcat(*(s for x in lines for s in x.past)),
        sample=ca.vertcat(*(symbols[ij] for ij in entries), *y, pulse),
        parameters=ca.vertcat(theta, level, x0),
        next_state=ca.vertcat(*(s for x in lines for s in x.next)),
        residual=ca.vertcat(*residual),
        jacobian=jacobian,
    )


def state_space_recursion(structure: StateSpace, levels: bool, initial: bool) -> Recursion:
    """The predictor x+ = A x + B u + K e, e = y - C x - D u, of an innovations model."""
    import casadi as ca

    n, nu, ny = structure.order, structure.n_inputs, structure.n_outputs
    theta, level = ca.SX.sym("theta", structure.n), ca.SX.sym("level", ny if levels else 0)
    x0 = ca.SX.sym("x0", n if initial else 0)
    fixed = structure.matrices(np.zeros(structure.n))
    m = {letter: ca.SX(value) for letter, value in fixed.items()}
    for k, (letter, i, j) in enumerate(structure.entries()):
        m[letter][i, j] = theta[k]
    m = {letter: ca.sparsify(value) for letter, value in m.items()}
    x, sample = ca.SX.sym("x", n), ca.SX.sym("sample", nu + ny + 1)
    u, y = sample[:nu], sample[nu : nu + ny]
    e = y - m["C"] @ x - m["D"] @ u - (level if levels else 0)
    after = m["A"] @ x + m["B"] @ u + m["K"] @ e
    parameters = ca.vertcat(theta, level, x0)
    start = x0 if initial else None
    return differentiated(x, sample, parameters, ca.densify(after), ca.densify(e), start)
