"""Residual tests: what a model has left in its residuals, and their algebra; models compared on fresh data."""

from typing import TYPE_CHECKING

from oed.lazily import exporting

if TYPE_CHECKING:
    from estimators.residual.comparison import Comparison, compare_models
    from estimators.residual.tests import ResidualTest, feedback, input_correlation, residual_tests, whiteness

__all__ = [
    "Comparison", "ResidualTest", "compare_models", "feedback", "input_correlation", "residual_tests",
    "whiteness",
]  # fmt: skip

__getattr__, __dir__ = exporting(__name__)
