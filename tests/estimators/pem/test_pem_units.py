"""Units change no conclusion: powers of ten within the stated range, a line beyond it."""

from __future__ import annotations

import os
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy.signal import lfilter

from estimators import diagnose
from estimators.pem import identify
from estimators.pem.choice import held_out_error
from estimators.residual import compare_models
from estimators.residual.tests import autocorrelation, cross_correlation, residual_tests
from oed.data import Record
from oed.errors import InputError
from oed.files import read_record


def record(u_size: float = 1.0, y_size: float = 1.0, dt: float = 1.0, noise: float = 0.3) -> Record:
    """A plant of order one in noise that is not white, so that a test of whiteness must fail."""
    rng = np.random.default_rng(0)
    u, e = rng.standard_normal((2, 400))
    y = lfilter([0, 1, 0.5], [1, -0.8], u) + noise * np.asarray(lfilter([1], [1, -0.9], e))
    return Record(u_size * u[:, None], y_size * y[:, None], dt=dt)


def conclusions(
    data: Record, structure: str = "oe", orders: tuple[int, ...] = (2, 1), **options: Any
) -> dict[str, float]:
    """The tests' p-values, how much is explained, and the gain's error: none has a unit."""
    fit = identify(data, structure, orders, 1, **options)
    gain, error, _ = fit.hinf_norm
    return {name: test.p_value for name, test in residual_tests(fit, data).items()} | {
        "fit": fit.fit_percent, "error": error / gain,
    }  # fmt: skip


FAR = [(1, 1e-149), (1, 1e148), (1e-149, 1), (1e148, 1), (1e148, 1e148), (1e-149, 1e-149)]
STRUCTURES: list[tuple[str, tuple[int, ...], dict[str, Any]]] = [
    ("oe", (2, 1), {}), ("arx", (1, 2), {}), ("armax", (1, 2, 1), {}), ("bj", (2, 1, 1, 1), {}), ("ss", (2,), {}),
    ("ss", (2,), {"method": "n4sid"}), ("fir", (30,), {"regularisation": "tc"}), ("oe", (2, 1), {"robust": "student"}),
]  # fmt: skip


def same(found: dict[str, float], usual: dict[str, float], rtol: float = 1e-4) -> bool:
    return all(np.isclose(found[name], usual[name], rtol=rtol, atol=1e-9) for name in usual)


NEAR = [(1e-12, 1e12, 1e-12), (1, 1e-75), (1e-74, 1), (1e-40, 1e40), (1e140, 1, 1e-140), (1, 1e-140, 1e140)]


@pytest.mark.parametrize("sizes", [*NEAR, (1, 1, 1e-9), (1, 1, 1e9), *FAR])
def test_powers_of_ten_change_no_conclusion(sizes):
    usual, found = conclusions(record()), conclusions(record(*sizes))
    assert max(usual["whiteness"], found["whiteness"]) < 1e-6
    assert same(found, usual)


@pytest.mark.parametrize("sizes", FAR)
def test_nor_where_hardly_anything_is_left(sizes):
    """Squares of the signals over those of a residual that is a billion times smaller are the largest that are formed. The last digits
    of the samples are 1e-7 of that residual, and a p-value of .6 moved by 1e-4 of itself with another BLAS."""
    assert same(conclusions(record(*sizes, noise=1e-9)), conclusions(record(noise=1e-9)), rtol=1e-3)


@pytest.mark.parametrize("structure, orders, options", STRUCTURES, ids=str)
def test_nor_of_any_structure(structure, orders, options):
    usual = conclusions(record(), structure, orders, **options)
    for sizes in FAR[::2]:
        assert same(conclusions(record(*sizes), structure, orders, **options), usual), sizes


@pytest.mark.parametrize(
    "sizes, value",
    [((1, 1e-155), "output y of the record"), ((1, 1e155), "output y of the record"), ((1e-160, 1), "input u of the record"),
     ((1e200, 1), "input u of the record"), ((1, 1e-300), "output y"), ((1e-80, 1e80), "outputs of the record over that of its inputs"),
     ((1, 1, 1e-151), "sampling time of the record is 1e-151"), ((1, 1, 1e151), "sampling time of the record is 1e.151")],
)  # fmt: skip
def test_beyond_the_range_of_squares_is_a_line(sizes, value):
    """Before, a failed test of whiteness became p = 1 at 1e-100, and larger sizes ended in tracebacks."""
    with pytest.raises(InputError, match=f"{value}.*between 1e-150 and 1e.150.*choose other units"):
        conclusions(record(*sizes))


