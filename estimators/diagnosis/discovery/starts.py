"""Linear starts of a form: scaled signals, and chains by iterated filtering (Steiglitz-McBride) in the delta operator."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import combinations
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.signal import lfilter

from estimators.diagnosis.discovery.fitting import Fitted, Piece, fit
from estimators.diagnosis.discovery.form import Difference, Form
from estimators.residual.algebra import gapless
from oed.data import Record

Array = NDArray[Any]
MARGIN = 0.25  # of a signal's span: how far beyond the data a term follows it
SLOWEST, FASTEST = 0.01, 1.0  # pace of the delta operator: what one sample may change
MINOR = 0.1  # of two signals, or of their difference, over the larger: below it the difference is one of them, or nothing
ROUNDS = 4  # of filtering by the last denominator: more change nothing that the fit does not


@dataclass(frozen=True, eq=False)
class Scales:
    """Centres and spreads of inputs (nu,) and outputs (ny,), pace and typical change per sample of each output.

    `rest_u` and `rest_y` are the resting values; `delay` (nu,) whole samples by which the inputs are late.
    """

    u: Array
    su: Array
    y: Array
    sy: Array
    paces: tuple[float, ...]
    steps: tuple[float, ...]
    delay: Array
    dt: float
    bounds: tuple[tuple[float, float], ...]
    differences: tuple[Difference, ...] = ()

    @property
    def centres(self) -> dict[str, tuple[float, float]]:
        """Centre and scale of y, v, u and du of all channels in the user's units."""
        out = {f"y{i}": (c, s) for i, (c, s) in enumerate(zip(self.y, self.sy))}
        out |= {f"v{i}": (0.0, s * step / self.dt) for i, (s, step) in enumerate(zip(self.sy, self.steps))}
        out |= {f"u{j}": (c, s) for j, (c, s) in enumerate(zip(self.u, self.su))}
        out |= {f"du{j}": (0.0, s / self.dt) for j, s in enumerate(self.su)}
        return {name: (float(c), float(s)) for name, (c, s) in out.items()}

    def centre(self, d: Difference) -> tuple[float, float]:
        """Centre and scale of a difference."""
        (a, s), (b, _) = self.centres[d.first], self.centres[d.second]
        return a - b, s / d.weights[0]

    @property
    def zeros(self) -> dict[str, float]:
        """Where the user's zero of every y, u and difference lies in the scales."""
        placed = {n: c for n, c in self.centres.items() if n[0] in "yu"}
        placed |= {d.name: self.centre(d) for d in self.differences}
        return {n: -c / s for n, (c, s) in placed.items()}


def scales_of(records: Sequence[Record], smooth: Sequence[Array], delay: Array) -> Scales:
    """Scales from the records; rates from smooth outputs (N, ny), where noise does not swell them."""
    u, y = np.vstack([r.u for r in records]), np.vstack([gapless(r.y) for r in records])
    su, sy = np.maximum(u.std(axis=0), 1e-300), np.maximum(y.std(axis=0), 1e-300)
    change = np.sqrt(np.mean(np.vstack([np.diff(s, axis=0) for s in smooth]) ** 2, axis=0)) / sy
    change = np.maximum(change, 1e-6)
    paces = np.clip(2 * change, SLOWEST, FASTEST)
    early = Scales(
        u.mean(axis=0), su, y.mean(axis=0), sy, tuple(paces), tuple(change), delay, records[0].dt, ()
    )
    seen = dict(zip(early.centres, _covered(early, records, smooth).T, strict=True))
    bounds = tuple(_bounds(x, 1.0 if name[0] == "v" else 0.0) for name, x in seen.items())
    return replace(early, bounds=bounds, differences=_differences(early, records[0], seen))


def _covered(scales: Scales, records: Sequence[Record], smooth: Sequence[Array]) -> Array:
    """(N, 2 ny + 2 nu) the signals y, v, u, du along the records."""
    columns = []
    for r, s in zip(records, smooth):
        d = drive(r.u, scales)
        y = (gapless(r.y) - scales.y) / scales.sy
        v = np.diff((s - scales.y) / scales.sy, axis=0, prepend=np.nan) / np.array(scales.steps)
        columns.append(np.hstack([y, np.nan_to_num(v), d[:, 1:]]))
    return np.vstack(columns)


def _bounds(x: Array, further: float) -> tuple[float, float]:
    """Where a signal may go inside a term: the range that the records cover and a margin."""
    low, high = float(x.min()), float(x.max())
    margin = MARGIN * (high - low) + further
    return low - margin, high + margin


def _differences(scales: Scales, record: Record, seen: Mapping[str, Array]) -> tuple[Difference, ...]:
    """Of two signals of one unit, and of two outputs also where none is given: what drives a flow, a spring, an exchange."""
    units = {f"{kind}{i}": (kind, unit) for kind in "yv" for i, unit in enumerate(record.output_units)}
    units |= {f"u{j}": ("y", unit) for j, unit in enumerate(record.input_units)}
    out = []
    for a, b in combinations(units, 2):
        if units[a] != units[b] or (not units[a][1] and "u" in (a[0], b[0])):
            continue
        size = [scales.centres[n][1] for n in (a, b)]
        spread = float(np.std(size[0] * seen[a] - size[1] * seen[b]))
        if min(size) < MINOR * max(spread, *size) or spread < MINOR * min(size):
            continue
        d = Difference(a, b, (size[0] / spread, size[1] / spread), (0.0, 0.0))
        out.append(replace(d, bounds=_bounds(d.of(seen), 1.0 if a[0] == "v" else 0.0)))
    return tuple(out)


