"""What is refused before any work: records and orders that cannot give a model."""

from functools import lru_cache
from typing import Any

import numpy as np

from estimators.pem.predictors.of_structure import Structure
from oed.data import Record, check_sizes
from oed.errors import InputError
from oed.models.model import Polynomial, StateSpace, polynomial
from oed.models.statespaces import state_space

FEWEST = 1000
"""Orders that are never too many here: a regularised FIR may have more taps than there are samples."""


def structure_for(
    structure: Any, orders: Any, delay: Any, diagonal: bool, records: list[Record]
) -> Structure:
    """The structure that was asked for, sized to the records."""
    if not records or not all(isinstance(r, Record) for r in records):
        raise InputError("records must be one oed.data.Record or a non-empty list of them.")
    for what in ("n_inputs", "n_outputs", "dt"):
        values = {getattr(r, what) for r in records}
        if len(values) > 1:
            raise InputError(f"the records differ in {what}: {sorted(values)}; one model needs one value.")
    ny, nu = records[0].n_outputs, records[0].n_inputs
    if isinstance(structure, Polynomial | StateSpace):
        if (structure.n_outputs, structure.n_inputs) != (ny, nu):
            raise InputError(
                f"the structure has {structure.n_outputs} outputs and {structure.n_inputs} inputs, "
                f"the records {ny} and {nu}; they must agree."
            )
        return structure
    samples = max(sum(map(len, records)), FEWEST)
    each = (v for given in (orders, delay) for v in np.ravel(np.asarray(given, dtype=object)))
    if any(isinstance(v, int | np.integer) and v > samples for v in each):  # before so many names are made
        raise InputError(
            f"{sum(map(len, records))} samples cannot determine orders {orders} at a delay of {delay}; lower them."
        )
    if structure == "ss":
        order = np.ravel(orders)
        if len(order) != 1 or np.ndim(delay) or diagonal:
            raise InputError(
                f"ss takes n, one delay for all and no diagonal; orders {orders}, delay {delay}, diagonal={diagonal}."
            )
        return state_space(int(order[0]), n_outputs=ny, n_inputs=nu, delay=int(delay))
    simple = isinstance(structure, str) and isinstance(orders, tuple | list)
    if simple and all(type(x) is int for x in (delay, *orders)):
        return _plain(structure, tuple(orders), delay, ny, nu, diagonal)
    return polynomial(structure, orders, delay, n_outputs=ny, n_inputs=nu, diagonal=diagonal)


@lru_cache(maxsize=256)
def _plain(kind: str, orders: tuple[int, ...], delay: int, ny: int, nu: int, diagonal: bool) -> Polynomial:
    """A structure is never changed, so that one will do for many fits."""
    return polynomial(kind, orders, delay, n_outputs=ny, n_inputs=nu, diagonal=diagonal)


def check_records(
    records: list[Record], form: Structure, offset: bool, missing: bool = False, regularised: bool = False
) -> None:
    """Refuse records that cannot determine the structure, before any work."""
    delay = 0 if isinstance(form, StateSpace) else int(np.max(form.nk, where=form.nb > 0, initial=0))
    seen = [r.y[max(delay - 1, 0) :] for r in records]  # before it no input has reached the output
    total = sum(int(np.isfinite(y).all(axis=1).sum()) if missing else len(y) for y in seen)
    count = 5 * form.n_outputs * form.n_inputs if regularised else form.n
    count += form.n_outputs if offset else 0
    if total * form.n_outputs < 2 * count:
        after = f" after the delay of {delay}" if delay > 1 else ""
        raise InputError(
            f"{total} samples{after} cannot determine {count} parameters; give at least "
            f"{max(delay - 1, 0) + -(-2 * count // form.n_outputs)} samples or lower the {'delay' if after else 'orders'}."
        )
    for k, record in enumerate(records):
        which = f"record {k + 1}" if len(records) > 1 else "the record"
        check_sizes(record, which)
        gaps = ~np.isfinite(record.u)
        if missing and gaps.any():
            raise InputError(
                f"{which} has {int(gaps.sum())} missing input samples; only outputs may be missing: the input that "
                "was applied must be known (hold its last value if that is what the actuator did)."
            )
        if not missing and not record.complete:
            bad = int((~np.isfinite(record.u)).sum() + (~np.isfinite(record.y)).sum())
            raise InputError(
                f"{which} has {bad} missing samples (NaN); ask for them to be treated as missing (missing=True) "
                "or remove them."
            )
    for j in range(form.n_inputs):
        values = np.concatenate([r.u[:, j] for r in records])
        constant = np.ptp(values) == 0
        if (
            constant
            and (offset or not values.any())
            and (isinstance(form, StateSpace) or form.nb[:, j].any())
        ):
            raise InputError(
                f"input {records[0].input_names[j]} is constant ({values[0]:g}) in all records; "
                "a constant input cannot be told from an offset: excite it, or leave it out."
            )
    for i, name in enumerate(records[0].output_names):
        values = np.concatenate([r.y[:, i] for r in records])
        values = values[np.isfinite(values)]
        if values.size and np.ptp(values) == 0 and (offset or not values.any()):
            raise constant_output(name, values[0])


def constant_output(name: str, value: float) -> InputError:
    """What is said of an output that never moves."""
    return InputError(
        f"output {name} is constant ({value:g}) in all records; nothing of it can be told by an input: check its sensor, or leave it out."
    )
