"""Diagnosis of files: records, and what a meta.json says of them."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from estimators.diagnosis.loop import Setting, diagnose
from estimators.diagnosis.result.report import Diagnosis
from oed.data import Record
from oed.errors import InputError
from oed.files.clock import SECONDS, seconds_in
from oed.files.documents import TEXT, keyed, read_document

SIGNALS = {"deviations": True, "as logged": False}
"""What `signals` of a meta.json says of the operating point; where it is absent, the data decide."""


ORDER = {"type": "integer", "minimum": 1, "maximum": 20}
UNIT = {
    "anyOf": [TEXT, {"type": "array", "items": TEXT, "minItems": 1}],
    "description": "a unit, or one per column: a list, or separated by commas",
}
META = keyed(
    {
        "sampling_time": {
            "type": "number",
            "exclusiveMinimum": 0,
            "description": "a positive number, in time_unit or else in seconds",
        },
        "suggested_order": {
            "anyOf": [ORDER, {"type": "array", "items": ORDER, "minItems": 1}, {"type": "null"}],
            "description": "a whole number from 1 to 20, or a list with one per output",
        },
        "skip": {
            "type": "integer",
            "minimum": 0,
            "description": "a whole number of test samples that may set the initial state",
        },
        **dict.fromkeys(("structure", "signals", "time_unit", "input_hold", "note"), TEXT),
        **{
            name: {
                "not": {"type": "array", "contains": {"not": TEXT}},
                "description": "a list of columns' names",
            }
            for name in ("inputs", "outputs")
        },
        **dict.fromkeys(("input_unit", "output_unit"), UNIT),
    },
    others={},
)
"""What a meta.json may say; keys that are not known here are the user's own notes."""


COUNTED = ("SISO", "MISO", "SIMO", "MIMO")
"""Structures that say only how many channels there are, which the record says too."""


def setting_of_meta(meta: dict[str, Any], n_outputs: int) -> Setting:
    """What a meta.json says: structure, order, deviations."""
    structure = meta.get("structure", "full")
    if structure not in ("diagonal", "full", *COUNTED):
        raise InputError(
            f"the structure in meta.json is {structure!r}; it is diagonal, full, or one of {', '.join(COUNTED)}."
        )
    order = meta.get("suggested_order")
    if order is None:
        orders: tuple[int, ...] = ()
    else:
        given = order if isinstance(order, list) else [order] * n_outputs
        if len(given) != n_outputs or not all(isinstance(n, int) and 1 <= n <= 20 for n in given):
            raise InputError(
                f"suggested_order is {order!r} for {n_outputs} outputs; give one whole number from 1 to 20 each."
            )
        orders = tuple(given)
    signals = meta.get("signals")
    if signals not in (None, *SIGNALS):
        raise InputError(
            f"signals in meta.json is {signals!r}; it is one of {', '.join(SIGNALS)}, or absent."
        )
    return Setting(
        orders=orders, structure=structure, deviations=None if signals is None else SIGNALS[signals]
    )


def _in_units(record: Record, meta: dict[str, Any]) -> Record:
    """The record with the units that a meta.json gives, where its own file has none."""
    given: dict[str, Any] = {}
    for side in ("input", "output"):
        own, said = getattr(record, f"{side}_units"), meta.get(f"{side}_unit", "")
        units = said if isinstance(said, list) else [unit.strip() for unit in said.split(",")]
        units = units if isinstance(said, list) or len(units) == len(own) else [said] * len(own)
        if len(units) != len(own):
            raise InputError(
                f"{side}_unit in meta.json is {said!r} for {len(own)} {side}s; give one unit each."
            )
        given[f"{side}_units"] = tuple(mine or theirs for mine, theirs in zip(own, units, strict=True))
    return record.replace(**given)


@dataclass(frozen=True)
class Columns:
    """Which columns of the files are the inputs and outputs (names, separated by commas), and the sampling
    time in seconds.

    `inputs, outputs` names; by default the columns that begin with u and y; `dt` by default from the column t
    or t_s.
    """

    inputs: str | None = None
    outputs: str | None = None
    dt: float | None = None


