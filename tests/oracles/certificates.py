"""What certificates are challenged with: random plants beyond the usual, their gradients by the quotient rule, dense grids.

Shares no code with `oed.design`: sums over grids that are fine around every pole, triangular factors, no iteration.
"""

from __future__ import annotations

import numpy as np

from oed.data import Spectrum
from oed.plants.plant import Plant
from tests.oracles.digits import exact_worth

DENSE = 8001
HIGHEST = 40  # of the dense grid's prices, those that are worked out to sixty digits


def hard_plant(rng: np.random.Generator, channels: int = 1, most: int = 20) -> Plant:
    """Order to `most`, poles to radius .9999, zeros on the circle, delays to 30, noise from 1e-4 to 1e4."""

    def roots(order: int, radii) -> np.ndarray:
        found = []
        while len(found) < order:
            pole = radii() * np.exp(1j * rng.uniform(0.05, 3.09))
            pair = [pole, pole.conjugate()]
            found += pair if order - len(found) > 1 else [rng.choice([-1, 1]) * min(abs(pole), 0.95)]
        return np.atleast_1d(np.poly(found)).real

    num, den = [], []
    for _ in range(channels):
        num.append([])
        den.append([])
        for _ in range(channels):
            order = int(rng.integers(1, most + 1))
            den[-1].append(roots(order, lambda: 1 - 10 ** rng.uniform(-4, -0.3)))
            top = roots(
                int(rng.integers(0, order + 1)), lambda: 1.0 if rng.uniform() < 0.5 else rng.uniform(0.2, 2)
            )
            num[-1].append(np.concatenate([np.zeros(int(rng.integers(1, 31))), rng.uniform(0.1, 10) * top]))
    return Plant(num, den, noise_covariance=10 ** rng.uniform(-4, 4), name="hard")


def gradient(plant: Plant, omega: np.ndarray) -> np.ndarray:
    """dG over the noise's deviation, (K, n, ny, nu): d/db = z^-k / A, d/da = -B z^-k / A^2, A from its roots."""
    z = np.exp(-1j * np.asarray(omega))
    columns = []
    for i, row in enumerate(plant.den):
        for j, A in enumerate(row):
            B = plant.num[i][j]
            # As a product over the roots the small values of A beside a sharp pole keep their digits.
            bottom = np.prod(1 - np.roots(A)[:, None] * z, axis=0) if len(A) > 1 else np.ones(len(z))
            top = np.polyval(B[::-1], z)
            for k, slope in [(k, 1 / bottom) for k in range(np.flatnonzero(B)[0], len(B))] + [
                (k, -top / bottom**2) for k in range(1, len(A))
            ]:
                columns.append(np.zeros((len(z), plant.n_outputs, plant.n_inputs), dtype=complex))
                columns[-1][:, i, j] = slope * z**k
    return np.stack(columns, axis=1) / np.sqrt(plant.noise_covariance[0, 0])


def dense_grid(plant: Plant, low: float = 0.0, high: float = np.pi) -> np.ndarray:
    """Uniform, and around every pole from a hundredth of its distance from the circle to thirty times that."""
    parts = [np.linspace(low, high, DENSE)]
    for den in (den for row in plant.den for den in row):
        for pole in np.roots(den):
            steps = (1 - abs(pole)) * np.geomspace(0.01, 100, 300)
            parts.append(abs(np.angle(pole)) + np.concatenate([-steps, [0.0], steps]))
    omega = np.unique(np.concatenate(parts))
    return omega[(omega >= low) & (omega <= high)]


def least_condition(plant: Plant, spectrum: Spectrum, points: int) -> float:
    """The least condition number of weights on a spectrum's own lines and on a grid in several directions, by CVXPY."""
    import cvxpy

    nu = plant.n_inputs
    phases = np.array([[1, phase] for phase in (0, 1, -1, 1j, -1j)] + [[0, 1]], dtype=complex)
    turns = np.ones((1, 1)) if nu == 1 else phases
    own = np.moveaxis(np.linalg.eigh(spectrum.power)[1], 1, 2)
    grid = np.linspace(0, np.pi, points)
    D = np.concatenate([
        np.einsum("knpq,kdq->kdnp", gradient(plant, spectrum.omega), own).reshape(-1, *gradient(plant, grid).shape[1:3]),
        np.einsum("knpq,dq->kdnp", gradient(plant, grid), turns).reshape(-1, *gradient(plant, grid).shape[1:3]),
    ])  # fmt: skip
    atoms = np.einsum("mnp,mkp->mnk", D, D.conj()).real
    n = atoms.shape[1]
    atoms /= np.trace(atoms, axis1=1, axis2=2)[:, None, None]
    w, t = cvxpy.Variable(len(atoms), nonneg=True), cvxpy.Variable()
    M = cvxpy.reshape(atoms.reshape(-1, n * n).T @ w, (n, n), order="C")
    cvxpy.Problem(cvxpy.Maximize(t), [M >> t * np.eye(n), M << np.eye(n)]).solve(solver="CLARABEL")
    return float(1 / t.value)


