"""The command line: exit statuses, one line for bad input, one JSON object on standard output."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from types import SimpleNamespace

import numpy as np
import pytest

from benchmarks.cli import main


def oed(*words: str) -> subprocess.CompletedProcess[str]:
    return subprocess.run(
        [sys.executable, "-m", "benchmarks.cli", *words], capture_output=True, text=True, check=False
    )


def payload(capfd: pytest.CaptureFixture[str], *words: str) -> dict:
    assert main([*words, "--json", "--quiet"]) == 0
    out = capfd.readouterr().out
    assert out.count("\n") == 1
    return json.loads(out)


def test_help_lists_every_command_and_version_is_the_package():
    done = oed("--help")
    assert done.returncode == 0
    for name in ("compare", "theory", "iterate", "design", "identify", "report"):
        assert name in done.stdout
    assert oed("--version").stdout.startswith("oed ")


@pytest.mark.parametrize("name", ["compare", "theory", "iterate", "design", "identify", "report"])
def test_every_command_has_help_with_an_example(name, capsys):
    with pytest.raises(SystemExit) as stopped:
        main([name, "--help"])
    assert stopped.value.code == 0
    out = capsys.readouterr().out
    assert "example: oed" in out
    for option in ("--json", "--seed", "--quiet"):
        assert option in out


def test_theory_of_the_reference_plant(capfd):
    """theory.md sections 2 and 4 through the command line."""
    found = payload(capfd, "theory", "--plant", "reference", "--noise-variance", "1", "--experiments", "10")
    assert found["schema_version"] == 1
    assert abs(found["hinf_norm"] - 2.411554068769) < 1e-12
    assert abs(found["mu2"] - 5.818127937783) < 1e-12
    assert abs(found["beta2_mean"] - 4.818127937783) < 1e-12
    assert abs(found["c_efficiency"] - 0.81125) < 5e-6
    assert np.allclose(found["c_efficiency_by_experiments"][9], 0.50952, atol=5e-6)
    assert abs(found["d_efficiency"] - 0.033674015758 / 0.093712276) < 1e-8


def test_theory_prints_small_efficiencies_by_their_digits_and_leaves_none_out_silently(tmp_path, capfd):
    plants = {"flat": np.poly([0.9] * 4), "long": np.r_[1.0, np.zeros(99), 0.5]}
    for name, den in plants.items():
        (tmp_path / f"{name}.json").write_text(json.dumps({"num": [0, 1], "den": list(den)}))
    assert main(["theory", "--plant", str(tmp_path / "flat.json"), "--experiments", "1"]) == 0
    assert "volume (D) 9.42e-08, all parameters, sum (A) 7.06e-10" in capfd.readouterr().out
    assert main(["theory", "--plant", str(tmp_path / "long.json"), "--experiments", "1"]) == 0
    assert "left out: the plant has 101 unknown parameters" in capfd.readouterr().out
    (tmp_path / "two.json").write_text(json.dumps({"num": [0, 1], "den": [1, 0, -0.81]}))  # peaks at 0 and pi
    assert main(["theory", "--plant", str(tmp_path / "two.json"), "--experiments", "2"]) == 0
    said = capfd.readouterr().out
    assert "left out: the gain is largest at 2 frequencies" in said
    assert "nan" not in said


def test_theory_at_vanishing_noise_keeps_its_digits(capfd):
    found = payload(capfd, "theory", "--plant", "reference", "--noise-variance", "1e-4", "--experiments", "1")
    assert np.isclose(found["mu2_excess"], 2e-8 / 1148.953609, rtol=1e-4)


@pytest.mark.parametrize(
    "criterion, loss",
    [("D", 0.033674015758), ("A", 0.339118600620), ("E", 0.230078614237), ("hinf", 1.0)],
)
def test_design_of_the_reference_plant(capfd, criterion, loss):
    """theory.md section 4, second table."""
    found = payload(
        capfd, "design", "--plant", "reference", "--criterion", criterion, "--noise-variance", "1"
    )
    assert np.isclose(found["loss"], loss, rtol=1e-7)
    assert 0 <= found["gap"] <= 1e-6
    assert np.isclose(sum(line["power"] for line in found["support"]), 1.0, rtol=1e-9)


@pytest.mark.parametrize(
    "words, sentence",
    [
        (("theory", "--plant", "referense"), "did you mean reference"),
        (("--verzion",), "--verzion is not understood; give a command first"),
        (("identify", "x.csv", "--seed", "x"), "--seed: it is 'x'; it must be a whole number"),
        (
            ("design", "--plant", "my/record.csv"),
            "is a record by its suffix, not a plant; identify a model of it first",
        ),
        (("design", "--plant", "."), ". is a folder; a model's file in it is the plant: model.json"),
        (("design", "--plant", "none.json"), "check the name and the folder"),
        (("theory", "--plant", "reference", "--noise-variance", "-1"), "noise variance is -1"),
        (("theory", "--plant", "reference", "--noise-variance", "x"), "it is 'x'; it must be a number"),
        (("theory", "--plant", "nowhere.json"), "nowhere.json cannot be read"),
        (("theory",), "--plant"),
        (("design", "--plant", "reference", "--criterion", "D", "--input-power", "0"), "power"),
        (("compare", "--plant", "reference", "--methods", "whit"), "did you mean white"),
        (("compare", "--replicates", "1"), "replicates is 1"),
        (("compare", "--replicates", "0", "--dry-run"), "replicates is 0"),
        (("compare", "--against", "nowhere", "--dry-run"), "nowhere holds no comparison.csv"),
        (("iterate", "--samples", "9000000", "--out", "x.txt"), "the file must end in .npz or .csv"),
        (("design", "--plant", "Reference"), "did you mean reference?"),
        (("report", "nowhere"), "there is no folder nowhere"),
        (("nonsense",), "no command named"),
        (("design", "--plant", "\u201creference\u201d"), "has typographic quotation marks or dashes"),
        (("design", "\u2013-plant", "reference"), "has typographic quotation marks or dashes"),
        (("identify", "-r.csv"), "-r.csv is a file here: write ./-r.csv"),
        (("identify", "x.csv", "-r.csv"), "-r.csv is a file here: write ./-r.csv"),
        (("identify", "x.csv", "--test", "-r.csv"), "-r.csv is a file here: write ./-r.csv"),
    ],
)
def test_bad_input_is_one_line_and_exit_status_2(words, sentence, tmp_path, capsys, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "-r.csv").write_text("t,u,y\n")
    try:
        status = main(list(words))
    except SystemExit as stopped:
        status = stopped.code
    captured = capsys.readouterr()
    assert status == 2
    assert captured.out == ""
    assert sentence in captured.err
    assert captured.err.count("\n") == 1
    assert [path.name for path in tmp_path.iterdir()] == ["-r.csv"]  # nothing was written


@pytest.mark.parametrize(
    "num, den, sentence",
    [
        ([0, 1], [1, -1.5], "must be stable"),
        ([1], [0, 1], "improper"),
        ([0], [1], "zero"),
        ([1, None], [1], "num"),
    ],
)
def test_bad_plant_files(num, den, sentence, tmp_path, capsys):
    file = tmp_path / "plant.json"
    file.write_text(json.dumps({"num": num, "den": den}))
    assert main(["theory", "--plant", str(file)]) == 2
    assert sentence in capsys.readouterr().err


@pytest.mark.parametrize(
    "content, sentence",
    [
        ("1,2\n3,4\n", "header"),
        ("u,y\n1,2\nthree,4\n", "three"),
        ("u,y\n1,nan\n3,4\n", "nan"),
        ("u,y\n1,2\n3\n", "row"),
    ],
)
def test_bad_records(content, sentence, tmp_path, capsys):
    file = tmp_path / "record.csv"
    file.write_text(content)
    assert main(["identify", str(file)]) == 2
    err = capsys.readouterr().err
    assert sentence in err.lower()
    assert err.count("\n") == 1


def test_json_is_alone_on_standard_output_even_below_python(tmp_path):
    """A library that writes to file descriptor 1 must not disturb the object."""
    script = (
        "import os, sys, benchmarks.commands.suite.report as r\n"
        "r.run = lambda args: (os.write(1, b'banner'), ({'path': float('nan')}, ''))[1]\n"
        "from benchmarks.cli import main\nsys.exit(main(['report', 'x', '--json']))\n"
    )
    done = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, check=False)
    assert done.returncode == 0
    assert json.loads(done.stdout) == {"schema_version": 1, "path": None}
    assert "banner" in done.stderr


def test_what_a_terminal_obeys_is_written_out_of_a_name_in_a_file(tmp_path, capfd):
    """It had been in messages, not in answers: a plant's name could clear the screen."""
    plant, name = tmp_path / "p.json", "a\x1b[2J\r\u202eb\u00a0\u00b5"
    plant.write_text(json.dumps({"num": [[[0, 1]]], "den": [[[1, -0.5]]], "dt": 1, "name": name}))
    words = ["theory", "--plant", str(plant), "--noise-variance", "1", "--quiet"]
    assert main(words) == 0
    assert "a\\x1b[2J\\r\\u202eb\u00a0\u00b5," in capfd.readouterr().out


