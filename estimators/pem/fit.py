"""A fitted model with its uncertainty, and what can be asked of it."""

from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from estimators.norm.model_peak import frequency_error, peak_gain
from estimators.pem.predictors.of_structure import Structure, samples
from estimators.pem.regularised.regularisation import Regularisation
from estimators.pem.search.problem import Problem, prepare
from estimators.pem.subspace.observability import Subspace
from estimators.residual.measures import fit_percent, per
from oed.data import Record, as_signal
from oed.errors import InputError, Status
from oed.files.objects import as_record
from oed.models.model import Model, Polynomial, StateSpace
from oed.models.poles import poles_in_hz


def noise_free(model: Model) -> tuple[Polynomial | StateSpace, NDArray[np.float64]]:
    """The output-error structure with the same G, and its parameters."""
    form = model.structure
    if isinstance(form, StateSpace):
        bare = StateSpace(form.blocks, form.n_inputs, form.feedthrough, noise=False)
        return bare, np.array(
            [v for (x, _, _), v in zip(form.entries(), model.theta, strict=True) if x != "K"]
        )
    none = np.zeros_like(form.na)
    degree = np.where(form.nb > 0, form.nf + form.na[:, None], 0)
    theta = []
    for i, row in enumerate(form.coefficients(model.theta)):
        theta += [row["b"][j][form.nk[i, j] :] for j in range(form.n_inputs)]
        theta += [np.convolve(row["a"][0], row["f"][j])[1:] for j in range(form.n_inputs) if form.nb[i, j]]
    return Polynomial(none, form.nb, none, none, degree, form.nk, "oe"), np.concatenate(theta)


_STATED = ("noise_variance", "loss", "fit_percent", "simulation_fit_percent", "aic", "bic", "hinf_frequency_error",
           "n_samples", "initial")  # fmt: skip
"""Numbers of a fit that `to_dict` gives as they are."""


