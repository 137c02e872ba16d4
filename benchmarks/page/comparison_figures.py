"""The figures of a comparison as rows: where the iterations are optimal, what estimators waste, profiles, spectra, gains."""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from benchmarks.page.content import Figure, line
from benchmarks.tables.answer import KINDS
from benchmarks.tables.formats import format_value
from benchmarks.tables.profiles import TOLERANCE
from oed.plants.plant import Plant
from oed.theory.limit import limit_spectrum

Row = Mapping[str, Any]
OMEGA = "frequency (rad/sample)"
BARS = 2.0
"""Standard errors to either side that an error bar shows."""
MOST_SOLVERS = 12
"""Profiles in one figure, the best ones: more lines cannot be told apart; the table has all."""
GRID, AROUND = 200, 40
"""Frequencies of a spectrum's uniform grid, every third of some 600 pixels, and those on either side of a peak, where it is sharp."""


def measured(row: Row, key: str, place: str = "y") -> dict[str, Any]:
    """A value with its bar and with the text that the tables show."""
    value, se = row.get(key), row.get(f"{key}_se")
    point: dict[str, Any] = {place: value, "text": format_value(value, se)}
    if isinstance(value, int | float) and isinstance(se, int | float) and np.isfinite([value, se]).all():
        point |= {"low": max(value - BARS * se, 0.1 * abs(value)), "high": value + BARS * se}
    return point


def at(row: Row, **more: Any) -> dict[str, Any]:
    """What the filters know of a row, and more."""
    return {key: row[key] for key in ("plant", "noise_variance", "method", "known") if key in row} | more


def _of(row: Row) -> dict[str, Any]:
    return {
        "plant": row["plant"],
        "noise_variance": row["noise_variance"],
        "panel": f"{row['case']} ({row['channels']})",
    }


def where_figure(rows: Sequence[Row]) -> Figure:
    """Where the iterations are optimal experiment design: efficiency against noise, plant by plant."""
    points = []
    for row in rows:
        base = _of(row) | {"x": row["noise_variance"]}
        white = {"c_efficiency": row["c_efficiency"] / row["over_white"] if row["over_white"] > 0 else None}
        points += [
            base | measured(row, "c_efficiency") | {"series": "iterations, for the peak gain"},
            base | measured(row, "d_efficiency") | {"series": "iterations, for D"},
            base | measured(row, "limit") | {"series": "in the limit"},
            base | measured(white, "c_efficiency") | {"series": "white, for the peak gain"},
        ]
    return Figure(
        "answer-where",
        "Where the iterations are optimal design: what their experiments carry together, in shares of the certified optimum "
        "(bars: two standard errors), and what they would with experiments without end.",
        "Share of the certified optimum against the noise variance, one panel per plant, for the iterations, white noise and "
        "the limit of the iterations.",
        [p for p in points if p["y"] is not None and p["y"] == p["y"]], "noise variance", "share of the optimum",
        {"iterations, for the peak gain": "both", "iterations, for D": "both", "in the limit": "ticks"}, "xy", rules=(1.0,),
    )  # fmt: skip


def advice_figure(rows: Sequence[Row]) -> Figure:
    """What knowledge is worth: rho against noise of whoever knows the structure, whoever knows nothing, and the iterations."""
    points = [
        _of(row) | {"x": row["noise_variance"]} | measured(row, f"rho_{kind}") | {"series": words}
        for row in rows for kind, words in KINDS.items() if row[f"rho_{kind}"] == row[f"rho_{kind}"]
    ]  # fmt: skip
    return Figure(
        "answer-advice",
        "What knowledge is worth: rho of the best way of every kind (1 is the bound; bars: two standard errors), chosen on one half "
        "and judged on the other.",
        "Error rho against the noise variance, one panel per plant: the best that knows the structure, the best that knows "
        "nothing, and the iterations with their own estimator.",
        points, "noise variance", "rho", dict.fromkeys(KINDS.values(), "both"), "xy", rules=(1.0,),
    )  # fmt: skip