def test_a_name_that_is_no_text_is_printed(tmp_path):
    call = [sys.executable, "-m", "benchmarks.cli", "demo", b"\xff"]
    done = subprocess.run(call, cwd=tmp_path, capture_output=True, check=False)
    assert (done.returncode, done.stderr) == (0, b"")
    assert rb"written to \udcff" in done.stdout


@pytest.mark.parametrize("words", [("data",), ("data", "--json")])
def test_a_full_disk_behind_the_output_is_one_line(words):
    with open("/dev/full", "w") as full:
        done = subprocess.run(
            [sys.executable, "-m", "benchmarks.cli", *words],
            stdout=full,
            stderr=subprocess.PIPE,
            text=True,
            check=False,
        )
    assert done.returncode == 2
    assert done.stderr.count("\n") == 1
    assert "No space left on device" in done.stderr


@pytest.mark.slow
@pytest.mark.parametrize(
    "words, made, both",
    [
        ("--help", (), False),
        ("data", (), True),
        ("data --json", (), False),
        (
            "identify x.csv --structure arx --orders 1 1 --out m",
            ("model.json", "residuals.csv", "report.html"),
            True,
        ),
        ("design --plant reference --realise 50 --out m", ("design.json", "input.csv", "report.html"), False),
    ],
)
def test_a_reader_that_goes_away_loses_no_result(words, made, both, tmp_path):
    """As `oed ... | head` does it, and with `2>&1`: the folder is whole, the work well done, and no word of the pipe is said."""
    u = np.random.default_rng(0).standard_normal(60)
    np.savetxt(tmp_path / "x.csv", np.c_[u, np.r_[0.0, u[:-1]]], delimiter=",", header="u,y", comments="")
    read, write = os.pipe()
    os.close(read)
    call = [sys.executable, "-m", "benchmarks.cli", *words.split()]
    done = subprocess.run(
        call, cwd=tmp_path, stdout=write, stderr=write if both else subprocess.PIPE, check=False
    )
    os.close(write)
    assert done.returncode == 0, done.stderr
    assert both or b"ipe" not in done.stderr
    assert {file.name for file in tmp_path.glob("m/*")} >= {*made}


