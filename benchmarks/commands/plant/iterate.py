"""`oed iterate`: run the power iterations on a plant and print the gains."""

import argparse

from benchmarks.commands import natural

HELP = "run the power iterations on a plant; estimates per iteration"
EXAMPLE = "oed iterate --plant reference --algorithm siso --samples 1000 --iterations 50 --noise-variance 1"


def configure(parser: argparse.ArgumentParser) -> None:
    """Add the options of `oed iterate`."""
    add = parser.add_argument
    # fmt: off
    add("--plant", default="reference", help="name or JSON file of the plant")
    add("--algorithm", choices=("siso", "procedure-1", "two-experiment", "mimo"), default="siso")
    add("--samples", type=int, default=1000, help="samples per experiment")
    add("--iterations", type=int, default=50)
    add("--noise-variance", type=float)
    add("--scaling", choices=("none", "each", "common"), default="none",
        help="scaling of the second-stage inputs of mimo and two-experiment")
    add("--replicate", type=natural, default=0, help="which noise (of the same seed) is met")
    add("--until-settled", action="store_true", help="stop before --iterations when the gain changes by less than its standard error")
    add("--out", help="write inputs and outputs to this .npz or .csv file")
    # fmt: on


MOST_SAMPLES = 10**9
"""Simulated in all: some minutes, and gigabytes; what asks for more does not end."""


def run(args: argparse.Namespace) -> tuple[dict, str]:
    """Run the iterations."""
    import numpy as np

    from benchmarks.campaign.plants import load_plant
    from benchmarks.campaign.traces import trace_file, write_trace
    from estimators.norm.peak_estimates import corrected
    from estimators.norm.worst_inputs import worst_case
    from estimators.rules.by_name import iterate
    from estimators.rules.stopping import settled
    from oed.errors import InputError, OedError
    from oed.experiments import simulated

    if args.iterations < 1:
        raise InputError(f"--iterations is {args.iterations}; it must be at least 1.")
    if args.samples * args.iterations > MOST_SAMPLES:
        raise InputError(
            f"{args.iterations} iterations of {args.samples} samples are more than {MOST_SAMPLES:,} samples in all; ask for fewer."
        )
    if args.replicate < 0:
        raise InputError(f"--replicate is {args.replicate}; it must be at least 0.")
    if args.out:
        trace_file(args.out)
    plant = load_plant(args.plant, args.noise_variance)
    trace, gains = iterate(
        simulated(plant, seed=args.seed, replicate=args.replicate), algorithm=args.algorithm, samples=args.samples,
        iterations=args.iterations, scaling=args.scaling, rng=np.random.default_rng([args.seed, args.replicate]),
        stop=settled() if args.until_settled else None,
    )  # fmt: skip
    worst = worst_case(trace)
    local, reason = None, ""
    try:
        local = corrected(trace)
    except OedError as error:  # too short for a local model: say so, and go on
        reason = str(error)
    if args.out:
        write_trace(trace, args.out)
    complex_pairs = lambda v: [[float(x.real), float(x.imag)] for x in v]
    usage, last = trace.usage, gains["gain"]
    payload = {
        "plant": plant.name, "algorithm": args.algorithm, "scaling": args.scaling,
        "gain": {name: g.values.tolist() for name, g in gains.items()},
        "gain_status": {name: [s.name for s in g.statuses] for name, g in gains.items()},
        "estimate": last.last, "estimate_status": last.status.name,
        "frequency": worst.frequency, "frequency_hz": worst.frequency_hz,
        "direction": complex_pairs(worst.input_direction),
        "output_direction": complex_pairs(worst.output_direction),
        "corrected": None if local is None else [local.value, local.standard_error],
        "corrected_interval": None if local is None else list(local.interval()),
        "corrected_frequency": [local.frequency, local.frequency_error] if local and local.located else None,
        "corrected_status": "FAILED" if local is None else local.status.name,
        "experiments_used": usage.experiments, "samples": usage.samples, "energy": usage.energy,
        "status": trace.status.name, "message": trace.message,
    }  # fmt: skip
    lines = [f"{plant}", f"{trace}"]
    lines += [f"  {g}" for g in gains.values()]
    if not last.status.ok:
        lines.append(f"  last gain: {last.status.value}")
    lines.append(f"  corrected: {local}" if local else f"  corrected: none. {reason}")
    lines.append(f"  {worst}")
    if args.out:
        lines.append(f"  written to {args.out}")
    return payload, "\n".join(lines)
