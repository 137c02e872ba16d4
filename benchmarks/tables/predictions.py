"""What `oed theory` reports: the theory's prediction for the iterations, and the map of [S] Sec. 4.2's claim, as rows."""

from collections.abc import Callable, Sequence
from dataclasses import asdict
from functools import partial
from typing import Any

import numpy as np

from oed.plants.plant import Plant
from oed.theory.cases import ClaimCase, claim_cases, claim_map
from oed.theory.claim import ClaimRow
from oed.theory.limit import LimitSpectrum, limit_spectrum

CRITERIA = ("c", "D", "A", "E")
MOST_PARAMETERS = 64
"""Of a plant whose optima are looked for here: four certified designs of so many take some ten seconds, of a hundred minutes."""
TOLERANCE = 1e-5
"""Gap of an optimum that an efficiency is stated against: it is printed to five decimals, and where many peaks are narrow the next
digit takes a minute."""
PLAIN = 1e-3
"""An efficiency below this is printed by its digits, not by its decimals."""


def optimal_loss(plant: Plant, criterion: str) -> float:
    """Certified optimal loss of a plant at unit input power."""
    from oed.design import solve_design
    from oed.plants.norms import peak

    if criterion == "c":
        return (
            float(solve_design(plant, "hinf", tolerance=TOLERANCE).bound)
            if peak(plant).unique
            else float("nan")
        )
    return float(solve_design(plant, criterion, tolerance=TOLERANCE).bound)


def optimal_losses(plant: Plant) -> Any:
    """Certified optimal losses of a plant for c, D, A and E at unit input power."""
    from oed.theory.efficiency import Losses

    return Losses(**{k: optimal_loss(plant, k) for k in CRITERIA})


def _efficiencies(plant: Plant, spectrum: Any) -> dict[str, float]:
    from oed.plants.norms import gain_gradient, peak
    from oed.theory.efficiency import losses_of_spectrum

    if len(plant.free) > MOST_PARAMETERS:
        return {f"{k.lower()}_efficiency": float("nan") for k in CRITERIA}
    top = peak(plant)
    c = gain_gradient(plant, top) if top.unique else None
    share = losses_of_spectrum(plant, spectrum, c).efficiency(optimal_losses(plant))
    return {f"{k.lower()}_efficiency": getattr(share, k) for k in CRITERIA}


def siso_prediction(plant: Plant, *, experiments: int, samples: int | None) -> tuple[dict[str, Any], str]:
    """Prediction for Algorithm 1 on a plant with one input and one output."""
    from oed.theory.efficiency import peak_gain_efficiency_by_experiments

    limit = limit_spectrum(plant)
    # Where the gain-scaling theorem gives the optimum.
    usual = plant.white_noise and plant.free == plant.all_names
    few = len(plant.free) <= MOST_PARAMETERS
    optimum = None if usual else optimal_loss(plant, "c") if few else float("nan")
    together = peak_gain_efficiency_by_experiments(plant, experiments, optimum)
    payload = _predicted(plant, limit, algorithm="siso", beta2_mean=limit.beta2_mean) | {
        "c_efficiency_by_experiments": together, "peak_frequencies": list(limit.peak.frequencies),
    }  # fmt: skip
    if plant.dt != 1:
        payload["peak_frequency_hz"] = limit.peak.frequency / (2 * np.pi * plant.dt)
    if samples is not None:
        from oed.theory.finite import finite_prediction

        payload |= finite_prediction(plant, samples)
    return payload, _siso_text(plant, limit, payload)


def _siso_text(plant: Plant, limit: LimitSpectrum, payload: dict[str, Any]) -> str:
    gamma = payload["hinf_norm"]
    together = payload["c_efficiency_by_experiments"]
    mean = payload["beta2_mean"]
    bias = f"biased by {limit.beta2_bias:+.4g}" if mean > 0 else "lost in the noise"
    lines = [
        f"Power iterations (Algorithm 1) on {plant.name}, noise variance {plant.noise_variance:g}",
        f"  H-infinity norm      {gamma:.12g} at {payload['peak_frequency']:.10g} rad/sample, {_hertz(plant, payload)}"
        f" (curvature of its square {payload['peak_curvature']:.6g})",
        f"  limit of mu^2        {payload['mu2']:.12g} = norm^2 + {payload['mu2_excess']:.6g} (mu: ratio of output to input norm)",
        f"  limit of E beta_2^2  {mean:.10g} (beta_2, the own estimate, is {bias})",
        f"  limit spectrum       from {payload['spectrum_min']:.6g} to {payload['spectrum_max']:.6g} of the mean input power",
        "  efficiency of the limit spectrum against certified optima:",
        "    " + _efficiencies_text(plant, payload),
        "  peak-gain efficiency of the first n experiments together:",
        "    " + _together_text(plant, limit, together),
    ]
    if "finite_norm" in payload:
        lines.append(_finite_text(payload))
    return "\n".join(lines)


