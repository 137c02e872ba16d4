"""The page of a diagnosis: what is missing, the ladder of errors, the effect's curve, what was tried, what to measure next."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from benchmarks.page.content import Figure, Page, Section, Table, headed, line, thinned
from benchmarks.page.skeleton import save_page
from benchmarks.tables.formats import format_value
from estimators.diagnosis.ladder.first_line import NAMELESS
from estimators.diagnosis.ladder.verdicts import ECHO, NOTHING, UNCLAIMED
from estimators.diagnosis.result.words import in_seconds, named_plainly
from estimators.residual.measures import p_stated

if TYPE_CHECKING:
    from estimators.diagnosis.result.report import Diagnosis

Row = dict[str, Any]
NEXT = 200
"""Samples of the experiment that is proposed."""
TRIED = 20
"""Effects listed as tried, the best first."""
MUCH = 0.1
"""Share of the test record outside the training record's range from which on it is another experiment."""
NEAR = 0.05
"""Of the training record's range, by which it may be left as by the noise."""
FURTHER = "A longer record, or an input that goes further or faster, may show what this one cannot."
"""What to measure where no experiment is proposed."""
SUFFICES = "Nothing is missing from the linear model that these data could show"
UNCONFIRMED = "More is left than noise, but these data confirm no cause: the linear model stands"
RUNGS = {
    "linear": "linear model",
    "named": "+ named effect",
    "discovered": "+ discovered terms",
    "remainder": "+ remainder",
}


def _capital(sentence: str) -> str:
    return f"{sentence[:1].upper()}{sentence[1:]}".rstrip(".") + "."


def _unit(result: Diagnosis) -> str:
    units = {u for u in result.extra["test"].output_units if u}
    return f" {units.pop()}" if len(units) == 1 else ""


def _with(words: str, unit: str) -> str:
    """Words of an axis or a column with a unit, where there is one."""
    return f"{words} ({unit})" if unit else words


def _ladder(result: Diagnosis) -> tuple[Figure, Table]:
    points, rows = [], []
    for row in result.ladder:
        name = RUNGS.get(row["step"], row["step"])
        for series, value, low, high in (("unused blocks of the training record", "rmse_unused", "low", "high"),
                                         (f"the {result.held_out}", "rmse_test", "low_test", "high_test")):  # fmt: skip
            points.append({"x": row[value], "y": name, "low": row[low], "high": row[high], "series": series,
                           "text": format_value(row[value])})  # fmt: skip
        why = "the answer" if row["answer"] else "the start" if row["step"] == "linear" else ""
        rows.append({k: v for k, v in row.items() if k not in ("answer", "adds")}
                    | {"step": name, "adds": ", ".join(row["adds"]) or "–", "verdict": why})  # fmt: skip
    best = min((r["rmse_unused"] for r in result.ladder if r["answer"]), default=float("nan"))
    for row in rows:
        row["verdict"] = row["verdict"] or (
            "no better than the answer beyond its standard errors"
            if row["rmse_unused"] >= 0.98 * best
            else "a gain that its own check on data not used did not confirm"
        )
    floor = f"noise floor ({'at most' if result.floor_is_bound else 'estimated'})"
    points.append(
        {"x": result.noise_floor, "y": floor, "series": floor, "text": format_value(result.noise_floor)}
    )
    marks = {p["series"]: "points" for p in points}
    unit = _unit(result).strip()
    caption = "The ladder: root mean square error of the free run on data not used, step by step, with 95 % intervals."
    figure = Figure("ladder", caption, "Error of every step of the ladder, from the linear model down to the noise floor.",
                    points, f"error ({unit or 'output units'})", "", marks, sideways=True, rules=(0.0, result.noise_floor))  # fmt: skip
    columns = headed("step", "adds", rmse_unused="error, unused blocks", low="from", high="to",
                     rmse_test=f"error, {result.held_out}", low_test="from ", high_test="to ", verdict="why")  # fmt: skip
    return figure, Table(
        "ladder", "Every step that was tried, on the same data that it did not see.", columns, rows
    )


