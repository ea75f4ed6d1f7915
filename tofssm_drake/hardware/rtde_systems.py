"""A robot as Drake systems: what comes is State, what goes is published.

As with Drake's LcmInterfaceSystem, one system owns the connection, and the
others are given it:

    RtdeInterfaceSystem    owns the connection; no ports, no state
    RtdeSubscriberSystem   the newest report, as State
    RobotReportReceiver    report -> joints, gripper, products; pure
    SliderControl          report, speed fraction, problem -> command
    RtdePublisherSystem    sends the command when it is told to publish
"""

from pydrake.common.value import Value
from pydrake.systems.framework import (
    BasicVector,
    Context,
    EventStatus,
    LeafSystem,
    State,
)

from tofssm_drake.errors import UserError, require
from tofssm_drake.hardware.robot_connection import RobotConnection
from tofssm_drake.hardware.slider import (
    SliderConfig,
    SliderPhase,
    SliderState,
    step_slider,
)
from tofssm_drake.messages import RobotReport, SliderCommand


class RtdeInterfaceSystem(LeafSystem):
    """Owns the connection to a robot.

    .. pydrake_system::

        name: RtdeInterfaceSystem

    It has neither ports nor state nor events: a connection receives in a
    thread of its own. Put it into the Diagram, so that the connection lives
    as long, and give `connection` to the subscriber and the publisher.

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
        """What it owns."""
        return self._connection

    def DoGetGraphvizFragment(self, params):
        """Adds the robot's address to the system's picture."""
        if self._url:
            params.header_lines += [f"rtde_url={self._url}"]
        return super().DoGetGraphvizFragment(params)


class RtdeSubscriberSystem(LeafSystem):
    """Holds the newest report of a robot.

    .. pydrake_system::

        name: RtdeSubscriberSystem
        output_ports:
        - report

    `report` is a `RobotReport`. It is State: it changes in an update at the
    begin of each of the Simulator's steps, or when it is told to (forced
    update), and never in between. So all that is computed in a step is of one
    package.

    Initialization waits for a report that is newer than those that the
    connection had before.

    Args:
        connection: Where reports come from.
        wait_timeout: Longest wait at initialization, s; 0 does not wait.
        per_step: Update at each step; else only in forced updates, which
            spare a loop the copy of the Diagram's whole State.
    """

    def __init__(
        self,
        *,
        connection: RobotConnection,
        wait_timeout: float = 10.0,
        per_step: bool = True,
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
        if per_step:
            self.DeclarePerStepUnrestrictedUpdateEvent(self._update)
        self.DeclareForcedUnrestrictedUpdateEvent(self._update)

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
    """Sends a command to a robot when it is told to publish.

    .. pydrake_system::

        name: RtdePublisherSystem
        input_ports:
        - command

    `command` is a `SliderCommand`. It is sent in forced publish events only,
    so that whoever runs the loop decides when: once for each report.

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
        # Nothing follows from what send returns: the slider's echo tells.
        self._connection.send(self._command.Eval(context))
        return EventStatus.Succeeded()


class RobotReportReceiver(LeafSystem):
    """Takes a report apart into the ports of a simulated robot.

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
        - gripper_closed
        - products_placed
        - task_done
        - target_speed_fraction
        - speed_scaling

    The first five are vectors of six: rad, rad/s, rad/s^2; the tool in the
    robot's base, as `RobotReport` has it. `gripper_closed` is a bit of the
    digital outputs, 0 or 1; `products_placed` the register, 0 before there
    is any; `task_done` is 1 once that is the number of products.

    Args:
        gripper_output: Number of the digital output that closes the gripper.
        products: How many the robot's program places.
    """

    def __init__(self, *, gripper_output: int = 0, products: int = 10):
        super().__init__()
        require(
            0 <= gripper_output <= 17,
            f"gripper_output: must be from 0 to 17, got {gripper_output}",
        )
        self._gripper_output = gripper_output
        self._products = products
        self._report = self.DeclareAbstractInputPort(
            "report", Value(RobotReport())
        )
        ticket = {self._report.ticket()}
        for name, size, read in (
            ("position_measured", 6, lambda r: r.position),
            ("velocity_measured", 6, lambda r: r.velocity),
            ("acceleration_commanded", 6, lambda r: r.acceleration_commanded),
            ("tcp_pose_measured", 6, lambda r: r.tcp_pose),
            ("tcp_velocity_measured", 6, lambda r: r.tcp_velocity),
            ("gripper_closed", 1, self._is_closed),
            ("products_placed", 1, lambda r: [max(r.products_placed, 0)]),
            (
                "task_done",
                1,
                lambda r: [float(r.products_placed >= self._products)],
            ),
            ("target_speed_fraction", 1, lambda r: [r.target_speed_fraction]),
            ("speed_scaling", 1, lambda r: [r.speed_scaling]),
        ):
            self.DeclareVectorOutputPort(
                name, size, self._make_calc(read), ticket
            )

    def _make_calc(self, read):
        def calc(context: Context, output: BasicVector) -> None:
            output.SetFromVector(read(self._report.Eval(context)))

        return calc

    def _is_closed(self, report):
        # Not reported counts as open: what it holds is then an obstacle.
        bits = max(report.digital_outputs, 0)
        return [float(bits >> self._gripper_output & 1)]


class SliderControl(LeafSystem):
    """Turns the speed fraction into commands and watches that they work.

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
    is empty if they are: from a fault the way back to speed leads through the
    reduced fraction.

    The outputs are of the inputs as they are now. The update at the begin of
    the Simulator's next step, or who runs the loop, makes `slider` the State,
    so what was published is what is remembered.

    Args:
        config: Settings; checked.
        per_step: Update at each step; else who runs the loop does, or tells
            it to (forced update).
    """

    def __init__(
        self, *, config: SliderConfig | None = None, per_step: bool = True
    ):
        super().__init__()
        self._config = SliderConfig() if config is None else config
        self._config.check("slider")
        self._report = self.DeclareAbstractInputPort(
            "report", Value(RobotReport())
        )
        self._speed_fraction = self.DeclareVectorInputPort("speed_fraction", 1)
        self._problem = self.DeclareAbstractInputPort("problem", Value(""))
        self._state = self.DeclareAbstractState(Value(SliderState()))
        sources = {
            self._report.ticket(),
            self._speed_fraction.ticket(),
            self._problem.ticket(),
            self.abstract_state_ticket(self._state),
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
        if per_step:
            self.DeclarePerStepUnrestrictedUpdateEvent(self._update)
        self.DeclareForcedUnrestrictedUpdateEvent(self._update)

    def _calc_slider(self, context, output):
        output.set_value(
            step_slider(
                self._config,
                context.get_abstract_state(self._state).get_value(),
                self._report.Eval(context),
                self._speed_fraction.Eval(context)[0],
                self._problem.Eval(context),
            )
        )

    def _calc_obeys(self, context, output):
        phase = self._slider.Eval(context).phase
        output.SetAtIndex(0, float(phase != SliderPhase.FAULT))

    def _update(self, context: Context, state: State) -> EventStatus:
        slider = self._slider.Eval(context)
        if slider is context.get_abstract_state(self._state).get_value():
            return EventStatus.DidNothing()
        state.get_mutable_abstract_state(int(self._state)).set_value(slider)
        return EventStatus.Succeeded()
