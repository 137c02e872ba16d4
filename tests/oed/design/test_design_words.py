"""A design in words: the first line says what to apply, what it saves and what is certified."""

import dataclasses

import numpy as np
import pytest

from oed import named_plant
from oed.criteria import c_criterion
from oed.design import solve_design
from oed.design.problem.criteria_by_name import NAMES
from oed.design.problem.words import ASKED, headline, question

PLANT = named_plant("reference")


def test_the_first_line_is_an_engineers():
    """On [0, pi] without a sampling time, in Hz with one; the share of white noise is that of the samples."""
    design = solve_design(PLANT, "D")
    times = 1 / design.efficiency_white
    said = f"; white noise of the same power needs {times:.3g} times as many samples for the same error; certified: no input within the limits does better"
    assert str(design).splitlines()[0] == (
        "to learn all parameters (D): apply 0.9373 rad/sample with 50 % and 1.053 rad/sample with 50 % of the power"
        + said
    )
    slow = solve_design(dataclasses.replace(PLANT, dt=0.01), "D")
    assert "apply 14.92 Hz with 50 % and 16.76 Hz with 50 % of the power" in headline(slow)


def test_what_is_not_samples_is_said_as_a_loss():
    """The condition number does not fall with the number of samples; one line stands alone."""
    assert "with white noise of the same power the loss is 5.41 times as large" in headline(
        solve_design(PLANT, "modified-E")
    )
    assert "apply 0.989 rad/sample alone; " in headline(solve_design(PLANT, "hinf"))


def test_a_limit_on_the_output_only_makes_no_comparison_with_white_noise():
    """White noise as strong as the input that the limit allows would break it."""
    assert "white noise of the same power does not keep the limits" in headline(
        solve_design(PLANT, "D", output_power=1.0, input_power=None)
    )


def test_many_lines_are_a_band():
    """Forty lines are not named one by one."""
    assert "apply half of the power between " in headline(solve_design(named_plant("order-20"), "D"))


def test_an_open_design_claims_no_more_than_its_gap():
    """Nothing is certified that is not; a grid's bound is of the grid."""
    design = solve_design(PLANT, "D", points=np.linspace(0, np.pi, 8), refine=False)
    assert "certified: no input of this grid does better" in headline(design)
    loose = dataclasses.replace(solve_design(PLANT, "D"), bound=0.9 * solve_design(PLANT, "D").loss)
    assert headline(loose).endswith("certified: an input within the limits may be up to 11 % better")


@pytest.mark.parametrize("name", NAMES)
def test_every_named_criterion_has_words(name):
    """By itself or with an argument."""
    key = name if name in ASKED else f"{name}:1"
    assert question(key).startswith("to learn the ") or question(key).startswith("to learn all ")


def test_an_own_criterion_keeps_its_name():
    """Nothing is known of it but that."""
    own = c_criterion(np.ones(4), name="stiffness")
    assert headline(solve_design(PLANT, own)).startswith("for stiffness: apply ")
