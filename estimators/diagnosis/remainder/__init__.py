"""What is still explainable and has neither name nor equation: a bounded fading-memory model, admitted by unused blocks.

from estimators.diagnosis.remainder import fit_remainder, linear_footing
rest = fit_remainder(base, [record], linear_footing(base, [record]))  # rest.admitted, rest.why, rest.unused
rest.simulate(test, base.simulate(test))                              # (N,) simulated output
"""

from estimators.diagnosis.remainder.footing import Footing, linear_footing, spliced
from estimators.diagnosis.remainder.mixture import Remainder
from estimators.diagnosis.remainder.stack import Limits, fit_remainder
from estimators.diagnosis.remainder.storage import from_json, to_json

__all__ = [
    "Footing",
    "Limits",
    "Remainder",
    "fit_remainder",
    "from_json",
    "linear_footing",
    "spliced",
    "to_json",
]
