"""Simulated rigs in folders: records for the tool, truth for the grader.

    python -m tests.rigs.generate --out DIR --seed N [--rigs a,b]

writes DIR/public/E_practice/case_NNN/{train,test}.csv and meta.json, and DIR/truth/E_practice/case_NNN.json. A case keeps its number and
its values whichever rigs are asked for. The four `linear_*` rigs and `speckle` are controls: nothing predicts better than the best
linear model, so that their share removed means nothing, and a claim made there is a false one.
"""

from __future__ import annotations

import argparse
import json
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Any
from zlib import crc32

import numpy as np
from scipy.signal import butter, chirp, lfilter

from tests.rigs import catalogue_coupled, ode_kernels  # noqa: F401  (registers its rigs)
from tests.rigs.catalogue import RIGS, Draw, Rig
from tests.rigs.reference import best_linear, black_box, fitted, rms

SET = "E_practice"
REST, TEST_LENGTHS, TRAIN_LENGTHS = 15, (500, 800), (1000, 1500)
MATTERS, USEFUL = (
    1.8,
    0.8,
)  # the linear model's error is at least so many noises, and at most this part of the output's deviation
CONTROL = 1.15  # a control's linear model errs by at most so many noises
ATTEMPTS = 40
NOTE = (
    "two experiments, train and test, whose times are on one clock; levels are logged, nothing is subtracted; both start from rest; "
    "the error is the rms over every sample and output of test"
)


# -- excitation ---------------------------------------------------------------------------------------------------------------------


