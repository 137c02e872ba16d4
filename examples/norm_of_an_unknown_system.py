"""
The norm of an unknown system
=============================

The H-infinity norm of a system that nobody has modelled, from experiments on it alone.

A session hands out inputs and takes measured outputs. Here the system is a Python function; on a rig it would be
the function that plays `u` through the amplifier and returns what the sensor saw.

    python examples/norm_of_an_unknown_system.py
"""

from __future__ import annotations

from estimators.sessions import Session, Settings
from oed import named_plant, peak, simulated


def main() -> dict[str, float]:
    plant = named_plant("reference", 0.1)  # known to this script only for the comparison at its end
    rig = simulated(plant, seed=3)

    # 600 samples every 10 ms, and never more than 3 V: the iterations scale every input to its limits.
    session = Session(
        Settings(
            "power",
            samples=600,
            dt=0.01,
            experiments=10,
            inputs=("drive",),
            input_units=("V",),
            amplitude=(3.0,),
        )
    )
    print("experiment   estimate   95 % interval")
    while session.step:
        step = session.step
        session.tell(rig(session.ask()))
        now = session.estimate()
        print(f"{step:10d}   {now.value:8.4f}   {now.interval[0]:.4f} to {now.interval[1]:.4f}")

    found = session.estimate()
    true = peak(plant).value
    hertz = found.frequency / (2 * 3.141592653589793 * 0.01)
    print(f"\nThe largest gain is {found.value:.4f}, at {hertz:.3f} Hz; the truth is {true:.4f}.")
    print(f"Largest input applied: {session.trace.usage.peak:.3f} V.")
    return {
        "value": found.value, "standard_error": found.standard_error, "true": true, "peak": session.trace.usage.peak,
    }  # fmt: skip


if __name__ == "__main__":
    main()
