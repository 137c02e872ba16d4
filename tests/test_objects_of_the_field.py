"""Every public verb that takes a plant or a record takes it as the object that people have, with the same answer."""

from __future__ import annotations

import warnings
from typing import Any

import control
import numpy as np
import pandas as pd
import pytest
import scipy.signal
import xarray as xr

import estimators
import oed
from estimators.pem import identify_response
from estimators.residual import residual_tests
from estimators.residual.measures import p_stated
from oed import design as designs
from oed import theory
from oed.data import Record, Spectrum
from oed.errors import InputError
from oed.inspection import defects

NUM, DEN, DT = [0.2155, 0.2012], [1.0, -0.9854, 0.8187], 0.1
TF = control.TransferFunction(NUM, DEN, DT)
PLANT = oed.as_plant(TF)
RNG = np.random.default_rng(0)
U = RNG.standard_normal((300, 1))
RECORD = Record(U, PLANT.simulate(U) + 0.05 * RNG.standard_normal((300, 1)), dt=DT)
FIT = estimators.identify(RECORD, "oe", (2, 2), 1)
INDEX = pd.date_range("2024-01-01", periods=300, freq="100ms")
SIGNALS = {"u": RECORD.u[:, 0], "y": RECORD.y[:, 0]}
DLTI = scipy.signal.dlti(NUM, DEN, dt=DT)

SYSTEMS: dict[str, Any] = {
    "TransferFunction": TF,
    "StateSpace": control.tf2ss(TF),
    "dlti": DLTI,
    "dlti in states": scipy.signal.dlti(
        [[0.9854, -0.8187], [1.0, 0.0]], [[1.0], [0.0]], [NUM], [[0.0]], dt=DT
    ),
    "dlti by zeros": DLTI.to_zpk(),
}
RECORDS: dict[str, Any] = {
    "DataFrame": pd.DataFrame(SIGNALS, index=INDEX),
    "Dataset": xr.Dataset({k: ("time", v) for k, v in SIGNALS.items()}, coords={"time": INDEX.to_numpy()}),
    "TimeResponseData": control.TimeResponseData(RECORD.t, SIGNALS["y"], inputs=SIGNALS["u"], issiso=True),
    "(u, y, dt)": (RECORD.u, RECORD.y, DT),
    "columns": (SIGNALS["u"], SIGNALS["y"], DT),
    "list": [RECORD],
}
LINES = Spectrum(np.array([0.5, 1.0]), np.array([0.5, 0.5]))
OPEN = lambda omega: np.zeros((len(omega), 1, 1), complex)

PLANT_VERBS: dict[str, Any] = {
    "solve_design": lambda p: oed.solve_design(p, "D").loss,
    "peak": lambda p: oed.peak(p).value,
    "simulated": lambda p: oed.simulated(p, seed=1)(U),
    "limit_spectrum": lambda p: oed.limit_spectrum(p).mu2,
    "information_of_signal": lambda p: oed.information_of_signal(p, U),
    "information_of_spectrum": lambda p: oed.information_of_spectrum(p, LINES),
    "information_of_records": lambda p: oed.information_of_records(p, [U]),
    "amplitude_design": lambda p: designs.amplitude_design(p, "D", 1.0, 60, np.random.default_rng(0))[0].loss,
    "autocorrelation_design": lambda p: designs.autocorrelation_design(p, "D", lags=4).loss,
    "autoregressive_design": lambda p: designs.autoregressive_design(p, "D", order=2).loss,
    "basis_design": lambda p: designs.basis_design(p, "D").loss,
    "moment_design": lambda p: designs.moment_design(p, "D").loss,
    "masked_design": lambda p: designs.masked_design(p, "D", tolerance=1e-3).loss,
    "least_power_design": lambda p: designs.least_power_design(p, "A", 1.0).spectrum.total_power,
    "robust_design": lambda p: designs.robust_design([p], "D").loss,
    "quantile_design": lambda p: designs.quantile_design([p], "A").design.loss,
    "closed_loop_map": lambda p: designs.closed_loop_map(p, OPEN).of_spectrum(LINES),
    "information_map": lambda p: designs.information_map(p).of_spectrum(LINES),
    "gain_scaling_residual": lambda p: theory.gain_scaling_residual(p)[0] < 1e-9,
    "limit_spectrum_on_grid": lambda p: theory.limit_spectrum_on_grid(p, 100).mu2,
    "map_of_claim": lambda p: theory.map_of_claim([p])[0].limit,
    "peak_sinusoid_spectrum": lambda p: theory.peak_sinusoid_spectrum(p).omega,
    "spectra_of_iterations": lambda p: theory.spectra_of_iterations(p, 2)[2],
}
RECORD_VERBS: dict[str, Any] = {
    "identify": lambda r: estimators.identify(r, "arx", (2, 2), 1).theta,
    "residual_tests": lambda r: residual_tests(FIT, r)["whiteness"].statistic,
    "plot.compare": lambda r: np.concatenate(
        [line.get_ydata() for line in FIT.plot.compare(r).axes[0].lines]
    ),
    "plot.residuals": lambda r: FIT.plot.residuals(r).axes[0].lines[0].get_ydata(),
    "residuals_of": lambda r: FIT.residuals_of(r),
    "simulate_record": lambda r: FIT.simulate_record(r, window=5),
    "defects": lambda r: [d.kind for d in defects(r)],
}


