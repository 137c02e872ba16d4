"""`oed theory`: what the theory predicts for the power iterations on a plant."""

import argparse
from typing import Any

from benchmarks.campaign.plants import add_plant_arguments, load_plant
from oed.errors import InputError

HELP = "what the theory predicts for the iterations: limit spectrum, bias, efficiency"
EXAMPLE = "oed theory --plant reference --noise-variance 1 --json"


def configure(parser: argparse.ArgumentParser) -> None:
    """Add the options of this command."""
    add_plant_arguments(parser)
    add = parser.add_argument
    # fmt: off
    add("--algorithm", choices=("siso", "two-experiment", "mimo"), help="default: siso, mimo for a MIMO plant")
    add("--scaling", choices=("none", "each", "common"), default="none", help="of Procedure 2's second stage")
    add("--experiments", type=int, default=50, metavar="n", help="efficiencies of the first 1..n (default 50)")
    add("--samples", type=int, metavar="N", help="also the prediction for experiments of N samples")
    add("--claim-map", action="store_true",
        help="instead: where the sinusoid at the peak and the limit spectrum are optimal, this plant first")
    # fmt: on


MOST_SAMPLES, MOST_EXPERIMENTS = 10**7, 10**4
"""Of an experiment, by whose length the theory for short ones goes over into that for long ones long before, and of them."""


def run(args: argparse.Namespace) -> tuple[dict[str, Any], str]:
    """Compute the prediction."""
    from benchmarks.tables.predictions import mimo_prediction, siso_prediction
    from estimators.stages import stage

    plant = load_plant(args.plant, args.noise_variance)
    several = plant.n_inputs * plant.n_outputs > 1
    algorithm = args.algorithm or ("mimo" if several else "siso")
    if args.experiments < 1:
        raise InputError(f"--experiments is {args.experiments}; it must be at least 1.")
    if args.samples is not None and not 2 <= args.samples <= MOST_SAMPLES:
        raise InputError(
            f"--samples is {args.samples}; an experiment has at least 2, and here at most {MOST_SAMPLES:,}."
        )
    if args.experiments > MOST_EXPERIMENTS:
        raise InputError(f"--experiments is {args.experiments}; at most {MOST_EXPERIMENTS:,} are computed.")
    if several and algorithm != "mimo":
        raise InputError(
            f"the plant has {plant.n_outputs} outputs and {plant.n_inputs} inputs; --algorithm {algorithm} is for "
            "one of each: use --algorithm mimo."
        )
    stage("the limit spectrum and its efficiency")
    if args.claim_map:
        return _claim_map(plant)
    if algorithm == "siso":
        return siso_prediction(plant, experiments=args.experiments, samples=args.samples)
    return mimo_prediction(plant, algorithm, args.scaling, experiments=args.experiments, samples=args.samples)


def _claim_map(plant: Any) -> tuple[dict[str, Any], str]:
    """This plant's row and those of the usual cases, each with its certificate."""
    from benchmarks.tables.columns import headings
    from benchmarks.tables.formats import to_text
    from benchmarks.tables.predictions import claim_row, claim_tasks
    from oed.theory import map_of_claim

    rows = [
        claim_row("this plant", map_of_claim([plant])[0]),
        *(row for task in claim_tasks() for row in task()),
    ]
    return {"claim_map": rows}, to_text(rows, headings("claim_map"))