def diagnose_files(
    train: Path | str | Sequence[Path | str],
    test: Path | str | None = None,
    *,
    meta: Path | str | None = None,
    skip: int | None = None,
    columns: Columns | None = None,
    setting: Setting | None = None,
    progress: Callable[[str], None] | None = None,
) -> tuple[Diagnosis, list[str]]:
    """Diagnose records in files, one or several for training; `skip` is by default what their description says, else 0."""
    from oed.files import read_record
    from oed.files.tables import ASSUMED

    columns, wanted = columns or Columns(), setting or Setting()
    notes: list[str] = []
    known = read_document(meta, META, "the description") if meta is not None else {}
    keys = META["properties"]
    if known and not set(known) & set(keys):
        raise InputError(
            f"the description {meta} has none of the keys {', '.join(keys)}; it is another file."
        )
    names = {
        side: given or (",".join(known[side]) if isinstance(known.get(side), list) else None)
        for side, given in (("inputs", columns.inputs), ("outputs", columns.outputs))
    }
    opening = skip if skip is not None else 0 if test is None else int(known.get("skip", 0))
    _check(wanted, opening)
    unit, said = str(known.get("time_unit") or "s"), "sampling_time" in known
    of_unit = seconds_in(unit)
    if said and not of_unit > 0.0:
        raise InputError(
            f"time_unit in meta.json is {unit!r}; known are {', '.join(SECONDS)}, and so many of them, as in '15 min'."
        )
    stated = float(known["sampling_time"]) * of_unit if said else None

    def read(path: Path | str) -> Record:
        told: list[str] = []
        record = read_record(path, **names, dt=columns.dt, missing=True, notes=told)
        assumed = [note for note in told if note.endswith(f"{ASSUMED}.")]
        if assumed and stated is not None:
            record = record.replace(dt=stated, t0=record.t0 * stated)
            told.remove(assumed[0])
        scale = of_unit if stated is not None and columns.dt is None else 1.0
        if stated is not None and scale != 1.0 and abs(scale * record.dt - stated) < 1e-3 * stated:
            record = record.replace(dt=stated, t0=record.t0 * scale)
            told.append(f"the times are taken in {unit}, the time_unit of meta.json")
        notes.extend(told)
        return _in_units(record, known)

    records = [read(path) for path in ([train] if isinstance(train, str | Path) else train)]
    first = max(records, key=len)
    second = read(test) if test is not None else None
    if stated is not None and columns.dt is None and abs(first.dt - stated) > 1e-3 * stated:
        raise InputError(
            f"the sampling time is {stated:g} s in meta.json and {first.dt:g} s by the column t; correct one of them."
        )
    given = setting_of_meta(known, first.n_outputs) if meta is not None else wanted
    final = replace(
        wanted, structure=given.structure, deviations=given.deviations, skip=opening,
        orders=(wanted.orders or given.orders) * (first.n_outputs if len(wanted.orders) == 1 else 1),
    )  # fmt: skip
    if second is not None and second.t0 < first.t0 + first.dt * (len(first) - 1):
        same = abs(second.t0 - first.t0) < 0.5 * first.dt
        how = (
            "both records start at the same time"
            if same
            else "the test record does not follow the training record"
        )
        notes.append(f"{how}: they are taken as separate clocks")
        final = replace(final, separate=True)
    return diagnose(records, second, final, progress=progress), list(dict.fromkeys(notes))


def _check(setting: Setting, skip: int) -> None:
    if not 0 < setting.alpha < 0.5:
        raise InputError(f"the false-alarm rate is {setting.alpha}; it lies between 0 and 0.5.")
    if skip < 0:
        raise InputError(f"--skip is {skip}; it must be 0 or more.")
    if any(not 1 <= order <= 20 for order in setting.orders):
        raise InputError(f"the order is {setting.orders[0]}; give a whole number from 1 to 20.")
