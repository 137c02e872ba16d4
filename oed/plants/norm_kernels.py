"""The peak of |B/A| on the unit circle, found and certified by halving cells, compiled: a QZ iteration is long for a few numbers.

On a cell of half width h about c the Taylor coefficients of A and B at q = e^-jc give gamma^2 |A|^2 - |B|^2 to second order in
t = w - c, and bound what is left: |q(t) - q| <= e^|t| - 1, so that A is majorised by sum |alpha_k| (e^t - 1)^k. Where the parabola
exceeds the bound on the whole cell no frequency in it has the gain gamma; else the cell is halved.
"""

import numpy as np
from numba import njit

LINES = 512
"""Lines of the uniform grid at most; fewer where the degree is low, as every degree adds at most one maximum."""
PER_DEGREE = 32
RESOLVED = 0.5
"""What A may change by within a cell, of its size, for its neighbours to show every maximum that a pole makes."""
NARROWEST = 1e-9
"""Half width in rad/sample from which on no cell is halved for a pole: closer poles are no less than 1e-9 from the circle."""
APART = 1e-12
"""Distance of two lines below which they are one: cells and uniform lines meet up to rounding."""
CELLS, ROUNDS = 4000, 30
"""Cells that are tried before another way is taken (40 to 400 are usual), and higher gains that are found on the way."""
ROUNDING = 4.0 * 2.220446049250313e-16
"""Relative rounding of a sum of complex products, per term."""
OK, HIGHER, UNDECIDED = 0, 1, 2
FLAT = 1e-13
"""Relative range of the squared gain below which it is constant (an all-pass plant), which no cell decides."""


@njit(error_model="numpy", cache=True)
def _value(p, q):
    total = 0j
    for k in range(len(p) - 1, -1, -1):
        total = total * q + p[k]
    return total


@njit(error_model="numpy", cache=True)
def _taylor(p, q, out):
    """Taylor coefficients of a polynomial at q, by synthetic division."""
    n = len(p)
    for k in range(n):
        out[k] = p[k]
    for j in range(n - 1):
        for i in range(n - 2, j - 1, -1):
            out[i] += q * out[i + 1]


@njit(error_model="numpy", cache=True)
def _derivatives(b, a, w):
    """|G|^2 with its first two derivatives in frequency."""
    q = complex(np.cos(w), -np.sin(w))
    found = np.zeros((2, 3), dtype=np.complex128)
    for which in range(2):
        p = b if which == 0 else a
        v0 = v1 = v2 = 0j
        for k in range(len(p) - 1, -1, -1):
            v2 = v2 * q + v1
            v1 = v1 * q + v0
            v0 = v0 * q + p[k]
        found[which, 0], found[which, 1], found[which, 2] = v0, -1j * q * v1, -q * v1 - 2.0 * q * q * v2
    g = found[0, 0] / found[1, 0]
    g1 = (found[0, 1] - g * found[1, 1]) / found[1, 0]
    g2 = (found[0, 2] - 2.0 * g1 * found[1, 1] - g * found[1, 2]) / found[1, 0]
    return (
        abs(g) ** 2,
        2.0 * (g.conjugate() * g1).real,
        2.0 * (abs(g1) ** 2 + (g.conjugate() * g2).real),
    )


@njit(error_model="numpy", cache=True)
def _near_poles(a, out):
    """Ends of cells within which A hardly changes, in ascending order; how many."""
    left, count = np.empty(64), 0
    width = np.empty(64)
    left[0], width[0], top = 0.0, np.pi, 1
    alpha = np.empty(len(a), dtype=np.complex128)
    while top > 0 and count < CELLS:
        top -= 1
        x, h = left[top], 0.5 * width[top]
        _taylor(a, complex(np.cos(x + h), -np.sin(x + h)), alpha)
        reach, power, change = np.expm1(h), 1.0, 0.0
        for k in range(1, len(a)):
            power *= reach
            change += abs(alpha[k]) * power
        if change <= RESOLVED * abs(alpha[0]) or h < NARROWEST:
            out[count] = x
            count += 1
        else:  # the left half is looked at first
            left[top], width[top], left[top + 1], width[top + 1] = x + h, h, x, h
            top += 2
    return count


