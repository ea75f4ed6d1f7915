"""Sends a run to a viewer, frame by frame, and takes the frames apart."""

from collections.abc import Callable

from pydrake.common.value import Value
from pydrake.systems.framework import LeafSystem

from tofssm_drake.messages import (
    Frame,
    MaskedScan,
    make_empty_decision,
)


class FrameSender(LeafSystem):
    """Hands out what a viewer draws, at a fixed rate.

    .. pydrake_system::

        name: FrameSender
        input_ports:
        - position_measured
        - carried_objects
        - decision
        - masked_scan_<ring>

    Args:
        send: Takes each `Frame`; it must neither raise nor block for long.
        num_joints: Number of joints.
        num_objects: Number of objects that the task carries.
        rings: Names of the rings.
        period: Between frames, s; an exact binary fraction avoids extra
            steps of the simulation.
    """

    def __init__(
        self,
        *,
        send: Callable[[Frame], None],
        num_joints: int,
        num_objects: int,
        rings: tuple[str, ...],
        period: float = 1 / 16,
    ):
        super().__init__()
        self._send = send
        self._position = self.DeclareVectorInputPort(
            "position_measured", num_joints
        )
        self._carried = self.DeclareVectorInputPort(
            "carried_objects", num_objects
        )
        self._decision = self.DeclareAbstractInputPort(
            "decision", Value(make_empty_decision(()))
        )
        self._scans = {
            ring: self.DeclareAbstractInputPort(
                f"masked_scan_{ring}", Value(MaskedScan())
            )
            for ring in rings
        }
        self.DeclarePeriodicPublishEvent(period, 0.0, self._publish)
        self.DeclareForcedPublishEvent(self._publish)

    def _publish(self, context):
        self._send(
            Frame(
                time=context.get_time(),
                position_measured=self._position.Eval(context).copy(),
                carried_objects=self._carried.Eval(context).copy(),
                decision=self._decision.Eval(context),
                masked_scan={
                    ring: port.Eval(context)
                    for ring, port in self._scans.items()
                },
            )
        )


class FrameReader(LeafSystem):
    """Takes a frame apart, for the systems that draw.

    .. pydrake_system::

        name: FrameReader
        input_ports:
        - frame
        output_ports:
        - position_measured
        - carried_objects
        - decision
        - masked_scan_<ring>

    Args:
        num_joints: Number of joints.
        num_objects: Number of objects that the task carries.
        rings: Names of the rings.
    """

    def __init__(
        self, *, num_joints: int, num_objects: int, rings: tuple[str, ...]
    ):
        super().__init__()
        self._frame = self.DeclareAbstractInputPort("frame", Value(Frame()))
        of_frame = {self.input_port_ticket(self._frame.get_index())}
        for name, size in (
            ("position_measured", num_joints),
            ("carried_objects", num_objects),
        ):
            self.DeclareVectorOutputPort(
                name,
                size,
                self._make_vector_calc(name),
                prerequisites_of_calc=of_frame,
            )
        self.DeclareAbstractOutputPort(
            "decision",
            lambda: Value(make_empty_decision(())),
            self._calc_decision,
            prerequisites_of_calc=of_frame,
        )
        for ring in rings:
            self.DeclareAbstractOutputPort(
                f"masked_scan_{ring}",
                lambda: Value(MaskedScan()),
                self._make_scan_calc(ring),
                prerequisites_of_calc=of_frame,
            )

    def _make_vector_calc(self, name):
        def calc(context, output):
            output.SetFromVector(getattr(self._frame.Eval(context), name))

        return calc

    def _calc_decision(self, context, output):
        output.set_value(self._frame.Eval(context).decision)

    def _make_scan_calc(self, ring):
        def calc(context, output):
            output.set_value(self._frame.Eval(context).masked_scan[ring])

        return calc
