"""Two models of one record, compared sample by sample: what the record can tell between them."""

import numpy as np

from estimators.diagnosis.model.fitting import Fit, innovations

CLOSE = 6.0  # of Schwarz's criterion: odds of twenty to one
LIMIT = 2.0  # standard errors


def paired_difference(f: Fit, g: Fit) -> tuple[float, float]:
    """By how much Schwarz's criterion of one model lies above another's, and the standard error of that.

    The deviances are sums of e^2/v + log v over the samples; their paired difference has a standard error of
    its own, from sums over blocks, as the differences are correlated (Vuong, Econometrica 57, 1989).
    """
    if len(f.residual) != len(g.residual) or not np.isfinite(f.criterion + g.criterion):
        return float("inf"), 0.0
    e, d = innovations(f.residual, f.noise), innovations(g.residual, g.noise)
    terms = d**2 / max(g.variance, 1e-300) - e**2 / max(f.variance, 1e-300)
    block = max(1, int(2 * len(terms) ** (1 / 3)))
    count = len(terms) // block
    sums = terms[: count * block].reshape(count, block).sum(axis=1)
    return g.criterion - f.criterion, float(np.std(sums) * np.sqrt(len(terms) / block))


def as_good(f: Fit, g: Fit, *, adequate: bool = True) -> bool:
    """Whether the record cannot tell that a model is worse than another."""
    difference, error = paired_difference(f, g)
    return difference < (CLOSE if adequate else max(CLOSE, LIMIT * error))
