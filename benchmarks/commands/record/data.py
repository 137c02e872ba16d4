"""`oed data`: well-known benchmark records from a folder of the user's, with their splits and published errors."""

import argparse
from dataclasses import dataclass

HELP = "well-known benchmark records from your folder: their splits, published errors, and the call to diagnose each"
EXAMPLE = "oed data silverbox --from ~/records"


@dataclass(frozen=True)
class Benchmark:
    """A benchmark record: files, rows of each split, samples that set the initial state, published simulation errors."""

    train: str
    test: str
    skip: int
    unit: str
    published: str
    options: str = ""


SPLITS = "M. D. Champneys et al., Baseline results for selected nonlinear system identification benchmarks, IFAC SYSID 2024"
RECORDS = {
    "silverbox": Benchmark(
        "silverbox_snls80mv.csv.gz[40650:105712]", "silverbox_snls80mv.csv.gz[105712:127400]", 50, "mV",
        "linear 6.95; best nonlinear 0.26 and below", "--dt 0.0016384",
    ),
    "wiener-hammerstein": Benchmark(
        "wiener_hammerstein_2009.csv.gz[5200:105200]", "wiener_hammerstein_2009.csv.gz[105200:184000]", 50, "mV",
        "linear 43.4; best nonlinear 0.24", "",
    ),
    "cascaded-tanks": Benchmark("cascaded_tanks_est.csv", "cascaded_tanks_val.csv", 50, "V", "linear 0.588", ""),
    "emps": Benchmark(
        "emps_est.csv.gz", "emps_val_pulses.csv.gz", 20, "mm", "linear 5.53", "--inputs vir_V --outputs qm_m"
    ),
}  # fmt: skip


def configure(parser: argparse.ArgumentParser) -> None:
    """The name and the folder."""
    parser.add_argument("name", nargs="?", help="; ".join(RECORDS) + "; none lists them all")
    parser.add_argument(
        "--from", dest="folder", default=".", metavar="DIR", help="folder with the files (default .)"
    )


def run(args: argparse.Namespace) -> tuple[dict, str]:
    """The payload and the text: which files are there, how they are split, what was published."""
    from pathlib import Path

    from oed.errors import InputError, check_names

    if args.name is not None:
        check_names([args.name], tuple(RECORDS), "benchmark record")
    folder, rows, lines = Path(args.folder), [], []
    for name in [args.name] if args.name else RECORDS:
        known = RECORDS[name]
        parts = [str(folder / part) for part in (known.train, known.test)]
        missing = [p for p in parts if not Path(p.partition("[")[0]).is_file()]
        if missing and args.name:
            raise InputError(
                f"{missing[0].partition('[')[0]} is not there; put the benchmark's file, as CSV, under that name into "
                f"{folder}, or name its folder with --from."
            )
        call = f'oed diagnose "{parts[0]}" --test "{parts[1]}" --skip {known.skip} {known.options}'.rstrip()
        rows.append(
            {"name": name, "train": parts[0], "test": parts[1], "skip": known.skip, "unit": known.unit,
             "published": known.published, "source": SPLITS, "there": not missing, "call": call}
        )  # fmt: skip
        lines += [
            f"{name}: {'there' if not missing else 'not there'}; published [{known.unit}]: {known.published}",
            f"  {call}",
        ]
    return {"rows": rows}, "\n".join([*lines, f"splits and linear figures: {SPLITS}"])