def _errors(result: Diagnosis) -> Table:
    figures = {
        "simulation, linear model": result.rmse_before, "simulation, whole answer": result.rmse_after,
        "paired difference": result.difference, "one step ahead, linear model": result.pred_rmse_before,
        "one step ahead, whole answer": result.pred_rmse_after,
    }  # fmt: skip
    rows: list[Row] = [
        {"error": k, "value": f.value, "low": f.low, "high": f.high} for k, f in figures.items()
    ]
    floor = "noise floor (at most)" if result.floor_is_bound else "noise floor (estimated)"
    rows.append({"error": floor, "value": result.noise_floor, "low": None, "high": None})
    if result.detected and result.removed == result.removed:  # NaN where there is nothing to remove
        low, high = result.removed_interval
        rows.append({
            "error": "share of the removable error removed", "value": result.removed, "low": low,
            "high": high,
        })  # fmt: skip
    unit = _unit(result).strip() or "units of the output"
    caption = f"Root mean square errors with 95 % intervals, as of the same record measured again, in {unit}; a share has no unit."
    return Table("errors", caption, headed("error", "value", low="2.5 %", high="97.5 %"), rows)


def _runs(result: Diagnosis, i: int) -> Figure:
    test = result.extra["test"]
    name, unit = test.output_names[i], test.output_units[i]
    rows = thinned(test.t, {"measured": np.asarray(test.y[:, i]), "linear model": result.yhat_before[:, i],
                            "whole answer": result.yhat_after[:, i]})  # fmt: skip
    return Figure(f"simulated-{i + 1}", f"{name}, measured and simulated before and after, on the {result.held_out}; simulated.csv "
                  "has every sample.", f"Measured {name} with the free runs of the linear model and of the whole answer over time.",
                  [r for r in rows if np.isfinite(r["y"])], "time (s)", _with(name, unit), zoom=True)  # fmt: skip


