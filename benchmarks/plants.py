"""Plants by name or file, as the command line takes them, among them the one identified from the hair dryer."""

from __future__ import annotations

import argparse
from functools import lru_cache
from importlib.resources import files
from pathlib import Path

from oed.data import Record
from oed.errors import InputError, check_names
from oed.plants import Plant

__all__ = ["add_plant_arguments", "hair_dryer_record", "load_plant", "plant_names"]

HAIR_DRYER = "hair-dryer"


def plant_names() -> tuple[str, ...]:
    """Names of all plants that the suite knows.

    Returns
    -------
    tuple of str
        For `--plant`.
    """
    from oed.named import NAMES

    return (*NAMES, HAIR_DRYER)


def add_plant_arguments(parser: argparse.ArgumentParser) -> None:
    """Add `--plant` and `--noise-variance`.

    Parameters
    ----------
    parser : argparse.ArgumentParser
        Of a subcommand about one plant.
    """
    parser.add_argument(
        "--plant", required=True, metavar="NAME|FILE.json", help="a named plant or a JSON file"
    )
    parser.add_argument(
        "--noise-variance",
        type=float,
        metavar="V",
        help="noise variance on every output (for hair-dryer: in multiples of the identified one)",
    )


def load_plant(spec: str, noise_variance: float | None = None) -> Plant:
    """Plant by name or from a JSON file.

    Parameters
    ----------
    spec : str
        A name of `plant_names()`, or a file.
    noise_variance : float, optional
        Overrides the plant's own; for the hair dryer in multiples of the identified variance.

    Returns
    -------
    Plant
        InputError if there is no such plant or the file does not describe one.
    """
    if spec.endswith(".json") or "/" in spec or Path(spec).is_file():
        from oed.plant_files import plant_from_json

        return plant_from_json(spec, noise_variance=noise_variance)
    check_names([spec], plant_names(), "plant")
    if spec == HAIR_DRYER:
        plant = _hair_dryer()
        if noise_variance is None:
            return plant
        if not noise_variance >= 0:
            raise InputError(
                f"the noise variance is {noise_variance:g}; it must be at least 0: check its sign."
            )
        return plant.replace(noise_variance=noise_variance * plant.noise_variance)
    from oed.named import named_plant

    return (
        named_plant(spec)
        if noise_variance is None
        else named_plant(spec).replace(noise_variance=noise_variance)
    )


def hair_dryer_record() -> Record:
    """The hair-dryer record (Feedback PT326), 1000 samples every 0.08 s.

    Returns
    -------
    Record
        Heater voltage to outlet air temperature, both in volts.
    """
    from oed.files import read_record

    return read_record(str(files("benchmarks") / "data" / "hair_dryer.csv"))


@lru_cache(maxsize=1)
def _hair_dryer() -> Plant:
    """The output-error model OE(2,2) with delay 3 of the first half of the record, with its noise variance."""
    from estimators.pem import identify

    fit = identify(hair_dryer_record()[:500], "oe", (2, 2), delay=3, offset=True)
    return fit.to_plant().replace(name=HAIR_DRYER)
