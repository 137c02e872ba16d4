"""Models of measured frequency responses: rational functions weighted by the variance of every line."""

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.stats import chi2

from estimators.pem.search.levenberg_marquardt import Point, minimise
from estimators.pem.search.starts import reflected
from estimators.residual.measures import p_stated
from oed.data import frozen
from oed.errors import InputError, Status, check_sampling_time
from oed.files.objects import kinds_of
from oed.models.model import Model, Polynomial, polynomial
from oed.plants.plant import Plant

ROUNDS = 20
"""Rounds of Sanathanan and Koerner's iteration for the start; it settles within ten where it settles at all."""


@dataclass(frozen=True, eq=False)
class ResponseFit:
    """A model fitted to a frequency response.

    Attributes
    ----------
    model : Model
        G = q^-nk B / F.
    covariance : ndarray
        (n, n) covariance of the parameters.
    loss : float
        Mean over the lines of the squared error over its variance.
    p_value : float
        Of errors that large under the stated variances; not a number where none were stated.
    status : Status
        How the search ended.
    """

    model: Model
    covariance: NDArray[np.float64]
    loss: float
    p_value: float
    status: Status

    @property
    def standard_errors(self) -> NDArray[np.float64]:
        """(n,) standard errors of the parameters."""
        return np.sqrt(np.maximum(np.diag(self.covariance), 0.0))

    def to_plant(self, name: str = "identified") -> Plant:
        """The model as a plant to design experiments for; its noise is not known from a response: unit variance.

        Parameters
        ----------
        name : str
            What the plant is called.

        Returns
        -------
        Plant
            With the same G.
        """
        return self.model.to_plant(name)

    def to_dict(self) -> dict[str, Any]:
        """Plain numbers, as `Fit.to_dict`.

        Returns
        -------
        dict
            Ready for JSON.
        """
        pairs = zip(self.model.names, self.model.theta.tolist(), self.standard_errors.tolist(), strict=True)
        return {
            "model": self.model.to_dict(), "parameters": {name: [value, error] for name, value, error in pairs},
            "covariance": self.covariance.tolist(), "loss": self.loss, "p_value": self.p_value,
            "status": self.status.name,
        }  # fmt: skip

    def __repr__(self) -> str:
        pairs = zip(self.model.names, self.model.theta, self.standard_errors, strict=True)
        rows = [f"{self.model.structure!r} fitted to a frequency response: {self.status.value}"]
        rows += [f"  {name:>8} = {value:12.6g} +- {error:.2g}" for name, value, error in pairs]
        judged = f", {p_stated(self.p_value)}" if np.isfinite(self.p_value) else " (no variance given)"
        return "\n".join([*rows, f"  loss {self.loss:.6g} per line{judged}"])


def identify_response(
    response: Any,
    orders: tuple[int, int] = (2, 2),
    delay: int = 1,
    *,
    omega: ArrayLike | None = None,
    variance: ArrayLike | None = None,
    dt: float | None = None,
    max_iterations: int = 200,
) -> ResponseFit:
    """Model q^-nk B / F of a measured frequency response of one input and one output.

    The weighted squares sum |G_k - G(w_k)|^2 / v_k are minimised, the maximum likelihood where the errors of the lines are
    circular, Gaussian and independent. The search starts where linear least squares, weighted anew in turn, ends, and
    stays among stable models.

    Parameters
    ----------
    response : control.FrequencyResponseData or array_like
        The response, or its (K,) complex values at `omega`.
    orders : tuple of int
        nb coefficients of B, nf of F.
    delay : int
        nk in samples.
    omega : array_like, optional
        (K,) frequencies in rad/s; of a FrequencyResponseData its own.
    variance : array_like, optional
        (K,) variances E |error|^2, or one for all. Without it all lines weigh the same, and the errors are scaled by
        what the model leaves.
    dt : float, optional
        Sampling time in seconds of the model; of a FrequencyResponseData that has one, its own.
    max_iterations : int
        Most steps of the search.

    Returns
    -------
    ResponseFit
        Model, covariance, loss.

    Raises
    ------
    InputError
        If frequencies, values and variances do not belong together, reach beyond pi / dt, or are too few.

    References
    ----------
    C. K. Sanathanan and J. Koerner, IEEE Trans. Autom. Control 8 (1963) 56; R. Pintelon and J. Schoukens, System
    Identification: A Frequency Domain Approach, 2012, ch. 9.

    Examples
    --------
    >>> import numpy as np
    >>> w = np.linspace(0.1, 3, 40)
    >>> identify_response(0.5 * np.exp(-1j * w) / (1 - 0.8 * np.exp(-1j * w)), (1, 1), omega=w, dt=1).model.theta.round(6)
    array([ 0.5, -0.8])
    """
    w, G, v, dt = _lines(response, omega, variance, dt)
    form = polynomial("oe", orders, delay)
    if 2 * len(w) <= form.n:
        raise InputError(
            f"{len(w)} lines cannot determine {form.n} parameters; measure more, or lower the orders."
        )
    weight = 1 / np.sqrt(np.ones(len(w)) if v is None else v)

    def evaluate(theta: NDArray, _: Any) -> Point | None:
        if not Model(form, theta).stable:
            return None
        g, dg = form.response(theta, w)
        e, J = (_real(weight * (G - g[:, 0, 0])), -_real(weight[:, None] * dg[:, :, 0, 0]))
        return Point(theta, float(e @ e), J.T @ e, J.T @ J, lambda step: None)

    start = evaluate(_start(form, w, G, weight), None)
    if start is None:
        raise InputError(
            "no stable model of these orders is near this response; change the orders or the delay."
        )
    found = minimise(evaluate, start, max_iterations=max_iterations)
    freedom = 2 * len(w) - form.n
    if np.linalg.matrix_rank(found.point.hessian, hermitian=True) < form.n:
        raise InputError(f"the response does not determine {form.n} parameters: lower the orders.")
    # the real and the imaginary part of a circular error have half its variance each
    level = 0.5 if v is not None else found.point.loss / freedom
    p_value = float(chi2.sf(2 * found.point.loss, freedom)) if v is not None else float("nan")
    return ResponseFit(
        Model(form, found.point.z, dt=dt), frozen(level * np.linalg.inv(found.point.hessian)),
        found.point.loss / len(w), p_value, found.status,
    )  # fmt: skip


