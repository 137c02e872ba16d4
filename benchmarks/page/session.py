"""The page of a session: how far it is, the estimate with its interval after every experiment, the records, the limits."""

from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.page.content import Figure, Page, Section, Table, headed, line, thinned
from benchmarks.progress import in_words
from estimators.residual.measures import stated
from oed.errors import InputError
from oed.files.writing import write_whole

MOST, MOST_FITTED = 25, 6
"""Estimates that are computed again for the curve, evenly thinned, and how many of them where each is a fit."""

CUT = 3.0
"""Intervals are drawn up to so many times the last estimate: those of the first experiments would hide all others."""


def _curve(session: Any) -> list[dict[str, Any]]:
    """The estimate after every experiment, as the session gave it then."""
    from estimators.sessions.estimates import estimate_of

    trace, own = session.trace, session.own_trace
    most = MOST_FITTED if session.settings.method in ("two-stage", "sequential") else MOST
    ends = [part.stop for part in own.iterations]
    keep = (
        sorted({ends[k] for k in np.unique(np.linspace(0, len(ends) - 1, most).astype(int))}) if ends else []
    )
    points, widest = [], CUT * abs(session.estimate().value)
    for k in keep:
        found = estimate_of(session.settings, trace.first(k), own.first(k))
        low, high = found.interval[0], min(found.interval[1], max(widest, found.value))
        if np.isfinite(found.value):
            point = {"x": k, "y": found.value, "series": "estimate, with its 95 % interval"}
            points.append(point | ({"low": low, "high": high} if np.isfinite([low, high]).all() else {}))
    gains = session.estimate().gains
    if len(gains) == len(ends):
        points += [row for row in line(ends, gains, "the method's own gain") if np.isfinite(row["y"])]
    return points


def _limit_words(s: Any) -> dict[str, tuple[str, tuple[str, ...]]]:
    """Each limit's words and the units of its numbers."""
    per_second, squared = (
        tuple(f"{u}/s" for u in s.input_units),
        tuple(f"({u})^2" if u else "" for u in s.input_units),
    )
    return {
        "power": ("mean square of the inputs, at most", ("",)),
        "amplitude": ("deviation from the level, at most", s.input_units),
        "rate": ("change per second, at most", per_second),
        "energy": ("sum of squares, at most", squared),
        "level": ("operating level", s.input_units),
        "abort": ("output beyond which a record is not used", s.output_units),
        "sensor_range": ("range of the sensor", s.output_units),
    }


def _listed(value: Any, units: tuple[str, ...]) -> str:
    """Numbers, or pairs of them, each with its unit."""
    each = value if isinstance(value, tuple) else (value,)
    said = [" to ".join(f"{x:g}" for x in v) if isinstance(v, tuple) else f"{v:g}" for v in each]
    return ", ".join(f"{words} {unit}".rstrip() for words, unit in zip(said, units, strict=True))