def holds(n: int, g: np.random.Generator, shortest: int, longest: int, level) -> np.ndarray:
    lengths = g.integers(shortest, longest + 1, n // shortest + 1)
    return np.repeat([level(i) for i in range(len(lengths))], lengths)[:n]


def operator(n: int, g: np.random.Generator, band: float) -> np.ndarray:
    """Holds, ramps and second thoughts, as by hand."""
    x, at = [], 0.0
    while len(x) < n:
        to = g.uniform(-1.8, 1.8)
        if g.random() < 0.5:
            x.extend(np.linspace(at, to, int(g.integers(3, 4 + int(3 / band)))))
        x.extend([to] * int(g.integers(2 + int(0.5 / band), 4 + int(4 / band))))
        at = to * (0.7 if g.random() < 0.2 else 1)
        x.extend([at] * int(0.5 / band))
    return np.array(x[:n])


def excitation(kind: str, n: int, g: np.random.Generator, band: float) -> np.ndarray:
    """(n,) about zero, of unit rms, its power below about 2 `band` rad per sample."""
    t = np.arange(n)
    if kind == "prbs":
        clock = max(1, round(g.uniform(0.5, 0.9) / band))
        x = holds(n, g, clock, clock, lambda i: g.choice([-1.0, 1.0]))
    elif kind == "steps":
        x = holds(n, g, max(3, int(0.8 / band)), int(5 / band) + 4, lambda i: g.uniform(-1.7, 1.7))
    elif kind == "noise":
        x = lfilter(*butter(2, min(0.85, g.uniform(1.4, 2.4) * band / np.pi)), g.standard_normal(n + 300))[
            300:
        ]
    elif kind == "multisine":
        lines = np.arange(1, 2 + int(min(g.uniform(2, 3.2) * band, 2.6) * n / 2 / np.pi))
        lines = lines if len(lines) < 60 else np.sort(g.choice(lines, 60, replace=False))
        x = np.cos(2 * np.pi * np.outer(t, lines) / n + g.uniform(0, 2 * np.pi, len(lines))).sum(1)
    elif kind == "swept":
        sweep = n / int(g.integers(2, 5))
        f = np.array([0.12 * band, min(2.8 * band, 2.6)]) / 2 / np.pi
        x = chirp(t % sweep, f[0], sweep, f[1], phi=g.uniform(0, 360)) * (
            1 + 0.35 * np.sin(2 * np.pi * t * g.uniform(1.5, 5) / n)
        )
    else:
        x = operator(n, g, band)
    return x / rms(x)


def command(d: Draw, kind: str, n: int, g: np.random.Generator, scale: float, shift: float) -> np.ndarray:
    """(n, channels) input as logged: first at rest, then about the middle (times `scale`, `shift` rms away)."""
    middle, amp = np.atleast_1d(np.asarray(d.u, float)), np.atleast_1d(np.asarray(d.amp, float))
    x = np.column_stack([excitation(kind, n - REST, g, d.band) for _ in middle])
    return np.vstack(
        [np.tile(at_rest(d), (REST, 1)), np.clip(middle + amp * (scale * x + shift), d.lo, d.hi)]
    )


# -- simulation ---------------------------------------------------------------------------------------------------------------------


def at_rest(d: Draw) -> np.ndarray:
    return np.atleast_1d(np.asarray(d.u if d.rest is None else d.rest, float))


@dataclass(frozen=True, eq=False)
class Plant:
    """A drawn rig that can be simulated, with its parameters or others."""

    rig: Rig
    d: Draw

    def states(self, values: np.ndarray, u: np.ndarray, x: np.ndarray, k0: int, stride: int) -> np.ndarray:
        u = np.ascontiguousarray(u, float)
        return ode_kernels.integrate(
            self.rig.rhs, self.rig.jump, values, u, x, self.d.ts, k0, self.d.steps, stride
        )

    def settled(self, values: np.ndarray, k0: int, channels: int) -> np.ndarray:
        """State after a long rest; the hidden channel is silent."""
        x = np.array(self.d.x0, float)
        rest = np.r_[at_rest(self.d), np.zeros(channels - len(at_rest(self.d)))]
        if self.d.settle:
            self.states(values, np.tile(rest, (self.d.settle, 1)), x, k0 - self.d.settle, self.d.steps)
        return x

    def __call__(
        self, values: np.ndarray, u: np.ndarray, k0: int, hidden: np.ndarray | None = None
    ) -> np.ndarray:
        """(samples, outputs) without sensor noise."""
        p, k = dict(zip(self.d.p, values)), k0 + np.arange(len(u))
        true = u if self.d.actual is None else self.d.actual(u, p, k)
        true = true if hidden is None else np.column_stack([true, hidden])
        x = self.settled(values, k0, true.shape[1])
        return self.d.out(self.states(values, true, x, k0, 1 if self.d.fine else self.d.steps), p, k)

    def controlled(self, values, n, g, kind, sigma) -> tuple[np.ndarray, np.ndarray]:
        """Input and measured output of PI control through the noise, following steps of the set point."""
        d, k = self.d, np.arange(1)
        gain, integral = d.gains
        x, u, y, total = self.settled(values, 0, 1), np.empty((n, 1)), np.empty((n, 1)), 0.0
        static = self.d.out(x[None], d.p, k)[0, 0]
        target = static + np.r_[np.zeros(REST), d.amp * 0.4 * excitation(kind, n - REST, g, d.band / 2)]
        for i in range(n):
            y[i] = d.out(x[None], d.p, k)[0] + sigma * g.standard_normal()
            total += integral * (target[i] - y[i, 0])
            u[i] = at_rest(d) + gain * (target[i] - y[i, 0]) + total
            self.states(values, u[i : i + 1], x, i, d.steps)
        return u, y


@dataclass(frozen=True, eq=False)
class Records:
    u: np.ndarray
    y: np.ndarray
    ut: np.ndarray
    yt: np.ndarray
    clean: np.ndarray  # test by the true model with the true parameters
    k0: int
    sigma: np.ndarray
    how: dict[str, Any]


def recorded(plant: Plant, g: np.random.Generator, different: bool) -> Records:
    d, values = plant.d, np.array(list(plant.d.p.values()))
    n, nt = int(g.integers(*TRAIN_LENGTHS)), int(g.integers(*TEST_LENGTHS))
    k0, kinds = n + int(g.integers(20, 200)), d.kinds.split()
    train = test = str(g.choice(kinds))
    scale, shift = 1.0, 0.0
    if different:
        test = str(g.choice([kind for kind in kinds if kind != train]))
        scale, shift = (
            (g.uniform(0.6, 0.9) if g.random() < 0.6 else g.uniform(1.05, 1.2)),
            g.uniform(-0.3, 0.3),
        )
    ut = command(d, test, nt, g, scale, shift)
    clean = plant(values, ut, k0)
    sigma = np.exp(g.uniform(*np.log(d.noise))) * clean[REST:].std(0)
    hidden = [d.hidden(g, m) if d.hidden else None for m in (n, nt)]
    noisy = lambda y: y + (sigma + d.noise_gain * np.abs(y)) * g.standard_normal(y.shape)
    if d.gains is None:
        u = command(d, train, n, g, 1.0, 0.0)
        y = noisy(plant(values, u, 0, hidden[0]))
    else:
        u, y = plant.controlled(values, n, g, train, sigma)
    how = {
        "train": train + (" in closed loop" if d.gains else ""),
        "test": test,
        "test_scale": scale,
        "test_shift": shift,
        "different": different,
    }
    return Records(u, y, ut, noisy(plant(values, ut, k0, hidden[1])), clean, k0, sigma, how)


# -- one case -----------------------------------------------------------------------------------------------------------------------


def acceptable(rig: Rig, r: Records, linear: float, ideal: float) -> bool:
    """The effect matters, yet the linear model is of use; a control's linear model is as good as any."""
    enough = MATTERS * ideal <= linear if rig.matters else linear <= CONTROL * ideal
    return bool(enough and linear < USEFUL * rms(r.yt - r.yt.mean(0)))


@dataclass(frozen=True, eq=False)
class Case:
    """An accepted draw with its records, and the best linear model's prediction of test."""

    name: str
    seed: int
    plant: Plant
    records: Records
    linear: np.ndarray
    notes: list[dict[str, Any]]
    attempt: int

    @property
    def errors(self) -> tuple[float, float]:
        """Test error of the best linear model, and of the true model with the true parameters."""
        return rms(self.records.yt - self.linear), rms(self.records.yt - self.records.clean)


def draw(name: str, seed: int) -> Case:
    """A rig, drawn again until it is acceptable."""
    rig, different = RIGS[name], (seed + list(RIGS).index(name)) % 2 == 0
    for attempt in range(ATTEMPTS):
        g = np.random.default_rng([seed, crc32(name.encode()), attempt])
        plant = Plant(rig, rig.draw(g))
        r = recorded(plant, g, different)
        if np.all(np.isfinite(r.y)) and np.all(np.isfinite(r.yt)):
            case = Case(name, seed, plant, r, *best_linear(r.u, r.y, r.ut, plant.d.delays), attempt)
            if acceptable(rig, r, *case.errors):
                return case
    raise ValueError(f"{name}: no acceptable draw in {ATTEMPTS} with seed {seed}")


def attainable(case: Case) -> tuple[np.ndarray, float]:
    """Prediction of test by the true structure fitted to train, and the fit's error over the noise."""
    plant, r = case.plant, case.records
    values = np.array(list(plant.d.p.values()))
    free = [i for i, key in enumerate(plant.d.p) if key not in plant.d.frozen.split()]

    def at(factors):
        moved = values.copy()
        moved[free] *= factors
        return moved

    g = np.random.default_rng([case.seed, crc32(case.name.encode()), case.attempt, 1])
    factors, over_noise = fitted(
        lambda f, rows: plant(at(f), r.u[:rows], 0), r.y, r.sigma, len(free), g, plant.d.coarse
    )
    return plant(at(factors), r.ut, r.k0), over_noise


def truth_of(case: Case) -> tuple[dict[str, Any], np.ndarray]:
    """What the grader reads of a case, and test by the true model, by the fitted one and by the linear one."""
    rig, d, r = case.plant.rig, case.plant.d, case.records
    (linear, ideal), (fit, over_noise) = case.errors, attainable(case)
    free, boxes = black_box(r.u, r.y, r.ut, r.yt, d.delays, case.seed)
    truth = {
        "rig": case.name,
        "half": "practice",
        "families": [case.name],
        "linear_part": rig.linear_part,
        "equation": rig.equation,
        "nature": rig.nature,
    }
    truth |= {
        "names": rig.names,
        "near_labels": rig.near,
        "params": d.p,
        "noise_std": r.sigma.tolist(),
        "test_std": float(r.clean.std()),
    }
    truth |= {
        "criterion_ideal": ideal,
        "criterion_linear": linear,
        "attainable": rms(r.yt - fit),
        "attainable_train_over_noise": over_noise,
    }
    truth |= {
        "black_box": rms(r.yt - free),
        "black_box_info": boxes,
        "linear_model": case.notes,
        "ratio": linear / ideal,
        "excitation": r.how,
    }
    truth |= {
        "linear_over_std": linear / rms(r.yt - r.yt.mean(0)),
        "matters": rig.matters,
        "draw_attempt": case.attempt,
    }
    return truth, np.hstack([r.clean, fit, case.linear])


def write(folder: Path, case: str, c: Case, truth: dict[str, Any], curves: np.ndarray) -> None:
    d, r = c.plant.d, c.records
    public, hidden = folder / "public" / SET / case, folder / "truth" / SET
    public.mkdir(parents=True, exist_ok=True)
    hidden.mkdir(parents=True, exist_ok=True)
    several = r.u.shape[1] > 1
    inputs, outputs = (["u1", "u2"], ["y1", "y2"]) if several else (["u"], ["y"])
    for name, k0, u, y in (("train", 0, r.u, r.y), ("test", r.k0, r.ut, r.yt)):
        rows = np.column_stack([(k0 + np.arange(len(u))) * d.ts, u, y])
        header = ",".join(["t", *inputs, *outputs])
        np.savetxt(
            public / f"{name}.csv",
            rows,
            fmt=["%.10g", *["%.8g"] * (rows.shape[1] - 1)],
            delimiter=",",
            header=header,
            comments="",
        )
    meta = {
        "id": case,
        "sampling_time": d.ts,
        "time_unit": "s",
        "inputs": inputs,
        "outputs": outputs,
        "input_unit": d.units[0],
        "output_unit": d.units[1],
    }
    meta |= {
        "input_hold": "zero-order",
        "signals": "as logged",
        "structure": "full" if several else "SISO",
        "suggested_order": d.order,
    }
    meta |= {"n_train": len(r.u), "n_test": len(r.ut), "note": NOTE}
    (public / "meta.json").write_text(json.dumps(meta, indent=1))
    names = [
        f"{curve}{j + 1 if several else ''}" for curve in ("clean", "fit", "lti") for j in range(len(outputs))
    ]
    np.savetxt(
        hidden / f"{case}_clean.csv", curves, fmt="%.9g", delimiter=",", header=",".join(names), comments=""
    )
    (hidden / f"{case}.json").write_text(json.dumps({"id": case, "set": SET} | truth, indent=1))


def numbered(seed: int) -> dict[str, str]:
    """Case number of every rig, shuffled by the seed so that the number tells nothing."""
    order = np.random.default_rng([seed, len(RIGS)]).permutation(len(RIGS))
    return {list(RIGS)[at]: f"case_{i:03d}" for i, at in enumerate(order, 1)}


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--out", required=True, type=Path)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--rigs", default="")
    wanted = parser.parse_args()
    print(
        "case     rig                    N    ideal   linear attainable black box  (over ideal; tries, seconds)"
    )
    for name, case in numbered(wanted.seed).items():
        if wanted.rigs and name not in wanted.rigs.split(","):
            continue
        began, c = time.perf_counter(), draw(name, wanted.seed)
        T, curves = truth_of(c)
        write(wanted.out, case, c, T, curves)
        ratios = [T[key] / T["criterion_ideal"] for key in ("criterion_linear", "attainable", "black_box")]
        print(
            f"{case} {name:22s} {len(c.records.u):4d} {T['criterion_ideal']:8.3g} {ratios[0]:8.2f} {ratios[1]:10.2f} {ratios[2]:9.2f}",
            end="  ",
        )
        print(
            f"lin/std {T['linear_over_std']:.2f} {T['excitation']['train']}>{T['excitation']['test']} {T['draw_attempt']} {time.perf_counter() - began:.1f}",
            flush=True,
        )


if __name__ == "__main__":
    main()
