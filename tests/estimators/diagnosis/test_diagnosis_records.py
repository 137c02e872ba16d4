"""Measured records on their published splits: the cause named by the tool itself, and the error before and after."""

import os
from pathlib import Path

import pytest

from estimators.diagnosis.cases import Columns, diagnose_files
from estimators.diagnosis.model.forces import force_balance
from oed.files import read_record

DATA = os.environ.get("OED_DATA")
pytestmark = [
    pytest.mark.validate,
    pytest.mark.skipif(DATA is None, reason="OED_DATA does not name the folder of the measured records"),
]
SILVERBOX = "silverbox/silverbox_snls80mv.csv.gz"
WH = "wh2009/wiener_hammerstein_2009.csv.gz"
SILVERBOX_DT, WH_DT = 0.0016384041943147375, 1.953125e-05


def diagnosed(train, test, **options):
    result, _ = diagnose_files(f"{DATA}/{train}", f"{DATA}/{test}", **options)
    return result


@pytest.mark.parametrize(
    "rows, linear, limit",
    # published linear errors 6.96 and 14.4 mV (Champneys et al. 2024, table); the limits are the issue's
    [("105712:127400", 6.96e-3, 0.5e-3), ("100:40575", 14.4e-3, 0.7e-3)],
    ids=["multisine", "arrow"],
)
def test_silverbox_is_a_stiffening_spring(rows, linear, limit):
    result = diagnosed(
        f"{SILVERBOX}[40650:105712]", f"{SILVERBOX}[{rows}]", skip=50, columns=Columns(dt=SILVERBOX_DT)
    )
    assert result.effect == "duffing"
    assert result.rmse_before.value == pytest.approx(linear, rel=0.05)
    assert result.rmse_after.value < limit


def test_wiener_hammerstein_has_its_nonlinearity_between_two_filters():
    result = diagnosed(f"{WH}[5200:105200]", f"{WH}[105200:184000]", skip=50, columns=Columns(dt=WH_DT))
    assert result.variant.startswith("sandwich")
    assert not {"outliers", "dropouts"} & set(result.ranked)
    assert result.rmse_before.value == pytest.approx(43.4e-3, rel=0.05)  # published linear error
    assert result.rmse_after.value < 1e-3


@pytest.mark.xfail(
    strict=True,
    reason="an end stop behind a smooth sensor curve is better on unused blocks (.37 for .42) and worse on the test record "
    "(.439 for .334), which may not choose",
)
def test_cascaded_tanks_lack_the_square_root_outflow():
    folder = "cascaded_tanks/cascaded_tanks"
    result = diagnosed(f"{folder}_est.csv", f"{folder}_val.csv", skip=50)
    assert result.effect == "square_root_outflow"
    assert result.rmse_after.value < 0.42


def test_emps_has_dry_friction():
    options = {"inputs": "vir_V", "outputs": "qm_m"}
    result = diagnosed(
        "emps/emps_est.csv.gz", "emps/emps_val_pulses.csv.gz", skip=20, columns=Columns(**options)
    )
    assert result.effect == "coulomb_friction"
    # the open-loop position drifts: minima of the training error 1 % apart are 5 to 9 mm on the test record
    assert result.rmse_after.value < 0.5 * result.rmse_before.value
    balance = force_balance(read_record(Path(DATA) / "emps/emps_est.csv.gz", **options), gain=35.15065)
    # published inverse-dynamic fit (Janot, Gautier, Brunot 2019): 95.109 kg, 203.5 N s/m, 20.394 N, -3.165 N
    assert balance.mass[0] == pytest.approx(95.109, rel=0.01)
    assert balance.viscous[0] == pytest.approx(203.5, rel=0.02)
    assert balance.coulomb[0] == pytest.approx(20.394, rel=0.02)
    assert balance.offset[0] == pytest.approx(-3.165, rel=0.05)


@pytest.mark.parametrize(
    "record, cut, skip", [("hair_dryer/hair_dryer.csv", 500, 50), ("gas_furnace/gas_furnace.csv", 200, 20)]
)
def test_no_nonlinearity_is_invented(record, cut, skip):
    result = diagnosed(f"{record}[:{cut}]", f"{record}[{cut}:]", skip=skip)
    assert result.effect in ("coloured_noise", "none")  # the delay is in the linear model
    assert result.pred_rmse_after.value < 0.5 * result.pred_rmse_before.value


def test_a_staircase_up_foretells_the_one_down():
    record = "hydraulic_motor/hydraulic_motor.csv"
    result = diagnosed(f"{record}[:7623]", f"{record}[7623:]", skip=20)
    assert result.rmse_after.value < 0.26  # .355 with the linear model
    assert any("goes with the clock" in sentence for sentence in result.data)
