"""What the systems of a tick see."""

import numpy as np
from paper_cell import RINGS

from tofssm_drake.diagrams.held_connections import HeldRings
from tofssm_drake.messages import RingScan

_HOST = 900.0


def make_scan(sequence, time):
    return RingScan(
        sequence=sequence,
        time=_HOST + time,
        sensor_time=np.array([_HOST + time - 0.001, _HOST + time]),
        distance=np.ones(2),
        status=np.zeros(2, dtype=np.uint8),
    )


def take(rings, scan, offset=-_HOST):
    rings.take((scan,) * len(RINGS), clock_offset=offset)
    return rings.scans[0]


def test_scans_are_on_the_diagrams_clock():
    held = take(HeldRings(RINGS), make_scan(0, 4.99))
    np.testing.assert_allclose(held.sensor_time, [4.989, 4.99], atol=1e-9)


def test_a_scan_is_taken_once():
    """The clock offset known at that time is used."""
    rings = HeldRings(RINGS)
    scan = make_scan(0, 4.99)
    first = take(rings, scan)
    assert take(rings, scan, offset=-_HOST + 0.01) is first


def test_nothing_came():
    rings = HeldRings(RINGS)
    rings.take((), clock_offset=0.0)
    assert [scan.sequence for scan in rings.scans] == [-1, -1, -1]