def growth_figure(rows: Sequence[Row]) -> Figure:
    """Efficiency of the iterations against experiments: predicted up to the limit, measured where the campaign went."""
    points = []
    for row in rows:
        noise = f"noise {row['noise_variance']:g}"
        base = _of(row) | {"x": row["experiments"]}
        points += [base | {"y": row["predicted"], "series": noise, "text": format_value(row["predicted"])}]
        if row["c_efficiency"] == row["c_efficiency"]:
            points += [base | measured(row, "c_efficiency") | {"series": f"measured, {noise}"}]
    names = {str(p["series"]): "points" for p in points if str(p["series"]).startswith("measured")}
    return Figure(
        "growth", "Efficiency for the peak gain of the first so many experiments together: predicted (lines), measured (marks).",
        "Share of the certified optimum against the number of experiments, one panel per plant, one line per noise level.",
        [p for p in points if p["y"] == p["y"]], "experiments (of Procedure 2 each counts)", "share of the optimum", names, "x", rules=(1.0,),
    )  # fmt: skip


def rho_figure(rows: Sequence[Row]) -> Figure:
    """Rho of every input and estimator with its bar, beside the prediction of the information."""
    points = []
    for row in rows:
        base = at(row, y=f"{row['method']} / {row['estimator']}", panel=row["plant"])
        noise = f"noise {row['noise_variance']:g}"
        points += [base | measured(row, "rho", "x") | {"series": noise}]
        if row["rho_predicted"] == row["rho_predicted"]:
            points += [
                base
                | {
                    "x": row["rho_predicted"],
                    "series": f"predicted, {noise}",
                    "text": format_value(row["rho_predicted"]),
                }
            ]
    order = sorted({p["series"] for p in points}, key=lambda name: (name.startswith("predicted"), name))
    points.sort(key=lambda p: order.index(p["series"]))
    return Figure(
        "rho", "rho of every input and estimator (bars: two standard errors) beside the prediction of the information.",
        "Error rho of every input with every estimator, one panel per plant, one mark per noise level.",
        points, "rho (1 is the bound)", "", {n: "ticks" if n.startswith("predicted") else "points" for n in order}, "x",
        sideways=True, rules=(1.0,),
    )  # fmt: skip


def efficiency_figure(rows: Sequence[Row], plant: str, theory: Mapping[float, NDArray[np.float64]]) -> Figure:
    """Efficiency of the first n experiments together, measured and predicted, for the peak gain and for D."""
    points = []
    for key, label in (("c_efficiency", "peak gain"), ("d_efficiency", "D")):
        for row in sorted(
            (r for r in rows if r["plant"] == plant and r[key] > 0), key=lambda r: r["experiments"]
        ):
            panel = f"{label}, noise {row['noise_variance']:g}"
            points.append(
                at(row, x=row["experiments"], panel=panel, series=row["method"]) | measured(row, key)
            )
    for variance, values in theory.items():
        points += [
            {"plant": plant, "noise_variance": variance, "method": "power", "x": n + 1, "y": float(v), "series": "power, theory",
             "panel": f"peak gain, noise {variance:g}", "text": format_value(float(v))}
            for n, v in enumerate(values)
        ]  # fmt: skip
    names = dict.fromkeys(str(p["series"]) for p in points)
    return Figure(
        f"efficiency-{plant}", f"{plant}: efficiency against the number of experiments, measured (marks) and predicted (line).",
        f"Efficiency of every input on {plant} against the number of experiments, for the peak gain and for D, by noise level.",
        points, "experiments", "efficiency", {n: "both" for n in names if n != "power, theory"} | {"power": "points"}, "x",
    )  # fmt: skip


