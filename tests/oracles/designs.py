"""Optimal input spectra the slow way, for SISO plants in white noise of variance 1 and unit input power.

D and A: the multiplicative algorithm on a grid, then the lines themselves are moved; the equivalence theorem on a fine grid
says how good the answer is. c: Elfving's theorem as a linear programme over discs cut into polygons. E: two lines by search.
"""

from __future__ import annotations

import numpy as np
from scipy import optimize

from tests.oracles import information


def atoms(plant, omega) -> np.ndarray:
    """dG/d theta at the frequencies, (K, n)."""
    return information.response_derivative(plant, omega)[:, :, 0, 0].T


def of_atoms(g, power) -> np.ndarray:
    return ((g * np.asarray(power)[:, None]).T @ g.conj()).real


def loss(criterion: str, matrix, c=None) -> float:
    """D det(I^-1)^(1/n), A trace I^-1, E largest eigenvalue of I^-1, c: c' I^-1 c."""
    values = np.linalg.eigvalsh(matrix)
    if values[0] <= 0.0:
        return np.inf
    if criterion == "D":
        return float(np.exp(-np.mean(np.log(values))))
    if criterion == "A":
        return float(np.sum(1.0 / values))
    if criterion == "E":
        return float(1.0 / values[0])
    return float(c @ np.linalg.solve(matrix, c))


def sensitivity(criterion: str, matrix, g) -> np.ndarray:
    """tr(Z I(w)) / tr(Z I), theory.md 5: at the optimum its maximum over w is 1 (D: Z = I^-1, A: Z = I^-2)."""
    inverse = np.linalg.inv(matrix)
    z = inverse if criterion == "D" else inverse @ inverse
    return np.einsum("ki,ij,kj->k", g.conj(), z, g).real / np.trace(z @ matrix)


def multiplicative(
    criterion: str, g, rounds: int = 3000, tolerance: float = 1e-4
) -> tuple[np.ndarray, float]:
    """Titterington's algorithm: every line's power times its sensitivity (its root for A); stops at the wanted gap."""
    power = np.full(len(g), 1.0 / len(g))
    for _ in range(rounds):
        value = sensitivity(criterion, of_atoms(g, power), g)
        if value.max() < 1.0 + tolerance:
            break
        power = power * (value if criterion == "D" else np.sqrt(value))
        power = power / power.sum()
    return power, float(value.max() - 1.0)


def moved_lines(criterion: str, plant, omega, power) -> tuple[np.ndarray, np.ndarray, float]:
    """Frequencies and powers together by Nelder-Mead restarts from a start; loss at the end."""
    lines = len(omega)

    def unpack(x):
        weights = np.square(x[lines:])
        return np.clip(x[:lines], 0.0, np.pi), weights / weights.sum()

    def objective(x):
        w, share = unpack(x)
        return np.log(loss(criterion, of_atoms(atoms(plant, w), share)))

    x = np.concatenate([omega, np.sqrt(power)])
    for _ in range(2):
        found = optimize.minimize(
            objective, x, method="Nelder-Mead", options={"xatol": 1e-8, "fatol": 1e-13, "maxiter": 400}
        )
        x = found.x
    w, share = unpack(x)
    return w, share, float(np.exp(found.fun))


def optimal(criterion: str, plant, lines: int = 801, check: int = 20001) -> dict[str, object]:
    """D- or A-optimal spectrum: support, shares, loss, and the largest sensitivity minus 1 on the fine grid."""
    omega = np.linspace(0.0, np.pi, lines)
    power, _ = multiplicative(criterion, atoms(plant, omega))
    heavy = power > 1e-3
    groups = np.split(np.arange(lines), np.flatnonzero(np.diff(heavy.astype(int))) + 1)
    groups = [k for k in groups if heavy[k[0]]]
    start = [float(power[k] @ omega[k] / power[k].sum()) for k in groups]
    share = [float(power[k].sum()) for k in groups]
    w, share, value = moved_lines(criterion, plant, np.array(start), np.array(share) / np.sum(share))
    matrix = of_atoms(atoms(plant, w), share)
    fine = atoms(plant, np.linspace(0.0, np.pi, check))
    gap = float(sensitivity(criterion, matrix, fine).max() - 1.0)
    order = np.argsort(w)
    return {"omega": w[order], "share": share[order], "loss": value, "gap": gap}


