"""What an import and a help text load, and that versions agree."""

from __future__ import annotations

import importlib
import json
import subprocess
import sys
import tomllib

import pytest

from tests.test_architecture import PACKAGES, ROOT

HEAVY = ("casadi", "clarabel", "control", "cvxpy", "matplotlib", "numba", "pandas", "scipy.signal", "xarray")


def loaded_by(*arguments: str) -> list[str]:
    """Which of the heavy modules a fresh interpreter has loaded once it has run the arguments."""
    script = (
        "import json, runpy, sys\n"
        "try:\n"
        f"    {'; '.join(arguments)}\n"
        "except SystemExit:\n"
        "    pass\n"
        f"sys.stderr.write('\\n' + json.dumps([name for name in {HEAVY!r} if name in sys.modules]))\n"
    )
    run = subprocess.run(
        [sys.executable, "-c", script], cwd=ROOT, capture_output=True, text=True, check=False
    )
    assert run.returncode == 0, run.stderr
    return json.loads(run.stderr.splitlines()[-1])


@pytest.mark.parametrize("package", [name for name in PACKAGES if (ROOT / name / "__init__.py").exists()])
def test_import_is_light(package: str) -> None:
    assert loaded_by(f"import {package}") == []


@pytest.mark.skipif(not (ROOT / "benchmarks" / "cli.py").exists(), reason="no command line yet")
@pytest.mark.parametrize("flag", ["--help", "--version"])
def test_help_is_light(flag: str) -> None:
    assert (
        loaded_by("from benchmarks.cli import main", f"sys.argv = ['oed', '{flag}']", "sys.exit(main())")
        == []
    )


def test_versions_agree() -> None:
    version = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]["version"]
    assert f"\nversion: {version}\n" in (ROOT / "CITATION.cff").read_text(encoding="utf-8")
    assert version in (ROOT / "CHANGELOG.md").read_text(encoding="utf-8")
    if (ROOT / "oed" / "__init__.py").exists():
        oed = importlib.import_module("oed")
        assert getattr(oed, "__version__", version) == version
