"""Plant, campaign and session files with something in them changed: what they were, or one line that refuses them."""

from __future__ import annotations

import contextlib
import copy
import json
import os
import signal
import tempfile
import time
import tomllib
from pathlib import Path

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from benchmarks.campaign.settings import Settings as Campaign
from benchmarks.campaign.settings import campaign_from_toml
from estimators.diagnosis.cases import diagnose_files
from estimators.sessions.settings import Settings, settings_from_json, settings_to_json
from oed.errors import OedError
from oed.models.model import Model, arx, bj, model_from_json
from oed.models.statespaces import StateSpace
from oed.plants.json import plant_from_json, plant_to_json

TESTS = 11  # with those of the readers and of the arguments beside this file
MANY = int(os.environ.get("OED_FUZZ", "0"))
quick = settings(
    max_examples=MANY // TESTS or 100, derandomize=not MANY, database=None, deadline=None,
    suppress_health_check=list(HealthCheck),
)  # fmt: skip
PLANTS = (
    {"num": [[[0, 0.2155, 0.2012]]], "den": [[[1, -0.9854, 0.8187]]], "dt": 1, "free": ["b1"],
     "noise": {"covariance": [[2.0]], "filter": {"num": [1, 0.5], "den": [1, -0.3]}}},
    {"A": [[0.5, 0.1], [0, 0.3]], "B": [[1], [1]], "C": [[1, 0]], "D": [[0]], "dt": 0.1, "noise": {"variance": 3}},
    {"num": [[[0, 1], [0, 2]], [[0, 1], [0, 3]]], "den": [[[1, -0.5], [1]], [[1, -0.2], [1, 0.3]]],
     "noise": {"covariance": [[2.0, 1], [1, 3]]}},
)  # fmt: skip
MODELS = tuple(
    Model(structure, [0.1, 0.2, 0.5, 0.3, 0.1, -0.2][: structure.n], [[1.0]], 0.5).to_dict()
    for structure in (arx(2, 1), bj(1, 1, 1, 1), StateSpace((2,)))
)
CAMPAIGN = {
    "plants": ["reference", "random-fir-1..3"], "noise_variances": [1.0, 0.1], "methods": ["white", "power"],
    "estimators": ["frf", "pem"], "samples": 100, "experiments": 5, "seed": 3, "profile_replicates": 0, "replicates": 4,
    "time_limit": 2.5, "out": "results/x", "limit": [{"replicates": 2, "plant": "random-*", "noise_variance": 0.1, "why": "time"}],
}  # fmt: skip
META = {"sampling_time": 1.0, "suggested_order": 2, "structure": "SISO", "signals": "deviations", "note": "x", "inputs": ["u"],
        "outputs": ["y"], "time_unit": "s", "rig": [1]}  # fmt: skip
ODD = (None, True, 0, -1, 1e-320, 1e308, -1e308, 1e-300, [], {}, "x", "", [[]], [[[]]], [1], [1, 2, 3], 1e150, 5,
       [[1, 2], [3]], {"a": 1}, 0.999999999, -0.0, float("nan"), float("inf"), 10**400)  # fmt: skip
SECONDS = {signal.SIGPROF: (signal.ITIMER_PROF, 20), signal.SIGALRM: (signal.ITIMER_REAL, 120)}
"""What an input may take at most: of work, and by the clock, but for what other processes hold up."""


def held_up() -> float:
    """Seconds for which this process could have run and others did: 1.5 s of work have taken 43 on a busy machine."""
    try:
        return int(Path("/proc/self/schedstat").read_text().split()[1]) / 1e9
    except (OSError, IndexError):  # not on Linux
        return 0.0


@contextlib.contextmanager
def in_time():
    """The block does not work, wait or hang for longer than it may."""
    begun = time.monotonic() - held_up()

    def late(number, frame):
        timer, most = SECONDS[number]
        left = most - (time.monotonic() - held_up() - begun)
        if number == signal.SIGPROF or left < 0.1:
            raise AssertionError(f"more than {most} s")
        signal.setitimer(timer, left)

    before = {number: signal.signal(number, late) for number in SECONDS}
    for timer in SECONDS.values():
        signal.setitimer(*timer)
    try:
        yield
    finally:
        for number, (timer, _) in SECONDS.items():
            signal.setitimer(timer, 0)
            signal.signal(number, before[number])


changes = st.lists(
    st.tuples(st.integers(0, 999), st.sampled_from(["set", "set", "drop", "add"]), st.sampled_from(ODD)),
    min_size=1, max_size=2,
)  # fmt: skip


def places(value, path=()):
    """Paths of everything inside a document."""
    found = [path] if path else []
    inside = value.items() if isinstance(value, dict) else enumerate(value) if isinstance(value, list) else ()
    for key, entry in inside:
        found += places(entry, (*path, key))
    return found


