"""`compare`: run a campaign and turn it into tables, figures, a page and a sentence."""

import json
import os
import platform
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from benchmarks.campaign.one_part import check_contents
from benchmarks.campaign.plants import expanded
from benchmarks.campaign.settings import Limit, Settings, default_limits
from benchmarks.campaign.users_own import Own
from benchmarks.campaign.whole_campaign import TIME_LIMIT, check_amounts, fill_store, parts_to_do, stored_runs
from benchmarks.progress import drawn
from benchmarks.tables.columns import headings, is_number
from benchmarks.tables.formats import to_text
from benchmarks.tables.tabulation import tabulate
from oed.covariances import on_one_thread
from oed.errors import CampaignError, InputError
from oed.files.documents import parsed_json
from oed.files.limits import file_content
from oed.files.lock import locked
from oed.files.writing import write_whole


@dataclass(frozen=True, eq=False)
class Comparison:
    """Result of `compare`. `rows` the comparison table; `information` what the inputs carry, by number of
    experiments; `out` results folder; `page` the report; None after a dry run; `sentences` what the numbers
    say; `pairs` paired differences with corrected p-values."""

    rows: list[dict[str, Any]]
    information: list[dict[str, Any]] = field(repr=False)
    out: Path
    page: Path | None
    sentences: list[str]
    pairs: list[dict[str, Any]] = field(default_factory=list, repr=False)

    def to_dict(self) -> dict[str, Any]:
        """The keys of `oed compare --json`."""
        return {
            "rows": self.rows, "out": str(self.out), "report": str(self.page) if self.page else None,
            "summary": self.sentences, "information": self.information, "pairs": self.pairs,
        }  # fmt: skip

    def __str__(self) -> str:
        where = [f"report: {self.page}"] if self.page else []
        table = [to_text(self.rows, headings("comparison")), ""] if self.rows else []
        return "\n".join([*table, *self.sentences, *where])


class _Progress:
    """A line on standard error with the time left, and progress.json for `oed report --serve`."""

    def __init__(self, quiet: bool, folder: Path) -> None:
        self.quiet = quiet
        self.file = folder / "progress.json"
        self.bar: Any = None

    def __call__(self, done: int, total: int) -> None:
        write_whole(self.file, json.dumps({"done": done, "total": total}) + "\n", error=CampaignError)
        if self.quiet:
            return
        if self.bar is None:
            from tqdm import tqdm

            self.bar = tqdm(total=total, initial=done, unit="part", desc="campaign", file=drawn(), leave=True)
        self.bar.update(done - self.bar.n)
        if done == total:
            self.bar.close()


@on_one_thread
def compare(
    *,
    plants: Sequence[str] | None = None,
    noise_variances: Sequence[float] | None = None,
    samples: int = 1000,
    experiments: int = 20,
    replicates: int = 100,
    methods: Sequence[Any] | None = None,
    estimators: Sequence[Any] | None = None,
    limits: Sequence[Limit] | None = None,
    profile_replicates: int = Settings.profile_replicates,
    seed: int = 0,
    out: str | Path = "results/compare",
    jobs: int | None = None,
    scheduler: str | None = None,
    time_limit: float | None = TIME_LIMIT,
    dry_run: bool = False,
    quiet: bool = False,
    tell: Callable[[Comparison], None] = lambda result: None,
) -> Comparison:
    """Compare inputs and estimators for the H-infinity norm in Monte Carlo, at equal budgets. `tell` hears the result
    before its theory is computed and its figures are drawn, which takes a minute where there are many plants."""
    brought = Own(methods or (), estimators or ())
    plants = expanded(plants) if plants else None
    given = {
        "plants": plants, "noise_variances": noise_variances, "methods": brought.methods,
        "estimators": brought.estimators, "limits": limits, "sources": brought.sources,
    }  # fmt: skip
    if limits is None:
        blank = Settings()
        chosen = default_limits(
            plants or blank.plants, brought.methods or blank.methods, brought.estimators or blank.estimators
        )
        # Inputs that were asked for by name are not limited.
        given["limits"] = tuple(limit for limit in chosen if not (methods and limit.method))
    settings = Settings(
        samples=samples,
        experiments=experiments,
        seed=seed,
        profile_replicates=profile_replicates,
        **{name: tuple(values) for name, values in given.items() if values},
    )
    if jobs is not None and jobs < 1:
        raise InputError(f"jobs is {jobs}; it must be at least 1.")
    options = {"time_limit": time_limit, "own": brought.functions}
    check_amounts(replicates, time_limit)
    if dry_run:
        return _dry_run(settings, replicates, Path(out), options)
    folder, began = Path(out), time.monotonic()
    workers = jobs or os.cpu_count() or 1
    try:
        store = fill_store(
            settings, replicates, folder, jobs=jobs, scheduler=scheduler, progress=_Progress(quiet, folder), **options,
        )  # fmt: skip
    except KeyboardInterrupt:
        if folder.is_dir():
            _add_cost(folder, time.monotonic() - began, workers)
        raise
    _add_cost(folder, time.monotonic() - began, workers)
    from benchmarks.page.comparison import write_comparison

    try:
        with locked(folder / "lock", f"the campaign {folder}"):
            tables = tabulate(stored_runs(store, settings, replicates, **options), settings, workers)
            check_contents(settings, *settings.plants)
            result = lambda words, page: Comparison(
                tables.rows, tables.information, folder, page, words, tables.pairs
            )
            found = write_comparison(
                folder, settings, replicates, tables, workers, lambda words: tell(result(words, None))
            )
    except OSError as error:
        raise CampaignError(
            f"cannot write the tables and figures in {folder} ({error.strerror or error}); all runs are kept: make room and "
            "run again."
        ) from None
    return result(*found)


