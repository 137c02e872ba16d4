"""Parts of a campaign on a Dask cluster: a cluster that is not there, or no longer, is said in a line and ended."""

import asyncio
import contextlib
import logging
import math
import queue
import sys
import time
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import CancelledError, ThreadPoolExecutor
from typing import Any

from oed.errors import CampaignError, InputError

CONNECT, SAY, END = 10.0, 10.0, 120.0
"""Seconds to connect; without a worker until it is said; and until the campaign ends, keeping what was finished."""
SILENT = 30.0
"""Seconds without a sign of life until a worker is called silent: they send two a second, which compiled code may hold back."""
LOOK, ANSWER = 1.0, 5.0
"""Seconds between two looks at the cluster while nothing arrives, and for the scheduler's answer: one that hangs gives none."""
FETCH = 30.0
"""Seconds for a result, of a megabyte at most, to come from its worker."""


def on_cluster(
    address: str, function: Callable[[Any], Any], items: Sequence[Any]
) -> Iterator[tuple[Any, Any, bool]]:
    """Each item with its result and whether there is one, as they are finished, on the workers of a
    scheduler. An item without a result killed its workers, as many as the scheduler allows
    (`allowed-failures`)."""
    from distributed import KilledWorker

    with _connected(address) as client:
        arrived: queue.SimpleQueue[Any] = queue.SimpleQueue()
        waiting = {}
        for number, item in enumerate(items):
            future = client.submit(function, item, pure=False, key=f"oed-{id(client):x}-{number}")
            waiting[future.key] = item
            future.add_done_callback(arrived.put)
        kept = []  # a future that nobody holds is cancelled
        watch = _Watch(client)
        while waiting:
            try:
                future = arrived.get(timeout=LOOK)
            except queue.Empty:
                watch.look()
                continue
            if future.status == "cancelled":
                raise CampaignError(f"the Dask scheduler at {address} was lost; {KEPT}")
            try:
                if future.status == "lost":
                    raise TimeoutError
                error = future.exception(timeout=FETCH)
                result = future.result(timeout=FETCH) if error is None else None
            # its worker was lost before it was fetched: it is computed again where there is one
            except TimeoutError:
                future.add_done_callback(arrived.put)
                watch.look()
                continue
            except (OSError, CancelledError):  # the connection broke while the result was on its way
                raise CampaignError(f"the Dask scheduler at {address} was lost; {KEPT}") from None
            watch.seen()
            item = waiting.pop(future.key)
            kept.append(future)
            if error is None:
                yield item, result, True
            elif isinstance(error, KilledWorker):
                yield item, None, False
            else:
                raise error
            future.release()
            kept.clear()


KEPT = "what was finished is kept: run again with the same --out."


class _Watch:
    """How long there has been no worker, and what is said and done about it."""

    def __init__(self, client: Any) -> None:
        self.client = client
        self.since, self.said = time.monotonic(), False
        self.heard: dict[str, tuple[float, float]] = {}  # a worker's last sign by its clock, and when by ours

    def seen(self) -> None:
        """A worker has answered."""
        self.since, self.said = time.monotonic(), False

    def look(self) -> None:
        """Say that there is no worker, and after a while end."""
        there = "does not answer"
        if self.client.status == "running":
            with contextlib.suppress(OSError, TimeoutError):
                ask = self.client.scheduler.identity
                workers = self.client.sync(ask, n_workers=-1, callback_timeout=ANSWER)["workers"]
                if workers:
                    self.silent({name: worker["last_seen"] for name, worker in workers.items()})
                    self.seen()
                there = "has no worker"
        gone = time.monotonic() - self.since
        where = self.client.scheduler.address if self.client.scheduler else "the scheduler"
        if gone > END:
            raise CampaignError(f"the Dask cluster at {where} {there}, for {END:.0f} s now; {KEPT}")
        if gone > SAY and not self.said:
            self.said = True
            print(
                f"the Dask cluster at {where} {there}; waiting until {END:.0f} s are over.",
                file=sys.stderr,
            )

    def silent(self, signs: dict[str, float]) -> None:
        """Say which workers have stopped: only the scheduler can give up what they hold, after minutes."""
        now = time.monotonic()
        for name, sign in signs.items():
            before, when = self.heard.get(name, (None, now))
            if sign != before:
                self.heard[name] = sign, now
            elif now - when > SILENT:
                self.heard[name] = sign, math.inf  # said once
                print(
                    f"the worker {name} of the Dask cluster has not been heard of for {SILENT:.0f} s; what it holds is done "
                    "elsewhere once the scheduler gives it up (`worker-ttl`, 5 minutes unless set).",
                    file=sys.stderr,
                )


@contextlib.contextmanager
def _connected(address: str) -> Iterator[Any]:
    """A client of the scheduler; what the library would log of a lost cluster in many lines is said here in one."""
    from distributed import Client

    level = logging.root.manager.disable
    logging.disable(logging.CRITICAL)
    try:
        try:
            with ThreadPoolExecutor(1) as aside:  # a notebook has a loop of its own, in which none can be run
                aside.submit(asyncio.run, _answer(address)).result()
            client = Client(address, timeout=CONNECT)
        except (OSError, TimeoutError, ValueError) as error:
            raise InputError(
                f"no Dask scheduler answers at {address} ({type(error).__name__}); start one with `dask scheduler` and "
                "give its address, such as tcp://127.0.0.1:8786."
            ) from None
        try:
            yield client
        finally:
            with contextlib.suppress(OSError, TimeoutError):
                client.close(timeout=5)
    finally:
        logging.disable(level)


async def _answer(address: str) -> None:
    """Ask the scheduler for its name: where one hangs, a client's own time limit is followed by a wait without end."""
    from distributed import Security
    from distributed.core import rpc

    how = Security().get_connection_args("client")
    async with rpc(address, timeout=CONNECT, connection_args=how) as scheduler:
        await asyncio.wait_for(scheduler.identity(n_workers=0), CONNECT)
