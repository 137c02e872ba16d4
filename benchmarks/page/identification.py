"""The page of an identification: measured and simulated, the frequency response with its band, poles, step, residual, orders."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from benchmarks.page.content import Figure, Page, Row, Section, Table, headed, line, thinned
from benchmarks.page.skeleton import save_page
from oed.data import Record
from oed.models.poles import poles_in_hz

if TYPE_CHECKING:
    from estimators.pem.fit import Fit
    from estimators.residual.tests import ResidualTest

LEVEL = 1.96
"""Standard errors to either side of a 95 % interval."""
ELLIPSE = float(np.sqrt(-2 * np.log(0.05)))
"""Radius of a 95 % ellipse in standard deviations: chi-squared with two degrees of freedom."""
SUSPECT = 0.01
"""p-value below which a residual test is named on top of the page."""
TOLD = 2.0
"""Standard errors that a gain must have to be told from zero: a 95 % interval."""
FREQUENCIES = 250
STEP = 80
"""Points of the frequency response and samples of the step response: enough for lines some 600 pixels wide."""
ORDERS = 5
"""Largest order of the order curve: each is one more fit."""


def _banded(x: Any, value: Any, error: Any, series: str, factor: float = 1.0) -> list[Row]:
    return line(x, factor * np.asarray(value), series, factor * LEVEL * np.asarray(error))


def _response(fit: Fit, record: Record) -> list[Figure]:
    from estimators.pem.uncertainty import bode_band, step_band

    omega = np.geomspace(0.01, np.pi, FREQUENCIES)
    turn, unit = (1.0, "rad/sample") if fit.model.dt == 1 else (2 * np.pi * fit.model.dt, "Hz")
    gain, phase = bode_band(fit, omega)
    step = step_band(fit, STEP)
    rows: dict[str, list[Row]] = {"gain": [], "phase": [], "step": []}
    several = record.n_outputs * record.n_inputs > 1
    per = "" if several else f" ({_per(record)})"
    for i, j in np.ndindex(record.n_outputs, record.n_inputs):
        name = f"{record.input_names[j]} to {record.output_names[i]}" if several else ""
        sizes = _banded(omega / turn, gain.value[:, i, j], gain.standard_error[:, i, j], name)
        # an absent entry has no logarithm
        rows["gain"] += [r | {"low": max(r["low"], 1e-2 * r["y"])} for r in sizes if r["y"] > 0]
        rows["phase"] += _banded(
            omega / turn, phase.value[:, i, j], phase.standard_error[:, i, j], name, 180 / np.pi
        )
        rows["step"] += _banded(
            step.x * fit.model.dt, step.value[:, i, j], step.standard_error[:, i, j], name
        )
    where, when = f"frequency ({unit})", "time (s)" if fit.model.dt != 1 else "sample"
    return [
        Figure("gain", "Gain with pointwise 95 % bands.", "Gain over frequency with its band.", rows["gain"], where, f"gain{per}", log="xy"),
        Figure("phase", "Phase with pointwise 95 % bands.", "Phase over frequency with its band.", rows["phase"], where,
               "phase (degrees)", log="x"),
        Figure("step", "Step response with pointwise 95 % bands.", "Step response over time with its band.", rows["step"], when,
               f"step response{per}"),
    ]  # fmt: skip


def _poles(fit: Fit) -> tuple[Figure, Table]:
    from estimators.pem.uncertainty import pole_covariances

    turn = np.linspace(0, 2 * np.pi, 61)
    circle = np.stack([np.cos(turn), np.sin(turn)])
    points = line(circle[0], circle[1], "unit circle")
    rows = []
    for pole, covariance in pole_covariances(fit):
        values, vectors = np.linalg.eigh(covariance)
        ring = (vectors * (ELLIPSE * np.sqrt(np.maximum(values, 0)))) @ circle
        points += line(pole.real + ring[0], pole.imag + ring[1], "95 % ellipse")
        points.append({"x": None, "y": None, "series": "95 % ellipse"})  # the next ring is a line of its own
        points.append({"x": pole.real, "y": pole.imag, "series": "pole", "text": f"{pole:.4g}"})
        real = abs(pole.imag) < 1e-12
        told = poles_in_hz(
            [complex(pole.real, 0.0 if real else abs(pole.imag))], fit.model.dt
        )  # none of a delay
        rings = [p for p in told if p.frequency_hz]
        rows.append({
            "pole": f"{pole.real if real else pole:.5g}", "size": abs(pole), "frequency_hz": rings[0].frequency_hz if rings else None,
            "damping": rings[0].damping if rings else None,
            "time_constant": told[0].time_constant if told and np.isfinite(told[0].time_constant) else None,
            "error": float(np.sqrt(np.trace(covariance))),
        })  # fmt: skip
    columns = headed("pole", "size", frequency_hz="frequency (Hz)", damping="damping",
                     time_constant="time constant (s)", error="standard error")  # fmt: skip
    figure = Figure("poles", "Poles with 95 % ellipses and the unit circle.", "Poles in the complex plane.", points, "real", "imaginary",
                    {"pole": "points", "95 % ellipse": "line", "unit circle": "line"}, square=True)  # fmt: skip
    return figure, Table("poles", "Poles; frequencies in Hz where the sampling time is known.", columns, rows)


def _residual(tests: Mapping[str, ResidualTest]) -> tuple[list[Figure], list[Table]]:
    from estimators.residual.measures import in_ranges, p_stated

    points, rows = [], []
    for name, test in tests.items():
        panel = f"{name}: {p_stated(test.p_value)}"
        points += line(test.lags, test.correlation, "correlation", panel=panel)
        points += line(
            test.lags,
            0 * test.deviation,
            "99 % where nothing is missing",
            2.576 * test.deviation,
            panel=panel,
        )
        rows.append({"test": name, "p_value": test.p_value, "p": p_stated(test.p_value), "lags": in_ranges(test.significant()) or "none",
                     "verdict": "something is missing" if test.p_value < SUSPECT else "nothing to see"})  # fmt: skip
    if not rows:
        return [], []
    columns = headed("test", p="p-value", lags="significant lags", verdict="so")
    figure = Figure("residuals", "Correlations of the residual over their lags.", "Correlations of the residual, one panel per test.",
                    points, "lag (samples)", "correlation", {"correlation": "stems"}, shared=False)  # fmt: skip
    return [figure], [
        Table("residual_tests", "Residual tests: whiteness, against the input, and feedback.", columns, rows)
    ]


def _orders(
    fit: Fit, records: Sequence[Record], structure: str, orders: Sequence[int], options: Mapping[str, Any]
) -> list[Figure]:
    """The singular values of a subspace method; of a search for one channel, Schwarz's criterion of neighbouring orders."""
    from estimators.pem.choice import select_orders

    if fit.subspace is not None:
        values = fit.subspace.singular_values
        taken = fit.model.structure.order  # type: ignore[union-attr]
        rows = [
            {"x": k + 1, "y": float(v), "series": "taken" if k < taken else "left"}
            for k, v in enumerate(values)
            if v > 0
        ]
        return [Figure("orders", "Singular values of the subspace method.", "Singular values by number.", rows, "number",
                       "singular value", {"taken": "points", "left": "points"}, log="y")]  # fmt: skip
    if (
        structure not in ("oe", "arx")
        or records[0].n_outputs * records[0].n_inputs > 1
        or not all(r.complete for r in records)
    ):
        return []
    given: dict[str, Any] = {k: v for k, v in options.items() if k in ("offset", "initial", "robust")} | {
        "search": "quick"
    }
    choice = select_orders(
        records, structure, [(n, n) for n in range(1, ORDERS + 1)], delays=(options["delay"],), **given
    )
    rows = sorted(
        ({"x": r["orders"][0], "y": r["value"], "series": "order n, n"} for r in choice.rows),
        key=lambda r: r["x"],
    )
    here = [{"x": max(orders), "y": fit.bic, "series": "this model"}]
    return [Figure("orders", "Schwarz's criterion (BIC) of neighbouring orders with the quick search: lower is better.",
                   "Criterion against the order.", [*rows, *here], "order", "BIC",
                   {"order n, n": "both", "this model": "points"})]  # fmt: skip


