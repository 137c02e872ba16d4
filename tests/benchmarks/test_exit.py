"""A process that has read Parquet ends as it should: no thread of Arrow's is left that could free a Python buffer.

An Arrow thread that lets go of a Python object while the interpreter ends asks for the GIL, is ended for it, and
aborts the process ("terminate called without an active exception", exit status 134) after all work was done.
"""

from __future__ import annotations

import ast
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[2]
HOME = ROOT / "oed" / "files" / "parquet.py"
THREADS = """
import io, os, sys
from pathlib import Path
import pyarrow as pa
from oed.files.parquet import open_parquet, read_columns, table_bytes
content = table_bytes(pa.table({"a": list(range(1000)), "b": ["x"] * 1000}))
before = len(os.listdir("/proc/self/task"))
path = Path(sys.argv[1]) / "x.parquet"
path.write_bytes(content)
for source in (content, path):
    with open_parquet(source) as file:
        read_columns(file)
        read_columns(file, ["b"])
        list(file.iter_batches(100, columns=["b"], use_threads=False))
ours = len(os.listdir("/proc/self/task"))
from pyarrow import parquet
parquet.read_table(io.BytesIO(content))
print(ours - before, len(os.listdir("/proc/self/task")) - ours, flush=True)
os._exit(0)  # or this process aborts as described above
"""
SHORT = """
import sys
from benchmarks.tables.formats import from_parquet
from_parquet(sys.argv[1])  # the last act: what the abort needs
"""
PROCESSES = 500


@pytest.mark.skipif(not Path("/proc/self/task").is_dir(), reason="counts threads under /proc")
def test_reading_starts_no_thread(tmp_path):
    done = subprocess.run(
        [sys.executable, "-c", THREADS, tmp_path], capture_output=True, text=True, check=True
    )
    ours, asynchronous = map(int, done.stdout.split())
    assert ours == 0
    assert asynchronous > 0, "the negative control: Arrow's own reader starts threads"


def test_one_file_opens_and_writes_parquet():
    """Who else named pyarrow.parquet could read through the scanner again."""
    for package in ("oed", "estimators", "benchmarks"):
        for path in (ROOT / package).rglob("*.py"):
            text = path.read_text(encoding="utf-8")
            for node in ast.walk(ast.parse(text)) if "pyarrow" in text else ():
                names = (
                    [alias.name for alias in node.names]
                    if isinstance(node, ast.Import | ast.ImportFrom)
                    else []
                )
                module = (node.module or "") if isinstance(node, ast.ImportFrom) else ""
                for name in names:
                    full = f"{module}.{name}".lstrip(".")
                    wrong = full.startswith(
                        ("pyarrow.parquet", "pyarrow.dataset", "pyarrow.csv", "pyarrow.feather")
                    )
                    assert path == HOME or not wrong, f"{path}: line {node.lineno}: {full}"
    calls = {
        n.func.attr
        for n in ast.walk(ast.parse(HOME.read_text()))
        if isinstance(n, ast.Call) and isinstance(n.func, ast.Attribute)
    }
    assert "ParquetFile" in calls
    assert not calls & {"read_table", "read_pandas", "ParquetDataset"}


@pytest.mark.validate
def test_short_processes_end_well(tmp_path, record_figure):
    from benchmarks.tables.formats import to_parquet

    path = to_parquet([{"a": k, "b": "x"} for k in range(1000)], tmp_path / "t.parquet")
    ended = [
        subprocess.run([sys.executable, "-c", SHORT, path], capture_output=True).returncode
        for _ in range(PROCESSES)
    ]
    record_figure("short processes that ended otherwise than with 0", sum(code != 0 for code in ended))
    assert ended == [0] * PROCESSES
