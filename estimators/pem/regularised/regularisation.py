"""What a regularised impulse response was estimated with, and what it expects of a record beside G u.

The output of a record is y = level + G u + tau + d + e: tau is the answer to inputs before the record, with the
kernel of the impulse response over time (Lataire, Chen, Automatica 72, 2016, 57), d a slow disturbance, e white.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from estimators.pem.regularised.impulse_priors import SlowNoise, kernel_factor
from oed.models.model import Polynomial


def lagged(form: Polynomial, i: int, u: NDArray) -> NDArray[np.float64]:
    """The inputs behind the taps of output i, with zeros before the record: u (N, nu) -> (N, n)."""
    size, columns = len(u), []
    for j in range(form.n_inputs):
        for k in range(form.nk[i, j], form.nk[i, j] + form.nb[i, j]):
            column = np.zeros(size)
            column[k:] = u[: max(size - k, 0), j]
            columns.append(column)
    return np.column_stack(columns)


def transient_factor(form: Polynomial, i: int, factors: list[NDArray], size: int) -> NDArray[np.float64]:
    """A factor of the covariance of the answer to inputs before the record, up to a factor: factors (nb, m)
    -> (T, m)."""
    reach = [form.nk[i, j] + form.nb[i, j] - 1 for j in range(form.n_inputs) if form.nb[i, j]]
    rows = min(max(reach, default=0), size)
    # Nothing is lost by shifting a kernel to the first sample: a delay holds what was applied during it.
    padded = [np.pad(f, ((0, max(rows - len(f), 0)), (0, 0)))[:rows] for f in factors]
    return np.hstack(padded)


@dataclass(frozen=True, eq=False)
class Regularisation:
    """Kernel, disturbance and hyperparameters of a regularised impulse response. `kernel` expected decay and
    smoothness; `disturbance` beside the white noise; `scale, decay, correlation` (ny, nu) c, a and rho of
    each entry's kernel, c in squared units of the taps; rho of dc alone; `transient` (ny,) factor of the
    kernel of the answer to earlier inputs; 0 where the record begins at rest; `phi, q` (ny,) of the
    disturbance; q relative to `noise`; `noise` (ny,) variance of the white noise e; `input_scale` (nu,) root
    mean square of the inputs' deviations; `errors` per output, standard errors of log scale, logit decay,
    ..., by name; `log_likelihood` marginal log-likelihood at the optimum, up to a constant of the data;
    `degrees_of_freedom` effective number of parameters: the trace of the map from outputs to fitted values G
    u, and the levels; `posterior` (n, n) covariance of the parameters at these hyperparameters. The fit's errors have beside it
    what the hyperparameters' own errors make, and an estimate of what the prior takes from this response: of 95 % intervals at the
    peak of a first-order lag 97 % hold, at the peak of a response that rings 87 % (77 by the posterior alone)."""

    kernel: str
    disturbance: str | None
    scale: NDArray[np.float64]
    decay: NDArray[np.float64]
    correlation: NDArray[np.float64]
    transient: NDArray[np.float64]
    phi: NDArray[np.float64]
    q: NDArray[np.float64]
    noise: NDArray[np.float64]
    input_scale: NDArray[np.float64]
    errors: tuple[dict[str, float], ...]
    log_likelihood: float
    degrees_of_freedom: float
    posterior: NDArray[np.float64]

    def slow_noise(self, i: int) -> SlowNoise:
        """Disturbance and white noise of output i, per unit of white noise variance."""
        return SlowNoise(float(self.phi[i]), float(self.q[i]))

    def _transient(self, form: Polynomial, i: int, size: int) -> NDArray[np.float64]:
        factors = [
            np.sqrt(self.transient[i] * self.scale[i, j] / self.noise[i]) * self.input_scale[j]
            * kernel_factor(self.kernel, form.nb[i, j], float(self.decay[i, j]), float(self.correlation[i, j]))
            for j in range(form.n_inputs)
            if form.nb[i, j]
        ]  # fmt: skip
        return transient_factor(form, i, factors, size)

    def _settled(self, form: Polynomial, i: int, v: NDArray, size: int) -> NDArray[np.float64]:
        """The answer to earlier inputs expected over `size` samples, from what G u leaves of the first ones."""
        out = np.zeros(size)
        if self.transient[i] <= 0:
            return out
        noise, M = self.slow_noise(i), self._transient(form, i, size)
        seen = M[: len(v)]
        columns = np.column_stack([np.vstack([seen, np.zeros((len(v) - len(seen), M.shape[1]))]), v])
        weighed = noise.weighed(columns)[0][: len(seen)]
        B = np.eye(M.shape[1]) + seen.T @ weighed[:, :-1]
        out[: len(M)] = M @ np.linalg.solve(B, seen.T @ weighed[:, -1])
        return out

    def continued(self, form: Polynomial, v: NDArray, size: int) -> NDArray[np.float64]:
        """Transient and disturbance expected over a record, of which the first samples are known: v (W, ny)
        -> (size, ny)."""
        out = np.zeros((size, v.shape[1]))
        for i in range(v.shape[1]):
            out[:, i] = self._settled(form, i, v[:, i], size)
            rest = v[:, i] - out[: len(v), i]
            out[len(v) :, i] += self.slow_noise(i).foretold(rest, size - len(v))
        return out

    def innovations(
        self, form: Polynomial, u: NDArray, v: NDArray, unknown: bool
    ) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """One-step prediction errors and their sensitivities to the parameters and the levels: u, v (N, nu)
        -> (N, ny), (N, ny, n + ny)."""
        from scipy.signal import lfilter

        size, ny = v.shape
        e, jacobian = np.zeros((size, ny)), np.zeros((size, ny, form.n + ny))
        for i, place in enumerate(form.places()):
            noise = self.slow_noise(i)
            rest = v[:, i] - (self._settled(form, i, v[:, i], size) if unknown else 0.0)
            X = lagged(form, i, u)
            whole = noise.innovations(np.column_stack([rest, X, np.ones(size)]))
            e[:, i] = whole[:, 0]
            taps = np.concatenate([np.arange(p.start, p.stop) for p in place["b"]])
            jacobian[:, i, taps] = -whole[:, 1:-1]
            jacobian[:, i, form.n + i] = -whole[:, -1]
            if self.disturbance:
                past = np.vstack([np.zeros((1, 2)), np.column_stack([-e[:, i], rest])[:-1]])
                slope = lfilter([1.0], [1.0, noise.polynomials[0]], past, axis=0)
                jacobian[:, i, [place["c"][0].start, place["d"][0].start]] = slope
        return e, jacobian

    def to_dict(self) -> dict:
        """Plain numbers."""
        arrays = ("scale", "decay", "correlation", "transient", "phi", "q", "noise", "input_scale")
        rest = ("kernel", "disturbance", "log_likelihood", "degrees_of_freedom")
        return (
            {x: getattr(self, x) for x in rest}
            | {x: getattr(self, x).tolist() for x in arrays}
            | {"errors": [dict(e) for e in self.errors]}
        )

    def __repr__(self) -> str:
        rows = []
        for i in range(len(self.noise)):
            which = f"output {i + 1}: " if len(self.noise) > 1 else ""
            decay = ", ".join(f"{a:.4g}" for a in self.decay[i])
            slow = ""
            if self.disturbance:
                slow = f", disturbance with phi {self.phi[i]:.5g} and increments of variance {self.q[i] * self.noise[i]:.3g}"
            rows.append(f"{which}decay {decay}, white noise of variance {self.noise[i]:.3g}{slow}")
        return (
            f"kernel {self.kernel}: {'; '.join(rows)}; {self.degrees_of_freedom:.3g} effective parameters, "
            f"log marginal likelihood {self.log_likelihood:.6g}; errors are too small at the peak of a "
            "response that rings more than the kernel expects (87 % of 95 % intervals hold)"
        )
