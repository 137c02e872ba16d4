"""
A better input for tomorrow
===========================

Today's record is there, the rig is free again tomorrow: which input is worth applying?

The record is the hair dryer of the textbooks. A model is fitted to half of it; the design takes what that half has
told as known, and asks what 500 further samples of the same power can add. It is compared with the kind of input that
was used (a binary signal) by what each promises, and by what each delivers on the fitted model as a stand-in for the rig.
"""

import matplotlib.pyplot as plt
import numpy as np

from benchmarks.campaign.plants import hair_dryer_record
from estimators import identify
from estimators.pem.uncertainty import bode_band
from oed import simulated, solve_design
from oed.data import Record
from oed.information import information_of_records
from oed.plants.norms import gain_gradient
from oed.signals.synthesis import realise

N = 500
record = hair_dryer_record()
today = record[:N]
fit = identify(today, "oe", (2, 2), delay=3, offset=True, initial="zero")
print(f"today: gain {fit.hinf_norm[0]:.4f} +- {fit.hinf_norm[1]:.4f}")

# %%
# The design
# ----------
# For the largest gain, given what today's record has told. The certificate is a bound that no input of this power passes.

plant = fit.to_plant()
used = record.u[N : 2 * N] - record.u.mean(axis=0)  # the same kind of input once more
known = information_of_records(plant, [today.u - today.u.mean(axis=0)])
design = solve_design(plant, "hinf", input_power=float(np.mean(used**2)), prior=known / N)
print(design)

# %%
# Tomorrow
# --------
# What is promised is the delta method on the Fisher information; what is reached is the error of a joint fit.

planned = realise(design.spectrum, N, rng=np.random.default_rng(1))
centred = today.replace(u=today.u - today.u.mean(axis=0), y=today.y - today.y.mean(axis=0))
rig = simulated(plant, seed=11)
gradient = gain_gradient(plant)
promised, fits = {}, {"today": fit}
print("tomorrow's input      promised error of the gain   error after the experiment")
for name, u in {"the same again": used, "the designed one": planned}.items():
    new = Record(u, rig(u), dt=record.dt)
    fits[name] = identify([centred, new], "oe", (2, 2), delay=3, offset=False)
    covariance = np.linalg.inv(known + information_of_records(plant, [u]))
    promised[name] = float(np.sqrt(gradient @ covariance @ gradient))
    print(f"{name:20s}  {promised[name]:26.5f}   {fits[name].hinf_norm[1]:26.5f}")

# %%
# What the choice buys
# --------------------
# The gain of a hair dryer is largest for slow changes, so all the power goes there; what is asked of other frequencies
# stays as well known as today.

_, left = plt.subplots(figsize=(3.6, 3.2), layout="constrained")
seconds = np.arange(N) * record.dt
left.plot(seconds, used[:, 0], color="C1", lw=0.8, label="the same again")
left.plot(seconds, planned[:, 0], color="C0", lw=2, label="the designed one")
left.set(title="two inputs of the same power", xlabel="time [s]", ylabel="heater, about its mean [V]")
left.legend(loc="lower right", fontsize="small")
omega = np.geomspace(1e-3, np.pi, 300)
_, right = plt.subplots(figsize=(3.6, 3.2), layout="constrained")
for (name, each), color in zip(fits.items(), ("0.5", "C1", "C0"), strict=True):
    error = bode_band(each, omega)[0].standard_error[:, 0, 0]
    right.loglog(omega / (2 * np.pi * record.dt), error, color=color, label=name)
right.set(title="error of the gain", xlabel="frequency [Hz]", ylabel="standard error [V/V]")
right.legend(fontsize="small")
plt.show()
