"""Limits on a spectral density, frequency by frequency, and the density within them that is worth most.

    0 <= Phi(w) <= C(w),   G(w) Phi(w) G(w)^* <= Y(w)   (Hermitian matrices; two-sided densities)

With Phi = R F R^*, C = R R^*, and B = R^* G^* Y^-1 G R these read 0 <= F <= I and B^1/2 F B^1/2 <= I. Worth T gives
tr[T Phi] at most tr [R^* T R]_+ under the first alone, by projection; under both, by Newton's method on the barrier

    tr(R^* T R F) / mu + log det F + log det(I - F) + log det(I - B^1/2 F B^1/2),

all frequencies at once; whatever the multiplier Gamma, tr Gamma + tr [R^* T R - B^1/2 Gamma B^1/2]_+ bounds the worth.
"""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from oed.design.problem.information_maps import InformationMap
from oed.errors import InputError

Mask = Callable[[NDArray[np.float64]], NDArray[Any]]
SINGULAR = 1e-12
"""Eigenvalues of an output mask below this share of its largest count as this share: their inverse is needed."""
BARRIER = 1e-8
"""Last weight of the barrier relative to the worth: it costs three times the number of inputs of it."""
SHRINK = 0.2
"""What the barrier's weight is multiplied by from one centre to the next."""
CENTRED = 15
"""Most Newton steps to a centre; from the last one it takes four to eight."""


@dataclass(frozen=True, eq=False)
class Masks:
    """Both masks of a plant, and a ceiling on the density where they leave it free. `information` the plant;
    `on_input, on_output` omega (K,) -> (K,) for one channel, or Hermitian matrices; `ceiling` larger
    eigenvalues of the limit, infinite ones too, count as this."""

    information: InformationMap
    on_input: Mask | None
    on_output: Mask | None
    ceiling: float

    def at(self, omega: NDArray[np.float64]) -> tuple[NDArray, NDArray | None]:
        """R (K, nu, nu) with C = R R^*, and B (K, nu, nu) or None where the first mask alone says it all."""
        nu = self.information.n_inputs
        C = np.broadcast_to(self.ceiling * np.eye(nu, dtype=complex), (len(omega), nu, nu))
        if self.on_input is not None:
            C = _below(_checked(self.on_input, omega, nu, "input mask"), self.ceiling)
        if self.on_output is None:
            return hermitian_root(C), None
        G = self.information.gain(omega)
        Y = _checked(self.on_output, omega, G.shape[1], "output mask")
        values, vectors = np.linalg.eigh(np.where(np.isfinite(Y), Y, 0.0))
        values = np.where(np.isinf(Y).reshape(len(Y), -1).any(axis=1, keepdims=True), np.inf, values)
        # Where the output may have no power at all, neither may the input.
        shut = ~(values[:, -1] > 0)
        values = np.where(shut[:, None], 1.0, values)
        least = SINGULAR * np.where(np.isfinite(values), values, 0.0)[:, -1:]
        half = (vectors / np.sqrt(np.maximum(values, least))[:, None, :]).conj().swapaxes(1, 2) @ G
        C = np.where(shut[:, None, None], 0.0, C)
        if nu == 1:
            limit = np.sum(np.abs(half) ** 2, axis=(1, 2))
            with np.errstate(divide="ignore"):
                return np.sqrt(np.minimum(C.real, 1 / limit[:, None, None])).astype(complex), None
        inverse = half.conj().swapaxes(1, 2) @ half
        if self.on_input is None:
            values, vectors = np.linalg.eigh(inverse)
            root = vectors / np.sqrt(np.maximum(values, 1 / self.ceiling))[:, None, :]
            return np.where(shut[:, None, None], 0.0, root), None
        R = hermitian_root(C)
        return R, R.conj().swapaxes(1, 2) @ inverse @ R

    def most(self, R: NDArray, B: NDArray | None, T: NDArray) -> tuple[NDArray, NDArray[np.float64]]:
        """The density (K, nu, nu) of largest worth tr(T Phi), and a bound (K,) on the worth of every other."""
        turned = R.conj().swapaxes(1, 2) @ T @ R
        turned = (turned + turned.conj().swapaxes(1, 2)) / 2
        if B is None:
            values, vectors = np.linalg.eigh(turned)
            half = (R @ vectors) * (values > 0)[:, None, :]
            return half @ half.conj().swapaxes(1, 2), np.clip(values, 0, None).sum(axis=1)
        F, bound = _within_both(turned, hermitian_root(B))
        return R @ F @ R.conj().swapaxes(1, 2), bound


def _below(C: NDArray, ceiling: float) -> NDArray:
    """The mask with its eigenvalues cut at the ceiling; infinite values of a scalar mask are the ceiling."""
    if C.shape[1] == 1:
        return np.minimum(C.real, ceiling).astype(complex)
    values, vectors = np.linalg.eigh(C)
    return (vectors * np.clip(values, 0, ceiling)[:, None, :]) @ vectors.conj().swapaxes(1, 2)


def hermitian_root(matrices: NDArray) -> NDArray:
    """Hermitian square roots."""
    values, vectors = np.linalg.eigh(matrices)
    root = (vectors * np.sqrt(np.clip(values, 0, None))[:, None, :]) @ vectors.conj().swapaxes(1, 2)
    return np.asarray(root, dtype=np.complex128)


