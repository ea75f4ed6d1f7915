import dataclasses as dc
import itertools
import unittest

from hypothesis import given, settings
from hypothesis import strategies as st
import numpy as np
from paper_cell import RINGS
from pydrake.common.value import Value
from pydrake.common.yaml import yaml_load_typed
from pydrake.math import RigidTransform, RotationMatrix

from tofssm_drake.errors import UserError
from tofssm_drake.laws.distances import calc_directed_speeds
from tofssm_drake.messages import (
    MaskedScan,
    Reading,
    RingHealth,
    RingScan,
    SensorFault,
)
import tofssm_drake.perception.separation as mut

CLEAR, VALID, MASKED, FAULTED, HELD = Reading
RADIUS = 0.08
ZEROS = np.zeros(6)


def make_X_LS(n=8, radius=RADIUS):
    """Sensors around z, looking outwards; the first along x."""
    rotations = [
        RotationMatrix.MakeZRotation(2 * np.pi * i / n) for i in range(n)
    ]
    return [RigidTransform(R, R @ [radius, 0, 0]) for R in rotations]


class FakeKinematics:
    """Three links that move with the first three joint speeds in world.

    Link i is turned about z by joint i + 3.
    """

    def __init__(self):
        self.calls = 0

    def calc(self, q, qd):
        self.calls += 1
        R_WL = np.array(
            [RotationMatrix.MakeZRotation(a).matrix() for a in q[3:6]]
        )
        return np.tile(q[:3], (3, 1)), R_WL, np.tile(qd[:3], (3, 1))


def make_masked_scan(
    distance,
    reading,
    *,
    sequence=0,
    time=1.0,
    dt=0.024,
    previous=None,
    q=ZEROS,
    qd=ZEROS,
    faulted_for=0.024,
):
    n = len(distance)
    is_faulted = np.array(reading) == FAULTED
    time = np.broadcast_to(np.asarray(time, dtype=float), n).copy()
    return MaskedScan(
        scan=RingScan(
            sequence=sequence,
            time=time.max() + 0.015,
            sensor_time=time,
            distance=np.array(distance, dtype=float),
            status=np.zeros(n, dtype=np.uint8),
        ),
        reading=np.array(reading, dtype=np.uint8),
        fault=np.where(is_faulted, SensorFault.BUS, SensorFault.NONE),
        healthy_time=time - is_faulted * faulted_for,
        self_nearest=np.full(n, np.inf),
        self_farthest=np.full(n, -np.inf),
        previous_distance=np.array(
            np.full(n, np.nan) if previous is None else previous, dtype=float
        ),
        previous_time=time - dt,
        position=np.tile(q, (n, 1)),
        velocity=np.tile(qd, (n, 1)),
    )


def calc_row(masked_scan, k_max=3.3, **settings):
    n = len(masked_scan.reading)
    return mut.make_separation(
        mut.calc_link_row(
            mut.SeparationConfig(**settings),
            masked_scan,
            mut.make_ring_geometry(make_X_LS(n)),
            FakeKinematics(),
            0,
            k_max,
        )[None],
        ("base",),
    )


class TestConfig(unittest.TestCase):
    def test_loads_and_checks(self):
        dut = yaml_load_typed(
            schema=mut.SeparationConfig, data="{literal: true, V_hmax: 2.0}"
        )
        dut.check("separation")
        self.assertTrue(dut.literal)
        for name, bad in (
            ("V_hmax", -1.0),
            ("max_gap", np.nan),
            ("fault_time", -1.0),
        ):
            with self.assertRaisesRegex(UserError, f"here.{name}: .*use"):
                mut.SeparationConfig(**{name: bad}).check("here")