def _binned(x: Any, r: Any, bins: int = 25) -> tuple[Any, Any, Any]:
    """Mean of r in bins of equal count of x, and its standard error."""
    order = np.argsort(x)
    groups = np.array_split(order, min(bins, max(2, len(x) // 20)))
    return (
        np.array([x[g].mean() for g in groups]),
        np.array([r[g].mean() for g in groups]),
        np.array([r[g].std() / np.sqrt(len(g)) for g in groups]),
    )


def _residuals(result: Diagnosis, i: int) -> list[Figure]:
    """The residual against the variable that reveals most of it, and over frequency, before and after."""
    from scipy.signal import welch

    test = result.extra["test"]
    y, name, unit = np.nan_to_num(test.y[:, i]), test.output_names[i], test.output_units[i]
    level = result.yhat_before[:, i]
    drive = min(i, test.n_inputs - 1)
    against = {_with(f"simulated {name}", unit): level, f"velocity of {name} ({unit or 'units'}/s)": np.gradient(level) / test.dt,
               _with(f"input {test.input_names[drive]}", test.input_units[drive]): test.u[:, drive]}  # fmt: skip
    pairs = {"before": y - level, "after": y - result.yhat_after[:, i]}
    told = lambda x: float(
        np.sum((_binned(x, pairs["before"])[1] / np.maximum(_binned(x, pairs["before"])[2], 1e-300)) ** 2)
    )
    best = max(against, key=lambda key: told(against[key]))
    points, spectra = [], []
    for label, r in pairs.items():
        centre, mean, error = _binned(against[best], r)
        points += line(centre, mean, label, 2 * error)
        frequency, power = welch(r, 1 / test.dt, nperseg=min(256, len(r)))
        spectra += [row for row in line(frequency[1:], np.sqrt(power[1:]), label) if row["y"] > 0]
    return [
        Figure(f"residual-{i + 1}", f"Mean residual of {name} against the variable that reveals most of it: {best} (bars: two "
               "standard errors). A flat line at zero has nothing left to explain.", f"Mean residual against {best}, before and after.",
               points, best, _with("mean residual", unit), {"before": "both", "after": "both"}, rules=(0.0,)),
        Figure(f"spectrum-{i + 1}", f"Residual of {name} over frequency, before and after.", "Spectral density of the residual.",
               spectra, "frequency (Hz)", f"{unit or 'units'} per root hertz", log="y"),
    ]  # fmt: skip


def _curves(result: Diagnosis, i: int) -> list[Figure]:
    from estimators.diagnosis.result.curves import characteristics

    drawn = []
    for k, c in enumerate(characteristics(result, i)):
        rows = [row for row in line(c.x, c.y, "found, with its 95 % band", c.band) if np.isfinite(row["x"])]
        rows += line(c.x[[0, -1]], c.straight, "linear") if c.straight is not None else []
        drawn.append(Figure(f"curve-{i + 1}-{k + 1}", _capital(c.sentence), f"The effect's curve: {c.sentence}.", rows,
                            *c.labels))  # fmt: skip
    return drawn


def _tried(result: Diagnosis) -> list[Table]:
    taken, confusable, rows = set(result.variant.split(", ")), set(result.confusable), []
    claims = [(i, c) for i, out in enumerate(result.extra["outputs"]) for c in out.attribution.claims]
    best = max((float(c.gain) for _, c in claims if c.key in taken), default=0.0)
    for i, c in sorted(claims, key=lambda pair: -float(pair[1].gain))[:TRIED]:
        if c.key in taken:
            why = "taken"
        elif c.cause in confusable:
            why = "this record cannot tell it from the answer"
        elif float(c.gain) <= 0:
            why = "gains nothing over the linear model"
        else:
            why = (
                f"explains less: {100 * float(c.gain) / best:.0f} % of the best one's gain"
                if best > c.gain
                else "did not hold on unused blocks"
            )
        rows.append({"cause": c.cause.replace("_", " "), "variant": c.key, "output": i + 1, "gain": float(c.gain),
                     "p_value": float(c.p_value), "why": why})  # fmt: skip
    columns = headed("cause", "variant", "output", "gain", p_value="corrected p", why="why")
    caption = ("Each effect by itself: gain of Schwarz's criterion over the linear model, and its p-value corrected for the shapes "
               "and effects tried.")  # fmt: skip
    return [Table("causes", caption, columns, rows, ["gain"])] if rows else []


def _linear(result: Diagnosis) -> list[Section]:
    if not result.linear:
        return []
    rows = [
        {"pole": k + 1, "frequency": f or None, "damping": d if f else None, "time_constant": t}
        for k, (f, d, t) in enumerate(result.linear["poles"])
    ]
    columns = headed("pole", frequency="frequency (Hz)", damping="damping", time_constant="time constant (s)")
    poles = Table("poles", "Poles of the linear model; a real pole has a time constant only.", columns, rows)
    said = [f"{result.linear['structure']}.", *(_capital(why) for why in result.linear.get("why", ()))]
    return [Section("The linear model", said, [poles] if rows else [])]


def _uncovered(result: Diagnosis) -> list[str]:
    """What training data to record where much of the test record lies outside what they cover."""
    records, test = result.extra["records"], result.extra["test"]
    far, channels = np.zeros(len(test), dtype=bool), []
    for of, names, units in (
        (lambda r: r.u, test.input_names, test.input_units), (lambda r: r.y, test.output_names, test.output_units),
    ):  # fmt: skip
        known, asked = np.concatenate([of(r) for r in records]), of(test)
        low, high = np.nanmin(known, axis=0), np.nanmax(known, axis=0)
        beyond = (asked < low - NEAR * (high - low)) | (asked > high + NEAR * (high - low))
        far |= beyond.any(axis=1)
        channels += [f"{names[j]} from {np.nanmin(asked[:, j]):.4g} to {np.nanmax(asked[:, j]):.4g} {units[j]}".rstrip()
                     for j in np.flatnonzero(beyond.any(axis=0))]  # fmt: skip
    if far.mean() <= MUCH:
        return []
    return [f"Train on a record that has {' and '.join(channels)}: {100 * far.mean():.0f} % of the {result.held_out} lies where the "
            "training data have not been, and what any model says there is a guess."]  # fmt: skip


def _next(result: Diagnosis) -> tuple[list[Section], list[str], dict[str, str]]:
    """What to measure next, with its input."""
    from estimators.diagnosis.next_experiment import deciding_experiment

    designed = deciding_experiment(result, length=NEXT, rng=np.random.default_rng(0))
    if designed is None:
        return [], [], {}
    (first, second), experiment = designed
    words = (f"Apply the input of next_input.csv to tell {first.replace('_', ' ')} from {second.replace('_', ' ')}, within the "
             f"amplitude of the training record: {experiment}.")  # fmt: skip
    rows = line(range(len(experiment.u)), experiment.u, "")
    figure = Figure("next-input", "The input to apply next.", "The proposed input over its samples.", rows, "sample", "u",
                    zoom=True)  # fmt: skip
    dt = result.extra["train"].dt
    text = "t,u\n" + "".join(f"{k * dt!r},{v:.9g}\n" for k, v in enumerate(experiment.u))
    return [Section("What to measure next", [words], figures=[figure])], [words], {"next_input.csv": text}


def _words(result: Diagnosis) -> tuple[str, list[str], list[str]]:
    unit = _unit(result)
    before, after = result.rmse_before, result.rmse_after
    nothing = not result.detected or result.system.startswith(NOTHING)
    if result.detected:
        what = result.system.split("; error on fresh data")[0].replace("+-", "±") or result.effect.replace(
            "_", " "
        )
        same = f"{before.value:.3g}" == f"{after.value:.3g}"
        error = (
            f"stays at {after.value:.3g}"
            if same
            else f"{'falls' if after.value < before.value else 'rises'} from {before.value:.3g} to {after.value:.3g}"
        )
        whole = result.system.startswith((NOTHING, UNCLAIMED, ECHO))  # a sentence, not the name of a cause
        # of what has no name it is the name
        nature = "" if what.startswith(NAMELESS) else f" ({result.nature})"
        lacks = _capital(what)[:-1] if whole else f"The linear model lacks {what}{nature}"
        answer = f"{lacks}; the simulation error {error}{unit}."
    else:
        # what is left may be plain and yet have no cause that the data confirm: then "nothing" would be false
        lacks = UNCONFIRMED if result.remaining else SUFFICES
        answer = f"{lacks}; its simulation error is {before.value:.3g}{unit}."
    low, high = result.difference.low, result.difference.high
    sure = [f"Error on the {result.held_out}: {before}{unit} before, {after}{unit} after (95 % intervals); the difference is "
            f"{result.difference.value:.3g} [{low:.3g}, {high:.3g}]{unit}." if not low == high == 0.0
            else f"Error on the {result.held_out}: {before}{unit} (95 % interval)."]  # fmt: skip
    if result.detected:
        many = "all tests together, corrected for how many they are"
        sure.append(f"That the linear model's residual is white noise has {p_stated(result.p_value)} ({many})"
                    + (f"; what is left in it: {result.evidence[0]}." if nothing and result.evidence else "."))  # fmt: skip
    sure += (
        [f"This record cannot tell it from: {', '.join(c.replace('_', ' ') for c in result.confusable)}."]
        if result.confusable
        else []
    )
    sure += [_capital(w) for w in result.warnings]
    sure += [f"More is left than noise: {result.remaining}."] if result.remaining else []
    use = (
        "DiagnosedModel.load of model.json simulates it on any record"
        if result.model is not None
        else "its parameters are below"
    )
    todo = (
        [f"Keep the linear model: {use}.", FURTHER]
        if nothing
        else [f"Use the answer in place of the linear model: {use}."]
        if after.value < before.value
        else [f"Keep the linear model: the answer's error on the {result.held_out} is not lower."]
    )
    if result.remaining and not nothing:
        todo.append(f"To find what is left: {FURTHER[:1].lower()}{FURTHER[1:]}")
    return answer, sure, todo


def write_diagnosis_report(result: Diagnosis, folder: Path, made: Mapping[str, Any] | None = None) -> Path:
    """Write report.json, its tables and the page."""
    ladder, steps = _ladder(result) if result.ladder else (None, None)
    outputs = range(result.yhat_before.shape[1])
    answer, sure, todo = _words(result)
    following, what, downloads = _next(result)
    curves = [figure for i in outputs for figure in _curves(result, i)]
    said = {k: in_seconds(*row, result.extra["train"]) for k, row in result.parameters.items()}
    parameters = [
        {"parameter": named_plainly(k), "value": v, "value_se": se, "unit": unit}
        for k, (v, se, unit) in said.items()
    ]
    table = Table("parameters", "Parameters of the effects; u and y stand for units of inputs and outputs that are not known, or not all the same.",
                  {"parameter": "parameter", "value": "value ± standard error", "unit": "unit"}, parameters)  # fmt: skip
    evidence = [_capital(s) for s in result.evidence] + (
        [f"In the units of the record: {result.equation}"] if result.equation else []
    )
    if share := result.explainable:
        found = [f"{100 * max(share[key], 0.0):.0f}" for key in ("share", "low", "high")]
        evidence.append(
            f"Of the linear model's residual {found[0]} % [{found[1]}, {found[2]}] can be explained by what was measured."
        )
    sections = [
        Section("Before and after", [], [_errors(result)], [_runs(result, i) for i in outputs]),
        Section("The effect", evidence, [table] if parameters else [], curves),
        Section("Residual", figures=[f for i in outputs for f in _residuals(result, i)]),
        Section("What was tried, and why it lost", [], [*([steps] if steps else []), *_tried(result)]),
        *following,
        *_linear(result),
        Section("The data", [_capital(w) for w in result.data] or ["The checks of the record found nothing to report."]),
    ]  # fmt: skip
    page = Page("diagnosis", "What the linear model lacks", answer, sure, [*_uncovered(result), *what, *todo], [ladder] if ladder else [], sections,
                {k: str(v) for k, v in (made or {}).items()}, downloads=downloads)  # fmt: skip
    return save_page(folder, page, static=True)
