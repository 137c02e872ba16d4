"""`oed plot`: the figures of an identified model."""

import argparse

HELP = "figures of identified models: frequency response, poles, step response, residual tests, measured against simulated"
EXAMPLE = "oed plot record.csv --structure oe --orders 2 2 --delay 3 --figure bode --out bode.svg"

FIGURES = ("bode", "poles", "step", "residuals", "compare")


def configure(parser: argparse.ArgumentParser) -> None:
    """The model is fitted here, so that the figure has its bands."""
    from benchmarks.commands.record.identify import DEFAULTS, order

    parser.add_argument("data", metavar="DATA", help="csv, mat, parquet or npz; FILE[a:b] takes rows")
    parser.add_argument(
        "--structure",
        nargs="+",
        choices=tuple(DEFAULTS),
        default=["oe"],
        help="of --figure compare also several",
    )
    parser.add_argument("--orders", nargs="+", type=order, metavar="n", help="as in oed identify, or auto")
    parser.add_argument("--delay", default="1", help="nk in samples, or auto (default 1)")
    parser.add_argument("--figure", choices=FIGURES, default="bode")
    parser.add_argument("--test", metavar="DATA", help="fresh data for --figure compare")
    parser.add_argument(
        "--skip", type=int, default=20, metavar="n", help="samples that set the initial state (20)"
    )
    parser.add_argument("--inputs", help="input columns, with commas (default: those that begin with u)")
    parser.add_argument("--outputs", help="output columns, with commas (default: those that begin with y)")
    parser.add_argument("--dt", type=float, help="sampling time in seconds")
    parser.add_argument("--out", required=True, metavar="FILE", help="svg, pdf or png")


def run(args: argparse.Namespace) -> tuple[dict, str]:
    """The payload and the text: where the figure is."""
    from pathlib import Path

    from benchmarks.commands.record.identify import asked
    from estimators.pem import identify
    from estimators.residual.comparison import compare_models
    from estimators.stages import stage
    from oed.errors import InputError
    from oed.files import read_record
    from oed.files.writing import write_figure

    target = Path(args.out)
    if target.suffix not in (".svg", ".pdf", ".png"):
        raise InputError(f"--out is {args.out}; a figure is svg, pdf or png: choose one of these suffixes.")
    if not target.parent.is_dir():
        raise InputError(f"the folder {target.parent} does not exist; make it first.")
    if args.data.endswith(".json"):
        raise InputError(
            f"{args.data} is a model, and figures are of a model and its record; give the record, or open report.html beside the "
            "model: oed identify --out made it."
        )
    if len(args.structure) > 1 and (args.figure != "compare" or args.orders not in (None, ["auto"])):
        raise InputError(
            f"--structure names {len(args.structure)} structures; several are for --figure compare, with --orders auto or none."
        )
    reading = {"inputs": args.inputs, "outputs": args.outputs, "dt": args.dt}
    record = read_record(args.data, **reading)
    stage("the fit")
    fits = {name: identify(record, name, *asked(args, name)) for name in args.structure}
    plots = fits[args.structure[0]].plot
    stage("the figure")
    payload: dict = {"path": str(target)}
    lines = [f"written to {target}"]
    if args.figure == "compare":
        fresh = read_record(args.test, **reading) if args.test else record
        compared = compare_models(fits, fresh, skip=args.skip)
        payload["rows"], figure = compared.rows, compared.plot()
        lines.insert(0, repr(compared))
    elif args.figure == "residuals":
        figure = plots.residuals(record)
    else:
        figure = {"bode": plots.bode, "poles": plots.poles, "step": plots.step}[args.figure]()
    write_figure(target, figure)
    return payload, "\n".join(lines)
