"""Every example of --help runs as printed, in a folder that holds what it names; and mistakes at the command line are one line."""

from __future__ import annotations

import json
import re
import shlex
from importlib import import_module

import pytest

from benchmarks.campaign.plants import hair_dryer_record
from benchmarks.cli import _modules, _parser, main
from benchmarks.page.content import Page
from benchmarks.page.skeleton import save_page
from oed import write_record

EXAMPLES = {name: import_module(module).EXAMPLE for name, module in _modules().items()}
LONG = ("compare", "diagnose", "diagnose-folder", "speed", "reproduce")
"""Minutes; of these only that they are understood as printed (each runs in a test of its own)."""
ABSENT = ("data",)
"""What they read is not ours to ship: they say so."""


@pytest.fixture
def folder(tmp_path, monkeypatch):
    write_record(hair_dryer_record()[:400], str(tmp_path / "record.csv"))
    (tmp_path / "results" / "compare").mkdir(parents=True)
    save_page(tmp_path / "results" / "compare", Page("comparison", "t", "a"))
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("HOME", str(tmp_path))
    return tmp_path


@pytest.mark.parametrize("name", EXAMPLES)
def test_the_example_of_help_runs_as_printed(name, folder, capfd):
    words = shlex.split(EXAMPLES[name])
    assert words[:2] == ["oed", name]
    args, unknown = _parser().parse_known_args(words[1:])
    assert not unknown
    assert args.command == name
    if name in LONG:
        return
    assert main(words[1:]) == (2 if name in ABSENT else 0), capfd.readouterr().err
    if name in ABSENT:
        assert "is not there; put" in capfd.readouterr().err


MISTAKES = {
    "identify record.csv --structure oe --orders a b": "it is 'a'; it must be a whole number or auto",
    "identify record.csv --orders 2,2": "a whole number or auto, several written apart (2 2)",
    "identify record.csv --inputs u v": "v is not understood (several names are one word with commas",
    "diagnose record.csv --skip 9": "--skip is of the test record; give --test, or leave it out",
    "design --plant diagnosed.json": "is the model of a diagnosis, whose effects no plant holds; take a linear model",
    "plot model.json --out a.svg": "give the record, or open report.html beside the model",
    "compare --plant reference --against here": "here holds no comparison.csv; give a folder of results",
    "compare --plant reference --methods own.py:f": "No such file or directory); check the name and the folder",
}


@pytest.mark.parametrize("line", MISTAKES)
def test_a_mistake_is_answered_before_any_work(line, folder, capfd):
    (folder / "model.json").write_text(json.dumps({"num": [[[0, 1]]], "den": [[[1, -0.5]]]}))
    (folder / "diagnosed.json").write_text('{"schema": 1, "answers": [NaN]}')
    (folder / "here").mkdir()
    try:
        status = main(shlex.split(line))
    except SystemExit as ended:  # argparse's own
        status = ended.code
    said = capfd.readouterr().err
    assert status == 2
    assert MISTAKES[line] in said
    assert "Traceback" not in said
    assert not (folder / "results" / "compare" / "parts").exists()


@pytest.mark.parametrize("words", [("identify",), ("diagnose",), ("design",), ("session", "start")])
def test_what_must_be_chosen_is_explained(words, capsys):
    """The options that every user meets have words of their own, not a list of names alone."""
    with pytest.raises(SystemExit):
        main([*words, "--help"])
    said = capsys.readouterr().out.partition("show this help message")[2]
    for option in ("--structure", "--method", "--criterion", "--inputs", "--outputs"):
        shown = re.search(rf"^  {option} [^\n]*\n( {{24}}\S[^\n]*)?", said, re.MULTILINE)
        assert shown is None or re.search(r"[a-z] [a-z(]", shown[0]), shown
