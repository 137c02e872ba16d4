"""The pages that commands write: identification, design and session, each with its answer and the numbers of the result."""

from __future__ import annotations

import json

import numpy as np
import pytest
from scipy.signal import lfilter

from benchmarks.cli import main
from benchmarks.page.serve import page_of
from benchmarks.readme import session_picture
from estimators.residual.measures import p_stated
from estimators.sessions import Settings, start_session
from oed.errors import InputError
from oed.experiments import simulated
from oed.plants.named import named_plant


def told(folder) -> tuple[dict, dict]:
    """What report.json holds, and its tables by name."""
    content = json.loads((folder / "report.json").read_text())
    assert (folder / "report.html").read_text().startswith("<!doctype html>")
    return content, {t["name"]: t["rows"] for s in content["sections"] for t in s["tables"]}


@pytest.mark.slow
def test_identification(tmp_path, capfd):
    rng = np.random.default_rng(1)
    u = rng.standard_normal(300)
    y = lfilter([0, 0.5, 0.2], [1, -1.2, 0.6], u) + 0.1 * rng.standard_normal(300)
    np.savetxt(
        tmp_path / "r.csv",
        np.column_stack([np.arange(300) * 0.1, u, y]),
        delimiter=",",
        header="t,u,y",
        comments="",
    )
    assert (
        main(
            [
                "identify",
                str(tmp_path / "r.csv"),
                "--out",
                str(tmp_path / "out"),
                "--json",
                "--search",
                "quick",
            ]
        )
        == 0
    )
    found = json.loads(capfd.readouterr().out)
    content, tables = told(tmp_path / "out")
    assert f"{found['simulation_fit_percent']:.1f} % of the output" in content["answer"]
    assert {r["parameter"]: r["value"] for r in tables["parameters"]} == {
        k: v for k, (v, _) in found["parameters"].items()
    }
    assert [r["p"] for r in tables["residual_tests"]] == [
        p_stated(p) for p in found["residual_tests"].values()
    ]
    assert "in y/u" in next(s for s in content["sections"] if s["title"] == "Parameters")["text"][0]
    pole = np.roots([1, -1.2, 0.6])[0]
    assert tables["poles"][0]["frequency_hz"] == pytest.approx(abs(np.log(pole)) / (0.2 * np.pi), rel=0.1)
    figures = {f["name"]: f["rows"] for s in content["sections"] for f in s["figures"]}
    assert set(figures) == {"gain", "phase", "step", "poles", "residuals", "orders"}
    gain = max(figures["gain"], key=lambda r: r["y"])
    assert gain["y"] == pytest.approx(found["hinf_norm"][0], rel=0.01)
    assert gain["x"] == pytest.approx(found["hinf_frequency_hz"], rel=0.05)
    best = min((r for r in figures["orders"] if r["series"] != "this model"), key=lambda r: r["y"])
    assert best["x"] == 2


def test_a_model_that_fails_on_fresh_data_says_so_first(tmp_path):
    """The share of the data fitted stood alone in the answer beside -6510 % on fresh data."""
    rng = np.random.default_rng(1)
    u = rng.standard_normal((2, 200))
    y = lfilter([0, 0.5], [1, -0.8], u) * [[1], [-1]] + 0.1 * rng.standard_normal((2, 200))
    files = [str(tmp_path / f"{k}.csv") for k in range(2)]
    for file, pair in zip(files, zip(u, y, strict=True), strict=True):
        np.savetxt(file, np.column_stack(pair), delimiter=",", header="u,y", comments="")
    options = ["--structure", "arx", "--orders", "1", "1", "--out", str(tmp_path / "out"), "--quiet"]
    assert main(["identify", files[0], "--test", files[1], *options]) == 0
    content, _ = told(tmp_path / "out")
    assert content["answer"].endswith("on fresh data it is worse than a constant.")
    assert not any("Use the model" in words for words in content["todo"])


