"""`oed diagnose`: what a linear model of a record lacks, and the error before and after it is added."""

import argparse
from pathlib import Path
from typing import Any

from oed.errors import InputError

HELP = "find the residual of a linear model, trace it to its cause, add the effect, report before and after"
EXAMPLE = "oed diagnose train.csv --test test.csv --meta meta.json --json"


def configure(parser: argparse.ArgumentParser) -> None:
    """Add the options of this command."""
    add = parser.add_argument
    # fmt: off
    add("train", metavar="TRAIN", nargs="+", help="training record (csv, mat, parquet or npz), or several of one system; FILE[a:b] takes rows a to b-1")
    add("--test", metavar="TEST", help="held-out record, whose state is that of TRAIN's end where it goes on from there; without it blocked cross-validation inside TRAIN")
    add("--meta", metavar="META.json", help="sampling time, structure and order known beforehand")
    add("--skip", type=int, metavar="n", help="test samples that may set the initial state (0, or what META.json says)")
    add("--order", type=int, help="order stated for the linear model; what the data ask for beyond it is named (default: from --meta, else none)")
    add("--model", metavar="MODEL.json", help="a model of the system, as `oed identify --out` writes it: its orders are kept, its error stands beside")
    add("--inputs", metavar="NAMES", help="input columns, with commas (default: those that begin with u)")
    add("--outputs", metavar="NAMES", help="output columns, with commas (default: those that begin with y)")
    add("--dt", type=float, help="sampling time in seconds")
    add("--alpha", type=float, default=0.01, help="false-alarm rate over all tests (default 0.01)")
    add("--effort", choices=("quick", "normal", "thorough"), default="normal", help="how much work it may be (default normal)")
    add("--out", metavar="DIR", help="write the result, the simulated outputs, figures and report.html there")
    # fmt: on


def run(args: argparse.Namespace) -> tuple[dict[str, Any], str]:
    """Diagnose one pair of records."""
    from estimators.diagnosis.cases import Columns, diagnose_files
    from estimators.diagnosis.policy import Effort, Setting
    from estimators.stages import stage
    from oed.files.writing import new_folder
    from oed.lazily import where_installed

    if args.skip and not args.test:
        raise InputError("--skip is of the test record; give --test, or leave it out.")
    if args.out:
        new_folder(args.out, "--out")
    given = _given(args) if args.model else None
    orders = given["orders"] if given is not None else () if args.order is None else (args.order,)
    result, notes = diagnose_files(
        args.train, args.test, meta=args.meta, skip=args.skip, columns=Columns(args.inputs, args.outputs, args.dt),
        setting=Setting(orders=orders, alpha=args.alpha, effort=Effort(args.effort)),
        progress=stage,
    )  # fmt: skip
    payload = result.to_dict() | {"notes": notes}
    if args.meta:
        payload["case"] = Path(args.meta).parent.name
    words = [str(result)]
    if given is not None:
        payload["model_given"] = given
        errors = ", ".join(f"{value:.4g}" for value in given["rmse"])
        beside = f"the model {args.model} misses {given['record']} by {errors} (rms, output units); its orders are kept for the linear model."
        words.append(beside)
    text = "\n".join([*words, *(f"note: {note}" for note in notes)])
    if args.out:
        if not args.json:  # the answer first: figures take their time
            print(text, flush=True)
        from estimators.diagnosis.result.saving import save

        stage("figures and page")
        folder, said = Path(args.out), list[str]()
        made = {
            "training record": ", ".join(args.train),
            "test record": args.test or "none",
            "false-alarm rate": args.alpha,
        }
        save(result, folder)
        with where_installed(said, "the page"):
            from benchmarks.page.diagnosis import write_diagnosis_report

            write_diagnosis_report(result, folder, made)
        payload |= {"out": str(folder), "model": str(folder / "model.json")}
        text = "\n".join([*said, f"written to {folder}"])
    return payload, text


def _given(args: argparse.Namespace) -> dict[str, Any]:
    """The model that the user has: its orders, and its error on the test record, or on the first that it is fitted to."""
    from oed.files import read_record
    from oed.plants.json import plant_from_json
    from oed.plants.judging import errors_of, orders_of

    if args.order is not None:
        raise InputError("--model and --order both tell the order; give one of them.")
    plant, where = plant_from_json(args.model), args.test or args.train[0]
    record = read_record(where, inputs=args.inputs, outputs=args.outputs, dt=args.dt, missing=True)
    rmse = errors_of(plant, record).tolist()
    return {"file": args.model, "orders": orders_of(plant), "record": where, "rmse": rmse}
