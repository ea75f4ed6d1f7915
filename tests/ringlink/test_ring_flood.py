"""More datagrams than rings send: they cost nothing but a counter."""

import contextlib
import resource
import threading
import time

import pytest
from ring_flood import flood
from test_ring_link import find_port, make_decoder, make_example, wait_for

from tofssm_drake.ringlink.ring_address import UdpAddress
from tofssm_drake.ringlink.ring_device import UdpSender
from tofssm_drake.ringlink.ring_frame import encode_frame
import tofssm_drake.ringlink.ring_link as mut

_UNKNOWN = encode_frame(make_example(9, 0))
_DAMAGED = encode_frame(make_example(0, 0))[:-1] + b"\0"
_MANY = 50_000


@contextlib.contextmanager
def sending_rings(address):
    """Sends a frame of each ring every 24 ms."""
    ended = threading.Event()

    def send():
        sequence = 0
        while not ended.wait(0.024):
            for ring in range(3):
                sender.send(make_example(ring, sequence))
            sequence += 1

    sender = UdpSender(address)
    thread = threading.Thread(target=send)
    thread.start()
    try:
        yield
    finally:
        ended.set()
        thread.join()
        sender.close()


@pytest.fixture
def address():
    return UdpAddress(
        host="127.0.0.1", port=find_port(), senders=("127.0.0.1",)
    )


@pytest.mark.parametrize(
    ("data", "name"),
    [
        (_UNKNOWN, "unknown"),
        (_DAMAGED, "corrupt"),
        (bytes(4000), "corrupt"),
        (b"", "corrupt"),
    ],
    ids=["unknown", "damaged", "large", "empty"],
)
def test_a_flood_is_only_counted(address, data, name):
    taken = []
    with (
        mut.RingLink(
            addresses=[address],
            decoder=make_decoder(),
            tap=lambda arrival, source, data: taken.append(data),
        ) as link,
        sending_rings(address),
    ):
        with flood(address, data):
            assert wait_for(lambda: getattr(link.get_status(), name) > 1000)
            memory = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
            assert wait_for(lambda: getattr(link.get_status(), name) > _MANY)
            # Scans come while the flood goes on.
            before = [scan.sequence for scan in link.get_scans()]
            assert wait_for(
                lambda: all(
                    scan.sequence > then + 10
                    for scan, then in zip(link.get_scans(), before, strict=True)
                )
            )
            grown = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - memory
        status = link.get_status()
    assert status.error == ""
    assert [c.out_of_order for c in status.counts.values()] == [0, 0, 0]
    # What is recorded is of the rings.
    assert data not in taken
    assert len(taken) == sum(c.received for c in status.counts.values())
    # In kB; the datagrams have 50,000 times that of one.
    assert grown < 20_000


def test_the_newest_of_a_backlog_counts(address):
    """The reader is held while frames and others' datagrams wait."""
    held, go_on = threading.Event(), threading.Event()

    def hold(*_):
        held.set()
        go_on.wait()

    with mut.RingLink(
        addresses=[address], decoder=make_decoder(), tap=hold
    ) as link:
        try:
            sender = UdpSender(address)
            sender.send(make_example(0, 0))
            assert held.wait(120.0)
            for sequence in range(1, 60):
                sender.send(make_example(0, sequence, 0.001 * sequence))
                sender.send_bytes(_UNKNOWN)
            began = time.monotonic()
        finally:
            go_on.set()
            sender.close()
        assert wait_for(lambda: link.get_status().unknown == 59)
        assert wait_for(lambda: link.get_scans()[0].sequence == 59)
        scan = link.get_scans()[0]
        assert scan.distance[0] == pytest.approx(0.059)
        # It is as old as it is: it came after the first one did.
        assert scan.time >= began
        status = link.get_status()
        assert (status.counts["base"].lost, status.corrupt) == (0, 0)
