"""The same function on many things, on several processes."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from typing import Any

__all__ = ["spread"]


def spread(function: Callable[[Any], Any], items: Iterable[Any], jobs: int = 1) -> list[Any]:
    """What the function returns for every item, in their order, whoever does the work.

    Parameters
    ----------
    function : callable
        Of a module, so that other processes find it.
    items : iterable
        Its arguments.
    jobs : int
        Processes; BLAS has one thread in each.

    Returns
    -------
    list
        One entry per item.
    """
    if jobs <= 1:
        return [function(item) for item in items]
    from joblib import Parallel, delayed, parallel_config

    with parallel_config(backend="loky", inner_max_num_threads=1, n_jobs=jobs):
        return list(Parallel()(delayed(function)(item) for item in items))
