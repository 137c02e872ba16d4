"""Work on several processes, its results in the order of the work."""

from __future__ import annotations

import warnings
from collections.abc import Callable, Iterable
from typing import Any

__all__ = ["at_once", "spread"]


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

    with warnings.catch_warnings(), parallel_config(backend="loky", inner_max_num_threads=1, n_jobs=jobs):
        # A worker that has come to hold much more than after its first task, as by its imports, is replaced and says so.
        warnings.filterwarnings("ignore", "A worker stopped while some jobs were given")
        return list(Parallel()(delayed(function)(item) for item in items))


def at_once(tasks: Iterable[Callable[[], Any]], jobs: int = 1) -> list[Any]:
    """What every task returns, in their order.

    Parameters
    ----------
    tasks : iterable of callable
        Without arguments, such as a `functools.partial` of a module's function.
    jobs : int
        Processes; BLAS has one thread in each.

    Returns
    -------
    list
        One entry per task.
    """
    return spread(_call, tasks, jobs)


def _call(task: Callable[[], Any]) -> Any:
    return task()
