"""Records of one system that can be diagnosed together, and a test record that proves something."""

from collections.abc import Iterable, Sequence
from typing import Any

import numpy as np

from estimators.diagnosis.effects import Effect, Nature
from estimators.diagnosis.record.measurement import goes_with_clock
from estimators.diagnosis.record.overlap import copied_rows
from estimators.pem.checks import constant_output
from oed.data import Record, check_sizes
from oed.errors import CUBES, InputError
from oed.files.objects import as_records

LEAST = 50
"""Samples of a training record: five blocks of ten, below which no error on unused blocks says anything."""


STILL = 1e-12
"""Movement of a channel, of its size, that is none: the last digits of doubles."""


def _check(train: Record, test: Record | None) -> None:
    pair = (("training", train),) if test is None else (("training", train), ("test", test))
    for name, record in pair:
        if not np.isfinite(record.u).all():
            raise InputError(
                f"the {name} input has missing samples; simulation needs every input: fill or cut them."
            )
        check_sizes(record, f"the {name} record", CUBES)
    if len(train) < LEAST:
        raise InputError(
            f"the training record has {len(train)} samples; at least {LEAST} are needed: measure longer."
        )
    spread = np.std(train.u, axis=0)
    if np.any(spread <= STILL * (np.abs(train.u).max(axis=0) + 1e-300)):
        j = int(np.argmin(spread))
        raise InputError(
            f"the input {train.input_names[j]} is constant: there is no excitation; excite it and measure again."
        )
    if test is not None:
        check_fresh(train, test)


def check_fresh(train: Record, test: Record) -> None:
    """Refuse a test record of another system or clock, and one that was trained on."""
    _alike(train, test, "test record")
    shared = copied_rows(train, test)
    if shared:
        raise InputError(f"{shared} consecutive rows of the test record are also in the training record; the error on "
                         "them would prove nothing: give data that were not used.")  # fmt: skip


def check_distinct(records: Sequence[Record]) -> None:
    """Refuse records that share measured rows: counted twice they make errors too small, and blocks left out are known."""
    for k, one in enumerate(records):
        for j, other in enumerate(records[:k]):
            alike = (one.n_inputs, one.n_outputs) == (other.n_inputs, other.n_outputs)
            shared = copied_rows(other, one) if alike else 0
            if shared:
                raise InputError(
                    f"{shared} consecutive rows of record {k + 1} are also in record {j + 1}; counted twice, they would make every "
                    "standard error too small: give each record once."
                )


def _alike(train: Record, other: Record, name: str) -> None:
    if (other.n_inputs, other.n_outputs) != (train.n_inputs, train.n_outputs):
        raise InputError(f"the {name} has {other.n_inputs} inputs and {other.n_outputs} outputs, the training record "
                         f"{train.n_inputs} and {train.n_outputs}; they must be of the same system.")  # fmt: skip
    if abs(other.dt - train.dt) > 1e-3 * train.dt:
        raise InputError(
            f"the sampling times are {train.dt:g} and {other.dt:g} s; resample one to the other's."
        )


def together(train: Any, test: Record | None) -> list[Record]:
    """The training records, checked, the longest first: single effects are looked for there, and judged on all."""
    given = as_records(train, missing=True)
    check_distinct(given)
    records = sorted(given, key=len, reverse=True)
    for record in records:
        _alike(records[0], record, "other training record")
        _check(record, test)
    for i, name in enumerate(records[0].output_names):
        values = np.concatenate([r.y[:, i] for r in records])
        values = values[np.isfinite(values)]
        if len(values) and np.ptp(values) <= STILL * np.abs(values).max():
            raise constant_output(name, values[0])
    return records


CLOCKS = ("integral_curve",)
"""Effects that run by an integral of the input, which is a clock where the input goes one way."""


def told_from_clock(effects: Iterable[Effect], records: Sequence[Record]) -> tuple[Effect, ...]:
    """The effects that the records can tell from what depends on the level: none that runs by the clock, where an input goes with it."""
    found = tuple(effects)
    if not goes_with_clock(records):
        return found
    return tuple(e for e in found if e.nature is not Nature.TIME and e.key not in CLOCKS)
