"""`oed iterate` at the command line: the keys, the files, and bad input in one line."""

from __future__ import annotations

import json

import numpy as np
import pytest

from benchmarks.cli import main


def iterate(capsys, *arguments):
    status = main(["iterate", *arguments, "--quiet"])
    captured = capsys.readouterr()
    return status, captured.out, captured.err


def test_keys_and_files(capfd, tmp_path):
    for ending in ("npz", "csv"):
        out = str(tmp_path / f"runs.{ending}")
        arguments = (
            "--samples",
            "300",
            "--iterations",
            "12",
            "--noise-variance",
            "0.1",
            "--json",
            "--out",
            out,
        )
        status, text, _ = iterate(capfd, *arguments)
        assert status == 0
        payload = json.loads(text)
        assert set(payload) >= {
            "gain",
            "estimate",
            "frequency",
            "direction",
            "experiments_used",
            "energy",
            "status",
        }
        assert len(payload["gain"]["gain"]) == len(payload["gain"]["mu"]) == 12
        assert payload["gain"]["gain"][0] is None
        assert payload["estimate"] == payload["gain"]["gain"][-1]
        assert payload["experiments_used"] == 12
        assert payload["energy"] == pytest.approx(3600)
        assert payload["corrected"][0] == pytest.approx(2.41, abs=0.1)
        assert iterate(capfd, *arguments)[0] == 2  # nothing is overwritten
    stored = np.load(tmp_path / "runs.npz")
    assert stored["u"].shape == stored["y"].shape == (12, 300, 1)
    table = np.loadtxt(tmp_path / "runs.csv", delimiter=",", skiprows=1)
    np.testing.assert_array_equal(table[:300, 2], stored["u"][0, :, 0])


def test_vibration_isolation(capfd):
    """[M]: 121 Hz and not 296, and a gain above the 1.95 of 296 Hz."""
    status, text, _ = iterate(
        capfd, "--plant", "avis", "--algorithm", "mimo", "--samples", "2000", "--iterations", "40",
        "--noise-variance", "0.01", "--json",
    )  # fmt: skip
    payload = json.loads(text)
    assert status == 0
    assert payload["frequency_hz"] == pytest.approx(121, abs=0.5)
    assert payload["estimate"] > 1.95
    assert payload["experiments_used"] == 200
    a, b = (np.hypot(*pair) for pair in payload["direction"])
    assert 0.5 < a / b < 2


def test_until_settled(capfd):
    arguments = (
        "--samples",
        "300",
        "--iterations",
        "900",
        "--noise-variance",
        "0.5",
        "--json",
        "--until-settled",
    )
    payload = json.loads(iterate(capfd, *arguments)[1])
    assert payload["status"] == "CONVERGED"
    assert payload["experiments_used"] < 900


@pytest.mark.parametrize(
    "arguments, words",
    [
        (("--plant", "referense"), "did you mean reference"),
        (("--iterations", "0"), "must be at least 1"),
        (("--samples", "1"), "samples is 1"),
        (("--noise-variance", "-1"), "noise"),
        (("--plant", "avis", "--algorithm", "siso"), "procedure_2"),
        (("--plant", "avis", "--algorithm", "two-experiment"), "one input and one output"),
        (("--out", "somewhere.txt"), "must end in .npz or .csv"),
    ],
)
def test_bad_input_is_one_line_and_exit_2(capfd, arguments, words):
    status, out, err = iterate(capfd, *arguments)
    assert (status, out) == (2, "")
    assert words in err
    assert err.count("\n") == 1
