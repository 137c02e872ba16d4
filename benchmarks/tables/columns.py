"""What the tables of a comparison show, column by column, and how a comparison was made."""

import shlex
import tomllib
from collections.abc import Sequence
from dataclasses import asdict
from functools import partial
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.campaign.plants import load_plant
from benchmarks.campaign.registry import compatible, fits
from benchmarks.campaign.settings import Settings
from benchmarks.campaign.store import versions
from oed.files.writing import write_whole

SAID = tomllib.loads((Path(__file__).parent / "columns.toml").read_text(encoding="utf-8"))
TEXTS: dict[str, str] = SAID["texts"]


def headings(table: str) -> dict[str, str]:
    """Key -> heading of every column of a table, in their order; `columns.toml` has them."""
    own = SAID["tables"][table]
    said = SAID["headings"] | own.get("headings", {})
    return {key: said.get(key, key.replace("_", " ")) for key in own["columns"]}


def not_run_rows(settings: Settings, replicates: int) -> list[dict[str, Any]]:
    """What has no number although it was asked for, and why; of the plants of a family the first stands for all."""
    families = [p for p in settings.plants if not p.startswith("random-") or p.endswith("-1")]
    table = []
    for plant, method in product(families, settings.methods):
        if not fits(method, load_plant(plant)):
            row = {"plant": plant, "noise": "all", "method": method, "estimator": "all"}
            table.append(row | {"why": "made for one channel"})
            continue
        said: list[float] = []  # levels at which the input itself is left out
        for estimator in ("", *(e for e in settings.estimators if compatible(method, e))):
            count = partial(settings.replicates_of, replicates, plant, method, estimator)
            left = [v for v in settings.noise_variances if v not in said and count(v) == 0]
            if not left:
                continue
            said = said if estimator else left
            named = "all" if len(left) == len(settings.noise_variances) else ", ".join(f"{v:g}" for v in left)
            why = settings.why_not(plant, method, estimator, left[0]) or "left out by a limit of the campaign"
            row = {
                "plant": plant, "noise": named, "method": method, "estimator": estimator or "all", "why": why,
            }  # fmt: skip
            table.append(row)
    return table


def command_line(settings: Settings, replicates: int, out: Path) -> str:
    """The command that repeats a comparison."""
    words: list[Any] = ["oed", "compare"]
    for plant in settings.plants:
        words += ["--plant", plant]
    for variance in settings.noise_variances:
        words += ["--noise-variance", f"{variance:g}"]
    for limit in settings.limits:
        given = {k: v for k, v in asdict(limit).items() if k == "replicates" or (v and k != "why")}
        words += ["--limit", ",".join(f"{k}={v}" for k, v in given.items())]
    words += ["--samples", settings.samples, "--experiments", settings.experiments]
    words += [
        "--replicates", replicates, "--methods", *settings.methods, "--estimators", *settings.estimators,
    ]  # fmt: skip
    words += ["--profile-replicates", settings.profile_replicates, "--seed", settings.seed, "--out", out]
    return shlex.join(map(str, words))


def made(settings: Settings, replicates: int, out: Path) -> dict[str, str]:
    """How a comparison was made, for the end of its page."""
    values = {
        name: ", ".join(map(str, v)) if isinstance(v, tuple) else str(v)
        for name, v in asdict(settings).items()
    }
    return {
        "command": command_line(settings, replicates, out),
        **{name.replace("_", " "): value for name, value in values.items()},
        "replicates": str(replicates),
        **{f"version of {name}": value for name, value in versions().items()},
    }


def save_summary(folder: Path, sentences: Sequence[str], headline: str) -> None:
    """Keep the sentences and the headline table as Markdown."""
    write_whole(folder / "summary.md", "\n\n".join([headline, *sentences]) + "\n")


def is_number(value: Any) -> bool:
    """Whether a table entry is a finite number."""
    return isinstance(value, int | float) and bool(np.isfinite(value))
