"""Measures how long each fault takes to stop a robot: `make fault-table`.

Prints tables in Markdown: of rings, sensors and robot for docs/faults.md, of
processes for docs/hardware.md. The first three are measured in lock-step, where
a cycle of the robot lasts exactly as long as it should: the same on every
computer. For the last one, robot and runner are separate processes, the rings
send over a real socket, and another client of the robot takes the times; it
takes some minutes on an otherwise idle computer.
"""

from collections.abc import Sequence
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
from fault_rows import (
    RING_ROWS,
    ROBOT_ROWS,
    SENSOR_ROWS,
    Moment,
    Row,
    make_cell,
    measure_row,
)
from paper_cell import RINGS

from tofssm_drake.diagrams.scenario import load_scenario
from tofssm_drake.diagrams.simulated_rings import (
    SimulatedRings,
    iterate_wake_times,
)
from tofssm_drake.ringlink.ring_address import parse_ring_address
from tofssm_drake.ringlink.ring_device import UdpSender
from tofssm_drake.ringlink.ring_fault_injection import (
    FAULTS,
    FaultInjector,
    RingFault,
)

_TIMES = 3
# Faults of a whole ring that alone stop the robot.
_KINDS = (
    *("silent", "corrupt", "duplicate", "frozen", "late", "implausible"),
    *("bus", "restart"),
)
_PORT = 5005
_HEADS = {
    Moment.ALONE: "nobody there, ms",
    Moment.HELD: "held by a person, ms",
    Moment.COMES: "a person comes, ms",
}
_SIGNALS = {
    signal.SIGINT: "Ctrl-C",
    signal.SIGTERM: "SIGTERM",
    signal.SIGKILL: "kill -9",
    signal.SIGSTOP: "runner hangs, or nothing goes between it and the robot",
}
_HERE = Path(__file__).parent


class Rings:
    """Simulated rings in a thread, with faults that begin on request.

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
        """Begins a fault of a ring, or of one of its sensors."""
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
        # Frames that a fault delays leave with a later frame.
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
        """Adds one measurement, a `Seen`."""
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
    """Leaves out the consequence if the cause is reported before it."""
    return re.sub(r"; slider at most .*", "", text)


def _measure(cell, runner, act, *, settled=0.5):
    cell.wait_for_full_speed(runner)
    start = time.monotonic()
    act()
    return cell.watcher.see(start, settled=settled)


def print_rows(rows: Sequence[Row]) -> None:
    """Measures faults in lock-step and prints them in Markdown."""
    alone = make_cell(Moment.ALONE)
    cells = {
        Moment.ALONE: alone,
        Moment.HELD: make_cell(Moment.HELD),
        Moment.COMES: alone,
    }
    heads = ("fault", *(_HEADS[m] for m in Moment), "the runner says, or why")
    print(f"\n| {' | '.join(heads)} |\n|{len(heads) * '---|'}")
    for row in rows:
        # The moment between two samples counts, too.
        times = {
            moment: [
                measure_row(cells[moment], row, moment, shift)
                for shift in range(3 if moment == Moment.ALONE else 1)
            ]
            for moment in Moment
        }
        columns = [
            _describe_times(times[moment], moment in row.open)
            for moment in Moment
        ]
        note = _describe_note(row, times[Moment.ALONE][0].health)
        print(f"| {row.name} | {' | '.join(columns)} | {note} |", flush=True)


def _describe_times(times, is_open):
    """Returns the longest times to 0 and to standstill, ms."""
    zero, still = (
        max(getattr(t, name) for t in times) for name in ("zero", "still")
    )
    if is_open:
        return "**open**"
    if still == math.inf:
        return "goes on"
    if zero == still:
        return f"{round(1e3 * still)}"
    first = "stays" if zero == math.inf else f"{round(1e3 * zero)}"
    return f"{first} / {round(1e3 * still)}"


def _describe_note(row, health):
    """Returns what was said, and why it may go on."""
    says = _shorten(health) if row.says and not row.open else ""
    return "; ".join(filter(None, (says, row.why, row.finder)))


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


def print_processes() -> None:
    """Measures with processes and sockets, and prints it in Markdown."""
    table = Table()
    measure_rings(table)
    with tempfile.TemporaryDirectory() as folder:
        measure_ends(table, Path(folder))
    table.print()


_PARTS = {
    "rings": lambda: print_rows(RING_ROWS),
    "sensors": lambda: print_rows(SENSOR_ROWS),
    "robot": lambda: print_rows(ROBOT_ROWS),
    "processes": print_processes,
}


def main():
    """Measures and prints the named parts; by default all."""
    for part in sys.argv[1:] or _PARTS:
        _PARTS[part]()


if __name__ == "__main__":
    main()
