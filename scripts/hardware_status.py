"""What `tofssm hardware` prints while it runs: messages and a status line.

A thread writes it. A blocked terminal (Ctrl-S, a slow network) blocks the
thread, not the loop that the robot waits for.
"""

import collections
import contextlib
import math
import re
import shutil
import sys
import threading
import time
from typing import TextIO

from tofssm_drake.diagrams.hardware_loop import TickResult
from tofssm_drake.messages import RobotReport, RobotState
from tofssm_drake.ringlink.ring_link import RingConnection, RingLinkStatus
from tofssm_drake.robots.robot_connection import RobotConnection

# Between two updates, s.
_PERIOD = 0.2
# The end of a stop is reported after it has lasted this long, s: near a
# threshold the state may change with each scan.
_SETTLE = 1.0
# Longest wait for a blocked terminal at the end, s.
_FAREWELL = 1.0
# Between two lines about datagrams that are ignored, s.
_STRANGERS = 60.0
# Most lines that wait for a blocked terminal.
_WAITING = 100


class HardwareStatus:
    """Prints the status of a run; a context manager.

    Args:
        robot: The connection to the robot.
        link: The connection to the rings; None: they are virtual.
        dry_run: Whether nothing is written, so that the slider cannot obey.
        placed: See `describe_status`.
        stream: Where to print; None: stderr. A terminal also gets a status
            line, which is updated in place.
    """

    def __init__(
        self,
        *,
        robot: RobotConnection,
        link: RingConnection | None,
        dry_run: bool,
        placed: str = "placed",
        stream: TextIO | None = None,
    ):
        self._robot = robot
        self._link = link
        self._dry_run = dry_run
        self._placed = placed
        self._stream = sys.stderr if stream is None else stream
        self._changes = Changes(dry_run=dry_run)
        self._lines: collections.deque[str] = collections.deque(maxlen=_WAITING)
        self._result: TickResult | None = None
        self._missed = robot.get_report().missed
        self._problems = {"robot": "", "rings": ""}
        self._strangers = ""
        self._strangers_told = -math.inf
        self._done = threading.Event()
        self._thread = threading.Thread(
            target=self._run, name="status", daemon=True
        )

    def __enter__(self) -> "HardwareStatus":
        self._thread.start()
        return self

    def __exit__(self, *exception) -> None:
        self.end()
        self._thread.join(_FAREWELL)

    def end(self) -> None:
        """Ends the thread; later problems of the links are not printed."""
        self._done.set()

    def show(self, result: TickResult | None) -> None:
        """Takes the newest result; returns at once."""
        if result is None or result is self._result:
            return
        self._result = result
        line = self._changes.find(result)
        if line:
            self._lines.append(line)

    def _run(self):
        # A terminal that is gone must not affect the run.
        with contextlib.suppress(OSError, ValueError):
            while not self._done.wait(_PERIOD):
                self._write()
            self._write()
            if self._stream.isatty():
                self._stream.write("\r\x1b[K")
                self._stream.flush()

    def _write(self):
        problem = self._robot.get_status().problem
        rings = None if self._link is None else self._link.get_status()
        if not self._done.is_set():
            self._find_problem("robot", problem)
            if rings is not None:
                self._find_problem("rings", rings.error)
                self._find_strangers(rings)
        is_terminal = self._stream.isatty()
        text = ""
        while self._lines:
            text += self._lines.popleft() + "\n"
        if is_terminal:
            # Overwrites the line, as wide as the terminal is now.
            text = "\r\x1b[K" + text
            width = shutil.get_terminal_size().columns
            if self._result is not None:
                text += self._describe(self._result, rings, width)
        if text:
            self._stream.write(text)
            self._stream.flush()

    def _describe(self, result, rings, width):
        return describe_status(
            result,
            self._robot.get_report(),
            rings,
            now=time.monotonic(),
            missed_before=self._missed,
            dry_run=self._dry_run,
            placed=self._placed,
            # A character in the last column may break the line.
            width=width - 1,
        )

    def _find_problem(self, who, problem):
        """Reports once what is wrong with a link, and its recovery."""
        if problem != self._problems[who]:
            self._problems[who] = problem
            self._lines.append(f"{who}: {problem or 'all is well again'}")

    def _find_strangers(self, rings):
        """Tells what came that is not of the rings, once a minute at most."""
        now = time.monotonic()
        counts = describe_strangers(rings)
        if (
            counts != self._strangers
            and now - self._strangers_told > _STRANGERS
        ):
            self._strangers, self._strangers_told = counts, now
            self._lines.append(f"rings: ignored so far: {counts}")


