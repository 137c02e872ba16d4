"""What a newcomer meets: `oed` alone, a misspelt command, demo, plants, effects, data, plot."""

from __future__ import annotations

import json
import re
import shlex
from pathlib import Path

import pytest

from benchmarks.cli import main


def test_alone_prints_the_help(capfd):
    assert main([]) == 0
    assert "diagnose" in capfd.readouterr().out


def test_a_misspelt_command_gets_a_hint(capfd):
    assert main(["identfy"]) == 2
    said = capfd.readouterr().err
    assert "did you mean identify" in said
    assert said.count("\n") == 1


def test_plants_have_the_norms_of_the_theory(capfd):
    assert main(["plants", "--json"]) == 0
    rows = {row["name"]: row for row in json.loads(capfd.readouterr().out)["rows"]}
    assert rows["reference"]["norm"] == pytest.approx(2.411554068769, rel=1e-10)
    assert (rows["three-by-two"]["outputs"], rows["three-by-two"]["inputs"]) == (3, 2)


def test_effects_are_those_of_the_catalogue(capfd):
    from estimators.diagnosis.effects import CATALOGUE

    assert main(["effects", "--json"]) == 0
    assert [row["name"] for row in json.loads(capfd.readouterr().out)["rows"]] == [e.key for e in CATALOGUE]
    assert main(["effects", "--nature", "magic"]) == 2
    assert "no nature named" in capfd.readouterr().err


def test_the_demo_can_be_copied_line_by_line(tmp_path, monkeypatch, capfd):
    """Every command of the demo that takes under ten seconds is run as printed; a second demo does not overwrite the first."""
    assert main(["demo", str(tmp_path / "try")]) == 0
    assert main(["demo", str(tmp_path / "try")]) == 2
    monkeypatch.chdir(tmp_path / "try")
    commands = (tmp_path / "try" / "commands.sh").read_text().splitlines()
    quick = [shlex.split(line)[1:] for line in commands if line.startswith("oed")]
    quick = [words for words in quick if words[0] in ("identify", "design", "theory", "session")]
    assert len(quick) >= 6
    pasted = (Path(__file__).parents[2] / "docs" / "start.md").read_text()
    shown = dict(re.findall(r"^\$ oed (.*)\n(?:\.\.\.\n)?(.*)", pasted, re.M))
    for line in shown:  # what is pasted is what the demo says to run
        assert any(shlex.split(line) == shlex.split(command)[1:] for command in commands if command)
    for words in quick:
        capfd.readouterr()
        assert main(words) == 0, (words, capfd.readouterr().err)
        said = capfd.readouterr().out
        for line, answer in shown.items():
            assert shlex.split(line) != words or answer in said, (line, said)


def test_data_says_what_is_missing(tmp_path, capfd):
    assert main(["data", "silverbox", "--from", str(tmp_path)]) == 2
    assert "silverbox_snls80mv.csv.gz is not there" in capfd.readouterr().err
    assert main(["data", "--from", str(tmp_path), "--json"]) == 0
    assert not any(row["there"] for row in json.loads(capfd.readouterr().out)["rows"])


def test_data_finds_the_shared_records(shared_data, capfd):
    assert main(["data", "emps", "--from", str(shared_data / "emps"), "--json"]) == 0
    assert json.loads(capfd.readouterr().out)["rows"][0]["there"]


@pytest.mark.parametrize("figure", ["bode", "poles", "step", "residuals", "compare"])
def test_plot_draws(figure, tmp_path, capfd):
    from benchmarks.campaign.plants import hair_dryer_record
    from oed import write_record

    write_record(hair_dryer_record()[:300], str(tmp_path / "r.csv"))
    words = [
        "plot",
        str(tmp_path / "r.csv"),
        "--delay",
        "auto" if figure == "bode" else "3",
        "--figure",
        figure,
        "--out",
        str(tmp_path / "f.svg"),
    ]
    assert main(words) == 0
    text = (tmp_path / "f.svg").read_text()
    assert text.count("<path") > 5
    assert main([*words[:-1], str(tmp_path / "f.bmp")]) == 2


def test_several_structures_are_compared_as_a_table_and_a_figure(tmp_path, capfd):
    from benchmarks.campaign.plants import hair_dryer_record
    from oed import write_record

    record = hair_dryer_record()
    write_record(record[:300], str(tmp_path / "a.csv"))
    write_record(record[300:600], str(tmp_path / "b.csv"))
    words = [
        "plot",
        str(tmp_path / "a.csv"),
        "--structure",
        "oe",
        "arx",
        "--delay",
        "3",
        "--figure",
        "compare",
    ]
    words += ["--test", str(tmp_path / "b.csv"), "--out", str(tmp_path / "f.svg")]
    assert main([*words, "--json"]) == 0
    rows = json.loads(capfd.readouterr().out)["rows"]
    assert {row["model"] for row in rows} == {"oe", "arx"}
    assert rows[0]["simulation_rmse"] <= rows[1]["simulation_rmse"]
    assert main(words) == 0
    assert "one-step fit %" in capfd.readouterr().out
    assert main([*words, "--orders", "2", "2"]) == 2
    assert "several are for --figure compare" in capfd.readouterr().err