def drive(u: Array, scales: Scales) -> Array:
    """(N, 1 + 2 nu): one, scaled inputs and their changes; an input that is late repeats its first value."""
    v = (u - scales.u) / scales.su
    late = np.column_stack([np.r_[np.repeat(x[:1], k), x[: len(x) - k]] for x, k in zip(v.T, scales.delay)])
    return np.hstack([np.ones((len(u), 1)), late, np.diff(late, axis=0, prepend=late[:1])])


def pieces_of(records: Sequence[Record], keep: Sequence[Array], scales: Scales) -> list[Piece]:
    """The records centred and scaled, with weights of 0 or 1."""
    out = []
    for r, k in zip(records, keep):
        y = (r.y - scales.y) / scales.sy
        fine = np.isfinite(y) & np.asarray(k, bool).reshape(len(y), -1)
        out.append(Piece(drive(r.u, scales), np.where(fine, y, 0.0), fine.astype(float)))
    return out


def chain_roots(alpha: Array, pace: float) -> Array:
    """Poles of a chain in z."""
    return 1 + pace * np.roots(np.concatenate([[1.0], alpha])) if len(alpha) else np.zeros(0)


def _regressors(n: int, pace: float, u: Array, y: Array, roots: Array) -> tuple[Array, Array]:
    """Filtered delta derivatives: rows of -alpha, beta, const, and the target; filter 1 / prod(delta - root)."""
    poly = np.real(np.poly(roots))  # in z
    powers = [np.array([1.0])]
    for _ in range(n):
        powers.append(np.convolve(powers[-1], [1.0, -1.0]) / pace)
    shaped = lambda m, x: np.asarray(lfilter(np.r_[np.zeros(n - m), powers[m]] * pace**n, poly, x))
    columns = [-shaped(n - 1 - m, y) for m in range(n)]
    columns += [shaped(n - 1 - m, x) for x in u.T for m in range(n)]
    return np.array([*columns, shaped(0, np.ones(len(y)))]).T, shaped(n, y)


def chain_start(n: int, pace: float, pieces: Sequence[Piece], i: int, outputs: Sequence[Array]) -> Array:
    """alpha, beta, const of chain i from outputs (N, ny), least squares of filtered signals, filter renewed."""
    roots = np.full(n, max(1 - pace, 0.1))
    theta = np.zeros(0)
    for _ in range(ROUNDS):
        rows, targets = [], []
        for piece, y in zip(pieces, outputs):
            nu = (piece.d.shape[1] - 1) // 2
            u, level = piece.d[:, 1 : 1 + nu], y[:1, i]
            X, t = _regressors(n, pace, u - u[:1], y[:, i] - level, roots)
            # about the first sample the filters start at rest; the constants come back with the level
            X[:, -1] = 1.0
            rows.append(X)
            targets.append(t)
        X, t = np.vstack(rows), np.concatenate(targets)
        size = np.sqrt(np.mean(X**2, axis=0)) + 1e-12
        theta = np.linalg.lstsq(X / size, t, rcond=1e-9)[0] / size
        new = chain_roots(theta[:n], pace)
        radius = np.abs(new)
        roots = np.where(radius > 0.999, new / np.maximum(radius, 1e-9) * 0.98, new)
    piece, y = pieces[0], outputs[0]
    nu = (piece.d.shape[1] - 1) // 2
    alpha, beta = theta[:n].copy(), theta[n:-1]
    stable = roots if np.any(np.abs(chain_roots(alpha, pace)) > 1) else None
    if stable is not None:
        alpha = np.real(np.poly((stable - 1) / pace))[1:]
    level = alpha[-1] * y[0, i] - sum(beta[(j + 1) * n - 1] * piece.d[0, 1 + j] for j in range(nu))
    return np.concatenate([alpha, beta, [level]])


def resting_states(form: Form, theta: Array, pieces: Sequence[Piece]) -> list[Array]:
    """Chain states of rest at the first output of every record."""
    out = []
    for piece in pieces:
        x, at = [], 0
        for i, n in enumerate(form.orders):
            pace_free = theta[at : at + n]
            y0, u0 = piece.y[0, i], piece.d[0, 1 : 1 + form.inputs]
            beta = theta[at + n : at + n + form.inputs * n].reshape(form.inputs, n)
            state = [y0]
            for m in range(n - 1):
                state.append(pace_free[m] * y0 - float(beta[:, m] @ u0))
            x += state
            at += n * (1 + form.inputs) + 1 + form.inputs * form.feedthrough
        out.append(np.array(x))
    return out


def linear_fit(
    orders: tuple[int, ...],
    pieces: Sequence[Piece],
    scales: Scales,
    outputs: Sequence[Array],
    *,
    feedthrough: bool = False,
    iterations: int = 15,
) -> Fitted | None:
    """Chains of these orders fitted by simulation error, from smooth outputs (scaled) as the start."""
    nu = (pieces[0].d.shape[1] - 1) // 2
    form = Form(orders, nu, scales.paces, scales.steps, (), feedthrough, scales.bounds, scales.differences)
    parts = []
    for i, n in enumerate(orders):
        parts += [chain_start(n, scales.paces[i], pieces, i, outputs), np.zeros(nu * feedthrough)]
    theta = np.concatenate(parts)
    return fit(form, theta, resting_states(form, theta, pieces), pieces, iterations=iterations)
