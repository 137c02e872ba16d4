"""What every design reduces to: information that is linear in the input spectrum.

    M(Phi) = M_0 + sum_k Re [ D(w_k) P_k D(w_k)^* ],   D(w) = Phi_v(w)^-1/2 dG(w), (n, r, nu)

M_0 holds what does not depend on the input: prior information, and what the noise itself tells in closed loop.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from oed.covariances import real_gram, root_in_own_units
from oed.criteria import Criterion
from oed.data import Spectrum, frozen
from oed.design.problem.orthonormal import Orthonormal, orthonormal_coordinates
from oed.errors import InputError
from oed.information import power_root, whitened_gradient
from oed.models.model import Model
from oed.plants.plant import Plant
from oed.plants.systems import as_plant
from oed.theory.quadrature import graded_edges, integral

MOST = 1000
"""Parameters of a map: a matrix of some 10,000 fills the memory, and its eigenvalues take hours."""
Responses = Callable[[NDArray[np.float64]], NDArray[np.complex128]]


@dataclass(frozen=True, eq=False)
class InformationMap:
    """Information per sample as a function of the spectrum of what may be chosen.

    Attributes
    ----------
    names : tuple of str
        The n parameters.
    n_inputs : int
        Number of chosen signals nu.
    factor : callable
        omega (K,) -> D (K, n, r, nu), complex.
    gain : callable
        omega (K,) -> G (K, ny, nu): from the chosen signals to the outputs, for limits on the outputs.
    constant : ndarray
        (n, n) information that is there whatever the input.
    resonances : ndarray
        (R, 2) frequencies and half widths in rad/sample near which the grid is made fine.
    input_gain : callable, optional
        omega (K,) -> (K, nu, nu): from the chosen signals to the plant's inputs (in closed loop); by
        default the identity.
    finer : callable, optional
        `factor` in extended precision, for parameters that double precision hardly tells apart.
    dt : float, optional
        Sampling time in seconds: frequencies are said in Hz where it is known.
    coordinates : callable, optional
        omega (K,) -> the model in coordinates that tell such parameters apart, or None.
    alike : bool
        Whether the parameters are such coordinates: of like effect.
    """

    names: tuple[str, ...]
    n_inputs: int
    factor: Responses
    gain: Responses
    constant: NDArray[np.float64]
    resonances: NDArray[np.float64] = field(default_factory=lambda: np.zeros((0, 2)))
    input_gain: Responses | None = None
    finer: Responses | None = None
    dt: float | None = None
    coordinates: Callable[[NDArray[np.float64]], Orthonormal | None] | None = None
    alike: bool = False

    def __post_init__(self) -> None:
        n = len(self.names)
        constant = np.array(self.constant, dtype=float)
        if constant.shape != (n, n) or not np.isfinite(constant).all():
            raise InputError(
                f"the constant information has the shape {constant.shape}; it must be finite and {n} x {n}."
            )
        scale = np.abs(constant).max(initial=0.0)
        if not np.allclose(constant, constant.T, rtol=1e-9, atol=1e-12 * scale):
            raise InputError("the prior information is not symmetric; an information matrix must be.")
        if np.linalg.eigvalsh(constant)[0] < -1e-9 * scale:
            raise InputError(
                "the prior information has a negative eigenvalue; it must be positive semidefinite."
            )
        object.__setattr__(self, "constant", frozen((constant + constant.T) / 2))

    @property
    def n(self) -> int:
        """Number of parameters."""
        return len(self.names)

    def of_spectrum(self, spectrum: Spectrum) -> NDArray[np.float64]:
        """Information per sample of a spectrum, the constant part included.

        Parameters
        ----------
        spectrum : Spectrum
            One-sided lines.

        Returns
        -------
        ndarray
            (n, n).
        """
        if spectrum.n_inputs != self.n_inputs:
            raise InputError(
                f"the spectrum has {spectrum.n_inputs} channels and the plant {self.n_inputs} inputs; they must agree."
            )
        if not len(spectrum):
            return self.constant
        return self.constant + real_gram(self._flat(spectrum))

    def loss(self, criterion: Criterion, spectrum: Spectrum) -> float:
        """Loss of a spectrum, from the factor of its information: where the parameters' scales differ by 1e7 the
        information itself has no digits of it.

        Parameters
        ----------
        criterion : Criterion
            Of the map's parameters.
        spectrum : Spectrum
            One-sided lines.

        Returns
        -------
        float
            Infinite where the spectrum does not determine what is asked.
        """
        flat = self._flat(spectrum)
        return criterion.loss_of_factor(
            np.concatenate([flat.real, flat.imag, root_in_own_units(self.constant)[0]], axis=1)
        )

    def _flat(self, spectrum: Spectrum) -> NDArray[np.complex128]:
        parts = np.einsum("knpq,kqr->nkpr", self.factor(spectrum.omega), power_root(spectrum))
        return parts.reshape(self.n, -1)

    def with_prior(self, information: ArrayLike) -> InformationMap:
        """The same map with information from experiments already done.

        Parameters
        ----------
        information : array_like
            (n, n), per sample of the experiment that is designed (N_old / N_new times the old one's).

        Returns
        -------
        InformationMap
            With the sum as constant part.
        """
        prior = np.asarray(information, dtype=float)
        if prior.shape != (self.n, self.n):
            raise InputError(
                f"the prior information has the shape {prior.shape}; the model has {self.n} parameters."
            )
        return replace(self, constant=self.constant + prior)


def resonances_of(dens: Sequence[NDArray[np.float64]]) -> NDArray[np.float64]:
    """Frequencies and half widths of the poles of some denominators: returns (R, 2)."""
    roots = [np.roots(den) for den in dens if len(den) > 1]
    poles = np.concatenate([*roots, np.zeros(0, complex)])
    poles = poles[(poles.imag >= 0) & (np.abs(poles) > 1e-3)]
    widths = np.maximum(np.abs(1 - np.abs(poles)), 1e-12)
    rows = np.column_stack([np.abs(np.angle(poles)), widths]).reshape(-1, 2)
    return np.asarray(np.unique(np.round(rows, 13), axis=0), dtype=np.float64)


def information_map(
    model: Any,
    *,
    noise_covariance: ArrayLike | None = None,
    noise_response: Callable[[NDArray], NDArray] | None = None,
) -> InformationMap:
    """Reduce a plant or model to its information map.

    Parameters
    ----------
    model : Plant, Model, InformationMap or object
        Any object with `response(omega) -> (G, dG)` will do.
    noise_covariance : array_like, optional
        (ny, ny) or a number, for a model that has only `response`; default 1.
    noise_response : callable, optional
        omega -> H (K,), for a model that has only `response`; default 1.

    Returns
    -------
    InformationMap
        The map; parameters of the noise model add their information to the constant part.
    """
    if isinstance(model, InformationMap):
        return model
    if isinstance(model, Plant):
        _check_number(len(model.free))
        dens = [den for row in model.den for den in row] + [model.noise_num]
        return InformationMap(
            model.free, model.n_inputs, lambda omega: whitened_gradient(model, omega),
            lambda omega: model.response(omega)[0], np.zeros((len(model.free),) * 2), resonances_of(dens),
            finer=lambda omega: whitened_gradient(model, omega.astype(np.longdouble)), dt=model.dt,
            coordinates=lambda omega: orthonormal_coordinates(model, omega),
        )  # fmt: skip
    if isinstance(model, Model):
        return _of_model(model)
    own = (getattr(type(model), "response", None), getattr(model, "__dict__", {}).get("response"))
    if not any(map(callable, own)):  # told without touching a property, such as that of measured responses
        return information_map(as_plant(model))
    G, dG = model.response(np.array([0.1, 0.2]))
    ny, nu = np.shape(G)[1:]
    W = _whitening(np.asarray(1.0 if noise_covariance is None else noise_covariance), ny)

    def factor(omega: NDArray) -> NDArray:
        D = np.einsum("pr,knrq->knpq", W, model.response(omega)[1])
        return D if noise_response is None else D / noise_response(omega)[:, None, None, None]

    n = np.shape(dG)[1]
    _check_number(n)
    names = tuple(f"theta{i + 1}" for i in range(n))
    return InformationMap(names, nu, factor, lambda omega: model.response(omega)[0], np.zeros((n, n)))


def _check_number(parameters: int) -> None:
    if parameters > MOST:
        raise InputError(
            f"the model has {parameters} unknown parameters, and their information is computed for at most {MOST}; name the ones that "
            "matter in `free`, or lower the order."
        )


def _whitening(covariance: NDArray, ny: int) -> NDArray[np.float64]:
    covariance = covariance * np.eye(ny) if covariance.ndim == 0 else covariance
    try:
        return np.asarray(np.linalg.inv(np.linalg.cholesky(covariance)), dtype=np.float64)
    except np.linalg.LinAlgError:
        raise InputError(
            "the noise covariance is not positive definite, so the information is infinite; give every output a "
            "positive noise variance."
        ) from None


def _of_model(model: Model) -> InformationMap:
    """A polynomial model: H may have parameters of its own or share those of A."""
    _check_number(model.structure.n)
    W = _whitening(model.noise_covariance, model.structure.n_outputs)

    def factor(omega: NDArray) -> NDArray:
        H, _ = model.noise_response(omega)
        return np.einsum("kpr,knrq->knpq", W @ np.linalg.inv(H), model.response(omega)[1])

    def finer(omega: NDArray) -> NDArray:
        """Outputs of polynomial models have a noise filter each, and no other's."""
        omega = omega.astype(np.longdouble)
        H = np.einsum("kpp->kp", model.noise_response(omega)[0])
        return np.einsum("pr,knrq->knpq", W, model.response(omega)[1] / H[:, None, :, None])

    rows = model.structure.coefficients(model.theta)
    dens = [p for row in rows for x in "acf" for p in row[x]]
    return InformationMap(
        model.names, model.structure.n_inputs, factor, lambda omega: model.response(omega)[0],
        noise_information(model, W), resonances_of(dens), finer=finer, dt=model.dt,
    )  # fmt: skip


def noise_information(model: Model, W: NDArray[np.float64]) -> NDArray[np.float64]:
    """Information that the noise carries about the parameters of H: (1/2pi) int tr of dH_i H^-1 terms."""
    L = np.linalg.inv(W)

    def squares(omega: NDArray) -> NDArray[np.float64]:
        H, dH = model.noise_response(omega)
        psi = np.einsum("kpr,knrs,sq->knpq", W @ np.linalg.inv(H), dH, L).reshape(
            len(omega), len(model.names), -1
        )
        return (psi @ psi.conj().swapaxes(1, 2)).real

    rows = model.structure.coefficients(model.theta)
    edges = graded_edges(0.0, np.pi, resonances_of([p for row in rows for x in "acdf" for p in row[x]]))
    return integral(squares, edges) / np.pi