class TestRingGeometry(unittest.TestCase):
    def test_reads_radius_and_beams(self):
        dut = mut.make_ring_geometry(make_X_LS(16, 0.065))
        self.assertAlmostEqual(dut.radius, 0.065)
        self.assertEqual(dut.beam_L.shape, (16, 3))
        np.testing.assert_allclose(dut.beam_L[4], [0, 1, 0], atol=1e-15)

        self.assertTrue(dut.is_radial)
        distance = np.arange(16.0)
        self.assertIs(dut.calc_centre_distance(distance), distance)
        self.assertIs(dut.find_direction(4, 0.3).base, dut.beam_L)

    def test_beams_that_are_not_radial(self):
        """The distance goes from the centre to the point on the axis."""
        aside = RigidTransform([0.0, 0.1, 0.0])
        dut = mut.make_ring_geometry([aside, aside])
        self.assertFalse(dut.is_radial)
        self.assertEqual(dut.radius, 0.0)
        np.testing.assert_allclose(
            dut.calc_centre_distance(np.array([0.3, np.inf])),
            [np.hypot(0.3, 0.1), np.inf],
        )
        np.testing.assert_allclose(
            dut.find_direction(0, 0.3),
            np.array([0.3, 0.1, 0.0]) / np.hypot(0.3, 0.1),
        )
        two_radii = make_X_LS(4, 0.08) + make_X_LS(4, 0.09)
        self.assertFalse(mut.make_ring_geometry(two_radii).is_radial)

    def test_both_ways_agree_for_radial_beams(self):
        radial = mut.make_ring_geometry(make_X_LS(8, 0.07))
        general = dc.replace(radial, is_radial=False, radius=0.0)
        distance = np.linspace(0.1, 1.3, 8)
        np.testing.assert_allclose(
            general.calc_centre_distance(distance),
            radial.radius + radial.calc_centre_distance(distance),
        )
        for i, d in enumerate(distance):
            np.testing.assert_allclose(
                general.find_direction(i, d), radial.find_direction(i, d)
            )


class TestSaturate(unittest.TestCase):
    def test_saturates(self):
        k_l, k_o = calc_directed_speeds(
            p_LO=np.array([[2.0, 0.0, 0.0], [-2.0, 0.0, 0.0]]),
            v_WL=np.array([5.0, 0.0, 0.0]),
            v_WO=np.array([9.0, 0.0, 0.0]),
        )
        k_l, k_o = ([mut.saturate(k, 3.3) for k in ks] for ks in (k_l, k_o))
        np.testing.assert_allclose(k_l, [3.3, -3.3])
        np.testing.assert_allclose(k_o, [-3.3, 3.3])