def same(a: Any, b: Any) -> bool:
    if isinstance(a, list) and a and isinstance(a[0], str):
        return a == b
    return np.shape(a) == np.shape(b) and np.allclose(a, b, rtol=1e-6, atol=1e-9)


@pytest.mark.parametrize("verb", PLANT_VERBS)
def test_systems(verb: str) -> None:
    work = PLANT_VERBS[verb]
    expected = work(PLANT)
    for name, system in SYSTEMS.items():
        with warnings.catch_warnings():
            warnings.simplefilter("error")
            assert same(work(system), expected), name
    assert same(work(FIT), work(FIT.to_plant()))
    assert not same(work(FIT), expected) or verb in (
        "gain_scaling_residual",
        "map_of_claim",
    )  # control: another plant
    response = control.frequency_response(TF, np.linspace(0.1, 30, 60))
    with pytest.raises(InputError, match="identify a model of it first"):
        work(response)


@pytest.mark.parametrize("verb", RECORD_VERBS)
def test_records(verb: str) -> None:
    work = RECORD_VERBS[verb]
    expected = work(RECORD)
    for name, record in RECORDS.items():
        assert same(work(record), expected), name
    if verb != "defects":
        assert not same(work(RECORD.replace(y=RECORD.y[::-1])), expected)  # control: another record
    with pytest.raises(InputError, match="one row of 300 values"):
        work((SIGNALS["u"][None, :], SIGNALS["y"][None, :], DT))


@pytest.mark.parametrize("verb", ["plot.compare", "plot.residuals", "residuals_of", "simulate_record"])
def test_two_records_are_not_one(verb: str) -> None:
    with pytest.raises(InputError, match="2 records are given where one is wanted"):
        RECORD_VERBS[verb]([RECORD, RECORD])


def test_a_measured_response_is_a_model_of_its_own() -> None:
    found = identify_response(control.frequency_response(TF, np.linspace(0.1, 30, 60)), (2, 2), delay=1)
    assert oed.peak(found).value == pytest.approx(oed.peak(PLANT).value, rel=1e-6)


def test_a_plot_of_residuals_knows_what_was_fitted() -> None:
    other = RECORD.replace(y=PLANT.simulate(U) + 0.05 * np.random.default_rng(7).standard_normal((300, 1)))
    for record, fresh in ((RECORD, False), (other, True)):
        test = residual_tests(FIT, record, fresh=fresh)["whiteness"]
        assert FIT.plot.residuals(record).axes[0].get_title() == f"whiteness: {p_stated(test.p_value)}"
    assert test.p_value != residual_tests(FIT, other)["whiteness"].p_value
