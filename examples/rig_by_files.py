"""
A rig by files
==============

A rig that is driven by LabVIEW, a Speedgoat or an Arduino: it reads a file and writes a file.

Everything goes through the command line and through files, as it would beside a machine; only the machine is played by
the function `machine`. Half-way it hands back a file that was cut off, which is refused, and measures again.

    python examples/rig_by_files.py [FOLDER]
"""

from __future__ import annotations

import csv
import json
import sys
import tempfile
from contextlib import redirect_stdout
from io import StringIO
from pathlib import Path

from benchmarks.cli import main as oed
from oed import named_plant, peak, simulated

PLANT = named_plant("two-peaks", 0.01)


def machine(given: Path, written: Path, apply) -> None:
    """What the rig's own software does: the columns t_s and force_N in, t_s and position_mm out."""
    with given.open() as file:
        rows = list(csv.reader(file))[1:]
    measured = apply([[float(force)] for _, force in rows])
    with written.open("w", newline="") as file:
        writer = csv.writer(file)
        writer.writerow(["t_s", "position_mm"])
        writer.writerows([t, position] for (t, _), (position,) in zip(rows, measured.tolist(), strict=True))


def command(*words: str) -> dict:
    """`oed session ... --json`, and what it says."""
    said = StringIO()
    print("$ oed session", *words)
    with redirect_stdout(said):
        status = oed(["session", *words])
    print(said.getvalue().rstrip())
    return {"status": status}


def main(folder: str | None = None) -> dict[str, float]:
    place = Path(folder or tempfile.mkdtemp(prefix="oed-session-"))
    session, measured = str(place / "rig"), place / "measured.csv"
    apply = simulated(PLANT, seed=2)
    command(
        "start", session, "--method", "power", "--samples", "400", "--dt", "0.005", "--experiments", "6",
        "--inputs", "force_N", "--outputs", "position_mm", "--amplitude", "4", "--rate", "900",
    )  # fmt: skip
    refused = 0
    for step in range(1, 7):
        command("next", session)
        machine(place / "rig" / f"input-{step:04d}.csv", measured, apply)
        if step == 3:  # the disk of the rig was slow
            whole = measured.read_text()
            measured.write_text(whole[: len(whole) // 2])
            refused += command("record", session, str(measured))["status"] == 2
            measured.write_text(whole)
        command("record", session, str(measured))
    command("estimate", session)

    from estimators.sessions import open_session

    found = open_session(session).estimate()
    settings = json.loads((place / "rig" / "session.json").read_text())
    print(f"\nall files are in {session}; the truth is {peak(PLANT).value:.4f}")
    return {
        "value": found.value, "standard_error": found.standard_error, "true": peak(PLANT).value, "refused": refused,
        "samples": settings["samples"],
    }  # fmt: skip


if __name__ == "__main__":
    main(*sys.argv[1:2])
