"""The best linear model by blocked cross-validation of its simulation error: what a diagnosis starts from.

from estimators.diagnosis.baseline import best_linear
base = best_linear([record])          # Baseline: outputs, blocks, y_model, unused, rmse_unused, simulate(record, window)
"""

from estimators.diagnosis.baseline.baseline import Baseline, Options, OutputModel, of_output
from estimators.diagnosis.baseline.best import best_linear
from estimators.diagnosis.baseline.blocks import Block, Blocks, blocks_of

__all__ = ["Baseline", "Block", "Blocks", "Options", "OutputModel", "best_linear", "blocks_of", "of_output"]
