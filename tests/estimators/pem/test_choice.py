"""Delay and orders are found where the data tell them."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.signal import lfilter

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
