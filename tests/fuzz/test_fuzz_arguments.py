"""Words behind `oed` with something in them changed: the work is done, or one line says why not; never anything else."""

from __future__ import annotations

import argparse
import contextlib
import io
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from benchmarks.cli import _parser, main
from tests.fuzz.test_fuzz_documents import in_time, quick

BASES = tuple(map(str.split, (
    "compare --plant p.json --noise-variance 1 --methods white --estimators frf --samples 40 --experiments 2 --replicates 2"
    " --profile-replicates 0 --limit replicates=2,method=white --time-limit 5 --jobs 1 --out o",
    "compare --config c.toml --against o --seed 3",
    "data tclab --from .",
    "demo d",
    "design --plant p.json --noise-variance 1 --criterion D --parametrisation grid --points 20 --input-power 1 --realise 50",
    "design --plant p.json --parametrisation moments --lags 4 --band 0.1 2 --channel-power 1 --out design.csv",
    "diagnose few.csv --test x.csv --meta meta.json --skip 5 --model p.json --inputs u --outputs y --dt 1 --alpha 0.01 --effort quick",
    "diagnose-folder cases --out r.jsonl --jobs 1",
    "effects --nature smooth",
    "identify x.csv --structure arx --orders 1 1 --delay 1 --initial zero --test x.csv --skip 3 --inputs u --outputs y --dt 1",
    "identify x.csv --structure ss --orders 1 --method moesp --horizon 4 --out m",
    "identify x.csv --structure fir --orders 4 --regularisation tc --folds 2 --no-offset",
    "iterate --plant p.json --algorithm siso --samples 40 --iterations 2 --noise-variance 1 --scaling each --replicate 1",
    "plants",
    "plot x.csv --structure arx --orders 1 1 --figure step --dt 1 --out f.svg",
    "report m",
    "reproduce --strict",
    "session start s --method power --samples 20 --dt 1 --experiments 2 --amplitude 2",
    "session status s",
    "session record s x.csv",
    "speed --strict",
    "theory --plant p.json --noise-variance 1 --algorithm siso --scaling each --experiments 4 --samples 40",
)))  # fmt: skip
NUMBERS = ("0", "-1", "-0.0", "0.5", "1", "2", "3", "7", "1e-320", "1e-9", "1e9", "1e200", "1e308", "1e999", "nan", "-inf", "1,5", "1_0",
           "\u0661", "\u00b2", "9" * 5000, str(2**63), str(10**18), "auto")  # fmt: skip
TEXTS = ("", " ", "x", "x" * 300, "\udcff", "\u202e", "a\nb", "\x1b[2J", "*", "[", ".", "..", "/", "/dev/null", "nowhere/x", "x.csv",
         "p.json", "c.toml", "cases", "m", "s", "=", "a=b", "p.json:f", "x.py:f", "replicates=\u00b2", "replicates=1,noise_variance=x",
         "u,y", "y,u", "--", "-", "--help", "--json")  # fmt: skip
NEVER = {"--serve", "--scheduler"}
"""What waits for others."""
ALWAYS = {"compare": ["--dry-run"], "speed": ["nothing"], "reproduce": ["nothing"]}
"""What keeps a command from the minutes that it would take."""
changes = st.lists(
    st.tuples(
        st.integers(0, 999), st.sampled_from(["set", "set", "add", "drop", "twice"]), st.sampled_from(NUMBERS),
        st.sampled_from(TEXTS),
    ),
    min_size=1, max_size=2,
)  # fmt: skip


def options() -> dict[str, list[str]]:
    """The options of each verb."""
    (verbs,) = (a for a in _parser()._actions if isinstance(a, argparse._SubParsersAction))
    return {
        verb: sorted({word for action in sub._actions for word in action.option_strings} - NEVER)
        for verb, sub in verbs.choices.items()
    }


@pytest.fixture(scope="module")
def place(tmp_path_factory):
    """A folder with a record, a plant, a campaign and a folder of cases, which the words name."""
    folder = tmp_path_factory.mktemp("arguments")
    u = np.random.default_rng(0).standard_normal(60)
    y = np.convolve(u, [0, 1, 0.5])[:60]
    text = "u,y\n" + "".join(f"{a!r},{b!r}\n" for a, b in zip(u.tolist(), y.tolist(), strict=True))
    (folder / "x.csv").write_text(text)
    (folder / "few.csv").write_text(
        text[:500]
    )  # a diagnosis takes seconds, and asks for more samples than this
    (folder / "p.json").write_text('{"num": [[[0, 1]]], "den": [[[1, -0.5]]], "dt": 1}')
    (folder / "c.toml").write_text(
        'plants = ["p.json"]\nmethods = ["white"]\nestimators = ["frf"]\nsamples = 40\n'
    )
    (folder / "meta.json").write_text("{}")
    (folder / "cases").mkdir()
    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(folder)
        yield options()


