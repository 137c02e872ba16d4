"""PO-MOESP of one input and one output, plainly: one long QR factor, loops over samples, dense least squares."""

from __future__ import annotations

import numpy as np


def _rows(x, count, columns, first):
    return np.array([x[first + k : first + k + columns] for k in range(count)])


def po_moesp(u, y, horizon: int, order: int, feedthrough: bool):
    """A, B, C, D and the simulated output, the initial state estimated.

    Parameters
    ----------
    u, y : ndarray
        (N,).
    horizon : int
        Block rows.
    order : int
        States.
    feedthrough : bool
        Whether D is free.

    Returns
    -------
    tuple
        A (n, n), B (n, 1), C (1, n), D (1, 1), simulated (N,).
    """
    N, i, n = len(u), horizon, order
    count = N - 2 * i + 1
    Up, Uf, Yp, Yf = (_rows(x, i, count, first) for x in (u, y) for first in (0, i))
    L = np.linalg.qr(np.vstack([Uf, Up, Yp, Yf]).T, mode="r").T
    left, size, _ = np.linalg.svd(L[3 * i :, i : 3 * i])
    G = left[:, :n] * np.sqrt(size[:n])
    A, C = np.linalg.lstsq(G[:-1], G[1:], rcond=None)[0], G[:1]
    columns = np.zeros((N, 2 * n + 1))
    to_b, to_x0 = np.zeros((n, n)), np.eye(n)
    for t in range(N):
        columns[t, :n], columns[t, n : 2 * n], columns[t, -1] = (C @ to_b)[0], (C @ to_x0)[0], u[t]
        to_b, to_x0 = A @ to_b + u[t] * np.eye(n), A @ to_x0
    used = columns if feedthrough else columns[:, :-1]
    theta = np.linalg.lstsq(used, y, rcond=None)[0]
    D = theta[-1] if feedthrough else 0.0
    return A, theta[:n, None], C, np.array([[D]]), used @ theta
