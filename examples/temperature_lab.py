"""
The Temperature Control Lab
===========================

A rig that nobody here wrote: the Temperature Control Lab, two heaters and two sensors (`pip install "oed[rig]"`).

The package `tclab` drives the real board and simulates it: quantised sensors, coupled heaters. The textbook model of it
is one first-order lag from each heater to its own sensor. Four questions, each answered by measuring:

1. How wrong is the textbook model at worst?       iterations on model minus rig, by a session
2. Why?                                            residual of a record -> cause, without being told
3. Which input next?                               D-optimal for the model with the cause added
4. Is it better now?                               the same errors on a record that was not used, and 1. once more
"""

import io
import random
from contextlib import redirect_stdout
from dataclasses import replace
from typing import Any

import matplotlib.pyplot as plt
import numpy as np

from estimators import diagnose, identify
from estimators.diagnosis.loop import Setting
from estimators.sessions import Session, Settings
from estimators.sessions.checking import check_input
from estimators.sessions.layout import measured, placed
from oed import solve_design
from oed.data import Record
from oed.information import information_of_records
from oed.plants.json import plant_to_json
from oed.signals.synthesis import realise

# heaters at 40 +- 35 %, a sample every 8 s, 32 minutes an experiment
LEVEL, RANGE, DT, N = 40.0, 35.0, 8.0, 240
STEP = 0.3223  # degC between two readings of the sensor
SETTINGS = Settings(
    "procedure-2", samples=N, dt=DT, experiments=20, lead=100, level=(LEVEL, LEVEL), amplitude=(RANGE, RANGE),
    inputs=("Q1", "Q2"), outputs=("T1", "T2"), input_units=("%", "%"), output_units=("degC", "degC"),
)  # fmt: skip
TEXTBOOK = ([[1, 0], [0, 1]], [[1, 0], [0, 1]])
COUPLED = ([[2, 2], [2, 2]], [[2, 2], [2, 2]])

# %%
# The rig
# -------
# Simulated here, and stepped by hand; `clocked` is what runs on the real board.


def stepped(u: np.ndarray, seed: int) -> np.ndarray:
    """The simulated lab with its clock stepped by hand: settled at the level first, then the input row by row."""
    import tclab

    random.seed(seed)  # the package draws its sensor noise there
    with redirect_stdout(io.StringIO()):
        lab = tclab.setup(connected=False)(synced=False)
    lab.tlast = 0.0  # it begins at the wall clock's time since the import: another number in every run
    lab.Q1(LEVEL)
    lab.Q2(LEVEL)
    now, y = 2000.0, np.empty((len(u), 2))
    lab.update(now)
    for k, (first, second) in enumerate(u):
        now += DT
        y[k] = lab.T1, lab.T2
        lab.Q1(first)
        lab.Q2(second)
        lab.update(now)
    return y


def clocked(u: np.ndarray, speedup: int) -> np.ndarray:
    """The same against the wall clock, sped up: what runs on the real board with connected=True and speedup=1."""
    import tclab

    y = np.empty((len(u), 2))
    with redirect_stdout(io.StringIO()), tclab.setup(connected=False, speedup=speedup)() as lab:
        begin = tclab.labtime.time()
        for k, (first, second) in enumerate(u):
            y[k] = lab.T1, lab.T2
            lab.Q1(first)
            lab.Q2(second)
            tclab.labtime.sleep(max(begin + (k + 1) * DT - tclab.labtime.time(), 0.0))
    return y


# %%
# Experiments on it
# -----------------


def experiment(u: np.ndarray, seed: int) -> Record:
    """One experiment within the limits: deviations from the level in, deviations from the resting output back."""
    whole = placed(u, SETTINGS)
    check_input(whole, SETTINGS)
    y = measured(stepped(whole, seed), SETTINGS).y
    return Record(u, y, dt=DT, input_names=SETTINGS.inputs, output_names=SETTINGS.outputs)


def levels(rng: np.random.Generator, size: float) -> np.ndarray:
    """Random heater levels, each held for a while: what one would try first."""
    columns = []
    for _ in range(2):
        holds = 2 ** rng.integers(1, 6, N)
        columns.append(np.repeat(rng.uniform(-size, size, N), holds)[:N])
    return np.column_stack(columns)


def error(fit: Any, record: Record) -> float:
    """Root mean square error of a model's simulation, in degrees."""
    return float(np.sqrt(np.mean((record.y - fit.simulate(record.u)) ** 2)))


def worst_error(fit: Any, seed: int) -> Any:
    """Norm of model minus rig by the iterations: a session, with the lab as its rig."""
    session = Session(replace(SETTINGS, model=plant_to_json(fit.to_plant())))
    seeds = iter(range(seed, seed + 100))
    return session.run(lambda u: stepped(u, next(seeds)))


def _uncertainty(plant: Any, inputs: list[np.ndarray]) -> float:
    """det(covariance)^(1/2n) with every parameter relative to its own size."""
    scaled = information_of_records(plant, inputs) * np.outer(plant.theta, plant.theta)
    return float(np.exp(-np.linalg.slogdet(scaled)[1] / (2 * len(plant.theta))))