@njit(error_model="numpy", cache=True)
def _root(b, a, x1, x2, f1, f2):
    """Where the slope changes from rising to falling (Chandrupatla 1997: inverse quadratic steps where safe, else halves)."""
    t = f1 / (f1 - f2)
    for _ in range(200):
        x = x1 + t * (x2 - x1)
        f = _derivatives(b, a, x)[1]
        if (f > 0) == (f1 > 0):
            x3, f3 = x1, f1
        else:
            x3, f3, x2, f2 = x2, f2, x1, f1
        x1, f1 = x, f
        least = 4e-16 / max(abs(x2 - x1), 1e-300)
        if least >= 0.5 or f1 == 0.0:
            break
        xi, phi = (x1 - x2) / (x3 - x2), (f1 - f2) / (f3 - f2)
        t = 0.5
        if phi * phi < xi and (1 - phi) ** 2 < 1 - xi:
            t = f1 / (f2 - f1) * f3 / (f2 - f3) + (x3 - x1) / (x2 - x1) * f1 / (f3 - f1) * f2 / (f3 - f2)
        t = min(max(t, least), 1.0 - least)
    return x1 if abs(f1) <= abs(f2) else x2


@njit(error_model="numpy", cache=True)
def _grid(a, degree, near, extra, omega):
    """Frequencies of a uniform grid, of cells that follow the poles and of the extra points: ascending, none twice; how many."""
    stride = 1
    while LINES // (2 * stride) >= PER_DEGREE * degree:
        stride *= 2
    poles, count, i, k = _near_poles(a, near), 0, 0, 0
    for x in extra:  # few: each is moved to its place
        at = poles
        while at > 0 and near[at - 1] > x:
            near[at] = near[at - 1]
            at -= 1
        near[at] = x
        poles += 1
    while i <= LINES:
        x = i * np.pi / LINES
        if k < poles and near[k] < x:
            x = near[k]
            k += 1
        else:
            i += stride
        if count == 0 or x > omega[count - 1] + APART:
            omega[count] = x
            count += 1
    omega[count - 1] = np.pi
    return count


@njit(error_model="numpy", cache=True)
def _tops(b, a, omega, height, found):
    """Places and squared heights of the local maxima between the ends; how many, or -1 where one has no bracket or all are flat."""
    count, least, most = 0, np.inf, 0.0
    for k in range(len(omega)):
        q = complex(np.cos(omega[k]), -np.sin(omega[k]))
        height[k] = abs(_value(b, q)) ** 2 / abs(_value(a, q)) ** 2
        least, most = min(least, height[k]), max(most, height[k])
    if most - least <= FLAT * most:
        return -1
    for k in range(1, len(omega) - 1):
        if not (height[k] >= height[k - 1] and height[k] >= height[k + 1]):
            continue
        low, high = omega[k - 1], omega[k + 1]
        f1, f2, here = _derivatives(b, a, low)[1], _derivatives(b, a, high)[1], 0.0
        if not f1 > 0.0 > f2:
            here = _derivatives(b, a, omega[k])[1]
            if here > 0.0:
                low, f1 = omega[k], here
            else:
                high, f2 = omega[k], here
            if not f1 > 0.0 > f2:
                return -1
        x = _root(b, a, low, high, f1, f2)
        found[count, 0], found[count, 1] = x, _derivatives(b, a, x)[0]
        count += 1
    return count


@njit(error_model="numpy", cache=True)
def _product(a, b):
    """A product and its rounding error (Dekker 1971)."""
    x, s, t = a * b, 134217729.0 * a, 134217729.0 * b
    ah, bh = s - (s - a), t - (t - b)
    return x, (a - ah) * (b - bh) - (((x - ah * bh) - (a - ah) * bh) - ah * (b - bh))


