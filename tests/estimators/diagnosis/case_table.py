"""Every family of the case generator on two random plants: detected, named first, removed; as a table.

`python -m tests.estimators.diagnosis.case_table SEED` prints it, row by row.
"""

from __future__ import annotations

import json
import sys
import tempfile
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from estimators.diagnosis.cases import diagnose_files
from estimators.diagnosis.loop import diagnose
from estimators.diagnosis.policy import Setting
from estimators.diagnosis.record.measurement import held_samples
from tests.estimators.diagnosis.case_beyond import BEYOND, draw_beyond
from tests.estimators.diagnosis.case_generator import FAMILIES, write_case

__all__ = ["NAMES", "Row", "measured", "table"]

PLANTS = 2
NAMES = (*FAMILIES, *BEYOND)
SAME = {"stribeck_friction": ("stribeck_friction", "coulomb_friction")}  # as the practice scorer accepts


@dataclass(frozen=True)
class Row:
    """One case: what was drawn and what was answered; `removed` is NaN where no reference is known."""

    family: str
    plant: str
    detected: bool
    first: str
    right: bool
    removed: float


def _case(family: str, seed: int, which: int, folder: Path) -> Row:
    for attempt in range(200):
        rng = np.random.default_rng([seed, NAMES.index(family), which, attempt])
        if write_case(folder, "case", (family,), rng):
            break
    else:
        raise RuntimeError(f"no case of {family} was drawn in 200 attempts")
    case = folder / "public" / "B" / "case"
    truth = json.loads((folder / "truth" / "B" / "case.json").read_text())
    result, _ = diagnose_files(case / "train.csv", case / "test.csv", meta=case / "meta.json")
    clean = np.loadtxt(folder / "truth" / "B" / "case_clean.csv", delimiter=",", skiprows=1, ndmin=2)
    ny = result.yhat_after.shape[1]
    y = np.loadtxt(case / "test.csv", delimiter=",", skiprows=1)[:, -ny:]
    target = clean[:, :ny] if truth["metric"] == "clean_sim_rmse" else y
    counts = np.stack(
        [~held_samples(y[:, i]) if family == "dropouts" else np.ones(len(y), bool) for i in range(ny)], axis=1
    )

    def error(simulated: np.ndarray) -> float:
        return float(np.sqrt(np.mean((target - simulated)[counts] ** 2)))

    after, before, ideal = error(result.yhat_after), error(clean[:, 2 * ny :]), error(clean[:, ny : 2 * ny])
    if (
        truth["metric"] != "sim_rmse"
    ):  # one-step errors, and the error of a clean output, have no oracle in the table
        before, ideal = truth["criterion_before"], truth["criterion_ideal"]
    if truth["metric"] == "pred_rmse":
        after = result.pred_rmse_after.value
    kinds = ", ".join(part.split("'")[1] for part in truth["plant"].split("'kind':")[1:])
    right = result.effect in SAME.get(family, (family,))
    return Row(family, kinds, result.detected, result.effect, right, (before - after) / (before - ideal))


def _beyond(key: str, seed: int) -> Row:
    train, test, order = draw_beyond(key, seed)
    result = diagnose(train, test, Setting(orders=(order,), structure="SISO"))
    right = result.effect == BEYOND[key].cause and result.nature == BEYOND[key].nature
    return Row(key, f"order {order}", result.detected, result.effect, right, result.room.value)


def measured(family: str, seed: int) -> list[Row]:
    """The rows of one family; effects beyond the generator's by their own floor, as no reference is known."""
    if family in BEYOND:
        return [_beyond(family, seed + which) for which in range(PLANTS)]
    rows = []
    for which in range(PLANTS):
        with tempfile.TemporaryDirectory() as folder:
            rows.append(_case(family, seed, which, Path(folder)))
    return rows


def table(rows: list[Row]) -> str:
    """The rows in Markdown."""
    lines = ["| effect | plant | detected | named first | removed |", "|---|---|---|---|---|"]
    for r in rows:
        named = "yes" if r.right else r.first
        lines.append(
            f"| {r.family} | {r.plant} | {'yes' if r.detected else 'no'} | {named} | {100 * r.removed:.0f} % |"
        )
    return "\n".join(lines)


if __name__ == "__main__":
    found: list[Row] = []
    print(table(found))
    for name in NAMES:
        rows = measured(name, int(sys.argv[1]))
        found += rows
        print("\n".join(table(rows).splitlines()[2:]), flush=True)
    print(f"detected {sum(r.detected for r in found)}, named first {sum(r.right for r in found)} of {len(found)}, "
          f"median removed {np.nanmedian([r.removed for r in found]):.3f}")  # fmt: skip
