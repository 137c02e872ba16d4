"""The Monte-Carlo campaign of the iterations, compiled: B runs side by side in every loop.

Runs are the innermost axis, so the recursions of the filters, which no processor can vectorise along time, are
vectorised across runs. A signal of one channel is a flat array: sample t of run b at t B + b. Indices are
unsigned, because a sign test in the index would keep the loops scalar. The twin of everything here is the plain
loop `estimators.rules.trace.run` on `oed.experiments.simulated`; the noise is that of `oed.signals.noise`, bit for bit.
"""

import numpy as np
from llvmlite import ir
from numba import njit, types
from numba.extending import intrinsic

from oed.signals.noise import COS, LOG, ROOT_HALF, ROUNDS, SIN

B = 64
"""Runs side by side; two signals of 1000 samples of them fill half of a 2 MB cache."""

UB, UB2, UB3, UB4, UB5 = (np.uint64(k * B) for k in range(1, 6))
_f, _i = np.float32, np.int32
M0, M1, LOW, SHIFT = (np.uint64(v) for v in (0xD2511F53, 0xCD9E8D57, 0xFFFFFFFF, 32))
W0, W1 = np.uint64(0x9E3779B9), np.uint64(0xBB67AE85)
L0, L1, L2, L3, L4, L5, L6 = (_f(c) for c in LOG)
S0, S1, S2, S3, S4 = (_f(c) for c in SIN)
C0, C1, C2, C3, C4 = (_f(c) for c in COS)
SCALE, OFFSET, TURN, LN2 = _f(2.0**-31), _f(2.0**-32), _f(np.pi / 2 * 2.0**-31), _f(np.log(2))
HALF, ONE, MINUS_TWO = _f(0.5), _f(1), _f(-2)
ROOT, RAISE, MANTISSA = _i(ROOT_HALF), _i(0x3F800000 - ROOT_HALF), _i(0x007FFFFF)
POSITIVE, SIGN, BIAS, N23 = _i(0x7FFFFFFF), _i(-(2**31)), _i(127), _i(23)


@intrinsic
def _bits(typingctx, x):
    """The bits of a single-precision number."""
    return types.int32(types.float32), lambda context, builder, sig, args: builder.bitcast(
        args[0], ir.IntType(32)
    )


@intrinsic
def _float(typingctx, x):
    """The single-precision number of some bits."""
    return types.float32(types.int32), lambda context, builder, sig, args: builder.bitcast(
        args[0], ir.FloatType()
    )


@intrinsic
def _wide(typingctx):
    """Ask the compiler for the widest vectors the machine has; where it has no wider ones, nothing changes."""

    def generate(context, builder, sig, args):
        if isinstance(builder.function.attributes, set):
            set.add(builder.function.attributes, '"prefer-vector-width"="512"')
        return context.get_dummy_value()

    return types.void(), generate


@njit(error_model="numpy", cache=True)
def _words(k0, k1, block, output, experiment, replicate, w):
    """Philox4x32-7 for B successive replicates. High words are left dirty: the products ignore them."""
    _wide()  # pyright: ignore[reportCallIssue]
    for b in range(B):
        c0, c1 = np.uint64(block), np.uint64(output)
        c2, c3 = np.uint64(experiment), np.uint64(replicate) + np.uint64(b)
        a0, a1 = k0, k1
        for _ in range(ROUNDS):
            p0, p1 = (c0 & LOW) * M0, (c2 & LOW) * M1
            c0, c1, c2, c3 = (p1 >> SHIFT) ^ c1 ^ a0, p1, (p0 >> SHIFT) ^ c3 ^ a1, p0
            a0, a1 = (a0 + W0) & LOW, (a1 + W1) & LOW
        w[0, b], w[1, b] = _i(np.uint32(c0)), _i(np.uint32(c1))
        w[2, b], w[3, b] = _i(np.uint32(c2)), _i(np.uint32(c3))


@njit(error_model="numpy", cache=True)
def _normals(w, e):
    """Box-Muller as in `oed.signals.noise`, every operation in single precision and rounded once."""
    _wide()  # pyright: ignore[reportCallIssue]
    for pair in range(2):
        for b in range(B):
            x, v = w[2 * pair, b], w[2 * pair + 1, b]
            u = _f(_i(x & POSITIVE)) * SCALE + OFFSET
            i = _i(_bits(u) + RAISE)
            exponent = _f(_i(_i(i >> N23) - BIAS))
            m = _float(_i(_i(i & MANTISSA) + ROOT)) - ONE
            p = (((((L6 * m + L5) * m + L4) * m + L3) * m + L2) * m + L1) * m + L0
            z = m * m
            radius = np.sqrt(MINUS_TWO * (exponent * LN2 + (m + (z * m * p - HALF * z))))
            radius = _float(_i(_bits(radius) ^ _i(x & SIGN)))
            a = _f(v) * TURN
            z = a * a
            e[2 * pair, b] = radius * ((((C4 * z + C3) * z + C2) * z + C1) * z + C0)
            e[2 * pair + 1, b] = radius * (a * ((((S4 * z + S3) * z + S2) * z + S1) * z + S0))


