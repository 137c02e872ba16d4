"""Monte-Carlo campaigns: plants x noise x methods x replicates, resumable, the same on any number of workers."""

import os
from collections.abc import Callable, Iterator, Mapping
from functools import partial
from pathlib import Path
from typing import Any

from benchmarks.campaign.cluster import on_cluster
from benchmarks.campaign.one_part import Part, killed_rows, parts, run_part
from benchmarks.campaign.processes import as_finished
from benchmarks.campaign.registry import ESTIMATORS, compatible
from benchmarks.campaign.run_columns import Runs, runs_of
from benchmarks.campaign.settings import Settings
from benchmarks.campaign.store import Store, difference, versions
from oed.errors import CampaignError, InputError
from oed.files.lock import locked

TIME_LIMIT = 300.0
"""Seconds for one run of a method, and for one estimate."""

Own = Mapping[str, Callable[..., Any]]
Result = tuple[Part, list[dict[str, Any]], dict[str, str]]


def run_campaign(
    settings: Settings, replicates: int, folder: Path, *, time_limit: float | None = TIME_LIMIT, own: Own | None = None,
    **how: Any,
) -> list[Runs]:  # fmt: skip
    """Run or resume a campaign as `fill_store` does, and read all of it."""
    store = fill_store(settings, replicates, folder, time_limit=time_limit, own=own, **how)
    return list(stored_runs(store, settings, replicates, time_limit=time_limit, own=own))


def check_amounts(replicates: int, time_limit: float | None) -> None:
    """Refuse numbers that no campaign can be run with."""
    if replicates < 2:
        raise InputError(f"replicates is {replicates}; standard errors need at least 2.")
    if time_limit is not None and not time_limit > 0:
        raise InputError(f"the time limit is {time_limit:g} s; it must be positive.")


def parts_to_do(settings: Settings, replicates: int) -> list[Part]:
    """The parts of a campaign; InputError where there are none, or nothing would estimate from them."""
    todo = parts(settings, replicates)
    if not todo:
        raise InputError(
            "nothing is left to run: none of the inputs is made for the channels of these plants, or the limits leave "
            "everything out."
        )
    if not any(compatible(part.method, name) for part in todo for name in settings.estimators):
        made_for = "; ".join(
            f"{name} for {', '.join(ESTIMATORS[name].inputs)}"
            for name in settings.estimators
            if name in ESTIMATORS
        )
        raise InputError(
            f"no estimator asked for can be applied to the records of {', '.join(settings.methods)}: they are made for other "
            f"inputs ({made_for}); add one of these inputs, or another estimator such as pem."
        )
    return todo


def fill_store(
    settings: Settings, replicates: int, folder: Path, *, jobs: int | None = None, scheduler: str | None = None,
    progress: Callable[[int, int], None] | None = None, time_limit: float | None = TIME_LIMIT,
    own: Own | None = None,
) -> Store:  # fmt: skip
    """Run or resume a campaign; the results stay on disk."""
    check_amounts(replicates, time_limit)
    todo = parts_to_do(settings, replicates)
    store = Store(folder, settings.deciding())
    with locked(folder / "lock", f"the campaign {folder}"):
        store.tidy()
        missing = [part for part in todo if not store.holds(part.key, time_limit)]
        report = progress or (lambda done, total: None)
        report(len(todo) - len(missing), len(todo))
        options = {"time_limit": time_limit, "own": dict(own or {})}
        for count, (part, result, made) in enumerate(
            _results(settings, missing, jobs, scheduler, options), len(todo) - len(missing) + 1
        ):
            if made != versions():
                raise CampaignError(
                    f"a worker runs other versions or other source than this process ({difference(made, versions())}); "
                    "what it made is not kept: install the same on every worker and run again."
                )
            store.write(part.key, result, time_limit)
            report(count, len(todo))
    return store


def stored_runs(
    store: Store, settings: Settings, replicates: int, *, time_limit: float | None = TIME_LIMIT,
    own: Own | None = None,
) -> Iterator[Runs]:  # fmt: skip
    """The combinations of a finished campaign one after the other, so that memory holds one at a time."""
    grouped: dict[tuple[str, float, str], list[Part]] = {}
    for part in parts(settings, replicates):
        grouped.setdefault(part.combination, []).append(part)
    for combination, mine in grouped.items():
        tables = []
        for part in mine:
            table = store.read(part.key)
            if table is None:
                store.write(part.key, run_part(settings, part, time_limit=time_limit, own=own), time_limit)
                table = store.read(part.key)
            if table is None:
                raise CampaignError(f"{store.path(part.key)} cannot be read back; check the disk.")
            tables.append(table)
        yield runs_of(combination, tables)


def _results(
    settings: Settings, missing: list[Part], jobs: int | None, scheduler: str | None, options: dict[str, Any]
) -> Iterator[Result]:
    """Parts with their rows and the versions that made them, as they are finished, whoever does the work."""
    jobs = min(jobs or os.cpu_count() or 1, max(len(missing), 1))
    if scheduler is None and jobs <= 1:
        for part in missing:
            yield _with_part(settings, options, part)
        return
    work = partial(_with_part, settings, options)
    each = as_finished(work, missing, jobs) if scheduler is None else on_cluster(scheduler, work, missing)
    for part, found, done in each:
        yield found if done else (part, killed_rows(settings, part), versions())


def _with_part(settings: Settings, options: dict[str, Any], part: Part) -> Result:
    return part, run_part(settings, part, **options), versions()