def profile_figures(performance: Sequence[Row], data: Sequence[Row]) -> list[Figure]:
    """Performance and data profiles with pointwise 95 % bands, the best solvers only."""
    solvers = list(dict.fromkeys((r["method"], r["estimator"]) for r in performance))
    area = {s: sum(r["share"] for r in performance if (r["method"], r["estimator"]) == s) for s in solvers}
    best = sorted(solvers, key=lambda s: -area[s])[:MOST_SOLVERS]
    named = lambda rows, key: [
        at(r, x=r[key], y=r["share"], low=r["low"], high=r["high"], series=f"{r['method']} / {r['estimator']}",
           **({"panel": r["channels"]} if key == "experiments" else {}))
        for s in best for r in rows if (r["method"], r["estimator"]) == s
    ]  # fmt: skip
    return [
        Figure("profiles", "Performance profiles (Dolan, Moré) with pointwise 95 % bands (Wilson): how often an error is at most "
               "so many times the smallest.", "Share of all problems solved to within a ratio of the smallest error.",
               named(performance, "ratio"), "error over the problem's smallest", "share of the problems", log="x"),
        Figure("profiles-data", f"Data profiles (Moré, Wild): share of problems with an error of at most {100 * TOLERANCE:g} %, by budget.",
               "Share of problems solved against the number of experiments.", named(data, "experiments"), "experiments",
               "share of the problems", log="x"),
    ]  # fmt: skip


def head_to_head_figure(rows: Sequence[Row]) -> Figure:
    """Median relative errors of the head-to-head with their intervals, beside the printed ones."""
    here = [{"x": 100 * r["median"], "y": r["name"], "low": 100 * r["low"], "high": 100 * r["high"], "series": "here",
             "text": f"{100 * r['median']:.3g} %"} for r in rows]  # fmt: skip
    printed = [{"x": 100 * r["published"], "y": r["name"], "series": "printed", "text": f"{100 * r['published']:.3g} %"}
               for r in rows if r["published"] is not None]  # fmt: skip
    return Figure(
        "head-to-head", "Median relative error of every way, with its 95 % interval, and the printed one.",
        "Median relative errors with intervals, one line per input and estimator.", [*here, *printed],
        "median relative error (%)", "", {"here": "points", "printed": "points"}, "x", sideways=True,
    )  # fmt: skip


def claim_figure(rows: Sequence[Row]) -> Figure:
    """c-efficiency of sinusoid, limit spectrum and white noise, case by case."""
    names = {"sinusoid": "sinusoid at the peak", "limit": "limit of the iterations", "white": "white noise"}
    points = [
        {"x": float(row[key]), "y": f"{row['group']}: {row['plant']}", "series": name, "text": format_value(float(row[key]))}
        for key, name in names.items() for row in rows if row[key] == row[key]
    ]  # fmt: skip
    return Figure(
        "claim-map", "The map of the claim, case by case.", "Efficiency for the peak gain of three inputs in every case.",
        points, "efficiency for the peak gain (the certified optimum is 1)", "", dict.fromkeys(names.values(), "points"),
        sideways=True, rules=(1.0,),
    )  # fmt: skip


def _fine(centres: Sequence[float]) -> NDArray[np.float64]:
    """A grid on which every peak is drawn with its true height."""
    width = np.geomspace(1e-6, 1, AROUND)
    omega = np.unique(
        np.concatenate(
            [np.linspace(0, np.pi, GRID), centres, *(w + s * width for w in centres for s in (-1, 1))]
        )
    )
    return omega[(omega >= 0) & (omega <= np.pi)]


def limit_spectrum_figures(plant: Plant, name: str, noise_variances: Sequence[float]) -> list[Figure]:
    """[S] Fig. 2: magnitude of G, and the limit spectra at several noise levels."""
    limits = [limit_spectrum(plant.replace(noise_variance=v)) for v in noise_variances]
    omega = _fine(limits[0].peak.frequencies)
    gain = line(omega, np.abs(plant.transfer(omega)[:, 0, 0]), "|G|")
    density = [row for v, limit in zip(noise_variances, limits, strict=True)
               for row in line(omega, limit.density(omega), f"noise variance {v:.3g}")]  # fmt: skip
    top = limits[0].peak
    return [
        Figure(f"magnitude-{name}", f"{name}: magnitude of the plant, {top.value:.4f} at {top.frequency:.4f} rad/sample.",
               "Magnitude of the plant over frequency.", gain, OMEGA, "|G|"),
        Figure(f"limit-spectra-{name}", f"{name}: limit spectra of the power iterations ([S] Fig. 2); white noise is 1.",
               "Limit spectra over frequency at each noise variance.", density, OMEGA, "limit spectrum", log="y", rules=(1.0,)),
    ]  # fmt: skip


