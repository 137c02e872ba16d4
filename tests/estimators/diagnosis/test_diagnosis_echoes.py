"""Where the input answers the output, what a run gains by knowing its past from the input is no effect."""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np
from scipy.signal import lfilter

from estimators.diagnosis.policy import Policy
from estimators.diagnosis.search.named import Bench
from oed.data import Record


def judge(record: Record, linear: np.ndarray, **fields: bool) -> Bench:
    """A bench on which only runs are compared: every sample counts, `linear` (N,) is the linear model's run."""
    n = len(record)
    base = SimpleNamespace(
        blocks=SimpleNamespace(counting=lambda records: [np.ones((n, 1), dtype=bool)]),
        unused=[linear[:, None]],
    )
    return Bench(
        SimpleNamespace(keep=np.ones(n, dtype=bool)),
        base,
        0,
        record,
        1,
        True,
        True,
        Policy(),
        0.01,
        1,
        **fields,
    )  # pyright: ignore[reportArgumentType]


def test_what_an_input_answers_is_noise_only_where_a_better_model_leaves_it() -> None:
    """An input that follows w after two samples, where w is a part of the output that the linear model lacks: no echo. Where w is
    noise, a run that knows its past by the input gains as much, and leaves what the input answers."""
    rng, n = np.random.default_rng(5), 1500
    w, e, v = rng.standard_normal(n), 0.2 * rng.standard_normal(n), rng.standard_normal(n)
    slow = lfilter([1.0], [1.0, -0.95], w)
    u = np.concatenate(([0.0, 0.0], w[:-2])) + 0.5 * v
    record, zero = Record(u, slow + e), np.zeros(n)
    bench = judge(record, zero, feedback=True)
    knows, heard = slow, np.concatenate(([0.0], 0.95 * slow[:-1]))
    for run, share in ((knows, 0.9), (heard, 0.0)):
        gain = bench.over(run, zero)
        assert (gain.share > 0.9) == (share > 0.0)
        assert bench.echoes(run) == (share == 0.0)
    # Where noise is what the input answers, each run has a noise model of its own: under that of the smooth error the gain is .12.
    answering = Record(np.concatenate(([0.0, 0.0], e[:-2])) + 0.1 * v, 0.1 * slow + e)
    assert judge(answering, zero, feedback=True).over(0.1 * slow, zero).share > 0.15


def test_little_beyond_a_linear_model_is_no_answer_where_the_input_answers_at_once() -> None:
    rng, n = np.random.default_rng(6), 1500
    y = rng.standard_normal(n)
    for share, echo in ((0.01, True), (0.45, True), (0.55, False)):
        assert judge(Record(y, y), np.zeros(n), inverse=True).echoes(share * y) is echo
