"""`oed identify`: a model of measured data by prediction-error identification."""

import argparse
from typing import Any

from oed.models.structures import ORDERS, STRUCTURES

HELP = "identify a model from data: parameters with standard errors, residual tests"
EXAMPLE = "oed identify record.csv --structure oe --orders 2 2 --delay 3"

DEFAULTS = {name: [one.first] * len(one.letters) for name, one in STRUCTURES.items()} | {"ss": [2]}


def configure(parser: argparse.ArgumentParser) -> None:
    """Add the options of `oed identify`."""
    add = parser.add_argument
    # fmt: off
    add("data", nargs="+", metavar="DATA", help="csv, mat, parquet or npz; FILE[a:b] takes rows; several: one model")
    add("--structure", choices=tuple(ORDERS), default="oe",
        help="how the noise enters: white at the output (oe, the default; fir), through the poles of the system (arx, armax), by a model of its "
        "own (bj), or through the state (ss)")
    add("--orders", nargs="+", type=order, metavar="n",
        help="; ".join(f"{k}: {' '.join(v)}" for k, v in ORDERS.items()) + " (default: 2); or auto, by blocks left out")
    add("--delay", default="1", help="nk in samples, or auto (default 1)")
    add("--diagonal", action="store_true", help="input i drives output i alone")
    add("--no-offset", action="store_true", help="signals are deviations; no offset is estimated")
    add("--remove-means", action="store_true", help="take the means as the offset")
    add("--initial", choices=("zero", "estimate", "backcast"), help="initial states (default: estimate; with --no-offset zero)")
    add("--iterations", type=int, default=100, metavar="n", help="most steps of the search (default 100)")
    add("--search", choices=("quick", "auto", "thorough"), default="auto", help="how hard the optimum is looked for")
    add("--method", choices=("pem", "moesp", "n4sid", "cva"), default="pem",
        help="of ss: prediction errors (default), or a subspace method, which needs no search")
    add("--horizon", type=int, metavar="i", help="block rows of the subspace method (default: chosen from the data)")
    add("--missing", action="store_true", help="NaN in the outputs marks missing samples")
    add("--robust", choices=("huber", "student"), help="a loss that withstands outliers")
    add("--regularisation", choices=("tc", "dc", "ss"),
        help="of fir: a kernel that expects the response to decay, its hyperparameters by marginal likelihood")
    add("--disturbance", choices=("ar1", "walk"), help="with --regularisation: a slow disturbance beside the noise")
    add("--folds", type=int, metavar="n",
        help="also simulate each of n blocks (or of several records) by a model of the others; --skip holds for each")
    add("--test", metavar="DATA", help="fresh data: the errors there are reported too")
    add("--skip", type=int, default=0, metavar="n",
        help="the first n samples of --test are left out of its errors and, unless --initial zero, set the initial state")
    add("--inputs", help="input columns, with commas (default: those that begin with u)")
    add("--outputs", help="output columns, with commas (default: those that begin with y)")
    add("--dt", type=float, help="sampling time in seconds")
    add("--out", metavar="DIR", help="write model.json, residuals.csv and report.html into this new folder")
    # fmt: on


AS_GIVEN = (
    "initial", "diagonal", "missing", "robust", "search", "regularisation", "disturbance", "method",
    "horizon",
)  # fmt: skip
"""Arguments of `identify` that are the options of the same names."""


