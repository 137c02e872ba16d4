"""`oed design`: an optimal input for a plant, with its certificate."""

import argparse
from typing import Any

from benchmarks.campaign.plants import add_plant_arguments, load_plant
from oed.errors import InputError

HELP = "an optimal input: spectrum, loss, certified bound, and a signal that realises it"
EXAMPLE = "oed design --plant reference --criterion D --realise 1000 --out input.csv"


def configure(parser: argparse.ArgumentParser) -> None:
    """Add the options of this command."""
    add_plant_arguments(parser)
    add = parser.add_argument
    # fmt: off
    add("--criterion", default="D", metavar="NAME",
        help="what the input is optimal for (default D): all parameters (D, A, E, modified-E) or some (Ds:b1,a2), the peak gain (hinf), "
        "static-gain, the gain at 0.5 rad/sample (gain:0.5), the first pole (pole:1, damping:1), the response (I, G, or in a band I:0:0.5)")
    add("--parametrisation", choices=("grid", "moments", "autocorrelation", "ar", "bands", "multisine"), default="grid",
        help="of the spectrum; ar: --lags poles, bands: --lags flat bands")
    add("--lags", type=int, metavar="L", help="of the autocorrelation, the basis (default 20), the poles (4)")
    add("--points", type=int, default=400, metavar="K", help="uniform part of the first frequency grid")
    add("--band", type=float, nargs=2, metavar=("LOW", "HIGH"), help="rad/sample, default 0 pi")
    add("--input-power", type=float, metavar="p", help="limit on the input power (default 1)")
    add("--output-power", type=float, metavar="p", help="limit on the output's noise-free power")
    add("--channel-power", type=float, nargs="+", metavar="p", help="limit on every input channel's power")
    add("--amplitude", type=float, metavar="a", help="largest absolute input of the signal")
    add("--rate", type=float, metavar="r", help="largest change of the input per sample")
    add("--solver", choices=("newton", "clarabel"), default="newton", help="how weights are found")
    add("--realise", type=int, metavar="N", help="also make a signal of N samples")
    add("--signal", choices=("multisine", "realise", "filtered-noise", "binary"),
        help="its kind (default multisine; within --amplitude the best of all kinds, clipped ones too)")
    add("--out", metavar="FILE", help="write the signal (.csv), the design (.json), or both with a page into a new folder")
    # fmt: on


