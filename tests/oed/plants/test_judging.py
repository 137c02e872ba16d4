"""A model that somebody has, judged on a record: its error is the noise, wherever the record begins and whatever its levels."""

from __future__ import annotations

import json
from types import SimpleNamespace

import numpy as np
import pytest

import estimators.diagnosis.cases as cases_module
from benchmarks.cli import main
from oed.data import Record
from oed.errors import InputError
from oed.plants.json import plant_to_json
from oed.plants.judging import errors_of, orders_of
from oed.plants.named import named_plant


@pytest.fixture
def measured(rng):
    """The middle of a run, about levels, with noise of 0.1."""
    plant = named_plant("three-by-two")
    u = rng.standard_normal((900, plant.n_inputs)) + [3.0, -2.0][: plant.n_inputs]
    y = plant.simulate(u) + 7.0 + 0.1 * rng.standard_normal((900, plant.n_outputs))
    return plant, Record(u[300:], y[300:])


def test_the_error_is_the_noise(measured):
    plant, record = measured
    found = errors_of(plant, record)
    np.testing.assert_allclose(found, 0.1, rtol=0.25)
    wrong = plant.replace(num=[[0.5 * entry for entry in row] for row in plant.num])
    assert (errors_of(wrong, record) > 2 * found).all()


def test_orders_do_not_count_delay():
    assert orders_of(named_plant("delay")) == (2,)
    assert orders_of(named_plant("reference")) == (2,)


def test_what_cannot_be_judged(measured):
    plant, record = measured
    with pytest.raises(InputError, match="give the model of this system"):
        errors_of(named_plant("reference"), record)
    with pytest.raises(InputError, match="too few to judge"):
        errors_of(plant, record[:40])


def test_diagnose_takes_a_model(tmp_path, monkeypatch, capfd, rng):
    plant = named_plant("reference")
    (tmp_path / "m.json").write_text(json.dumps(plant_to_json(plant)))
    u = rng.standard_normal(200)
    y = plant.simulate(u[:, None])[:, 0] + 0.1 * rng.standard_normal(200)
    (tmp_path / "r.csv").write_text("u,y\n" + "".join(f"{a},{b}\n" for a, b in zip(u, y, strict=True)))
    told = []

    def diagnose_files(train, test, *, setting, **_):
        told.append(setting.orders)
        return SimpleNamespace(to_dict=dict), []

    monkeypatch.setattr(cases_module, "diagnose_files", diagnose_files)
    words = ["diagnose", str(tmp_path / "r.csv"), "--model", str(tmp_path / "m.json"), "--json", "--quiet"]
    assert main(words) == 0
    said = json.loads(capfd.readouterr().out)["model_given"]
    assert told == [(2,)] == [tuple(said["orders"])]
    assert 0.07 < said["rmse"][0] < 0.13
    assert main([*words, "--order", "3"]) == 2
    assert "both tell the order" in capfd.readouterr().err
