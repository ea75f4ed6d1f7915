"""Beams of the rings in Meshcat."""

import numpy as np
from pydrake.common.value import Value
from pydrake.geometry import Box, Cylinder, Meshcat, MeshcatCone, Sphere
from pydrake.math import RigidTransform, RotationMatrix
from pydrake.multibody.plant import MultibodyPlant
from pydrake.systems.framework import LeafSystem

from tofssm_drake.arms.kinematics import ArmKinematics
from tofssm_drake.messages import MaskedScan, Reading
from tofssm_drake.visualization.animated import AnimatedProperty
import tofssm_drake.visualization.palette as palette

LOOKS = {
    Reading.CLEAR: "clear",
    Reading.VALID: "hit",
    Reading.MASKED: "masked",
    Reading.FAULTED: "fault",
    Reading.HELD: "held",
}
"""Name of each reading's object in Meshcat."""

_WITH_DISTANCE = (Reading.VALID, Reading.MASKED, Reading.HELD)
_R_ZX = RotationMatrix.MakeYRotation(np.pi / 2)
"""Turns an object along z into one along x, the axis of a beam."""


def calc_beam_lengths(
    reading: np.ndarray, distance: np.ndarray, max_range: float
) -> np.ndarray:
    """Returns how long to draw each beam, m.

    Args:
        reading: `Reading` of each sensor, (n,).
        distance: Measured distances, m, (n,).
        max_range: Length of a beam that meets nothing, m.

    Returns:
        (n,): the measured distance where there is one, at most the range;
        the range for the others. Rounded to 5 mm, so that noise does not
        bloat a recording.
    """
    measured = np.isin(reading, _WITH_DISTANCE)
    length = np.where(measured, distance, max_range)
    length = np.clip(np.nan_to_num(length, nan=max_range), 0.01, max_range)
    return np.round(length / 0.005) * 0.005


class RingRays(LeafSystem):
    """Draws what each sensor of the rings reads.

    .. pydrake_system::

        name: RingRays
        input_ports:
        - position
        - masked_scan_<ring>

    The looks differ in shape as well as in colour: *clear* is a thin line of
    full length; *hit* is the beam's true cone, which ends in a ball where
    something was measured; *masked* is the same cone in grey without the
    ball; *fault* is a black block on the sensor.

    Args:
        meshcat: Where to draw.
        plant: Finalized plant with the frames `<ring>_ring` and
            `<ring>_ring_<j>`; read once.
        fov: Full cone angle of a sensor, rad.
        max_range: Length of a clear beam, m.
        rings: Names of the rings.
        sensors_per_ring: Number of sensors of each.
        period: Between frames, s; an exact binary fraction avoids extra
            steps of the simulation.
        path: Where in Meshcat's tree.
    """

    def __init__(
        self,
        *,
        meshcat: Meshcat,
        plant: MultibodyPlant,
        fov: float,
        max_range: float,
        rings: tuple[str, ...],
        sensors_per_ring: int = 8,
        period: float = 1 / 16,
        path: str = "rings",
    ):
        super().__init__()
        self._meshcat = meshcat
        self._kinematics = ArmKinematics.from_plant(
            plant, links={ring: f"{ring}_ring" for ring in rings}
        )
        self._max_range = max_range
        self._period = period
        self._rings = tuple(rings)
        self._path = path
        context = plant.CreateDefaultContext()
        self._beams = []
        for ring in rings:
            centre = plant.GetFrameByName(f"{ring}_ring")
            for j in range(sensors_per_ring):
                sensor = plant.GetFrameByName(f"{ring}_ring_{j}")
                beam = f"{path}/{ring}/{j}"
                meshcat.SetTransform(beam, sensor.CalcPose(context, centre))
                self._draw_looks(beam, fov, max_range)
                self._beams.append(self._make_properties(beam))
        self._num_sensors = sensors_per_ring

        self._position_port = self.DeclareVectorInputPort(
            "position", self._kinematics.num_joints
        )
        self._scan_ports = [
            self.DeclareAbstractInputPort(
                f"masked_scan_{ring}", Value(MaskedScan())
            )
            for ring in rings
        ]
        self.DeclarePeriodicPublishEvent(period, 0.0, self._publish)
        self.DeclareForcedPublishEvent(self._publish)

    def _draw_looks(self, beam, fov, max_range):
        meshcat = self._meshcat
        edge = np.tan(fov / 2)
        line = RigidTransform(_R_ZX, [max_range / 2, 0, 0])
        cone = RigidTransform(_R_ZX, [0, 0, 0])

        def draw(reading, name, shape, X):
            meshcat.SetObject(
                f"{beam}/{LOOKS[reading]}/{name}", shape, palette.BEAM[reading]
            )
            meshcat.SetTransform(f"{beam}/{LOOKS[reading]}/{name}", X)

        draw(Reading.CLEAR, "line", Cylinder(0.004, max_range), line)
        # Of unit length: drawn at the measured one by scaling.
        draw(Reading.VALID, "cone", MeshcatCone(1.0, edge, edge), cone)
        draw(Reading.VALID, "ball", Sphere(0.05), RigidTransform([1, 0, 0]))
        draw(Reading.MASKED, "cone", MeshcatCone(1.0, edge, edge), cone)
        draw(Reading.HELD, "cone", MeshcatCone(1.0, edge, edge), cone)
        draw(Reading.HELD, "box", Box(0.1, 0.1, 0.1), RigidTransform([1, 0, 0]))
        draw(
            Reading.FAULTED,
            "block",
            Box(0.05, 0.05, 0.05),
            RigidTransform([0.03, 0, 0]),
        )

    def _make_properties(self, beam):
        def make(reading, name, hold=False):
            return AnimatedProperty(
                meshcat=self._meshcat,
                path=f"{beam}/{LOOKS[reading]}",
                name=name,
                hold=hold,
            )

        visible = {reading: make(reading, "visible") for reading in LOOKS}
        scale = {
            reading: make(reading, "scale", hold=True)
            for reading in _WITH_DISTANCE
        }
        return visible, scale

    def _publish(self, context):
        time = context.get_time()
        period = self._period
        q = self._position_port.Eval(context)
        X_WS, _ = self._kinematics.calc_sites(q, np.zeros(len(q)))
        beams = iter(self._beams)
        for i, (ring, port) in enumerate(
            zip(self._rings, self._scan_ports, strict=True)
        ):
            self._meshcat.SetTransform(
                f"{self._path}/{ring}", RigidTransform(X_WS[i]), time
            )
            scan = port.Eval(context)
            n = self._num_sensors
            if scan.scan.sequence < 0:
                readings, lengths = [None] * n, [0.0] * n
            else:
                readings = scan.reading.tolist()
                lengths = calc_beam_lengths(
                    scan.reading, scan.scan.distance, self._max_range
                ).tolist()
            for reading, length in zip(readings, lengths, strict=True):
                visible, scale = next(beams)
                for look, shown in visible.items():
                    shown.set(look == reading, time, period)
                if reading in scale:
                    scale[reading].set([length] * 3, time, period)