# %%
# The four questions
# ------------------


def main() -> dict[str, Any]:
    rng = np.random.default_rng(1)
    first = experiment(levels(rng, 20.0), seed=1)
    unseen = experiment(levels(rng, RANGE), seed=2)
    textbook = identify(first, "oe", TEXTBOOK, delay=1, offset=False)
    before = worst_error(textbook, 100)
    print(f"1. the textbook model is wrong by {before.value:.3f} degC/% at worst (95 % interval "
          f"{before.interval[0]:.3f} to {before.interval[1]:.3f}), at {before.frequency / DT:.4f} rad/s\n")  # fmt: skip

    found = diagnose(first, unseen, Setting(structure="diagonal", orders=(1, 1), separate=True))
    print(f"2. {found}\n")

    coupled = identify(first, "oe", COUPLED, delay=1, offset=False)
    plant = coupled.to_plant()
    known = information_of_records(plant, [first.u])
    power = float(np.mean(np.sum(first.u**2, axis=1)))
    design = solve_design(plant, "D", input_power=power, prior=known / N)
    print(f"3. {design}\n")
    draws = [realise(design.spectrum, N, rng=rng) for _ in range(50)]
    planned = min(draws, key=lambda u: float(np.abs(u).max()))  # the phases whose peak is lowest
    planned = planned * min(1.0, RANGE / float(np.abs(planned).max()))
    again = levels(rng, 20.0)
    again = again * np.sqrt(np.sum(planned**2) / np.sum(again**2))  # the same energy, without a design
    rows = [
        ("first order, each heater alone", error(textbook, unseen), float("nan")),
        ("cause found and added", found.rmse_after.value, float("nan")),
        ("second order, coupled, same record", error(coupled, unseen), _uncertainty(plant, [first.u])),
    ]
    for name, u, seed in (
        ("  and the same kind of input again", again, 3),
        ("  and the designed input", planned, 4),
    ):
        best = identify([first, experiment(u, seed)], "oe", COUPLED, delay=1, offset=False)
        rows.append((name, error(best, unseen), _uncertainty(plant, [first.u, u])))
    print(f"{'4. model':40s} error on unseen data   uncertainty (geometric mean, relative)")
    for name, value, spread in rows:
        print(f"{name:40s} {value:12.4f} degC       {spread:14.5f}")
    after = worst_error(best, 200)
    print(
        f"\nthe norm of model minus rig: {before.value:.3f} -> {after.value:.3f} degC/% "
        f"(95 % interval {after.interval[0]:.3f} to {after.interval[1]:.3f}); "
        f"the sensor's step alone makes an error of {STEP / np.sqrt(12):.3f} degC"
    )
    return {
        "rows": rows, "effect": found.effect, "variant": found.variant, "floor": found.noise_floor, "gap": design.gap,
        "norm_before": before, "norm_after": after, "planned": planned,
        "before": found.rmse_before.value, "after": found.rmse_after.value, "unseen": unseen, "textbook": textbook, "best": best,
    }  # fmt: skip


if __name__ == "__main__":
    told = main()

# %%
# Before and after
# ----------------


def draw(told: dict[str, Any]) -> None:
    unseen, minutes = told["unseen"], np.arange(N) * DT / 60
    axes = [plt.subplots(figsize=(3.6, 3.2), layout="constrained")[1] for _ in range(4)]
    for column, ax in enumerate(axes[:2]):
        ax.plot(minutes, unseen.y[:, column], ".", color="0.6", ms=3, label="measured, not used for fitting")
        for name, color in (("textbook", "C1"), ("best", "C0")):
            ax.plot(minutes, told[name].simulate(unseen.u)[:, column], color, lw=1, label=f"{name} model")
        ax.set(title=f"T{column + 1}, deviation from rest", xlabel="time [min]", ylabel="degC")
    axes[0].legend(fontsize="x-small")
    axes[2].step(minutes, LEVEL + told["planned"], lw=1, label=["Q1", "Q2"])
    for limit in (LEVEL + RANGE, LEVEL - RANGE):
        axes[2].axhline(limit, color="C3", ls=":")
    axes[2].set(title="the designed input", xlabel="time [min]", ylabel="heater [%]")
    axes[2].legend(loc="lower left", fontsize="x-small")
    names = ["textbook", "cause added", "second order,\ncoupled", "the same\nagain", "designed\ninput"][::-1]
    values = [value for _, value, _ in told["rows"]][::-1]
    bars = axes[3].barh(names, values, color=["C0", "C0", "C0", "C2", "C1"])
    axes[3].bar_label(bars, fmt=" %.3f", fontsize="x-small")
    axes[3].set(title="error on unseen data", xlabel="degC", xscale="log", xlim=(0.07, 3))
    axes[3].axvline(STEP / np.sqrt(12), color="0.5", ls=":", label="the sensor's step alone")
    axes[3].legend(fontsize="x-small")
    plt.show()


if __name__ == "__main__":
    draw(told)
