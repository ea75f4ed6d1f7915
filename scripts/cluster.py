"""Spreads calls over the cores of this machine, or over a Dask cluster."""

from collections.abc import Callable, Iterator
import contextlib
import logging
import os
from pathlib import Path
import shutil
from typing import Any

import dask
from distributed import CancelledError, Client, LocalCluster, wait
from distributed.comm import CommClosedError
from distributed.security import Security

from tofssm_drake.diagrams.run_metadata import get_versions
from tofssm_drake.errors import UserError

TIMEOUT = 10.0
"""How long to wait for an answer of a scheduler, s."""
# How often to look whether workers are left, s.
_LOOK = 2.0
_SETTINGS = {
    # A simulation may hold Python's lock for a while; that is not a fault.
    "distributed.admin.tick.limit": "1h",
    # The profiler samples a hundred times a second, which slows the runs.
    "distributed.worker.profile.enabled": False,
    # A worker that dies loses its own run and no other.
    "distributed.scheduler.allowed-failures": 1,
}
# On this machine there is nothing to look at over HTTP.
_NO_PAGES: dict[str, list] = {
    "distributed.scheduler.http.routes": [],
    "distributed.worker.http.routes": [],
}


@contextlib.contextmanager
def connect(
    scheduler: str | None = None,
    *,
    workers: int | None = None,
    scratch: Path,
) -> Iterator[Client]:
    """Connects to a cluster for the duration of a `with`.

    Args:
        scheduler: Address of a Dask scheduler, e.g. tls://10.0.0.1:8786, for
            which Dask's configuration has the certificates; None starts worker
            processes on this machine, and ends them.
        workers: Number of these processes; None: one per core.
        scratch: Folder for what these processes need while they run; removed
            afterwards.

    Yields:
        A Dask client.

    Raises:
        UserError: No scheduler answers, it has no workers, the workers have
            other versions of what results depend on, or the folder cannot be
            made.
    """
    with dask.config.set(_SETTINGS):
        if scheduler is None:
            with (
                _make_scratch(scratch) as folder,
                dask.config.set({"temporary_directory": folder, **_NO_PAGES}),
                LocalCluster(
                    n_workers=workers or len(os.sched_getaffinity(0)),
                    threads_per_worker=1,
                    processes=True,
                    # Reachable from this machine only, at any free port, and
                    # only with the key that was made for this campaign: who
                    # can talk to a scheduler can run any code.
                    host="127.0.0.1",
                    security=Security.temporary(),
                    dashboard_address="127.0.0.1:0",
                    silence_logs=logging.CRITICAL,
                    # A killed process cannot tidy up: what it leaves is in the
                    # folder and goes with it.
                    local_directory=folder,
                    env={"TMPDIR": folder},
                ) as cluster,
                Client(cluster) as client,
            ):
                yield client
            return
        with _connect_to(scheduler) as client:
            _check_workers(client, scheduler)
            yield client


@contextlib.contextmanager
def _make_scratch(path):
    try:
        path.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise UserError(
            f"--out: cannot write into {path.parent}: {error.strerror}"
        ) from None
    try:
        yield str(path.resolve())
    finally:
        shutil.rmtree(path, ignore_errors=True)


def _connect_to(scheduler):
    logging.getLogger("distributed").setLevel(logging.CRITICAL)
    try:
        return Client(scheduler, timeout=TIMEOUT)
    except (OSError, ValueError, TypeError) as error:
        reason = " ".join(str(error).split()) or type(error).__name__
        raise UserError(
            f"--scheduler: no Dask scheduler answers at {scheduler} ({reason})"
        ) from None


def _check_workers(client, scheduler):
    """Raises UserError unless there are workers with our versions."""
    try:
        theirs = client.run(get_versions)
    except ImportError as error:
        raise UserError(
            f"--scheduler: a worker of {scheduler} lacks a package: {error}"
        ) from None
    if not theirs:
        raise UserError(
            f"--scheduler: {scheduler} has no workers; start some with "
            "`dask worker ADDRESS --nthreads 1`"
        )
    ours = get_versions()
    for address, versions in theirs.items():
        for name, version in ours.items():
            if versions.get(name) != version:
                raise UserError(
                    f"--scheduler: the worker {address} has {name} "
                    f"{versions.get(name)}, this machine {version}"
                )


def call_all(
    client: Client,
    function: Callable,
    calls: dict[str, tuple],
    *,
    tell: Callable[[str], None],
) -> Iterator[tuple[str, Any, BaseException | None]]:
    """Calls a function with many sets of arguments, in parallel.

    Args:
        client: From `connect`.
        function: What to call; importable by the workers.
        calls: Arguments by name of the call.
        tell: Called with a line when no worker is left, which is waited for.

    Yields:
        (name, result, None) or (name, None, error), as they come. Results are
        not kept.

    Raises:
        UserError: The scheduler is gone.
    """
    names = {}
    for priority, (name, arguments) in enumerate(calls.items()):
        future = client.submit(
            function, *arguments, pure=False, priority=-priority
        )
        names[future] = name
    try:
        while names:
            for future in _wait_for_some(client, list(names), tell):
                name = names.pop(future)
                error = future.exception()
                if isinstance(error, CancelledError):
                    # Nobody cancels a run.
                    raise error
                result = None if error is not None else future.result()
                future.release()
                yield name, result, error
    except (CancelledError, CommClosedError):
        raise UserError(
            f"the Dask scheduler is gone; {len(names)} runs are not finished: "
            "run the same command again to continue"
        ) from None


def _wait_for_some(client, futures, tell):
    """Returns those that are done, at least one."""
    had_workers = True
    while True:
        try:
            return wait(futures, _LOOK, return_when="FIRST_COMPLETED").done
        except TimeoutError:
            has_workers = bool(client.nthreads())
        if had_workers and not has_workers:
            tell("no worker is left; waiting for one (Ctrl-C ends the wait)")
        had_workers = has_workers
