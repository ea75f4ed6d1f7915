"""Runs a campaign in the process of the test."""

import contextlib

from distributed import Client, LocalCluster


@contextlib.contextmanager
def connect_in_process(scheduler=None, *, workers=None, scratch=None):
    with (
        LocalCluster(
            n_workers=1,
            threads_per_worker=1,
            processes=False,
            dashboard_address="127.0.0.1:0",
        ) as cluster,
        Client(cluster) as client,
    ):
        yield client
