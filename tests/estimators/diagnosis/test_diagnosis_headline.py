"""The first line of a diagnosis: an effect in words with its parameters; no test's figures, no page of terms."""

from types import SimpleNamespace as Made

import numpy as np
import pytest

from estimators.diagnosis.effects import CATALOGUE
from estimators.diagnosis.ladder.asked import outside
from estimators.diagnosis.ladder.first_line import UNKNOWN, _instead, equations, headline
from estimators.diagnosis.ladder.steps import Kind, Step
from estimators.diagnosis.ladder.verdicts import Finding
from estimators.diagnosis.policy import Policy
from oed.data import Record

RECORD = Record(np.zeros(9), np.zeros(9), dt=0.1, input_units=("N",), output_units=("mm",))
EFFECTS = {e.key: e for e in CATALOGUE}
EVIDENCE = "the error on unused blocks is 81 % less with it, corrected p = 3e-153"
TERMS = Step(Kind.DISCOVERED, ("0.5 * y^3", "0.1 * y^2"), (), None, sentences=("a spring", "a spring"), equation="force on y = 0.5 * y^3 + 0.1 * y^2")  # fmt: skip


def outcome(key: str, chosen: Step, parameters: dict, index: int = 0) -> Made:
    """What the first line reads of an outcome: a claim, the answer and the named model beside it."""
    named = Step(Kind.NAMED, (key,), (), None, parameters=parameters)
    chain = Made(chain=(chosen,))
    ladder = Made(chosen=named if chosen is named else chain, rungs=(Made(step=named), Made(step=chosen)))
    terms = (Made(text="0.5 * y^3", same_as="duffing"), Made(text="0.1 * y^2", same_as="pendulum"))
    return Made(index=index, ladder=ladder, named=Made(claims=(Made(key=key),)), discovery=Made(terms=terms))


@pytest.mark.parametrize("bears", [True, False])
def test_a_claim_that_the_answer_has_as_terms_is_said_with_its_parameter(bears):
    o = outcome(
        "stiffness_cubic",
        TERMS,
        {"stiffness_cubic.k3": (0.154, 0.002, "1/u^2"), "stiffness_cubic.f1": (1.0, 0.1, "1")},
    )
    top = Finding(
        "stiffness_cubic",
        "duffing",
        "dynamic",
        0.6,
        3e-153,
        f"{EFFECTS['stiffness_cubic'].sentence}: {EVIDENCE}",
    )
    said = headline(top, [o], EFFECTS, RECORD, bears)
    assert (
        said
        == f"duffing ({EFFECTS['stiffness_cubic'].sentence}): cubic coefficient k3 0.1540 +- 0.0020 1/N^2"
    )


def test_a_claim_of_coefficients_says_what_and_where():
    o = outcome("cross", TERMS, {"cross.b1": (1.0, 0.1, "y/u")}, index=1)
    top = Finding(
        "cross", "mimo_cross", "linear", 0.6, 0.0, f"{EFFECTS['cross'].sentence} on output 2: {EVIDENCE}"
    )
    other = Made(
        index=0, ladder=Made(chosen=Made(chain=()), rungs=()), named=Made(claims=()), discovery=Made(terms=())
    )
    said = headline(top, [other, o], EFFECTS, RECORD, True)
    assert said == f"mimo cross ({EFFECTS['cross'].sentence}) on output 2"


def test_terms_are_the_heaviest_one_and_how_many_more():
    """Those of one model stand once, and not at all where the record does not bear them."""
    two = [outcome("", TERMS, {}, k) for k in range(2)]
    top = Finding("", UNKNOWN, "dynamic", 0.6, 0.0, "")
    assert (
        headline(top, two[:1], EFFECTS, RECORD, True)
        == "an effect without a name (dynamic): a spring, 0.5 * y^3, and 1 more term"
    )
    assert headline(top, two[:1], EFFECTS, RECORD, False) == "an effect without a name (dynamic)"
    assert equations(two) == [TERMS.equation]


def test_the_term_is_one_of_the_cause_that_is_named() -> None:
    """Of a two-link arm "coriolis coupling" had stood before "friction that saturates with speed", a lighter term of the first output."""
    top = Finding("", "pendulum", "dynamic", 0.6, 0.0, "")
    assert headline(top, [outcome("", TERMS, {})], EFFECTS, RECORD, True) == (
        "pendulum: a spring, 0.1 * y^2, and 1 more term"
    )


def test_what_leaves_the_range_says_by_how_much():
    ramp = np.linspace(0.0, 1.0, 50)
    train, test = (Record(x, x, input_units=("V",)) for x in (ramp, 0.99 + 0.02 * ramp))
    assert any("(0 to 1 V), by up to 0.01 V" in words for words in outside([train], test, Policy()))


def test_where_linear_dynamics_do_as_well_the_first_line_says_what_the_answer_has() -> None:
    """A diode between two filters was "one more order" alone, over a model that had a curve of the sensor."""
    effects = {e.key: e for e in CATALOGUE}
    step = Made(kind=Kind.NAMED, adds=("output_tanh",))
    outcome = Made(ladder=Made(chosen=Made(chain=(step,))))
    assert _instead([outcome], "order_one", effects) == (
        " or output nonlinearity (the sensor reads tanh(c y)/c), as the answer has it"
    )
    assert _instead([outcome], "output_tanh", effects) == ""
