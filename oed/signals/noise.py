"""Noise as a pure function of (seed, plant, replicate, experiment, output, sample).

Every method that is compared meets the same noise, in any order and on any number of workers, because
each sample is computed from its own coordinates: a counter-based generator (Philox4x32-7) turns them
into uniform numbers and the Box-Muller formula into normal ones.

    key     = 64 bits of BLAKE2b(seed, plant name)
    counter = (sample // 4, output, experiment, replicate), 32 bits each
    four words of 32 bits -> four normals, samples 4b ... 4b + 3

Of two words, the first gives the radius (31 bits) and a sign, the second an angle in [-pi/2, pi/2). Logarithm,
sine and cosine are polynomials in single precision, evaluated as written: the same bits wherever IEEE arithmetic
is used, which is what lets the compiled campaigns (`estimators.montecarlo.engine`) meet the same noise as the plain loop.
A normal of radius r differs from the exact formula's by at most 1e-6 + 1e-7 / r, far below what any sample shows.

Source: Salmon, Moraes, Dror, Shaw, "Parallel random numbers: as easy as 1, 2, 3", SC 2011, Sec. 3.3 and
Table 2: seven rounds pass every test of BigCrush. The polynomials are our own minimax fits."""

from collections.abc import Sequence
from hashlib import blake2b

import numpy as np
from numpy.typing import NDArray

from oed.errors import InputError

ROUNDS = 7
START = 0xFFFFFFFF
"""Number of the experiment whose noise is the white start of the iterations, by input channel."""

# log(1 + m) = m - m^2/2 + m^3 P(m), |m + 1| in [sqrt(1/2), sqrt(2)]; sin a = a P(a^2), cos a = P(a^2) on [-pi/2, pi/2].
LOG = (
    0.3333385602440021, -0.25001745454952473, 0.19965465902831492, -0.16565693472443777, 0.14876370170577985,
    -0.14349659227078418, 0.08918825775237947,
)  # fmt: skip
SIN = (
    0.9999999810643015,
    -0.16666649524769003,
    0.008332923908114753,
    -0.00019802090541244655,
    2.5925092284051487e-06,
)
COS = (
    0.999999953468684,
    -0.4999990534788844,
    0.0416635847009178,
    -0.0013853704328716798,
    2.3153931637764913e-05,
)
ROOT_HALF = 0x3F3504F3  # the bits of sqrt(1/2) in single precision

_MULTIPLIERS = np.uint64(0xD2511F53), np.uint64(0xCD9E8D57)
_WEYL = 0x9E3779B9, 0xBB67AE85
_LOW = np.uint64(0xFFFFFFFF)
_SHIFT = np.uint64(32)


def noise_key(seed: int, plant: str) -> tuple[int, int]:
    """Key of the noise of a plant under a seed: two 32-bit words."""
    if not isinstance(seed, int | np.integer):
        raise InputError(f"the seed is {seed!r}; it must be a whole number.")
    digest = blake2b(f"{int(seed)}|{plant}".encode(), digest_size=8).digest()
    return int.from_bytes(digest[:4], "little"), int.from_bytes(digest[4:], "little")


def philox(
    counter: tuple[NDArray[np.uint64], ...], key: tuple[int, int], rounds: int = ROUNDS
) -> tuple[NDArray[np.uint64], NDArray[np.uint64], NDArray[np.uint64], NDArray[np.uint64]]:
    """Philox4x32 on arrays of counters."""
    c0, c1, c2, c3 = counter
    k0, k1 = key
    for _ in range(rounds):
        p0, p1 = c0 * _MULTIPLIERS[0], c2 * _MULTIPLIERS[1]
        c0, c1, c2, c3 = (
            (p1 >> _SHIFT) ^ c1 ^ np.uint64(k0),
            p1 & _LOW,
            (p0 >> _SHIFT) ^ c3 ^ np.uint64(k1),
            p0 & _LOW,
        )
        k0, k1 = (k0 + _WEYL[0]) & 0xFFFFFFFF, (k1 + _WEYL[1]) & 0xFFFFFFFF
    return c0, c1, c2, c3


def standard_noise(
    key: tuple[int, int], replicate: int, experiment: int, n_samples: int, n_outputs: int = 1
) -> NDArray[np.float64]:
    """Standard normal noise of one experiment: returns (n_samples, n_outputs)."""
    return noise_series(key, replicate, [experiment], n_samples, n_outputs)[0]


def noise_series(
    key: tuple[int, int], replicate: int, experiments: Sequence[int], n_samples: int, n_outputs: int = 1
) -> NDArray[np.float64]:
    """Standard normal noise of several experiments at once: returns (experiments, n_samples, n_outputs)."""
    number = np.asarray(experiments, dtype=np.uint64)[:, None, None]
    block = np.arange(-(-n_samples // 4), dtype=np.uint64)[:, None]
    output = np.arange(n_outputs, dtype=np.uint64)
    shape = (len(number), len(block), n_outputs)
    counter = (block, output, number, np.uint64(replicate))
    x = philox(tuple(np.broadcast_to(c, shape) for c in counter), key)
    normals = np.empty((len(number), len(block), 4, n_outputs))
    for pair in (0, 1):
        normals[:, :, 2 * pair], normals[:, :, 2 * pair + 1] = _box_muller(x[2 * pair], x[2 * pair + 1])
    return normals.reshape(len(number), -1, n_outputs)[:, :n_samples]


def _box_muller(first: NDArray[np.uint64], second: NDArray[np.uint64]) -> tuple[NDArray, NDArray]:
    """Two normals of two words, in single precision; every operation rounds once."""
    one = np.float32  # every constant too, so that nothing is widened
    x, v = (word.astype(np.uint32).view(np.int32) for word in (first, second))
    uniform = (x & np.int32(0x7FFFFFFF)).astype(one) * one(2.0**-31) + one(2.0**-32)
    bits = uniform.view(np.int32) + np.int32(0x3F800000 - ROOT_HALF)
    exponent = ((bits >> np.int32(23)) - np.int32(127)).astype(one)
    m = ((bits & np.int32(0x007FFFFF)) + np.int32(ROOT_HALF)).view(one) - one(1)
    square = m * m
    log = exponent * one(np.log(2)) + (m + (square * m * _horner(LOG, m) - one(0.5) * square))
    radius = np.sqrt(one(-2) * log)
    radius = (radius.view(np.int32) ^ (x & np.int32(-(2**31)))).view(one)
    angle = v.astype(one) * one(np.pi / 2 * 2.0**-31)
    square = angle * angle
    return radius * _horner(COS, square), radius * (angle * _horner(SIN, square))


def _horner(coefficients: tuple[float, ...], x: NDArray) -> NDArray:
    value = np.full_like(x, coefficients[-1])
    for c in coefficients[-2::-1]:
        value = value * x + np.float32(c)
    return value