def describe_strangers(rings: RingLinkStatus) -> str:
    """Says what came that is not of the rings; empty: nothing."""
    counts = {
        "frames of unknown rings": rings.unknown,
        "datagrams of other senders": rings.foreign,
        "damaged frames": rings.corrupt,
    }
    return ", ".join(f"{n} {name}" for name, n in counts.items() if n)


class Changes:
    """Finds which ticks are worth a line.

    A stop is reported at once, its end after it has lasted for a second: near a
    threshold the state may change with each scan.

    Args:
        dry_run: Whether nothing is written, so that the slider cannot obey.
    """

    def __init__(self, *, dry_run: bool):
        self._dry_run = dry_run
        self._reported: tuple | None = None
        self._health: str | None = None
        self._stopped = False
        self._since = -math.inf

    def find(self, result: TickResult) -> str:
        """Returns the line for a tick; empty: nothing new.

        Args:
            result: Of the next tick.
        """
        if result.robot_state == RobotState.STOP:
            self._stopped = True
            self._since = result.time
        elif result.time - self._since >= _SETTLE:
            self._stopped = False
        news: tuple = (self._stopped, _strip_numbers(result.problem))
        if not self._dry_run:
            reason = _strip_numbers(result.slider.reason)
            news = (*news, result.slider.phase, reason)
        if news == self._reported:
            return ""
        self._reported = news
        health = describe_health(result, dry_run=self._dry_run)
        if health == self._health:
            return ""
        self._health = health
        return f"{result.time:8.2f} s  {health}"


def _strip_numbers(text):
    """Returns a text without its numbers, which keep changing."""
    return re.sub(r"[0-9.]+", "", text)


def describe_health(result: TickResult, *, dry_run: bool) -> str:
    """Returns one line: state, phase of the slider, and why.

    Args:
        result: Of the newest tick.
        dry_run: Whether nothing is written, so that the slider cannot obey.
    """
    state = RobotState(result.robot_state).name.lower()
    if dry_run:
        return result.reason
    phase = result.slider.phase.name.lower()
    return f"{state}, slider {phase}: {result.health or 'all is well'}"


def describe_status(
    result: TickResult,
    report: RobotReport,
    rings: RingLinkStatus | None,
    *,
    now: float,
    missed_before: int = 0,
    dry_run: bool = False,
    placed: str = "placed",
    width: int = 1000,
) -> str:
    """Returns the status line, no wider than the terminal.

    State, nearest ring and distance, speed fraction commanded and echoed, ages
    of the robot's report and of the rings' samples, gaps (lost packages and
    frames), sensors that are faulted or declared dead, and whatever else fits.

    Args:
        result: Of the newest tick.
        report: The robot's newest.
        rings: Of the link; None: they are virtual.
        now: Host's time, s.
        missed_before: Packages missed before the run.
        dry_run: Whether nothing is written.
        placed: What is done with the objects that the robot counts; empty: it
            counts none.
        width: Of the terminal, characters.
    """
    distance = result.separation.distance
    nearest = int(distance.argmin())
    near = "clear"
    if math.isfinite(distance[nearest]):
        near = f"{result.separation.name[nearest]} {distance[nearest]:.2f} m"
    ages = f"age robot {_format_age(now - report.time)}"
    gaps = f"gaps {report.missed - missed_before}"
    if rings is not None:
        ages += f", rings {_format_age(now - min(rings.measured.values()))}"
        gaps += f", {sum(c.lost for c in rings.counts.values())}"
    parts = [
        RobotState(result.robot_state).name.lower(),
        *(["dry run"] if dry_run else []),
        near,
        f"rho {result.speed_fraction:.2f}, "
        f"echo {report.target_speed_fraction:.2f}",
        f"{ages} ms",
        _describe_sensors(result),
        gaps,
        f"{result.products_placed} {placed}" if placed else "",
        "" if rings is None else rings.describe(now),
        result.slider.reason,
    ]
    line = parts[0]
    for part in parts[1:]:
        if part and len(line) + 2 + len(part) <= width:
            line += f"  {part}"
    return line[:width]


def _describe_sensors(result):
    """Returns what is wrong with the rings' sensors; empty: nothing."""
    separation = result.separation
    return "; ".join(
        f"{ring} {problem}"
        for ring, problem in zip(
            separation.name, separation.problem, strict=False
        )
        if problem
    )


def _format_age(seconds):
    return f"{1e3 * seconds:.0f}" if seconds < 100.0 else "-"
