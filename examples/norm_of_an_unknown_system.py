"""
The norm of an unknown system
=============================

The H-infinity norm of a system that nobody has modelled, from experiments on it alone.

A session hands out inputs and takes measured outputs. Here the system is a Python function; on a rig it would be
the function that plays `u` through the amplifier and returns what the sensor saw.
"""

import matplotlib.pyplot as plt
import numpy as np

from estimators.sessions import Session, Settings
from oed import named_plant, peak, simulated

DT = 0.01
plant = named_plant("reference", 0.1)  # known to this script only for the comparison at its end
rig = simulated(plant, seed=3)

# %%
# Ten experiments
# ---------------
# 600 samples every 10 ms, and never more than 3 V: the iterations scale every input to its limits.

session = Session(
    Settings(
        "power", samples=600, dt=DT, experiments=10, inputs=("drive",), input_units=("V",), amplitude=(3.0,)
    )
)
estimates = []
print("experiment   estimate   95 % interval")
while session.step:
    step = session.step
    session.tell(rig(session.ask()))
    now = session.estimate()
    estimates.append(now)
    print(f"{step:10d}   {now.value:8.4f}   {now.interval[0]:.4f} to {now.interval[1]:.4f}")

true, turn = peak(plant), 2 * np.pi * DT
print(
    f"\nThe largest gain is {now.value:.4f}, at {now.frequency / turn:.3f} Hz; the truth is {true.value:.4f}."
)
print(f"Largest input applied: {session.trace.usage.peak:.3f} V.")

# %%
# What the iterations do
# ----------------------
# The first input is white. Every next one is made of the output before it, so its power gathers where the gain is
# largest, and the interval closes on the truth.

_, left = plt.subplots(figsize=(3.6, 3.2), layout="constrained")
values = np.array([e.value for e in estimates])
half = values - [e.interval[0] for e in estimates]
left.errorbar(range(1, 11), values, half, fmt="o", ms=4, capsize=3, label="estimate, 95 % interval")
left.axhline(true.value, color="0.5", ls=":", label="the truth")
left.set(title="the largest gain", xlabel="experiment", ylabel="gain")
left.legend(fontsize="small")
omega = np.fft.rfftfreq(600) * 2 * np.pi
_, right = plt.subplots(figsize=(3.6, 3.2), layout="constrained")
for k, color in ((0, "0.6"), (1, "C1"), (9, "C0")):
    power = np.abs(np.fft.rfft(session.trace.records[k].u[:, 0])) ** 2
    right.semilogy(omega / turn, power / power.sum(), color=color, lw=1, label=f"input {k + 1}")
right.plot(omega / turn, np.abs(plant.transfer(omega)[:, 0, 0]) / 10, "k--", lw=1, label="gain / 10")
right.set(title="share of the input's power", xlabel="frequency [Hz]", ylim=(1e-5, 2))
right.legend(fontsize="small")
plt.show()