def _too_many(plant: Plant) -> str:
    return (
        f"the plant has {len(plant.free)} unknown parameters, and optima are computed for at most {MOST_PARAMETERS}; "
        "name the ones that matter in `free`"
    )


def _together_text(plant: Plant, limit: LimitSpectrum, together: Any) -> str:
    if np.isnan(together).all():
        many = f"the gain is largest at {len(limit.peak.frequencies)} frequencies, and its estimate has no derivative there"
        return f"left out: {_too_many(plant) if limit.peak.unique else many}"
    return ", ".join(f"n={k + 1}: {together[k]:.4f}" for k in _some(len(together)))


def _hertz(plant: Plant, payload: dict[str, Any]) -> str:
    return f"{payload['peak_frequency'] / (2 * np.pi * plant.dt):.6g} Hz"


WORDS = {
    "c": "peak gain (c)",
    "D": "all parameters, volume (D)",
    "A": "all parameters, sum (A)",
    "E": "worst direction (E)",
}
"""What each criterion asks for, beside its letter."""


def _efficiencies_text(plant: Plant, payload: dict[str, Any]) -> str:
    if len(plant.free) > MOST_PARAMETERS:
        return f"left out: {_too_many(plant)}"
    values = {k: payload[f"{k.lower()}_efficiency"] for k in CRITERIA}
    said = {k: f"{v:.5f}" if v >= PLAIN else f"{v:.3g}" for k, v in values.items()}
    said |= {k: "0 to rounding" for k, v in values.items() if v == 0}
    said |= {k: "not defined (the peak is not unique)" for k, v in values.items() if v != v}
    return ", ".join(f"{WORDS[k]} {words}" for k, words in said.items())


def _finite_text(payload: dict[str, Any]) -> str:
    line = f"  at {payload['samples']} samples: finite-time norm {payload['finite_norm']:.9g}"
    if "finite_mu2" in payload:
        line += f", mu^2 {payload['finite_mu2']:.7g}, mean squared gain {payload['finite_beta2_mean']:.7g}"
    if "finite_beta2_mean_random_mu" in payload:
        line += f" ({payload['finite_beta2_mean_random_mu']:.7g} with the fluctuation of mu)"
    return line


def _some(n: int) -> list[int]:
    return sorted({k for k in (0, 1, 4, 9, 49, 199, n - 1) if k < n})


def _predicted(plant: Plant, limit: Any, **more: Any) -> dict[str, Any]:
    """What both limits have in common, under the keys of the command line."""
    peak = {
        "hinf_norm": limit.peak.value,
        "peak_frequency": limit.peak.frequency,
        "peak_curvature": limit.peak.curvature,
    }
    stated = ("mu2", "mu2_excess", "spectrum_max", "spectrum_min")
    return {
        "plant": plant.name, "noise_variance": plant.noise_variance, **more, **peak,
        **{name: getattr(limit, name) for name in stated}, **_efficiencies(plant, limit.spectrum),
    }  # fmt: skip


def mimo_prediction(
    plant: Plant, algorithm: str, scaling: str, *, experiments: int, samples: int | None
) -> tuple[dict[str, Any], str]:
    """Prediction for Procedure 2 or the two-experiment scheme."""
    from oed.theory.mimo import mimo_limit_spectrum

    limit = mimo_limit_spectrum(plant, scaling=scaling)
    payload = _predicted(plant, limit, algorithm=algorithm, scaling=scaling, beta2_mean=limit.gain2_mean)
    text = [
        f"Procedure 2 on {plant.name}, noise variance {plant.noise_variance:g}, second stage scaled: {scaling}",
        f"  H-infinity norm      {payload['hinf_norm']:.12g} at {payload['peak_frequency']:.10g} rad/sample, {_hertz(plant, payload)}",
        f"  limit of mu^2        {payload['mu2']:.12g} = norm^4 + {payload['mu2_excess']:.6g}",
        f"  limit of E gamma_2^2 {payload['beta2_mean']:.10g}",
        "  efficiency of the limit spectrum against certified optima:",
        "    " + _efficiencies_text(plant, payload),
    ]
    if samples is not None:
        from oed.theory.finite_mimo import finite_mimo_prediction

        payload |= finite_mimo_prediction(plant, samples, scaling)
        text.append(_finite_text(payload))
    return payload, "\n".join(text)


def claim_row(group: str, row: ClaimRow) -> dict[str, Any]:
    """A case of the map of the claim as a row; `theorem` says whether gain scaling is closed there."""
    values = asdict(row)
    return {"group": group, "plant": row.plant, "theorem": values.pop("closed"), **values}


def claim_tasks(cases: Sequence[ClaimCase] | None = None) -> list[Callable[[], list[dict[str, Any]]]]:
    """The map case by case; the usual ones take about 20 seconds of one core."""
    return [partial(_mapped, case) for case in (claim_cases() if cases is None else cases)]


def _mapped(case: ClaimCase) -> list[dict[str, Any]]:
    return [claim_row(group, row) for group, row in claim_map([case])]
