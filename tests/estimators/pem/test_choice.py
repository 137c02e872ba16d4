"""Delay and orders are found where the data tell them."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.signal import lfilter

from benchmarks.campaign.plants import hair_dryer_record
from estimators import identify
from estimators.pem import choice
from estimators.pem.choice import estimate_delay, select_orders
from oed.data import Record
from oed.errors import InputError


def record(rng, delay=4, length=600, deviation=0.3):
    u = rng.normal(size=length)
    clean = lfilter(np.r_[np.zeros(delay), 0.5, 0.3], [1, -1.2, 0.6], u)
    return Record(u, clean + deviation * rng.normal(size=length))


def test_delay_is_found(rng) -> None:
    found = estimate_delay(record(rng), "oe", (2, 2), offset=False)
    assert found.delay == 4
    assert found.weights.max() > 0.99
    assert found.fit.model.structure.nk[0, 0] == 4
    assert "delay 4" in repr(found)
    assert found.to_dict()["delays"] == list(range(9))


def test_orders_are_found(rng) -> None:
    data = record(rng, delay=1)
    choice = select_orders(data, "oe", [range(1, 4), range(1, 4)], criterion="bic", offset=False)
    assert choice.orders == (2, 2)
    assert len(choice.rows) == 9
    assert choice.fit.model.structure.n == 4
    assert "(2, 2)" in repr(choice)


def test_cross_validation_prefers_the_true_orders_to_too_few(rng) -> None:
    data = record(rng, delay=1)
    choice = select_orders(data, "oe", [(1, 1), (2, 2)], criterion="cv", offset=False)
    assert choice.orders == (2, 2)
    several = select_orders([data[:300], data[300:]], "arx", [(1, 1), (4, 4)], criterion="cv", offset=False)
    assert several.orders == (4, 4)


def test_bad_input_is_told(rng) -> None:
    with pytest.raises(InputError, match="aic, bic or cv"):
        select_orders(record(rng), "oe", [(2, 2)], criterion="mdl", offset=False)
    with pytest.raises(InputError, match="could be fitted"):
        select_orders(record(rng), "oe", [(2, 2, 2)], offset=False)
    with pytest.raises(InputError, match="samples"):
        estimate_delay(record(rng)[:7], "oe", (2, 2), offset=False)


@pytest.mark.slow
def test_orders_and_delay_by_themselves(rng):
    """Order 2 and delay 3 are found; without noise worth modelling in the way, no larger order is taken."""
    u = rng.standard_normal(500)
    y = lfilter([0, 0, 0, 0.5, 0.2], [1, -1.2, 0.6], u)
    loud = Record(u, y + lfilter([1], [1, -1.2, 0.6], 0.1 * rng.standard_normal(500)))
    fit = identify(loud, "arx", "auto", "auto", offset=False)
    form = fit.model.structure
    assert (form.na[0], form.nb[0, 0], form.nk[0, 0]) == (2, 2, 3)
    assert "blocks left out" in fit.notes[-1]
    for orders, delay in (("best", 1), ((2, 2), "any")):
        with pytest.raises(InputError, match="'auto'"):
            identify(loud, "arx", orders, delay)


def test_an_order_must_be_worth_it(rng):
    """Of an output that is noise alone the smallest order is taken."""
    noise = Record(rng.standard_normal(400), rng.standard_normal(400))
    assert identify(noise, "arx", "auto", offset=False).model.structure.na[0] == 1


def test_poles_that_only_follow_a_late_input_are_left_out(rng):
    """Of two inputs, one later by a sample: a third coefficient serves it, and a third pole would cancel anywhere."""
    u = np.repeat(np.sign(rng.standard_normal((250, 2))), 4, axis=0)
    clean = lfilter([0, 0, 0.3, 0.1], [1, -1.5, 0.75], u[:, 0]) + lfilter([0, 0.8], [1, -0.9], u[:, 1])
    fit = identify(Record(u, clean + 0.2 * rng.standard_normal(len(u))), "oe", "auto", "auto")
    assert fit.model.structure.nf.max() == 2
    value, error, _ = fit.hinf_norm
    assert abs(value - np.hypot(8.0, 1.6)) < 3 * error < 1


@pytest.mark.slow
def test_an_order_that_the_data_do_not_tell_is_passed_over(monkeypatch):
    """Where a noise of one pole cannot be told from the plant's, which a fit then says, the next orders are tried."""
    measured = choice.held_out_error

    def untold(given, structure, orders, nk, **options):
        if max(orders) == 1:
            raise InputError("the noise cannot be told from the plant's.")
        return measured(given, structure, orders, nk, **options)

    monkeypatch.setattr(choice, "held_out_error", untold)
    form = identify(hair_dryer_record()[:350], "bj", "auto", 3, search="quick").model.structure
    assert form.nf[0, 0] == 2