def test_a_gain_that_is_not_told_is_said_and_channels_have_their_names(tmp_path):
    """The page asked to use a model whose gain was 31850 +- 480000000; its curves were "input 1 to output 1"."""
    rng = np.random.default_rng(1)
    u, noise = rng.standard_normal((200, 2)), rng.standard_normal(200)
    np.savetxt(
        tmp_path / "r.csv", np.column_stack([u, noise]), delimiter=",", header="valve,fan,flow", comments=""
    )
    words = ["--inputs", "valve,fan", "--outputs", "flow", "--structure", "arx", "--orders", "1", "1"]
    assert main(["identify", str(tmp_path / "r.csv"), *words, "--out", str(tmp_path / "out"), "--quiet"]) == 0
    content, _ = told(tmp_path / "out")
    assert content["answer"].endswith("these data do not tell its largest gain.")
    assert content["todo"][-1].startswith(
        "Before this model is used, check that inputs and outputs are not swapped"
    )
    drawn = {f["name"]: f["rows"] for s in content["sections"] for f in s["figures"]}
    assert {row["series"] for row in drawn["gain"]} == {"valve to flow", "fan to flow"}


def test_design(tmp_path, capfd):
    words = [
        "design",
        "--plant",
        "reference",
        "--criterion",
        "hinf",
        "--realise",
        "200",
        "--out",
        str(tmp_path / "new"),
    ]
    assert main([*words, "--json"]) == 0
    found = json.loads(capfd.readouterr().out)
    content, tables = told(tmp_path / "new")
    assert len(np.loadtxt(tmp_path / "new" / "input.csv", delimiter=",", skiprows=1)) == 200
    assert json.loads((tmp_path / "new" / "design.json").read_text())["loss"] == found["loss"]
    share = {r["input"]: r["efficiency"] for r in tables["alternatives"]}
    assert share["white noise"] == pytest.approx(found["efficiency_white"])
    assert share["one sinusoid at the peak"] == pytest.approx(
        1, abs=1e-6
    )  # the optimum for the peak gain, by theory
    assert share["white noise"] < share["power iterations, in the limit"] < 1
    sensitivity = [
        r for s in content["sections"] for f in s["figures"] if f["name"] == "sensitivity" for r in f["rows"]
    ]
    assert max(r["y"] for r in sensitivity) <= 1 + 1e-9
    assert all(r["y"] == pytest.approx(1, abs=1e-6) for r in sensitivity if r["series"] == "support")
    assert main([*words, "--quiet"]) == 2  # nothing is overwritten


def test_the_picture_of_the_readme_is_the_same_every_time(tmp_path):
    files = [tmp_path / "one" / "session.svg", tmp_path / "two" / "session.svg"]
    for file in files:
        file.parent.mkdir()
        session_picture(file)
    text = files[0].read_text()
    assert text == files[1].read_text()
    for words in ("position (mm)", "95 % interval", "own gain"):
        assert words in text


@pytest.mark.slow
def test_session(tmp_path):
    session = start_session(
        tmp_path / "rig",
        Settings(
            "power",
            samples=200,
            experiments=3,
            dt=0.01,
            amplitude=(2.0,),
            input_units=("N",),
            output_units=("mm",),
        ),
    )
    assert "no estimate yet: 0 of 3" in page_of(tmp_path / "rig").answer
    rig = simulated(named_plant("reference", 0.01), seed=1)
    session.run(rig)
    before = sorted(p.name for p in (tmp_path / "rig").iterdir())
    page = page_of(tmp_path / "rig")
    assert sorted(p.name for p in (tmp_path / "rig").iterdir()) == before
    assert page.progress == (3, 3)
    found = session.estimate()
    assert f"{found.value:.4g} mm/N" in page.answer
    assert f"{found.interval[0]:.4g} to {found.interval[1]:.4g}" in page.answer
    assert {r["limit"]: r["value"] for r in page.tables[1].rows}["deviation from the level, at most"] == "2 N"
    (last,) = [r for r in page.hero[0].rows if r["series"].startswith("estimate") and r["x"] == 3]
    assert (last["y"], last["low"], last["high"]) == (found.value, *found.interval)
    assert max(r["high"] for r in page.hero[0].rows if "high" in r) <= 3 * found.value
    assert [r["experiment"] for r in page.tables[0].rows] == [1, 2, 3]
    assert main(["report", str(tmp_path / "rig")]) == 0
    assert "after 3 of 3 experiments" in (tmp_path / "rig" / "report.html").read_text()


def test_a_campaign_that_runs_is_followed_and_no_result_is_refused(tmp_path):
    (tmp_path / "campaign.json").write_text("{}")
    (tmp_path / "progress.json").write_text(json.dumps({"done": 3, "total": 10}))
    page = page_of(tmp_path)
    assert page.progress == (3, 10)
    assert "3 of 10 parts" in page.answer
    (tmp_path / "campaign.json").unlink()
    with pytest.raises(InputError, match=r"has no report.json"):
        page_of(tmp_path)
