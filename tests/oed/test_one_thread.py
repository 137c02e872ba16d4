"""Verbs of small dense algebra run on one thread of the BLAS, and leave it as it was."""

from __future__ import annotations

import numpy as np
import pytest
from threadpoolctl import threadpool_info, threadpool_limits

from benchmarks.campaign.one_part import run_part
from benchmarks.comparison import compare
from estimators import diagnose
from estimators.pem import identify
from oed.covariances import on_one_thread
from oed.design import basis_design, masked_design, quantile_design, robust_design, solve_design
from oed.plants.named import named_plant


def threads():
    return {one["num_threads"] for one in threadpool_info() if one["user_api"] == "blas"}


class Watched:
    """A plant that notes how many threads the BLAS has while it is asked."""

    def __init__(self):
        self.seen = set()

    def response(self, omega):
        self.seen |= threads()
        return named_plant("reference").response(omega)


def test_a_design_limits_the_blas_and_gives_it_back():
    plant = Watched()
    with threadpool_limits(2, "blas"):
        before = threads()  # a library that is built for one thread stays at one
        assert 2 in before
        solve_design(plant, "D")
        assert plant.seen == {1}
        assert threads() == before


def test_it_is_given_back_after_an_error():
    @on_one_thread
    def fails():
        assert threads() == {1}
        raise ZeroDivisionError

    with threadpool_limits(2, "blas"):
        before = threads()
        with pytest.raises(ZeroDivisionError):
            fails()
        assert threads() == before


@pytest.mark.parametrize(
    "verb",
    [
        solve_design,
        masked_design,
        robust_design,
        quantile_design,
        basis_design,
        identify,
        diagnose,
        run_part,
        compare,
    ],
)
def test_every_verb_has_it(verb):
    assert verb.__wrapped__.__name__ == verb.__name__


def test_the_results_are_those_of_one_thread():
    with threadpool_limits(2, "blas"):
        two = solve_design(named_plant("reference"), "A")
    with threadpool_limits(1, "blas"):
        one = solve_design(named_plant("reference"), "A")
    np.testing.assert_array_equal(two.spectrum.power, one.spectrum.power)
