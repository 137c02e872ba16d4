"""At which frequencies a plant's gain equals a level: eigenvalues on the unit circle of a symplectic pencil."""

import numpy as np
from numpy.typing import NDArray

from oed.errors import InputError, SolverFailure
from oed.plants.plant import Plant
from oed.plants.realisations import n_states, state_space

LARGEST = 400
"""States of a plant whose level-set test is made: its pencil is twice that size, a minute of one core."""


def crossings(plant: Plant, level: float) -> NDArray[np.float64]:
    """Frequencies in [0, pi] where some singular value of G may equal the level (empty certifies a bound)."""
    n, nu = n_states(plant, delays=False), plant.n_inputs
    if n > LARGEST:
        raise InputError(
            f"the plant has {n} states, and the certificate of its largest gain is computed for at most {LARGEST}: lower "
            "its order, or cut its impulse response."
        )
    A, B, C, D = state_space(plant, delays=False)
    M = np.block(
        [
            [A, np.zeros((n, n)), B],
            [np.zeros((n, n)), np.eye(n), np.zeros((n, nu))],
            [D.T @ C, B.T, D.T @ D - level**2 * np.eye(nu)],
        ]
    )
    N = np.block([[np.eye(n), np.zeros((n, n + nu))], [C.T @ C, A.T, C.T @ D], [np.zeros((nu, 2 * n + nu))]])
    alpha, beta = _generalised_eigenvalues(M, N)
    a, b = np.abs(alpha), np.abs(beta)
    on_circle = (np.abs(a - b) / np.maximum(np.maximum(a, b), 1e-300) < 1e-6) & (b > 1e-12)
    return np.sort(np.abs(np.angle(alpha[on_circle] / beta[on_circle])))


def _generalised_eigenvalues(M: NDArray, N: NDArray) -> NDArray[np.complex128]:
    """Pairs (alpha, beta) with beta M x = alpha N x, where the QZ iteration needs a second start on some pencils."""
    from scipy.linalg import LinAlgError, eig

    # Entries that no sum can feel only underflow inside the iteration and stall it.
    flush = lambda X: np.where(np.abs(X) < 1e-150 * np.abs(X).max(), 0.0, X)
    M, N = flush(M), flush(N)
    for attempt in range(3):
        try:
            return np.asarray(eig(M, N, right=False, homogeneous_eigvals=True))
        except LinAlgError:
            # Rotations from both sides keep every eigenvalue and give the iteration another start.
            rng = np.random.default_rng(attempt)
            left, right = (np.linalg.qr(rng.standard_normal(M.shape))[0] for _ in range(2))
            M, N = left @ M @ right, left @ N @ right
    raise SolverFailure(
        f"the eigenvalues of the level-set pencil of size {len(M)} did not converge from three starts, so the "
        "H-infinity norm has no certificate: rescale the plant's channels or lower its order."
    )
