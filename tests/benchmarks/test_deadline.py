"""A call that is given up: interrupted soon, but never in the middle of what other threads depend on."""

from __future__ import annotations

import sys
import threading
import time
import warnings

import numba
import pytest

from benchmarks.campaign import deadline
from benchmarks.campaign.deadline import TimeLimit, within
from benchmarks.campaign.settings import Limit, Settings
from benchmarks.campaign.whole_campaign import run_campaign
from oed.errors import InputError

SLOW_IMPORT = """
import sys, time
sys.times_begun = getattr(sys, "times_begun", 0) + 1
while not hasattr(sys, "may_end"):
    time.sleep(0.001)
whole = True
"""


def waited_for(condition, seconds: float = 20.0) -> bool:
    end = time.monotonic() + seconds
    while not condition() and time.monotonic() < end:
        time.sleep(0.01)
    return bool(condition())


def test_a_loop_ends_and_what_is_returned_or_raised_is_passed_on():
    seen = []

    def loop():
        while True:
            seen.append(time.monotonic())
            time.sleep(0.001)

    with pytest.raises(TimeLimit, match=r"stopped after 0.1 s"):
        within(0.1, loop)
    assert not [t for t in threading.enumerate() if t.name.startswith("time-limit")]
    count = len(seen)
    time.sleep(0.05)
    assert len(seen) == count
    assert within(5, lambda a, b: a + b, 1, b=2) == within(None, lambda: 3) == 3
    with pytest.raises(ZeroDivisionError):
        within(5, lambda: 1 / 0)
    with pytest.raises(InputError, match="must be positive"):
        within(0, lambda: 0)


def test_an_import_is_not_left_half_done(tmp_path, monkeypatch):
    (tmp_path / "imported_slowly.py").write_text(SLOW_IMPORT)
    monkeypatch.syspath_prepend(tmp_path)
    monkeypatch.setattr(deadline, "WAIT", 0.3)
    with pytest.raises(TimeLimit):
        within(0.1, __import__, "imported_slowly")
    monkeypatch.setattr(sys, "may_end", True, raising=False)
    import imported_slowly

    assert imported_slowly.whole
    assert sys.times_begun == 1


def test_the_compiler_is_not_left_locked():
    @numba.njit
    def added(x):
        return x + 1

    with pytest.raises(TimeLimit):
        within(0.002, added, 1.0)
    assert waited_for(lambda: added.signatures), "it was broken off"
    assert added(1.0) == 2


def test_filters_of_warnings_are_as_before():
    """`catch_warnings` is entered over and over: wherever it is interrupted, it puts back what was there."""
    before = list(warnings.filters)

    def loop():
        while True:
            with warnings.catch_warnings():
                warnings.simplefilter("error")

    for _ in range(5):
        with pytest.raises(TimeLimit):
            within(0.002, loop)
    assert warnings.filters == before


def test_a_call_that_takes_no_notice_once_is_interrupted_again(monkeypatch):
    class Deaf:
        def __del__(self):
            while True:
                time.sleep(0.001)

    def loop():
        Deaf()
        while True:
            time.sleep(0.001)

    ignored = []
    monkeypatch.setattr(sys, "unraisablehook", ignored.append)
    with pytest.raises(TimeLimit):
        within(0.1, loop)
    assert ignored
    assert waited_for(lambda: not [t for t in threading.enumerate() if t.name == "time-limited"])


def test_a_part_in_which_every_run_was_given_up_and_no_estimate_was_asked_for(tmp_path):
    """Its rows are of no estimator: they keep that it is to be tried again, and count as no information."""
    slow = lambda plant: lambda *_, **__: [time.sleep(0.001) for _ in range(10_000)]
    settings = Settings(plants=("reference",), noise_variances=(1.0,), methods=("white",), estimators=("frf",), samples=20,
                        experiments=2, profile_replicates=0, limits=(Limit(5, estimator="frf"),))  # fmt: skip
    (given_up,) = run_campaign(settings, 7, tmp_path / "x", jobs=1, time_limit=0.02, own={"white": slow})
    assert given_up.final["frf"].statuses == {"TIME_LIMIT": 5}
    assert given_up.information == ()
    (again,) = run_campaign(settings, 7, tmp_path / "x", jobs=1)
    (whole,) = run_campaign(settings, 7, tmp_path / "y", jobs=1)
    assert repr(again.information) == repr(whole.information)
