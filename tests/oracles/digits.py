"""Losses to sixty digits: the gradient by the quotient rule and elimination, in decimal arithmetic; shares no code."""

from __future__ import annotations

from collections.abc import Iterator
from decimal import Decimal, localcontext

import numpy as np
from numpy.typing import NDArray

from oed.data import Spectrum
from oed.plants.plant import Plant

Pair = tuple[Decimal, Decimal]


def _turned(omega: float) -> Pair:
    """e^-jw by its series, the sum of a double's exact value's powers."""
    x, term, sums = Decimal(omega), Decimal(1), [Decimal(0)] * 4
    for k in range(1, 90):
        sums[(k - 1) % 4] += term
        term *= x / k
    return sums[0] - sums[2], sums[3] - sums[1]


def _times(a: Pair, b: Pair) -> Pair:
    return a[0] * b[0] - a[1] * b[1], a[0] * b[1] + a[1] * b[0]


def _inverse(a: Pair) -> Pair:
    size = a[0] ** 2 + a[1] ** 2
    return a[0] / size, -a[1] / size


def _lines(plant: Plant, omega: NDArray) -> Iterator[list[Pair]]:
    """dG over the noise's deviation at each frequency, by the quotient rule, of one input and one output in white noise."""
    A, B = ([Decimal(float(x)) for x in side[0][0]] for side in (plant.den, plant.num))
    first = int(np.flatnonzero(plant.num[0][0])[0])
    spread = 1 / Decimal(float(plant.noise_covariance[0, 0])).sqrt()
    for w in omega:
        z, powers = _turned(float(w)), [(spread, Decimal(0))]
        for _ in range(max(len(A), len(B))):
            powers.append(_times(powers[-1], z))
        a, b = (
            (sum(c * p[0] for c, p in zip(P, powers)), sum(c * p[1] for c, p in zip(P, powers)))
            for P in (A, B)
        )
        inverse = _inverse((a[0] / spread, a[1] / spread))
        minus_g = _times((-b[0] / spread, -b[1] / spread), _times(inverse, inverse))
        yield [_times(powers[k], inverse) for k in range(first, len(B))] + [
            _times(powers[k], minus_g) for k in range(1, len(A))
        ]


def exact_loss(kind: str, plant: Plant, spectrum: Spectrum, V: NDArray | None = None) -> float:
    """D or A of the lines of one input at a plant of one output in white noise; or trace V' M^-1 V, V (n, s), decimals or not."""
    with localcontext() as context:
        context.prec = 60
        rows = []
        powers = spectrum.power[:, 0, 0].real
        for power, line in zip(powers, _lines(plant, spectrum.omega), strict=True):
            size = Decimal(float(power)).sqrt()
            rows += [[size * x[part] for x in line] for part in (0, 1)]
        n = len(plant.free)
        M = [[sum(row[i] * row[j] for row in rows) for j in range(n)] for i in range(n)]
        return _loss_of(kind, M, np.eye(n) if V is None else V)


def exact_worth(plant: Plant, X: NDArray, omega: NDArray) -> float:
    """The largest worth |X' dG|^2 of a line at some frequencies, X (n, s)."""
    with localcontext() as context:
        context.prec = 60
        columns = [[Decimal(float(x)) for x in column] for column in X.T]
        return max(
            float(
                sum(
                    sum(c * x[part] for c, x in zip(column, line, strict=True)) ** 2
                    for column in columns
                    for part in (0, 1)
                )
            )
            for line in _lines(plant, omega)
        )


def _loss_of(kind: str, M: list[list[Decimal]], V: NDArray) -> float:
    """By elimination, the unit matrix beside M."""
    n, log = len(M), Decimal(0)
    M = [[*row, *(Decimal(int(i == j)) for j in range(n))] for i, row in enumerate(M)]
    for k in range(n):
        pivot = M[k][k]
        log += pivot.ln()
        M[k] = [x / pivot for x in M[k]]
        for i in range(n):
            if i != k:
                factor = M[i][k]
                M[i] = [x - factor * y for x, y in zip(M[i], M[k], strict=True)]
    return float((-log / n).exp()) if kind == "D" else _trace([row[n:] for row in M], V)


def _trace(inverse: list[list[Decimal]], V: NDArray) -> float:
    columns = [[Decimal(x) for x in column] for column in V.T]
    return float(sum(a * b * x for v in columns for a, row in zip(v, inverse) for b, x in zip(v, row)))


def pole_slope(plant: Plant, near: complex) -> NDArray:
    """Derivative of a pole's modulus by the parameters, (n, 1) decimals: Newton's method from a double that is nearly it."""
    with localcontext() as context:
        context.prec = 60
        A, p = [Decimal(float(x)) for x in plant.den[0][0]], (Decimal(near.real), Decimal(near.imag))
        slope = (Decimal(1), Decimal(0))
        for _ in range(8):
            value, slope = (A[0], Decimal(0)), (Decimal(0), Decimal(0))
            for a in A[1:]:  # Horner's rule for the polynomial and its derivative
                turned, moved = _times(slope, p), _times(value, p)
                slope, value = (turned[0] + value[0], turned[1] + value[1]), (moved[0] + a, moved[1])
            step = _times(value, _inverse(slope))
            p = (p[0] - step[0], p[1] - step[1])
        size, power, told = (p[0] ** 2 + p[1] ** 2).sqrt(), (Decimal(-1), Decimal(0)), []
        for _ in A[1:]:  # minus p^(n - k) / A', from the last coefficient to the first
            dp = _times(power, _inverse(slope))
            told.append((p[0] * dp[0] + p[1] * dp[1]) / size)
            power = _times(power, p)
        zeros = [Decimal(0)] * (len(plant.free) - len(told))
        return np.array([[x] for x in [*zeros, *told[::-1]]], dtype=object)