def _add_cost(folder: Path, wall: float, workers: int) -> None:
    """cost.json: what the runs took so far, every resumption added; not part of what is bound to the settings."""
    file = folder / "cost.json"
    try:
        before = float(parsed_json(file_content(file).decode(), file.name)["wall_seconds"])
    except (OSError, ValueError, KeyError, TypeError, RecursionError):
        before = 0.0  # none yet, or damaged: no result is in it
    cost = {
        "wall_seconds": round(before + wall, 1),
        "workers": workers,
        "megabytes_of_parts": round(sum(p.stat().st_size for p in folder.glob("parts/*")) / 1e6, 1),
        "machine": f"{platform.machine()}, {os.cpu_count()} cores, {platform.system()}",
    }
    write_whole(file, json.dumps(cost, indent=1) + "\n", error=CampaignError)


def _dry_run(settings: Settings, replicates: int, out: Path, options: dict[str, Any]) -> Comparison:
    """Every plant, input and estimator once at the first noise level, a few short experiments each, nothing kept."""
    from dataclasses import replace

    from benchmarks.campaign.one_part import run_part
    from benchmarks.campaign.plants import load_plant
    from benchmarks.campaign.run_columns import UNUSABLE

    plants = [load_plant(name) for name in settings.plants]
    iteration = 1 + max(plant.n_inputs * plant.n_outputs for plant in plants)  # of Procedure 2
    tiny = replace(
        settings,
        noise_variances=settings.noise_variances[:1],
        samples=min(settings.samples, 1000),  # fewer, and fits search longer for what the data do not say
        experiments=min(settings.experiments, max(iteration, 4)),
        profile_replicates=0,
    )
    start = time.monotonic()
    todo = parts_to_do(tiny, 1)
    rows = [row for part in todo for row in run_part(tiny, part, **options) if row["estimator"]]
    seconds = time.monotonic() - start
    failed = [row for row in rows if row["status"] in UNUSABLE or not is_number(row["estimate"])]
    size = settings.samples * settings.experiments * replicates
    sentences = [
        f"Dry run: {len(todo)} combinations of plant and input, {len(rows)} with an estimator, ran at noise "
        f"{tiny.noise_variances[0]:g} and {tiny.experiments} experiments of {tiny.samples} samples in {seconds:.1f} s; the "
        f"full campaign has {len(parts_to_do(settings, 1))} combinations with noise, {size:,} samples in each of them unless limited, "
        f"and is kept in {out}.",
        f"{len(failed)} of the {len(rows)} gave no number at this size"
        + "".join(f"; {words}" for words in dict.fromkeys(map(_failure_in_words, failed)))
        + ".",
    ]
    return Comparison([], [], out, None, sentences)


def _failure_in_words(row: dict[str, Any]) -> str:
    why = str(row["message"] or row["status"].lower().replace("_", " ")).rstrip(".")
    return f"{row['plant']}, {row['method']}, {row['estimator']}: {why}"