@njit(error_model="numpy", cache=True)
def normal_block(k0, k1, samples, output, experiment, replicate, x):
    """Standard normals of one output of one experiment into x, for B replicates: x (samples * B,)."""
    w, e = np.empty((4, B), np.int32), np.empty((4, B), np.float32)
    for block in range((samples + 3) // 4):
        _words(k0, k1, block, output, experiment, replicate, w)
        _normals(w, e)
        for s in range(min(4, samples - 4 * block)):
            base = np.uint64((4 * block + s) * B)
            for b in range(UB):
                x[base + b] = e[s, b]


@njit(error_model="numpy", fastmath={"contract"}, cache=True)
def _four_samples(u, y, t, samples, e, state, c):
    """Four samples of a second-order SISO plant with white noise, and what the estimators need of them.
    `state`: two filter states, the scale of u, and the sums ||y||^2, u_before' y~, u' y~. y holds u_before
    and receives y~ = T y in the same places."""
    _wide()  # pyright: ignore[reportCallIssue]
    b0, b1, b2, a1, a2, sigma = c[0], c[1], c[2], c[3], c[4], c[5]
    now, back = np.uint64(t * B), np.uint64((samples - 1 - t) * B)
    for b in range(UB):
        z0, z1, scale = state[b], state[UB + b], state[UB2 + b]
        s0, s1, s2 = state[UB3 + b], state[UB4 + b], state[UB5 + b]
        x = u[now + b] * scale
        v = z0 + b0 * x
        z0, z1 = z1 + b1 * x - a1 * v, b2 * x - a2 * v
        v += sigma * e[0, b]
        s0, s1, s2 = s0 + v * v, s1 + v * y[back + b], s2 + v * u[back + b]
        y[back + b] = v
        x = u[now + UB + b] * scale
        v = z0 + b0 * x
        z0, z1 = z1 + b1 * x - a1 * v, b2 * x - a2 * v
        v += sigma * e[1, b]
        s0, s1, s2 = s0 + v * v, s1 + v * y[back - UB + b], s2 + v * u[back - UB + b]
        y[back - UB + b] = v
        x = u[now + UB2 + b] * scale
        v = z0 + b0 * x
        z0, z1 = z1 + b1 * x - a1 * v, b2 * x - a2 * v
        v += sigma * e[2, b]
        s0, s1, s2 = s0 + v * v, s1 + v * y[back - UB2 + b], s2 + v * u[back - UB2 + b]
        y[back - UB2 + b] = v
        x = u[now + UB3 + b] * scale
        v = z0 + b0 * x
        z0, z1 = z1 + b1 * x - a1 * v, b2 * x - a2 * v
        v += sigma * e[3, b]
        s0, s1, s2 = s0 + v * v, s1 + v * y[back - UB3 + b], s2 + v * u[back - UB3 + b]
        y[back - UB3 + b] = v
        state[b], state[UB + b] = z0, z1
        state[UB3 + b], state[UB4 + b], state[UB5 + b] = s0, s1, s2


@njit(error_model="numpy", cache=True)
def _one_sample(u, y, t, samples, e, s, state, c):
    """As `_four_samples`, for the samples left over at the end."""
    for b in range(B):
        back = (samples - 1 - t) * B + b
        x = u[t * B + b] * state[2 * B + b]
        v = state[b] + c[0] * x
        state[b] = state[B + b] + c[1] * x - c[3] * v
        state[B + b] = c[2] * x - c[4] * v
        v += c[5] * e[s, b]
        state[3 * B + b] += v * v
        state[4 * B + b] += v * y[back]
        state[5 * B + b] += v * u[back]
        y[back] = v


@njit(error_model="numpy", cache=True)
def _filter_add(u, y, samples, num, den, scale, reverse):
    """y += G (scale u) from rest, reversed in time if asked; transposed direct form II of any order."""
    n = len(num) - 1
    z, x, v = np.zeros((n + 1) * B), np.empty(B), np.empty(B)
    for t in range(samples):
        now = np.uint64(t * B)
        to = np.uint64((samples - 1 - t) * B) if reverse else now
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
def _noise_add(y, samples, weights, num, den, k0, k1, experiment, replicate, divisor, reverse, e, x):
    """y += H (weights' e) / divisor: the noise of one output, white or filtered."""
    for output in range(len(weights)):
        if weights[output] == 0.0:
            continue
        normal_block(k0, k1, samples, output, experiment, replicate, x)
        for b in range(B):
            e[b] = weights[output] / divisor[b]
        _filter_add(x, y, samples, num, den, e, reverse)


@njit(error_model="numpy", cache=True)
def _dot_add(a, b, samples, reverse, out):
    """out += a' b for every run, b reversed in time if asked."""
    for t in range(samples):
        now = np.uint64(t * B)
        to = np.uint64((samples - 1 - t) * B) if reverse else now
        for k in range(UB):
            out[k] += a[now + k] * b[to + k]


@njit(error_model="numpy", nogil=True, cache=True)
def power_block(
    samples, iterations, num, den, noise_num, noise_den, weights, k0, k1, start, replicate, gain, mu, rayleigh,
    signals,
):  # fmt: skip
    """Algorithm 1 for B replicates: weights (1,), gain, mu, rayleigh (B, iterations), signals (2, samples *
    B)."""
    U, V, X = signals[0], signals[1], np.empty(samples * B)
    V[:] = 0.0
    w, e = np.empty((4, B), np.int32), np.empty((4, B), np.float32)
    state, scale, before = np.zeros(6 * B), np.empty(B), np.ones(B)
    one, small = np.ones(B), np.empty(B)
    fused = len(num) == 3 and len(noise_num) == 1
    c = np.zeros(6)
    if fused:
        c[:3], c[3:5], c[5] = num, den[1:], weights[0]
    normal_block(k0, k1, samples, 0, start, replicate, U)
    _dot_add(U, U, samples, False, state[3 * B : 4 * B])
    for b in range(B):
        scale[b] = np.sqrt(samples / state[3 * B + b])
    for m in range(iterations):
        state[:] = 0.0
        state[2 * B : 3 * B] = scale
        if fused:
            for block in range((samples + 3) // 4):
                _words(k0, k1, block, 0, m, replicate, w)
                _normals(w, e)
                if 4 * block + 4 <= samples:
                    _four_samples(U, V, 4 * block, samples, e, state, c)
                else:
                    for s in range(samples - 4 * block):
                        _one_sample(U, V, 4 * block + s, samples, e, s, state, c)
        else:
            W = np.zeros(samples * B)
            _filter_add(U, W, samples, num, den, scale, True)
            _noise_add(W, samples, weights, noise_num, noise_den, k0, k1, m, replicate, one, True, small, X)
            _dot_add(W, W, samples, False, state[3 * B : 4 * B])
            _dot_add(W, V, samples, False, state[4 * B : 5 * B])
            _dot_add(W, U, samples, False, state[5 * B : 6 * B])
            V = W
        for b in range(B):
            square = state[3 * B + b] / samples
            mu[b, m] = square
            rayleigh[b, m] = state[5 * B + b] * scale[b] / samples
            gain[b, m] = state[4 * B + b] * before[b] / (samples * scale[b]) if m else np.nan
            before[b], scale[b] = scale[b], 1 / np.sqrt(square)
        U, V = V, U


@njit(error_model="numpy", nogil=True, cache=True)
def procedure_block(
    samples, iterations, num, den, noise_num, noise_den, weights, k0, k1, start, replicate, scaling, gain, mu,
    energy,
):  # fmt: skip
    """Procedure 2 for B replicates; the two-experiment scheme where there is one channel; num, den (p, q, n +
    1), weights (p, p), gain, mu, energy (B, iterations)."""
    p, q = num.shape[:2]
    size = samples * B
    U, X = np.empty((q, size)), np.empty(size)
    scale, divisor, small = np.empty(B), np.ones(B), np.empty(B)
    total, power = np.zeros(B), np.zeros((p, B))
    for j in range(q):
        normal_block(k0, k1, samples, j, start, replicate, U[j])
        _dot_add(U[j], U[j], samples, False, total)
    for b in range(B):
        scale[b] = np.sqrt(samples / total[b])
    one = np.ones(B)
    for m in range(iterations):
        first = m * (1 + p * q)
        Y, Z = np.zeros((p, size)), np.zeros((q, size))
        power[:] = 0.0
        for i in range(p):
            for j in range(q):
                _filter_add(U[j], Y[i], samples, num[i, j], den[i, j], scale, True)
            _noise_add(
                Y[i], samples, weights[i], noise_num, noise_den, k0, k1, first, replicate, one, True, small, X
            )
            _dot_add(Y[i], Y[i], samples, False, power[i])
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
                _filter_add(Y[i], Z[j], samples, num[i, j], den[i, j], one, True)
                experiment = first + 1 + j * p + i
                _noise_add(
                    Z[j], samples, weights[i], noise_num, noise_den, k0, k1, experiment, replicate, divisor, True,
                    small, X,
                )  # fmt: skip
        total[:] = 0.0
        small[:] = 0.0
        for j in range(q):
            _dot_add(U[j], Z[j], samples, False, small)
            _dot_add(Z[j], Z[j], samples, False, total)
        for b in range(B):
            gain[b, m] = small[b] * scale[b] / samples
            mu[b, m] = np.sqrt(total[b] / samples)
            scale[b] = np.sqrt(samples / total[b])
        U = Z
