"""The polynomial predictor and its sensitivities as loops over filters, compiled once for all orders.

Output i of the family: A y = sum_j (B_j / F_j) u_j + (C / D) e. With w_j = (B_j / F_j) u_j and v = A y - sum_j w_j the
residual is e = (D / C) v, and its derivatives are delayed copies of a few filtered signals (Ljung 1999, section 10.3):

    de/da_k =  q^-k (D / C) y           de/dc_k = -q^-k (1 / C) e       de/dd_k = q^-k (1 / C) v
    de/db_k = -q^-k (D / (C F)) u       de/df_k =  q^-k (D / (C F)) w

An unknown initial state is one pulse more into every path, (X_j delta) / F_j, and into the noise filter, X delta / C; an
unknown level is subtracted from y. Sums over two copies follow from those one sample earlier by taking off the last
product, so that the Gauss-Newton matrix costs O(n N) and not O(n^2 N)."""

import numpy as np
from numba import njit

TINY = 1e-290
"""What has decayed this far is zero: subnormal numbers cost a hundred times a normal operation. Records may be small: 1e-75."""
CUT = 1e-30
"""Of a signal's largest value: what comes after its last sample above this share adds nothing to a sum of doubles."""


@njit(error_model="numpy", cache=True)
def _multiply(x, tail, lead):
    """(lead + tail_1 q^-1 + ...) x."""
    out = lead * x
    for k in range(len(tail)):
        for t in range(k + 1, len(x)):
            out[t] += tail[k] * x[t - k - 1]
    return out


@njit(error_model="numpy", cache=True)
def _divide(x, tail):
    """x / (1 + tail_1 q^-1 + ...), in its place."""
    n = len(tail)
    if n in (1, 2):
        last = before = 0.0
        first, second = tail[0], tail[1] if n == 2 else 0.0
        for t in range(len(x)):
            now = (x[t] - second * before) - first * last
            now = 0.0 if abs(now) < TINY else now
            before, last = last, now
            x[t] = now
    elif n:
        state = np.zeros(n + 1)
        for t in range(len(x)):
            now = x[t] + state[0]
            now = 0.0 if abs(now) < TINY else now
            for k in range(n):
                state[k] = state[k + 1] - tail[k] * now
            x[t] = now
    return x


@njit(error_model="numpy", cache=True)
def _coefficients(p, first, sizes):
    """Where each of several polynomials, one after the other, begins; the last entry is where they end."""
    places = np.empty(len(sizes) + 1, np.int64)
    places[0] = first
    for j in range(len(sizes)):
        places[j + 1] = places[j] + sizes[j]
    return places


@njit(error_model="numpy", cache=True)
def signals(data, p, orders, entries, levels, found):
    """Residuals (ny, N) of one record (nd, N), and into `found` (S, N) the filtered signals, row by row of
    the model: orders (4, ny): na, nc, nd, pulses; entries (3, ny, nu): nb, nf, pulses."""
    ny, nu = entries.shape[1:]
    N = data.shape[1]
    present = (entries[0] > 0).sum()
    at = orders[:3].sum() + entries[:2].sum() + ny * levels
    e, pulse = np.empty((ny, N)), data[present + ny]
    column = s = first = 0
    for i in range(ny):
        na, nc, nd, noise = orders[:, i]
        a, bs = p[first : first + na], _coefficients(p, first + na, entries[0, i])
        c = p[bs[nu] : bs[nu] + nc]
        d = p[bs[nu] + nc : bs[nu] + nc + nd]
        fs = _coefficients(p, bs[nu] + nc + nd, entries[1, i])
        first = fs[nu]
        y = data[present + i] - p[orders[:3].sum() + entries[:2].sum() + i] if levels else data[present + i]
        v = _multiply(y, a, 1.0)
        for j in range(nu):
            nb, nf, paths = entries[:, i, j]
            if nb == 0:
                continue
            b, f, u = p[bs[j] : bs[j + 1]], p[fs[j] : fs[j + 1]], data[column]
            column += 1
            w = _multiply(u, b[1:], b[0])
            for k in range(min(paths, N)):
                w[k] += p[at + k]
            at += paths
            w = _divide(w, f)
            v -= w
            found[s] = _divide(_divide(_multiply(u, d, 1.0), c), f)
            s += 1
            if nf:
                found[s] = _divide(_divide(_multiply(w, d, 1.0), c), f)
                s += 1
            if paths:
                found[s] = _divide(_divide(_multiply(pulse, d, 1.0), c), f)
                s += 1
        e[i] = _multiply(v, d, 1.0)
        for k in range(min(noise, N)):
            e[i, k] += p[at + k]
        at += noise
        e[i] = _divide(e[i].copy(), c)
        if na:
            found[s] = _divide(_multiply(y, d, 1.0), c)
            s += 1
        if nc:
            found[s] = _divide(e[i].copy(), c)
            s += 1
        if nd:
            found[s] = _divide(v, c)
            s += 1
        if levels:
            found[s] = _divide(_multiply(_multiply(np.ones(N), a, 1.0), d, 1.0), c)
            s += 1
        if noise:
            found[s] = _divide(pulse.copy(), c)
            s += 1
    return e


