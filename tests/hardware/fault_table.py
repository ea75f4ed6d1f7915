"""Measures how long each fault takes to stop a robot: `make fault-table`.

Prints two tables in Markdown for docs/hardware.md. The first is of lock-step,
where a cycle of the robot lasts as long as it should: the same on every
computer. For the second, robot and runner are processes of their own, the
rings send over a real socket, and the times are those of another client of
the robot: some minutes on a computer that has nothing else to do.
"""

import contextlib
import math
from pathlib import Path
import re
import signal
import statistics
import sys
import tempfile
import threading
import time

from cell_process import NOBODY, CellProcess
from lockstep import CYCLE, Cell

from tofssm_drake.diagrams.scenario import load_scenario
from tofssm_drake.diagrams.simulated_rings import (
    SimulatedRings,
    iterate_wake_times,
)
from tofssm_drake.hardware.ring_address import parse_ring_address
from tofssm_drake.hardware.ring_device import UdpSender
from tofssm_drake.hardware.ring_fault_injection import (
    FAULTS,
    FaultInjector,
    RingFault,
)
from tofssm_drake.hardware.rtde_fields import SafetyMode
from tofssm_drake.messages import RINGS

_TIMES = 3
# Those of a whole ring that stop the robot by themselves.
_KINDS = (
    *("silent", "corrupt", "duplicate", "frozen", "late", "implausible"),
    *("bus", "restart"),
)
_PORT = 5005
_SIGNALS = {
    signal.SIGINT: "Ctrl-C",
    signal.SIGTERM: "SIGTERM",
    signal.SIGKILL: "kill -9",
    signal.SIGSTOP: "runner hangs, or nothing goes between it and the robot",
}
_HERE = Path(__file__).parent


class Rings:
    """Simulated rings in a thread, whose faults begin when one likes.

    Args:
        cell: Robot and its watcher.
    """

    def __init__(self, cell: CellProcess):
        self._watcher = cell.watcher
        self._injectors = [FaultInjector() for _ in RINGS]
        cell.address = f"udp://{cell.host}:{_PORT}"
        self._sender = UdpSender(parse_ring_address(cell.address))
        self._scenario = load_scenario(text=NOBODY)
        self._rings = SimulatedRings(scenario=self._scenario, send=self._send)
        self._stopped = threading.Event()
        self._thread = threading.Thread(target=self._run)
        self._thread.start()

    def inject(self, kind: str, ring: str, sensor: int | None = None) -> None:
        """Begins a fault of a ring, or of one of its sensors alone."""
        self._injectors[RINGS.index(ring)] = FaultInjector(
            [RingFault(kind=kind, ring=ring, start=0.0, sensor=sensor)]
        )

    def heal(self) -> None:
        """Ends all faults."""
        self._injectors = [FaultInjector() for _ in RINGS]

    def close(self) -> None:
        """Ends the thread."""
        self._stopped.set()
        self._thread.join()
        self._sender.close()

    def _send(self, frame, is_damaged):
        # Those whose fault delays them leave with a later frame.
        injector, now = self._injectors[frame.ring], time.monotonic()
        injector.put(frame, now)
        sent = [
            self._sender.send(d.frame, d.is_damaged) for d in injector.take(now)
        ]
        return any(sent)

    def _run(self):
        self._watcher.wait_for(lambda r: True)
        start = time.monotonic()
        for wake_time in iterate_wake_times(self._scenario):
            if self._stopped.is_set():
                return
            time.sleep(max(start + wake_time - time.monotonic(), 0.0))
            self._rings.advance(
                wake_time, self._watcher.report, start + wake_time
            )


class Table:
    """Rows of what was measured."""

    def __init__(self):
        self._rows: dict[str, list] = {}

    def add(self, fault, seen, note=""):
        """Adds one measurement: a `Seen` or `Times`."""
        self._rows.setdefault(fault, []).append((seen.zero, seen.still, note))
        print(
            f"{fault}: 0 after {seen.zero:.3f} s, still after "
            f"{seen.still:.3f} s; {note}",
            file=sys.stderr,
            flush=True,
        )

    def print(self):
        """Prints it in Markdown."""
        print("\n| fault | slider at 0, ms | standstill, ms | ", end="")
        print("the runner says |\n|---|---|---|---|", flush=True)
        for fault, values in self._rows.items():
            zero, still = (_describe([v[i] for v in values]) for i in range(2))
            print(f"| {fault} | {zero} | {still} | {values[0][2]} |")


def _describe(values):
    if math.inf in values:
        return "stays" if min(values) == math.inf else "not always"
    low, high = (round(1e3 * f(values)) for f in (min, max))
    if low == high:
        return f"{low}"
    return f"{round(1e3 * statistics.median(values))} ({low} to {high})"


def _last_line(runner):
    """Returns what the runner said last, without the time."""
    lines = (runner.err + runner.out).strip().splitlines()
    line = lines[-1].strip() if lines else ""
    return _shorten(re.sub(r"^[0-9.]+ s +\w+, slider \w+: ", "", line))


def _shorten(text):
    """Leaves out the consequence, where the cause is told before it."""
    return re.sub(r"; slider at most .*", "", text)


def _measure(cell, runner, act, *, settled=0.5):
    cell.wait_for_full_speed(runner)
    start = time.monotonic()
    act()
    return cell.watcher.see(start, settled=settled)


