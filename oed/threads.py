"""Small dense algebra on one thread: for matrices of some hundred columns the BLAS's threads cost more than they bring."""

from __future__ import annotations

from collections.abc import Callable
from functools import lru_cache, wraps
from typing import Any, ParamSpec, TypeVar

__all__ = ["on_one_thread"]

P, R = ParamSpec("P"), TypeVar("R")


@lru_cache(maxsize=1)
def _libraries() -> Any:
    """The BLAS of NumPy and that of SciPy, which has one of its own; looked for once."""
    import scipy.linalg  # noqa: F401  (loads its BLAS, which is found only then)
    from threadpoolctl import ThreadpoolController

    return ThreadpoolController()


def on_one_thread(function: Callable[P, R]) -> Callable[P, R]:
    """A function during which the BLAS does not wake its threads; as many as before once it has returned."""

    @wraps(function)
    def limited(*args: P.args, **kwargs: P.kwargs) -> R:
        with _libraries().limit(limits=1, user_api="blas"):
            return function(*args, **kwargs)

    return limited
