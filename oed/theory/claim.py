"""Where the claim of [S] Sec. 4.2 holds: is the sinusoid at the peak, is the limit spectrum, an optimal design?

**Gain-scaling theorem.** Let the measurement noise be white with covariance lambda I, the total input power at most 1,
gamma = ||G||_inf attained at w^ only, with simple singular vectors u, v; and let the parametrisation be closed under
gain scaling at the true plant: some x has sum_i x_i G'_i = G / gamma. With c = d gamma / d theta, every spectrum has

    c' I^-1 c >= lambda,

and the sinusoid at w^ in direction v attains it.

*Proof.* c_i = Re(u^* G'_i(w^) v) (envelope theorem), so c'x = Re(u^* G(w^) v) / gamma = 1. By Cauchy-Schwarz
(c'x)^2 <= (c' I^-1 c) (x' I x) for every x (with c in the range of I, otherwise the left side is infinite). By linearity

    x' I x = (1 / lambda) (1/2pi) int tr(G Phi G^*) / gamma^2 dw <= (1 / lambda) (1/2pi) int tr Phi dw <= 1 / lambda,

since G^* G <= gamma^2 identity. Hence c' I^-1 c >= (c'x)^2 / (x' I x) >= lambda. The sinusoid: Phi = v v^* at w^ gives
I = (1/lambda) Re(g g^*) with g_i = G'_i(w^) v (n x ny). Put y = lambda x: I y = Re(g g^* x) = Re(g (G v / gamma)^*)^T
= Re(u^* g_i) = c, because sum_i x_i g_i = G v / gamma = u. So c' I^-1 c = y' I y = lambda c'x = lambda. Without the
uniqueness of w^ the gain has no gradient. With the output's power limited to P_y instead, the same x gives
x' I x <= P_y / (lambda gamma^2), and the same sinusoid attains lambda gamma^2 / P_y. QED

It breaks where no such x exists (known gain, monic numerator), where the noise is coloured or unequal over outputs, where
single channels or amplitudes are limited, and with an unknown offset when w^ = 0. `map_of_claim` and
`oed.theory.cases` measure by how much."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from oed.data import Spectrum
from oed.errors import OedError
from oed.plants.norms import gain_gradient, peak
from oed.plants.plant import Plant
from oed.plants.systems import as_plant


def peak_sinusoid_spectrum(plant: Plant, power: float = 1.0) -> Spectrum:
    """The sinusoid at the peak in its input direction.

    Parameters
    ----------
    plant : Plant
        The plant.
    power : float
        Input power.

    Returns
    -------
    Spectrum
        One line.
    """
    at = peak(plant)
    v = at.input_direction
    P = np.outer(v, v.conj())
    if at.frequency in (0.0, np.pi):
        P = P.real.astype(complex)
    return Spectrum(np.array([at.frequency]), power * P[None])


def gain_scaling_residual(plant: Plant, points: int = 200) -> tuple[float, NDArray[np.float64]]:
    """How far the parametrisation is from being closed under gain scaling.

    Parameters
    ----------
    plant : Plant
        The plant; only its unknown parameters count.
    points : int
        Frequencies at which sum_i x_i G'_i = G / gamma is asked for.

    Returns
    -------
    residual : float
        Relative norm of what is left: at most about 1e-10 where the theorem applies.
    x : ndarray
        (n,) the best combination.
    """
    omega, plant = (np.arange(points) + 0.5) * np.pi / points, as_plant(plant)
    G, dG = plant.response(omega)
    rows = np.moveaxis(dG, 1, 0).reshape(dG.shape[1], -1)
    target = G.ravel() / peak(plant).value
    scale = np.linalg.norm(rows, axis=1)
    A = np.concatenate([rows.real, rows.imag], axis=1).T / scale
    b = np.concatenate([target.real, target.imag])
    x = np.linalg.lstsq(A, b, rcond=None)[0]
    return float(np.linalg.norm(A @ x - b) / np.linalg.norm(b)), x / scale


@dataclass(frozen=True, eq=False)
class ClaimRow:
    """One plant of the map.

    Attributes
    ----------
    plant : str
        Its name.
    noise_variance : float
        Mean per output.
    closed : bool
        Whether the theorem's condition on the parametrisation holds.
    sinusoid : float
        c-efficiency of the sinusoid at the peak against the certified optimum.
    limit : float
        c-efficiency of the iterations' limit spectrum (one input and output), else NaN.
    white : float
        c-efficiency of white noise.
    optimum : float
        Optimal loss over the noise variance: 1 where the theorem applies.
    gap : float
        Relative gap of the certificate.
    note : str
        Why a number is missing.
    bound : float
        Certified: no admissible spectrum has a smaller variance of the peak gain per sample.
    largest_price, price_frequency : float
        Of the certificate, and where.
    """

    plant: str
    noise_variance: float
    closed: bool
    sinusoid: float
    limit: float
    white: float
    optimum: float
    gap: float
    note: str = ""
    bound: float = float("nan")
    largest_price: float = float("nan")
    price_frequency: float = float("nan")


def map_of_claim(plants: Sequence[Plant], **limits: float) -> list[ClaimRow]:
    """c-efficiency of the sinusoid at the peak and of the limit spectrum, plant by plant, with certificates.

    Parameters
    ----------
    plants : sequence of Plant
        Each with its noise and its unknown parameters.
    **limits : float
        As for `solve_design`: input_power, output_power, ...; default an input power of 1.

    Returns
    -------
    list of ClaimRow
        One per plant; what could not be computed is a row with a note.
    """
    return [claim_row(as_plant(plant), limits) for plant in plants]


def claim_row(plant: Plant, limits: dict[str, Any]) -> ClaimRow:
    """One row of the map."""
    from oed.criteria import c_criterion
    from oed.design import solve_design

    nan = float("nan")
    try:
        closed = gain_scaling_residual(plant)[0] < 1e-9
        design = solve_design(plant, "hinf", **limits)
    except OedError as error:
        return ClaimRow(plant.name, plant.noise_variance, False, nan, nan, nan, nan, nan, str(error))
    criterion = c_criterion(gain_gradient(plant))
    sinusoid = peak_sinusoid_spectrum(plant)
    low, high = limits.get("band") or (0.0, np.pi)
    allowed = low <= sinusoid.omega[0] <= high
    largest = min(
        limit / float(np.einsum("kqr,krq->", budget_form(plant, name, sinusoid.omega), sinusoid.power).real)
        for name, limit in design.limits.items()
    )
    loss = criterion.loss(design.map.of_spectrum(sinusoid * largest)) if allowed else np.inf
    limit, note = nan, "" if allowed else "the peak lies outside the band"
    if allowed and set(design.limits) == {"input power"} and "band" not in limits:
        limit, note = _limit_efficiency(plant, design)
    return ClaimRow(
        plant=plant.name, noise_variance=plant.noise_variance, closed=closed, sinusoid=design.bound / loss,
        limit=limit, white=nan if "band" in limits else design.efficiency_white,
        optimum=design.loss / plant.noise_variance, gap=design.gap, note=note, bound=design.bound,
        largest_price=design.certificate.largest_price, price_frequency=design.certificate.frequency,
    )  # fmt: skip


def offset_row(plant: Plant, samples: int) -> ClaimRow:
    """The map's row where a constant offset at the output is unknown. The offset takes all information that a
    line at frequency 0 carries: its regressor is the same constant. What is left are lines of whole periods,
    from 2 pi / N on."""
    row = claim_row(plant, {"band": (2 * np.pi / samples, np.pi)})
    note = f"lines from 2 pi / {samples} on" + (f"; {row.note}" if row.note else "")
    return replace(row, limit=float("nan"), white=float("nan"), note=note)


def amplitude_row(plant: Plant, amplitude: float) -> ClaimRow:
    """The map's row where |u| is limited, not its power. A signal within the amplitude a has a power of at
    most a^2, which bounds its information; the sinusoid at the peak has a^2 / 2, a square wave of its
    frequency a^2, of which its fundamental holds 8 / pi^2. Where the gain-scaling theorem holds, x' I x is
    the mean square of G u / gamma over the noise variance, and for plants of at most two states sums of
    squares bound it more tightly than the power does (`oed.design.parametrisations.bounded_inputs`)."""
    relaxed = claim_row(plant, {"input_power": amplitude**2})
    if not np.isfinite(relaxed.bound):
        return relaxed
    from oed.criteria import c_criterion
    from oed.information import information_of_spectrum

    criterion, at = c_criterion(gain_gradient(plant)), peak(plant).frequency
    constant = at in (0.0, float(np.pi))
    loss = lambda spectrum: criterion.loss(information_of_spectrum(plant, spectrum))
    square = sinusoid = loss(peak_sinusoid_spectrum(plant, amplitude**2 * (1.0 if constant else 0.5)))
    if not constant:
        # sign(cos(w t)): odd harmonics k of power 8 / (pi k)^2 each, folded into [0, pi] by sampling.
        k = np.arange(1, 4001, 2)
        folded = np.abs((k * at + np.pi) % (2 * np.pi) - np.pi)
        power = 8 / (np.pi * k) ** 2
        square = loss(Spectrum(folded, amplitude**2 * power / power.sum()))
    best = min(square, sinusoid)
    share = 1.0 if constant else _passed_share(plant, relaxed.closed)
    bound = relaxed.bound / share
    how = "" if share == 1.0 else f" by sums of squares, {1 / share:.4f} times that"
    return replace(
        relaxed, sinusoid=bound / sinusoid, limit=float("nan"), white=float("nan"), optimum=best / plant.noise_variance,
        gap=best / bound - 1, bound=bound,
        note=f"square wave {bound / square:.4f}; the bound is{how or ' that'} of the power a^2",
    )  # fmt: skip


def _passed_share(plant: Plant, closed: bool) -> float:
    """Certified bound on the mean square of G u / gamma over |u| <= 1; 1 where sums of squares do not apply."""
    from oed.design.parametrisations.bounded_inputs import passed_power
    from oed.errors import InputError

    white = len(plant.noise_num) == len(plant.noise_den) == 1
    if not (closed and white and plant.n_inputs * plant.n_outputs == 1):
        return 1.0
    try:
        return min(1.0, passed_power(plant.num[0][0] / peak(plant).value, plant.den[0][0]))
    except InputError:
        return 1.0


def budget_form(plant: Plant, name: str, omega: NDArray[np.float64]) -> NDArray[np.complex128]:
    """The Hermitian form that a named limit puts on a line's power: omega (K,) -> (K, nu, nu)."""
    if name == "output power":
        G = plant.transfer(omega)
        return G.conj().swapaxes(1, 2) @ G
    form = np.eye(plant.n_inputs, dtype=complex)
    if name.startswith(("power of input", "rate of input")):
        form = np.diag(np.eye(plant.n_inputs)[int(name.split()[-1]) - 1]).astype(complex)
    if name.startswith("rate of input"):
        return form * (np.abs(1 - np.exp(-1j * omega)) ** 2)[:, None, None]
    return np.broadcast_to(form, (len(omega), *form.shape))


def _limit_efficiency(plant: Plant, design: Any) -> tuple[float, str]:
    """Of the limit spectrum of Algorithm 1; with several inputs or outputs of Procedure 2, unscaled."""
    from oed.theory.limit import limit_spectrum
    from oed.theory.mimo import mimo_limit_spectrum

    several = plant.n_inputs * plant.n_outputs > 1
    try:
        spectrum = (mimo_limit_spectrum if several else limit_spectrum)(plant).spectrum
        information = design.map.of_spectrum(spectrum * (design.limits["input power"] / spectrum.total_power))
    except OedError as error:
        return float("nan"), str(error)
    return design.bound / design.criterion.loss(information), ""
