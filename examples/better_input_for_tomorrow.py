"""
A better input for tomorrow
===========================

Today's record is there, the rig is free again tomorrow: which input is worth applying?

The record is the hair dryer of the textbooks. A model is fitted to half of it; the design takes what that half has
told as known, and asks what 500 further samples of the same power can add. It is compared with the kind of input that
was used (a binary signal) by what each promises, and by what each delivers on the fitted model as a stand-in for the rig.

    python examples/better_input_for_tomorrow.py
"""

from __future__ import annotations

import numpy as np

from benchmarks.campaign.plants import hair_dryer_record
from estimators import identify
from oed import simulated, solve_design
from oed.data import Record
from oed.information import information_of_records
from oed.signals.synthesis import realise

N = 500


def main() -> dict[str, float]:
    record = hair_dryer_record()
    today = record[:N]
    fit = identify(today, "oe", (2, 2), delay=3, offset=True, initial="zero")
    print(f"today: gain {fit.hinf_norm[0]:.4f} +- {fit.hinf_norm[1]:.4f}\n")

    plant = fit.to_plant()
    used = record.u[N : 2 * N] - record.u.mean(axis=0)  # the same kind of input once more
    power = float(np.mean(used**2))
    known = information_of_records(plant, [today.u - today.u.mean(axis=0)])
    design = solve_design(plant, "hinf", input_power=power, prior=known / N)
    print(design, "\n")
    planned = realise(design.spectrum, N, rng=np.random.default_rng(1))

    rig = simulated(plant, seed=11)
    found: dict[str, float] = {}
    print("tomorrow's input      promised error of the gain   error after the experiment")
    for name, u in (("the same again", used), ("the designed one", planned)):
        new = Record(u, rig(u), dt=record.dt)
        joint = identify([_centred(today), new], "oe", (2, 2), delay=3, offset=False)
        promise = _promised(plant, known + information_of_records(plant, [u]))
        print(f"{name:20s}  {promise:26.5f}   {joint.hinf_norm[1]:26.5f}")
        key = name.split()[-1]
        found |= {f"promised_{key}": promise, f"reached_{key}": float(joint.hinf_norm[1])}
    return found | {"gap": float(design.gap)}


def _centred(record: Record) -> Record:
    return record.replace(u=record.u - record.u.mean(axis=0), y=record.y - record.y.mean(axis=0))


def _promised(plant, information: np.ndarray) -> float:
    """Standard error of the largest gain: the delta method on the Fisher information."""
    from oed.plants.norms import gain_gradient

    c = gain_gradient(plant)
    return float(np.sqrt(c @ np.linalg.solve(information, c)))


if __name__ == "__main__":
    main()
