"""Fisher information of an input about the parameters of a plant or model.

For Gaussian noise with spectrum Phi_v = H Lambda H*, per sample and asymptotically ([S] Lemma 13)

    I_ij = sum_k Re tr( dG_i(w_k) P_k dG_j(w_k)* Phi_v(w_k)^-1 ),

which is linear in the spectrum, hence additive over experiments."""

from __future__ import annotations

from collections.abc import Iterator
from typing import TYPE_CHECKING, Any, Protocol

import numpy as np
from numpy.typing import ArrayLike, NDArray

from oed.covariances import square_root
from oed.data import Spectrum, as_signal
from oed.errors import InputError, NotIdentifiable

if TYPE_CHECKING:
    from oed.plants.plant import Plant

TOGETHER = 2**18
"""Numbers in the gradients that are computed together."""


class Responding(Protocol):
    """What information and design ask of any model: its response with derivatives, and its noise."""

    @property
    def noise_covariance(self) -> NDArray[np.float64]:
        """Covariance Lambda of the white noise e, (ny, ny)."""
        ...

    def response(self, omega: ArrayLike) -> tuple[NDArray[np.complex128], NDArray[np.complex128]]:
        """G (K, ny, nu) and dG (K, n, ny, nu)."""
        ...

    def noise_response(self, omega: ArrayLike) -> NDArray | tuple[NDArray, NDArray]:
        """Noise filter H(e^jw)."""
        ...


def inverse_root(covariance: NDArray[np.float64]) -> NDArray[np.float64]:
    """W with W' W = Lambda^-1; an InputError where Lambda is singular."""
    try:
        return np.asarray(np.linalg.inv(np.linalg.cholesky(covariance)), dtype=np.float64)
    except np.linalg.LinAlgError:
        raise InputError(
            "the noise covariance is singular (some combination of outputs is free of noise), so the information "
            "is infinite; give every output a positive noise variance."
        ) from None


def whitened_gradient(model: Responding, omega: ArrayLike) -> NDArray[np.complex128]:
    """dG with the noise whitened, Phi_v^-1/2 dG_i: omega (K,) -> (K, n, ny, nu)."""
    W = inverse_root(model.noise_covariance)
    dG = model.response(omega)[1]
    H = model.noise_response(omega)
    if isinstance(H, tuple):
        return np.einsum("kpr,knrq->knpq", W @ np.linalg.inv(H[0]), dG)
    whitened: Any = np.tensordot(W, dG, (1, 2))
    return np.moveaxis(whitened, 0, 2) / H[:, None, None, None]


ENTRIES = 2_000_000
"""Entries of dG, lines times parameters times channels, that are in memory at a time: 32 MB, of which there are a few copies."""