@njit(error_model="numpy", cache=True)
def _sum(a, b):
    """A sum and its rounding error (Knuth)."""
    x = a + b
    t = x - a
    return x, (a - (x - t)) + (b - t)


@njit(error_model="numpy", cache=True)
def _value_doubled(p, q):
    """A polynomial's value as if in twice the digits: Horner's rule with its rounding errors carried along (Graillat et al. 2005)."""
    x, y, sr, si, er, ei = q.real, q.imag, p[len(p) - 1], 0.0, 0.0, 0.0
    for k in range(len(p) - 2, -1, -1):
        (rx, e1), (iy, e2), (ry, e3), (ix, e4) = (
            _product(sr, x),
            _product(si, y),
            _product(sr, y),
            _product(si, x),
        )
        (real, e5), (si, e6) = _sum(rx, -iy), _sum(ry, ix)
        sr, e7 = _sum(real, p[k])
        er, ei = er * x - ei * y + (e1 - e2 + e5 + e7), er * y + ei * x + (e3 + e4 + e6)
    return complex(sr + er, si + ei)


@njit(error_model="numpy", cache=True)
def _majorant(gamma2, alpha, beta, h):
    """Bound on what gamma^2 |A|^2 + |B|^2 has beyond second order within h of the centre, and of its rounding."""
    reach, power = np.expm1(h), 1.0
    A = B = 0.0
    for k in range(max(len(alpha), len(beta))):
        A += abs(alpha[k]) * power if k < len(alpha) else 0.0
        B += abs(beta[k]) * power if k < len(beta) else 0.0
        power *= reach
    whole = gamma2 * A * A + B * B
    parts = 0.0
    for which in range(2):
        c, scale = (alpha, gamma2) if which == 0 else (beta, 1.0)
        c0, c1 = abs(c[0]), abs(c[1]) if len(c) > 1 else 0.0
        c2 = 0.5 * c1 + (abs(c[2]) if len(c) > 2 else 0.0)
        parts += scale * (c0 * c0 + 2.0 * c0 * c1 * h + (2.0 * c0 * c2 + c1 * c1) * h * h)
    return max(whole - parts, 0.0) + ROUNDING * len(alpha) * whole


@njit(error_model="numpy", cache=True)
def _parabola(gamma2, alpha, beta, q, h):
    """gamma^2 |A|^2 - |B|^2 at the centre, and the least value of its expansion to second order within h."""
    R0 = R1 = R2 = 0.0
    for which in range(2):
        c, scale = (alpha, gamma2) if which == 0 else (beta, -1.0)
        c0, c1 = c[0], -1j * q * c[1] if len(c) > 1 else 0j
        c2 = -q * c[1] if len(c) > 1 else 0j
        if len(c) > 2:
            c2 -= 2.0 * q * q * c[2]
        R0 += scale * abs(c0) ** 2
        R1 += 2.0 * scale * (c0.conjugate() * c1).real
        R2 += 2.0 * scale * ((c0.conjugate() * c2).real + abs(c1) ** 2)
    if R2 > 0.0 and abs(R1) < R2 * h:
        return R0, R0 - 0.5 * R1 * R1 / R2
    return R0, R0 - abs(R1) * h + 0.5 * R2 * h * h