def run(args: argparse.Namespace) -> tuple[dict, str]:
    """Identify a model."""
    from estimators.pem import identify
    from estimators.pem.results import needed
    from estimators.residual.comparison import errors_on
    from estimators.residual.tests import residual_tests
    from estimators.stages import stage
    from oed.files.writing import new_folder
    from oed.inspection import defects
    from oed.lazily import where_installed

    notes: list[str] = []
    records, fresh = _read(args, notes)
    out = new_folder(args.out, "--out") if args.out else None
    offset = "mean" if args.remove_means else not args.no_offset
    options = {name: getattr(args, name) for name in AS_GIVEN} | {
        "offset": offset,
        "max_iterations": args.iterations,
    }
    stage("the fit")
    orders, delay = asked(args, args.structure)
    fit = identify(records, args.structure, orders, delay, **options)
    if "auto" in (orders, delay):
        orders, delay = _found(fit.model.structure)
    stage("residual tests")
    seen = defects(records, order=needed(fit.model.structure))
    complete = all(record.complete for record in records)
    tests = residual_tests(fit, records) if complete else {}
    if not complete:
        notes.append("Samples are missing, so that no residual test was made.")
    payload = fit.to_dict() | {
        "structure": args.structure, "orders": orders, "delay": delay,
        "residual_tests": {name: test.p_value for name, test in tests.items()},
        "residual_lags": {name: test.significant().tolist() for name, test in tests.items()},
        "data_defects": [defect.to_dict() for defect in seen], "notes": [*fit.notes, *notes],
    }  # fmt: skip
    if records[0].dt != 1:
        import numpy as np

        payload["hinf_frequency_hz"] = payload["hinf_frequency"] / (2 * np.pi * records[0].dt)
    if fresh is not None:
        payload["test"] = errors_on(fit, fresh, skip=args.skip) | {"skipped": args.skip}
        if not args.skip and fit.initial != "zero":
            notes.append(
                "--test is simulated from rest; with --skip 20 its first 20 samples set the state and are not judged."
            )
    lines = [_headline(fit, records[0], payload), repr(fit), _letters(fit, records[0])]
    unanswered = [defect for defect in seen if not (offset and defect.kind == "offset")]
    if unanswered:
        lines += ["seen in the data, and left as it is:", *(f"  {defect}" for defect in unanswered)]
    if offset:
        lines += _levels(fit, records[0])
    if tests:
        lines += ["residual tests (p-values):", *(f"  {test!r}" for test in tests.values())]
    if args.folds is not None:
        stage("blocks left out in turn")
        from estimators.pem.choice import held_out_error
        from estimators.residual.measures import window_of

        how = {"folds": args.folds, "window": window_of(fit.initial, args.skip)}
        error, spread = held_out_error(records, args.structure, orders, delay, **how, **options)
        payload["held_out"] = {"simulation_rmse": error, "standard_error": spread}
        lines.append(f"on what was left out in turn: simulation error {error:.6g} +- {spread:.2g}")
    if fresh is not None:
        lines.append(
            "on fresh data: simulation error {simulation_rmse:.6g} (fit {simulation_fit_percent:.2f} %), "
            "one-step error {prediction_rmse:.6g}".format(**payload["test"])
        )
    lines += [f"note: {note}" for note in notes]
    if out:
        if not args.json:  # the answer first: figures take their time
            print("\n".join(lines), flush=True)
        stage("figures and page")
        lines, payload["out"] = [], _write(out, fit, records)
        made = {"data": " ".join(args.data), "structure": args.structure, "orders": orders, "delay": delay}
        with where_installed(lines, "the page"):
            from benchmarks.page.identification import write_identification

            more = {"options": options, "letters": f"{_letters(fit, records[0]).strip()}."}
            write_identification(out, fit, records, tests, made, payload | more)
        lines.append(f"written to {payload['out']}")
    return payload, "\n".join(lines)


def _read(args: argparse.Namespace, notes: list[str]) -> tuple[list, Any]:
    """The records to fit, and the fresh one."""
    from estimators.diagnosis.record.admission import check_distinct, check_fresh
    from estimators.stages import stage
    from oed.files import read_record

    stage("reading the data")
    how = {name: getattr(args, name) for name in ("inputs", "outputs", "dt", "missing")}
    records = [read_record(spec, **how, notes=notes) for spec in args.data]
    check_distinct(records)
    fresh = read_record(args.test, **how, notes=notes) if args.test else None
    if fresh is not None:
        for record in records:
            check_fresh(record, fresh)
    return records, fresh


def _levels(fit, record) -> list[str]:
    return [
        f"  level of {name}: {value:.6g}" + (f" +- {error:.2g}" if error else "") + f" {unit}".rstrip()
        for name, unit, value, error in zip(
            [*record.input_names, *record.output_names], [*record.input_units, *record.output_units],
            [*fit.input_level, *fit.output_level], [*(0 * fit.input_level), *fit.output_level_errors], strict=True,
        )
    ]  # fmt: skip


