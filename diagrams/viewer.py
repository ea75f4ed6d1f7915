"""A viewer in a process of its own, which may die without ending the run.

    Diagram -> FrameSender -> queue -> pipe -> viewer_process -> Meshcat

Meshcat listens to every program of this machine, and a broken message ends
its process. So that is not the process of the run, which opens no port for it.
"""

from collections.abc import Callable
import contextlib
import dataclasses as dc
import json
from pathlib import Path
import pickle
import queue
import signal
import subprocess
import sys
import threading
import time

from pydrake.systems.framework import Diagram, DiagramBuilder

from tofssm_drake.diagrams.scenario import Scenario
from tofssm_drake.diagrams.sensors.rings import find_rings
from tofssm_drake.messages import Frame
from tofssm_drake.visualization.frames import FrameSender
from tofssm_drake.visualization.recording import FPS

# A viewer that takes nothing for this long has ended, s.
_PATIENCE = 60.0
# Frames that wait for the viewer, e.g. while it starts: about a minute of a
# recording, two seconds of a live view.
_WAITING_RECORDED = 1024
_WAITING_LIVE = 32
# From one look at whether the viewer has ended to the next, s.
_LOOK = 0.1
# How long a killed viewer may take to end, s.
_FAREWELL = 2.0


@dc.dataclass(frozen=True, kw_only=True)
class ViewerSettings:
    """What a viewer shows, and how."""

    scenario: Scenario
    """What is seen of it is in the frames, or moves by their time."""
    is_watched: bool = False
    """Whether browsers can watch the run."""
    is_recorded: bool = False
    """Whether it is recorded: then no frame may be lost."""
    with_health: bool = False
    """Whether there is a `HealthBoard`."""


@dc.dataclass(frozen=True, kw_only=True)
class RecordingOrder:
    """Tells the viewer to write what it has recorded."""

    folder: Path
    """With the run's samples; the recording is written into it too."""
    name: str
    """Of the recording's file."""
    title: str
    """Of its page."""


def add_frame_sender(
    builder: DiagramBuilder,
    scenario: Scenario,
    station: Diagram,
    monitor: Diagram,
    send: Callable[[Frame], None],
) -> None:
    """Sends what a viewer draws.

    Args:
        builder: Of the workcell.
        scenario: Checked settings.
        station: Of that scenario.
        monitor: Likewise.
        send: Takes each frame, see `FrameSender`.
    """
    rings = tuple(find_rings(scenario.sensors))
    sender = builder.AddNamedSystem(
        "frame_sender",
        FrameSender(
            send=send,
            num_joints=station.GetOutputPort("position_measured").size(),
            num_objects=station.GetOutputPort("carried_objects").size(),
            rings=rings,
            period=1.0 / FPS,
        ),
    )
    for system, names in (
        (station, ("position_measured", "carried_objects")),
        (monitor, ("decision", *(f"masked_scan_{ring}" for ring in rings))),
    ):
        for name in names:
            builder.Connect(
                system.GetOutputPort(name), sender.GetInputPort(name)
            )


