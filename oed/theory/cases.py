"""Cases of the map of [S] Sec. 4.2's claim: what is varied, the plant, and the limits on the input.

The theorem of `oed.theory.claim` covers white noise, one limit on the total power and a free gain; each group of cases
leaves one of these, or stays within them (damping, order, peaks, noise level) as a check."""

from dataclasses import dataclass, field
from typing import Any

import numpy as np

from oed.plants.named import named_plant
from oed.plants.norms import peak
from oed.plants.plant import Plant
from oed.theory.claim import ClaimRow, amplitude_row, claim_row, offset_row


@dataclass(frozen=True, eq=False)
class ClaimCase:
    """One case of the map.

    Attributes
    ----------
    group : str
        What is varied: damping, order, noise level, noise colour, known gain, limits, amplitude, offset, MIMO.
    plant : Plant
        With its noise and unknown parameters; its name says the value of what is varied.
    limits : dict
        As for `solve_design`.
    amplitude : float, optional
        Limit on the input's amplitude.
    offset : int, optional
        Number of samples of an experiment with an unknown constant offset at the output.
    """

    group: str
    plant: Plant
    limits: dict[str, Any] = field(default_factory=dict)
    amplitude: float | None = None
    offset: int | None = None


def _second_order(damping: float, natural: float = 1.0) -> Plant:
    pole = np.exp(natural * (-damping + 1j * np.sqrt(1 - damping**2)))
    den = np.poly([pole, pole.conjugate()]).real
    return Plant([0.0, den.sum() / 2, den.sum() / 2], den, name=f"damping {damping:g}")


def _ringing(plant: Plant, radius: float, offset: float) -> Plant:
    """Noise through a resonance at a distance from the plant's peak."""
    angle = peak(plant).frequency + offset
    den = np.poly(radius * np.exp([1j * angle, -1j * angle])).real
    return plant.replace(noise_den=den, name=f"{plant.name}, noise pole {radius:g} at {offset:+g} rad/sample")


def claim_cases() -> list[ClaimCase]:
    """The cases of the report's table.

    Returns
    -------
    list of ClaimCase
        In the order of the table.
    """
    reference, at_zero = named_plant("reference"), named_plant("peak-at-zero")
    three = named_plant("three-by-two").replace(noise_variance=1.0)
    known = reference.replace(free=("a1", "a2"), name="reference, b1 and b2 known")
    cases: list[Any] = [("damping", _second_order(z)) for z in (0.002, 0.01, 0.05, 0.2, 0.5)]
    names = ("two-peaks", "peak-at-zero", "peak-at-pi", "delay", "nonminimum-phase", "order-20")
    cases += [("peaks and order", named_plant(name).replace(noise_variance=1.0)) for name in names]
    levels = (0.01, 0.1, 1.0, 4.0, 9.0)
    cases += [
        ("noise level", reference.replace(noise_variance=v, name=f"reference, variance {v:g}"))
        for v in levels
    ]
    rings = ((0.9, 0.03), (0.95, 0.06), (0.97, 0.03), (0.97, 0.1), (0.99, 0.01))
    cases += [("noise colour", reference.replace(noise_den=[1, -0.9], name="reference, noise pole 0.9 at 0"))]
    cases += [("noise colour", _ringing(reference, radius, offset)) for radius, offset in rings]
    cases += [
        ("noise colour", _ringing(named_plant("two-peaks"), 0.99, 0.01)),
        ("known gain", known),
        ("known gain", known.replace(name="reference, b1 and b2 known, output power"), {"output_power": 1.0}),
        ("known gain", reference.replace(free=("b2", "a1", "a2"), name="reference, b1 known")),
        ("known gain", reference.replace(free=("b1", "b2"), name="reference, poles known")),
        ("limits", reference.replace(name="reference, output power"), {"output_power": 1.0}),
        ("limits", reference.replace(name="reference, band below 0.9"), {"band": (0.0, 0.9)}),
        ("limits", three.replace(name="three-by-two, equal channels"), {"channel_power": [0.5, 0.5]}),
        ("limits", three.replace(name="three-by-two, uneven channels"), {"channel_power": [0.9, 0.1]}),
        ("limits", three.replace(name="three-by-two, second channel strong"), {"channel_power": [0.1, 0.9]}),
        ("amplitude", reference.replace(name="reference, amplitude 1"), {}, 1.0),
        ("amplitude", at_zero.replace(name="peak-at-zero, amplitude 1"), {}, 1.0),
        ("offset", reference.replace(name="reference, unknown offset"), {}, None, 1000),
        ("offset", at_zero.replace(name="peak-at-zero, unknown offset"), {}, None, 1000),
        ("several inputs and outputs", three),
        ("several inputs and outputs", named_plant("avis").replace(noise_variance=1e-3)),
        ("several inputs and outputs",
         three.replace(noise_covariance=np.diag([0.1, 1.0, 10.0]), name="three-by-two, unequal noise")),
    ]  # fmt: skip
    return [ClaimCase(*case) for case in cases]


def claim_map(cases: list[ClaimCase] | None = None) -> list[tuple[str, ClaimRow]]:
    """The map: c-efficiencies of every case, each with its certificate.

    Parameters
    ----------
    cases : list of ClaimCase, optional
        By default `claim_cases()`.

    Returns
    -------
    list of (group, ClaimRow)
        In the order of the cases.
    """
    rows = []
    for case in claim_cases() if cases is None else cases:
        if case.amplitude is not None:
            row = amplitude_row(case.plant, case.amplitude)
        elif case.offset is not None:
            row = offset_row(case.plant, case.offset)
        else:
            row = claim_row(case.plant, case.limits)
        rows.append((case.group, row))
    return rows
