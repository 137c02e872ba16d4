"""How discovery searches: terms that explain nothing alone, chains that grow, stores that no window shows, what a record bears."""

from __future__ import annotations

import json
from dataclasses import asdict, replace

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.signal import lfilter

from estimators.diagnosis.baseline import Options, best_linear
from estimators.diagnosis.discovery import DiscoveredModel, answer, discover, search
from estimators.diagnosis.discovery.answer import BUDGETS
from estimators.diagnosis.discovery.dictionary import Kind
from estimators.diagnosis.discovery.form import FREE, LAST, Assembly, Factor, Form, Term
from estimators.diagnosis.discovery.starts import drive, linear_fit, pieces_of, scales_of
from estimators.diagnosis.discovery.wording import BETWEEN, CARRIED, DEGREE, sum_of_rates
from oed.data import Record
from tests.estimators.diagnosis.case_small import of_orders


def steps(rng: np.random.Generator, n: int, low: float, high: float) -> NDArray:
    """Levels that last from 10 to 60 samples."""
    return np.concatenate([np.full(rng.integers(10, 60), x) for x in rng.uniform(low, high, n // 10)])[:n]


def ventilated(seed: int, n: int = 900) -> Record:
    """A room: air of another temperature flows in, and what flows in carries what was there out."""
    rng = np.random.default_rng(seed)
    flow, supply, outside = steps(rng, n, 0.05, 0.35), steps(rng, n, 17.0, 36.0), steps(rng, n, -5.0, 15.0)
    y = np.full(n, 20.0)
    for k in range(n - 1):
        y[k + 1] = y[k] + 0.2 * flow[k] * (supply[k] - y[k]) + 0.006 * (outside[k] - y[k])
    return Record(np.stack((flow, supply, outside), axis=1), y + 0.02 * rng.standard_normal(n))


@pytest.mark.parametrize("units", [("", "", ""), ("kg/s", "degC", "degC")])
def test_a_product_with_a_difference_is_found(units: tuple[str, ...]) -> None:
    """Flow times the difference of two temperatures: chains of four states mimicked it and crowded the short one out, and neither
    product explains much without the other; the room had no answer. Where both have one unit it is one term."""
    record = replace(ventilated(1), input_units=units, output_units=units[1:2])
    found = discover([record], best_linear([record], Options()), of_orders(1))
    assert found.rmse_unused[0] < 0.03
    assert {t.same_as for t in found.terms[: 1 if units[1] else 2]} == {"bilinear"}
    assert CARRIED in {t.meaning for t in found.terms[:2]}
    assert found.nature == "dynamic nonlinearity"


def charged(seed: int, n: int = 900) -> Record:
    """A capacitor on a source and a resistance; a converter draws its power whatever the voltage."""
    rng = np.random.default_rng(seed)
    source, power, v = steps(rng, n, 250.0, 290.0), 1e3 * steps(rng, n, 4.0, 20.0), np.full(n, 240.0)
    for k in range(n - 1):
        v[k + 1] = v[k] + 0.12 * (source[k] - v[k]) - 0.1 * power[k] / v[k]
    return Record(
        np.stack((source, power), axis=1),
        v + 0.05 * rng.standard_normal(n),
        input_units=("V", "W"),
        output_units=("V",),
    )


def heated(seed: int, n: int = 900) -> Record:
    """A tank on a heat pump, which needs the more power for its heat the higher it lifts it, and nine degrees more."""
    rng = np.random.default_rng(seed)
    power, outside, t = steps(rng, n, 0.5, 4.0), steps(rng, n, -5.0, 12.0), np.full(n, 45.0)
    for k in range(n - 1):
        t[k + 1] = t[k] + 9.0 * power[k] / (t[k] - outside[k] + 9.0) - 0.02 * (t[k] - 21.0)
    return Record(
        np.stack((power, outside), axis=1),
        t + 0.02 * rng.standard_normal(n),
        input_units=("kW", "degC"),
        output_units=("degC",),
    )


@pytest.mark.parametrize(
    "made, words, noise", [(charged, "1/y * u2", 0.05), (heated, "1/(y - u2) * u1", 0.02)]
)
def test_a_power_acts_by_the_reciprocal_of_what_it_is_driven_into(made, words: str, noise: float) -> None:
    """A direct-current bus under a converter was square roots, a logarithm and three products: .75 V for the noise of .58."""
    record = made(1)
    found = discover([record], best_linear([record], Options()), of_orders(1))
    assert found.rmse_unused[0] < 1.3 * noise
    assert words in found.equation


def tanks(seed: int, n: int = 900) -> Record:
    """Two tanks beside each other; a flap lets water from the first into the second, and none back."""
    rng = np.random.default_rng(seed)
    u = np.stack((steps(rng, n, 0.0, 2.0), steps(rng, n, 0.0, 2.0)), axis=1)
    y = np.full((n, 2), 20.0)
    for k in range(n - 1):
        over = 0.05 * max(y[k, 0] - y[k, 1], 0.0)
        y[k + 1] = y[k] + u[k] * (0.5, 0.4) - 0.02 * y[k] + np.array((-over, over))
    return Record(
        u, y + 0.05 * rng.standard_normal(y.shape), 2.0, input_units=("V", "V"), output_units=("cm", "cm")
    )


def test_what_a_difference_drives_is_found() -> None:
    """Neither level bends the flow through a flap between two tanks, their difference does."""
    record, other = tanks(1), tanks(2)
    base = best_linear([record], Options())
    found = discover([record], base, of_orders(1))
    assert np.all(found.rmse_unused < 0.2 * base.rmse_unused)
    assert {t.output for t in found.terms if t.meaning == BETWEEN} == {0, 1}
    assert "(y1 - y2)" in found.equation
    assert found.model is not None
    again = DiscoveredModel.from_json(found.model.to_json())
    error = found.model.simulate(other, 60) - other.y
    assert np.sqrt(np.mean(error[60:] ** 2)) < 0.1  # of which noise .05
    assert np.array_equal(again.simulate(other, 20), found.model.simulate(other, 20))


def test_differences_are_of_one_unit_and_of_signals_of_one_size() -> None:
    record = tanks(1)
    names = lambda r: [d.name for d in scales_of([r], [r.y], np.zeros(2, int)).differences]
    assert names(record) == ["y0-y1", "v0-v1", "u0-u1"]
    assert names(replace(record, output_units=("cm", "mbar"))) == ["u0-u1"]
    assert "y0-u1" in names(replace(record, input_units=("V", "cm")))
    assert names(replace(record, y=record.y * (1.0, 1e-3))) == ["u0-u1"]


def test_a_difference_is_the_difference_of_its_signals_with_exact_sensitivities() -> None:
    """In the user's units, where an input acts at once too: that part of an output is a parameter."""
    record = replace(tanks(1), output_units=("V", "V"))
    scales = scales_of([record], [record.y], np.zeros(2, int))
    terms = tuple(
        Term((Factor(Kind.TANH, d.name, 0.1, 0.8, (True, True)),), chain=i % 2)
        for i, d in enumerate(scales.differences)
    )
    form = Form((2, 1), 2, scales.paces, scales.steps, terms, True, scales.bounds, scales.differences)
    assert Form.of(json.loads(json.dumps(asdict(form)))) == form
    asm, d = Assembly(form), drive(record.u[:60], scales)
    theta = 0.1 + 0.2 * np.random.default_rng(3).random(form.parameters)
    run = lambda p: asm.fill(p).sensitivities(x, np.zeros((len(x), len(p))), d)
    x = np.linspace(0.1, 0.3, len(asm.base[0]))
    got = run(theta)
    own = dict(zip(asm.signals, got.signals.T, strict=True))
    users = {n: c + s * own[n] for n, (c, s) in scales.centres.items()}
    for difference in scales.differences:
        centre, size = scales.centre(difference)
        assert centre + size * own[difference.name] == pytest.approx(
            users[difference.first] - users[difference.second], rel=1e-9
        )
    for p in range(len(theta)):
        step = 1e-6 * np.eye(len(theta))[p]
        slope = (run(theta + step).y - run(theta - step).y) / 2e-6
        assert np.allclose(got.dy[:, :, p], slope, rtol=1e-5, atol=1e-6), p


@pytest.mark.parametrize(("order", "along"), [(1, FREE), (1, LAST), (1, 0), (2, FREE), (2, 0), (3, FREE)])
def test_a_longer_chain_starts_as_the_same_model(order: int, along: int, monkeypatch) -> None:
    """Numerators, states and forces get the same fast pole as the denominator; only what acts in the highest derivative alone gets its lag."""
    record = ventilated(2, 400)
    base = best_linear([record], Options())
    scales = scales_of([record], base.y_model, np.zeros(3, int))
    pieces = pieces_of([record], [np.ones(record.y.shape, bool)], scales)
    smooth = [(y - scales.y) / scales.sy for y in base.y_model]
    fitted = linear_fit((order,), pieces, scales, smooth, feedthrough=True)
    assert fitted is not None
    term = Term((Factor(Kind.LINEAR, "u0"), Factor(Kind.LINEAR, "u1")), "force", 0, along)
    form = fitted.form.with_terms(term)
    theta = np.concatenate([fitted.theta, np.full(form.taps(term), 0.1)])
    fitted = search.fit(form, theta, fitted.starts, pieces, iterations=20)
    assert fitted is not None
    begun = []

    def as_begun(form, theta, starts, pieces, **options):
        begun.append(real(form, theta, starts, pieces, iterations=0))
        return real(form, theta, starts, pieces, **options)

    real = search.fit
    monkeypatch.setattr(search, "fit", as_begun)
    search.lengthened(fitted, 0, pieces, 10)
    assert begun[0].form.orders == (order + 1,)
    assert np.abs(begun[0].outputs[0] - fitted.outputs[0]).max() < 1e-9


def test_what_no_window_shows_is_carried_on(monkeypatch) -> None:
    """Models with a tenth of the error were thrown away, because blocks that start anew from a window of 20 samples do not see how
    full a store is that hardly moves, as where wax melts: those that do are preferred, but not to nothing."""
    record = ventilated(4)
    base = best_linear([record], Options())
    assert discover([record], base, of_orders(1)).found
    monkeypatch.setattr(answer._Judge, "starts", lambda judge, fitted: False)
    found = discover([record], base, of_orders(1))
    assert found.found
    assert found.rmse_unused[0] < 0.05


def closer(seed: int, n: int = 900) -> Record:
    """A door with a spring, damped the more the nearer it is to its frame."""
    rng = np.random.default_rng(seed)
    u = steps(rng, n, 0.0, 1.0)
    x = v = 0.0
    y = np.zeros(n)
    for k in range(n):
        y[k] = x
        for _ in range(20):
            v += 0.01 * (9.0 * (u[k] - x) - (1.5 + 12.0 * np.exp(-x / 0.2)) * v)
            x += 0.01 * v
    return Record(u, y + 0.005 * rng.standard_normal(n), 0.2, input_units=("Nm",), output_units=("rad",))


def test_a_record_that_begins_at_rest_vouches_for_terms_without_a_window() -> None:
    """Its later blocks have no window that would say where they start: judged from rest there, a door's closer was ten times worse
    than in any run, and gave way to a regression."""
    record = closer(1)
    base = best_linear([record], Options(deviations=True))
    assert base.blocks.window == 0
    found = discover([record], base, "quick", 0)
    assert found.rmse_unused[0] < 0.008 < 0.3 * base.rmse_unused[0]


def test_the_equation_of_a_force_with_a_rate_is_whole() -> None:
    """A curve of the output whose rate acts is damping; what was printed was the curve alone, a twentieth of the force."""
    record = closer(1)
    model = discover([record], best_linear([record], Options(deviations=True)), "quick", 0).model
    assert model is not None
    number, term = next((i, t) for i, t in enumerate(model.form.terms) if t.slot == "force")
    found = model.found()[number]
    assert "d/dt[" in found.text
    assert found.parameters["coefficient of the rate"][2] == "Nm s"
    taps, b = model.theta[model.form.blocks[number]], model.theta[model.assembly.betas[0][0]]
    unit = model.scales.su[0] * model.axes["y0"].scale ** -DEGREE[term.factors[0].kind]
    gains = [taps[1] / b[1] * unit, taps[0] / b[1] * unit * model.scales.dt / model.form.paces[0]]
    for rate, gain in enumerate(gains):
        assert model.amplitude(number, model.theta, rate) == pytest.approx(gain, rel=1e-9)
    assert model._damps(term, found.curve, 100.0)
    assert not model._damps(term, found.curve, 0.01)
    # where the curve itself is not sure, its rate is all that is said
    assert (
        sum_of_rates("y^2", {0: (0.1, 0.2), 1: (-3.0, 0.1), 2: (1.0, 0.2)})
        == "-3 +- 0.1 s * d/dt[y^2] + 1 +- 0.2 s^2 * d^2/dt^2[y^2]"
    )


@pytest.mark.parametrize("gain", [0.4, 0.0])
def test_in_a_loop_no_linear_part_passes_inputs_straight_on_that_are_late(monkeypatch, gain: float) -> None:
    """A tank on a heat pump in a loop: what was discovered was by far the best, and refused as it acted at once."""
    rng, n = np.random.default_rng(3), 700
    r = np.repeat(rng.uniform(0.5, 2.5, n // 5), 5)
    e = np.asarray(lfilter([1.0], [1.0, -1.3, 0.6], 0.02 * rng.standard_normal(n)))
    y, u, x = np.zeros(n), np.zeros(n), 1.0
    for k in range(n):
        y[k] = x + e[k]
        u[k] = r[k] - gain * y[k]
        x = 0.8 * x + 0.2 * u[k] / (0.5 + x)
    monkeypatch.setitem(BUDGETS, "quick", of_orders(1, 2))
    found = discover([Record(u, y)], best_linear([Record(u, y)]), "quick")
    assert found.model is not None
    assert found.model.form.feedthrough is not (gain > 0.0)