def run(args: argparse.Namespace) -> tuple[dict[str, Any], str]:
    """Design, realise, write."""
    import numpy as np

    from estimators.stages import stage
    from oed.design import solve_design
    from oed.design.parametrisations.amplitude import amplitude_design, within
    from oed.design.problem.words import in_words
    from oed.signals import synthesis as signals

    plant = load_plant(args.plant, args.noise_variance)
    writer = _writer(args)
    limits = {
        name: getattr(args, name) for name in ("input_power", "output_power", "band", "solver", "points")
    }
    if args.parametrisation == "multisine":
        # The lines of a period of N samples and no others.
        if args.realise is None:
            raise InputError("--parametrisation multisine has its lines at 2 pi k / N; say N with --realise.")
        limits |= {"points": 2 * np.pi * np.arange(args.realise // 2 + 1) / args.realise, "refine": False}
    made = None
    stage("the spectrum and its certificate")
    if args.rate is not None and args.amplitude is None:
        raise InputError("--rate limits a signal whose amplitude is limited: say --amplitude too.")
    if args.amplitude is not None:
        if args.realise is None or args.channel_power is not None:
            raise InputError(
                "--amplitude limits a signal: say its length with --realise N, without --channel-power."
            )
        rng = np.random.default_rng(args.seed)
        design, made = amplitude_design(
            plant, args.criterion, args.amplitude, args.realise, rng, rate=args.rate, **limits
        )
    else:
        design = solve_design(plant, args.criterion, channel_power=args.channel_power, **limits)
    payload, text = design.to_dict(), in_words(design)
    if args.parametrisation in ("moments", "autocorrelation", "ar", "bands"):
        design, payload, text = _parametrised(args, plant, design, payload)
    for line in payload["support"]:
        line["frequency_hz"] = line["frequency"] / (2 * np.pi * plant.dt)
    u = None
    if args.realise is not None:
        stage("the signal")
        if made is None or args.signal:
            how = getattr(signals, (args.signal or "multisine").replace("-", "_"))
            made = signals.realisation(
                plant, design, args.realise, np.random.default_rng(args.seed),
                how=how if made is None else lambda *given: within(how(*given), args.amplitude, args.rate),
            )  # fmt: skip
        u = made.u
        payload |= {"realised_loss": made.loss, "crest_factor": made.crest_factor}
        payload |= {"realised_power": made.power, "realised_efficiency": made.efficiency}
        text += f"\n{made!r}"
    if writer is not None:
        if not args.json:  # the answer first: figures take their time
            print(text, flush=True)
        stage("figures and page")
        notes = writer(payload, u, design, plant)
        text = "\n".join([*notes, f"written to {args.out}"])
        payload["out"] = args.out
    return payload, text


def _parametrised(args: argparse.Namespace, plant: Any, design: Any, payload: dict[str, Any]) -> tuple:
    """The same question in another parametrisation; the bound is the certified one over all spectra."""
    from dataclasses import replace

    import numpy as np

    from oed.design import (
        autocorrelation_design,
        autoregressive_design,
        band_basis,
        basis_design,
        moment_design,
    )
    from oed.design.problem.words import headline

    if args.amplitude or any(
        limit is not None for limit in (args.output_power, args.channel_power, args.band)
    ):
        raise InputError(
            f"--parametrisation {args.parametrisation} knows a limit on the input power only; leave out "
            "--output-power, --channel-power, --band and --amplitude, or use --parametrisation grid."
        )
    power = 1.0 if args.input_power is None else args.input_power
    lags = args.lags if args.lags is not None else 4 if args.parametrisation == "ar" else 20
    if args.parametrisation == "moments":
        found = moment_design(plant, args.criterion, input_power=power)
    elif args.parametrisation == "ar":
        found = autoregressive_design(plant, args.criterion, order=lags, input_power=power)
    elif args.parametrisation == "bands":
        basis = band_basis(np.linspace(0, np.pi, lags + 1))
        found = basis_design(plant, args.criterion, basis, input_power=power)
    else:
        found = autocorrelation_design(plant, args.criterion, lags=lags, input_power=power)
    design = replace(
        design,
        spectrum=found.spectrum,
        loss=found.loss,
        information=design.map.of_spectrum(found.spectrum),
        power_used={"input power": found.power},
        solver="clarabel" if args.parametrisation in ("moments", "autocorrelation") else "newton",
    )
    strongest = replace(design, spectrum=found.spectrum.strongest(1e-3))
    payload = payload | {
        "loss": found.loss, "gap": design.gap,
        "support": strongest.to_dict()["support"] if found.kind == "moments" else [],
        "coefficients": found.coefficients.tolist(), "parametrisation": args.parametrisation,
        "solver": design.solver, "input_power": found.spectrum.total_power, "power_used": design.power_used,
        "information": design.information.tolist(),
    }  # fmt: skip
    text = f"{headline(design)}\n{found!r}\nat least {design.bound:.12g} for every admissible spectrum (gap {design.gap:.1e})"
    return design, payload, text


MADE_WITH = ("parametrisation", "amplitude", "rate", "realise", "signal", "seed")
"""Options that the page of a design states."""


def _writer(args: argparse.Namespace):
    """A function that writes the result; complaints come before any work."""
    out, samples = args.out, args.realise
    if out is None:
        return None
    import json
    from functools import partial
    from pathlib import Path

    from oed.files.writing import new_folder, write_whole

    path = Path(out)
    if not path.suffix:
        return partial(
            _write_page, new_folder(out, "--out"), {name: getattr(args, name) for name in MADE_WITH}
        )
    if path.exists():
        raise InputError(f"{out} exists already; choose another name or remove it.")
    if not path.parent.is_dir():
        raise InputError(f"the folder of {out} does not exist; create it first.")
    if path.suffix not in (".csv", ".json"):
        raise InputError(f"--out is {out}; name it .csv (the signal), .json (the design), or a folder.")
    if path.suffix == ".csv" and samples is None:
        raise InputError("--out with .csv writes the signal; say its length with --realise N.")

    def write(payload: dict[str, Any], u: Any, design: Any, plant: Any) -> list[str]:
        write_whole(
            path, (json.dumps(payload, indent=1) if path.suffix == ".json" else _csv(u, plant.dt)) + "\n"
        )
        return []

    return write


def _csv(u: Any, dt: float) -> str:
    names = ["t", "u"] if u.shape[1] == 1 else ["t", *(f"u{j + 1}" for j in range(u.shape[1]))]
    rows = (",".join(map(repr, (k * dt, *row))) for k, row in enumerate(u.tolist()))
    return "\n".join([",".join(names), *rows])


def _write_page(
    folder: Any, options: dict[str, Any], payload: dict[str, Any], u: Any, design: Any, plant: Any
) -> list[str]:
    """Writes the design, its signal and its page into a new folder; what is to be said of it."""
    import json

    from oed.files.writing import write_whole
    from oed.lazily import where_installed

    write_whole(folder / "design.json", json.dumps(payload, indent=1) + "\n")
    if u is not None:
        write_whole(folder / "input.csv", _csv(u, plant.dt) + "\n")
    made = {"criterion": payload["criterion"], "plant": plant.name, "solver": design.solver} | options
    notes: list[str] = []
    with where_installed(notes, "the page"):
        from benchmarks.page.design import write_design

        write_design(folder, design, plant, payload, u, made)
    return notes
