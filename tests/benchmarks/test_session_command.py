"""`oed session` at the command line: the keys of every step, bad input in one line, and the model error on a rig."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from benchmarks.cli import main
from oed.experiments import simulated
from oed.plants.named import named_plant
from oed.plants.norms import peak
from oed.plants.plant import Plant

KEYS = {"schema_version", "step", "input", "output", "estimate", "interval", "frequency", "status"}


def oed(capfd, *words: str, status: int = 0) -> dict:
    assert main(["session", *words, "--json"]) == status
    return json.loads(capfd.readouterr().out)


def refused(capfd, *words: str) -> str:
    assert main(["session", *words]) == 2
    captured = capfd.readouterr()
    assert captured.out == ""
    assert captured.err.count("\n") == 1
    return captured.err


def rig(given: str, out: Path, apply) -> str:
    data = np.loadtxt(given, delimiter=",", skiprows=1, ndmin=2)
    y = apply(data[:, 1:])
    names = ",".join(f"y{k + 1}" for k in range(y.shape[1])) if y.shape[1] > 1 else "y"
    rows = [",".join(map(repr, row)) for row in np.column_stack([data[:, 0], y]).tolist()]
    out.write_text("\n".join([f"t_s,{names}", *rows]) + "\n")
    return str(out)


def test_a_session_from_start_to_estimate(capfd, tmp_path):
    folder, out = str(tmp_path / "rig"), tmp_path / "measured.csv"
    apply = simulated(named_plant("reference", 0.01), seed=1)
    started = oed(
        capfd, "start", folder, "--method", "power", "--samples", "200", "--dt", "0.01", "--experiments", "4",
        "--inputs", "force_N", "--outputs", "y_mm", "--amplitude", "2", "--seed", "6",
    )  # fmt: skip
    assert set(started) >= KEYS
    assert (started["step"], started["status"], started["estimate"]) == (1, "READY", None)
    for step in range(1, 5):
        asked = oed(capfd, "next", folder)
        assert (asked["step"], asked["status"], asked["rows"]) == (step, "WAITING", 200)
        assert Path(asked["input"]).read_text().startswith("t_s,force_N\n")
        assert oed(capfd, "next", folder)["input"] == asked["input"]
        stored = oed(capfd, "record", folder, rig(asked["input"], out, apply))
        assert stored["recorded"] == step
        assert stored["interval"][0] < stored["estimate"] < stored["interval"][1]
    ended = oed(capfd, "next", folder)
    assert (ended["step"], ended["input"], ended["status"]) == (None, None, "BUDGET")
    found = oed(capfd, "estimate", folder)
    true = peak(named_plant("reference")).value
    assert abs(found["estimate"] - true) < 4 * found["standard_error"]
    assert found["frequency_hz"] == pytest.approx(0.98899 / (2 * np.pi * 0.01), rel=1e-3)
    assert oed(capfd, "status", folder)["peak"] <= 2 * (1 + 1e-9)
    assert json.loads((tmp_path / "rig" / "session.json").read_text())["seed"] == 6
    assert main(["session", "status", folder]) == 0
    assert "peak gain" in capfd.readouterr().out


@pytest.mark.parametrize(
    "words, sentence",
    [
        (("next", "nowhere"), "there is no session in nowhere"),
        (("start", "s", "--method", "power", "--samples", "2", "--dt", "1"), "samples is 2"),
        (
            ("start", "s", "--method", "power", "--samples", "20", "--dt", "1", "--amplitude", "1,2"),
            "amplitude",
        ),
        (
            ("start", "s", "--method", "power", "--samples", "20", "--dt", "1", "--model", "no.json"),
            "no.json",
        ),
        (("start", "s", "--method", "powr", "--samples", "20", "--dt", "1"), "invalid choice"),
        (("start", "s", "--method", "power", "--samples", "20", "--dt", "1", "--rate", "x"), "--rate"),
        (("start",), "required"),
    ],
)
def test_bad_input_is_one_line_and_nothing_is_written(words, sentence, tmp_path, capfd, monkeypatch):
    monkeypatch.chdir(tmp_path)
    try:
        status = main(["session", *words])
    except SystemExit as stopped:
        status = stopped.code
    captured = capfd.readouterr()
    assert (status, captured.out, captured.err.count("\n")) == (2, "", 1)
    error = captured.err
    assert sentence in error
    assert not list(tmp_path.iterdir())


def test_the_rest_test_warns_at_every_step_and_status_draws(capfd, tmp_path):
    folder, out = str(tmp_path / "rig"), tmp_path / "measured.csv"
    apply = simulated(named_plant("reference", 1e-4), seed=1)
    offset = lambda u: apply(u) + 5
    start = [
        "start",
        folder,
        "--method",
        "power",
        "--samples",
        "300",
        "--dt",
        "0.01",
        "--amplitude",
        "2",
        "--range=-9:9",
    ]
    assert main(["session", *start, "--experiments", "5"]) == 0
    assert "no rest test yet: oed session rest" in capfd.readouterr().out
    assert main(["session", "next", folder]) == 0
    assert "no rest test yet" in capfd.readouterr().out
    given = oed(capfd, "rest", folder)["rest_input"]
    found = oed(capfd, "rest", folder, rig(given, out, offset))
    assert found["rest"]["level"][0] == pytest.approx(5, abs=0.01)
    assert any("rests at" in words for words in found["warnings"])
    drawn = "\n".join(_told(capfd, "status", folder))
    assert "rests at" in drawn
    assert "own gain" not in drawn
    for step in range(1, 5):
        asked = oed(capfd, "next", folder)
        assert (asked["rows"], asked["rate_hz"], asked["seconds_left"]) == (300, 100.0, 3.0 * (6 - step))
        assert not asked["warnings"]
        oed(capfd, "record", folder, rig(asked["input"], out, apply))
    told = _told(capfd, "status", folder, "--picture", str(tmp_path / "s.svg"))
    assert "300 rows at 100 Hz, 3 s each; at most 1 left, 3 s" in told
    assert any(line.endswith("*") for line in told)
    assert " Hz, by " in "".join(told)
    assert (tmp_path / "s.svg").read_text().count("<svg") == 1
    page = oed(capfd, "status", folder, "--picture", str(tmp_path / "s.html"))["picture"]
    assert "rests at" in Path(page).read_text()
    assert "ends in .html" in refused(capfd, "status", folder, "--picture", "s.doc")


def _told(capfd, *words: str) -> list[str]:
    assert main(["session", *words]) == 0
    return capfd.readouterr().out.splitlines()


@pytest.mark.parametrize("step", ["start", "rest", "next", "record", "status", "estimate"])
def test_every_step_has_help_with_an_example(step, capfd):
    with pytest.raises(SystemExit) as stopped:
        main(["session", step, "--help"])
    assert stopped.value.code == 0
    out = capfd.readouterr().out
    assert "example: oed session" in out
    for option in ("--json", "--seed", "--quiet"):
        assert option in out


def test_a_bad_measurement_is_refused_at_the_command_line(capfd, tmp_path):
    folder, out = str(tmp_path / "rig"), tmp_path / "measured.csv"
    oed(capfd, "start", folder, "--method", "power", "--samples", "50", "--dt", "1", "--abort", "3")
    plant = named_plant("reference", 0.0)
    given = oed(capfd, "next", folder)["input"]
    assert "beyond its abort level 3" in refused(
        capfd, "record", folder, rig(given, out, lambda u: 20 * plant.simulate(u))
    )
    reduced = oed(capfd, "next", folder, "--reduce")
    assert reduced["input"].endswith("input-0001-2.csv")
    assert reduced["factor"] == 0.5
    assert "too few samples" in refused(capfd, "record", folder, cut(given, out))
    assert oed(capfd, "status", folder)["flagged"] == [str(Path(folder) / "flagged-0001-1.csv")]


def cut(given: str, out: Path) -> str:
    rig(given, out, lambda u: u)
    out.write_text("\n".join(out.read_text().splitlines()[:20]) + "\n")
    return str(out)


@pytest.mark.slow
def test_the_error_of_a_model_on_the_vibration_isolation_rig(capfd, tmp_path):
    """[M] Sec. IV: two inputs, two outputs; the model lacks the mode at 121 Hz, and the session says so."""
    avis = named_plant("avis", 1e-4)
    from oed.plants.json import plant_to_json

    model = without_the_mode(avis, 121.0)
    file = tmp_path / "model.json"
    file.write_text(json.dumps(plant_to_json(model)))
    folder, out = str(tmp_path / "rig"), tmp_path / "measured.csv"
    oed(
        capfd, "start", folder, "--method", "procedure-2", "--samples", "500", "--dt", "0.001", "--inputs", "u1,u2",
        "--outputs", "y1,y2", "--experiments", "20", "--model", str(file),
    )  # fmt: skip
    apply = simulated(avis, seed=2)
    while (asked := oed(capfd, "next", folder))["input"]:
        oed(capfd, "record", folder, rig(asked["input"], out, apply))
    found = oed(capfd, "estimate", folder, "--diagnose")
    # what was left out is the mode itself: gain 1.997 at 121 Hz, input direction 50 degrees
    assert abs(found["estimate"] - 1.997) < 4 * found["standard_error"]
    assert found["standard_error"] < 0.02
    assert found["interval"][0] < 1.997 < found["interval"][1]
    assert found["frequency_hz"] == pytest.approx(121, abs=0.5)
    direction = np.array([complex(*d) for d in found["direction"]])
    mode = np.array([np.cos(np.deg2rad(50)), np.sin(np.deg2rad(50))])
    assert abs(abs(np.vdot(direction, mode)) - 1) < 0.01
    cause = found["diagnosis"]
    assert cause["cause"] == "mode"
    assert cause["parameters"]["frequency"] / (2 * np.pi * 0.001) == pytest.approx(121, abs=1)
    assert cause["error_after"] < 0.1 * cause["error_before"]
    assert cause["error_after"] == pytest.approx(0.01, rel=0.2)  # the noise


def without_the_mode(avis: Plant, hertz: float) -> Plant:
    """The plant as the sum of its two modes, less one: residues at its poles."""
    num, den = [], []
    for B, A in zip(avis.num, avis.den, strict=True):
        row_num, row_den = [], []
        for b, a in zip(B, A, strict=True):
            poles = np.roots(a)
            near = np.argsort(np.abs(np.abs(np.angle(poles)) - 2 * np.pi * hertz * avis.dt))
            gone, kept = np.poly(poles[near[:2]]).real, np.poly(poles[near[2:]]).real
            # b = (x0 gone + x1 kept) (z^-1 - z^-3): two unknowns, solved exactly
            X = np.array([np.convolve([0, 1, 0, -1], part) for part in (gone, kept)]).T
            x, rest = np.linalg.lstsq(X, b, rcond=None)[:2]
            assert np.all(rest < 1e-20)
            row_num.append((x[0] * np.array([0, 1, 0, -1])).tolist())
            row_den.append(kept.tolist())
        num.append(row_num)
        den.append(row_den)
    return Plant(num, den, dt=avis.dt, noise_covariance=0.0, name="model")


def test_undo_keeps_what_it_takes_back_and_watch_goes_on(capfd, tmp_path):
    """After undo the same output leads to the same next input, bit for bit; a watched folder ends the session, and a file
    that is no output is refused in a line."""
    folder, inbox = str(tmp_path / "rig"), tmp_path / "inbox"
    inbox.mkdir()
    apply = simulated(named_plant("reference", 0.01), seed=1)
    oed(capfd, "start", folder, "--method", "power", "--samples", "100", "--dt", "0.01", "--experiments", "2")
    assert "nothing is recorded" in refused(capfd, "undo", folder)
    first = oed(capfd, "next", folder)["input"]
    measured = rig(first, tmp_path / "m.csv", apply)
    oed(capfd, "record", folder, measured)
    second = Path(oed(capfd, "next", folder)["input"])
    content = second.read_bytes()
    assert main(["session", "undo", folder]) == 0
    said = capfd.readouterr().out
    assert "step 1 waits again for the output of" in said
    assert f"do not apply {second}" in said
    assert (tmp_path / "rig" / "undone-output-0001-1.csv").read_bytes()
    assert oed(capfd, "status", folder)["status"] == "WAITING"
    (inbox / "notes.csv").write_text("a,b\n1,2\n")
    Path(measured).rename(inbox / "one.csv")
    taken = oed(capfd, "watch", folder, str(inbox), "--once")["events"]
    assert sum("is not used" in words for words in taken) == 1
    assert second.read_bytes() == content
    rig(str(second), inbox / "two.csv", apply)
    assert oed(capfd, "watch", folder, str(inbox), "--once", "--quiet")["status"] == "BUDGET"
    assert main(["session", "next", folder]) == 0
    assert "finished" in capfd.readouterr().out
    assert "no folder" in refused(capfd, "watch", folder, str(tmp_path / "none"))
