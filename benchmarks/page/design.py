"""The page of a design: the spectrum, the sensitivity with the certificate's line, the signal, what limits it, alternatives."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.page.content import Figure, Page, Row, Section, Table, headed, line, thinned
from benchmarks.page.skeleton import save_page
from oed.data import Spectrum
from oed.design import Design
from oed.design.problem.words import headline
from oed.errors import OedError
from oed.plants.plant import Plant

POINTS = 600
"""Frequencies of the sensitivity's line, beside the support."""
TIGHT = 1e-3
"""Share of a budget that may be left where it still counts as what limits the design."""


def _alternatives(design: Design, plant: Plant) -> list[Row]:
    """Efficiency of what somebody might apply instead, at the same power."""
    from oed.plants.norms import peak

    power = design.spectrum.total_power
    rows = [{"input": "this design", "efficiency": design.bound / design.loss},
            {"input": "white noise", "efficiency": design.efficiency_white}]  # fmt: skip
    other: dict[str, Spectrum] = {}
    eye = np.eye(plant.n_inputs)[None] * power / plant.n_inputs
    at = peak(plant).frequency
    other["one sinusoid at the peak"] = Spectrum(np.array([at]), eye.astype(complex))
    if plant.n_inputs * plant.n_outputs == 1:
        from oed.theory.limit import limit_spectrum

        limit = limit_spectrum(plant).spectrum
        other["power iterations, in the limit"] = Spectrum(
            limit.omega, limit.power * (power / limit.total_power)
        )
    for name, spectrum in other.items():
        try:
            rows.append({"input": name, "efficiency": design.efficiency(spectrum)})
        except OedError:  # its information is singular for this criterion: it is worth nothing here
            rows.append({"input": name, "efficiency": 0.0})
    return sorted(rows, key=lambda row: -row["efficiency"])


def _limits(design: Design) -> list[Row]:
    one = len(design.spectrum.power[0]) == 1
    return [
        {"limit": "power of the input" if one and name == "power of input 1" else name, "used": design.power_used.get(name), "allowed": allowed, "worth": design.certificate.multipliers.get(name),
         "binds": "yes" if design.power_used.get(name, 0.0) >= (1 - TIGHT) * allowed else "no"}
        for name, allowed in design.limits.items()
    ]  # fmt: skip


def write_design(
    folder: Path, design: Design, plant: Plant, payload: Mapping[str, Any], signal: Any, made: Mapping[str, Any],
) -> Path:  # fmt: skip
    """Write report.json, its tables and the page of an optimal input."""
    turn, unit = (1.0, "rad/sample") if plant.dt == 1 else (2 * np.pi * plant.dt, "Hz")
    where = f"frequency ({unit})"
    omega = np.linspace(0, np.pi, POINTS)
    power = np.einsum("kii->k", design.spectrum.power).real
    gain = np.linalg.svd(design.map.gain(omega), compute_uv=False)[:, 0]
    at, price_at = design.spectrum.omega, design.certificate.sensitivity
    lines = line(at / turn, power, "power of the lines")
    shape = line(omega / turn, power.max() * gain / gain.max(), "gain of the plant, scaled")
    fine = np.unique(np.concatenate([omega, at]))
    price = line(fine / turn, price_at(fine), "sensitivity") + line(at / turn, price_at(at), "support")
    spectrum = Figure("spectrum", "Where the power lies: the lines of the optimal spectrum over the gain of the plant.",
                      "Power of the lines over frequency.", [*lines, *shape], where, "power (input unit squared)",
                      {"power of the lines": "stems"}, rules=(0.0,))  # fmt: skip
    sensitivity = Figure("sensitivity", "The certificate: the sensitivity nowhere exceeds 1 and touches it at the lines, so no "
                         "admissible spectrum is better by more than the gap.", "Sensitivity over frequency with the support marked.",
                         price, where, "sensitivity", {"support": "points"}, rules=(1.0,))  # fmt: skip
    others, limits = _alternatives(design, plant), _limits(design)
    bars = [{"x": (share := r["efficiency"]), "y": r["input"], "series": "efficiency", "text": f"{100 * share:.3g} %"}
            for r in others]  # fmt: skip
    runs = []
    if signal is not None:
        u = np.asarray(signal)
        names = [f"u{j + 1}" for j in range(u.shape[1])] if u.shape[1] > 1 else ["u"]
        rows = thinned(np.arange(len(u)) * plant.dt, dict(zip(names, u.T, strict=True)))
        runs = [Figure("signal", "The signal to apply; input.csv has every sample.", "The input over time.", rows,
                       "time (s)" if plant.dt != 1 else "sample", "input", zoom=True)]  # fmt: skip
    sentence = headline(design)
    binding = [r["limit"] for r in limits if r["binds"] == "yes"]
    answer = f"{sentence[0].upper()}{sentence[1:]}."
    sure = [f"Loss {design.loss:.6g}, and no admissible spectrum has less than {design.bound:.6g}: a certified gap of {design.gap:.1e}.",
            f"{design.status.name}: {design.status.value}"]  # fmt: skip
    todo = (
        ["Apply input.csv, and estimate from its record: oed identify RECORD."]
        if runs
        else ["Make a signal of it: the same command with --realise N."]
    )
    if signal is not None and "realised_efficiency" in payload:
        sure.append(
            f"The signal of {len(signal)} samples keeps {100 * payload['realised_efficiency']:.3g} % of it, crest factor {payload['crest_factor']:.3g}."
        )
    if binding:
        larger = (
            f"a larger amplitude than {made['amplitude']:g}, which limits the "
            if made.get("amplitude")
            else "more of what limits it: "
        )
        todo.append(f"To do better, allow {larger}{', '.join(binding)}.")
    columns = headed("limit", "used", "allowed", "binds", worth="worth of one unit more")
    support = [{"frequency": r["x"], "power": r["y"]} for r in lines]
    sections = [
        Section("Why it is optimal", figures=[sensitivity]),
        *([Section("The signal", figures=runs)] if runs else []),
        Section("What limits it", [], [Table("limits", "Every limit, how much of it is used, and its price.", columns, limits)]),
        Section("Alternatives", [], [Table("alternatives", "Efficiency at the same power.", headed("input", "efficiency"),
                                           others, ["efficiency"])],
                [Figure("alternatives", "What else one might apply, in shares of the certified optimum.", "Efficiencies as bars.", bars,
                        "share of the optimum", "", {"efficiency": "bars"}, sideways=True, rules=(1.0,))]),
        Section("Lines", [], [Table("support", "Lines of the spectrum, one-sided.", headed(frequency=where, power="power (input unit squared)"), support)]),
    ]  # fmt: skip
    stated = {k: str(v) for k, v in made.items() if v is not None}
    return save_page(
        folder, Page("design", "An optimal input", answer, sure, todo, [spectrum], sections, stated)
    )