def said(words: list[str]) -> tuple[int, str, str]:
    """Exit status, standard output and standard error of the command."""
    out, err = io.StringIO(), io.StringIO()
    with in_time(), contextlib.redirect_stdout(out), contextlib.redirect_stderr(err):
        try:
            status = main(words)
        except SystemExit as end:
            status = end.code
    return status, out.getvalue(), err.getvalue()


@quick
@given(st.sampled_from(BASES), changes)
def test_changed_arguments_are_done_or_refused_in_a_line(place, base, how):
    verb, *words = base
    for place_of, kind, number, text in how:
        at = place_of % (len(words) + 1)
        odd = (
            number
            if (place_of % 9 if words[at:] and words[at][:1].isdigit() else place_of % 3 == 0)
            else text
        )
        if kind == "add":
            words[at:at] = [place[verb][place_of % len(place[verb])], odd]
        elif kind == "twice":
            words[at:at] = words[at : at + 1]
        else:
            words[at : at + 1] = [odd] if kind == "set" else []
    words = [verb, *words, "--quiet", *ALWAYS.get(verb, [])]
    status, out, err = said(words)
    assert status in (0, 1, 2), err
    assert not {"Traceback", "defect"} & set(err.split()), err
    assert len(err) < 5000
    if status == 2:
        lines = [line for line in err.splitlines() if ": running the code in " not in line]
        assert (out, len(lines)) == ("", 1), err


@pytest.mark.parametrize(
    "words, line",
    [
        (f"identify x.csv --structure fir --orders {10**18}", "60 samples cannot determine orders"),
        (f"identify x.csv --structure ss --orders {2**63}", "60 samples cannot determine orders"),
        (f"design --plant p.json --points {10**18}", "100000 are the most"),
        ("design --plant p.json --input-power 1e-320", "choose other units"),
        ("design --plant p.json --amplitude 1e200 --realise 50", "the amplitude is 1e+200"),
        ("design --plant p.json --amplitude 1 --rate 1e-200 --realise 50", "the rate is 1e-200"),
        (f"iterate --plant p.json --iterations {10**18}", "ask for fewer"),
        (f"theory --plant p.json --samples {10**18}", "at most 10,000,000"),
        (f"theory --plant p.json --experiments {10**18}", "at most 10,000 are"),
        ("compare --limit replicates=\u00b2", "give replicates=R"),
        (f"compare --limit replicates={'9' * 5000}", "give replicates=R"),
        ("compare --limit replicates=1,noise_variance=x", "positive, finite"),
        ("compare --limit replicates=1,noise_variance=nan", "positive, finite"),
        (f"report {'x' * 300}", "File name too long"),
        (f"identify {'x' * 300}.csv", "File name too long"),
        ("iterate --plant p.json --seed -1", "it must be a whole number of at least 0"),
        ("iterate --plant p.json --replicate -1", "it must be a whole number of at least 0"),
        ("plants a\x0bb", "a b is not understood"),
        (f"plants {'x' * 5000}", " ... xxx"),
    ],
    ids=lambda value: str(value)[:40],
)  # fmt: skip
def test_what_was_found(place, words, line):
    found, _, err = said([*words.split(" "), "--quiet"])
    assert (found, err.count("\n")) == (2, 1), err
    assert line in err


def test_a_folder_or_plant_whose_name_is_no_text_has_a_page(place):
    """Its bytes were no UTF-8: pages, models and tables of it ended in a traceback."""
    Path("\udcff.json").write_text('{"num": [[[0, 1]]], "den": [[[1, -0.5]]], "dt": 1}')
    plant = "--plant \udcff.json --quiet"
    for words in (
        "session start \udcff.s --method power --samples 20 --dt 1 --quiet", "report \udcff.s --quiet",
        f"iterate {plant} --samples 40 --iterations 2", f"design {plant} --realise 50 --out d\udcff",
    ):  # fmt: skip
        status, _, err = said(words.split())
        assert (status, err) == (0, "")
    assert "\\udcff" in Path("d\udcff/report.html").read_text()
    status, _, err = said(f"compare {plant} --dry-run".split())
    assert (status, err.count("\n")) == (2, 1)
    assert "rename the file" in err
