"""The noise of the compiled campaigns, of B runs side by side in every loop: that of `oed.signals.noise`, bit for bit.

Runs are the innermost axis. A signal of one channel is a flat array: sample t of run b at t B + b. Indices are unsigned, because a sign
test in the index would keep the loops scalar."""

import numpy as np
from llvmlite import ir
from numba import njit, types
from numba.extending import intrinsic

from oed.signals.noise import COS, LOG, ROOT_HALF, ROUNDS, SIN

B = 32
"""Runs side by side; two signals of 1000 samples of them fill half of a 1 MB cache."""

BLOCKS = 16
"""Blocks of four samples whose noise is made at once: enough that a loop costs more than its beginning, and all stays in the cache."""

PAIRS = 2 * BLOCKS * B
UB, UB2, UB3, UB4, UB5 = (np.uint64(k * B) for k in range(1, 6))
_f, _i = np.float32, np.int32
M0, M1, LOW, SHIFT = (np.uint64(v) for v in (0xD2511F53, 0xCD9E8D57, 0xFFFFFFFF, 32))
W0, W1 = np.uint64(0x9E3779B9), np.uint64(0xBB67AE85)
L0, L1, L2, L3, L4, L5, L6 = (_f(c) for c in LOG)
S0, S1, S2, S3, S4 = (_f(c) for c in SIN)
C0, C1, C2, C3, C4 = (_f(c) for c in COS)
SCALE, OFFSET, TURN = _f(2.0**-31), _f(2.0**-32), _f(np.pi / 2 * 2.0**-31)
ONE, MINUS_TWO_LN2 = _f(1), _f(-2 * np.log(2))
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
def apart(typingctx):
    """Tell the compiler that no two arguments share memory, and ask for the widest vectors the machine has: without the first, every
    loop would begin by comparing all addresses."""

    def generate(context, builder, sig, args):
        if isinstance(builder.function.attributes, set):
            set.add(builder.function.attributes, '"prefer-vector-width"="512"')
            set.add(builder.function.attributes, "noinline")  # where it is inlined, none of this holds
        for argument in builder.function.args[2:]:  # the first two are where results and errors go
            if isinstance(argument.type, ir.PointerType):
                argument.add_attribute("noalias")
        return context.get_dummy_value()

    return types.void(), generate