def _headline(fit, record, payload: dict) -> str:
    """What an engineer asks first: the gain with its unit, the error and where it was measured, the noise."""
    import numpy as np

    from benchmarks.page.identification import TOLD
    from estimators.residual.measures import per

    u, y = (units[0] or names[0] for units, names in (
        (record.input_units, record.input_names), (record.output_units, record.output_names)))  # fmt: skip
    gain, error, omega = fit.hinf_norm
    said = f"largest gain {gain:.4g} +- {error:.2g} {per(y, u)} at {omega / (2 * np.pi * record.dt):.4g} Hz"
    if not fit.model.stable:
        said = "WARNING: the model is unstable, so that it has no largest gain"
    elif not gain > TOLD * error:
        said = (
            f"WARNING: these data do not tell the gain ({said.removeprefix('largest gain ')}); check that inputs and outputs "
            "are not swapped, the delay (--delay auto), and that the input moves enough"
        )
    if "test" in payload:
        said += f"; simulation error on fresh data {payload['test']['simulation_rmse']:.4g} {y}"
    else:
        said += f"; simulated, {fit.simulation_fit_percent:.1f} % of the data fitted is explained (fresh data: --test)"
    return f"{said}; noise {np.sqrt(fit.noise_covariance[0, 0]):.4g} {y}"


LETTERS = {
    "b": "of the input k samples before, in {per}", "f": "of the simulated output k samples before, no unit",
    "a": "of the output k samples before, no unit", "c": "of the noise k samples before, no unit",
    "d": "of the coloured noise k samples before, no unit", "A": "from state to state, no unit",
    "B": "from the inputs to the states, in {per}", "C": "from the states to the outputs, no unit",
    "D": "from the inputs to the outputs, in {per}", "K": "from the noise to the states, no unit",
}  # fmt: skip
"""What the letters of the parameters stand for; the states have the outputs' units."""


def _letters(fit, record) -> str:
    from estimators.residual.measures import per

    units = lambda units, names: " or ".join(dict.fromkeys(u or n for u, n in zip(units, names, strict=True)))
    gain = per(units(record.output_units, record.output_names), units(record.input_units, record.input_names))
    used = dict.fromkeys(name[0] for name in fit.names if name[0] in LETTERS)
    return "  Where " + "; ".join(f"{letter}: {LETTERS[letter].format(per=gain)}" for letter in used)


def order(text: str) -> int | str:
    """One of --orders."""
    return text if text == "auto" else int(text)


def asked(args: argparse.Namespace, structure: str) -> tuple[Any, Any]:
    """Orders and delay of a structure as `identify` takes them."""
    orders = args.orders or DEFAULTS[structure]
    return "auto" if "auto" in orders else orders, "auto" if args.delay == "auto" else _whole(args.delay)


def _found(form) -> tuple[list[int], int]:
    """Orders, as the command line takes them, and delay of a structure."""
    if form.kind == "ss":
        return [form.order], 1 - form.feedthrough
    return [int(getattr(form, name).max()) for name in ORDERS[form.kind]], int(form.nk.max())


def _whole(text: str) -> int:
    from oed.errors import InputError

    try:
        return int(text)
    except ValueError:
        raise InputError(f"--delay is {text!r}; give a whole number of samples, or auto.") from None


def _write(folder, fit, records) -> str:
    import json

    import numpy as np

    from oed.files.writing import write_whole

    levels = {"input_level": fit.input_level.tolist(), "output_level": fit.output_level.tolist()}
    saved = fit.model.to_dict() | {"covariance": fit.covariance.tolist(), **levels, "status": fit.status.name}
    head = "record,t," + ",".join(f"e_{name}" for name in records[0].output_names)
    rows = [
        np.column_stack([np.full(len(e), k + 1), r.t, e])
        for k, (r, e) in enumerate(zip(records, fit.residuals, strict=True))
    ]
    table = "\n".join(",".join(repr(float(x)) for x in row) for row in np.concatenate(rows))
    for name, text in (("model.json", json.dumps(saved)), ("residuals.csv", f"{head}\n{table}")):
        write_whole(folder / name, text + "\n")
    return str(folder)
