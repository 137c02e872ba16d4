"""`oed identify`: the keys of its contract, and one clear line for bad input."""

from __future__ import annotations

import json

import numpy as np
import pytest
from scipy.signal import lfilter

from benchmarks.cli import main
from oed.models.model import model_from_json


@pytest.fixture
def data(tmp_path, rng):
    u = rng.normal(size=400) + 3
    y = 2 + lfilter([0, 0, 0, 0.5, 0.2], [1, -1.2, 0.6], u - 3) + 0.1 * rng.normal(size=400)
    path = tmp_path / "data.csv"
    np.savetxt(
        path, np.column_stack([np.arange(400) * 0.1, u, y]), delimiter=",", header="t,u,y", comments=""
    )
    return path


def answer(capfd, *arguments) -> dict:
    assert main(["identify", *map(str, arguments), "--json"]) == 0
    return json.loads(capfd.readouterr().out)


def test_keys_of_the_contract(data, capfd) -> None:
    found = answer(capfd, data, "--delay", 3)
    assert {
        *("parameters", "noise_variance", "loss", "fit_percent", "aic", "bic", "hinf_norm", "residual_tests"),
        "status",
    } <= set(found)
    assert list(found["parameters"]) == ["b3", "b4", "f1", "f2"]
    for name, true in (("b3", 0.5), ("b4", 0.2), ("f1", -1.2), ("f2", 0.6)):
        value, error = found["parameters"][name]
        assert abs(value - true) < 4.5 * error
    assert set(found["residual_tests"]) == {"whiteness", "input", "feedback"}
    assert found["hinf_frequency_hz"] == pytest.approx(found["hinf_frequency"] / (0.2 * np.pi))
    assert found["output_level"][0][0] == pytest.approx(2, abs=0.1)


def test_delay_is_found_and_fresh_data_are_judged(data, capfd) -> None:
    found = answer(capfd, f"{data}[:300]", "--delay", "auto", "--test", f"{data}[300:]")
    assert found["delay"] == 3
    assert found["test"]["prediction_rmse"] == pytest.approx(0.1, rel=0.3)


@pytest.mark.parametrize(
    "structure, orders",
    [("fir", [25]), ("arx", [2, 2]), ("armax", [2, 2, 2]), ("bj", [2, 1, 1, 2]), ("ss", [5])],
)
def test_every_structure(data, capfd, structure, orders) -> None:
    delay = 1 if structure == "ss" else 3
    options = ["--structure", structure, "--orders", *orders, "--delay", delay, "--search", "quick"]
    found = answer(capfd, data, *options)
    assert found["fit_percent"] > 80


def test_regularised_impulse_response_with_a_disturbance(data, capfd, tmp_path) -> None:
    options = ["--structure", "fir", "--orders", 30, "--delay", 3, "--regularisation", "tc"]
    extra = ["--disturbance", "ar1", "--folds", 3, "--skip", 20, "--out", tmp_path / "fit"]
    found = answer(capfd, data, *options, *extra)
    assert [found["parameters"][x][0] for x in ("b3", "b4")] == pytest.approx([0.5, 0.8], abs=0.05)
    assert found["regularisation"]["kernel"] == "tc"
    assert found["held_out"]["simulation_rmse"] == pytest.approx(0.1, rel=0.3)
    model = model_from_json((tmp_path / "fit" / "model.json").read_text())
    assert model.theta[0] == found["parameters"]["b3"][0]
    assert main(["identify", str(data), "--regularisation", "tc"]) == 2
    assert "take fir" in capfd.readouterr().err


def test_missing_samples_and_outliers(data, capfd) -> None:
    lines = data.read_text().splitlines()
    for k in range(50, 400, 9):
        lines[k] = lines[k].rsplit(",", 1)[0] + ",nan"
    data.write_text("\n".join(lines) + "\n")
    assert main(["identify", str(data), "--delay", "3"]) == 2
    assert "not finite" in capfd.readouterr().err
    found = answer(capfd, data, "--delay", 3, "--missing")
    value, error = found["parameters"]["b3"]
    assert abs(value - 0.5) < 4.5 * error
    assert found["residual_tests"] == {}
    assert found["simulation_fit_percent"] == pytest.approx(found["fit_percent"], abs=1)
    half = answer(capfd, f"{data}[:200]", "--delay", 3, "--missing", "--test", f"{data}[200:]", "--skip", 20)[
        "test"
    ]
    assert half["simulation_rmse"] == pytest.approx(half["prediction_rmse"], rel=0.05)


def test_robust_loss(data, capfd) -> None:
    lines = data.read_text().splitlines()
    for k in range(50, 400, 40):
        lines[k] = lines[k].rsplit(",", 1)[0] + ",60"
    data.write_text("\n".join(lines) + "\n")
    found = answer(capfd, data, "--delay", 3, "--robust", "student")
    value, error = found["parameters"]["b3"]
    assert abs(value - 0.5) < 4.5 * error