@njit(error_model="numpy", cache=True)
def aligned(rows, size):
    """Room (rows, size) that begins where a line of the cache does, so that no vector lies across two."""
    room = np.empty(rows * size + 8)
    begin = (-room.ctypes.data // 8) % 8
    return room[begin : begin + rows * size].reshape(rows, size)


@njit(error_model="numpy", cache=True)
def _words(k0, k1, block, blocks, output, experiment, replicate, radii, angles):
    """Philox4x32-7 for B successive replicates and some successive blocks, into radii and angles (PAIRS,). High words are
    left dirty: the products ignore them."""
    apart()  # pyright: ignore[reportCallIssue]
    for k in range(blocks):
        row = np.uint64(2 * k * B)
        for b in range(UB):
            c0, c1 = np.uint64(block + k), np.uint64(output)
            c2, c3 = np.uint64(experiment), np.uint64(replicate) + b
            a0, a1 = k0, k1
            for _ in range(ROUNDS):
                p0, p1 = (c0 & LOW) * M0, (c2 & LOW) * M1
                c0, c1, c2, c3 = (p1 >> SHIFT) ^ c1 ^ a0, p1, (p0 >> SHIFT) ^ c3 ^ a1, p0
                a0, a1 = (a0 + W0) & LOW, (a1 + W1) & LOW
            radii[row + b], angles[row + b] = _i(np.uint32(c0)), _i(np.uint32(c1))
            radii[row + UB + b], angles[row + UB + b] = _i(np.uint32(c2)), _i(np.uint32(c3))


@njit(error_model="numpy", cache=True)
def _normals(radii, angles, even, odd, blocks):
    """Box-Muller as in `oed.signals.noise`, the same bits: every operation in single precision and rounded once, but for factors of
    two, which round nothing wherever they stand. In three loops, whose chains of operations are short enough to overlap."""
    apart()  # pyright: ignore[reportCallIssue]
    for b in range(blocks * np.uint64(2 * B)):
        u = _f(_i(radii[b] & POSITIVE)) * SCALE + OFFSET
        i = _i(_bits(u) + RAISE)
        odd[b] = _f(_i(_i(i >> N23) - BIAS)) * MINUS_TWO_LN2
        even[b] = _float(_i(_i(i & MANTISSA) + ROOT)) - ONE
    for b in range(blocks * np.uint64(2 * B)):
        m = even[b]
        p = (((((L6 * m + L5) * m + L4) * m + L3) * m + L2) * m + L1) * m + L0
        z = m * m
        p = z * m * p
        even[b] = np.sqrt(odd[b] + (z - (p + p) - (m + m)))
    for b in range(blocks * np.uint64(2 * B)):
        radius = even[b]
        radius = _float(_i(_bits(radius) ^ _i(radii[b] & SIGN)))
        a = _f(angles[b]) * TURN
        z = a * a
        even[b] = radius * ((((C4 * z + C3) * z + C2) * z + C1) * z + C0)
        odd[b] = radius * (a * ((((S4 * z + S3) * z + S2) * z + S1) * z + S0))


@njit(error_model="numpy", cache=True)
def chunk(k0, k1, t, samples, output, experiment, replicate, noise):
    """Standard normals of one output of one experiment, of as many samples from t on as `noise` (`room`) holds; returns their
    number."""
    radii, angles, even, odd = noise
    blocks = min(BLOCKS, (samples - t + 3) // 4)
    _words(k0, k1, t // 4, blocks, output, experiment, replicate, radii, angles)
    _normals(radii, angles, even, odd, np.uint64(blocks))
    return min(4 * BLOCKS, samples - t)


@njit(error_model="numpy", cache=True)
def room():
    """Where `chunk` works: words of radii and of angles, normals of the samples of even and of odd numbers, each (PAIRS,)."""
    room = aligned(4, PAIRS // 2).view(np.float32)
    return room[0].view(np.int32), room[1].view(np.int32), room[2], room[3]


@njit(error_model="numpy", cache=True)
def normal_block(k0, k1, samples, output, experiment, replicate, x):
    """Standard normals of one output of one experiment into x, for B replicates: x (samples * B,)."""
    noise = room()
    for t in range(0, samples, 4 * BLOCKS):
        count = chunk(k0, k1, t, samples, output, experiment, replicate, noise)
        _copy(noise[2], noise[3], x, t, count, np.uint64(len(x) // samples))


@njit(error_model="numpy", cache=True)
def _copy(even, odd, x, t, count, lanes):
    """`lanes` is B, but not known when this is compiled: else the compiler would write the loops out, scalar by scalar."""
    apart()  # pyright: ignore[reportCallIssue]
    for s in range(count):
        row, to = np.uint64(s // 2 * B), np.uint64((t + s) * B)
        if s % 2:
            for b in range(lanes):
                x[to + b] = odd[row + b]
        else:
            for b in range(lanes):
                x[to + b] = even[row + b]


@njit(error_model="numpy", cache=True)
def scaled_add(even, odd, y, back, count, scale):
    """y += scale e, backwards in time from the sample `back` on."""
    apart()  # pyright: ignore[reportCallIssue]
    lanes = np.uint64(len(scale))  # as in `_copy`
    for s in range(count):
        row, to = np.uint64(s // 2 * B), np.uint64((back - s) * B)
        if s % 2:
            for b in range(lanes):
                y[to + b] += odd[row + b] * scale[b]
        else:
            for b in range(lanes):
                y[to + b] += even[row + b] * scale[b]