@dataclass(frozen=True, eq=False)
class Fit:
    """The result of a prediction-error identification.

    Attributes
    ----------
    model : Model
        Structure, parameters, noise covariance.
    covariance : ndarray
        (n, n) covariance of the parameters: lambda (sum J'J)^-1, or (sum J' Lambda^-1 J)^-1 for several outputs.
    loss : float
        det of the residuals' second moment (one output: the mean square).
    n_samples : int
        Samples of all records together.
    n_estimated : int
        Everything that was estimated: parameters, levels and initial states.
    fit_percent : float
        Of the one-step prediction, on the data that were fitted. It flatters models with a noise model: compare
        structures by `simulation_fit_percent`, or better on fresh data.
    status : Status
        How the search ended.
    iterations : int
        Gauss-Newton steps from the start that won.
    decrement : float
        Relative decrease of the loss that a further step promises: the optimality residual.
    residuals : list of ndarray
        (N, ny) one-step prediction errors of each record.
    input_level, output_level : ndarray
        Levels from which the model's signals deviate; zero unless an offset was asked for.
    output_level_errors : ndarray
        (ny,) standard errors of the output levels.
    initial : str
        How the initial states were treated.
    notes : tuple of str
        What a reader should know beside the numbers.
    regularisation : Regularisation, optional
        Kernel, disturbance and hyperparameters of a regularised impulse response. The fit's covariance has its errors too.
    subspace : Subspace, optional
        Horizon and singular values of a subspace method, whose parameters minimise no loss.
    records : tuple of Record
        What was fitted.
    """

    model: Model
    covariance: NDArray[np.float64]
    loss: float
    n_samples: int
    n_estimated: int
    fit_percent: float
    status: Status
    iterations: int
    decrement: float
    residuals: list[NDArray[np.float64]]
    input_level: NDArray[np.float64]
    output_level: NDArray[np.float64]
    output_level_errors: NDArray[np.float64]
    initial: str = "zero"
    notes: tuple[str, ...] = field(default=())
    regularisation: Regularisation | None = None
    subspace: Subspace | None = None
    records: tuple[Record, ...] = field(default=(), repr=False)

    @property
    def plot(self) -> Any:
        """Figures: `plot.bode()`, `.compare(record)`, `.residuals(record)`, `.poles()`, `.step()`, `.order()`."""
        from estimators.pem.plots import FitPlots

        return FitPlots(self)

    @property
    def theta(self) -> NDArray[np.float64]:
        """(n,) parameters."""
        return self.model.theta

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the parameters."""
        return self.model.names

    @property
    def standard_errors(self) -> NDArray[np.float64]:
        """(n,) standard errors of the parameters."""
        return np.sqrt(np.maximum(np.diag(self.covariance), 0.0))

    @property
    def noise_covariance(self) -> NDArray[np.float64]:
        """(ny, ny) covariance of the innovations, corrected for the degrees of freedom."""
        return self.model.noise_covariance

    @property
    def noise_variance(self) -> float:
        """Mean innovation variance per output, tr(Lambda) / ny."""
        return float(np.trace(self.noise_covariance)) / self.model.structure.n_outputs

    @property
    def log_likelihood(self) -> float:
        """Gaussian log-likelihood at the optimum."""
        ny = self.model.structure.n_outputs
        return -0.5 * self.n_samples * (np.log(max(self.loss, 1e-300)) + ny * (1 + np.log(2 * np.pi)))

    @property
    def aic(self) -> float:
        """Akaike's criterion, -2 log L + 2 n."""
        return -2 * self.log_likelihood + 2 * self.n_estimated

    @property
    def bic(self) -> float:
        """Schwarz's criterion, -2 log L + n log N."""
        return -2 * self.log_likelihood + self.n_estimated * np.log(self.n_samples)

    @property
    def hinf_norm(self) -> tuple[float, float, float]:
        """Peak gain of G, its standard error by the delta method, and its frequency in rad/sample.

        The gradient is Re(u* dG v) at the peak (envelope theorem). Not a number where G is unstable.
        """
        if not self.model.stable:
            return float("nan"), float("nan"), float("nan")
        gamma, omega, slope = peak_gain(self.model)
        return gamma, float(np.sqrt(max(slope @ self.covariance @ slope, 0.0))), omega

    @property
    def hinf_frequency_error(self) -> float:
        """Standard error of the frequency of `hinf_norm`; infinite where the data do not say where the peak is."""
        return frequency_error(self.model, self.covariance) if self.model.stable else float("nan")

    @property
    def simulation_fit_percent(self) -> float:
        """`fit_percent` of the simulation from the inputs alone, on the data that were fitted.

        From rest, or from the initial state that suits each record best where states were estimated. Not a number of
        unstable models. Missing outputs are left out.
        """
        if not self.records or not self.model.stable:
            return float("nan")
        whole = self.initial != "zero" and self.regularisation is None
        y = [self.simulate_record(r, window=len(r) if whole else 0) for r in self.records]
        return fit_percent(np.concatenate([r.y for r in self.records]), np.concatenate(y))

    def simulate(self, u: ArrayLike) -> NDArray[np.float64]:
        """Noise-free output for an input, from rest at the levels.

        Parameters
        ----------
        u : array_like
            (N, nu) input in the units of the data.

        Returns
        -------
        ndarray
            (N, ny) output.
        """
        u = as_signal(u, "the input u")
        structure = self.model.structure
        if u.shape[1] != structure.n_inputs:
            raise InputError(f"the input has {u.shape[1]} channels; the model has {structure.n_inputs}.")
        return self.output_level + self.model.simulate(u - self.input_level)

    def simulate_record(self, record: Record, *, window: int) -> NDArray[np.float64]:
        """Simulated output of a record whose first samples set the initial state.

        Parameters
        ----------
        record : Record
            Its input is simulated; its output is used in the window alone.
        window : int
            Samples to which the initial state is fitted by least squares; 0 starts at rest. Of a regularised
            impulse response they tell what remains of earlier inputs and the disturbance, which are foretold from them.

        Returns
        -------
        ndarray
            (N, ny). Leave the window out of an error.
        """
        record = as_record(record, missing=True)
        if window <= 0:
            return self.simulate(record.u)
        form = self.model.structure
        if self.regularisation is not None and isinstance(form, Polynomial):
            bare = self.simulate(record.u)
            return bare + self.regularisation.continued(form, (record.y - bare)[:window], len(record))
        structure, theta = noise_free(self.model)
        short = self._made_ready(structure, record[:window], initial=True)
        point = short.evaluate(theta)
        if point is None:
            raise InputError("the model is unstable, so its initial state cannot be told from its output.")
        filled = np.where(np.isfinite(record.y), record.y, self.output_level)
        data = samples(structure, record.u - self.input_level, filled - self.output_level)
        data = np.column_stack([data, np.ones((len(record), short.data.shape[1] - data.shape[1]))])
        return filled - short.kernel.trace(data, np.concatenate([theta, point.extra[0][0]]), False)[0]

    def _made_ready(self, structure: Structure, record: Record, **which: bool) -> Problem:
        """A record as deviations from the levels of this fit, in the units of the data."""
        ones = np.ones(structure.n_inputs), np.ones(structure.n_outputs)
        gaps = not np.isfinite(record.y).all()
        problem = prepare(structure, [record], scales=ones, missing=gaps, **which)
        data = samples(structure, record.u - self.input_level, record.y - self.output_level)
        if gaps:  # as `prepare` does: what was seen, beside it
            data = np.column_stack([np.nan_to_num(data), np.isfinite(record.y)])
        return problem.replace(data=np.ascontiguousarray(data))

    def linearised(
        self, record: Record, *, initial: str | None = None
    ) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """One-step prediction errors on any record and their sensitivities to everything that was fitted.

        Parameters
        ----------
        record : Record
            Data in the units of those fitted.
        initial : {"zero", "estimate"}, optional
            Whether the record starts at rest; by default as in the fit.

        Returns
        -------
        residuals : ndarray
            (N, ny).
        jacobian : ndarray
            (N, ny, n + levels + initial states): parameters first.
        """
        record = as_record(record, missing=True)
        structure = self.model.structure
        unknown = (initial or self.initial) != "zero"
        if self.regularisation is not None and isinstance(structure, Polynomial):
            rest = record.y - self.simulate(record.u)
            e, J = self.regularisation.innovations(structure, record.u - self.input_level, rest, unknown)
            return e, J if self.output_level_errors.any() else J[:, :, : structure.n]
        problem = self._made_ready(
            structure, record, offset=bool(self.output_level_errors.any()), initial=unknown
        )
        point = problem.evaluate(np.concatenate([self.theta, np.zeros(problem.n_parameters - structure.n)]))
        if point is None:
            raise InputError(
                "the predictor of this model is unstable, so that it has no residuals on this record."
            )
        states = np.zeros(0) if point.extra[0] is None else point.extra[0][0]
        e, jacobian = problem.kernel.trace(problem.data, np.concatenate([point.z, states]), True)
        return np.where(np.isfinite(record.y), e, np.nan), np.asarray(jacobian)

    def residuals_of(self, record: Record, *, initial: str | None = None) -> NDArray[np.float64]:
        """One-step prediction errors on any record.

        Parameters
        ----------
        record : Record
            Data in the units of those fitted.
        initial : {"zero", "estimate"}, optional
            Whether the record starts at rest; by default as in the fit.

        Returns
        -------
        ndarray
            (N, ny).
        """
        return self.linearised(record, initial=initial)[0]

    def predict(self, record: Record, *, initial: str | None = None) -> NDArray[np.float64]:
        """One-step-ahead prediction of the output of a record.

        Parameters
        ----------
        record : Record
            Data in the units of those fitted.
        initial : {"zero", "estimate"}, optional
            Whether the record starts at rest; by default as in the fit.

        Returns
        -------
        ndarray
            (N, ny).
        """
        record = as_record(record, missing=True)
        return record.y - self.residuals_of(record, initial=initial)

    def to_plant(self, name: str = "identified") -> Any:
        """The model's G and noise as a plant to design experiments for.

        Parameters
        ----------
        name : str
            What the plant is called.

        Returns
        -------
        Plant
            With the same G; InputError if it is unstable, or if outputs have different noise filters.
        """
        return self.model.to_plant(name)

    def to_dict(self) -> dict:
        """Plain numbers: the model, its uncertainty and the figures of merit.

        Returns
        -------
        dict
            Ready for JSON.
        """
        gamma, error, omega = self.hinf_norm
        return {
            "model": self.model.to_dict(),
            "parameters": {
                k: [float(v), float(s)]
                for k, v, s in zip(self.names, self.theta, self.standard_errors, strict=True)
            },
            "covariance": self.covariance.tolist(),
            "input_level": self.input_level.tolist(),
            "output_level": [
                [float(v), float(s)] for v, s in zip(self.output_level, self.output_level_errors, strict=True)
            ],
            **{name: getattr(self, name) for name in _STATED},
            "noise_covariance": self.noise_covariance.tolist(),
            "hinf_norm": [gamma, error],
            "hinf_frequency": omega,
            "status": self.status.name,
            "notes": list(self.notes),
            **({"regularisation": self.regularisation.to_dict()} if self.regularisation else {}),
            **({"subspace": self.subspace.to_dict()} if self.subspace else {}),
        }

    def __repr__(self) -> str:
        r = self.records[0]
        gamma, error, omega = self.hinf_norm
        hertz = 2 * np.pi * self.model.dt
        u, y = (
            units[0] or names[0]
            for units, names in ((r.input_units, r.input_names), (r.output_units, r.output_names))
        )
        entries = (", ".join(map(str, poles_in_hz(z, self.model.dt))) for z in self.model.poles())
        poles = " | ".join(filter(None, entries))
        rows = [f"{self.model.structure!r} fitted to {self.n_samples} samples: {self.status.value}"]
        rows += [
            f"  {k:>8} = {v:12.6g} +- {s:.2g}"
            for k, v, s in zip(self.names, self.theta, self.standard_errors, strict=True)
        ]
        rows += [
            f"  noise variance {self.noise_variance:.6g} ({y})^2, fit of these data "
            f"{self.fit_percent:.2f} % one step ahead, {self.simulation_fit_percent:.2f} % simulated",
            f"  peak gain {gamma:.6g} +- {error:.2g} {per(y, u)} at {omega / hertz:.5g} +- {self.hinf_frequency_error / hertz:.2g} Hz",
            *(f"  {line}" for line in self.model.written(r.input_names, r.output_names)),
            f"  poles: {poles or 'none'}; one sample every {self.model.dt:.6g} s",
            *(f"  {how!r}" for how in (self.regularisation, self.subspace) if how),
            *(f"  note: {note}" for note in self.notes),
        ]
        return "\n".join(rows)
