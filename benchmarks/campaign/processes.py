"""Work on several processes: nothing is lost when one is killed, and none is left when the first one is."""

import os
import signal
import sys
import threading
import time
import warnings
from collections.abc import Callable, Iterable, Iterator
from functools import partial
from typing import Any

from oed.errors import CampaignError

ROUNDS = 10
"""How often all workers are started again; what still kills its worker is then tried alone, once."""
PER_CORE = 8
"""Processes on a core at most: they compute and do not wait, so that more of them only fill the memory, with a tenth of a GB each."""
WATCH = 0.5
"""Seconds between two looks of a worker at whether the process that started it lives."""


def as_finished(
    function: Callable[[Any], Any], items: Iterable[Any], jobs: int
) -> Iterator[tuple[Any, Any, bool]]:
    """Each item with its result and whether there is one, as they are finished, on so many processes. A
    worker that is killed, as by a system short of memory, takes the others with it: what was not finished is
    done again. An item whose worker is killed even when it is alone has no result."""
    from joblib import Parallel, delayed, parallel_config
    from joblib.externals.loky import ProcessPoolExecutor
    from joblib.externals.loky.process_executor import TerminatedWorkerError

    todo = dict(enumerate(items))
    # All are started, whatever there is to do; with one, the work would be done here, and end this process with it.
    jobs = min(jobs, max(2, min(len(todo), PER_CORE * (os.cpu_count() or 1))))
    # A worker that has come to hold much more than after its first task, as by its imports, is replaced and says so.
    warnings.filterwarnings("ignore", "A worker stopped while some jobs were given")
    # Ended by a signal, workers leave tasks undone; that is said in a line of our own.
    warnings.filterwarnings(
        "ignore", r"\d+ tasks (which were still being processed|have been successfully executed)"
    )
    for _ in range(ROUNDS):
        before = len(todo)
        if not todo:
            return
        try:
            with parallel_config(backend="loky", inner_max_num_threads=1, n_jobs=jobs):
                work: Any = Parallel(return_as="generator_unordered")
                for k, result in work(
                    delayed(_watched)(os.getpid(), k, function, v) for k, v in [*todo.items()]
                ):
                    yield todo.pop(k), result, True
        except TerminatedWorkerError:
            print("a worker process was killed; what it had not finished is done again.", file=sys.stderr)
        if len(todo) == before:  # whoever kills the workers does so at once
            break
    for k, item in todo.items():
        executor = ProcessPoolExecutor(max_workers=1, timeout=10)
        try:
            yield item, executor.submit(_watched, os.getpid(), k, function, item).result()[1], True
        except TerminatedWorkerError:
            yield item, None, False
        finally:
            executor.shutdown(kill_workers=True)


def _watched(parent: int, k: int, function: Callable[[Any], Any], item: Any) -> tuple[int, Any]:
    """Do the work in a worker that ends with the process that started it, also where that was killed; Ctrl-C, which a terminal sends
    to both, is for that one, which ends its workers."""
    if not any(thread.name == "oed-watch" for thread in threading.enumerate()):
        if threading.current_thread() is threading.main_thread():
            signal.signal(signal.SIGINT, signal.SIG_IGN)
        threading.Thread(target=_watch, args=(parent,), name="oed-watch", daemon=True).start()
    return k, function(item)


def _watch(parent: int) -> None:
    while os.getppid() == parent:
        time.sleep(WATCH)
    os._exit(1)


def spread(function: Callable[[Any], Any], items: Iterable[Any], jobs: int = 1) -> list[Any]:
    """What the function, of a module so that other processes find it, returns for every item, in their order."""
    items = list(items)
    if jobs <= 1:
        return [function(item) for item in items]
    found: dict[int, Any] = {}
    for (k, _), result, done in as_finished(partial(_of_second, function), enumerate(items), jobs):
        if not done:
            raise CampaignError(
                "a process was killed each time it made a table or a figure, perhaps for want of memory; what was finished "
                "is kept: run again with --jobs 1."
            )
        found[k] = result
    return [found[k] for k in range(len(items))]


def _of_second(function: Callable[[Any], Any], pair: tuple[int, Any]) -> Any:
    return function(pair[1])


def at_once(tasks: Iterable[Callable[[], Any]], jobs: int = 1) -> list[Any]:
    """What every task, such as a `functools.partial` of a module's function, returns, in their order."""
    return spread(_call, tasks, jobs)


def _call(task: Callable[[], Any]) -> Any:
    return task()