@njit(error_model="numpy", cache=True)
def certified(b, a, gamma2):
    """Whether |B/A|^2 < gamma2 at every frequency: OK, or HIGHER with a frequency where it is not, or UNDECIDED."""
    centre, half = np.empty(128), np.empty(128)
    centre[0], half[0], top = 0.5 * np.pi, 0.5 * np.pi, 1
    alpha, beta = np.empty(len(a), dtype=np.complex128), np.empty(len(b), dtype=np.complex128)
    size_a = size_b = 0.0
    for x in a:
        size_a += abs(x)
    for x in b:
        size_b += abs(x)
    terms = ROUNDING * max(len(a), len(b))
    for _ in range(CELLS):
        top -= 1
        c, h = centre[top], half[top]
        q = complex(np.cos(c), -np.sin(c))
        _taylor(a, q, alpha)
        _taylor(b, q, beta)
        beyond = _majorant(gamma2, alpha, beta, h)
        here, least = _parabola(gamma2, alpha, beta, q, h)
        rounding = 2.0 * terms * (gamma2 * abs(alpha[0]) * size_a + abs(beta[0]) * size_b)
        if abs(here) <= rounding or beyond < least <= beyond + rounding:
            alpha[0], beta[0] = _value_doubled(a, q), _value_doubled(b, q)
            here, least = _parabola(gamma2, alpha, beta, q, h)
            rounding *= len(a) * h + len(b) * h + terms  # of the slope, and of what twice the digits leave
            for c0, c1, scale in (
                (alpha[0], alpha[min(1, len(a) - 1)], gamma2),
                (beta[0], beta[min(1, len(b) - 1)], 1.0),
            ):
                rounding += 2.0 * ROUNDING * scale * abs(c0) * (abs(c0) + abs(c1))
        if here < -rounding:
            return HIGHER, c
        if least - rounding <= beyond:
            if top + 2 > len(centre) or h < 1e-15:
                return UNDECIDED, c
            for side in (1.0, -1.0):
                centre[top], half[top] = c + side * 0.5 * h, 0.5 * h
                top += 1
        elif top == 0:
            return OK, c
    return UNDECIDED, 0.0


@njit(error_model="numpy", cache=True)
def response_at(b, a, w, delay):
    """B/A at w behind so many samples of delay, and minus the second derivative of its squared gain."""
    q = complex(np.cos(w), -np.sin(w))
    turn = complex(np.cos(delay * w), -np.sin(delay * w))
    return turn * _value(b, q) / _value(a, q), -_derivatives(b, a, w)[2]


@njit(error_model="numpy", cache=True)
def siso_peak(b, a, tolerance):
    """Local maxima (K, 2), places and squared gains, those between the ends first, then the ends; whether 0 and whether pi is one; and
    whether it is certified that no gain exceeds the highest by more than `tolerance`, relative."""
    degree, rounds = max(len(a), len(b)) - 1, 0
    if degree == 1:  # a quotient of first order in cos w has no maximum inside
        found = np.empty((2, 2))
        for k in range(2):
            q = complex(1.0 - 2.0 * k, 0.0)
            found[k, 0], found[k, 1] = k * np.pi, abs(_value(b, q)) ** 2 / abs(_value(a, q)) ** 2
        low, high = found[0, 1], found[1, 1]
        return found, low > high, high > low, abs(low - high) > FLAT * max(low, high)
    near, every, extra = np.empty(CELLS + ROUNDS), np.empty(CELLS + ROUNDS + LINES + 1), np.empty(ROUNDS)
    while rounds < ROUNDS:
        omega = every[: _grid(a, degree, near, extra[:rounds], every)]
        height, found = np.empty(len(omega)), np.empty((len(omega) + 2, 2))
        count, last = _tops(b, a, omega, height, found), len(omega) - 1
        if count < 0:
            break
        found[count, 0], found[count, 1] = 0.0, height[0]
        found[count + 1, 0], found[count + 1, 1] = omega[last], height[last]
        highest = 0.0
        for k in range(count + 2):
            highest = max(highest, found[k, 1])
        status, extra[rounds] = certified(b, a, highest * (1.0 + tolerance) ** 2)
        if status == OK:
            return found[: count + 2], height[0] >= height[1], height[last] >= height[last - 1], True
        if status == UNDECIDED:
            break
        rounds += 1
    return np.empty((0, 2)), False, False, False