class Viewer:
    """The run's end of a viewer.

    Nothing that happens to the viewer is raised here. Its end is told in one
    line on stderr, once. Where to watch is printed as soon as it is known.

    Args:
        settings: What to show.
        patience: A viewer that takes nothing for this long is given up, s.
        command: Starts the viewer; None: that of this package.
    """

    def __init__(
        self,
        settings: ViewerSettings,
        *,
        patience: float = _PATIENCE,
        command: tuple[str, ...] | None = None,
    ):
        self._settings = settings
        self._patience = patience
        self._command = command or (
            *(sys.executable, "-m"),
            "tofssm_drake.diagrams.viewer_process",
        )
        self._queue: queue.Queue = queue.Queue(
            _WAITING_RECORDED if settings.is_recorded else _WAITING_LIVE
        )
        self._process: subprocess.Popen | None = None
        self._threads: list[threading.Thread] = []
        self._ready = threading.Event()
        self._recorded = threading.Event()
        self._ended = threading.Event()
        self._is_closing = False
        self._problem = ""
        self._progress = time.monotonic()

    def __enter__(self) -> "Viewer":
        return self

    def __exit__(self, *_) -> None:
        self.close()

    def connect(
        self, builder: DiagramBuilder, station: Diagram, monitor: Diagram
    ) -> None:
        """Adds what sends the frames of a workcell; its hook `prebuild`.

        Args:
            builder: Of the workcell.
            station: Of the scenario in the settings.
            monitor: Likewise.
        """
        add_frame_sender(
            builder, self._settings.scenario, station, monitor, self.send
        )

    def start(self) -> None:
        """Starts the process; does not wait for it."""
        try:
            process = subprocess.Popen(
                self._command,
                stdin=subprocess.PIPE,
                stdout=subprocess.PIPE,
                stderr=subprocess.DEVNULL,
                # Ctrl-C in the terminal is for the run, which ends it.
                start_new_session=True,
            )
        except OSError as error:
            self._tell_end(f"cannot be started: {error.strerror}")
            return
        self._process = process
        self._progress = time.monotonic()
        self._queue.put(self._settings)
        self._threads = [
            threading.Thread(target=self._feed, args=[process], daemon=True),
            threading.Thread(target=self._listen, args=[process], daemon=True),
        ]
        for thread in self._threads:
            thread.start()

    def wait_until_ready(self) -> None:
        """Waits until browsers can watch, or the viewer has ended."""
        self._wait(self._ready)

    def send(self, frame: Frame) -> None:
        """Shows a frame.

        A live view loses frames for which it is too slow. A recording is
        waited for.

        Args:
            frame: The next one.
        """
        if self._settings.is_recorded:
            self._put(frame)
        elif not self._ended.is_set():
            try:
                self._queue.put_nowait(frame)
            except queue.Full:
                self._check_progress()

    def record(self, order: RecordingOrder) -> bool:
        """Writes the recording.

        Args:
            order: Where; the samples are there already.

        Returns:
            Whether it was written.
        """
        self._put(order)
        self._wait(self._recorded)
        return self._recorded.is_set()

    def close(self) -> None:
        """Ends the viewer; what it has not drawn is lost."""
        self._is_closing = True
        if self._process is None:
            return
        # It has nothing to save, and would take a second to end by itself.
        self._process.kill()
        # The feeder waits for a message, or for a pipe that is now broken.
        with contextlib.suppress(queue.Full):
            self._queue.put_nowait(None)
        for thread in self._threads:
            thread.join(_FAREWELL)
        self._ended.set()

    def _put(self, message):
        """Hands a message to the feeder, and waits if it must."""
        begin = time.monotonic()
        while not self._ended.is_set():
            try:
                self._queue.put(message, timeout=_LOOK)
                return
            except queue.Full:
                self._check_progress(begin)

    def _wait(self, event):
        """Waits for an event, unless the viewer ends or does nothing."""
        begin = time.monotonic()
        while not (event.wait(_LOOK) or self._ended.is_set()):
            self._check_progress(begin)

    def _check_progress(self, begin=0.0):
        """Ends a viewer that should have done something for too long.

        Args:
            begin: Since when, s on the monotonic clock.
        """
        idle = time.monotonic() - max(self._progress, begin)
        if idle > self._patience:
            self._give_up(f"it did nothing for {self._patience:g} s")

    def _give_up(self, problem):
        """Ends the viewer; what listens to it tells why."""
        self._problem = self._problem or problem
        if self._process is not None:
            self._process.kill()

    def _feed(self, process):
        """Writes messages into the pipe, as fast as the viewer takes them."""
        with contextlib.suppress(OSError), process.stdin as pipe:
            while (message := self._queue.get()) is not None:
                try:
                    data = pickle.dumps(message)
                except Exception as error:
                    # A law of a user's own may have decided anything.
                    self._give_up(f"a frame cannot be sent: {error}")
                    return
                pipe.write(data)
                pipe.flush()
                self._progress = time.monotonic()

    def _listen(self, process):
        """Takes the viewer's answers until it ends; tells why it did."""
        for line in process.stdout:
            self._progress = time.monotonic()
            with contextlib.suppress(ValueError):
                self._take(json.loads(line))
        code = process.wait()
        if not self._is_closing:
            self._tell_end(self._problem or _describe_exit(code))
        self._ended.set()

    def _take(self, answer):
        """Takes an answer of the viewer."""
        if "error" in answer:
            # Whether or not it manages to end by itself.
            self._give_up(str(answer["error"]))
        if "url" in answer:
            if self._settings.is_watched:
                with contextlib.suppress(OSError, ValueError):
                    print(f"watch at {answer['url']}", flush=True)
            self._ready.set()
        if "recorded" in answer:
            self._recorded.set()

    def _tell_end(self, why):
        """Tells in one line that there is no viewer any more."""
        loss = ""
        if self._settings.is_recorded and not self._recorded.is_set():
            loss = ", there is no recording"
        # The terminal may be gone.
        with contextlib.suppress(OSError, ValueError):
            print(
                f"the viewer ended: {' '.join(why.split())}; the run goes on"
                f"{loss}",
                file=sys.stderr,
                flush=True,
            )
        self._ended.set()


def _describe_exit(code):
    """Returns what an exit code says, in a few words."""
    if code >= 0:
        return f"exit code {code}"
    try:
        return f"signal {signal.Signals(-code).name}"
    except ValueError:
        return f"signal {-code}"
