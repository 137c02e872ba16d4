"""Diagnosis of files: records, and what a meta.json says of them."""

from __future__ import annotations

import os
from typing import Any

from estimators.diagnosis.loop import Setting, diagnose
from estimators.diagnosis.report import Diagnosis
from oed.data import Record
from oed.errors import InputError
from oed.files.documents import keyed, read_document

__all__ = ["diagnose_files", "setting_of_meta"]

SIGNALS = {"deviations": True, "as logged": False}
"""What `signals` of a meta.json says of the operating point; where it is absent, the data decide."""


ORDER = {"type": "integer", "minimum": 1, "maximum": 20}
META = keyed(
    {
        "sampling_time": {
            "type": "number",
            "exclusiveMinimum": 0,
            "description": "a positive number of seconds",
        },
        "suggested_order": {
            "anyOf": [ORDER, {"type": "array", "items": ORDER, "minItems": 1}, {"type": "null"}],
            "description": "a whole number from 1 to 20, or a list with one per output",
        },
        **{
            name: {"type": "string", "description": "a text"}
            for name in ("structure", "signals", "time_unit", "input_hold", "note")
        },
    },
    others={},
)
"""What a meta.json may say; keys that are not known here are the user's own notes."""


def setting_of_meta(meta: dict[str, Any], n_outputs: int) -> Setting:
    """What a meta.json says: structure, order, deviations.

    Parameters
    ----------
    meta : dict
        Its content.
    n_outputs : int
        Outputs of the record.

    Returns
    -------
    Setting
        For `diagnose`.

    Raises
    ------
    InputError
        If a field has a value that the suite does not know.
    """
    structure = meta.get("structure", "full")
    if structure not in ("SISO", "diagonal", "full"):
        raise InputError(f"the structure in meta.json is {structure!r}; it is SISO, diagonal or full.")
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


def diagnose_files(
    train: str | os.PathLike[str],
    test: str | os.PathLike[str] | None = None,
    *,
    meta: str | os.PathLike[str] | None = None,
    skip: int = 0,
    order: int | None = None,
    inputs: str | None = None,
    outputs: str | None = None,
    dt: float | None = None,
    alpha: float = 0.01,
) -> tuple[Diagnosis, list[str]]:
    """Diagnose records in files.

    Parameters
    ----------
    train, test : path
        Records; `FILE[a:b]` takes rows a to b-1.
    meta : path, optional
        A meta.json: the signals are then deviations and the linear model has no offset.
    skip : int
        Test samples that may set the initial state.
    order : int, optional
        Order of the linear model.
    inputs, outputs : str, optional
        Column names.
    dt : float, optional
        Sampling time in seconds.
    alpha : float
        False-alarm rate over all tests together.

    Returns
    -------
    tuple
        The diagnosis, and notes on what was assumed.

    Raises
    ------
    InputError
        If the files or options cannot be used.
    """
    from dataclasses import replace

    from oed.files import read_record

    notes: list[str] = []
    known = read_document(meta, META, "the description") if meta is not None else {}
    if inputs is None and isinstance(known.get("inputs"), list):
        inputs = ",".join(known["inputs"])
    if outputs is None and isinstance(known.get("outputs"), list):
        outputs = ",".join(known["outputs"])
    if not 0 < alpha < 0.5:
        raise InputError(f"the false-alarm rate is {alpha}; it lies between 0 and 0.5.")
    if skip < 0:
        raise InputError(f"--skip is {skip}; it must be 0 or more.")
    if order is not None and not 1 <= order <= 20:
        raise InputError(f"the order is {order}; give a whole number from 1 to 20.")

    def read(path: str | os.PathLike[str]) -> Record:
        return read_record(path, inputs=inputs, outputs=outputs, dt=dt, missing=True, notes=notes)

    first = read(train)
    second = read(test) if test is not None else None
    stated = known.get("sampling_time")
    if isinstance(stated, int | float) and dt is None and abs(first.dt - stated) > 1e-3 * stated:
        raise InputError(
            f"the sampling time is {stated:g} s in meta.json and {first.dt:g} s by the column t; correct one of them."
        )
    setting = setting_of_meta(known, first.n_outputs) if meta is not None else Setting()
    if order is not None:
        setting = replace(setting, orders=(order,) * first.n_outputs)
    setting = replace(setting, skip=skip, alpha=alpha)
    if second is not None and second.t0 < first.t0 + first.dt * (len(first) - 1):
        same = abs(second.t0 - first.t0) < 0.5 * first.dt
        how = (
            "both records start at the same time"
            if same
            else "the test record does not follow the training record"
        )
        notes.append(f"{how}: they are taken as separate clocks")
        setting = replace(setting, separate=True)
    return diagnose(first, second, setting), list(dict.fromkeys(notes))
