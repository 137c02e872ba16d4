"""A blind column recomputed with no access to a plant: `python recompute_blind.py FOLDER` reads records, prints decisions.

FOLDER holds one NAME.npz per trace: u, y (experiments, samples, channels), kinds, and the names of its generator's seed.
Estimators see the records alone; inputs are asked for again, and refused where they differ from what was applied.
"""

from __future__ import annotations

import json
import sys
from pathlib import Path

import numpy as np

from benchmarks.campaign.one_part import seed_for
from benchmarks.campaign.registry import ESTIMATORS, METHODS, Told, compatible
from estimators.rules.trace import Trace
from oed.data import Record
from oed.errors import Status
from oed.experiments import Usage, replayed


def decisions(file: Path, estimators: list[str]) -> dict[str, float]:
    """By estimator, the norm; and under "applied" the energy of the inputs that the method asks for."""
    kept = np.load(file)
    records = tuple(Record(u, y) for u, y in zip(kept["u"], kept["y"], strict=True))
    usage = Usage()
    for record in records:
        usage = usage.add(record.u)
    trace = Trace(records, tuple(kept["kinds"].tolist()), usage, Status.BUDGET, "")
    names = json.loads(str(kept["seed"]))
    method = names[2]
    again = METHODS[method].build()(
        replayed(records), samples=len(records[0]), iterations=len(records), rng=seed_for(*names)
    )
    blind = [e for e in estimators if ESTIMATORS[e].told is Told.NOTHING and compatible(method, e)]
    return {name: ESTIMATORS[name].estimate(trace).value for name in blind} | {"applied": again.usage.energy}


if __name__ == "__main__":
    wanted = sys.argv[2].split(",")
    print(
        json.dumps({file.stem: decisions(file, wanted) for file in sorted(Path(sys.argv[1]).glob("*.npz"))})
    )
