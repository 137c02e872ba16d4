"""Without the extras: the core works, and what lacks a package names the extra that brings it."""

from __future__ import annotations

import subprocess
import sys

import pytest

from oed.lazily import EXTRAS

LIGHT = f"import sys; sys.modules.update(dict.fromkeys({list(EXTRAS)})); from benchmarks.cli import main; "


def light(*words: str) -> subprocess.CompletedProcess:
    """A command in a process where no extra can be imported."""
    call = f"{LIGHT}raise SystemExit(main({list(words)!r}))"
    return subprocess.run([sys.executable, "-c", call], capture_output=True, text=True, timeout=300)


@pytest.mark.slow
def test_the_chain_needs_no_extra(tmp_path):
    demo, model = tmp_path / "demo", tmp_path / "model"
    chain = [
        ("demo", str(demo)),
        ("identify", f"{demo}/record.csv[0:300]", "--delay", "3", "--search", "quick", "--out", str(model)),
        ("design", "--plant", f"{model}/model.json"),
        ("session", "start", str(tmp_path / "rig"), "--method", "power", "--samples", "100", "--dt", "0.1"),
    ]
    for words in chain:
        ended = light(*words)
        assert ended.returncode == 0, (words, ended.stderr)


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
    ended = light(*words)
    assert ended.returncode == 2
    assert f"pip install 'oed[{extra}]'" in ended.stderr
    assert ended.stderr.count("\n") == 1


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
