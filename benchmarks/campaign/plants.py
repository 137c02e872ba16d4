"""Plants by name or file, as the command line takes them, among them the one identified from the hair dryer."""

import argparse
import json
import re
from collections.abc import Sequence
from functools import lru_cache
from hashlib import blake2b
from importlib.resources import files
from pathlib import Path

import numpy as np

from oed.data import Record
from oed.errors import InputError, check_names
from oed.files.limits import file_content
from oed.plants.families import FAMILIES
from oed.plants.plant import Plant

HAIR_DRYER = "hair-dryer"
RANDOM = re.compile(r"random-(fir|light|competing|late|many)-(\d{1,6})")
SEVERAL = re.compile(r"(random-[a-z]+-)(\d{1,6})\.\.(\d{1,6})")
RANDOM_SEED = 2018
RECORDS = (".csv", ".txt", ".tsv", ".mat", ".npz", ".parquet", ".gz")


def plant_names() -> tuple[str, ...]:
    """Names of all plants that the suite knows."""
    from oed.plants.named import NAMES

    return (*NAMES, HAIR_DRYER)


def is_file(spec: str) -> bool:
    """Whether a plant is given as a file."""
    return spec.endswith(".json") or "/" in spec or Path(spec).is_file()


def check_plants(specs: Sequence[str]) -> None:
    """Raise InputError if a plant is neither a file nor known by name."""
    for spec in specs:
        if Path(spec).is_dir() and spec not in plant_names():
            raise InputError(
                f"{spec} is a folder; a model's file in it is the plant: {Path(spec) / 'model.json'}."
            )
    named = [spec for spec in specs if not is_file(spec) and not RANDOM.fullmatch(spec)]
    check_names(named, (*plant_names(), "random-fir-1", *(f"random-{name}-1" for name in FAMILIES)), "plant")


def content_of(spec: str) -> str:
    """Digest of a plant's file; "" for a plant by name, which the digest of our source binds."""
    if not is_file(spec):
        return ""
    try:
        return blake2b(file_content(Path(spec)), digest_size=8).hexdigest()
    except OSError as error:
        raise InputError(f"cannot read the plant file {spec}: {error.strerror}.") from None


def add_plant_arguments(parser: argparse.ArgumentParser) -> None:
    """Add `--plant` and `--noise-variance`."""
    add = parser.add_argument
    # fmt: off
    add("--plant", required=True, metavar="NAME|FILE.json", help="a named plant or a JSON file")
    add("--noise-variance", type=float, metavar="V", help="noise variance on every output (for hair-dryer: in multiples of the identified one)")
    # fmt: on


def load_plant(spec: str, noise_variance: float | None = None) -> Plant:
    """Plant by name or from a JSON file."""
    check_plants([spec])
    if is_file(spec):
        if Path(spec).suffix in RECORDS:
            raise InputError(
                f"{spec} is a record by its suffix, not a plant; identify a model of it first: oed identify {spec} --out DIR, then "
                "--plant DIR/model.json."
            )
        from oed.plants.json import plant_from_json

        try:
            return plant_from_json(spec, noise_variance=noise_variance)
        except InputError as error:
            if not _diagnosed(spec):
                raise error from None
            raise InputError(
                f"{spec} is the model of a diagnosis, whose effects no plant holds; take a linear model of the same record: "
                "oed identify RECORD --out DIR, then --plant DIR/model.json."
            ) from None
    numbered = RANDOM.fullmatch(spec)
    if numbered:
        return _random(spec, numbered[1], int(numbered[2]), noise_variance)
    if spec == HAIR_DRYER:
        plant = _hair_dryer()
        if noise_variance is None:
            return plant
        if not noise_variance >= 0:
            raise InputError(
                f"the noise variance is {noise_variance:g}; it must be at least 0: check its sign."
            )
        return plant.replace(noise_variance=noise_variance * plant.noise_variance)
    from oed.plants.named import named_plant

    plant = named_plant(spec)
    return plant if noise_variance is None else plant.replace(noise_variance=noise_variance)


def _diagnosed(spec: str) -> bool:
    """Whether a file is the model that `oed diagnose --out` wrote."""
    try:
        return "answers" in json.loads(file_content(Path(spec)))
    except (OSError, ValueError, TypeError, RecursionError):
        return False


def _random(spec: str, family: str, number: int, noise_variance: float | None) -> Plant:
    """A random plant; the number is its seed. Of the head-to-head protocol (fir): length 10, decay 0.75;
    experiments of 50 samples with input norm 1 and noise of standard deviation 0.1 are, in unit input power,
    noise of variance 0.5, the default there."""
    from oed.plants.families import random_plant
    from oed.plants.named import random_fir

    variance = noise_variance if noise_variance is not None else 0.5 if family == "fir" else 1.0
    if family == "fir":
        plant = random_fir(np.random.default_rng([RANDOM_SEED, number]), noise_variance=variance)
    else:
        plant = random_plant(family, np.random.default_rng([RANDOM_SEED, number, *family.encode()]), variance)
    return plant.replace(name=spec)


def family_of(spec: str) -> str:
    """The family of a random plant, as tables name it; empty for any other plant."""
    found = RANDOM.fullmatch(spec)
    return f"random-{found[1]}" if found else ""


def expanded(specs: Sequence[str]) -> tuple[str, ...]:
    """Plants with `random-light-1..40` written out."""
    found: list[str] = []
    for spec in specs:
        many = SEVERAL.fullmatch(spec)
        found += [f"{many[1]}{k}" for k in range(int(many[2]), int(many[3]) + 1)] if many else [spec]
    return tuple(found)


def hair_dryer_record() -> Record:
    """The hair-dryer record (Feedback PT326), 1000 samples every 0.08 s."""
    from oed.files import read_record

    return read_record(str(files("benchmarks") / "data" / "hair_dryer.csv"))


@lru_cache(maxsize=1)
def _hair_dryer() -> Plant:
    """The output-error model OE(2,2) with delay 3 of the first half of the record, with its noise variance."""
    from estimators.pem import identify

    fit = identify(hair_dryer_record()[:500], "oe", (2, 2), delay=3, offset=True, initial="zero")
    return fit.to_plant().replace(name=HAIR_DRYER)