def _measured(fit: Fit, record: Record) -> list[Figure]:
    whole = fit.initial != "zero" and fit.regularisation is None
    simulated = fit.simulate_record(record, window=len(record) if whole else 0)
    drawn = []
    for i, name in enumerate(record.output_names):
        unit = f" ({record.output_units[i]})" if record.output_units[i] else ""
        rows = thinned(record.t, {"measured": np.asarray(record.y[:, i]), "simulated": simulated[:, i]})
        drawn.append(Figure(f"compare-{i + 1}", f"{name}: measured, and simulated from the input alone.",
                            f"Measured and simulated {name} over time.", [r for r in rows if np.isfinite(r["y"])],
                            "time (s)" if record.dt != 1 else "sample", name + unit, zoom=True))  # fmt: skip
    return drawn


def _per(record: Record) -> str:
    """Unit of a gain: that of the first output over that of the first input, or their names."""
    from estimators.residual.measures import per

    return per(
        record.output_units[0] or record.output_names[0], record.input_units[0] or record.input_names[0]
    )


def write_identification(
    folder: Path, fit: Fit, records: Sequence[Record], tests: Mapping[str, ResidualTest], made: Mapping[str, Any],
    payload: Mapping[str, Any],
) -> Path:  # fmt: skip
    """Write report.json, its tables and the page of an identified model."""
    gamma, error, omega = fit.hinf_norm
    wrong = [name for name, test in tests.items() if test.p_value < SUSPECT]
    suffices = (
        "nothing is left in the residual"
        if not wrong
        else "what is left is noise with a memory, which the input does not explain"
        if wrong == ["whiteness"]
        else f"the residual still shows something ({', '.join(wrong)})"
    )
    if not tests:
        suffices = "no residual test was made"
    share = fit.simulation_fit_percent
    does = (
        f"simulates {share:.1f}" if np.isfinite(share) else f"predicts, one step ahead, {fit.fit_percent:.1f}"
    )
    orders = " ".join(map(str, payload["orders"]))
    answer = f"A model of structure {payload['structure'].upper()} with orders {orders} {does} % of the output; {suffices}."
    told = gamma > TOLD * error
    if not told:
        answer = f"{answer[:-1]}; these data do not tell its largest gain."
    sure = [f"Peak gain {gamma:.4g} ± {error:.2g} {_per(records[0])} at {omega / (2 * np.pi * fit.model.dt):.4g} Hz; standard errors hold if the model can describe the data.",
            f"Fitted to {fit.n_samples} samples; the search ended: {fit.status.value[:1].lower()}{fit.status.value[1:]}"]  # fmt: skip
    fresh = payload["test"]["simulation_fit_percent"] if "test" in payload else None
    useless = fresh is not None and fresh <= 0
    if useless:
        answer = f"{answer[:-1]}; on fresh data it is worse than a constant."
    if fresh is not None:
        worse = "Its error on fresh data is larger than that of a constant, the mean of the output."
        sure.insert(0, worse if useless else f"On fresh data it simulates {fresh:.1f} % of the output.")
    todo = ["Find what is missing: oed diagnose with the same record."] if wrong else []
    if wrong == ["whiteness"]:
        todo = [
            "Give the noise a model of its own, or one of more orders: --structure armax or bj. Then the standard errors are right, and smaller."
        ]
    todo += [
        f"Data: {defect['message']}" for defect in payload.get("data_defects", ()) if "message" in defect
    ]
    todo.append(
        "Try other orders or another structure before this model is used: --orders auto."
        if useless
        else "Before this model is used, check that inputs and outputs are not swapped, the delay (--delay auto), fewer orders, and that the input moves enough."
        if not told
        else "Use the model: every command takes model.json as a plant, such as oed design --plant model.json."
    )
    drawn, tables = _residual(tests)
    figure, poles = _poles(fit)
    parameters = [{"parameter": k, "value": float(v), "value_se": float(s)}
                  for k, v, s in zip(fit.names, fit.theta, fit.standard_errors, strict=True)]  # fmt: skip
    measured = _measured(fit, records[0]) if fit.model.stable and records[0].complete else []
    sections = [
        Section("Frequency and step response", figures=_response(fit, records[0]) if fit.model.stable else []),
        Section("Poles", [], [poles] if poles.rows else [], [figure] if poles.rows else []),
        Section("What the residual says", list(payload.get("notes", ())), tables, drawn),
        Section("Orders", figures=_orders(fit, records, payload["structure"], payload["orders"], payload["options"] | {"delay": payload["delay"]})),
        Section("Parameters", [payload["letters"]], [Table("parameters", "Parameters with their standard errors.",
                                         headed("parameter", value="value ± standard error"), parameters)]),
    ]  # fmt: skip
    page = Page("identification", "A model of measured data", answer, sure, todo, measured[:1],
                [Section("Further outputs", figures=measured[1:])] * bool(measured[1:]) + sections,
                {k: str(v) for k, v in made.items()})  # fmt: skip
    return save_page(folder, page)
