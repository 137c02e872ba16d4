"""
What is my model missing?
=========================

A model is there, a rig is there, and they differ: by how much at worst, where, and why?

The iterations run on model minus rig: every input goes to the rig, its simulated output is subtracted, and the pq
directed experiments take the place of the transposed system. What comes out is the norm of the model error with an
interval, the frequency and the direction where it is worst, and the smallest correction that explains it. Here the rig
is the synthetic vibration-isolation table, and its model knows only one of its two modes.
"""

import matplotlib.pyplot as plt
import numpy as np

from estimators.sessions import Session, Settings, what_is_missing
from oed import named_plant, simulated
from oed.plants.json import plant_to_json
from oed.plants.plant import Plant

# Largest gain 1.95 at 296 Hz with a half-power width of 24 Hz, and the directions in which it acts.
HERTZ, WIDTH, GAIN, DT = 296.0, 24.0, 1.95, 0.001


def one_mode() -> Plant:
    """The mode at 296 Hz alone, as somebody would have modelled it who looked there."""
    half = np.tan(np.pi * WIDTH * DT)
    radius2 = (1 - half) / (1 + half)
    num = GAIN * (1 - radius2) / 2 * np.array([0.0, 1.0, 0.0, -1.0])
    den = [1.0, -(1 + radius2) * np.cos(2 * np.pi * HERTZ * DT), radius2]
    out, into = np.deg2rad(40.0), np.deg2rad(50.0)
    shape = np.outer([-np.sin(out), np.cos(out)], [-np.sin(into), np.cos(into)])
    return Plant([[num * g for g in row] for row in shape], [[den, den], [den, den]], dt=DT, name="model")


# %%
# How wrong, and where
# --------------------

table, model = named_plant("avis", 1e-4), one_mode()
settings = Settings(
    "procedure-2", samples=500, dt=DT, experiments=20, model=plant_to_json(model),
    inputs=("fz", "mphi"), outputs=("z", "phi"), amplitude=(3.0, 3.0),
)  # fmt: skip
session = Session(settings)
found = session.run(simulated(table, seed=5))
turn = 2 * np.pi * DT
low, high = found.interval
print(f"norm of the model error: {found.value:.4f}, 95 % interval {low:.4f} to {high:.4f}")
print(f"worst at {found.frequency / turn:.2f} Hz, input direction {np.round(found.direction.real, 3)}")

# %%
# Why
# ---

missing = what_is_missing(session.trace, model, found.frequency)
cause = missing.cause
print(f"missing from the model: {cause}")
print("ranked:", ", ".join(c.name for c in missing.causes))
print(f"the missing mode is at {cause.parameters['frequency'] / turn:.2f} Hz")

# %%
# In a picture
# ------------
# Left, what no experimenter sees: the rig's own gain, known here because it is simulated. The point is what the
# experiments found without it. Right: how much of the model error each correction leaves, on records held out.

_, left = plt.subplots(figsize=(3.6, 3.2), layout="constrained")
omega = np.linspace(0.01, np.pi, 2000)
largest = lambda g: np.linalg.svd(g, compute_uv=False)[:, 0]
truth, known = table.transfer(omega), model.transfer(omega)
left.semilogy(omega / turn, largest(truth), "0.8", lw=5, label="rig")
left.semilogy(omega / turn, largest(known), "C1", label="model")
left.semilogy(omega / turn, largest(truth - known), "C0--", label="rig minus model")
left.plot(found.frequency / turn, found.value, "o", color="C3", label="found by 20 experiments")
left.set(title="largest gain", xlabel="frequency [Hz]", ylim=(5e-3, 4))
left.legend(fontsize="small")
_, right = plt.subplots(figsize=(3.6, 3.2), layout="constrained")
names = [c.name for c in missing.causes][::-1]
right.barh(
    names, [c.after for c in missing.causes][::-1], color=["C0" if n == cause.name else "0.7" for n in names]
)
right.set(title="model error left, rms", xscale="log", xlabel="output about its mean")
plt.show()