def information_of_spectrum(model: Responding, spectrum: Spectrum) -> NDArray[np.float64]:
    """Fisher information per sample of an input with a given spectrum, [S] Lemma 13.

    Parameters
    ----------
    model : Plant or model
        The model.
    spectrum : Spectrum
        One-sided lines whose powers sum to the input power.

    Returns
    -------
    ndarray
        (n, n), symmetric; multiply by the number of samples for an experiment. It is what the input brings:
        what noise alone tells of a Model's noise filter is the constant part of its `information_map`.

    Notes
    -----
    Source: [S] Lemma 13. Twin: brute-force integration with finite differences in tests/oracles.
    """
    from oed.models.model import Model

    model = model if isinstance(model, Model) else _as_plant(model)
    at_once = max(ENTRIES // model.response(spectrum.omega[:1])[1].size, 1)
    lines = range(0, max(len(spectrum.omega), 1), at_once)
    parts = (
        information_rows(model, Spectrum(spectrum.omega[k : k + at_once], spectrum.power[k : k + at_once]))
        for k in lines
    )
    return np.sum([rows.T @ rows for rows in parts], axis=0)


def information_rows(model: Responding, spectrum: Spectrum) -> NDArray[np.float64]:
    """R (K, n) with R'R the information of a spectrum: half of its condition, for what needs every digit."""
    psi = np.einsum("knpq,kqr->nkpr", whitened_gradient(model, spectrum.omega), power_root(spectrum))
    flat = psi.reshape(len(psi), -1)
    return np.concatenate([flat.real, flat.imag], axis=1).T


def power_root(spectrum: Spectrum) -> NDArray[np.complex128]:
    """R_k with R_k R_k^* = P_k for every line, in units of every channel's own power: what is little beside another channel's keeps
    its digits, and may be all that a sharp resonance is known by: returns (K, nu, nu)."""
    if spectrum.n_inputs == 1:
        return np.sqrt(np.clip(spectrum.power.real, 0, None)).astype(complex)
    own = np.sqrt(np.clip(np.einsum("kii->ki", spectrum.power).real, 0, None))
    unit = np.where(own > 0, own, 1.0)
    return unit[:, :, None] * square_root(spectrum.power / (unit[:, :, None] * unit[:, None, :]))


def information_of_signal(plant: Responding, u: ArrayLike) -> NDArray[np.float64]:
    """Fisher information of a finite experiment from rest: sum over samples of psi_t Lambda^-1 psi_t'.

    psi_t is the exact derivative of the whitened one-step prediction, by the filters dG_i / H applied to the
    input, so edge effects are in it (the spectrum's information times N leaves them out).

    Parameters
    ----------
    plant : Plant or model
        With `gradient_filters()` or, for a Plant, its rational form.
    u : array_like
        (N, nu) input.

    Returns
    -------
    ndarray
        (n, n), for the whole experiment.
    """
    return information_of_records(plant, [np.asarray(u)])


def signal_gradient(plant: Responding, u: ArrayLike) -> NDArray[np.float64]:
    """Derivative of the one-step prediction with respect to the parameters, from rest: u (N, nu) -> (N, n,
    ny)."""
    psi = _signal_gradients(_as_plant(plant), as_signal(u, "the input")[None])[:, :, 0]
    return np.ascontiguousarray(psi.transpose(2, 1, 0))


def _as_plant(plant: Responding) -> Plant:
    from oed.plants.systems import as_plant

    return as_plant(plant)


def _signal_gradients(plant: Plant, u: NDArray[np.float64]) -> NDArray[np.float64]:
    """The gradients of several experiments of one length: from (M, N, nu) to (ny, n, M, N), time last for speed."""
    from scipy.signal import lfilter

    M, N, nu = u.shape
    if nu != plant.n_inputs:
        raise InputError(f"the input has {nu} channels and the plant {plant.n_inputs}; they must agree.")
    rows = [row for row in plant._parameters() if row[0] in plant.free]
    psi = np.zeros((plant.n_outputs, len(rows), M, N))
    white = plant.white_noise
    base: dict[tuple[str, int, int], NDArray] = {}
    for n, (_, letter, power, i, j, _) in enumerate(rows):
        A, B = plant.den[i][j], plant.num[i][j]
        if (letter, i, j) not in base:
            x = np.asarray(lfilter([1.0], A, u[:, :, j]))
            x = x if white else np.asarray(lfilter(plant.noise_den, plant.noise_num, x))
            base[letter, i, j] = x if letter == "b" else -np.asarray(lfilter(B, A, x))
        psi[i, n, :, power:] = base[letter, i, j][:, : max(N - power, 0)]
    return psi


def information_of_records(plant: Responding, inputs: list[NDArray[np.float64]]) -> NDArray[np.float64]:
    """Fisher information of several experiments together, the sum over experiments ([S] (19)).

    Parameters
    ----------
    plant : Plant
        The plant.
    inputs : list of ndarray
        (N_k, nu) each.

    Returns
    -------
    ndarray
        (n, n).
    """
    plant = _as_plant(plant)
    n = len(plant.free)
    total = np.zeros((n, n))
    for _, gradients in _weighted_gradients(plant, inputs):
        for flat in gradients.reshape(plant.n_outputs, n, -1):
            total += flat @ flat.T
    return total


def information_of_each(plant: Responding, inputs: list[NDArray[np.float64]]) -> NDArray[np.float64]:
    """Fisher information of each of several experiments: inputs (N_k, nu) -> (experiments, n, n)."""
    plant = _as_plant(plant)
    n = len(plant.free)
    found = np.zeros((len(inputs), n, n))
    for places, gradients in _weighted_gradients(plant, inputs):
        for output in gradients.transpose(0, 2, 1, 3):
            found[places] += output @ output.transpose(0, 2, 1)
    return found


def _weighted_gradients(
    plant: Plant, inputs: list[NDArray[np.float64]]
) -> Iterator[tuple[list[int], NDArray[np.float64]]]:
    """Which experiments, and their gradients weighted by the noise, (ny, n, M, N); as many as memory should hold."""
    W = inverse_root(plant.noise_covariance)
    apart = np.count_nonzero(W) == np.count_nonzero(np.diag(W))
    signals = [as_signal(u, "the input") for u in inputs]
    for length in sorted({len(u) for u in signals}):
        same = [k for k, u in enumerate(signals) if len(u) == length]
        each = max(1, TOGETHER // (length * max(len(plant.free), 1) * plant.n_outputs))
        for k in range(0, len(same), each):
            places = same[k : k + each]
            psi = _signal_gradients(plant, np.stack([signals[p] for p in places]))
            if apart:
                psi *= np.diag(W)[:, None, None, None]
            yield places, psi if apart else np.tensordot(W, psi, axes=1)


def null_directions(information: NDArray[np.float64], names: tuple[str, ...]) -> list[str]:
    """Combinations of parameters on which there is no information, in words: information (n, n)."""
    scale = np.sqrt(np.clip(np.diag(information), 0, None))
    dead = scale <= 0
    safe = np.where(dead, 1.0, scale)
    values, vectors = np.linalg.eigh(information / np.outer(safe, safe))
    null = vectors[:, values <= len(values) * 4e-15 * max(values.max(), 1e-300)] / safe[:, None]
    sentences = []
    for direction in null.T:
        direction = direction / np.linalg.norm(direction)
        terms = [f"{c:+.2g} {name}" for c, name in zip(direction, names, strict=True) if abs(c) > 0.01]
        sentences.append(" ".join(terms).lstrip("+"))
    return sentences


def covariance(information: NDArray[np.float64], names: tuple[str, ...] = ()) -> NDArray[np.float64]:
    """Inverse of the information: the Cramer-Rao bound on the covariance of unbiased estimates; information
    (n, n) -> (n, n)."""
    names = names or tuple(f"theta{i + 1}" for i in range(len(information)))
    null = null_directions(information, names)
    if null:
        raise NotIdentifiable(
            f"the input carries no information on {'; '.join(null)}: excite more frequencies, or hold some of these "
            "parameters fixed."
        )
    scale = 1 / np.sqrt(np.diag(information))
    return scale[:, None] * np.linalg.inv(scale[:, None] * information * scale) * scale
