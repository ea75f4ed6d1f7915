"""A robot as Drake systems: input becomes State, output is published.

As with Drake's LcmInterfaceSystem, one system owns the connection, and the
others are given it:

    RtdeInterfaceSystem    owns the connection; no ports, no state
    RtdeSubscriberSystem   the newest report, as State
    RobotReportReceiver    report -> joints, carried objects, progress; pure
    SliderControl          report, speed fraction, problem -> command
    RtdePublisherSystem    sends the command in forced publish events
"""

from collections.abc import Callable

import numpy as np
from pydrake.common.value import Value
from pydrake.systems.framework import (
    BasicVector,
    Context,
    EventStatus,
    LeafSystem,
    State,
)

from tofssm_drake.errors import UserError, require
from tofssm_drake.messages import RTDE_JOINTS, RobotReport, SliderCommand
from tofssm_drake.robots.driver import read_carried_objects
from tofssm_drake.robots.robot_connection import RobotConnection
from tofssm_drake.rtde.slider import (
    SliderConfig,
    SliderPhase,
    SliderState,
    step_slider,
)
from tofssm_drake.tasks.path import ProgramPath


class RtdeInterfaceSystem(LeafSystem):
    """Owns the connection to a robot.

    .. pydrake_system::

        name: RtdeInterfaceSystem

    It has neither ports nor state nor events: a connection receives in a
    thread of its own. Put it into the Diagram, so that the connection lives as
    long as the Diagram, and give `connection` to the subscriber and the
    publisher.

    Args:
        connection: An `RtdeClient`, or one without a robot.
        url: What a drawing of the Diagram shows, e.g. rtde://192.168.0.10.
    """

    def __init__(self, *, connection: RobotConnection, url: str = ""):
        super().__init__()
        self._connection = connection
        self._url = url

    @property
    def connection(self) -> RobotConnection:
        """The owned connection."""
        return self._connection

    def DoGetGraphvizFragment(self, params):
        """Adds the robot's address to the system's drawing."""
        if self._url:
            params.header_lines += [f"rtde_url={self._url}"]
        return super().DoGetGraphvizFragment(params)


class RtdeSubscriberSystem(LeafSystem):
    """Holds the newest report of a robot.

    .. pydrake_system::

        name: RtdeSubscriberSystem
        output_ports:
        - report

    `report` is a `RobotReport`. It is State: it changes only in an update at
    the beginning of each step of the Simulator, so everything computed in a
    step follows from one package.

    Initialization waits for a report newer than those that the connection
    already had.

    Args:
        connection: Where reports come from.
        wait_timeout: Longest wait at initialization, s; 0 does not wait.
    """

    def __init__(
        self,
        *,
        connection: RobotConnection,
        wait_timeout: float = 10.0,
    ):
        super().__init__()
        require(
            0.0 <= wait_timeout <= 3600.0,
            f"wait_timeout: must be from 0 to 3600 s, got {wait_timeout!r}",
        )
        self._connection = connection
        self._wait_timeout = wait_timeout
        self._report = self.DeclareAbstractState(Value(RobotReport()))
        self.DeclareStateOutputPort("report", self._report)
        self.DeclareInitializationUnrestrictedUpdateEvent(self._initialize)
        self.DeclarePerStepUnrestrictedUpdateEvent(self._update)

    def _initialize(self, context: Context, state: State) -> EventStatus:
        if self._wait_timeout > 0.0:
            before = self._connection.get_report().sequence
            report = self._connection.wait_for_report(
                after=before, timeout=self._wait_timeout
            )
            if report.sequence <= before:
                problem = self._connection.get_status().problem
                raise UserError(
                    f"no report from the robot within "
                    f"{self._wait_timeout:g} s: {problem or 'it is silent'}"
                )
        return self._update(context, state)

    def _update(self, context: Context, state: State) -> EventStatus:
        report = self._connection.get_report()
        if report is context.get_abstract_state(self._report).get_value():
            return EventStatus.DidNothing()
        state.get_mutable_abstract_state(int(self._report)).set_value(report)
        return EventStatus.Succeeded()


class RtdePublisherSystem(LeafSystem):
    """Sends a command to a robot in forced publish events.

    .. pydrake_system::

        name: RtdePublisherSystem
        input_ports:
        - command

    `command` is a `SliderCommand`. It is sent in forced publish events only, so
    that the run loop decides when: once for each report.

    Args:
        connection: Where commands go.
    """

    def __init__(self, *, connection: RobotConnection):
        super().__init__()
        self._connection = connection
        self._command = self.DeclareAbstractInputPort(
            "command", Value(SliderCommand())
        )
        self.DeclareForcedPublishEvent(self._publish)

    def _publish(self, context: Context) -> EventStatus:
        # The result of send is not used: the slider's echo says more.
        self._connection.send(self._command.Eval(context))
        return EventStatus.Succeeded()


