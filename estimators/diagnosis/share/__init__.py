"""How much of the linear model's residual could be explained at all, by which variables, and of what nature.

from estimators.diagnosis.share import explainable_share
share = explainable_share(base, [record])  # share, low, high, by, natures, noise_floor; base: a Baseline
"""

from estimators.diagnosis.share.explainable import Evidence, Share, explainable_share

__all__ = ["Evidence", "Share", "explainable_share"]
