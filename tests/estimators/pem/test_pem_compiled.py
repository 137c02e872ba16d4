"""The loops of the predictors are compiled once, for all structures and whatever is asked."""

import numpy as np

from estimators.pem import identify
from estimators.pem.predictors import filter_kernels, state_kernels
from oed.data import Record


def test_loops_are_compiled_for_one_kind_of_arguments() -> None:
    """For whatever is asked: numba compiles anew for arrays that cannot be written or lie otherwise, 4 to 7 s each time it did."""
    rng = np.random.default_rng(0)
    u, e = rng.normal(size=(2, 120, 2))
    one, two = Record(u, u[:, :1] + 0.1 * e[:, :1]), Record(u, u + 0.1 * e)
    for offset in (False, True):
        identify(one, "bj", (1, 1, 1, 1), 0, offset=offset, search="quick", max_iterations=1)
        identify([two, two], "oe", (1, 1), 0, offset=offset, search="quick", max_iterations=1)
        identify(one, "oe", (1, 1), 0, offset=offset, search="quick", robust="huber")
        identify([two, two], "ss", (2,), 0, offset=offset, max_iterations=1)
        identify(one, "ss", (1,), 0, offset=offset, robust="huber", max_iterations=1)
    for module in (filter_kernels, state_kernels):
        many = {
            name: len(f.signatures) for name, f in vars(module).items() if name in ("signals", "fold", "run")
        }
        assert set(many.values()) == {1}, many
