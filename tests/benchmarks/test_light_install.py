"""Without the extras: the core works, and what lacks a package names the extra that brings it."""

from __future__ import annotations

import subprocess
import sys

import pytest

from oed.lazily import EXTRAS

LIGHT = f"""
from importlib.machinery import PathFinder
found = PathFinder.find_spec
PathFinder.find_spec = lambda name, *more: None if name.partition(".")[0] in {list(EXTRAS)} else found(name, *more)
"""


def light(*words: str) -> subprocess.CompletedProcess:
    """A command in a process where no extra can be imported."""
    return light_python(f"from benchmarks.cli import main\nraise SystemExit(main({list(words)!r}))")


def light_python(call: str) -> subprocess.CompletedProcess:
    return subprocess.run([sys.executable, "-c", LIGHT + call], capture_output=True, text=True, timeout=300)


@pytest.mark.slow
def test_the_chain_needs_no_extra(tmp_path):
    demo, model = tmp_path / "demo", tmp_path / "model"
    chain = [
        ("demo", str(demo)),
        ("identify", f"{demo}/record.csv[0:300]", "--delay", "3", "--search", "quick", "--out", str(model)),
        ("design", "--plant", f"{model}/model.json", "--out", str(tmp_path / "design")),
        ("session", "start", str(tmp_path / "rig"), "--method", "power", "--samples", "100", "--dt", "0.1"),
    ]
    for words in chain:
        ended = light(*words)
        assert ended.returncode == 0, (words, ended.stderr)
        assert ("pip install 'oed[report]'" in ended.stdout) == ("--out" in words)
    assert (tmp_path / "design" / "design.json").exists()


@pytest.mark.parametrize(
    "words, extra",
    [
        (("design", "--plant", "reference", "--parametrisation", "moments"), "convex"),
        (("identify", "r.parquet"), "files"),
        (("identify", "r.csv", "--missing"), "casadi"),
        (("compare", "--plant", "reference", "--replicates", "2"), "compare"),
    ],
)
def test_what_is_missing_is_named(tmp_path, monkeypatch, words, extra):
    (tmp_path / "r.parquet").write_bytes(b"PAR1PAR1")
    rows = [f"{k % 7 % 2},{'' if k == 9 else k % 5}" for k in range(99)]
    (tmp_path / "r.csv").write_text("\n".join(["u,y", *rows, ""]))
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("PYTHONPATH", ":".join(p for p in sys.path if p))
    ended = light(*words, "--quiet")  # on a slow machine it says what it is at
    assert ended.returncode == 2
    assert f"pip install 'oed[{extra}]'" in ended.stderr
    assert ended.stderr.count("\n") == 1


@pytest.mark.parametrize(
    "call, package, extra",
    [
        ("identify(numbers(), 'arx', (1, 1), missing=True)", "casadi", "casadi"),
        ("identify(numbers(), 'arx', (1, 1)).plot.bode()", "matplotlib", "report"),
        ("identify(numbers(), 'arx', (1, 1)).model.to_control()", "control", "control"),
        ("from oed.files.objects import to_pandas; to_pandas(numbers())", "pandas", "files"),
        ("read_record('x.parquet')", "pyarrow", "files"),
    ],
)
def test_python_names_the_extra_too(tmp_path, monkeypatch, call, package, extra):
    """Four of these ended with the name of the package alone."""
    (tmp_path / "x.parquet").write_bytes(b"PAR1PAR1")
    monkeypatch.setenv("PYTHONPATH", ":".join(p for p in sys.path if p))
    monkeypatch.chdir(tmp_path)
    ended = light_python(f"""
import numpy as np
from oed import Record, read_record
from estimators.pem import identify
u = np.arange(99) * 37 % 11 - 5.0
y = np.r_[0.0, u[:-1]] + np.arange(99) % 3
y[9] = np.nan if "missing" in {call!r} else 0
numbers = lambda: Record(u, y, 1.0)
{call}
""")
    assert (
        f"{package} is not installed; pip install 'oed[{extra}]' brings it" in ended.stderr.splitlines()[-1]
    )


def test_what_others_ask_for_is_answered_as_ever():
    """Another package that does without an extra of ours, or looks whether it is there, meets no error of ours."""
    ended = light_python("""
import oed, importlib.util
assert importlib.util.find_spec("pandas") is None
try:
    import pandas
except ImportError as error:
    assert str(error) == "No module named 'pandas'", error
else:
    raise AssertionError
""")
    assert ended.returncode == 0, ended.stderr


def test_versions_of_what_a_comparison_does_without(monkeypatch):
    """With oed[compare] and no more, a comparison ended at the version of cvxpy, which it does not use."""
    from importlib.metadata import PackageNotFoundError

    from benchmarks.campaign import store

    def version(name):
        if name == "cvxpy":
            raise PackageNotFoundError(name)
        return "1"

    monkeypatch.setattr(store, "version", version)
    found = store._versions.__wrapped__()
    assert (found["cvxpy"], found["numpy"]) == ("not installed", "1")
