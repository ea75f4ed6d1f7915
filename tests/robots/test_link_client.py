"""A link of one's own: numbered, opened again, left at 0."""

import queue
import time

import numpy as np
import pytest

from tofssm_drake.messages import RobotReport, SliderCommand
from tofssm_drake.robots.link_client import LinkClient


class Link:
    """Gives the reports that are put into it; an exception is raised."""

    frequency = 100.0

    def __init__(self):
        self.items = queue.Queue()
        self.written = []
        self.is_closed = False
        self.fails = False

    def put(self, timestamp, **fields):
        values = {"position": np.zeros(7), "velocity": np.zeros(7)} | fields
        self.items.put(RobotReport(timestamp=timestamp, **values))

    def read(self):
        try:
            item = self.items.get(timeout=0.05)
        except queue.Empty:
            return self.last
        if isinstance(item, Exception):
            raise item
        self.last = item
        return item

    def write(self, command):
        if self.fails:
            raise OSError("full")
        self.written.append(command)

    def close(self):
        self.is_closed = True


@pytest.fixture
def links():
    return []


@pytest.fixture
def dut(links):
    def open_link():
        links.append(Link())
        return links[-1]

    with LinkClient(open_link, where="robot:1") as client:
        wait(lambda: links)
        yield client


def wait(condition):
    """Waits until something holds."""
    deadline = time.monotonic() + 120.0
    while not condition():
        assert time.monotonic() < deadline
        time.sleep(0.002)


def get_next(dut, after):
    report = dut.wait_for_report(after=after, timeout=120.0)
    assert report.sequence == after + 1
    return report


def test_reports_are_numbered(dut, links):
    links[0].put(5.0)
    first = get_next(dut, -1)
    assert (first.session, first.missed, len(first.position)) == (0, 0, 7)
    assert np.isfinite(first.time)
    # The same once more does not count; three are missing.
    links[0].put(5.0)
    links[0].put(5.04)
    second = get_next(dut, 0)
    assert (second.session, second.missed, second.timestamp) == (0, 3, 5.04)
    # The robot's clock goes back, then far ahead.
    links[0].put(1.0)
    assert get_next(dut, 1).session == 1
    links[0].put(1000.0)
    assert get_next(dut, 2).session == 2
    status = dut.get_status()
    assert (status.connected, status.problem, status.writes) == (True, "", True)
    assert status.frequency == 100.0


@pytest.mark.parametrize(
    ("error", "problem"),
    [
        (OSError("the controller hung up"), "robot:1: the controller hung up"),
        (ValueError("nonsense"), "robot:1: nonsense"),
        (KeyError("q"), "KeyError('q')"),
    ],
)
def test_a_link_that_raises_is_opened_again(dut, links, error, problem):
    links[0].put(5.0)
    get_next(dut, -1)
    links[0].items.put(error)
    wait(lambda: dut.get_status().problem == problem or len(links) > 1)
    wait(lambda: len(links) > 1)
    assert links[0].is_closed
    links[1].put(5.01)
    assert get_next(dut, 0).session == 1


@pytest.mark.parametrize(
    "fields",
    [
        {"position": np.full(7, np.nan)},
        {"velocity": np.full(7, np.inf)},
        {"timestamp": np.nan},
    ],
)
def test_what_is_not_a_number_is_no_report(dut, links, fields):
    links[0].put(**({"timestamp": 5.0} | fields))
    wait(lambda: len(links) > 1)
    assert dut.get_report().sequence == -1


def test_commands_answer_reports_of_this_connection(dut, links):
    assert not dut.send(SliderCommand(sequence=0, mask=1))
    links[0].put(5.0)
    get_next(dut, -1)
    wait(lambda: dut.get_status().writes)
    assert not dut.send(SliderCommand())
    assert dut.send(SliderCommand(sequence=0, mask=1, speed_fraction=0.5))
    with pytest.raises(ValueError, match="not a number"):
        dut.send(SliderCommand(sequence=0, mask=1, speed_fraction=np.nan))
    links[0].fails = True
    assert not dut.send(SliderCommand(sequence=0, mask=1))
    # A robot that takes no commands is connected again.
    links[0].put(5.01)
    links[0].put(5.02)
    wait(lambda: len(links) > 1)
    links[1].put(5.03)
    after = get_next(dut, 0).sequence
    wait(lambda: dut.send(SliderCommand(sequence=after, mask=1)))
    assert not dut.send(SliderCommand(sequence=0, mask=1))


def test_closing_sets_it_to_0(dut, links):
    links[0].put(5.0)
    get_next(dut, -1)
    wait(lambda: dut.get_status().writes)
    dut.close()
    (command, *_) = links[0].written
    assert (command.mask, command.speed_fraction) == (1, 0.0)
    assert links[0].is_closed
    assert dut.get_status().problem == "closed"


def test_without_write_nothing_is_written():
    link = Link()
    link.put(5.0)
    with LinkClient(lambda: link, where="robot:1", write=False) as dut:
        get_next(dut, -1)
        assert not dut.send(SliderCommand(sequence=0, mask=1))
    assert link.written == []
