"""Physically parametrised models, in continuous or discrete time, given as CasADi expressions.

    x' = f(x, u, p)   or   x(t+1) = f(x, u, p),      y = h(x, u, p) + e

The input is held between samples; continuous time is integrated by Runge-Kutta of order 4 in substeps, its error
O((dt / substeps)^4). Sensitivities are propagated forwards, sample by sample."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import lru_cache
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from estimators.pem.predictors.kernel import Kernel, kernel_of
from estimators.pem.predictors.recursion import differentiated
from estimators.pem.search.levenberg_marquardt import Point, minimise
from estimators.residual.measures import fit_percent
from oed.data import Record, as_signal
from oed.errors import InputError, NotIdentifiable, Status
from oed.files.objects import as_records


@dataclass(frozen=True, eq=False)
class GreyBox:
    """A model as two functions of CasADi symbols. `dynamics` (x, u, p) -> x' or x(t+1), each a casadi.SX
    column; `output` (x, u, p) -> y; `n_states` number of states; `start` parameters by name with their
    initial guesses; their order is that of p; `continuous` whether `dynamics` is a time derivative, per
    second; `substeps` Runge-Kutta steps per sample."""

    dynamics: Callable[[Any, Any, Any], Any]
    output: Callable[[Any, Any, Any], Any]
    n_states: int
    start: Mapping[str, float]
    continuous: bool = True
    substeps: int = 4


@dataclass(frozen=True, eq=False)
class GreyBoxFit:
    """Estimated parameters of a grey-box model. `names` of the parameters; `theta` (n,) estimates;
    `covariance` (n, n), for white residuals; `noise_covariance` (ny, ny) of the residuals, corrected for the
    degrees of freedom; `fit_percent` of the simulation on the data that were fitted; `residuals` (N, ny) of
    each record; `initial_states` (R, nx); zero unless they were estimated; `status` how the search ended;
    `iterations` Gauss-Newton steps; `simulator` (u, x0) -> y."""

    names: tuple[str, ...]
    theta: NDArray[np.float64]
    covariance: NDArray[np.float64]
    noise_covariance: NDArray[np.float64]
    fit_percent: float
    residuals: list[NDArray[np.float64]]
    initial_states: NDArray[np.float64]
    status: Status
    iterations: int
    simulator: Callable[[NDArray, NDArray], NDArray]

    @property
    def standard_errors(self) -> NDArray[np.float64]:
        """(n,) standard errors."""
        return np.sqrt(np.maximum(np.diag(self.covariance), 0.0))

    def simulate(self, u: ArrayLike, x0: ArrayLike | None = None) -> NDArray[np.float64]:
        """Output of the model for an input: u (N, nu), x0 (nx,) -> (N, ny)."""
        width = self.initial_states.shape[1]
        start = np.zeros(width) if x0 is None else np.asarray(x0, dtype=float)
        return self.simulator(as_signal(u, "the input u"), start)

    def __repr__(self) -> str:
        rows = [f"grey-box model: {self.status.value}"]
        rows += [
            f"  {name:>10} = {value:12.6g} +- {error:.2g}"
            for name, value, error in zip(self.names, self.theta, self.standard_errors, strict=True)
        ]
        return "\n".join([*rows, f"  fit {self.fit_percent:.2f} % simulated"])


def _step(model: GreyBox, dt: float, x: Any, u: Any, p: Any) -> Any:
    """The state one sample later."""
    if not model.continuous:
        return model.dynamics(x, u, p)
    h = dt / model.substeps
    for _ in range(model.substeps):
        k1 = model.dynamics(x, u, p)
        k2 = model.dynamics(x + h / 2 * k1, u, p)
        k3 = model.dynamics(x + h / 2 * k2, u, p)
        k4 = model.dynamics(x + h * k3, u, p)
        x = x + h / 6 * (k1 + 2 * k2 + 2 * k3 + k4)
    return x


@lru_cache(maxsize=16)
def _prepared(
    model: GreyBox, guess: tuple[tuple[str, float], ...], nu: int, ny: int, dt: float, unknown: bool
) -> tuple[Kernel, Any]:
    """The predictor of a model, and its step (x, u, q) -> (x+, y), in parameters in units of their guesses; made once."""
    import casadi as ca

    values = np.array([value for _, value in guess], dtype=float)
    q, x0 = ca.SX.sym("q", len(guess)), ca.SX.sym("x0", model.n_states if unknown else 0)
    x, sample = ca.SX.sym("x", model.n_states), ca.SX.sym("sample", nu + ny + 1)
    p, u = q * np.where(values != 0, np.abs(values), 1.0), sample[:nu]
    y_hat = ca.densify(ca.SX(model.output(x, u, p)))
    after = ca.densify(ca.SX(_step(model, dt, x, u, p)))
    if y_hat.numel() != ny or after.numel() != model.n_states:
        raise InputError(
            f"the model gives {y_hat.numel()} outputs and {after.numel()} states; the records have {ny} outputs "
            f"and n_states is {model.n_states}."
        )
    e, parameters = sample[nu : nu + ny] - y_hat, ca.vertcat(q, x0)
    kernel = kernel_of(differentiated(x, sample, parameters, after, e, x0 if unknown else None))
    u = ca.SX.sym("u", nu)
    return kernel, ca.Function("one", [x, u, q], [_step(model, dt, x, u, p), model.output(x, u, p)])


def identify_grey_box(
    records: Record | Sequence[Record], model: GreyBox, *, initial: str = "zero",
    bounds: Mapping[str, tuple[float, float]] | None = None, max_iterations: int = 200,
) -> GreyBoxFit:  # fmt: skip
    """Parameters that minimise the simulation error of a physically parametrised model."""
    given = as_records(records)
    if not given or initial not in ("zero", "estimate"):
        raise InputError(f"{len(given)} records, initial {initial!r}; give records and zero or estimate.")
    ny, nu, dt = given[0].n_outputs, given[0].n_inputs, given[0].dt
    if any((r.n_outputs, r.n_inputs, r.dt) != (ny, nu, dt) or not r.complete for r in given):
        raise InputError("the records must have the same channels and sampling time, and no missing samples.")
    names, guess = tuple(model.start), np.array(list(model.start.values()), dtype=float)
    size = np.where(guess != 0, np.abs(guess), 1.0)
    n, m = len(names), model.n_states * (initial == "estimate") * len(given)
    kernel, one = _prepared(model, tuple(model.start.items()), nu, ny, dt, bool(m))
    scale = np.sqrt(np.mean(np.concatenate([r.y for r in given]) ** 2, axis=0))
    scale = np.where(scale > 0, scale, 1.0)
    weight = np.diag(scale**-2.0) if ny > 1 else np.eye(1)
    blocks = [np.column_stack([r.u, r.y, np.eye(len(r), 1)]) for r in given]
    data, lengths = np.ascontiguousarray(np.concatenate(blocks)), np.array([len(r) for r in given])
    width, per = n + m, model.n_states if m else 0
    # The parameters and the initial state of every record.
    own = np.array([np.r_[0:n, n + r * per : n + (r + 1) * per] for r in range(len(given))])
    parts = np.split(data, np.cumsum(lengths)[:-1])

    def evaluate(z: NDArray, _: Any = None) -> Point | None:
        with np.errstate(over="ignore", invalid="ignore"):
            sums = kernel.sums(data, lengths, z[own], weight)
        loss, gradient, hessian = float(sums.loss.sum()), np.zeros(width), np.zeros((width, width))
        if not (np.isfinite(loss) and np.isfinite(sums.hessian).all()):
            return None
        for r, at in enumerate(own):
            gradient[at] += sums.gradient[r]
            hessian[np.ix_(at, at)] += sums.hessian[r]
        return Point(z, loss, gradient, hessian, lambda d: None, sums.covariance.sum(axis=0) / len(data))

    lower, upper = np.full(width, -np.inf), np.full(width, np.inf)
    for name, (low, high) in (bounds or {}).items():
        if name not in names or not low <= high:
            raise InputError(f"bounds {low}, {high} of {name!r}; the parameters are {', '.join(names)}.")
        k = names.index(name)
        lower[k], upper[k] = low / size[k], high / size[k]
    clipped = lambda z: np.clip(z, lower, upper)
    point = evaluate(clipped(np.concatenate([guess / size, np.zeros(m)])))
    if point is None:
        raise InputError("the loss at the guess is not finite; give a guess whose simulation stays bounded.")
    best = minimise(evaluate, point, max_iterations=max_iterations, project=clipped, bounds=(lower, upper))
    z, hessian = best.point.z, best.point.hessian
    root = np.sqrt(np.maximum(np.diag(hessian), np.finfo(float).tiny))
    values, vectors = np.linalg.eigh(hessian / np.outer(root, root))
    if values[0] <= 1e-13 * values[-1]:
        null = np.abs(vectors[:n, 0] / root[:n])
        guilty = [names[k] for k in range(n) if null[k] > 1e-2 * null.max()]
        raise NotIdentifiable(
            f"the data do not determine a combination of {', '.join(guilty)}; fix one of them, or excite more."
        )
    freedom = len(data) / max(len(data) - width / ny, 1.0)
    inverse = np.linalg.inv(hessian)
    if ny == 1:
        spread = inverse * float(best.point.extra[0, 0]) * freedom
    else:  # outputs weighted equally in units of their size: the sandwich of that weighting
        middle, moment = np.zeros((width, width)), weight @ best.point.extra @ weight * freedom
        for part, at in zip(parts, own, strict=True):
            jacobian = np.asarray(kernel.trace(part, z[at], True)[1])
            middle[np.ix_(at, at)] += np.einsum("tij,ik,tkl->jl", jacobian, moment, jacobian)
        spread = inverse @ middle @ inverse
    covariance = np.asarray(spread[:n, :n] * np.outer(size, size), dtype=np.float64)
    states = z[n:].reshape(len(given), per) if m else np.zeros((len(given), model.n_states))
    residuals = [kernel.trace(part, z[at], False)[0] for part, at in zip(parts, own, strict=True)]
    simulation = [r.y - e for r, e in zip(given, residuals, strict=True)]
    theta = z[:n] * size

    def simulator(u_given: NDArray, state: NDArray) -> NDArray:
        y = np.zeros((len(u_given), ny))
        for t, row in enumerate(u_given):
            state, y_t = (np.array(v).ravel() for v in one(state, row, z[:n]))
            y[t] = y_t
        return y

    return GreyBoxFit(
        names, theta, covariance, best.point.extra * freedom,
        fit_percent(np.concatenate([r.y for r in given]), np.concatenate(simulation)),
        residuals, states, best.status, best.iterations, simulator,
    )  # fmt: skip
