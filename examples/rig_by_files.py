"""
A rig by files
==============

A rig that is driven by LabVIEW, a Speedgoat or an Arduino: it reads a file and writes a file.

Everything goes through the command line and through files, as it would beside a machine; only the machine is played by
the function `machine`. Half-way it hands back a file that was cut off, which is refused, and measures again.
"""

import csv
import sys
import tempfile
from contextlib import chdir, redirect_stderr, redirect_stdout
from io import StringIO
from pathlib import Path

import matplotlib.pyplot as plt
import numpy as np

from benchmarks.cli import main as oed
from estimators.sessions import open_session
from oed import named_plant, peak, simulated

PLANT = named_plant("two-peaks", 0.01)
apply = simulated(PLANT, seed=2)


def machine(given: Path, written: Path) -> None:
    """What the rig's own software does: the columns t_s and force_N in, t_s and position_mm out."""
    with given.open() as file:
        rows = list(csv.reader(file))[1:]
    measured = apply([[float(force)] for _, force in rows])
    with written.open("w", newline="") as file:
        writer = csv.writer(file)
        writer.writerow(["t_s", "position_mm"])
        writer.writerows([t, position] for (t, _), (position,) in zip(rows, measured.tolist(), strict=True))


def command(*words: str) -> int:
    """`oed session ...`, what it says, and its exit status."""
    said = StringIO()
    with redirect_stdout(said), redirect_stderr(said):
        status = oed(["session", *words])
    print("$ oed session", *words, f"\n{said.getvalue()}")
    return status


# %%
# Six experiments
# ---------------
# The folder `rig` holds all there is: settings, inputs, outputs and a journal. A computer that is switched off in
# between loses nothing.

folder = Path(sys.argv[1] if len(sys.argv) > 1 else tempfile.mkdtemp())
measured, refused, estimates = Path("measured.csv"), 0, []
with chdir(folder):
    command(
        "start", "rig", "--method", "power", "--samples", "400", "--dt", "0.005", "--experiments", "6",
        "--inputs", "force_N", "--outputs", "position_mm", "--amplitude", "4", "--rate", "900",
    )  # fmt: skip
    for step in range(1, 7):
        command("next", "rig")
        machine(Path(f"rig/input-{step:04d}.csv"), measured)
        if step == 3:  # the disk of the rig was slow
            whole = measured.read_text()
            measured.write_text(whole[: len(whole) // 2])
            refused += command("record", "rig", "measured.csv") == 2
            measured.write_text(whole)
        command("record", "rig", "measured.csv")
        session = open_session("rig")
        estimates.append(session.estimate())
print(f"the truth is {peak(PLANT).value:.4f}")

# %%
# What the machine was given
# --------------------------
# Each input keeps the limits of the rig: 4 N, and 900 N/s, which is the one that is reached first.

_, left = plt.subplots(figsize=(3.6, 3.2), layout="constrained")
ms = 5 * np.arange(100)
for k, color in ((0, "0.6"), (5, "C0")):
    rate = np.diff(session.trace.records[k].u[:101, 0]) / 0.005
    left.plot(ms, rate, color=color, lw=1, label=f"input {k + 1}")
left.axhline(900, color="C3", ls=":", label="limit")
left.axhline(-900, color="C3", ls=":")
left.set(title="the first and the last input", xlabel="time [ms]", ylabel="change of the force [N/s]")
left.legend(loc="upper right", fontsize="small")
values = np.array([e.value for e in estimates])
half = values - [e.interval[0] for e in estimates]
_, right = plt.subplots(figsize=(3.6, 3.2), layout="constrained")
right.errorbar(range(1, 7), values, half, fmt="o", ms=4, capsize=3, label="estimate, 95 % interval")
right.axhline(peak(PLANT).value, color="0.5", ls=":", label="the truth")
right.set(title="the largest gain", xlabel="experiment", ylabel="mm/N")
right.legend(fontsize="small")
plt.show()
