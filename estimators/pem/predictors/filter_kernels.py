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
def _multiply(x, p, first, count, lead, out):
    """(lead + p_first q^-1 + ...) x."""
    for t in range(len(x)):
        out[t] = lead * x[t]
    for k in range(count):
        for t in range(k + 1, len(x)):
            out[t] += p[first + k] * x[t - k - 1]


@njit(error_model="numpy", cache=True)
def _divide(x, p, first, count):
    """x / (1 + p_first q^-1 + ...), in its place."""
    if count in (1, 2):
        last = before = 0.0
        one, two = p[first], p[first + 1] if count == 2 else 0.0
        for t in range(len(x)):
            now = (x[t] - two * before) - one * last
            now = 0.0 if abs(now) < TINY else now
            before, last = last, now
            x[t] = now
    elif count:
        state = np.zeros(count + 1)
        for t in range(len(x)):
            now = x[t] + state[0]
            now = 0.0 if abs(now) < TINY else now
            for k in range(count):
                state[k] = state[k + 1] - p[first + k] * now
            x[t] = now


@njit(error_model="numpy", cache=True)
def _divide_both(x, y, p, first, count):
    """As `_divide` of two signals by one polynomial, which takes hardly longer than of one: each has to wait for its own last sample."""
    if count in (1, 2):
        last = before = past = older = 0.0
        one, two = p[first], p[first + 1] if count == 2 else 0.0
        for t in range(len(x)):
            now = (x[t] - two * before) - one * last
            then = (y[t] - two * older) - one * past
            now = 0.0 if abs(now) < TINY else now
            then = 0.0 if abs(then) < TINY else then
            before, last, older, past = last, now, past, then
            x[t] = now
            y[t] = then
    elif count:
        state, other = np.zeros(count + 1), np.zeros(count + 1)
        for t in range(len(x)):
            now, then = x[t] + state[0], y[t] + other[0]
            now = 0.0 if abs(now) < TINY else now
            then = 0.0 if abs(then) < TINY else then
            for k in range(count):
                state[k] = state[k + 1] - p[first + k] * now
            for k in range(count):
                other[k] = other[k + 1] - p[first + k] * then
            x[t] = now
            y[t] = then


@njit(error_model="numpy", cache=True)
def signals(data, begin, end, p, orders, entries, places, found, e):
    """Residuals (ny, N) of the samples from begin to end of (nd, samples), and into `found` (S, N) the filtered signals, row by row of
    the model: orders (4, ny): na, nc, nd, pulses; entries (3, ny, nu): nb, nf, pulses; places: where the levels begin among the
    parameters, where the pulses do, the outputs' rows, the pulse's, and whether there are levels."""
    ny, nu = entries.shape[1:]
    N = end - begin
    level, at, first_output, pulse_row, levels = places
    y, v, w, moved = np.empty(N), np.empty(N), np.empty(N), np.empty(N)
    pulse = data[pulse_row, begin:end]
    column = s = first = 0
    for i in range(ny):
        na, nc, nd, noise = orders[0, i], orders[1, i], orders[2, i], orders[3, i]
        a, b = first, first + na
        c = b
        for j in range(nu):
            c += entries[0, i, j]
        d = c + nc
        f = d + nd
        for t in range(N):
            y[t] = data[first_output + i, begin + t] - (p[level + i] if levels else 0.0)
        _multiply(y, p, a, na, 1.0, v)
        for j in range(nu):
            nb, nf, paths = entries[0, i, j], entries[1, i, j], entries[2, i, j]
            if nb == 0:
                f += nf
                continue
            u = data[column, begin:end]
            column += 1
            _multiply(u, p, b + 1, nb - 1, p[b], w)
            for k in range(min(paths, N)):
                w[k] += p[at + k]
            at += paths
            _multiply(u, p, d, nd, 1.0, found[s])
            _divide(found[s], p, c, nc)
            _divide_both(w, found[s], p, f, nf)
            s += 1
            for t in range(N):
                v[t] -= w[t]
            if nf:
                _multiply(w, p, d, nd, 1.0, found[s])
            if paths:  # of a path with poles alone
                _multiply(pulse, p, d, nd, 1.0, found[s + 1])
                _divide_both(found[s], found[s + 1], p, c, nc)
                _divide_both(found[s], found[s + 1], p, f, nf)
                s += 2
            elif nf:
                _divide(found[s], p, c, nc)
                _divide(found[s], p, f, nf)
                s += 1
            b += nb
            f += nf
        _multiply(v, p, d, nd, 1.0, e[i])
        for k in range(min(noise, N)):
            e[i, k] += p[at + k]
        at += noise
        first, begun, apart = f, s, s + (na > 0) + (nc > 0)  # the signal of D goes along with the residuals
        if nd:
            for t in range(N):
                found[apart, t] = v[t]
            _divide_both(e[i], found[apart], p, c, nc)
        else:
            _divide(e[i], p, c, nc)
        if na:
            _multiply(y, p, d, nd, 1.0, found[s])
            s += 1
        if nc:
            for t in range(N):
                found[s, t] = e[i, t]
            s += 1
        if nd:
            s += 1
        if levels:
            for t in range(N):
                y[t] = 1.0
            _multiply(y, p, a, na, 1.0, moved)
            _multiply(moved, p, d, nd, 1.0, found[s])
            s += 1
        if noise:
            for t in range(N):
                found[s, t] = pulse[t]
            s += 1
        waiting = -1
        for k in range(begun, s):
            if nd and k == apart:
                continue
            if waiting < 0:
                waiting = k
            else:
                _divide_both(found[waiting], found[k], p, c, nc)
                waiting = -1
        if waiting >= 0:
            _divide(found[waiting], p, c, nc)


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
        t, most = found.shape[1], 0.0
        for k in range(t):
            most = max(most, abs(found[s, k]))
        while t > 0 and abs(found[s, t - 1]) <= CUT * most:
            t -= 1
        ends[s] = t
    return ends