def test_several_files_and_output_folder(data, capfd, tmp_path) -> None:
    out = tmp_path / "new"
    found = answer(capfd, f"{data}[:200]", f"{data}[200:]", "--delay", 3, "--out", out)
    model = model_from_json((out / "model.json").read_text())
    assert dict(zip(model.names, model.theta, strict=True)) == {
        k: v[0] for k, v in found["parameters"].items()
    }
    assert len((out / "residuals.csv").read_text().splitlines()) == 401
    assert main(["identify", str(data), "--out", str(out)]) == 2
    assert "already holds" in capfd.readouterr().err


@pytest.mark.parametrize(
    "arguments, words",
    [
        (["--orders", "2"], "oe takes nb nf"),
        (["--delay", "x"], "whole number"),
        (["--delay", "-1"], "causal"),
        (["--inputs", "v"], "v"),
    ],
)
def test_bad_input_is_one_line_and_status_2(data, capfd, arguments, words) -> None:
    assert main(["identify", str(data), *arguments]) == 2
    said = capfd.readouterr().err.strip()
    assert words in said
    assert len(said.splitlines()) == 1


@pytest.mark.parametrize("command", ["identify", "diagnose"])
def test_rows_given_twice_are_not_counted_twice(data, capfd, command) -> None:
    """The same file twice had made every standard error too small by a factor of 1.4, in silence."""
    for second, rows in ((str(data), 400), (f"{data}[300:]", 100)):
        assert main([command, str(data), second]) == 2
        assert f"{rows} consecutive rows of record 2 are also in record 1" in capfd.readouterr().err


def test_what_was_fitted_is_no_fresh_data(data, capfd, tmp_path) -> None:
    assert main(["identify", f"{data}[:300]", "--test", f"{data}[200:]"]) == 2
    assert "100 consecutive rows of the test record are also in the training record" in capfd.readouterr().err
    slow = tmp_path / "slow.csv"
    slow.write_text("t,u,y\n" + "".join(f"{k},{k % 3},{k % 5}\n" for k in range(60)))
    fast = tmp_path / "fast.csv"
    fast.write_text("t,u,y\n" + "".join(f"{k / 10},{k % 3},{k % 7}\n" for k in range(60)))
    assert main(["identify", str(slow), "--test", str(fast)]) == 2
    assert "the sampling times are 1 and 0.1 s" in capfd.readouterr().err


def test_the_first_line_says_where_the_gain_is_not_told(tmp_path, rng, capfd) -> None:
    noise = tmp_path / "noise.csv"
    rows = np.column_stack([np.arange(300), rng.standard_normal((300, 2))])
    np.savetxt(noise, rows, delimiter=",", header="t,u,y", comments="")
    assert main(["identify", str(noise), "--orders", "1", "1", "--quiet"]) == 0
    assert capfd.readouterr().out.startswith("WARNING: these data do not tell the gain (")


def test_text_names_what_matters(data, capfd) -> None:
    assert main(["identify", str(data), "--delay", "3", "--quiet"]) == 0
    said = capfd.readouterr().out
    for words in (
        "b3",
        "peak gain",
        "  G(z) = (",
        " / (1 - 1.",
        "poles: ",
        "time constant",
        "one sample every",
        "residual tests",
        "noise variance",
        "level of y",
    ):
        assert words in said


def test_what_the_data_suffer_from_is_told(data, capfd) -> None:
    """The offset of u and a spike of y; the record that is fitted is the one that was given."""
    lines = data.read_text().splitlines()
    lines[201] = lines[201].rsplit(",", 1)[0] + ",60"
    data.write_text("\n".join(lines) + "\n")
    found = answer(capfd, data, "--delay", 3)
    assert {("offset", "u"), ("outliers", "y")} <= {(d["kind"], d["channel"]) for d in found["data_defects"]}
    assert main(["identify", str(data), "--delay", "3"]) == 0
    assert "left as it is" in capfd.readouterr().out


def test_first_test_samples_are_left_out(data, capfd) -> None:
    """From rest in the middle of a record the first samples are wrong; a window sets the state."""
    split = [f"{data}[:200]", "--delay", 3, "--test", f"{data}[200:]"]
    rest, window = answer(capfd, *split)["test"], answer(capfd, *split, "--skip", 20)["test"]
    assert window["simulation_rmse"] < rest["simulation_rmse"]
    assert (rest["skipped"], window["skipped"]) == (0, 20)
    assert main(["identify", *map(str, split), "--skip", "200"]) == 2
    assert "--skip 200" in capfd.readouterr().err


def test_subspace_method(data, capfd) -> None:
    options = ("--structure", "ss", "--orders", 5, "--method", "moesp", "--horizon", 12)
    found = answer(capfd, data, *options)
    assert found["fit_percent"] > 80
    assert (found["subspace"]["method"], found["subspace"]["horizon"]) == ("moesp", 12)
    assert main(["identify", str(data), "--method", "moesp"]) == 2
    assert 'take the structure "ss" instead of oe' in capfd.readouterr().err


def test_a_mean_is_no_complaint_where_the_level_is_estimated(data, capfd) -> None:
    """The payload keeps what was seen; a reader is told only of what the call does not answer."""
    for options, told in (((), False), (("--no-offset", "--initial", "estimate"), True)):
        assert main(["identify", str(data), "--delay", "3", *options]) == 0
        assert ("u: the mean is" in capfd.readouterr().out) is told
    assert "offset" in {d["kind"] for d in answer(capfd, data, "--delay", 3)["data_defects"]}
