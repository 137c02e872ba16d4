"""Discovery without a catalogue: an equation for what the linear model lacks, in the user's units.

from estimators.diagnosis.discovery import discover
found = discover([record], baseline)      # Discovery: found, equation, nature, terms, unused, rmse_unused
found.model.simulate(other, 20)           # (N, ny)
"""

from estimators.diagnosis.discovery.answer import BUDGETS, Discovery, discover
from estimators.diagnosis.discovery.found import Curve, FoundTerm
from estimators.diagnosis.discovery.model import DiscoveredModel
from estimators.diagnosis.discovery.search import Budget

__all__ = ["BUDGETS", "Budget", "Curve", "DiscoveredModel", "Discovery", "FoundTerm", "discover"]
