"""How discovery searches: terms that explain nothing alone, chains that grow, stores that no window shows, what a record bears."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray

from estimators.diagnosis.baseline import Options, best_linear
from estimators.diagnosis.discovery import answer, discover, search
from estimators.diagnosis.discovery.dictionary import Kind
from estimators.diagnosis.discovery.form import FREE, LAST, Factor, Term
from estimators.diagnosis.discovery.starts import linear_fit, pieces_of, scales_of
from estimators.diagnosis.discovery.wording import CARRIED
from oed.data import Record


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


def test_a_product_with_a_difference_is_found() -> None:
    """Flow times the difference of two temperatures: chains of four states mimicked it and crowded the short one out, and neither
    product explains much without the other; the room had no answer."""
    record = ventilated(1)
    found = discover([record], best_linear([record], Options()), "quick")
    assert found.rmse_unused[0] < 0.03
    assert [t.same_as for t in found.terms[:2]] == ["bilinear", "bilinear"]
    assert CARRIED in {t.meaning for t in found.terms[:2]}
    assert found.nature == "dynamic nonlinearity"


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
    assert discover([record], base, "quick").found
    monkeypatch.setattr(answer._Judge, "starts", lambda judge, fitted: False)
    found = discover([record], base, "quick")
    assert found.found
    assert found.rmse_unused[0] < 0.05