@pytest.mark.parametrize(
    "sizes",
    [(1, 1e-52), (1, 1e50), (1e-51, 1), (1e51, 1), (1e30, 1e-30), (1, 1, 1e-51), (1, 1, 1e51), (1, 1e-300)],
)
def test_beyond_the_range_of_sixth_powers_a_diagnosis_is_a_line(sizes):
    with pytest.raises(
        InputError,
        match=r"of (the training record|its inputs) is .*between 1e-50 and 1e.50.*choose other units",
    ):
        diagnose(record(*sizes))


def test_each_channel_has_a_size_of_its_own():
    u = np.column_stack([record().u, 1e-160 * record(noise=1.0).y])
    with pytest.raises(InputError, match="the size of the input u2 of the record"):
        identify(Record(u, record().y), "fir", (3,), 1)


@pytest.mark.parametrize("size", [1e-300, 1e-170, 1e-12, 1e12, 1e170, 1e300])
def test_tests_that_give_only_a_p_value_know_no_size(size):
    """A residual with memory became white (p = 1) at 1e-170, and an overflow at 1e170."""
    rng = np.random.default_rng(0)
    e, u = lfilter([1], [1, -0.9], rng.standard_normal((2, 500)))
    usual = autocorrelation(e), cross_correlation(e, u), cross_correlation(e, u)
    found = autocorrelation(size * e), cross_correlation(size * e, u), cross_correlation(e, size * u)
    assert usual[0].p_value < 1e-6
    assert np.allclose([t.p_value for t in found], [t.p_value for t in usual], rtol=1e-9)


def test_fresh_data_of_sizes_that_the_model_has_no_squares_for_is_a_line():
    fit = identify(record(), "oe", (2, 1), 1)
    for look in (partial(residual_tests, fit, fresh=True), lambda data: compare_models({"oe": fit}, data)):
        with pytest.raises(InputError, match="output y of the record is .*choose other units"):
            look(record(1, 1e200))


def test_nor_the_error_of_blocks_left_out():
    usual, found = (held_out_error(data, "oe", (2, 1), 1, folds=3) for data in (record(), record(1, 1e148)))
    assert np.allclose(np.array(found) / 1e148, usual, rtol=1e-6)


@pytest.mark.validate
@pytest.mark.parametrize(
    "sizes",
    [(1, 1e-48), (1, 5e49), (1e-49, 1), (4e49, 1), (1e-24, 1e24), (4e49, 5e49), (1e-49, 1e-48), (1, 1, 1e-50), (1, 1, 1e50),
     (4e49, 5e49, 1e-50), (1e-12, 1e12, 1e-12), (1e12, 1e-12, 1e12)],
)  # fmt: skip
def test_nor_of_a_diagnosis(sizes):
    rng = np.random.default_rng(0)
    u = np.repeat(rng.uniform(-2, 2, 100), 4)
    y = lfilter([0, 0.1, 0.1], [1, -1.5, 0.7], np.clip(u, -1.1, 1.1)) + 0.02 * rng.standard_normal(400)
    usual, found = (
        diagnose(Record(a * u[:, None], b * y[:, None], dt=t[0] if t else 1.0))
        for a, b, *t in ((1.0, 1.0), sizes)
    )
    assert (found.effect, found.variant, found.nature) == ("input_saturation", usual.variant, usual.nature)
    assert np.isclose(found.rmse_after.value / sizes[1], usual.rmse_after.value, rtol=1e-6)
    assert np.isclose(
        found.parameters["saturation.limit"][0] / sizes[0], usual.parameters["saturation.limit"][0], rtol=1e-6
    )


@pytest.mark.validate
@pytest.mark.skipif(not os.environ.get("OED_CASES"), reason="needs the practice records, in OED_CASES")
@pytest.mark.parametrize("name", ["case_002", "case_005", "case_010", "case_013"])
def test_nor_of_a_diagnosis_of_a_rig(name):
    """A bilinear plant was a nonlinear loss, a sensor that saturates a broken line, wherever a unit was 1e13 from one."""
    folder = Path(os.environ["OED_CASES"]) / "undeclared" / "practice" / "public" / "P" / name
    records = [read_record(folder / f"{part}.csv") for part in ("train", "test")]
    found = []
    for a, b, dt in ((1, 1, 1), (1e-31, 1e13, 1e-5), (1e45, 1e45, 1e-45)):
        r = diagnose(*(Record(a * r.u, b * r.y, dt=dt * r.dt) for r in records))
        found.append((r.effect, r.nature, r.variant, f"{r.rmse_after.value / b:.4g}"))
    assert found == found[:1] * 3
