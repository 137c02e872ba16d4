"""The same bytes whatever the environment: hash seed, threads of BLAS, language of the system, order of the work."""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
from hashlib import blake2b
from pathlib import Path

import pytest

from benchmarks.campaign.settings import Settings
from benchmarks.campaign.whole_campaign import fill_store
from tests.conftest import ROOT

ENDURANCE = (1000, pytest.param(100_000, marks=pytest.mark.validate))
"""Runs over which handles and memory are looked at; after four fifths every input has begun, with all that it imports."""
GROWTH_MB = 10
SCRIPT = """
import locale, sys
from contextlib import suppress
from pathlib import Path
from benchmarks.campaign.whole_campaign import run_campaign
from benchmarks.campaign.settings import Settings
with suppress(locale.Error):
    locale.setlocale(locale.LC_ALL, "")
runs = run_campaign(Settings(plants=("reference", "three-by-two"), noise_variances=(1.0, 0.1), methods=("white", "power", "procedure-2"),
    estimators=("frf", "gain", "mu", "fir-selected"), samples=60, experiments=4, profile_replicates=1, seed=%s), 5,
    Path(sys.argv[1]), jobs=1)
print([(r.key, k, e.estimate.tobytes()) for r in runs for k, e in r.final.items()])
"""
ENVIRONMENTS = {
    "hash seed": {"PYTHONHASHSEED": "4711"},
    "threads": dict.fromkeys(("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"), "4"),
    "German": {"LC_ALL": "de_DE.UTF-8", "LANG": "de_DE.UTF-8"},
    "Turkish": {"LC_ALL": "tr_TR.UTF-8", "LANG": "tr_TR.UTF-8"},
}


def made(folder: Path, seed: int = 0, python: Path | str = sys.executable, **environment: str) -> str:
    """A campaign in a process of its own; every bit of its estimates."""
    usual = {
        "PYTHONHASHSEED": "1",
        "OMP_NUM_THREADS": "1",
        "OPENBLAS_NUM_THREADS": "1",
        "MKL_NUM_THREADS": "1",
    }
    call = [python, "-c", SCRIPT % seed, folder]
    return subprocess.check_output(call, env=os.environ | usual | environment, text=True)


def digest(folder: Path, seed: int = 0, **environment: str) -> str:
    """All that it wrote."""
    made(folder, seed, **environment)
    files = sorted(folder.rglob("*.parquet")) + [folder / "campaign.json"]
    assert len(files) > 8
    return blake2b(b"".join(f.name.encode() + f.read_bytes() for f in files)).hexdigest()


@pytest.fixture(scope="module")
def usual(tmp_path_factory):
    return digest(tmp_path_factory.mktemp("usual") / "x")


def spoken(environment: dict[str, str], folder: Path) -> dict[str, str]:
    """The environment, with its language compiled into the folder: an image has C alone, most have the sources of all."""
    name = environment.get("LC_ALL")
    if not name:
        return environment
    if not shutil.which("localedef"):
        pytest.skip("no localedef to compile a language with")
    language, charset = name.split(".")
    words = ["localedef", "-i", language, "-f", charset, folder / f"{language}.utf8"]
    made = subprocess.run(words, capture_output=True, text=True, check=False)
    if made.returncode:
        pytest.skip(f"the sources of {name} are not installed: {made.stderr.strip()}")
    there = environment | {"LOCPATH": str(folder)}
    look = "import locale; locale.setlocale(locale.LC_ALL, ''); print(locale.str(0.5))"
    said = subprocess.check_output([sys.executable, "-c", look], env=os.environ | there, text=True)
    assert said.strip() == "0,5"  # it is in force: a comma
    return there


@pytest.mark.slow
@pytest.mark.parametrize("what", ENVIRONMENTS)
def test_the_same_bytes(what, usual, tmp_path):
    assert digest(tmp_path / "x", **spoken(ENVIRONMENTS[what], tmp_path)) == usual


def other_pythons() -> list[Path]:
    """Of the environments beside the checkout, those of another version: .venv-3.13, or .venv from there."""
    ask = f"import sys; print(sys.version_info[:2] != {tuple(sys.version_info[:2])})"
    say = lambda python: (
        subprocess.run([python, "-c", ask], capture_output=True, text=True, check=False).stdout
    )
    return [p for p in sorted(ROOT.glob(".venv*/bin/python")) if say(p).strip() == "True"]


@pytest.mark.parametrize("python", other_pythons() or [None], ids=str)
def test_another_python_gives_the_same_numbers(python, tmp_path):
    """With the libraries of the same lock the tolerance is nil; parts differ in the version that they say."""
    if python is None:
        pytest.skip("no environment of another Python beside the checkout (CI makes them)")
    found = made(tmp_path / "y", python=python)
    assert len(found) > 1000
    assert found == made(tmp_path / "x")


@pytest.mark.slow
def test_another_seed_gives_other_bytes(usual, tmp_path):
    assert digest(tmp_path / "x", seed=1) != usual


COMMAND = """
import locale
locale.setlocale(locale.LC_ALL, "")
from benchmarks.cli import main
main()
"""


@pytest.mark.validate
def test_a_report_has_the_same_bytes_for_every_hash_seed_and_language(tmp_path):
    """What a page iterates over is a list: a set of names has another order in every process."""
    words = "compare --plant reference --noise-variance 1 --methods white power multisine --estimators frf gain --samples 50"
    words += " --experiments 3 --replicates 2 --jobs 1 --quiet --out o"
    told = []
    seeds = [{"PYTHONHASHSEED": seed} for seed in "012"]
    for k, environment in enumerate([*seeds, ENVIRONMENTS["German"], ENVIRONMENTS["Turkish"]]):
        folder = tmp_path / str(k)
        folder.mkdir()
        call = [sys.executable, "-c", COMMAND, *words.split()]
        env = os.environ | spoken(environment, tmp_path)
        subprocess.run(call, check=True, cwd=folder, env=env, capture_output=True)
        files = (
            f
            for f in sorted((folder / "o").rglob("*"))
            if f.is_file() and f.name not in ("lock", "cost.json")
        )
        told.append({f.name: blake2b(f.read_bytes()).hexdigest() for f in files})
    assert {"report.html", "report.json"} <= set(told[0])
    assert all(other == told[0] for other in told)


def memory_mb() -> float:
    return int(Path("/proc/self/statm").read_text().split()[1]) * os.sysconf("SC_PAGE_SIZE") / 2**20


@pytest.mark.slow
@pytest.mark.skipif(not Path("/proc/self/statm").exists(), reason="reads memory and handles under /proc")
@pytest.mark.parametrize("runs", ENDURANCE)
def test_memory_and_handles_stay_flat(tmp_path, record_figure, runs):
    settings = Settings(plants=("reference",), noise_variances=(1.0,), methods=("white", "power"), estimators=("frf", "gain"),
                        samples=50, experiments=3, profile_replicates=0)  # fmt: skip
    seen: list[tuple[float, int]] = []
    look = lambda done, total: seen.append((memory_mb(), len(os.listdir("/proc/self/fd"))))
    fill_store(settings, runs // 2, tmp_path, jobs=1, progress=look)
    settled, end = seen[4 * len(seen) // 5], seen[-1]
    record_figure(f"memory in MB after four fifths and at the end of {runs} runs", (settled[0], end[0]))
    assert end[1] == settled[1]
    assert end[0] < settled[0] + GROWTH_MB
