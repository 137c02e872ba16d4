"""Compiled recursion of linear dynamics with terms inside, and its exact forward sensitivities.

    s = S x + T d,  w_t = product of the factors of term t at s,
    y = C x + D d + G w,  x+ = A x + B d + E w.

Everything that discovery fits is of this form: forces are columns of E, maps of the output columns of G, slow states
and filters rows of A. The plain twin is in the tests.
"""

import numpy as np

from estimators.diagnosis.effects.kernels.recursion_kernels import compiled


@compiled
def factor(kind, s, p, q):  # pragma: no cover - compiled
    """Value of a factor at s and its derivatives by s and by its two constants p and q."""
    d = s - p
    if kind == 0:
        return d, 1.0, -1.0, 0.0
    if kind == 1:
        return d * d, 2 * d, -2 * d, 0.0
    if kind == 2:
        return d * d * d, 3 * d * d, -3 * d * d, 0.0
    if kind == 3:
        e = 1.0 if d >= 0 else -1.0
        return abs(d), e, -e, 0.0
    if kind == 4:  # sign, softened over q
        t = np.tanh(d / q)
        g = (1 - t * t) / q
        return t, g, -g, -g * d / q
    if kind == 5:  # saturation
        t = np.tanh(d / q)
        g = 1 - t * t
        return q * t, g, -g, t - g * d / q
    if kind == 6:  # one-sided
        if d > 0:
            return d, 1.0, -1.0, 0.0
        return 0.0, 0.0, 0.0, 0.0
    if kind == 7:
        return d * abs(d), 2 * abs(d), -2 * abs(d), 0.0
    if kind == 8:
        c = np.cos(q * d)
        return np.sin(q * d), q * c, -q * c, d * c
    if kind == 9:
        c = np.sin(q * d)
        return np.cos(q * d), -q * c, q * c, -d * c
    if kind == 10:
        e = np.exp(min(d / q, 30.0))
        return e, e / q, -e / q, -e * d / (q * q)
    if kind == 11:  # root
        r = np.sqrt(max(d, 1e-6))
        g = 0.5 / r if d > 1e-6 else 0.0
        return r, g, -g, 0.0
    if kind == 12:
        g = 1 / d if d > 1e-6 else 0.0
        return np.log(max(d, 1e-6)), g, -g, 0.0
    if kind == 13:
        e = max(d, 1e-2)
        g = -1 / (e * e) if d > 1e-2 else 0.0
        return 1 / e, g, -g, 0.0
    if kind == 14:  # root of the magnitude with the sign, finite slope at 0
        r = np.sqrt(abs(d) + 1e-3)
        g = 1 / r - 0.5 * abs(d) / (r * r * r)
        return d / r, g, -g, 0.0
    e = np.exp(-((d / q) ** 2))  # bell
    g = -2 * d / (q * q) * e
    return e, g, -g, 2 * d * d / (q * q * q) * e


@compiled
def evaluate(s, table, w, ws, wq):  # pragma: no cover - compiled
    """Values w of all terms at the signals s, derivatives ws by each factor's signal and wq by its two constants.

    Beyond its bounds a signal counts as at them: a polynomial is not followed to where no data were.
    """
    heads, kinds, signals, q, bounds = table
    for t in range(heads.shape[0] - 1):
        w[t] = 1.0
        for f in range(heads[t], heads[t + 1]):
            a = s[signals[f]]
            b = min(max(a, bounds[signals[f], 0]), bounds[signals[f], 1])
            v, ws[f], wq[f, 0], wq[f, 1] = factor(kinds[f], b, q[2 * f], q[2 * f + 1])
            if a != b:
                ws[f] = 0.0
            for other in range(heads[t], f):
                ws[other] *= v
                wq[other, 0] *= v
                wq[other, 1] *= v
            ws[f] *= w[t]
            wq[f, 0] *= w[t]
            wq[f, 1] *= w[t]
            w[t] *= v