def _lines(
    response: Any, omega: ArrayLike | None, variance: ArrayLike | None, dt: float | None
) -> tuple[NDArray, NDArray, NDArray | None, float]:
    """Frequencies in rad/sample, response, variances and sampling time, checked."""
    kinds = kinds_of(response)
    if ("control", "FrequencyResponseData") in kinds:
        if response.ninputs != 1 or response.noutputs != 1:
            raise InputError(
                f"the response has {response.noutputs} outputs and {response.ninputs} inputs; give one entry at a time."
            )
        own = response.dt if isinstance(response.dt, float | int) and response.dt is not True else None
        omega = response.omega if omega is None else omega
        dt, response = dt or own, np.ravel(response.eval(response.omega))
    if not dt:
        raise InputError("the sampling time is missing; give dt in seconds: the model is in discrete time.")
    check_sampling_time(dt)
    if omega is None:
        raise InputError("the frequencies of the response are missing; give omega in rad/s.")
    G, w = (
        np.atleast_1d(np.asarray(response, dtype=complex)),
        np.atleast_1d(np.asarray(omega, dtype=float)) * dt,
    )
    if G.ndim != 1 or G.shape != w.shape:
        raise InputError(
            f"the response has the shape {G.shape}, omega {w.shape}; give one value for each frequency."
        )
    if not (np.isfinite(G).all() and np.isfinite(w).all()) or w.min() < 0 or w.max() > np.pi * (1 + 1e-9):
        raise InputError(
            f"the frequencies reach from {w.min() / dt:.4g} to {w.max() / dt:.4g} rad/s; values must be finite and frequencies "
            f"lie between 0 and pi / dt = {np.pi / dt:.4g}: are they in Hz, or is dt another?"
        )
    if variance is None:
        return w, G, None, float(dt)
    v = np.broadcast_to(np.asarray(variance, dtype=float), w.shape)
    if not (np.isfinite(v) & (v > 0)).all():
        raise InputError("a variance is not positive; leave out lines whose error is not known.")
    return w, G, v, float(dt)


def _real(x: NDArray) -> NDArray:
    return np.concatenate([x.real, x.imag])


def _start(form: Polynomial, w: NDArray, G: NDArray, weight: NDArray) -> NDArray[np.float64]:
    """F G - q^-nk B = 0 by weighted least squares, the weights those of the last F; the best round that is stable."""
    nb, nf, nk = int(form.nb[0, 0]), int(form.nf[0, 0]), int(form.nk[0, 0])
    delays = np.exp(-1j * np.outer(w, np.arange(max(nk + nb, nf + 1))))
    denominator, best, least = np.ones(len(w), complex), np.zeros(form.n), np.inf
    for _ in range(ROUNDS):
        rows = np.hstack([delays[:, nk : nk + nb], -G[:, None] * delays[:, 1 : nf + 1]])
        by = weight / np.abs(denominator)
        theta = np.linalg.lstsq(_real(by[:, None] * rows), _real(by * G), rcond=None)[0]
        theta[nb:] = reflected(theta[nb:])
        denominator = 1 + delays[:, 1 : nf + 1] @ theta[nb:]
        loss = float(np.sum(np.abs(weight * (G - form.response(theta, w)[0][:, 0, 0])) ** 2))
        if loss < least:
            best, least = theta, loss
    return best
