"""The Monte-Carlo campaign of the iterations, compiled: B runs side by side in every loop.

Runs are the innermost axis, so the recursions of the filters, which no processor can vectorise along time, are
vectorised across runs. A signal of one channel is a flat array: sample t of run b at t B + b. Indices are
unsigned, because a sign test in the index would keep the loops scalar. The twin of everything here is the plain
loop `estimators.rules.trace.run` on `oed.experiments.simulated`.
"""

import numpy as np
from numba import njit

from estimators.montecarlo.noise_kernels import (
    BLOCKS,
    UB,
    UB2,
    UB3,
    UB4,
    UB5,
    B,
    aligned,
    apart,
    chunk,
    normal_block,
    room,
    scaled_add,
)


@njit(error_model="numpy", inline="always")
def _step(x, z0, z1, b0, b1, b2, a1, a2):
    """One sample of a second-order filter, transposed direct form II: its output, and its states after it."""
    v = z0 + b0 * x
    return v, z1 + b1 * x - a1 * v, b2 * x - a2 * v


@njit(error_model="numpy", fastmath={"contract"}, cache=True)
def _samples(u, y, t, count, samples, even, odd, state, c):
    """`count` samples of a second-order SISO plant with white noise, four at a time, and what the estimators need of them. `state`: two
    filter states, the scale of u, and the sums ||y||^2, u_before' y~, u' y~. y holds u_before and receives y~ = T y in the same places."""
    apart()  # pyright: ignore[reportCallIssue]
    b0, b1, b2, a1, a2, sigma = c[0], c[1], c[2], c[3], c[4], c[5]
    lanes = np.uint64(len(state) // 6)  # B, but not known when this is compiled, as in `_copy`
    for s in range(0, count, 4):
        now, back, row = np.uint64((t + s) * B), np.uint64((samples - 1 - t - s) * B), np.uint64(s // 2 * B)
        for b in range(lanes):
            z0, z1, scale = state[b], state[UB + b], state[UB2 + b]
            s0, s1, s2 = state[UB3 + b], state[UB4 + b], state[UB5 + b]
            v, z0, z1 = _step(u[now + b] * scale, z0, z1, b0, b1, b2, a1, a2)
            v += sigma * even[row + b]
            s0, s1, s2 = s0 + v * v, s1 + v * y[back + b], s2 + v * u[back + b]
            y[back + b] = v
            v, z0, z1 = _step(u[now + UB + b] * scale, z0, z1, b0, b1, b2, a1, a2)
            v += sigma * odd[row + b]
            s0, s1, s2 = s0 + v * v, s1 + v * y[back - UB + b], s2 + v * u[back - UB + b]
            y[back - UB + b] = v
            v, z0, z1 = _step(u[now + UB2 + b] * scale, z0, z1, b0, b1, b2, a1, a2)
            v += sigma * even[row + UB + b]
            s0, s1, s2 = s0 + v * v, s1 + v * y[back - UB2 + b], s2 + v * u[back - UB2 + b]
            y[back - UB2 + b] = v
            v, z0, z1 = _step(u[now + UB3 + b] * scale, z0, z1, b0, b1, b2, a1, a2)
            v += sigma * odd[row + UB + b]
            s0, s1, s2 = s0 + v * v, s1 + v * y[back - UB3 + b], s2 + v * u[back - UB3 + b]
            y[back - UB3 + b] = v
            state[b], state[UB + b] = z0, z1
            state[UB3 + b], state[UB4 + b], state[UB5 + b] = s0, s1, s2


@njit(error_model="numpy", cache=True)
def _one_sample(u, y, t, samples, e, row, state, c):
    """As `_samples`, for one that is left over at the end."""
    for b in range(B):
        back = (samples - 1 - t) * B + b
        x = u[t * B + b] * state[2 * B + b]
        v, state[b], state[B + b] = _step(x, state[b], state[B + b], c[0], c[1], c[2], c[3], c[4])
        v += c[5] * e[row + b]
        state[3 * B + b] += v * v
        state[4 * B + b] += v * y[back]
        state[5 * B + b] += v * u[back]
        y[back] = v


@njit(error_model="numpy", cache=True)
def _fused(u, y, samples, k0, k1, experiment, replicate, noise, state, c):
    """One experiment of a second-order SISO plant with white noise, as `_samples` has it."""
    even, odd = noise[2], noise[3]
    for t in range(0, samples, 4 * BLOCKS):
        left = chunk(k0, k1, t, samples, 0, experiment, replicate, noise)
        _samples(u, y, t, left - left % 4, samples, even, odd, state, c)
        for s in range(left - left % 4, left):
            _one_sample(u, y, t + s, samples, odd if s % 2 else even, s // 2 * B, state, c)


@njit(error_model="numpy", cache=True)
def _second_order_add(u, y, samples, num, den, scale, z):
    """As `_filter_add` for a second order, four samples at a time."""
    apart()  # pyright: ignore[reportCallIssue]
    b0, b1, b2, a1, a2 = num[0], num[1], num[2], den[1], den[2]
    z[:] = 0.0
    for t in range(0, samples - samples % 4, 4):
        now, to = np.uint64(t * B), np.uint64((samples - 1 - t) * B)
        for b in range(UB):
            z0, z1, c = z[b], z[UB + b], scale[b]
            v, z0, z1 = _step(u[now + b] * c, z0, z1, b0, b1, b2, a1, a2)
            y[to + b] += v
            v, z0, z1 = _step(u[now + UB + b] * c, z0, z1, b0, b1, b2, a1, a2)
            y[to - UB + b] += v
            v, z0, z1 = _step(u[now + UB2 + b] * c, z0, z1, b0, b1, b2, a1, a2)
            y[to - UB2 + b] += v
            v, z0, z1 = _step(u[now + UB3 + b] * c, z0, z1, b0, b1, b2, a1, a2)
            y[to - UB3 + b] += v
            z[b], z[UB + b] = z0, z1
    for t in range(samples - samples % 4, samples):
        now, to = np.uint64(t * B), np.uint64((samples - 1 - t) * B)
        for b in range(UB):
            v, z[b], z[UB + b] = _step(u[now + b] * scale[b], z[b], z[UB + b], b0, b1, b2, a1, a2)
            y[to + b] += v


@njit(error_model="numpy", cache=True)
def _filter_add(u, y, samples, num, den, scale):
    """y += T G (scale u) from rest, T for reversal in time; transposed direct form II of any order."""
    n = len(num) - 1
    z, x, v = np.zeros((n + 1) * B), np.empty(B), np.empty(B)
    if n == 2:
        _second_order_add(u, y, samples, num, den, scale, z)
        return
    for t in range(samples):
        now, to = np.uint64(t * B), np.uint64((samples - 1 - t) * B)
        b0 = num[0]
        for b in range(UB):
            value = u[now + b] * scale[b]
            x[b] = value
            v[b] = z[b] + b0 * value
        for k in range(n):
            row, nk, dk = np.uint64(k * B), num[k + 1], den[k + 1]
            for b in range(UB):
                z[row + b] = z[row + UB + b] + nk * x[b] - dk * v[b]
        for b in range(UB):
            y[to + b] += v[b]


@njit(error_model="numpy", cache=True)
def _noise_add(y, samples, weights, num, den, k0, k1, experiment, replicate, divisor, scale, x, noise):
    """y += T H (weights' e) / divisor: the noise of one output, white or filtered. `x`: room for one signal."""
    for output in range(len(weights)):
        if weights[output] == 0.0:
            continue
        for b in range(B):
            scale[b] = weights[output] / divisor[b]
        if len(num) > 1:
            normal_block(k0, k1, samples, output, experiment, replicate, x)
            _filter_add(x, y, samples, num, den, scale)
            continue
        for t in range(0, samples, 4 * BLOCKS):
            count = chunk(k0, k1, t, samples, output, experiment, replicate, noise)
            scaled_add(noise[2], noise[3], y, samples - 1 - t, count, scale)


@njit(error_model="numpy", cache=True)
def _dot_add(a, b, samples, out):
    """out += a' b for every run."""
    apart()  # pyright: ignore[reportCallIssue]
    whole = samples - samples % 4
    for t in range(0, whole, 4):
        now = np.uint64(t * B)
        for k in range(UB):
            total = out[k] + a[now + k] * b[now + k]
            total += a[now + UB + k] * b[now + UB + k]
            total += a[now + UB2 + k] * b[now + UB2 + k]
            out[k] = total + a[now + UB3 + k] * b[now + UB3 + k]
    for t in range(whole, samples):
        now = np.uint64(t * B)
        for k in range(UB):
            out[k] += a[now + k] * b[now + k]


@njit(error_model="numpy", nogil=True, cache=True)
def power_block(
    samples, iterations, num, den, noise_num, noise_den, weights, k0, k1, start, replicate, signals, gain, mu, rayleigh,
):  # fmt: skip
    """Algorithm 1 for B replicates: weights (1,), signals (4, samples * B) room, gain, mu, rayleigh (B, iterations)."""
    fused = len(num) == 3 and len(noise_num) == 1
    U, V, W, X = signals[0], signals[1], signals[2], signals[3]
    V[:] = 0.0
    noise, state = room(), aligned(1, 6 * B)[0]
    scale, before, one, small = np.empty(B), np.ones(B), np.ones(B), np.empty(B)
    c = np.zeros(6)
    if fused:
        c[:3], c[3:5], c[5] = num, den[1:], weights[0]
    normal_block(k0, k1, samples, 0, start, replicate, U)
    state[:] = 0.0
    _dot_add(U, U, samples, state[3 * B : 4 * B])
    for b in range(B):
        scale[b] = np.sqrt(samples / state[3 * B + b])
    for m in range(iterations):
        state[:] = 0.0
        state[2 * B : 3 * B] = scale
        if fused:
            _fused(U, V, samples, k0, k1, m, replicate, noise, state, c)
        else:
            W[:] = 0.0
            _filter_add(U, W, samples, num, den, scale)
            _noise_add(W, samples, weights, noise_num, noise_den, k0, k1, m, replicate, one, small, X, noise)
            _dot_add(W, W, samples, state[3 * B : 4 * B])
            _dot_add(W, V, samples, state[4 * B : 5 * B])
            _dot_add(W, U, samples, state[5 * B : 6 * B])
            V, W = W, V
        for b in range(B):
            square = state[3 * B + b] / samples
            mu[b, m] = square
            rayleigh[b, m] = state[5 * B + b] * scale[b] / samples
            gain[b, m] = state[4 * B + b] * before[b] / (samples * scale[b]) if m else np.nan
            before[b], scale[b] = scale[b], 1 / np.sqrt(square)
        U, V = V, U


@njit(error_model="numpy", nogil=True, cache=True)
def procedure_block(
    samples, iterations, num, den, noise_num, noise_den, weights, k0, k1, start, replicate, signals, gain,
    mu, energy, scaling,
):  # fmt: skip
    """Procedure 2 for B replicates; the two-experiment scheme where there is one channel; num, den (p, q, n +
    1), weights (p, p), signals (2 q + p + 1, samples * B) room, gain, mu, energy (B, iterations)."""
    p, q = num.shape[:2]
    U, Z, Y, X = signals[:q], signals[q : 2 * q], signals[2 * q : 2 * q + p], signals[-1]
    noise = room()
    scale, divisor, small = np.empty(B), np.ones(B), np.empty(B)
    total, power = np.zeros(B), np.zeros((p, B))
    for j in range(q):
        normal_block(k0, k1, samples, j, start, replicate, U[j])
        _dot_add(U[j], U[j], samples, total)
    for b in range(B):
        scale[b] = np.sqrt(samples / total[b])
    one = np.ones(B)
    for m in range(iterations):
        first = m * (1 + p * q)
        Y[:], Z[:] = 0.0, 0.0
        power[:] = 0.0
        for i in range(p):
            for j in range(q):
                _filter_add(U[j], Y[i], samples, num[i, j], den[i, j], scale)
            _noise_add(
                Y[i],
                samples,
                weights[i],
                noise_num,
                noise_den,
                k0,
                k1,
                first,
                replicate,
                one,
                small,
                X,
                noise,
            )
            _dot_add(Y[i], Y[i], samples, power[i])
        for b in range(B):
            total[b] = power[:, b].sum()
            energy[b, m] = samples
        for j in range(q):
            for i in range(p):
                for b in range(B):
                    if scaling == 1:
                        divisor[b] = np.sqrt(samples / power[i, b])
                    elif scaling == 2:
                        divisor[b] = np.sqrt(samples / total[b])
                    energy[b, m] += divisor[b] ** 2 * power[i, b]
                _filter_add(Y[i], Z[j], samples, num[i, j], den[i, j], one)
                experiment = first + 1 + j * p + i
                _noise_add(
                    Z[j], samples, weights[i], noise_num, noise_den, k0, k1, experiment, replicate, divisor, small,
                    X, noise,
                )  # fmt: skip
        total[:] = 0.0
        small[:] = 0.0
        for j in range(q):
            _dot_add(U[j], Z[j], samples, small)
            _dot_add(Z[j], Z[j], samples, total)
        for b in range(B):
            gain[b, m] = small[b] * scale[b] / samples
            mu[b, m] = np.sqrt(total[b] / samples)
            scale[b] = np.sqrt(samples / total[b])
        U, Z = Z, U


@njit(error_model="numpy", cache=True)
def accumulate(values, count, average, squares):
    """Counts, means and sums of squared deviations (M,) of the finite ones of values (R, M), batch by batch (Chan, Golub and
    LeVeque)."""
    runs, size = values.shape
    n, own, spread = np.zeros(size), np.zeros(size), np.zeros(size)
    for r in range(runs):
        for m in range(size):
            if np.isfinite(values[r, m]):
                n[m] += 1
                own[m] += values[r, m]
    for m in range(size):
        own[m] = own[m] / n[m] if n[m] else 0.0
    for r in range(runs):
        for m in range(size):
            if np.isfinite(values[r, m]):
                spread[m] += (values[r, m] - own[m]) ** 2
    for m in range(size):
        shift, share = own[m] - average[m], n[m] / (count[m] + n[m]) if n[m] else 0.0
        squares[m] += spread[m] + shift**2 * count[m] * share
        average[m] += shift * share
        count[m] += n[m]
