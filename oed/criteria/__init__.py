"""Criteria of optimal design: what an information matrix is worth. Numpy only; one file each.

Every criterion is a loss of V' M^-1 V, where M (n, n) is the Fisher information and V (n, s) says which combinations
of the parameters matter, and has the lower bound, valid for every X (n, s), also where M is singular (Cauchy-Schwarz):

    loss(M) >= numerator(X) / trace(X' M X),

so that one number, the largest trace(X' M X) over all admissible spectra, bounds the loss of all of them. A new one
is a file here with a subclass of `Criterion`; with `named` it is known by that name everywhere.
"""

import importlib
import pkgutil

from oed.criteria.condition import condition_criterion
from oed.criteria.criterion import Criterion
from oed.criteria.determinant import d_criterion
from oed.criteria.eigenvalue import e_criterion
from oed.criteria.trace import a_criterion, c_criterion
from oed.criteria.worst import g_criterion, worst_d_criterion

__all__ = [
    "NAMED", "Criterion", "a_criterion", "c_criterion", "condition_criterion", "d_criterion", "e_criterion",
    "g_criterion", "worst_d_criterion",
]  # fmt: skip

for _info in pkgutil.iter_modules(__path__):
    importlib.import_module(f"{__name__}.{_info.name}")
NAMED: dict[str, type[Criterion]] = {one.named: one for one in Criterion.__subclasses__() if one.named}
"""The criteria of all parameters, by name."""