@pytest.mark.parametrize("closed", ["2>&-", ">&-", "<&- >&- 2>&-"])
@pytest.mark.parametrize("more, status", [((), 0), (("--json",), 0), (("--nonsense",), 2)])
def test_closed_streams_end_no_command(closed, more, status, tmp_path):
    """As a service may start it: without standard error, no command that shows its progress had worked, and said nothing."""
    words = [
        sys.executable,
        "-m",
        "benchmarks.cli",
        "design",
        "--plant",
        "reference",
        "--realise",
        "50",
        "--out",
        "d.csv",
        *more,
    ]
    done = subprocess.run(["sh", "-c", f'exec "$@" {closed}', "sh", *words], cwd=tmp_path, check=False)
    assert done.returncode == status
    assert (tmp_path / "d.csv").exists() == (status == 0)


@pytest.mark.slow
def test_a_full_disk_behind_the_output_loses_no_folder(tmp_path):
    """The answer is printed first, which fails; what was asked for in files is there."""
    words = ["design", "--plant", "reference", "--realise", "50", "--out", str(tmp_path / "m"), "--quiet"]
    with open("/dev/full", "w") as full:
        done = subprocess.run(
            [sys.executable, "-m", "benchmarks.cli", *words], stdout=full, stderr=subprocess.PIPE, check=False
        )
    assert (done.returncode, done.stderr.count(b"\n")) == (2, 1), done.stderr
    assert (tmp_path / "m" / "report.html").exists()


