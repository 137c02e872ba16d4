"""Linear candidates are compared with what the record cannot show charged: poles slower than a block, answers that hang on one."""

from dataclasses import replace

import numpy as np
import pytest

from estimators.diagnosis.baseline import blocks_of
from estimators.diagnosis.baseline.choice import Candidate, Trial, cheapest, simplest, tried, undetermined
from estimators.diagnosis.baseline.linear_model import LinearModel, Prior
from estimators.diagnosis.baseline.output_error import OutputError
from estimators.diagnosis.baseline.regression import Arx, fitted_to_all, lagged
from oed.data import Record


def test_models_that_differ_without_a_block_must_be_better_by_what_a_simpler_may_cost():
    """A resonance at half the sampling rate that the input hardly reaches, against the same model without it."""
    rng = np.random.default_rng(3)
    ringing = [
        LinearModel(np.convolve([1.0, -0.8], [1.0, 0.97]), b * np.ones((1, 2))) for b in (0.19, 0.2, 0.21)
    ]
    settled = [LinearModel(np.array([1.0, -0.8]), b * np.ones((1, 1))) for b in (0.1995, 0.2, 0.2005)]
    record = Record(rng.standard_normal(300), rng.standard_normal(300))
    spread = [undetermined(models, [record]) for models in (ringing, settled)]
    assert spread[0] > 20 * spread[1] > 0
    form = Arx(1, 1, (0,), False)
    trials = [
        Trial(
            Candidate("OE", "", size, [], form),
            [],
            square * np.ones(20),
            False,
            False,
            lambda _, each=each: (each, 0.0),
        )
        for size, square, each in ((4, 1e-3, spread[0]), (5, 1.02e-3, 0.0))
    ]
    assert simplest(trials).candidate.size == 5
    assert simplest([replace(t, doubts=lambda _: (0.0, 0.0)) for t in trials]).candidate.size == 4


@pytest.mark.parametrize(("size", "taken"), [(6, True), (14, False)])
def test_a_model_of_a_quarter_of_the_parameters_may_cost_twice_as_much(size: int, taken: bool) -> None:
    """A boat: 27 parameters were 4 % better than 6 on unused blocks, well within the error, and 45 % worse on the rest of the day."""
    form, rng = Arx(1, 1, (0,), False), np.random.default_rng(0)
    trial = lambda size, squares: Trial(Candidate("OE", "", size, [], form), [], squares, False, False)
    squares = rng.uniform(0.2, 1.8, 20)
    other = squares * (1.0 + rng.uniform(-0.7, 0.7, 20))
    many, few = trial(27, squares / squares.mean()), trial(size, 1.035**2 * other / other.mean())
    assert (simplest([many, few]) is few) is taken


def test_a_pole_that_outlives_the_record_must_gain_twice_what_a_slow_one_must():
    """Gyroscopes to a tilt: a pole at 1.00000 was 1.5 times better on unused blocks and twice as bad on the test record."""
    form = Arx(1, 1, (0,), False)
    trial = lambda size, error, *slow: Trial(
        Candidate("OE", "", size, [], form), [], error**2 * np.ones(20), *slow
    )
    quick, slow, endless = trial(2, 1.0, False, False), (True, False), (True, True)
    for error, kind, taken in (
        (0.68, slow, True),
        (0.68, endless, False),
        (0.48, endless, True),
        (0.75, slow, False),
    ):
        assert (simplest([quick, trial(4, error, *kind)]).candidate.size == 4) is taken
    record = Record(np.ones(500), np.ones(500))
    for radius, kind in ((0.98, (False, False)), (0.995, slow), (0.999, endless)):
        models = [LinearModel(np.array([1.0, -radius]), np.full((1, 1), 1.0 - radius))] * 6
        found = tried(
            Candidate("OE", "", 2, models, form),
            [record],
            0,
            blocks_of([record], 5, 20, 0),
            Prior(1.0, 0.5 ** np.arange(8), 1.0),
        )
        assert found is not None
        assert (found.slow, found.endless) == kind


