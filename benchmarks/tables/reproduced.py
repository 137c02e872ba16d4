"""The rows of `oed reproduce`: what was published, what comes out here, and whether that agrees."""

import pkgutil
from importlib import import_module
from typing import Any

from estimators.stages import stage
from oed.errors import check_names

KEYS = ("name", "source", "published", "computed", "tolerance", "why", "holds", "kind")
KINDS = {
    "in print": "a figure that stands in print",
    "statement": "a statement in print that could have failed",
    "two ways": "recomputed two ways, by programs that share no formula",
    "illustration": "an illustration, which proves nothing and is not judged",
}
"""What stands behind `published`; only the first three can fail, and only they are counted."""


def row(
    name: str, source: str, published: float | str | None, computed: float | str, tolerance: float | None, why: str,
    holds: bool | None = None, kind: str = "two ways",
) -> dict[str, Any]:  # fmt: skip
    """One published statement and what comes out here."""
    kind = "illustration" if published is None else kind
    check_names([kind], tuple(KINDS), "kind of row")
    if kind == "illustration":
        holds = None
    elif holds is None and isinstance(published, int | float) and tolerance is not None:
        holds = bool(abs(float(computed) - published) <= tolerance)
    return dict(zip(KEYS, (name, source, published, computed, tolerance, why, holds, kind), strict=True))


def traced(rule: Any, plant: Any, samples: int, experiments: int, rng: Any = 0) -> Any:
    """What a rule measures on a simulated plant; `rng` a generator or its seed."""
    import numpy as np

    from estimators.rules.trace import run
    from oed.experiments import simulated

    rng = np.random.default_rng(rng)
    return run(
        rule, simulated(plant, expected=experiments), samples=samples, experiments=experiments, rng=rng
    )


def modules() -> dict[str, str]:
    """Name -> module of everything that can be reproduced."""
    import benchmarks.reproductions as home

    found = sorted(info.name for info in pkgutil.iter_modules(home.__path__))
    return {name.replace("_", "-"): f"{home.__name__}.{name}" for name in found}


def rows_of(name: str | None = None) -> list[dict[str, Any]]:
    """Reproduce one published item, or all."""
    known = modules()
    if name is not None:
        check_names([name], tuple(known), "reproduction")
    rows = []
    chosen = [name] if name else list(known)
    for k, each in enumerate(chosen):
        stage("published items", k, len(chosen))
        rows += import_module(known[each]).rows()
    return rows
