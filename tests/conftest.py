"""What all tests share: a seeded generator, the marks, and the record that `make validate` leaves."""

from __future__ import annotations

import json
import math
import os
import platform
import subprocess
import zlib
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path

import numpy as np
import pytest
from hypothesis import HealthCheck, settings

ROOT = Path(__file__).resolve().parent.parent
SLOW_SECONDS = 5.0

# The same examples in every run: a test that fails now and then is worse than one that always fails.
settings.register_profile(
    "oed", derandomize=True, deadline=None, database=None, suppress_health_check=[HealthCheck.too_slow]
)
# Other examples in every run, to look for what the fixed ones miss: pytest --hypothesis-profile=search
settings.register_profile(
    "search", deadline=None, database=None, print_blob=True, suppress_health_check=[HealthCheck.too_slow]
)
settings.load_profile("oed")


@pytest.fixture
def rng(request: pytest.FixtureRequest) -> np.random.Generator:
    """A generator seeded by the test's package, file and name: the same draws alone, in any order, on any worker, and in
    whatever folder of its package the file is."""
    path, _, name = request.node.nodeid.partition("::")
    parts = path.split("/")
    key = "/".join([*parts[:2], *parts[2:][-1:]]) + "::" + name
    return np.random.default_rng(zlib.crc32(key.encode()))


@pytest.fixture
def record_figure(request: pytest.FixtureRequest):
    """Keep a number that a test arrived at, for `validation.json`: record_figure("rho", 0.97, seed=3)."""

    def record(name: str, value: object, **how: object) -> None:
        # Workers send plain values only: arrays and NumPy numbers anywhere inside become lists and numbers.
        plain = json.loads(json.dumps({"name": name, "value": value, **how}, default=lambda x: x.tolist()))
        request.node.user_properties.append(("figure", plain))

    return record


@pytest.fixture
def shared_data() -> Path:
    """The folder of shared records, or a skip where it is not there."""
    return _folder("OED_DATA")


@pytest.fixture
def shared_cases() -> Path:
    """The folder of shared cases, or a skip where it is not there."""
    return _folder("OED_CASES")


def _folder(variable: str) -> Path:
    folder = os.environ.get(variable)
    if not folder or not Path(folder).is_dir():
        pytest.skip(f"{variable} names no folder")
    return Path(folder)


def pytest_addoption(parser: pytest.Parser) -> None:
    parser.addoption("--validation-json", metavar="FILE", help="write outcomes and recorded figures to FILE")
    parser.addoption(
        "--one-of-each",
        action="store_true",
        help="each test with the first of its parameters: what a further Python or library may break, not the numbers",
    )


def pytest_configure(config: pytest.Config) -> None:
    if not hasattr(config, "workerinput"):  # the controller, or the only process
        config.pluginmanager.register(_Record(config), "oed-record")


@pytest.hookimpl(
    trylast=True
)  # of what marks and keywords leave: the first of a test's parameters may be slow
def pytest_collection_modifyitems(config: pytest.Config, items: list[pytest.Item]) -> None:
    kept = items
    if "validate" not in (config.option.markexpr or ""):
        kept = [item for item in kept if not item.get_closest_marker("validate")]
    if config.option.one_of_each:
        first = {item.nodeid.partition("[")[0]: item for item in reversed(kept)}
        kept = [item for item in kept if first[item.nodeid.partition("[")[0]] is item]
    chosen = set(kept)
    if left_out := [item for item in items if item not in chosen]:
        config.hook.pytest_deselected(items=left_out)
        items[:] = kept


class _Record:
    """What the run was, test by test: for `validation.json` and for a word about unmarked slow tests."""

    def __init__(self, config: pytest.Config) -> None:
        self.config = config
        self.rows: dict[str, dict] = {}

    def pytest_runtest_logreport(self, report: pytest.TestReport) -> None:
        row = self.rows.setdefault(report.nodeid, {"outcome": "passed", "seconds": 0.0, "figures": []})
        row["seconds"] += report.duration
        row["slow"] = bool({"slow", "validate"} & set(report.keywords))
        if report.when == "call":
            row["figures"] = [value for name, value in report.user_properties if name == "figure"]
        if report.outcome != "passed":
            row["outcome"] = report.outcome

    def pytest_terminal_summary(self, terminalreporter) -> None:
        unmarked = {
            k: r["seconds"] for k, r in self.rows.items() if r["seconds"] > SLOW_SECONDS and not r["slow"]
        }
        if unmarked:
            terminalreporter.section(f"over {SLOW_SECONDS:g} s and not marked slow")
            for name, seconds in sorted(unmarked.items(), key=lambda pair: -pair[1]):
                terminalreporter.write_line(f"{seconds:7.1f} s  {name}")

    def pytest_sessionfinish(self) -> None:
        target = self.config.getoption("--validation-json")
        if not target:
            return
        document = {
            "schema_version": 1,
            "commit": _git("rev-parse", "HEAD"),
            "uncommitted_changes": bool(_git("status", "--porcelain", "--untracked-files=no")),
            "python": platform.python_version(),
            "machine": platform.machine(),
            "versions": {
                name: _version(name) for name in ("oed", "numpy", "scipy", "casadi", "cvxpy", "clarabel")
            },
            "outcomes": {
                outcome: sum(row["outcome"] == outcome for row in self.rows.values())
                for outcome in ("passed", "failed", "skipped")
            },
            "tests": {
                name: {
                    "outcome": row["outcome"],
                    "seconds": round(row["seconds"], 2),
                    "figures": row["figures"],
                }
                for name, row in sorted(self.rows.items())
            },
        }
        Path(target).write_text(json.dumps(_finite(document), indent=1) + "\n", encoding="utf-8")


def _finite(value):
    """The value as JSON can hold it: non-finite numbers are null, what is not plain is its text."""
    match value:
        case dict():
            return {str(key): _finite(item) for key, item in value.items()}
        case list() | tuple():
            return [_finite(item) for item in value]
        case float():
            return value if math.isfinite(value) else None
        case None | bool() | int() | str():
            return value
    return str(value)


def _git(*arguments: str) -> str | None:
    try:
        run = subprocess.run(["git", *arguments], cwd=ROOT, capture_output=True, text=True, check=False)
    except OSError:
        return None
    return run.stdout.strip() if run.returncode == 0 else None


def _version(name: str) -> str | None:
    try:
        return version(name)
    except PackageNotFoundError:
        return None
