"""From experiments and records to numbers: the iterations, other estimators, identification, diagnosis.

The names below are imported when they are first used, so that `import estimators` is quick.
"""

from typing import TYPE_CHECKING

from oed.lazily import exporting

if TYPE_CHECKING:
    from estimators.diagnosis.loop import diagnose
    from estimators.montecarlo.additivity import additivity_by_monte_carlo
    from estimators.pem import identify
    from estimators.rules.power import power_iterations
    from estimators.rules.trace import Trace, run

__all__ = ["Trace", "additivity_by_monte_carlo", "diagnose", "identify", "power_iterations", "run"]

__getattr__, __dir__ = exporting(__name__)
