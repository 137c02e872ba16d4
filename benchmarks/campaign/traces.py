"""Traces to files: every input and output of the experiments of a run."""

from __future__ import annotations

import io
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from oed.errors import InputError
from oed.files.writing import write_whole

if TYPE_CHECKING:
    from estimators.rules.trace import Trace


def trace_file(path: str) -> Path:
    """The file that a trace can be written into; complaints come before any work."""
    target = Path(path)
    if target.suffix not in (".npz", ".csv"):
        raise InputError(f"--out is {path}; the file must end in .npz or .csv.")
    if target.exists():
        raise InputError(f"{path} exists; nothing is overwritten: give another name or remove it.")
    if not target.parent.is_dir():
        raise InputError(f"the folder {target.parent} does not exist; make it first.")
    return target


def write_trace(trace: Trace, path: str) -> None:
    """Write the experiments of a trace, stacked in time, with their numbers."""
    target = trace_file(path)
    file = io.BytesIO()
    if target.suffix == ".npz":
        np.savez_compressed(
            file,
            u=np.stack([r.u for r in trace.records]),
            y=np.stack([r.y for r in trace.records]),
            kinds=np.array(trace.kinds),
            dt=trace.records[0].dt,
        )
    else:
        first = trace.records[0]
        header = ",".join(["experiment", "t", *first.input_names, *first.output_names])
        rows = [
            np.column_stack([np.full(len(r), k + 1.0), r.t, r.u, r.y]) for k, r in enumerate(trace.records)
        ]
        np.savetxt(file, np.vstack(rows), delimiter=",", header=header, comments="", fmt="%.17g")
    write_whole(target, file.getvalue())