@njit(error_model="numpy", fastmath={"reassoc", "contract"}, cache=True)
def _product(x, y, i, j, end):
    """sum_t x(t - i) y(t - j) over t < end."""
    most = max(i, j)
    total = 0.0
    a, b = x[most - i : end - i], y[most - j : end - j]
    for t in range(end - most):
        total += a[t] * b[t]
    return total


@njit(error_model="numpy", cache=True)
def _ends(found):
    """After how many samples each signal has died away."""
    ends = np.empty(len(found), np.int64)
    for s in range(len(found)):
        t, least = found.shape[1], CUT * np.abs(found[s]).max()
        while t > 0 and abs(found[s, t - 1]) <= least:
            t -= 1
        ends[s] = t
    return ends


@njit(error_model="numpy", cache=True)
def _gram(found, copies, weight, hessian):
    """Adds the sums over all pairs of delayed signals, each pair at its place and with its weight: copies (S,
    5): row of the model, first delay, number of delays, first column, sign."""
    N, ends = found.shape[1], _ends(found)
    for s in range(len(found)):
        row, i0, ni, at, sign = copies[s]
        x = found[s]
        for r in range(s, len(found)):
            other, j0, nj, to, turned = copies[r]
            scale = weight[row, other] * sign * turned
            if scale == 0.0:
                continue
            y = found[r]
            sums = np.empty((ni, nj))
            for k in range(ni):
                sums[k, 0] = _product(
                    x, y, i0 + k, j0, max(min(N, ends[s] + i0 + k, ends[r] + j0), i0 + k, j0)
                )
            for m in range(1, nj):
                if s == r:
                    sums[0, m] = sums[m, 0]
                else:
                    end = min(N, ends[s] + i0, ends[r] + j0 + m)
                    sums[0, m] = _product(x, y, i0, j0 + m, max(end, i0, j0 + m))
            for k in range(1, ni):
                for m in range(1, nj):
                    i, j = N - i0 - k, N - j0 - m
                    sums[k, m] = sums[k - 1, m - 1] - (x[i] * y[j] if i >= 0 and j >= 0 else 0.0)
            for k in range(ni):
                for m in range(nj):
                    hessian[at + k, to + m] += scale * sums[k, m]
                    if s != r:
                        hessian[to + m, at + k] += scale * sums[k, m]


@njit(error_model="numpy", cache=True)
def fold(data, lengths, parameters, weight, orders, entries, levels, copies):
    """Of each record: loss (R,), half its gradient (R, n), Gauss-Newton matrix (R, n, n), moment of the
    residuals; data (nd, N) of all records, parameters (R, n), weight (ny, ny) -> (R, ny, ny) last."""
    R, n, ny = len(lengths), parameters.shape[1], len(weight)
    loss, gradient = np.zeros(R), np.zeros((R, n))
    hessian, moment = np.zeros((R, n, n)), np.zeros((R, ny, ny))
    start = 0
    for r in range(R):
        N = lengths[r]
        found = np.empty((len(copies), N))
        e = signals(data[:, start : start + N], parameters[r], orders, entries, levels, found)
        start += N
        weighted = np.zeros((ny, N))
        for i in range(ny):
            for j in range(ny):
                moment[r, i, j] = _product(e[max(i, j)], e[min(i, j)], 0, 0, N)
                weighted[i] += weight[i, j] * e[j]
        loss[r] = (weight * moment[r]).sum()
        for s in range(len(copies)):
            row, i0, ni, at, sign = copies[s]
            for k in range(min(ni, max(N - i0, 0))):
                gradient[r, at + k] = sign * _product(found[s], weighted[row], i0 + k, 0, N)
        _gram(found, copies, weight, hessian[r])
    return loss, gradient, hessian, moment
