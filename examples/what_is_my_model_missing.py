"""
What is my model missing?
=========================

A model is there, a rig is there, and they differ: by how much at worst, where, and why?

The iterations run on model minus rig: every input goes to the rig, its simulated output is subtracted, and the pq
directed experiments take the place of the transposed system. What comes out is the norm of the model error with an
interval, the frequency and the direction where it is worst, and the smallest correction that explains it. Here the rig
is the synthetic vibration-isolation table, and its model knows only one of its two modes.

    python examples/what_is_my_model_missing.py
"""

from __future__ import annotations

import numpy as np

from estimators.sessions import Session, Settings, what_is_missing
from oed import named_plant, simulated
from oed.plants.json import plant_to_json
from oed.plants.plant import Plant

# Largest gain 1.95 at 296 Hz with a half-power width of 24 Hz, and the directions in which it acts.
HERTZ, WIDTH, GAIN, DT = 296.0, 24.0, 1.95, 0.001


def model() -> Plant:
    """The mode at 296 Hz alone, as somebody would have modelled it who looked there."""
    half = np.tan(np.pi * WIDTH * DT)
    radius2 = (1 - half) / (1 + half)
    num = GAIN * (1 - radius2) / 2 * np.array([0.0, 1.0, 0.0, -1.0])
    den = [1.0, -(1 + radius2) * np.cos(2 * np.pi * HERTZ * DT), radius2]
    out, into = np.deg2rad(40.0), np.deg2rad(50.0)
    shape = np.outer([-np.sin(out), np.cos(out)], [-np.sin(into), np.cos(into)])
    return Plant([[num * g for g in row] for row in shape], [[den, den], [den, den]], dt=DT, name="model")


def main() -> dict[str, float | str]:
    rig = simulated(named_plant("avis", 1e-4), seed=5)
    settings = Settings(
        "procedure-2", samples=500, dt=DT, experiments=20, model=plant_to_json(model()),
        inputs=("fz", "mphi"), outputs=("z", "phi"), amplitude=(3.0, 3.0),
    )  # fmt: skip
    session = Session(settings)
    found = session.run(rig)
    hertz = found.frequency / (2 * np.pi * DT)
    low, high = found.interval
    print(f"norm of the model error: {found.value:.4f}, 95 % interval {low:.4f} to {high:.4f}")
    print(f"worst at {hertz:.2f} Hz, input direction {np.round(found.direction.real, 3)}\n")

    missing = what_is_missing(session.trace, model(), found.frequency)
    cause = missing.cause
    print(f"missing from the model: {cause}")
    print("ranked:", ", ".join(c.name for c in missing.causes))
    print(f"\nthe missing mode is at {cause.parameters['frequency'] / (2 * np.pi * DT):.2f} Hz")
    return {
        "value": found.value, "low": low, "high": high, "hertz": hertz, "cause": cause.name,
        "before": cause.before, "after": cause.after,
    }  # fmt: skip


if __name__ == "__main__":
    main()
