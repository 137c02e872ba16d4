"""Small dense algebra on one thread: waking the BLAS's others takes longer than the algebra does."""

from __future__ import annotations

from collections.abc import Callable
from functools import cache, wraps
from typing import Any, ParamSpec, TypeVar

__all__ = ["on_one_thread"]

P = ParamSpec("P")
T = TypeVar("T")


@cache
def _libraries() -> Any:
    """What threadpoolctl knows of the BLAS of NumPy and of SciPy, which are two; both are loaded by then."""
    import numpy.linalg  # noqa: F401
    import scipy.linalg  # noqa: F401
    from threadpoolctl import ThreadpoolController

    return ThreadpoolController().select(user_api="blas")


def on_one_thread(verb: Callable[P, T]) -> Callable[P, T]:
    """The same function with the BLAS limited to one thread while it runs, and as it was afterwards."""

    @wraps(verb)
    def limited(*args: P.args, **kwargs: P.kwargs) -> T:
        with _libraries().limit(limits=1):
            return verb(*args, **kwargs)

    return limited
