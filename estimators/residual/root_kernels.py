"""Compiled: whether the roots of a polynomial are inside the circle."""

from numba import njit


@njit(cache=True)
def inside(f, limit):  # pragma: no cover - compiled
    """Whether all reflection coefficients (Schur, Cohn) of 1 + f1 z^-1 + ..., f (n,) without its leading 1, are below a limit."""
    a = f.copy()
    for m in range(a.shape[0] - 1, -1, -1):
        k = a[m]
        if not abs(k) < limit:
            return False
        b = a[:m][::-1].copy()
        for i in range(m):
            a[i] = (a[i] - k * b[i]) / (1.0 - k * k)
    return True
