import contextlib
import os
import signal
import subprocess
import sys
import threading
import time

from distributed import Client
from distributed.security import Security
import psutil
import pytest

from tofssm_drake.errors import UserError
import tofssm_drake.scripts.cluster as mut


def find_listeners():
    """Returns the sockets on which this process and its children listen."""
    return {
        connection.laddr
        for process in (psutil.Process(), *psutil.Process().children(True))
        for connection in process.net_connections(kind="inet")
        if connection.status == psutil.CONN_LISTEN
    }


def test_only_the_campaign_may_use_its_workers(tmp_path):
    """Who can talk to a scheduler can run any code as its user."""
    told = []
    # Those of other tests that ran in this process.
    before = find_listeners()
    with mut.connect(workers=1, scratch=tmp_path / "scratch") as client:
        # Longer than a look for workers, of which there is one.
        calls = {"a": (2.5 * mut._LOOK,)}
        ((_, _, error),) = mut.call_all(
            client, time.sleep, calls, tell=told.append
        )
        assert error is None
        assert told == []
        assert client.submit(os.getpid).result() != os.getpid()
        address = client.scheduler.address
        assert address.startswith("tls://127.0.0.1:")
        for theirs, security in (
            (address.replace("tls", "tcp"), None),
            (address, Security.temporary()),
        ):
            with pytest.raises(OSError):
                Client(theirs, security=security, timeout=5)
        opened = find_listeners() - before
        assert opened
        assert {address.ip for address in opened} == {"127.0.0.1"}
    assert not (tmp_path / "scratch").exists()


@contextlib.contextmanager
def start(*command):
    """Runs a part of Dask as a process, which may be killed."""
    process = subprocess.Popen(
        [sys.executable, "-m", *command],
        stderr=subprocess.DEVNULL,
        start_new_session=True,
    )
    try:
        yield process
    finally:
        with contextlib.suppress(ProcessLookupError):
            os.killpg(process.pid, signal.SIGKILL)
        process.wait()


@pytest.fixture
def cluster(tmp_path):
    """Scheduler, worker, and a client of them."""
    contact = ("--scheduler-file", str(tmp_path / "scheduler.json"))
    with (
        start(
            *("distributed.cli.dask_scheduler", "--host", "127.0.0.1"),
            *("--port", "0", "--no-dashboard", *contact),
        ) as scheduler,
        start(
            *("distributed.cli.dask_worker", "--nthreads", "1", *contact),
            *("--no-nanny", "--no-dashboard"),
            *("--local-directory", str(tmp_path)),
        ) as worker,
        Client(scheduler_file=contact[1], timeout=300.0) as client,
    ):
        client.wait_for_workers(1, timeout=300.0)
        yield scheduler, worker, client


def test_a_scheduler_that_is_gone_is_told(cluster):
    scheduler, _, client = cluster
    calls = {"a": (600.0,), "b": (600.0,)}
    results = mut.call_all(client, time.sleep, calls, tell=print)
    threading.Timer(1.0, scheduler.kill).start()
    with pytest.raises(UserError, match="scheduler is gone; 2 runs are not"):
        next(results)


def test_that_no_worker_is_left_is_told_once(cluster, monkeypatch):
    monkeypatch.setattr(mut, "_LOOK", 0.1)
    scheduler, worker, client = cluster
    told = []

    def tell(line):
        told.append(line)
        # It goes on waiting; this ends it.
        threading.Timer(1.0, scheduler.kill).start()

    threading.Timer(1.0, worker.kill).start()
    with pytest.raises(UserError, match="scheduler is gone"):
        list(mut.call_all(client, time.sleep, {"a": (600.0,)}, tell=tell))
    assert len(told) == 1
    assert "no worker is left" in told[0]
