"""From experiments and records to numbers: the iterations, other estimators, identification, diagnosis.

The names below are imported when they are first used, so that `import estimators` is quick.
"""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from estimators.diagnosis.loop import diagnose
    from estimators.montecarlo.additivity import (
        additivity_by_monte_carlo,
        additivity_of_records,
        additivity_of_spectra,
    )
    from estimators.pem import identify
    from estimators.rules.power import power_iterations
    from estimators.rules.trace import Trace, run


_HOME = {
    "Trace": "estimators.rules.trace",
    "additivity_by_monte_carlo": "estimators.montecarlo.additivity",
    "additivity_of_records": "estimators.montecarlo.additivity",
    "additivity_of_spectra": "estimators.montecarlo.additivity",
    "diagnose": "estimators.diagnosis.loop",
    "identify": "estimators.pem",
    "power_iterations": "estimators.rules.power",
    "run": "estimators.rules.trace",
}

__all__ = [
    "Trace",
    "additivity_by_monte_carlo",
    "additivity_of_records",
    "additivity_of_spectra",
    "diagnose",
    "identify",
    "power_iterations",
    "run",
]


def __getattr__(name: str) -> Any:
    if name in _HOME:
        return getattr(import_module(_HOME[name]), name)
    raise AttributeError(f"module 'estimators' has no attribute {name!r}")


def __dir__() -> list[str]:
    return [*globals(), *_HOME]