def smallest_eigenvalue_two_lines(plant, boxes, rounds: int = 14, points: int = 7) -> dict[str, object]:
    """E-optimal pair of lines: boxes ((low, high) of each frequency and of the first share), searched and shrunk."""
    boxes = [list(box) for box in boxes]
    best = (np.inf, None)
    for _ in range(rounds):
        axes = [np.linspace(low, high, points) for low, high in boxes]
        g0, g1 = atoms(plant, axes[0]), atoms(plant, axes[1])
        for i, w0 in enumerate(axes[0]):
            for j, w1 in enumerate(axes[1]):
                for share in axes[2]:
                    value = loss("E", of_atoms(np.array([g0[i], g1[j]]), [share, 1.0 - share]))
                    if value < best[0]:
                        best = (value, (w0, w1, share))
        boxes = [[x - 0.3 * (high - low), x + 0.3 * (high - low)] for x, (low, high) in zip(best[1], boxes)]
    return {
        "loss": best[0],
        "omega": np.array(best[1][:2]),
        "share": np.array([best[1][2], 1.0 - best[1][2]]),
    }


def smallest_eigenvalue_bound(matrix, g) -> float:
    """Upper bound of lambda_min over all unit-power spectra, theory.md 5: max over w of tr(Z I(w)), Z >= 0, trace 1.

    Z ranges over the eigenspace of the two smallest eigenvalues of `matrix`; its angle and split by search.
    """
    _, vectors = np.linalg.eigh(matrix)
    a, b = np.abs(g.conj() @ vectors[:, 0]) ** 2, np.abs(g.conj() @ vectors[:, 1]) ** 2
    ab = ((g.conj() @ vectors[:, 0]) * (g @ vectors[:, 1])).real

    def worst(x):
        spread = 0.5 * np.array([[1 + x[0], x[1]], [x[1], 1 - x[0]]])
        if x[0] ** 2 + x[1] ** 2 > 1.0:
            return np.inf
        return float((spread[0, 0] * a + spread[1, 1] * b + 2 * spread[0, 1] * ab).max())

    best = np.inf
    for start in ((0.0, 0.0), (0.5, 0.0), (-0.5, 0.0), (0.0, 0.5), (0.0, -0.5), (0.99, 0.0)):
        x = np.array(start)
        for _ in range(4):
            found = optimize.minimize(
                worst, x, method="Nelder-Mead", options={"xatol": 1e-12, "fatol": 1e-15}
            )
            x = found.x
        best = min(best, float(found.fun))
    return best


