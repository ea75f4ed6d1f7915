import unittest

from fake_meshcat import FakeMeshcat
import numpy as np
from paper_cell import RINGS, make_plant
from pydrake.common.value import Value
from pydrake.systems.analysis import Simulator

from tofssm_drake.messages import MaskedScan, Reading, RingScan
import tofssm_drake.visualization.ring_rays as mut

Q = np.array([0.3, -1.2, 1.1, -1.4, -1.6, 0.2])


def _make_scan(reading, distance):
    return MaskedScan(
        scan=RingScan(sequence=0, time=0.0, distance=np.array(distance)),
        reading=np.array(reading, dtype=np.uint8),
    )


class TestCalcBeamLengths(unittest.TestCase):
    def test_lengths(self):
        reading = np.array([0, 1, 2, 3, 1, 1])
        distance = np.array([0.7, 0.5013, 0.2, np.nan, 9.0, -1.0])
        np.testing.assert_allclose(
            mut.calc_beam_lengths(reading, distance, 1.3),
            [1.3, 0.5, 0.2, 1.3, 1.3, 0.01],
        )


class TestRingRays(unittest.TestCase):
    @classmethod
    def setUpClass(cls):
        cls.plant = make_plant()

    def setUp(self):
        self.meshcat = FakeMeshcat()
        self.dut = mut.RingRays(
            rings=RINGS,
            meshcat=self.meshcat,
            plant=self.plant,
            fov=np.deg2rad(25),
            max_range=1.3,
        )
        self.context = self.dut.CreateDefaultContext()
        self.dut.GetInputPort("position").FixValue(self.context, Q)
        for ring in RINGS:
            self._fix(ring, MaskedScan())

    def _fix(self, ring, scan):
        port = self.dut.GetInputPort(f"masked_scan_{ring}")
        port.FixValue(self.context, Value(scan))

    def _find_shown(self, ring, j):
        return [
            look
            for look in mut.LOOKS.values()
            if self.meshcat.find_last(f"rings/{ring}/{j}/{look}", "visible")
        ]

    def test_ports(self):
        self.assertEqual(
            [
                self.dut.get_input_port(i).get_name()
                for i in range(self.dut.num_input_ports())
            ],
            ["position", *(f"masked_scan_{ring}" for ring in RINGS)],
        )

    def test_objects(self):
        """Every sensor has the four looks, which differ in shape."""
        for ring in RINGS:
            for j in range(8):
                for name in (
                    "clear/line",
                    "hit/cone",
                    "hit/ball",
                    "masked/cone",
                    "fault/block",
                ):
                    self.assertIn(
                        f"rings/{ring}/{j}/{name}", self.meshcat.objects
                    )

    def test_nothing_before_the_first_scan(self):
        self.dut.ForcedPublish(self.context)
        for ring in RINGS:
            for j in range(8):
                self.assertEqual(self._find_shown(ring, j), [])

    def test_looks(self):
        self._fix(
            "elbow",
            _make_scan(
                [0, 1, 2, 3, 0, 0, 0, 0], [9, 0.5, 0.25, np.nan, 9, 9, 9, 9]
            ),
        )
        self.dut.ForcedPublish(self.context)
        for j, look in enumerate(["clear", "hit", "masked", "fault"]):
            self.assertEqual(self._find_shown("elbow", j), [look])
        self.assertEqual(self._find_shown("base", 0), [])
        scale = self.meshcat.find_last("rings/elbow/1/hit", "scale")
        np.testing.assert_allclose(scale, [0.5, 0.5, 0.5])
        scale = self.meshcat.find_last("rings/elbow/2/masked", "scale")
        np.testing.assert_allclose(scale, [0.25, 0.25, 0.25])

    def test_poses(self):
        """Ring pose times sensor pose is where the plant has the sensor."""
        self.dut.ForcedPublish(self.context)
        X = {path: X for path, X, _ in self.meshcat.transforms}
        plant_context = self.plant.CreateDefaultContext()
        self.plant.SetPositions(plant_context, Q)
        for ring in RINGS:
            for j in range(8):
                frame = self.plant.GetFrameByName(f"{ring}_ring_{j}")
                self.assertTrue(
                    (
                        X[f"rings/{ring}"] @ X[f"rings/{ring}/{j}"]
                    ).IsNearlyEqualTo(
                        frame.CalcPoseInWorld(plant_context), 1e-9
                    )
                )

    def test_cone_opens_along_the_beam(self):
        """The cone of unit length ends at the measured distance."""
        X = {path: X for path, X, _ in self.meshcat.transforms}
        tip = X["rings/base/0/hit/cone"] @ [0, 0, 1]
        np.testing.assert_allclose(tip, [1, 0, 0], atol=1e-12)
        cone, _ = self.meshcat.objects["rings/base/0/hit/cone"]
        self.assertAlmostEqual(cone.a(), np.tan(np.deg2rad(12.5)))

    def test_recorded_at_the_frame_rate(self):
        simulator = Simulator(self.dut, self.context)
        simulator.AdvanceTo(0.25)
        times = sorted(
            {t for p, _, t in self.meshcat.transforms if t is not None}
        )
        np.testing.assert_allclose(sorted(times), np.arange(5) / 16)

    def test_every_reading_has_a_look(self):
        self.assertEqual(set(mut.LOOKS), set(Reading))
