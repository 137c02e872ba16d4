"""A change with time that begins again in the test record, as of a batch: by the clock it had gone on."""

from collections.abc import Callable, Sequence
from dataclasses import replace

from estimators.diagnosis.ladder.held_out import HeldOut
from estimators.diagnosis.ladder.steps import Ladder
from oed.data import Record

ANEW = (
    "by the clock of both records what changes with time would have gone on, and the test record refuses that (error {:.4g}); begun anew "
    "with the record, as of a batch, it is borne out ({:.4g}): this one thing the test record chose"
)


def begun_anew(
    assessed: Callable[[Record | None], HeldOut],
    train: Record,
    test: Record | None,
    ladders: Sequence[Ladder],
) -> HeldOut:
    """The errors on the test record; where it refuses what runs by the clock, those with its clock begun as the training record's, if they
    are surely less."""
    held = assessed(test)
    if test is None or held.bears or not any(k.answer for k in ladders) or abs(test.t0 - train.t0) < test.dt:
        return held
    again = assessed(test.replace(t0=train.t0))
    errors = held.rmse_after.value, again.rmse_after.value
    if not (again.bears and again.difference.low > 0.0 and errors[1] < held.rmse_after.low):
        return held
    return replace(again, warnings=(*again.warnings, ANEW.format(*errors)))
