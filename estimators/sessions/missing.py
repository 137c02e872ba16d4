"""What a model lacks where the iterations on model minus rig found its error: corrections, fitted and ranked.

[M] (1) leaves the model error Delta = P_model - P_rig nonparametric. Here Delta's records are explained by the smallest
correction C of the model, P_rig = P_model + C, that they support:

    gain          C = kappa_ij P_ij                           entry by entry
    delay         C = -tau_ij (1 - z^-1) P_ij                 to first order in the delay
    feedthrough   C = D
    lag           C = (B0 + B1 z^-1) / (1 - a z^-1)           one real pole
    mode          C = (B0 + .. + B3 z^-3) / (1 - 2 r cos(w) z^-1 + r^2 z^-2)

and compared by Schwarz's criterion; the error before and after is that of records that were not used in the fit.
"""

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from estimators.rules.trace import Trace
from oed.data import entry_name
from oed.errors import InputError
from oed.plants.plant import Plant

Array = NDArray[Any]
MAKERS = ("gain", "delay", "feedthrough", "lag", "mode")


@dataclass(frozen=True, eq=False)
class Cause:
    """A correction of the model. `name` none, gain, delay, feedthrough, lag or mode; `sentence` what it says;
    `criterion` gain of Schwarz's criterion over no correction, in units of twice the log-likelihood; `before,
    after` root mean square of the model error's output on the records held out, without and with the
    correction; `parameters` poles and coefficients by name."""

    name: str
    sentence: str
    criterion: float
    before: float
    after: float
    parameters: dict[str, float] = field(default_factory=dict)

    def __str__(self) -> str:
        return f"{self.name}: {self.sentence}; error {self.before:.4g} -> {self.after:.4g}"


@dataclass(frozen=True, eq=False)
class ModelError:
    """What is missing from a model, and where. `causes` best first; "none" among them; `frequency` worst-case
    frequency in rad/sample; `share` (ny, nu) share of each entry of the model error in its squared size at
    that frequency."""

    causes: tuple[Cause, ...]
    frequency: float
    share: Array

    @property
    def cause(self) -> Cause:
        """The best one."""
        return self.causes[0]


