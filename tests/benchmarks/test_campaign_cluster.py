"""A campaign on a Dask cluster: the same bytes, nothing lost with a worker, and a scheduler that is not there."""

from __future__ import annotations

import os
import signal
import socket

import pytest

import benchmarks.campaign.cluster as cluster_module
from benchmarks.campaign.deadline import within
from benchmarks.campaign.whole_campaign import (
    run_campaign,
)
from oed.errors import InputError
from tests.benchmarks.small_campaign import SMALL, same


@pytest.mark.slow
def test_a_dask_cluster_agrees_bit_for_bit_and_loses_nothing_when_a_worker_dies(tmp_path):
    """Two real worker processes, one of them killed while the campaign runs."""
    distributed = pytest.importorskip("distributed", reason="the extra `dask` is not installed")
    serial = run_campaign(SMALL, 30, tmp_path / "serial", jobs=1)
    with distributed.LocalCluster(
        n_workers=2, threads_per_worker=1, processes=True, dashboard_address=":0", silence_logs=50
    ) as cluster:
        victims = [worker.process.pid for worker in cluster.workers.values()]
        killed = []

        def progress(done: int, total: int) -> None:
            if done >= 2 and not killed:
                killed.append(victims[0])
                os.kill(victims[0], signal.SIGKILL)

        spread = run_campaign(
            SMALL, 30, tmp_path / "dask", scheduler=cluster.scheduler_address, progress=progress
        )
    assert killed
    assert same(serial, spread)


def test_a_scheduler_that_is_not_there(tmp_path, monkeypatch):
    pytest.importorskip("distributed", reason="the extra `dask` is not installed")
    monkeypatch.setattr(cluster_module, "CONNECT", 0.5)
    with pytest.raises(InputError, match=r"no Dask scheduler answers at tcp://127.0.0.1:9"):
        run_campaign(SMALL, 2, tmp_path, scheduler="tcp://127.0.0.1:9")


def test_a_scheduler_that_hangs_from_the_start(tmp_path, monkeypatch):
    """Its system takes the connection, and nobody reads: the client's own time limit is not kept."""
    pytest.importorskip("distributed", reason="the extra `dask` is not installed")
    monkeypatch.setattr(cluster_module, "CONNECT", 0.5)
    with socket.create_server(("127.0.0.1", 0)) as silent:
        address = f"tcp://127.0.0.1:{silent.getsockname()[1]}"
        with pytest.raises(InputError, match=f"no Dask scheduler answers at {address}"):
            within(20, run_campaign, SMALL, 2, tmp_path, scheduler=address)