@njit(error_model="numpy", cache=True)
def _gram(found, copies, weight, hessian):
    """Adds the sums over all pairs of delayed signals, each pair at its place and with its weight: copies (S,
    5): row of the model, first delay, number of delays, first column, sign."""
    N, ends = found.shape[1], _ends(found)
    for s in range(len(found)):
        row, i0, ni, at, sign = copies[s, 0], copies[s, 1], copies[s, 2], copies[s, 3], copies[s, 4]
        x = found[s]
        for r in range(s, len(found)):
            other, j0, nj, to, turned = copies[r, 0], copies[r, 1], copies[r, 2], copies[r, 3], copies[r, 4]
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
def fold(data, begins, parameters, weight, orders, entries, places, copies):
    """Of each record: loss (R,), half its gradient (R, n), Gauss-Newton matrix (R, n, n), moment of the
    residuals; data (nd, N) of all records, begins (R + 1,), parameters (R, n), weight (ny, ny) -> (R, ny, ny) last."""
    R, n, ny = len(parameters), parameters.shape[1], len(weight)
    loss, gradient = np.zeros(R), np.zeros((R, n))
    hessian, moment = np.zeros((R, n, n)), np.zeros((R, ny, ny))
    for r in range(R):
        start, N = begins[r], begins[r + 1] - begins[r]
        found, e, weighted = np.empty((len(copies), N)), np.empty((ny, N)), np.zeros((ny, N))
        signals(data, start, start + N, parameters[r], orders, entries, places, found, e)
        for i in range(ny):
            for j in range(ny):
                moment[r, i, j] = _product(e[max(i, j)], e[min(i, j)], 0, 0, N)
                loss[r] += weight[i, j] * moment[r, i, j]
                for t in range(N):
                    weighted[i, t] += weight[i, j] * e[j, t]
        for s in range(len(copies)):
            row, i0, ni, at, sign = copies[s, 0], copies[s, 1], copies[s, 2], copies[s, 3], copies[s, 4]
            for k in range(min(ni, max(N - i0, 0))):
                gradient[r, at + k] = sign * _product(found[s], weighted[row], i0 + k, 0, N)
        _gram(found, copies, weight, hessian[r])
    return loss, gradient, hessian, moment
