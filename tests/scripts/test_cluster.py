import os

from distributed import Client
from distributed.security import Security
import psutil
import pytest

import tofssm_drake.scripts.cluster as mut


def test_only_the_campaign_may_use_its_workers(tmp_path):
    """Who can talk to a scheduler can run any code as its user."""
    with mut.connect(workers=1, scratch=tmp_path / "scratch") as client:
        assert client.submit(os.getpid).result() != os.getpid()
        address = client.scheduler.address
        assert address.startswith("tls://127.0.0.1:")
        for theirs, security in (
            (address.replace("tls", "tcp"), None),
            (address, Security.temporary()),
        ):
            with pytest.raises(OSError):
                Client(theirs, security=security, timeout=5)
        for process in (psutil.Process(), *psutil.Process().children(True)):
            for connection in process.net_connections(kind="inet"):
                if connection.status == psutil.CONN_LISTEN:
                    assert connection.laddr.ip == "127.0.0.1"
    assert not (tmp_path / "scratch").exists()