def session_page(folder: Path) -> Page:
    """The page of a session's folder, as it stands; nothing in the folder changes."""
    from estimators.sessions import open_session
    from estimators.sessions.layout import rig_samples
    from estimators.sessions.rest import rest_of

    session = open_session(folder)
    s, status, found = session.settings, session.status(), session.estimate()
    done, budget = status["experiments"], status["budget"]
    records = session.rig_records
    rows = [
        {"experiment": k + 1, "rows": len(r), "input_rms": float(np.sqrt(np.mean(r.u**2))), "input_peak": float(np.abs(r.u).max()),
         "output_rms": float(np.sqrt(np.mean(r.y**2))), "output_peak": float(np.abs(r.y).max())}
        for k, r in enumerate(records)
    ]  # fmt: skip
    columns = headed("experiment", rows="samples", input_rms="input, rms", input_peak="input, peak",
                     output_rms="output, rms", output_peak="output, peak")  # fmt: skip
    signals = []
    if records:
        last = records[-1]
        for name, side, names, units in (("input", last.u, last.input_names, last.input_units),
                                         ("output", last.y, last.output_names, last.output_units)):  # fmt: skip
            column = lambda channel, unit: f"{channel} ({unit})" if unit else channel
            signals.append(Figure(f"last-{name}", f"The {name} of the last experiment.", f"The {name} over time.",
                                  thinned(last.t, dict(zip(names, side.T, strict=True))), "time (s)", ", ".join(map(column, names, units)), zoom=True))  # fmt: skip
    limits = [
        {"limit": words, "value": _listed(getattr(s, key), units)}
        for key, (words, units) in _limit_words(s).items()
        if getattr(s, key) not in (None, ())
    ]
    used = {
        "energy used": f"{status['energy']:.6g} (sum of squares)",
        "largest input": f"{status['peak']:.6g} {s.input_units[0]}".rstrip(),
        "samples": str(status["samples"]),
    }
    limits += [{"limit": key, "value": value} for key, value in used.items()]
    rest = rest_of(session)
    tested = (
        [f"{words.replace('+-', '±')}." for words in rest.sentences(s)]
        if rest
        else ["There is no rest test."]
    )
    step = {"READY": f"Ask for the next input: oed session next {folder.name}.",
            "WAITING": f"Apply {Path(status['input']).name if status['input'] else 'the input'} and hand over what was measured: "
            f"oed session record {folder.name} FILE."}.get(status["status"], f"The session has ended: {status['message'].rstrip('.')}. "
            "Use the estimate; every record is in the folder, input-0001.csv with output-0001.csv and so on.")  # fmt: skip
    where = ""
    if np.isfinite(found.frequency_error):
        turns = 2 * np.pi * s.dt
        where = f" at {stated(found.frequency / turns, found.frequency_error / turns).replace('+-', '±')} Hz"
    per = (
        f" {s.output_units[0] or s.outputs[0]}/{s.input_units[0] or s.inputs[0]}"
        if s.n_inputs == s.n_outputs == 1
        else ""
    )
    low, high = found.interval
    span = f" (95 % interval {low:.4g} to {high:.4g})" if np.isfinite([low, high]).all() else ""
    todo = [step, *(f"{w[:1].upper()}{w[1:]}." for w in rest.warnings(s))] if rest else [step]
    if status["status"] in ("READY", "WAITING"):
        left = in_words(rig_samples(s) * s.dt * (budget - done))
        todo.append(f"At most {budget - done} experiments are left: {left} on the rig.")
    answer = (f"The peak gain is {found.value:.4g}{per}{where}{span} after {done} of {budget} experiments." if np.isfinite(found.value)
              else f"There is no estimate yet: {done} of {budget} experiments are recorded.")  # fmt: skip
    said = str(found).replace("+-", "±").removesuffix(".")
    sure = [f"{said[:1].upper()}{said[1:]}."]
    sure += [f"Flagged and not used: {Path(name).name}." for name in status["flagged"]] + status["damage"]
    curve = Figure("estimate", f"The estimate over the experiments; intervals are cut at {CUT:g} times the last estimate.", "Estimated peak gain against the number of experiments.",
                   _curve(session) if done else [], "experiments", f"peak gain ({per.strip()})" if per else "peak gain",
                   {"estimate, with its 95 % interval": "both", "the method's own gain": "points"})  # fmt: skip
    sections = [
        Section("Records", [] if rows else ["Nothing is recorded yet."],
                [Table("records", "Every experiment that is used.", columns, rows)] if rows else [], signals),
        Section("The rig at rest", tested),
        Section("Limits", [], [Table("limits", "What the rig allows and what was used.", headed("limit", "value"), limits)]),
    ]  # fmt: skip
    made = {"method": s.method, "samples": str(s.samples), "sampling time (s)": f"{s.dt:g}", "seed": str(s.seed),
            "state": status["status"]}  # fmt: skip
    hero = [curve] if curve.rows else []
    return Page(
        "session", f"A session of {s.method}", answer, sure, todo, hero, sections, made, progress=(done, budget),
    )  # fmt: skip


def draw_session(folder: Path, file: Path) -> Path:
    """The session as a page (.html), or its estimates and last signals as a figure (.svg, .png, .pdf)."""
    kind = file.suffix.lower()
    if kind not in (".html", ".svg", ".png", ".pdf"):
        raise InputError(f"--picture is {file.name!r}; its name ends in .html, .svg, .png or .pdf.")
    page = session_page(folder)
    if kind == ".html":
        from benchmarks.page.skeleton import html

        return write_whole(file, html(page))
    if not page.figures:
        raise InputError(
            "nothing is recorded yet, so that there is nothing to draw; the page (.html) has the limits."
        )
    from benchmarks.page.figures_static import save_as, stacked

    return save_as(file, stacked([f for f in page.figures if f.rows]))