class Challenge:
    """A plant in coordinates in which the dense grid's mean information is the identity."""

    def __init__(self, plant: Plant) -> None:
        self.plant, self.omega = plant, dense_grid(plant)
        D = gradient(plant, self.omega)
        self.n = D.shape[1]
        flat = np.moveaxis(D, 1, 0).reshape(self.n, -1)
        rows = np.concatenate([flat.real, flat.imag], axis=1).T / np.sqrt(len(D))
        unit = np.linalg.norm(rows, axis=0)
        self.R = np.linalg.qr(rows / unit, mode="r") * unit
        self.D = np.linalg.solve(self.R.T, flat).reshape(self.n, len(D), *D.shape[2:]).swapaxes(0, 1)

    @property
    def rounding(self) -> float:
        """How far from the identity the mean information is in its own coordinates: what the sums are worth."""
        flat = np.moveaxis(self.D, 1, 0).reshape(self.n, -1)
        return float(np.abs((flat @ flat.conj().T).real / len(self.D) - np.eye(self.n)).max())

    def information(self, spectrum) -> np.ndarray:
        """Scaled information of a spectrum's lines."""
        F = np.linalg.solve(self.R.T, self._factor(spectrum))
        return (F @ F.conj().T).real

    def _factor(self, spectrum) -> np.ndarray:
        """F of the information F F^*, (n, k) complex."""
        D = gradient(self.plant, spectrum.omega)
        unit = np.sqrt(np.maximum(np.einsum("kii->ki", spectrum.power).real, 1e-300))
        values, vectors = np.linalg.eigh(spectrum.power / (unit[:, :, None] * unit[:, None, :]))
        half = D @ (unit[:, :, None] * vectors * np.sqrt(np.clip(values, 0, None))[:, None, :])[:, None]
        return np.moveaxis(half, 1, 0).reshape(self.n, -1)

    def condition(self, spectrum) -> float:
        """Condition number of the information about the parameters themselves, from its factor's singular values."""
        F = self._factor(spectrum)
        sizes = np.linalg.svd(np.concatenate([F.real, F.imag], axis=1), compute_uv=False)
        return float((sizes[0] / sizes[-1]) ** 2)

    def loss(self, kind: str, M: np.ndarray) -> float:
        """D, A or E of the parameters themselves, from the scaled information."""
        if kind == "D":
            return float(
                np.exp(-(np.linalg.slogdet(M)[1] + 2 * np.log(np.abs(np.diag(self.R))).sum()) / self.n)
            )
        half = np.linalg.inv(np.linalg.cholesky(M)) @ np.linalg.inv(self.R).T
        return float(np.sum(half**2) if kind == "A" else np.linalg.norm(half, 2) ** 2)

    def loss_of(self, V: np.ndarray, M: np.ndarray, determinant: bool) -> float:
        """Of combinations V, from below: directions of the information that rounding may have made are taken for known."""
        values, vectors = np.linalg.eigh(M)
        seen = values > 1e-9 * values[-1]
        half = (vectors.T @ np.linalg.solve(self.R.T, V))[seen] / np.sqrt(values[seen])[:, None]
        if not determinant:
            return float(np.sum(half**2))
        return float(np.exp(np.linalg.slogdet(half.T @ half)[1] / V.shape[1]))

    def worst_variance(self, M: np.ndarray) -> float:
        """Largest variance of the frequency response on the dense grid."""
        half = np.linalg.solve(np.linalg.cholesky(M), np.moveaxis(self.D, 1, 0).reshape(self.n, -1))
        told = np.sum(np.abs(half.reshape(self.n, len(self.D), -1)) ** 2, axis=(0, 2))
        return float(told.max()) * self.plant.noise_covariance[0, 0]

    def mean_variance(self, M: np.ndarray) -> float:
        """Mean variance of the frequency response over the band: five nodes on each of the dense grid's intervals, no matrix
        of weights."""
        x, weight = np.polynomial.legendre.leggauss(5)
        edges = self.omega[:: max(1, len(self.omega) // 3000)]
        edges = np.concatenate([[0.0], edges[1:-1], [np.pi]])
        half = np.diff(edges)[:, None] / 2
        D = gradient(self.plant, ((edges[1:] + edges[:-1])[:, None] / 2 + half * x).ravel())
        D = np.linalg.solve(self.R.T, np.moveaxis(D, 1, 0).reshape(self.n, -1))
        told = np.linalg.solve(np.linalg.cholesky(M), D).reshape(self.n, half.size, 5, -1)
        parts = np.sum(np.abs(told) ** 2, axis=(0, 3)) * half * weight
        return float(parts.sum()) / np.pi * self.plant.noise_covariance[0, 0]

    def bound(self, design) -> float:
        """The certificate's bound, its prices maximised over the dense grid: power limited only, no prior."""
        X = self.R @ design.certificate.X
        E = np.einsum("knpq,ns->kspq", self.D, X, optimize=True).reshape(len(self.D), -1, self.D.shape[3])
        worth = np.linalg.norm(E, 2, axis=(1, 2)) ** 2
        told = design.criterion.numerator(design.certificate.X) / design.limits["input power"]
        if design.bound > told / worth.max() and self.plant.n_inputs * self.plant.n_outputs == 1:
            # These sums may be off by ten times their rounding: sixty digits decide, where they are highest.
            near = np.union1d(self.omega[np.argsort(-worth)[:HIGHEST]], design.spectrum.omega)
            return told / exact_worth(self.plant, design.certificate.X, near)
        return told / worth.max()

    def price(self, kind: str, M: np.ndarray) -> float:
        """How much more than its share a line tells, at most: 1 at the optimum (D and A)."""
        Y = np.linalg.inv(M)
        W = Y if kind == "D" else Y @ np.linalg.inv(self.R @ self.R.T) @ Y
        L = np.linalg.cholesky(W + 1e-300 * np.eye(self.n))
        E = np.einsum("knpq,ns->kspq", self.D, L, optimize=True).reshape(len(self.D), -1, self.D.shape[3])
        return float(np.linalg.norm(E, 2, axis=(1, 2)).max() ** 2 / np.sum(W * M))

    def bound_within(self, design, height: float) -> float:
        """The certificate's bound where no density exceeds `height`: its integral on panels that close in on every kink."""
        nu, limit = design.certificate.multipliers["input power"], design.limits["input power"]
        X = self.R @ design.certificate.X

        def worth(omega: np.ndarray) -> np.ndarray:
            flat = np.moveaxis(gradient(self.plant, omega), 1, 0).reshape(self.n, -1)
            D = np.linalg.solve(self.R.T, flat).reshape(self.n, len(omega), -1, self.plant.n_inputs)
            E = np.einsum("nkpq,ns->kspq", D, X).reshape(len(omega), -1, self.plant.n_inputs)
            values = np.linalg.eigvalsh(np.einsum("kmp,kmq->kpq", E.conj(), E))
            return np.clip(values - nu / limit, 0, None).sum(axis=1) * height

        x, weight = np.polynomial.legendre.leggauss(8)
        total, edges = 0.0, self.omega[:: max(1, len(self.omega) // 4000)]
        low, high = edges[:-1], np.append(edges[1:-1], np.pi)
        low = np.append(0.0, low[1:])
        for _ in range(14):
            half = (high - low)[:, None] / 2
            told = worth(((low + high)[:, None] / 2 + half * x).ravel()).reshape(half.size, -1)
            # Where the worth is cut off inside a panel the rule is of second order: those panels are halved.
            kinked = (told.min(axis=1) == 0) & (told.max(axis=1) > 0)
            total += float(np.sum((half * weight * told)[~kinked]))
            middle = (low + high)[kinked] / 2
            last = float(np.sum((half * weight * told)[kinked]))
            low, high = np.append(low[kinked], middle), np.append(middle, high[kinked])
            if not len(low):
                return design.criterion.numerator(design.certificate.X) / (nu + total / np.pi)
        return design.criterion.numerator(design.certificate.X) / (nu + (total + last) / np.pi)

    def rivals(self, design, rng: np.random.Generator, count: int = 30) -> float:
        """The least worst variance of spectra near a design: its lines with other weights, and a few lines more."""
        power, least = design.spectrum.power, np.inf
        extra = rng.choice(self.omega, 3)
        omega = np.append(design.spectrum.omega, extra)
        eye = np.broadcast_to(np.eye(self.plant.n_inputs), (3, *power.shape[1:]))
        for step in np.geomspace(1e-4, 1, count):
            weights = np.exp(step * rng.normal(size=len(power)))[:, None, None]
            mixed = np.concatenate([power * weights, eye * step * 1e-2])
            mixed *= design.limits["input power"] / np.einsum("kii->", mixed).real
            least = min(least, self.worst_variance(self.information(Spectrum(omega, mixed))))
        return least
