"""From experiments and records to numbers: the iterations, other estimators, identification, diagnosis.

The names below are imported when they are first used, so that `import estimators` is quick.
"""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from estimators.checks import additivity_by_monte_carlo, additivity_of_records, additivity_of_spectra
    from estimators.diagnosis.loop import diagnose
    from estimators.pem import identify
    from estimators.power import power_iterations
    from estimators.trace import Trace, run


_HOME = {
    "Trace": "estimators.trace",
    "additivity_by_monte_carlo": "estimators.checks",
    "additivity_of_records": "estimators.checks",
    "additivity_of_spectra": "estimators.checks",
    "diagnose": "estimators.diagnosis.loop",
    "identify": "estimators.pem",
    "power_iterations": "estimators.power",
    "run": "estimators.trace",
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