def elfving(g, c, sides: int = 8, rounds: int = 60, tolerance: float = 1e-9) -> dict[str, object]:
    """max c'x subject to |g_k* x| <= 1 at every line: the loss c' I^-1 c of the c-optimal design is its square.

    Each disc starts as the polygon around it (a relaxation); where the solution leaves a disc, the tangent there is added. The
    answer is bracketed: `upper` from the relaxation, `lower` from the same x shrunk into the discs.
    """
    angles = 2 * np.pi * np.arange(sides) / sides
    scale = np.abs(g).max()
    coarse = g[:: max(1, len(g) // 200)] / scale
    rows = np.concatenate([(coarse.conj() * np.exp(1j * angle)).real for angle in angles])
    for _ in range(rounds):
        found = optimize.linprog(-c, A_ub=rows, b_ub=np.ones(len(rows)), bounds=(None, None), method="highs")
        x = found.x
        value = (g.conj() / scale) @ x
        size = np.abs(value)
        if size.max() <= 1.0 + tolerance:
            break
        inner = np.r_[True, size[1:] >= size[:-1]] & np.r_[size[:-1] >= size[1:], True]
        new = np.flatnonzero(inner & (size > 1.0 + tolerance / 2))
        phase = value[new] / size[new]
        rows = np.vstack([rows, (g[new].conj() / scale * phase.conj()[:, None]).real])
    height = float(c @ x) / scale
    return {"upper": height**2, "lower": (height / max(1.0, float(size.max()))) ** 2, "x": x / scale}


def vertex_direction(
    derivative, criterion: str, rounds: int = 400, c=None
) -> dict[str, float | np.ndarray | list]:
    """Bracket of the optimal loss over lines of any rank: Fedorov's algorithm, derivative (n, K, p, q) whitened by the noise.

    Each round finds the line and the input direction v of the largest sensitivity v* D* Z D v and moves power to it by a search
    along the segment. `loss` is that of the spectrum reached, `bound` from theory.md 5: no spectrum on these lines has less.
    """
    n, lines, _, q = derivative.shape
    power = np.tile(np.eye(q, dtype=complex) / (q * lines), (lines, 1, 1))

    def information_of(p):
        return np.einsum("ikab,kbc,jkac->ij", derivative, p, derivative.conj()).real

    matrix, best = information_of(power), 0.0
    for _ in range(rounds):
        inverse = np.linalg.inv(matrix)
        z = {"D": inverse, "A": inverse @ inverse}.get(criterion)
        if z is None:
            z = inverse @ np.outer(c, c) @ inverse
        forms = np.einsum("ikab,ikac->kbc", derivative.conj(), np.tensordot(z, derivative, 1))
        values, vectors = np.linalg.eigh(forms)
        k = int(np.argmax(values[:, -1]))
        largest, now = float(values[k, -1]), float(np.trace(z @ matrix))
        # concave phi: phi(other) <= phi(here) + largest - now, turned into a bound on the loss
        if criterion == "D":
            bound = loss("D", matrix) * np.exp(-(largest - now) / n)
        else:
            bound = now * now / largest  # tr(W I^-1) tr-homogeneous: loss >= tr(Z I)^2 / max tr(Z I(w))
        best = max(best, bound)
        v = vectors[k, :, -1]
        line = np.outer(v, v.conj())
        atom = np.einsum("iab,bc,jac->ij", derivative[:, k], line, derivative[:, k].conj()).real
        step = optimize.minimize_scalar(
            lambda t, a=matrix, b=atom: np.log(loss(criterion, (1 - t) * a + t * b, c)),
            bounds=(0.0, 0.9),
            method="bounded",
            options={"xatol": 1e-7},
        ).x
        power = (1 - step) * power
        power[k] = power[k] + step * line
        matrix = (1 - step) * matrix + step * atom
    return {"loss": loss(criterion, matrix, c), "bound": best, "power": power}


def elfving_matrices(derivative, c, rounds: int = 300, tolerance: float = 1e-7) -> tuple[float, float]:
    """theory.md 5, MIMO: max c'x with s_max(sum_k x_k G'_k(w)) <= 1; (lower, upper) bound of the c-optimal loss on these lines.

    A linear programme with the cuts Re u* (sum x_k G'_k) v <= 1, u and v the singular vectors where a solution is too large.
    """
    n = len(derivative)
    scale = np.sqrt(np.sum(np.abs(derivative) ** 2, axis=(1, 2, 3)))[:, None]
    whitened = derivative / scale[..., None, None]
    c = c / scale[:, 0]
    rows = np.concatenate([whitened.real.reshape(n, -1).T, -whitened.real.reshape(n, -1).T])
    rows = rows[np.linalg.norm(rows, axis=1) > 1e-9][:: max(1, len(rows) // 500)]
    upper, lower = np.inf, 0.0
    for _ in range(rounds):
        found = optimize.linprog(-c, A_ub=rows, b_ub=np.ones(len(rows)), bounds=(-1e6, 1e6), method="highs")
        x = found.x
        u, s, vh = np.linalg.svd(np.tensordot(x, whitened, 1))
        size = s[:, 0]
        upper = min(upper, float(c @ x) ** 2)
        lower = max(lower, (float(c @ x) / max(1.0, float(size.max()))) ** 2)
        if upper <= lower * (1 + tolerance):
            break
        worst = np.argsort(size)[-12:]
        new = np.einsum(
            "ka,nkab,kb->kn", u[worst][:, :, 0].conj(), whitened[:, worst], vh[worst][:, 0].conj()
        )
        rows = np.vstack([rows, new.real])
    return lower, upper