def test_a_defect_is_exit_status_1_with_its_traceback(monkeypatch, capsys):
    import benchmarks.commands.suite.report as command

    monkeypatch.setattr(command, "run", lambda args: 1 / 0)
    assert main(["report", "x"]) == 1
    err = capsys.readouterr().err
    assert "ZeroDivisionError" in err
    assert "defect" in err


@pytest.mark.parametrize(
    "held, left", [((), "nothing of it is kept"), (("model.json",), "holds is not whole: remove it")]
)
@pytest.mark.parametrize("compiled", [False, True])
def test_an_interrupt_says_what_is_left_also_where_compiled_code_ran(
    held, left, compiled, tmp_path, monkeypatch, capsys
):
    """What reaches compiled code comes out of it as a SystemError: two of three interrupts of `identify` ended as a defect."""
    import benchmarks.commands.record.identify as command

    def interrupted(args):
        for name in held:
            (tmp_path / name).write_text("")
        if compiled:
            raise SystemError("returned a result with an exception set") from KeyboardInterrupt()
        raise KeyboardInterrupt

    monkeypatch.setattr(command, "run", interrupted)
    assert main(["identify", "x.csv", "--out", str(tmp_path)]) == 130
    err = capsys.readouterr().err
    assert "oed identify: interrupted; " in err
    assert left in err
    assert "Traceback" not in err


def test_python_without_docstrings_is_refused_before_any_work(monkeypatch, capsys):
    """The charts' library needs them: all runs of a comparison were done before that was found."""
    monkeypatch.setattr(sys, "flags", SimpleNamespace(optimize=2))
    assert main(["compare", "--dry-run"]) == 2
    assert "without -OO" in capsys.readouterr().err


def test_no_warning_of_numpy_reaches_who_gives_a_command(tmp_path):
    """-W still shows it, and whoever calls from Python has it."""
    (tmp_path / "own.py").write_text(
        "import numpy as np\ndef method(experiment, *, samples, iterations, rng):\n    return np.log(np.array([-1.0]))\n"
    )
    words = "-m benchmarks.cli compare --plant reference --methods own.py:method --estimators frf --dry-run --quiet"
    warned = []
    for more in ([], ["-W", "default"]):
        call = [sys.executable, *more, *words.split()]
        environment = {k: v for k, v in os.environ.items() if k != "PYTHONWARNINGS"}
        done = subprocess.run(call, cwd=tmp_path, capture_output=True, text=True, env=environment, check=True)
        warned.append("invalid value encountered in log" in done.stderr)
        assert "TypeError: the method returned ndarray; it must return a Trace" in done.stdout
    assert warned == [False, True]
