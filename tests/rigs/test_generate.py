"""The generated rigs are what they say: repeatable, solutions of their equations, and worth more than a linear model, but for the controls."""

from __future__ import annotations

import csv
import json
import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from scipy.integrate import solve_ivp

from tests.rigs import ode_kernels
from tests.rigs.catalogue import RIGS
from tests.rigs.generate import CONTROL, MATTERS, SET, Plant, at_rest, draw, numbered, rms, truth_of, write

SEED = 7
CONTROLS = {"linear_disturbed", "linear_closed_loop", "linear_level", "linear_two_by_two", "speckle"}
JUMPING = {name for name, rig in RIGS.items() if rig.jump is not ode_kernels.smooth}


def files(folder: Path) -> dict[str, bytes]:
    return {str(p.relative_to(folder)): p.read_bytes() for p in sorted(folder.rglob("*")) if p.is_file()}


@pytest.fixture(scope="module")
def twice(tmp_path_factory) -> list[Path]:
    """Three cases, the first two of them written again, and with another seed."""
    folders = []
    for seed, count in ((SEED, 3), (SEED, 2), (SEED + 1, 2)):
        folders.append(tmp_path_factory.mktemp("rigs"))
        for name in ("two_outlets", "linear_level", "mixing_tap")[:count]:
            case = draw(name, seed)
            write(folders[-1], numbered(seed)[name], case, *truth_of(case))
    return folders


@pytest.mark.slow
def test_a_seed_gives_the_same_files_bit_for_bit(twice) -> None:
    one, again, other = map(files, twice)
    assert len(one) == 15
    assert len(again) == 10
    assert again.items() <= one.items()
    assert not set(one.values()) & set(other.values())


@pytest.mark.slow
@pytest.mark.parametrize("name", RIGS)
def test_the_truth_beats_the_linear_model_but_for_the_controls(name: str) -> None:
    case = draw(name, SEED)
    linear, ideal = case.errors
    r = case.records
    assert (name in CONTROLS) != RIGS[name].matters
    assert linear <= CONTROL * ideal if name in CONTROLS else linear >= MATTERS * ideal
    if name not in CONTROLS:
        # What the true model leaves is the sensor's noise: within 12 %, over 3.5 standard deviations of the rms of 500 samples.
        assert ideal == pytest.approx(rms(r.sigma), rel=0.12)
        # Nor is it chaotic: parameters that are a thousandth off still predict, so that a good fit can be rewarded.
        values = np.array(list(case.plant.d.p.values()))
        moved = values * (
            1 + 1e-3 * np.array([key not in case.plant.d.frozen.split() for key in case.plant.d.p])
        )
        assert rms(case.plant(moved, r.ut, r.k0) - r.clean) < 0.5 * linear
    assert 1000 <= len(r.u) < 1500
    # At rest: nothing moves before the excitation but by noise (and what comes from outside: the day, the hum).
    assert np.all(r.u[:15] == r.u[0]) or case.plant.d.gains
    if name not in ("day_swing", "aliased_hum", "linear_disturbed", "speckle", "blind_encoder"):
        assert np.all(np.ptp(r.y[:15], axis=0) < 6 * r.sigma)


def by_solve_ivp(plant: Plant, u: np.ndarray) -> np.ndarray:
    """The states at the samples by an adaptive solver, which starts anew at every sample."""
    d = plant.d
    values, x = np.array(list(d.p.values())), plant.settled(np.array(list(d.p.values())), 0, u.shape[1])
    states, slope = [x], np.empty(len(x))

    def rhs(t, x, k):
        plant.rig.rhs(np.ascontiguousarray(x), np.r_[u[k], t], values, slope)
        return slope.copy()

    for k in range(len(u) - 1):
        span = (k * d.ts, (k + 1) * d.ts)
        states.append(
            solve_ivp(
                rhs, span, states[-1], args=(k,), method="DOP853", rtol=1e-9, atol=1e-10, max_step=d.ts / 8
            ).y[:, -1]
        )
    return np.array(states)


@pytest.mark.slow
@pytest.mark.parametrize("name", sorted(set(RIGS) - JUMPING))
def test_the_integrator_agrees_with_an_adaptive_one(name: str) -> None:
    plant = Plant(RIGS[name], RIGS[name].draw(g := np.random.default_rng(SEED)))
    d = plant.d
    u = at_rest(d) + np.atleast_1d(d.amp) * np.repeat(g.uniform(-1, 1, (10, len(at_rest(d)))), 4, axis=0)
    u = np.clip(u, d.lo, d.hi)
    values = np.array(list(d.p.values()))
    ours = plant.states(values, u, plant.settled(values, 0, u.shape[1]), 0, d.steps)
    theirs = by_solve_ivp(plant, u)
    # A corner inside a step (a gap that closes, a limit that is reached) costs an order: a thousandth is less than the noise.
    assert np.max(np.abs(ours - theirs) / (np.ptp(theirs, axis=0) + 1e-9 + 1e-6 * np.abs(theirs[0]))) < 1e-3


@pytest.mark.slow
def test_the_grader_reads_it(twice, tmp_path) -> None:
    """The true curve removes all of the error and the linear one none; words that name the effect count as named."""
    grader = Path(os.environ.get("OED_CASES", "")) / "rigs" / "score.py"
    if not grader.is_file():
        pytest.skip("OED_CASES does not hold the rigs' grader")
    lines = []
    for path in sorted((twice[0] / "truth" / SET).glob("*.json")):
        T = json.loads(path.read_text())
        with path.with_name(f"{path.stem}_clean.csv").open() as text:
            rows = list(csv.DictReader(text))
        curves = {
            c: [[float(v) for k, v in row.items() if k.rstrip("12") == c] for row in rows]
            for c in ("clean", "lti")
        }
        answer = {
            "effect": {"two_outlets": "a second outlet", "mixing_tap": "bilinear"}.get(T["rig"], ""),
            "detected": T["matters"],
        }
        lines.append(
            json.dumps(
                {"case": T["id"], "yhat_before": curves["lti"], "yhat_after": curves["clean"]} | answer
            )
        )
    (tmp_path / "results.jsonl").write_text("\n".join(lines))
    told = [
        sys.executable,
        str(grader),
        "--data",
        str(twice[0]),
        "--results",
        str(tmp_path / "results.jsonl"),
    ]
    subprocess.run([*told, "--json", str(tmp_path / "report.json")], check=True, capture_output=True)
    rows = {row["rig"]: row for row in json.loads((tmp_path / "report.json").read_text())["rows"]}
    assert {name: rows[name]["verdict"] for name in rows} == {
        "two_outlets": "exact",
        "mixing_tap": "exact",
        "linear_level": "missed",
    }
    for name in ("two_outlets", "mixing_tap"):
        assert rows[name]["removed"] == pytest.approx(1.0, abs=1e-6)
        assert rows[name]["before"] == pytest.approx(rows[name]["linear"], rel=1e-6)