def test_charges_are_worked_out_only_where_what_is_shown_leaves_a_trial_a_chance():
    """The cheapest of fifty trials is that of all charges worked out, and most are not."""
    rng, asked = np.random.default_rng(1), []
    form = Arx(1, 1, (0,), False)

    def doubts(trial: Trial) -> tuple[float, float]:
        asked.append(trial)
        return 0.0, 0.3 * trial.candidate.size

    trials = [
        Trial(Candidate("OE", "", size, [], form), [], square * np.ones(8), False, False, doubts)
        for size, square in zip(rng.integers(1, 6, 50), rng.uniform(0.5, 20.0, 50), strict=True)
    ]
    first = cheapest(trials)
    assert len(asked) < 15
    assert first is min(trials, key=lambda t: float(t.charged.mean()))


@pytest.mark.parametrize("rest", [False, True])
def test_the_compiled_derivatives_are_those_of_differences(rest: bool) -> None:
    """Two inputs of different delays, an offset, a state before the record: the gradient of the loss against central differences."""
    rng = np.random.default_rng(0)
    record = Record(rng.standard_normal((60, 2)) + 1.0, rng.standard_normal(60))
    prior = Prior(0.3, np.exp(-np.arange(9) / 5.0), 0.1, rest)
    problem = OutputError([record], 0, Arx(2, 3, (1, 2), not rest), prior)
    theta = np.concatenate(([-1.2, 0.5], rng.standard_normal(6), [] if rest else [0.4, 0.2, -0.7]))
    rows = [np.arange(60) % 7 > 0]
    errors = lambda q: (record.y[:, 0] - _run(problem, q))[rows[0]]
    J = np.stack([(errors(theta + d) - errors(theta - d)) / 2e-6 for d in 1e-6 * np.eye(len(theta))], axis=1)
    loss, gradient, hessian = problem.local(theta, rows)
    assert loss == pytest.approx(np.mean(errors(theta) ** 2), rel=1e-12)
    size = problem.form.size  # beyond it the prior of the state is in both
    np.testing.assert_allclose(gradient[:size], -(J.T @ errors(theta))[:size], rtol=1e-6)
    np.testing.assert_allclose(hessian[:size], (J.T @ J)[:size], rtol=1e-6, atol=1e-6)


def _run(problem: OutputError, theta: np.ndarray) -> np.ndarray:
    """The run by the equation itself, the inputs before the record at their first values, or 0 at rest."""
    f, u = problem.form, problem.records[0].u
    a, b = theta[: f.na], theta[f.na : f.na + 2 * f.nb].reshape(2, f.nb)
    past = list(np.zeros(f.na) if problem.prior.rest else theta[f.size : f.size + f.na])
    out = []
    for k in range(len(u)):
        y = theta[f.size - 1] if f.offset else 0.0
        for j, delay in enumerate(f.delay):
            for i in range(f.nb):
                at = k - delay - i
                y += b[j, i] * (u[at, j] if at >= 0 else 0.0 if problem.prior.rest else u[0, j])
        y -= a @ past
        past = [y, *past[:-1]]
        out.append(y)
    return np.array(out)


def test_least_squares_on_all_samples_are_those_of_the_blocks_factors():
    """With missing samples, two inputs and an offset."""
    rng = np.random.default_rng(2)
    y = rng.standard_normal(300)
    y[[40, 41, 200]] = np.nan
    record = Record(rng.standard_normal((300, 2)), y)
    form = Arx(3, 2, (1, 4), True)
    known = lagged([record], 0, blocks_of([record], 5, 20, 30), form, False).fit(form)
    fitted = fitted_to_all([record], 0, form, False)
    np.testing.assert_allclose(fitted.den, known.den, rtol=1e-9)
    np.testing.assert_allclose(fitted.num, known.num, rtol=1e-9, atol=1e-12)
    assert fitted.constant == pytest.approx(known.constant, rel=1e-9)