class TestLinkRow(unittest.TestCase):
    def test_worked_numbers(self):
        distance = [0.31, 1.5, 0.905, 0.72, 1.5, 0.15, 0.64, 1.31]
        mask = [0, 1, 1, 1, 1, 0, 1, 1]
        dut = calc_row(
            make_masked_scan(distance, [VALID if m else MASKED for m in mask])
        )
        self.assertEqual(dut.sensor[0], 6)
        self.assertAlmostEqual(dut.distance[0], 0.72, delta=1e-12)
        self.assertAlmostEqual(dut.distance[0] ** -2, 1.929012, delta=5e-7)
        self.assertAlmostEqual(
            (0.3 / dut.distance[0]) ** 2, 0.173611, delta=5e-7
        )
        np.testing.assert_array_equal(dut.count[0], [0, 6, 2, 0])
        self.assertEqual(dut.health[0], RingHealth.HEALTHY)

    def test_direction_is_the_beam_in_world(self):
        distance = np.full(8, 1.0)
        distance[2] = 0.5
        # Sensor 2 looks along y of the ring, which is turned by 90 deg.
        dut = calc_row(
            make_masked_scan(
                distance, [VALID] * 8, q=np.array([0, 0, 0, np.pi / 2, 0, 0])
            )
        )
        np.testing.assert_allclose(dut.direction[0], [-1, 0, 0], atol=1e-12)

    def test_closing_is_positive(self):
        near = np.full(4, 0.5)
        before = near + 0.024
        dut = calc_row(make_masked_scan(near, [VALID] * 4, previous=before))
        self.assertAlmostEqual(dut.k_o[0], 1.0)
        dut = calc_row(
            make_masked_scan(near, [VALID] * 4, previous=near - 0.024)
        )
        self.assertAlmostEqual(dut.k_o[0], -1.0)
        # The robot moves along the first sensor's beam.
        qd = np.array([0.7, 0.2, 0.0, 0, 0, 0])
        dut = calc_row(
            make_masked_scan(near, [VALID] * 4, previous=near, qd=qd)
        )
        self.assertAlmostEqual(dut.k_l[0], 0.7)
        self.assertAlmostEqual(dut.k_o[0], 0.0)
        self.assertAlmostEqual(dut.link_speed[0], np.hypot(0.7, 0.2))

    def test_own_time_of_each_sensor(self):
        time = [1.0, 1.01, 1.02, 1.005]
        scan = make_masked_scan(
            [0.9, 0.5, 0.8, 0.7],
            [VALID] * 4,
            time=time,
            dt=0.030,
            previous=[0.9, 0.53, 0.8, 0.7],
        )
        dut = calc_row(scan)
        self.assertEqual(dut.time[0], 1.01)
        self.assertAlmostEqual(dut.k_o[0], 1.0)

    def test_first_detection_is_an_unknown_person(self):
        qd = np.array([0.7, 0, 0, 0, 0, 0])
        first = make_masked_scan([0.5, 0.9], [VALID, VALID], qd=qd)
        self.assertAlmostEqual(calc_row(first).k_o[0], 0.7 + 1.6)
        # The other sensor's previous sample does not help.
        other = make_masked_scan(
            [0.5, 0.9], [VALID, VALID], qd=qd, previous=[np.nan, 0.9]
        )
        self.assertAlmostEqual(calc_row(other).k_o[0], 0.7 + 1.6)
        gap = make_masked_scan([0.5], [VALID], qd=qd, previous=[0.5], dt=0.11)
        self.assertAlmostEqual(calc_row(gap).k_o[0], 0.7 + 1.6)
        same_time = make_masked_scan(
            [0.5], [VALID], qd=qd, previous=[0.6], dt=0.0
        )
        self.assertAlmostEqual(calc_row(same_time).k_o[0], 0.7 + 1.6)

    def test_literal_differences_the_minimum_of_the_ring(self):
        scan = make_masked_scan(
            [0.50, 0.60], [VALID] * 2, previous=[0.524, 0.512]
        )
        self.assertAlmostEqual(calc_row(scan).k_o[0], 1.0)
        self.assertAlmostEqual(calc_row(scan, literal=True).k_o[0], 0.5)
        self.assertAlmostEqual(
            calc_row(scan, literal=True, literal_sign=True).k_o[0], -0.5
        )
        scan = make_masked_scan(
            [0.50, 0.60], [VALID] * 2, previous=[np.nan, 0.512]
        )
        self.assertAlmostEqual(calc_row(scan, literal=True).k_o[0], 0.5)
        scan = make_masked_scan([0.50, 0.60], [VALID] * 2)
        self.assertAlmostEqual(calc_row(scan, literal=True).k_o[0], 1.6)

    def test_clear_ring(self):
        qd = np.array([0.6, 0.0, 0.8, 0, 0, 0])
        dut = calc_row(
            make_masked_scan(
                [0.3, 0.4, 0.5],
                [CLEAR, MASKED, FAULTED],
                time=[1.0, 1.01, 0.5],
                qd=qd,
                faulted_for=-0.4,
            )
        )
        self.assertEqual(dut.distance[0], np.inf)
        self.assertEqual(dut.sensor[0], -1)
        self.assertTrue(np.isnan(dut.direction[0]).all())
        self.assertAlmostEqual(dut.k_l[0], 1.0)
        self.assertAlmostEqual(dut.k_o[0], 2.6)
        # The oldest of those that it relies on; the faulted one does not count.
        self.assertEqual(dut.time[0], 1.0)
        self.assertEqual(dut.health[0], RingHealth.HEALTHY)

    def test_all_faulted_is_as_old_as_can_be(self):
        dut = calc_row(make_masked_scan([0.3] * 3, [FAULTED] * 3))
        self.assertEqual(dut.time[0], -np.inf)
        self.assertEqual(dut.health[0], RingHealth.FAULTED)

    def test_blind(self):
        dut = calc_row(make_masked_scan([0.3] * 3, [MASKED, MASKED, FAULTED]))
        self.assertEqual(dut.health[0], RingHealth.BLIND)
        self.assertEqual(dut.distance[0], np.inf)

    def test_one_lost_sample_does_not_condemn_the_ring(self):
        reading = [CLEAR] * 7 + [FAULTED]
        dut = calc_row(make_masked_scan([0.3] * 8, reading))
        self.assertEqual(dut.health[0], RingHealth.HEALTHY)
        dut = calc_row(make_masked_scan([0.3] * 8, reading, faulted_for=0.3))
        self.assertEqual(dut.health[0], RingHealth.FAULTED)
        dut = calc_row(make_masked_scan([0.3] * 8, reading), fault_time=0.02)
        self.assertEqual(dut.health[0], RingHealth.FAULTED)

    def test_a_problem_of_the_link_is_a_fault(self):
        masked_scan = make_masked_scan([0.3] * 8, [CLEAR] * 8)
        masked_scan = dc.replace(
            masked_scan,
            scan=dc.replace(masked_scan.scan, problem="period 37 ms"),
        )
        self.assertEqual(calc_row(masked_scan).health[0], RingHealth.FAULTED)

    def test_what_is_held_closes_in(self):
        # Measured 0.115 s ago with 3 m/s, and the robot stands still.
        masked_scan = make_masked_scan(
            [0.3, 0.9, 1.0], [CLEAR, HELD, VALID], previous=[np.nan, 0.972, 1.0]
        )
        masked_scan = dc.replace(
            masked_scan, scan=dc.replace(masked_scan.scan, time=1.115)
        )
        dut = calc_row(masked_scan)
        self.assertEqual(dut.sensor[0], 1)
        self.assertAlmostEqual(dut.distance[0], RADIUS + 0.9 - 3.3 * 0.115)
        self.assertAlmostEqual(dut.k_o[0], 3.0)
        # No younger than the ring's other samples.
        self.assertEqual(dut.time[0], 1.0)
        # An obstacle that moved away counts as an unmonitored person.
        dut = calc_row(
            dc.replace(masked_scan, previous_distance=np.array([0.1] * 3))
        )
        self.assertAlmostEqual(dut.k_o[0], 1.6)
        # It never falls below 0.
        dut = calc_row(
            dc.replace(masked_scan, scan=dc.replace(masked_scan.scan, time=9.0))
        )
        self.assertEqual(dut.distance[0], RADIUS)

    def test_describes_problems(self):
        masked_scan = make_masked_scan([0.3] * 8, [CLEAR] * 8)
        fault = np.zeros(8, dtype=np.uint8)
        for sensors, text in (
            ({}, ""),
            ({3: 1}, "sensor 3: bus"),
            ({3: 7, 4: 7, 6: 1}, "sensor 6: bus; sensors 3, 4: frozen"),
            (dict.fromkeys(range(8), 3), "all sensors: late"),
        ):
            fault[:] = 0
            for i, cause in sensors.items():
                fault[i] = cause
            self.assertEqual(
                mut.describe_problem(
                    dc.replace(masked_scan, fault=fault.copy())
                ),
                text,
            )

    sensors = st.lists(
        st.tuples(
            st.floats(0.0, 4.0),
            st.sampled_from(list(Reading)),
            st.one_of(st.just(np.nan), st.floats(0.0, 4.0)),
        ),
        min_size=1,
        max_size=16,
    )
    speeds = st.lists(st.floats(-2.0, 2.0), min_size=6, max_size=6)

    @settings(deadline=None)
    @given(sensors=sensors, qd=speeds, literal=st.booleans())
    def test_nearest_valid_wins_and_speeds_are_saturated(
        self, sensors, qd, literal
    ):
        distance, reading, previous = map(np.array, zip(*sensors, strict=True))
        dut = calc_row(
            make_masked_scan(
                distance, reading, previous=previous, qd=np.array(qd)
            ),
            literal=literal,
        )
        # Measured 0.015 s ago.
        nearer = np.maximum(distance - 3.3 * 0.015, 0.0)
        counted = np.where(reading == HELD, nearer, distance)
        obstacles = counted[(reading == VALID) | (reading == HELD)]
        if len(obstacles):
            self.assertAlmostEqual(
                dut.distance[0], RADIUS + obstacles.min(), delta=1e-12
            )
            self.assertIn(reading[dut.sensor[0]], (VALID, HELD))
            self.assertAlmostEqual(np.linalg.norm(dut.direction[0]), 1.0)
        else:
            self.assertEqual(dut.distance[0], np.inf)
        self.assertLessEqual(abs(dut.k_l[0]), 3.3)
        self.assertLessEqual(abs(dut.k_o[0]), 3.3)
        self.assertLessEqual(dut.k_l[0], dut.link_speed[0] + 1e-12)
        self.assertEqual(dut.count[0].sum(), len(sensors))

    @settings(deadline=None)
    @given(sensors=sensors, worse=st.floats(0.0, 4.0), data=st.data())
    def test_dropped_sensors_never_matter(self, sensors, worse, data):
        distance, reading, previous = map(np.array, zip(*sensors, strict=True))
        is_obstacle = (reading == VALID) | (reading == HELD)
        changed = np.where(is_obstacle, distance, worse)
        one = calc_row(make_masked_scan(distance, reading, previous=previous))
        two = calc_row(make_masked_scan(changed, reading, previous=previous))
        for field in dc.fields(one):
            np.testing.assert_array_equal(
                getattr(one, field.name), getattr(two, field.name)
            )

    @settings(deadline=None)
    @given(
        d=st.floats(0.1, 1.3),
        v_link=st.floats(-1.5, 1.5),
        v_person=st.floats(-1.6, 1.6),
    )
    def test_measured_speed_is_the_projected_one(self, d, v_link, v_person):
        """Head-on, Eq. 9 with the corrected sign equals Eq. 4."""
        dt = 0.024
        expected_k_l, expected_k_o = np.clip(
            calc_directed_speeds(
                p_LO=np.array([RADIUS + d, 0.0, 0.0]),
                v_WL=np.array([v_link, 0.0, 0.0]),
                v_WO=np.array([v_person, 0.0, 0.0]),
            ),
            -3.3,
            3.3,
        )
        dut = calc_row(
            make_masked_scan(
                [d],
                [VALID],
                dt=dt,
                previous=[d + dt * (v_link - v_person)],
                qd=np.array([v_link, 0, 0, 0, 0, 0]),
            )
        )
        self.assertAlmostEqual(dut.k_l[0], expected_k_l, delta=1e-9)
        self.assertAlmostEqual(dut.k_o[0], expected_k_o, delta=1e-9)

    def test_speeds_are_saturated(self):
        masked_scan = make_masked_scan(
            [0.5],
            [VALID],
            dt=0.024,
            previous=[0.7],
            qd=np.array([1.2, 0, 0, 0, 0, 0]),
        )
        for k_max in (0.5, 3.3):
            dut = calc_row(masked_scan, k_max)
            self.assertAlmostEqual(dut.k_l[0], min(1.2, k_max))
            self.assertEqual(dut.k_o[0], k_max)