class RobotReportReceiver(LeafSystem):
    """Splits a report into the ports of a simulated robot.

    .. pydrake_system::

        name: RobotReportReceiver
        input_ports:
        - report
        output_ports:
        - position_measured
        - velocity_measured
        - acceleration_commanded
        - tcp_pose_measured
        - tcp_velocity_measured
        - carried_objects
        - products_placed
        - task_done
        - target_speed_fraction
        - speed_scaling

    The first three are vectors of the joints: rad, rad/s, rad/s^2; the next two
    are the tool in the robot's base, six each, as `RobotReport` has it. What is
    not reported is NaN. `carried_objects` is what the driver makes of the
    report; `products_placed` is 0 before a number is reported; `task_done` is 1
    once it has counted all that the program places.

    Args:
        path: Of the robot's program.
        joints: Number of the robot's joints.
        find_carried_objects: The driver's, see `Driver`.
    """

    def __init__(
        self,
        *,
        path: ProgramPath,
        joints: int = RTDE_JOINTS,
        find_carried_objects: Callable[
            [RobotReport, ProgramPath], np.ndarray
        ] = read_carried_objects,
    ):
        super().__init__()
        placements = len(path.open_time)
        self._report = self.DeclareAbstractInputPort(
            "report", Value(RobotReport())
        )
        ticket = {self._report.ticket()}
        for name, size, read in (
            ("position_measured", joints, lambda r: r.position),
            ("velocity_measured", joints, lambda r: r.velocity),
            (
                "acceleration_commanded",
                joints,
                lambda r: r.acceleration_commanded,
            ),
            ("tcp_pose_measured", 6, lambda r: r.tcp_pose),
            ("tcp_velocity_measured", 6, lambda r: r.tcp_velocity),
            (
                "carried_objects",
                len(path.objects),
                lambda r: find_carried_objects(r, path),
            ),
            ("products_placed", 1, lambda r: [max(r.products_placed, 0)]),
            (
                "task_done",
                1,
                lambda r: [float(r.products_placed >= placements > 0)],
            ),
            ("target_speed_fraction", 1, lambda r: [r.target_speed_fraction]),
            ("speed_scaling", 1, lambda r: [r.speed_scaling]),
        ):
            self.DeclareVectorOutputPort(
                name, size, self._make_calc(read), ticket
            )

    def _make_calc(self, read):
        def calc(context: Context, output: BasicVector) -> None:
            values = read(self._report.Eval(context))
            if len(values) != output.size():
                # As of a robot with another number of joints, or of none yet.
                values = np.full(output.size(), np.nan)
            output.SetFromVector(values)

        return calc


class SliderControl(LeafSystem):
    """Turns the speed fraction into commands and checks their effect.

    .. pydrake_system::

        name: SliderControl
        input_ports:
        - report
        - speed_fraction
        - problem
        output_ports:
        - slider
        - command
        - slider_obeys

    `slider` is a `SliderState`, what `step_slider` makes of the newest
    report; `command` is the `SliderCommand` in it, for the publisher;
    `slider_obeys` (vector, 1) is 0 in a fault and else 1.

    `problem` (str) says why the monitor's data are not fresh and healthy, and
    is empty if they are: after a fault the speed recovers through the reduced
    fraction.

    The outputs follow from the current inputs, however often they are
    evaluated: each report is processed from the state after the previous one.
    The update at the beginning of each step of the Simulator remembers both, so
    the next report starts from what was last published for this one.

    Args:
        config: Settings; checked.
        connection: Where the reports come from: the update waits for the next
            report, which saves the other steps an update of the Diagram's
            State. None: it acts at each step.
    """

    def __init__(
        self,
        *,
        config: SliderConfig | None = None,
        connection: RobotConnection | None = None,
    ):
        super().__init__()
        self._config = SliderConfig() if config is None else config
        self._config.check("slider")
        self._connection = connection
        self._report = self.DeclareAbstractInputPort(
            "report", Value(RobotReport())
        )
        self._speed_fraction = self.DeclareVectorInputPort("speed_fraction", 1)
        self._problem = self.DeclareAbstractInputPort("problem", Value(""))
        # After the previous report, and after the newest.
        self._before, self._newest = (
            self.DeclareAbstractState(Value(SliderState())) for _ in range(2)
        )
        sources = {
            self._report.ticket(),
            self._speed_fraction.ticket(),
            self._problem.ticket(),
            self.abstract_state_ticket(self._before),
            self.abstract_state_ticket(self._newest),
        }
        self._slider = self.DeclareAbstractOutputPort(
            "slider",
            lambda: Value(SliderState()),
            self._calc_slider,
            sources,
        )
        self.DeclareAbstractOutputPort(
            "command",
            lambda: Value(SliderCommand()),
            lambda context, output: output.set_value(
                self._slider.Eval(context).command
            ),
            sources,
        )
        self.DeclareVectorOutputPort(
            "slider_obeys", 1, self._calc_obeys, sources
        )
        self.DeclarePerStepUnrestrictedUpdateEvent(self._update)

    def _get_before(self, context):
        """Returns the state after the previous report."""
        newest = context.get_abstract_state(self._newest).get_value()
        if newest.command.sequence != self._report.Eval(context).sequence:
            return newest
        return context.get_abstract_state(self._before).get_value()

    def _calc_slider(self, context, output):
        output.set_value(
            step_slider(
                self._config,
                self._get_before(context),
                self._report.Eval(context),
                self._speed_fraction.Eval(context)[0],
                self._problem.Eval(context),
            )
        )

    def _calc_obeys(self, context, output):
        phase = self._slider.Eval(context).phase
        output.SetAtIndex(0, float(phase != SliderPhase.FAULT))

    def _update(self, context: Context, state: State) -> EventStatus:
        if self._connection is not None:
            newest = self._connection.get_report()
            if newest is self._report.Eval(context):
                return EventStatus.DidNothing()
        slider = self._slider.Eval(context)
        if slider is context.get_abstract_state(self._newest).get_value():
            return EventStatus.DidNothing()
        before = self._get_before(context)
        for index, value in ((self._before, before), (self._newest, slider)):
            state.get_mutable_abstract_state(index).set_value(value)
        return EventStatus.Succeeded()
