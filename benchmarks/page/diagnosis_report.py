"""The report page of a diagnosis: verdict, errors before and after, causes, parameters, figures, what remains."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

from benchmarks.page.report import save_figure, save_report, save_table
from oed.files.writing import write_whole

if TYPE_CHECKING:
    from estimators.diagnosis.result.report import Diagnosis

__all__ = ["write_diagnosis_report"]


def _errors(result: Diagnosis) -> list[dict[str, Any]]:
    rows = []
    for name, figure in (
        ("simulation, linear model", result.rmse_before),
        ("simulation, augmented model", result.rmse_after),
        ("paired difference", result.difference),
        ("one step ahead, linear model", result.pred_rmse_before),
        ("one step ahead, augmented model", result.pred_rmse_after),
    ):
        rows.append({"error": name, "value": figure.value, "low": figure.low, "high": figure.high})
    floor = "noise floor (at most)" if result.floor_is_bound else "noise floor (estimated)"
    rows.append({"error": floor, "value": result.noise_floor, "low": None, "high": None})
    if result.detected and result.removed == result.removed:  # NaN where there is nothing to remove
        low, high = result.removed_interval
        rows.append(
            {
                "error": "share of the removable error removed",
                "value": result.removed,
                "low": low,
                "high": high,
            }
        )
    return rows


def _claims(result: Diagnosis) -> list[dict[str, Any]]:
    rows = []
    for i, out in enumerate(result.extra["outputs"]):
        for claim in out.attribution.claims[:12]:
            rows.append({"output": i + 1, "cause": claim.cause, "variant": claim.key, "gain": float(claim.gain),
                         "p_value": float(claim.p_value)})  # fmt: skip
    return rows


def write_diagnosis_report(result: Diagnosis, folder: Path, made: dict[str, Any] | None = None) -> Path:
    """Write report.json, its tables and figures, and the page."""
    import numpy as np

    from estimators.diagnosis.next_experiment.decision import next_experiment
    from estimators.diagnosis.result.plots import nonlinearity_figure, residual_figure

    lead = [
        f"Cause: {result.effect.replace('_', ' ')} ({result.nature})."
        if result.detected
        else "Nothing is missing from the linear model at the stated false-alarm rate.",
        f"Simulation error on the {result.held_out}: {result.rmse_before} before, {result.rmse_after} after.",
    ]
    sections: list[dict[str, Any]] = []
    if result.evidence or result.confusable or result.remaining:
        text = [sentence[0].upper() + sentence[1:] + "." for sentence in result.evidence]
        if result.confusable:
            text.append("This record cannot tell it from: " + ", ".join(result.confusable) + ".")
        if result.remaining:
            text.append("What the final residual still shows: " + result.remaining + ".")
        sections.append({"title": "Evidence", "text": text})
    errors = save_table(
        folder, "errors", _errors(result), {"error": "error", "value": "value", "low": "2.5 %", "high": "97.5 %"},
        caption="Root mean square errors with intervals of a block bootstrap, in units of the output.",
    )  # fmt: skip
    sections.append({"title": "Before and after", "tables": [errors]})
    claims = _claims(result)
    if claims:
        table = save_table(
            folder, "causes", claims,
            {"output": "output", "cause": "cause", "variant": "variant", "gain": "gain", "p_value": "corrected p"},
            caption="Each effect by itself: gain of Schwarz's criterion over the linear model, and its p-value "
            "corrected for the shapes and effects tried.",
        )  # fmt: skip
        sections.append({"title": "Effects tried", "tables": [table]})
    rows = [
        {"parameter": name, "value": value, "standard_error": se, "unit": unit}
        for name, (value, se, unit) in result.parameters.items()
    ]
    if rows:
        table = save_table(
            folder, "parameters", rows,
            {"parameter": "parameter", "value": "value", "standard_error": "standard error", "unit": "unit"},
            caption="Parameters of the effects; u and y stand for the units of the input and the output.",
        )  # fmt: skip
        sections.append({"title": "Parameters", "tables": [table]})
    figures = []
    for i in range(result.yhat_before.shape[1]):
        figures.append(save_figure(folder, f"residual_{i + 1}", residual_figure(result, i),
                                   "Residual before and after: in time, in frequency, against the simulated "
                                   "output and against its velocity."))  # fmt: skip
        curve = nonlinearity_figure(result, i)
        if curve is not None:
            figures.append(save_figure(folder, f"nonlinearity_{i + 1}", curve,
                                       "The characteristics found, with bands of two standard errors."))  # fmt: skip
    sections.append({"title": "Residual", "figures": figures})
    designed = next_experiment(result, length=200, rng=np.random.default_rng(0))
    if designed is not None:
        (first, second), experiment = designed
        sections.append({"title": "What to measure next", "text": [
            f"To tell {first.replace('_', ' ')} from {second.replace('_', ' ')}, within the amplitude of the training "
            f"record: {experiment}. The input is the column u of next_input.csv."]})  # fmt: skip
        write_whole(folder / "next_input.csv", "u\n" + "".join(f"{v:.9g}\n" for v in experiment.u))
    content = {"title": "What the linear model lacks", "lead": lead, "sections": sections, "made": made or {}}
    return save_report(folder, content)
