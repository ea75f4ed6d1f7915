"""The process of a viewer: `python -m tofssm_drake.diagrams.viewer_process`.

It takes pickled messages on its standard input (`ViewerSettings`, then each
`Frame`, at the end a `RecordingOrder`) and answers with lines of JSON: its
`url`, `recorded`, or an `error`. It ends when its input ends.
"""

import json
import os
import pickle
import resource
import sys
from typing import BinaryIO, TextIO

from pydrake.geometry import Meshcat
from pydrake.systems.framework import Diagram, DiagramBuilder

from tofssm_drake.arms.kinematics import ArmKinematics
from tofssm_drake.diagrams.display import add_display
from tofssm_drake.diagrams.ring_world import add_ring_world, make_scene
from tofssm_drake.diagrams.scenario import Scenario, find_links
from tofssm_drake.diagrams.sensors.rings import find_rings
from tofssm_drake.diagrams.tasks import make_task_path
from tofssm_drake.diagrams.viewer import RecordingOrder, ViewerSettings
from tofssm_drake.factory import tell
from tofssm_drake.messages import Frame
from tofssm_drake.recording.samples import read_samples
from tofssm_drake.visualization.frames import FrameReader
from tofssm_drake.visualization.health_board import HealthBoard
from tofssm_drake.visualization.recording import (
    make_display,
    start_recording,
    write_recording,
)

# Greatest memory of the process, bytes: what it draws may be too much for it.
_MOST_MEMORY = 4 * 1024**3


def make_viewer(scenario: Scenario, meshcat: Meshcat) -> Diagram:
    """Makes what draws frames; a forced publish draws one.

    .. pydrake_system::

        name: viewer
        input_ports:
        - frame

    People and obstacles are where the scenario has them at the frame's time,
    which is that of the Context.

    Args:
        scenario: Checked settings.
        meshcat: Where to draw.

    Returns:
        The Diagram.
    """
    builder = DiagramBuilder()
    scene_graph, plant = make_scene(builder, scenario)
    kinematics = ArmKinematics.from_plant(plant)
    objects = make_task_path(scenario.task, kinematics, scenario.robot).objects
    reader = builder.AddNamedSystem(
        "frame_reader",
        FrameReader(
            num_joints=kinematics.num_joints,
            num_objects=len(objects),
            rings=tuple(find_rings(scenario.sensors)),
        ),
    )
    builder.ExportInput(reader.get_input_port(), "frame")
    ports = {
        port.get_name(): port
        for port in map(
            reader.get_output_port, range(reader.num_output_ports())
        )
    }
    add_ring_world(
        builder,
        scenario=scenario,
        scene_graph=scene_graph,
        plant=plant,
        objects=objects,
        position_measured=ports["position_measured"],
        carried_objects=ports["carried_objects"],
        with_sensors=False,
    )
    ports["geometry_query"] = scene_graph.get_query_output_port()
    add_display(builder, scenario, plant, ports, meshcat)
    diagram = builder.Build()
    diagram.set_name("viewer")
    return diagram


class FrameView:
    """Draws frames in a Meshcat.

    Args:
        settings: What to show.
        meshcat: Where.
    """

    def __init__(self, settings: ViewerSettings, meshcat: Meshcat):
        scenario = settings.scenario
        self._diagram = make_viewer(scenario, meshcat)
        self._context = self._diagram.CreateDefaultContext()
        self._board = None
        if settings.with_health:
            self._board = HealthBoard(
                meshcat=meshcat, names=(*find_links(scenario), "robot")
            )

    def show(self, frame: Frame) -> None:
        """Draws a frame at its time."""
        self._context.SetTime(frame.time)
        self._diagram.get_input_port().FixValue(self._context, frame)
        self._diagram.ForcedPublish(self._context)
        if self._board is not None:
            self._board.show(dict(frame.health))


def serve(messages: BinaryIO, answers: TextIO) -> None:
    """Shows what comes until there is no more.

    Args:
        messages: Pickled, see above.
        answers: Lines of JSON.

    Raises:
        EOFError: There is no more.
    """

    def answer(**values):
        print(json.dumps(values), file=answers, flush=True)

    try:
        settings = pickle.load(messages)
        meshcat = make_display()
        view = FrameView(settings, meshcat)
        if settings.is_recorded:
            start_recording(meshcat, live=settings.is_watched)
        answer(url=meshcat.web_url())
        while True:
            message = pickle.load(messages)
            if isinstance(message, RecordingOrder):
                _record(meshcat, message)
                answer(recorded=message.name)
            else:
                view.show(message)
    except (EOFError, BrokenPipeError, pickle.UnpicklingError):
        raise EOFError from None
    except Exception as error:
        answer(error=tell(error))
        raise


def _record(meshcat, order):
    """Writes the recording of a run whose samples are written."""
    write_recording(
        meshcat,
        order.folder / order.name,
        samples=read_samples(order.folder),
        title=order.title,
    )


def main() -> int:
    """Serves the process that has started this one; returns the exit code."""
    resource.setrlimit(resource.RLIMIT_DATA, (_MOST_MEMORY, _MOST_MEMORY))
    # What others print must not come between the answers.
    answers = os.fdopen(os.dup(sys.stdout.fileno()), "w", encoding="utf-8")
    os.dup2(sys.stderr.fileno(), sys.stdout.fileno())
    try:
        serve(sys.stdin.buffer, answers)
    except EOFError:
        return 0
    except Exception:
        return 1
    return 0


if __name__ == "__main__":
    # A usual exit would wait for Meshcat's thread, which a broken message ends.
    os._exit(main())