@compiled
def recursion(mats, table, x0, dx0, d, moving, most):  # pragma: no cover - compiled
    """Outputs (N, ny), their derivatives (N, ny, P), signals (N, ns), states (N, n), whether these stayed below `most`.

    mats holds A to G, table the heads of the terms and the kinds, signals and constants (2 each) of the factors and the
    signals' bounds (ns, 2), dx0 is
    (n, P). moving holds what the parameters move: entries, rows (parameter, matrix, row, column), matrix 0 to 7 for A, B,
    E, S, T, C, D, G; values, the derivative of each such element; slots, rows (parameter, factor, which constant).
    """
    A, B, E, S, T, C, D, G = mats
    heads, kinds, signals, _, _ = table
    entries, values, slots = moving
    count, n, ny, ns, nt, nf = (
        d.shape[0],
        A.shape[0],
        C.shape[0],
        S.shape[0],
        heads.shape[0] - 1,
        kinds.shape[0],
    )
    nd, many = d.shape[1], dx0.shape[1]
    y, dy, kept, states = (
        np.zeros((count, ny)),
        np.zeros((count, ny, many)),
        np.zeros((count, ns)),
        np.zeros((count, n)),
    )
    x, ahead, dx, new = x0.copy(), np.zeros(n), dx0.copy(), np.zeros((n, many))
    w, ws, wq = np.zeros(nt), np.zeros(nf), np.zeros((nf, 2))
    owner = np.zeros(nf, np.int64)
    for t in range(nt):
        for f in range(heads[t], heads[t + 1]):
            owner[f] = t
    AE, CE = np.zeros((n, n)), np.zeros((ny, n))
    for k in range(count):
        s = kept[k]
        for j in range(n):
            states[k, j] = x[j]
            for i in range(ns):
                s[i] += S[i, j] * x[j]
        for j in range(nd):
            for i in range(ns):
                s[i] += T[i, j] * d[k, j]
        evaluate(s, table, w, ws, wq)
        if many > 0:
            AE[:] = A
            CE[:] = C
            for f in range(nf):
                t = owner[f]
                for j in range(n):
                    g = ws[f] * S[signals[f], j]
                    if g != 0.0:
                        for i in range(n):
                            AE[i, j] += E[i, t] * g
                        for i in range(ny):
                            CE[i, j] += G[i, t] * g
            new[:] = 0.0
            for j in range(n):
                for i in range(n):
                    a = AE[i, j]
                    if a != 0.0:
                        for p in range(many):
                            new[i, p] += a * dx[j, p]
                for i in range(ny):
                    a = CE[i, j]
                    if a != 0.0:
                        for p in range(many):
                            dy[k, i, p] += a * dx[j, p]
            for e in range(entries.shape[0]):
                p, m, i, j, v = entries[e, 0], entries[e, 1], entries[e, 2], entries[e, 3], values[e]
                if m == 0:
                    new[i, p] += v * x[j]
                elif m == 1:
                    new[i, p] += v * d[k, j]
                elif m == 2:
                    new[i, p] += v * w[j]
                elif m == 5:
                    dy[k, i, p] += v * x[j]
                elif m == 6:
                    dy[k, i, p] += v * d[k, j]
                elif m == 7:
                    dy[k, i, p] += v * w[j]
                else:
                    ds = v * x[j] if m == 3 else v * d[k, j]
                    for f in range(nf):
                        if signals[f] == i:
                            for r in range(n):
                                new[r, p] += E[r, owner[f]] * ws[f] * ds
                            for r in range(ny):
                                dy[k, r, p] += G[r, owner[f]] * ws[f] * ds
            for e in range(slots.shape[0]):
                p, f = slots[e, 0], slots[e, 1]
                g = wq[f, slots[e, 2]]
                for r in range(n):
                    new[r, p] += E[r, owner[f]] * g
                for r in range(ny):
                    dy[k, r, p] += G[r, owner[f]] * g
            dx, new = new, dx
        for i in range(n):
            ahead[i] = 0.0
            for j in range(n):
                ahead[i] += A[i, j] * x[j]
            for j in range(nd):
                ahead[i] += B[i, j] * d[k, j]
            for t in range(nt):
                ahead[i] += E[i, t] * w[t]
        for i in range(ny):
            for j in range(n):
                y[k, i] += C[i, j] * x[j]
            for j in range(nd):
                y[k, i] += D[i, j] * d[k, j]
            for t in range(nt):
                y[k, i] += G[i, t] * w[t]
        for i in range(n):
            x[i] = ahead[i]
            if not abs(x[i]) < most:
                return y, dy, kept, states, False
    return y, dy, kept, states, True


@compiled
def factor_values(kind, s, p, q):  # pragma: no cover - compiled
    """`factor` at every sample of s (N,)."""
    out = np.empty_like(s)
    for k in range(s.shape[0]):
        out[k] = factor(kind, s[k], p, q)[0]
    return out