class TestMaxGap(unittest.TestCase):
    def test_follows_from_the_sensor(self):
        dut = mut.SeparationConfig()
        self.assertEqual(dut.calc_max_gap(), 0.1)
        self.assertEqual(dut.calc_max_gap(0.024), 0.1)
        self.assertAlmostEqual(dut.calc_max_gap(0.1), 0.41)

    def test_the_scenario_has_the_last_word(self):
        dut = mut.SeparationConfig(max_gap=0.05)
        self.assertEqual(dut.calc_max_gap(0.1), 0.05)


class TestTofSeparation(unittest.TestCase):
    def setUp(self):
        self.kinematics = FakeKinematics()
        self.dut = mut.TofSeparation(
            name=RINGS,
            config=mut.SeparationConfig(),
            kinematics=self.kinematics,
            geometries=[
                mut.make_ring_geometry(make_X_LS(8, r))
                for r in (0.08, 0.07, 0.06)
            ],
        )
        self.context = self.dut.CreateDefaultContext()

    def fix(self, ring, masked_scan):
        self.dut.GetInputPort(f"masked_scan_{ring}").FixValue(
            self.context, Value(masked_scan)
        )

    def eval(self):
        return self.dut.GetOutputPort("separation").Eval(self.context)

    def test_ports(self):
        names = [
            self.dut.get_input_port(i).get_name()
            for i in range(self.dut.num_input_ports())
        ]
        self.assertEqual(names, [f"masked_scan_{ring}" for ring in RINGS])
        self.assertEqual(self.dut.num_output_ports(), 1)

    def test_nothing_is_known_before_the_first_scan(self):
        for ring in RINGS:
            self.fix(ring, MaskedScan())
        separation = self.eval()
        self.assertEqual(separation.name, RINGS)
        self.assertTrue((separation.health == RingHealth.FAULTED).all())
        self.assertTrue((separation.sequence == -1).all())
        self.assertTrue((separation.time == -np.inf).all())
        self.assertEqual(self.kinematics.calls, 0)

    def make_one(self, k_max):
        return mut.TofSeparation(
            config=mut.SeparationConfig(),
            k_max=k_max,
            kinematics=self.kinematics,
            geometries=[mut.make_ring_geometry(make_X_LS(8))],
            name=("base",),
        )

    def test_saturates_at_its_k_max(self):
        self.dut = self.make_one(0.5)
        self.context = self.dut.CreateDefaultContext()
        self.fix(
            "base",
            make_masked_scan(
                [0.5] * 8, [VALID] * 8, dt=0.024, previous=[0.7] * 8
            ),
        )
        self.assertEqual(self.eval().k_o[0], 0.5)

    def test_rejects_a_k_max_that_is_no_speed(self):
        for k_max in (0.0, -1.0, np.nan, np.inf):
            with self.assertRaisesRegex(ValueError, "k_max"):
                self.make_one(k_max)

    def test_only_the_ring_with_a_new_scan_changes(self):
        for i, ring in enumerate(RINGS):
            self.fix(
                ring,
                make_masked_scan(
                    [0.5 + i] * 8, [VALID] * 8, time=1.0 + i, q=[0.1 * i] * 6
                ),
            )
        before = self.eval()
        np.testing.assert_allclose(before.distance, [0.58, 1.57, 2.56])
        np.testing.assert_array_equal(before.time, [1.0, 2.0, 3.0])

        self.fix(
            "elbow",
            make_masked_scan(
                [0.3] * 8, [VALID] * 8, time=4.0, sequence=7, q=[0.4] * 6
            ),
        )
        after = self.eval()
        np.testing.assert_allclose(after.distance, [0.58, 0.37, 2.56])
        np.testing.assert_array_equal(after.sequence, [0, 7, 0])
        for field in dc.fields(after):
            one, two = (
                np.asarray(getattr(s, field.name)) for s in (before, after)
            )
            for link in (0, 2):
                np.testing.assert_array_equal(one[link], two[link])

    def test_types(self):
        for ring in RINGS:
            self.fix(ring, make_masked_scan([0.5] * 8, [VALID] * 8))
        separation = self.eval()
        for name, kind in itertools.chain(
            zip(("sequence", "sensor", "health", "count"), "iiii", strict=True),
            zip(("time", "distance", "k_l", "direction"), "ffff", strict=True),
        ):
            value = getattr(separation, name)
            self.assertEqual(value.dtype.kind, kind, name)
            self.assertTrue(value.flags.c_contiguous, name)
        self.assertEqual(separation.direction.shape, (3, 3))
        self.assertEqual(separation.count.shape, (3, 4))


if __name__ == "__main__":
    unittest.main()