def changed(content, how):
    content = copy.deepcopy(content)
    for number, kind, value in how:
        paths = places(content)
        if not paths:
            break
        *parents, last = paths[number % len(paths)]
        inside = content
        for key in parents:
            inside = inside[key]
        if kind == "drop":
            del inside[last]
        elif kind == "add" and isinstance(inside, list):
            inside.insert(last, copy.deepcopy(value))
        else:
            inside[last if kind == "set" or number % 2 else "varance"] = copy.deepcopy(value)
    return content


def read(reader):
    """What is read; None where it was refused in a line."""
    try:
        with in_time():
            return reader()
    except OedError as error:
        said = str(error)
    assert 10 < len(said) < 2000
    return None


@quick
@given(st.sampled_from(PLANTS), changes)
def test_a_changed_plant_is_read_as_it_stands_or_refused(content, how):
    content = changed(content, how)
    plant = read(lambda: plant_from_json(content))
    if plant is None:
        return
    assert all(np.isfinite(p).all() for side in (plant.num, plant.den) for row in side for p in row)
    again = plant_from_json(json.loads(json.dumps(plant_to_json(plant))))
    assert plant_to_json(again) == plant_to_json(plant)
    if "num" in content:  # the slow reading: every coefficient over the leading one
        num, den = (
            side if isinstance(side[0], list) else [[side]] for side in (content["num"], content["den"])
        )
        for i, row in enumerate(num):
            for j, entry in enumerate(row):
                assert plant.num[i][j].tolist() == [float(v) / den[i][j][0] for v in entry]


@quick
@given(st.sampled_from(MODELS), changes)
def test_a_changed_model_is_read_as_it_stands_or_refused(content, how):
    content = changed(content, how)
    model = read(lambda: model_from_json(json.dumps(content)))
    if model is None:
        return
    said = json.loads(model.to_json())
    assert said["theta"] == content["theta"]
    assert said["noise_covariance"] == content["noise_covariance"]
    assert {k: v for k, v in said["structure"].items() if k in content["structure"]} == content["structure"]
    read(lambda: plant_from_json(content))


@quick
@given(changes)
def test_a_changed_session_is_read_as_it_stands_or_refused(how):
    content = json.loads(
        settings_to_json(Settings("power", 100, amplitude=(2.0,), sensor_range=((-1.0, 1.0),)))
    )
    text = json.dumps(changed(content, how))
    found = read(lambda: settings_from_json(text, "session.json"))
    if found is None:
        return
    assert settings_from_json(settings_to_json(found), "again") == found


def toml(value) -> str:
    """A value as TOML has it, also where TOML has none."""
    if isinstance(value, dict):
        return "{" + ", ".join(f"{json.dumps(k)} = {toml(v)}" for k, v in value.items()) + "}"
    if isinstance(value, list):
        return "[" + ", ".join(map(toml, value)) + "]"
    return str(value) if isinstance(value, float) else json.dumps(value)


@quick
@given(
    changes,
    st.sampled_from(["", "", "", "seed = 4\n", "[[limit]]\nreplicates = 1\n", "x", "\0", "a.b = 1\n"]),
    st.integers(0, 3),
)
def test_a_changed_campaign_is_read_as_it_stands_or_refused(how, more, cut):
    content = changed(CAMPAIGN, how)
    text = "".join(f"{json.dumps(key)} = {toml(value)}\n" for key, value in content.items())
    text = (text[: -len(text) // cut - 1] if cut > 1 else text) + more
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "c.toml"
        path.write_text(text)
        found = read(lambda: campaign_from_toml(path))
    if found is None:
        return
    meant = tomllib.loads(text)
    limits = found.pop("limits", ())
    assert {key: list(v) if isinstance(v, tuple) else v for key, v in found.items()} == {
        key: value for key, value in meant.items() if key != "limit"
    }
    for limit, entry in zip(limits, meant.get("limit", ()), strict=True):
        assert all(getattr(limit, key) == value for key, value in entry.items())
    deciding = {key: found[key] for key in found.keys() & Campaign.__dataclass_fields__.keys()}
    read(lambda: Campaign(**deciding, limits=limits))


@quick
@given(changes)
def test_a_changed_description_is_read_or_refused(how):
    with tempfile.TemporaryDirectory() as folder:
        for name, text in (("x.csv", "u,y\n1,2\n2,3\n"), ("meta.json", json.dumps(changed(META, how)))):
            (Path(folder) / name).write_text(text)
        with pytest.raises(OedError) as refused:  # a record of two samples is none to diagnose
            diagnose_files(Path(folder) / "x.csv", meta=Path(folder) / "meta.json")
    assert 10 < len(str(refused.value)) < 2000
