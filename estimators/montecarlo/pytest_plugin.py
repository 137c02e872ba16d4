"""The pytest plugin that the package registers: the fixture `information_adds_up` for a user's own plant and method."""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING, Any

import pytest

if TYPE_CHECKING:
    from estimators.montecarlo.additivity import Additivity


@pytest.fixture
def information_adds_up() -> Callable[..., Additivity]:
    """An assertion: `information_adds_up(plant, method, resolution=0.1)`, with the options of
    `additivity_by_monte_carlo`. It fails the test with what was tested and what broke, and returns the result
    where nothing did."""

    def check(plant: Any, method: Any, **options: Any) -> Additivity:
        from estimators.montecarlo.additivity import additivity_by_monte_carlo

        __tracebackhide__ = True
        result = additivity_by_monte_carlo(plant, method, **options)
        if not result:
            pytest.fail(
                f"[S] Lemma 13 does not hold of {plant.name} under this method.\n{result!r}", pytrace=False
            )
        return result

    return check
