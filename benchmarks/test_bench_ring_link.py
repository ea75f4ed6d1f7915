"""What a ring's frame costs, from the wire to the scan."""

import socket
import time

import numpy as np
import pytest

from tofssm_drake.messages import RingScan
from tofssm_drake.ringlink.ring_address import SerialAddress, UdpAddress
from tofssm_drake.ringlink.ring_device import (
    PtySender,
    UdpSender,
    make_frame,
)
from tofssm_drake.ringlink.ring_frame import encode_frame, encode_serial
from tofssm_drake.ringlink.ring_link import RingLink
from tofssm_drake.ringlink.ring_receiver import RingDecoder, RingLinkConfig
from tofssm_drake.sensors.ring import Ring

_BUDGET = 0.020
_FRAMES = 2000


def make_decoder(sensors=8):
    return RingDecoder(
        config=RingLinkConfig(settle_time=0.0),
        rings={"ring": Ring(count=sensors)},
    )


def make_frames(count, sensors=8, start=0.0):
    """Frames of one ring, 24 ms apart, with noise."""
    generator = np.random.default_rng(0)
    frames = []
    for i in range(count):
        end = start + 0.024 * i
        frames.append(
            make_frame(
                RingScan(
                    sequence=i,
                    time=end,
                    sensor_time=np.full(sensors, end - 0.010),
                    distance=generator.uniform(0.1, 1.3, sensors),
                    status=np.zeros(sensors, dtype=np.uint8),
                ),
                ring=0,
                timing_budget=_BUDGET,
            )
        )
    return frames


@pytest.mark.parametrize("sensors", [8, 16])
def test_datagram_to_scan(benchmark, sensors):
    data = [encode_frame(f) for f in make_frames(_FRAMES, sensors)]

    def receive():
        decoder = make_decoder(sensors)
        for i, piece in enumerate(data):
            decoder.receive_datagram(piece, 100.0 + 0.024 * i)
        return decoder

    decoder = benchmark(receive)
    assert decoder.counts["base"].delivered == _FRAMES
    benchmark.extra_info["us per frame"] = (
        1e6 * benchmark.stats.stats.median / _FRAMES
    )


def test_serial_to_scan(benchmark):
    data = [encode_serial(f) for f in make_frames(_FRAMES)]

    def receive():
        decoder = make_decoder()
        decoder.receive_serial("a", b"\0", 99.0)
        for i, piece in enumerate(data):
            decoder.receive_serial("a", piece, 100.0 + 0.024 * i)
        return decoder

    decoder = benchmark(receive)
    assert decoder.counts["base"].delivered == _FRAMES
    benchmark.extra_info["us per frame"] = (
        1e6 * benchmark.stats.stats.median / _FRAMES
    )


@pytest.mark.parametrize("carrier", ["udp", "serial"])
def test_sent_to_seen(benchmark, carrier):
    """From the sender's call until another thread sees the new scan."""
    if carrier == "udp":
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
            probe.bind(("127.0.0.1", 0))
            port = probe.getsockname()[1]
        address = UdpAddress(
            host="127.0.0.1", port=port, senders=("127.0.0.1",)
        )
        sender = UdpSender(address)
    else:
        sender = PtySender()
        address = SerialAddress(path=sender.path)
    frames = iter(make_frames(4000))
    with RingLink(addresses=[address], decoder=make_decoder()) as link:
        sender.send(next(frames))

        def send():
            before = link.get_scans()[0]
            sender.send(next(frames))
            # Asleep, or the link's thread would have to wait for this one.
            while link.get_scans()[0] is before:
                time.sleep(20e-6)

        # At the frames' own rate, or their clock would be out of its limits.
        def pause():
            time.sleep(0.024)

        benchmark.pedantic(send, setup=pause, rounds=200)
        latency = np.array(benchmark.stats.stats.data)
        benchmark.extra_info["p99 us"] = 1e6 * np.quantile(latency, 0.99)
        assert link.get_status().counts["base"].lost == 0
    sender.close()