def spectra_figure(
    plant: Plant, name: str, noise_variances: Sequence[float], optima: Mapping[str, Any]
) -> Figure:
    """Cumulative power over frequency: lines have no density, so spectra are compared in what both have."""
    points = []
    for variance in noise_variances:
        s = limit_spectrum(plant.replace(noise_variance=variance)).spectrum
        keep = np.unique(np.linspace(0, len(s.omega) - 1, GRID).astype(int))
        share = np.cumsum(s.power[:, 0, 0].real) / s.total_power
        points += line(s.omega[keep], share[keep], f"iterations, noise variance {variance:.3g}")
    points += line((0.0, np.pi), (0.0, 1.0), "white noise")
    for key, spectrum in optima.items():
        order = np.argsort(spectrum.omega)
        steps = np.cumsum(spectrum.power[order, 0, 0].real)
        points += line(
            [0.0, *spectrum.omega[order], np.pi], [0.0, *(steps / steps[-1]), 1.0], f"optimal for {key}"
        )
    return Figure(
        f"spectra-{name}", f"{name}: where the power lies, iterations against optimal inputs (cumulative, since lines have no "
        "density).", "Share of the input power below a frequency.", points, OMEGA, "share of power below",
        {f"optimal for {key}": "step" for key in optima},
    )  # fmt: skip


def estimated_gain_figure(
    name: str, averages: Mapping[float, NDArray[np.float64]], single: NDArray[np.float64], single_variance: float,
    finite_norm: float, size: str,
) -> Figure:  # fmt: skip
    """[S] Fig. 3: estimated gain over the iterations, one run (M,) and averages."""
    n = np.arange(1, len(single) + 1)
    points = line(n, single, f"one run, noise variance {single_variance:.3g}")
    points += [row for v, mean in averages.items() for row in line(n, mean, f"mean, noise variance {v:.3g}")]
    return Figure(
        f"estimated-gain-{name}", f"{name}: estimated gain beta_2 during the iterations ([S] Fig. 3), {size}; the thin line is the "
        "finite-time norm. Runs whose square is negative are left out of that iteration's mean.",
        "Estimated gain against the iteration.", [p for p in points if p["y"] == p["y"]], "iteration", "estimated gain",
        rules=(finite_norm,),
    )  # fmt: skip


def hair_dryer_figures(story: Any) -> list[Figure]:
    """The hair dryer: input-residual correlation, and the simulation on the second half, before and after."""
    delays = dict(zip(("before", "after"), (story.before_delay, story.delay), strict=True))
    lags = [
        row for k, v in story.correlations.items() for row in line(story.lags, v, f"{k} (nk = {delays[k]})")
    ]
    t = story.test.t
    runs = line(t, story.test.y[:, 0], "measured")
    runs += [row for k, r in zip(("before", "after"), story.rows, strict=True)
             for row in line(t, story.simulated[k][:, 0], f"{k}: {r['simulation_rmse']:.3f} V rms")]  # fmt: skip
    return [
        Figure("hair-dryer", "What the residual says: correlation of input and residual (thin lines: 99 % bounds).",
               "Correlation of input and residual against the lag, before and after the delay was added.", lags,
               "lag (samples)", "correlation", dict.fromkeys((r["series"] for r in lags), "both"), rules=(-story.bound, story.bound)),
        Figure("hair-dryer-simulation", "Simulation on data not used for the fit.", "Measured and simulated output over time.",
               runs, "time (s)", "air temperature sensor (V)", zoom=True),
    ]  # fmt: skip