def _basis(nu: int) -> NDArray:
    """Orthonormal Hermitian matrices, (nu^2, nu, nu)."""
    found = []
    for i in range(nu):
        for j in range(nu):
            E = np.zeros((nu, nu), dtype=complex)
            E[i, j] += 1 if i == j else np.sqrt(0.5) * (1 if i < j else 1j)
            E[j, i] += 0 if i == j else np.sqrt(0.5) * (1 if i < j else -1j)
            found.append(E)
    return np.stack(found)


def _within_both(T: NDArray, root: NDArray) -> tuple[NDArray, NDArray[np.float64]]:
    """F of largest tr(T F) with 0 <= F <= I and root F root <= I, and a bound on it; (K, nu, nu) each."""
    K, nu = T.shape[:2]
    eye, E = np.eye(nu), _basis(nu)
    flat = E.reshape(nu**2, -1).conj()
    turned = root[:, None] @ E @ root[:, None]
    size = np.maximum(np.abs(np.linalg.eigvalsh(T)).max(axis=1), 1e-300)[:, None, None]
    T, largest = T / size, np.linalg.eigvalsh(root @ root)[:, -1]
    F, mu = (0.5 / (1 + largest))[:, None, None] * eye, 1.0
    coordinates = lambda A: (A.reshape(K, -1) @ flat.T).real
    while mu > BARRIER:
        mu *= SHRINK
        for _ in range(CENTRED):
            P, Q, W = (np.linalg.inv(part) for part in (F, eye - F, eye - root @ F @ root))
            g = coordinates(T / mu + P - Q - root @ W @ root)
            curved = P[:, None] @ E @ P[:, None] + Q[:, None] @ E @ Q[:, None]
            outer = root @ W
            curved = curved + outer[:, None] @ turned @ outer.conj().swapaxes(1, 2)[:, None]
            H = (curved.reshape(K, nu**2, -1) @ flat.T).real
            step = _newton_step((H + H.swapaxes(1, 2)) / 2, g)
            # A damped Newton step stays inside a self-concordant barrier's set; the longest that does so is better.
            decrement = np.sqrt(np.maximum(np.sum(step * g, axis=1), 0))
            dF = np.einsum("ke,eij->kij", step, E)
            shrunk = np.stack([-P @ dF, Q @ dF, W @ root @ dF @ root])
            reach = 0.9 / np.maximum(np.abs(np.linalg.eigvals(shrunk)).max(axis=(0, 2)), 1e-300)
            length = np.where(decrement < 0.25, 1.0, np.maximum(1 / (1 + decrement), np.minimum(reach, 1.0)))
            F = F + length[:, None, None] * dF
            # The multiplier of the last centre is the certificate: it is solved for, the others are passed.
            if decrement.max() < (0.5 if mu > BARRIER else 1e-6):
                break
    W = np.linalg.inv(eye - root @ F @ root)
    rest = np.linalg.eigvalsh(T - mu * root @ W @ root)
    bound = mu * np.einsum("kii->k", W).real + np.clip(rest, 0, None).sum(axis=1)
    return F, bound * size[:, 0, 0]


def _newton_step(H: NDArray[np.float64], g: NDArray[np.float64]) -> NDArray[np.float64]:
    """(K, n) H^-1 g; where rounding leaves a curvature singular, at a corner of the set, its least curvatures are at rounding.

    The bound holds at any F: a step only makes it tighter.
    """
    try:
        return np.asarray(np.linalg.solve(H, g[:, :, None])[:, :, 0], dtype=np.float64)
    except np.linalg.LinAlgError:
        values, V = np.linalg.eigh(H)
        values = np.maximum(values, np.finfo(float).eps * values[:, -1:])
        return np.asarray(
            np.einsum("kij,kj->ki", V, np.einsum("kij,ki->kj", V, g) / values), dtype=np.float64
        )


def _checked(mask: Mask, omega: NDArray[np.float64], size: int, name: str) -> NDArray:
    """Values (K, size, size) of a mask; an InputError where it is no bound on a spectrum."""
    values = np.asarray(mask(omega))
    if size == 1 and values.ndim == 1:
        if np.iscomplexobj(values) or values.shape != omega.shape or not (values >= 0).all():
            raise InputError(
                f"the {name} has the shape {values.shape} and values from {values.min()} on; for one channel it must "
                f"be real, at least 0 and of shape {omega.shape}."
            )
        return values.astype(complex)[:, None, None]
    wanted = (len(omega), size, size)
    if values.shape != wanted or not np.isfinite(values).all():
        raise InputError(
            f"the {name} has the shape {values.shape}; for this plant it must be finite and {wanted}: "
            "(frequencies, channels, channels)."
        )
    values = values.astype(complex)
    scale = max(float(np.abs(values).max()), 1e-300)
    skew = np.abs(values - values.conj().swapaxes(1, 2)).max(axis=(1, 2))
    if skew.max() > 1e-9 * scale:
        at = omega[int(np.argmax(skew))]
        raise InputError(
            f"the {name} is not Hermitian at {at:.6g} rad/sample (by {skew.max():g}); a bound on a spectrum must be: "
            "make every entry the conjugate of its transpose's, as (C + C^H) / 2 is."
        )
    lowest = np.linalg.eigvalsh(values)[:, 0]
    if lowest.min() < -1e-9 * scale:
        at = omega[int(np.argmin(lowest))]
        raise InputError(
            f"the {name} has the negative eigenvalue {lowest.min():g} at {at:.6g} rad/sample; no spectrum lies below it: "
            "make it positive semidefinite."
        )
    return values