def what_is_missing(
    trace: Trace, model: Plant, frequency: float, *, periodic: bool = False, centred: bool = False
) -> ModelError:
    """Correction that explains the records of model minus rig.

    Parameters
    ----------
    trace : Trace
        Inputs, and outputs of model minus rig.
    model : Plant
        The model.
    frequency : float
        Where its error peaks, rad/sample.
    periodic : bool
        Whether the records are one period of a periodic response; otherwise they start from rest.
    centred : bool
        Whether their means were taken off.

    Returns
    -------
    ModelError
        All corrections, best first.

    Raises
    ------
    InputError
        If there are fewer than two records.
    """
    if len(trace) < 2:
        raise InputError("a correction is fitted to some records and judged on others; record at least two.")
    kept = max(1, len(trace) * 3 // 4)
    data = [_Data(trace.records[part], periodic, centred) for part in (slice(0, kept), slice(kept, None))]
    causes = [_judged("none", "the model lacks nothing that these records show", data, None, 0, {})]
    for name in MAKERS:
        causes.append(_fitted(name, data, model, frequency))
    causes.sort(key=lambda c: -c.criterion)
    return ModelError(tuple(causes), frequency, _shares(data[0], frequency))


class _Data:
    """Signals of several records, stacked: u (N, M, nu), r = rig - model (N, M, ny)."""

    def __init__(self, records: tuple, periodic: bool, centred: bool) -> None:
        self.u = np.stack([r.u for r in records], axis=1)
        self.r = -np.stack([r.y for r in records], axis=1)
        self.periodic, self.centred = periodic, centred

    def filtered(self, b: Array, a: Array, x: Array) -> Array:
        """x through b/a, from rest or in the periodic steady state, with the mean taken off as the records'."""
        from scipy.signal import lfilter

        if self.periodic:
            N = len(x)
            y = np.asarray(lfilter(b, a, np.concatenate([x] * 4), axis=0))[-N:]
        else:
            y = np.asarray(lfilter(b, a, x, axis=0))
        return y - y.mean(axis=0) if self.centred else y

    def rows(self, x: Array) -> Array:
        return x.reshape(-1)


Regressors = Callable[[_Data, int], list[Array]]


def _fitted(name: str, data: list[_Data], model: Plant, frequency: float) -> Cause:
    if name in ("lag", "mode"):
        return _with_pole(name, data, frequency)
    whole = lambda d, i, j: d.filtered(model.num[i][j], model.den[i][j], d.u[:, :, j])
    nu = model.n_inputs
    if name == "gain":
        regressors = lambda d, i: [whole(d, i, j) for j in range(nu)]
        words = "the gains are off"
    elif name == "delay":
        step = np.array([-1.0, 1.0])
        regressors = lambda d, i: [d.filtered(step, np.ones(1), whole(d, i, j)) for j in range(nu)]
        words = "the delays are off (samples)"
    else:
        regressors = lambda d, i: [d.filtered(np.ones(1), np.ones(1), d.u[:, :, j]) for j in range(nu)]
        words = "a direct path is missing"
    coefficients = _solve(data[0], regressors)
    found = {
        f"{name}_{entry_name(i, j, *coefficients.shape[:2])}": float(c)
        for i, row in enumerate(coefficients)
        for j, c in enumerate(row)
    }
    listed = ", ".join(f"{key} {value:.3g}" for key, value in found.items())
    return _judged(name, f"{words}: {listed}", data, regressors, coefficients.size, found)


def _with_pole(name: str, data: list[_Data], frequency: float) -> Cause:
    from scipy.optimize import minimize

    def poles(x: Array) -> Array:
        if name == "lag":
            return np.array([1.0, -np.tanh(x[0])])
        r = 1 / (1 + np.exp(-x[0]))
        return np.array([1.0, -2 * r * np.cos(x[1]), r * r])

    def regressors_at(x: Array) -> Regressors:
        a = poles(x)
        delays = np.eye(4 if name == "mode" else 2)
        return lambda d, i: [d.filtered(b, a, d.u[:, :, j]) for j in range(d.u.shape[2]) for b in delays]

    def cost(x: Array) -> float:
        rest = _residual(data[0], regressors_at(x), None)
        return float(np.sum(np.log(np.maximum(np.mean(rest**2, axis=(0, 1)), 1e-300))))

    # radii 0.73 to 0.998 beside the worst-case frequency; real poles at -0.5, 0.5, 0.9 and 0.99
    starts = [[x] for x in (-0.55, 0.55, 1.47, 2.65)] if name == "lag" else [
        [x, frequency] for x in (1.0, 2.2, 3.5, 5.0, 6.2)
    ]  # fmt: skip
    best = min((np.array(s, dtype=float) for s in starts), key=cost)
    x = minimize(cost, best, method="Nelder-Mead", options={"maxiter": 80, "xatol": 1e-4, "fatol": 1e-4}).x
    regressors = regressors_at(x)
    size = _solve(data[0], regressors).size + len(x)
    a = poles(x)
    if name == "lag":
        pole = float(-a[1])
        return _judged(name, f"a real pole at {pole:.4g} is missing", data, regressors, size, {"pole": pole})
    radius, angle = float(np.sqrt(a[2])), float(np.arccos(np.clip(-a[1] / 2 / np.sqrt(a[2]), -1, 1)))
    found = {"frequency": angle, "radius": radius, "damping": -float(np.log(radius)) / max(angle, 1e-12)}
    words = f"a mode at {angle:.5g} rad/sample with the damping {found['damping']:.3g} is missing"
    return _judged(name, words, data, regressors, size, found)


def _solve(d: _Data, regressors: Regressors) -> Array:
    """Least squares, output by output: (ny, regressors)."""
    rows = []
    for i in range(d.r.shape[2]):
        X = np.stack([d.rows(x) for x in regressors(d, i)], axis=1)
        size = np.sqrt(np.sum(X**2, axis=0)) + 1e-300
        X = X / size
        rows.append(np.linalg.lstsq(X.T @ X, X.T @ d.rows(d.r[:, :, i]), rcond=1e-12)[0] / size)
    return np.array(rows)


def _residual(d: _Data, regressors: Regressors | None, coefficients: Array | None) -> Array:
    if regressors is None:
        return d.r
    found = _solve(d, regressors) if coefficients is None else coefficients
    parts = [np.tensordot(found[i], np.stack(regressors(d, i)), 1) for i in range(d.r.shape[2])]
    return d.r - np.stack(parts, axis=2)


def _judged(
    name: str, sentence: str, data: list[_Data], regressors: Regressors | None, size: int, found: dict[str, float],
) -> Cause:  # fmt: skip
    train, test = data
    coefficients = None if regressors is None else _solve(train, regressors)
    fitted = lambda r: np.maximum(np.mean(r**2, axis=(0, 1)), 1e-300)
    n = train.r[:, :, 0].size
    gain = n * float(np.sum(np.log(fitted(train.r) / fitted(_residual(train, regressors, coefficients)))))
    rms = lambda r: float(np.sqrt(np.mean(r**2)))
    after = _residual(test, regressors, coefficients)
    return Cause(name, sentence, gain - size * float(np.log(n)), rms(test.r), rms(after), found)


def _shares(d: _Data, omega: float) -> Array:
    """Share of each entry of the error's response at a frequency, by least squares over the records."""
    e = np.exp(-1j * omega * np.arange(len(d.u)))
    U, R = (np.tensordot(e, x, 1) for x in (d.u, d.r))
    G = np.linalg.lstsq(U, R, rcond=None)[0].T
    return np.abs(G) ** 2 / max(float(np.sum(np.abs(G) ** 2)), 1e-300)
