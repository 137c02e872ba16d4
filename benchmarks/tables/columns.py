"""What the tables of a comparison show, column by column, and how a comparison was made."""

from __future__ import annotations

import shlex
from collections.abc import Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.campaign.settings import Settings
from benchmarks.campaign.store import versions
from oed.files.writing import write_whole

__all__ = ["BUDGET", "COLUMNS", "INFORMATION_COLUMNS", "command_line", "is_number", "made", "save_summary"]

BUDGET = {
    "channels": "channels",
    "samples": "samples",
    "experiments": "experiments",
    "energy": "energy",
    "energy_per_input": "per input",
    "peak_amplitude": "peak |u|",
}
COLUMNS = {
    "plant": "plant",
    "noise_variance": "noise",
    "method": "input",
    "estimator": "estimator",
    "known": "is told",
    **BUDGET,
    "rho": "rho",
    "rho_predicted": "predicted",
    "bias": "bias",
    "rmse": "RMSE",
    "c_efficiency": "eff. peak gain",
    "d_efficiency": "eff. D",
    "coverage": "coverage",
    "n": "runs",
    "n_failed": "failed",
    "failures": "how",
    "remark": "remark",
}
INFORMATION_COLUMNS = {
    "plant": "plant",
    "noise_variance": "noise",
    "method": "input",
    "known": "is told",
    **BUDGET,
    "c_efficiency": "peak gain",
    "d_efficiency": "D",
    "a_efficiency": "A",
    "e_efficiency": "E",
    "rho_predicted": "best rho",
}


def command_line(settings: Settings, replicates: int, out: Path) -> str:
    """The command that repeats a comparison."""
    words = ["oed", "compare"]
    for plant in settings.plants:
        words += ["--plant", plant]
    for variance in settings.noise_variances:
        words += ["--noise-variance", f"{variance:g}"]
    for limit in settings.limits:
        words += ["--limit", ",".join(f"{k}={v}" for k, v in asdict(limit).items() if k == "replicates" or v)]
    words += ["--samples", str(settings.samples), "--experiments", str(settings.experiments)]
    words += [
        "--replicates",
        str(replicates),
        "--methods",
        *settings.methods,
        "--estimators",
        *settings.estimators,
    ]
    words += ["--profile-replicates", str(settings.profile_replicates)]
    return shlex.join([*words, "--seed", str(settings.seed), "--out", str(out)])


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