def measure_in_lockstep(table: Table) -> None:
    """All that does not end a runner, without clock and sockets."""
    cell = Cell()
    robot = cell.robot

    def late():
        cell.delay = 0.15

    def silent():
        cell.is_silent = True

    def disobey():
        robot.slider_frozen = True
        cell.inject("bus", "elbow")

    def ignore(fraction=1.0):
        robot.slowest_fraction = fraction
        cell.inject("bus", "elbow")

    acts = {
        f"ring {kind}: {FAULTS[kind]}": (
            lambda k=kind: cell.inject(k, "elbow"),
            1.5,
        )
        for kind in _KINDS
    } | {
        "a ring, and the slider does not obey": (disobey, 1.0),
        "a ring, and the arm ignores its slider": (ignore, 2.0),
        "a ring, and the arm gets no slower than 0.6": (
            lambda: ignore(0.6),
            2.0,
        ),
        "a ring, and the arm gets no slower than 0.1": (
            lambda: ignore(0.1),
            2.0,
        ),
        "robot's reports 0.15 s late": (late, 1.0),
        "robot silent": (silent, 1.0),
        "robot's clock jumps": (lambda: robot.shift_clock(5.0), 0.2),
        "program paused": (robot.pause, 0.5),
        "protective stop": (
            lambda: robot.set_safety_mode(SafetyMode.PROTECTIVE_STOP),
            0.5,
        ),
    }
    for fault, (act, duration) in acts.items():
        # The moment between two samples counts, too.
        for shift in range(3):
            cell.wait_for_full_speed()
            for _ in range(shift):
                cell.step()
            act()
            times = cell.measure(duration + CYCLE / 2)
            table.add(fault, times, _shorten(times.health))
            cell.heal()
            cell.delay = 0.0
            cell.is_silent = robot.slider_frozen = False
            robot.slowest_fraction = 0.0
            robot.set_safety_mode(SafetyMode.NORMAL)
            for _ in range(50):
                cell.step()
            robot.play()


def measure_rings(table: Table) -> None:
    """A ring's faults, and what needs one to show, with one runner."""
    with CellProcess() as cell, contextlib.closing(Rings(cell)) as rings:
        runner = cell.start_runner()
        for i in range(_TIMES):
            for kind in _KINDS:
                seen = _measure(
                    cell,
                    runner,
                    lambda kind=kind: rings.inject(kind, "elbow"),
                )
                table.add(
                    f"ring {kind}: {FAULTS[kind]}", seen, _last_line(runner)
                )
                rings.heal()
            cell.wait_for_full_speed(runner)
            cell.do("simulate slider-frozen on")
            seen = _measure(cell, runner, lambda: rings.inject("bus", "elbow"))
            table.add("the same, and no slider obeys", seen, _last_line(runner))
            cell.do("simulate slider-frozen off")
            rings.heal()
            for line, what, settled in (
                ("simulate clock 5", "robot's clock jumps", 0.0),
                ("pause", "program paused", 0.5),
                ("simulate safety 3", "protective stop", 0.5),
            ):
                seen = _measure(
                    cell,
                    runner,
                    lambda line=line: cell.do(line),
                    settled=settled,
                )
                table.add(what, seen, _last_line(runner))
                cell.do("unlock protective stop")
            print(f"{i + 1} of {_TIMES}", file=sys.stderr, flush=True)


def measure_ends(table: Table, folder: Path) -> None:
    """What ends a runner: each time with a new one."""
    trigger = folder / "fail"
    with CellProcess() as cell:
        for _ in range(_TIMES):
            for number, what in _SIGNALS.items():
                runner = cell.start_runner()
                seen = _measure(
                    cell,
                    runner,
                    lambda r=runner, n=number: r.process.send_signal(n),
                )
                if number == signal.SIGSTOP:
                    runner.process.kill()
                runner.process.wait()
                says = number in (signal.SIGINT, signal.SIGTERM)
                table.add(what, seen, _last_line(runner) if says else "")
            runner = cell.start_runner(
                main=(_HERE / "failing_runner.py", trigger)
            )
            seen = _measure(cell, runner, trigger.touch)
            runner.process.wait()
            trigger.unlink()
            table.add("exception in a system", seen, _last_line(runner))
        runner = cell.start_runner()
        cell.wait_for_full_speed(runner)
        start = time.monotonic()
        cell.do("simulate stall 15")
        runner.process.wait()
        elapsed = time.monotonic() - start
        print(f"silent for good: the run ends after {elapsed:.1f} s: ", end="")
        print(_last_line(runner))
    for _ in range(_TIMES):
        with CellProcess("pty") as cell:
            runner = cell.start_runner()
            seen = _measure(cell, runner, cell.rings.process.kill)
            # Its name may soon be that of another terminal.
            says = runner.wait_for("rings: .* is gone: .*")[0]
            table.add("rings unplugged", seen, says)
        # A robot that has placed no products yet: the run would end with them.
        with CellProcess() as cell:
            measure_full_disk(table, cell, folder)


def measure_full_disk(table: Table, cell: CellProcess, folder: Path) -> None:
    """Some seconds of a run, then what would be beyond fails."""
    runner = cell.start_runner(
        *("--record", folder / "run.mcap"), limit_file_size=4000
    )
    cell.wait_for_full_speed(runner)
    start = time.monotonic()
    runner.process.wait()
    seen = cell.watcher.see(start)
    up = [r for r in seen.reports if r.target_speed_fraction > 0]
    seen.zero -= up[-1].time - start
    seen.still -= up[-1].time - start
    table.add("disk full", seen, _last_line(runner))


def main():
    """Measures and prints."""
    table = Table()
    measure_in_lockstep(table)
    table.print()
    table = Table()
    measure_rings(table)
    with tempfile.TemporaryDirectory() as folder:
        measure_ends(table, Path(folder))
    table.print()


if __name__ == "__main__":
    main()
