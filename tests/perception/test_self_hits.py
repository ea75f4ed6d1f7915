import math
import unittest

import numpy as np

from tofssm_drake.errors import UserError
from tofssm_drake.perception.occlusion_mask import OcclusionMaskConfig
import tofssm_drake.perception.self_hits as mut
from tofssm_drake.sensors.vl53l1x import Vl53l1x

INF = np.inf


def classify(distance, status, expectation):
    outcome = np.empty(len(distance), dtype=np.int64)
    is_odd = mut.classify_self_hits(
        np.array(distance, dtype=float),
        np.array(status, dtype=np.uint8),
        np.array(expectation, dtype=float),
        0.03,
        0.04,
        0.9,
        outcome,
    )
    return outcome.tolist(), is_odd


class TestConfig(unittest.TestCase):
    def test_defaults_are_fine(self):
        mut.SelfHitConfig().check("self_hits")

    def test_one_line_for_a_mistake(self):
        for change, message in (
            ({"miss_rate": 0.6}, "self_hits.miss_rate: 0.6"),
            ({"miss_rate": 0.3, "broken_rate": 0.2}, "broken_rate: 0.2"),
            ({"turns_deg": [0.0]}, "self_hits.turns_deg: 0.0"),
            ({"max_distance": math.nan}, "self_hits.max_distance"),
            ({"ride_travel": 0.0}, "self_hits.ride_travel: 0.0"),
        ):
            with self.assertRaisesRegex(UserError, message):
                mut.SelfHitConfig(**change).check("self_hits")


class Rides:
    """One sensor that moves along x, look by look."""

    def __init__(self):
        self.start = np.array([INF])
        self.travel = np.zeros(1)
        self.last = np.zeros((1, 3))
        self.alarm = np.zeros(1)
        self.unfit = np.zeros(1)

    def look(self, x, distance=0.9, outcome=mut.ALONE, status=0):
        """Counts a look at x, m; returns distance, travel and alarm."""
        mut.step_rides(
            self.start,
            self.travel,
            self.last,
            self.alarm,
            self.unfit,
            np.array([outcome]),
            np.array([distance]),
            np.array([status], dtype=np.uint8),
            np.array([[x, 2.0, 3.0]]),
            0.03,
            1.0,
        )
        return self.start[0], round(self.travel[0], 6), self.alarm[0]


class TestRides(unittest.TestCase):
    def test_alarm_beyond_the_travel(self):
        dut = Rides()
        # Where the stretch begins, and how it was reached, does not count.
        self.assertEqual(dut.look(5.0), (0.9, 0.0, 0.0))
        self.assertEqual(dut.look(5.6, 0.929), (0.9, 0.6, 0.0))
        # Back and forth is travel, too.
        self.assertEqual(dut.look(5.2, 0.871), (0.9, 1.0, 0.0))
        self.assertEqual(dut.look(5.21), (0.9, 1.01, 1.0))
        # It lasts while the robot stands.
        self.assertEqual(dut.look(5.21), (0.9, 1.01, 1.0))

    def test_another_distance_starts_again(self):
        dut = Rides()
        dut.look(0.0)
        self.assertEqual(dut.look(1.1), (0.9, 1.1, 1.0))
        # By 31 mm more than at the start, however slowly.
        self.assertEqual(dut.look(1.2, 0.92), (0.9, 1.2, 1.0))
        self.assertEqual(dut.look(1.3, 0.931), (0.9, 1.2, 1.0))
        self.assertEqual(dut.look(1.3, 0.931), (0.931, 0.0, 0.0))
        self.assertEqual(dut.look(2.4, 0.931), (0.931, 1.1, 1.0))

    def test_what_the_robot_explains_or_an_empty_room_ends_it(self):
        for outcome, status in (
            (mut.MATCH, 0),
            (mut.MISS, 0),
            (mut.MISS, 2),
            (mut.QUIET, 2),
            (mut.QUIET, 4),
            (mut.QUIET, 7),
        ):
            dut = Rides()
            dut.look(0.0)
            dut.look(1.1)
            other = {"outcome": outcome, "status": status}
            # One may be a lost sample; after one that fits the count restarts.
            for _ in range(3):
                self.assertEqual(dut.look(1.1, **other), (0.9, 1.1, 1.0))
                self.assertEqual(dut.look(1.1), (0.9, 1.1, 1.0))
            dut.look(1.2, **other)
            self.assertEqual(dut.look(1.2, **other), (INF, 0.0, 0.0))
            self.assertEqual(dut.look(9.0), (0.9, 0.0, 0.0))

    def test_one_look_ends_a_stretch_without_alarm(self):
        dut = Rides()
        dut.look(0.0)
        dut.look(0.9)
        self.assertEqual(dut.look(0.9, outcome=mut.QUIET, status=2)[1], 0.0)

    def test_no_failure_ends_it(self):
        for status in (1, 5, 8, 240, 253, 254, 255):
            dut = Rides()
            dut.look(0.0)
            dut.look(1.1)
            self.assertEqual(
                dut.look(1.2, 0.0, mut.QUIET, status), (0.9, 1.1, 1.0)
            )
            self.assertEqual(dut.look(1.2), (0.9, 1.2, 1.0))

    def test_noise_of_a_robot_that_stands_is_no_travel(self):
        dut = Rides()
        for i in range(10_000):
            dut.look(0.0004 * (i % 2))
        self.assertEqual(dut.travel[0], 0.0)
        # Slow motion is.
        for i in range(1101):
            dut.look(0.0006 * i)
        self.assertAlmostEqual(dut.travel[0], 0.66, places=3)

    def test_origins(self):
        X_WF = np.empty((2, 3, 4))
        X_WF[0] = np.nan
        # F is turned by 90 deg about z, and moved.
        X_WF[1] = [[0, -1, 0, 1], [1, 0, 0, 2], [0, 0, 1, 3]]
        X_FS = np.zeros((1, 3, 4))
        X_FS[0, :, 3] = [0.1, 0.2, 0.3]
        np.testing.assert_allclose(
            mut.calc_origins(X_WF, np.array([1]), X_FS), [[0.8, 2.1, 3.3]]
        )


class TestExpectation(unittest.TestCase):
    def test_two_looks(self):
        # Three wide rays, then three narrow ones.
        first = np.array([[0.5, INF, 0.7, 0.6, 0.55, INF], [INF] * 6])
        second = np.array([[0.4, 0.5, 0.5, 0.62, INF, 0.58], [INF] * 6])
        dut = mut.make_no_expectation(2)
        mut.widen_expectation(first, 3, dut)
        np.testing.assert_array_equal(
            dut, [[0.5, INF], [0.7, -INF], [0.6, INF]]
        )
        mut.widen_expectation(second, 3, dut)
        # The farther one of the second nearest narrow rays: 0.60, 0.62.
        np.testing.assert_array_equal(
            dut, [[0.4, INF], [0.7, -INF], [0.62, INF]]
        )
        # A single ray that hits is not enough.
        mut.widen_expectation(
            np.array([[INF, INF, INF, 0.5, INF, INF], [INF] * 6]), 3, dut
        )
        self.assertEqual(dut[2, 0], INF)

    def test_must_see(self):
        expectation = np.array(
            [
                [0.5, 0.03, 0.5, INF],
                [0.7, 0.7, 0.7, -INF],
                [0.6, 0.6, 0.95, INF],
            ]
        )
        self.assertEqual(
            mut.must_see(expectation, 0.04, 0.9).tolist(),
            [True, False, False, False],
        )

    def test_fan_is_wide_then_narrow(self):
        fan_S, num_wide = mut.make_self_hit_fan(
            mut.SelfHitConfig(), OcclusionMaskConfig(), Vl53l1x().traits
        )
        angle = np.degrees(np.arccos(np.clip(fan_S[:, 0], -1.0, 1.0)))
        self.assertAlmostEqual(angle[:num_wide].max(), 13.5, places=6)
        self.assertAlmostEqual(angle[num_wide:].max(), 11.5, places=6)


class TestOutcome(unittest.TestCase):
    def test_where_the_robot_must_be_seen(self):
        # At 0.5 to 0.7 m, and at most at 0.6 m.
        for distance, status, wanted in (
            (0.50, 0, mut.MATCH),
            (0.471, 0, mut.MATCH),
            (0.629, 0, mut.MATCH),
            (0.631, 0, mut.MISS),
            (1.2, 0, mut.MISS),
            (0.3, 0, mut.ALONE),
            (0.02, 0, mut.ALONE),
            (0.5, 3, mut.ALONE),
            (0.0, 2, mut.MISS),
            (0.0, 4, mut.MISS),
            (0.0, 7, mut.MISS),
            # Something is there; the sensor is broken; there is no sample.
            (0.0, 1, mut.QUIET),
            (0.0, 5, mut.QUIET),
            (0.0, 253, mut.QUIET),
            (0.0, 254, mut.QUIET),
        ):
            outcome, is_odd = classify(
                [distance], [status], [[0.5], [0.7], [0.6]]
            )
            self.assertEqual(outcome, [wanted], (distance, status))
            self.assertEqual(is_odd, wanted >= mut.MISS)

    def test_where_it_may_or_cannot_be_seen(self):
        self.assertEqual(
            classify(
                [0.0, 0.65, 0.75, 0.0, 0.5],
                [2, 0, 0, 2, 0],
                [
                    [0.5, 0.5, 0.5, INF, INF],
                    [0.7, 0.7, 0.7, -INF, -INF],
                    [INF] * 5,
                ],
            ),
            ([mut.QUIET, mut.MATCH, mut.ALONE, mut.QUIET, mut.ALONE], True),
        )

    def test_nearer_than_can_be_measured(self):
        outcome, _ = classify(
            [0.01, 0.6], [3, 0], [[0.05] * 2, [0.05] * 2, [INF] * 2]
        )
        self.assertEqual(outcome, [mut.MATCH, mut.ALONE])


class TestStep(unittest.TestCase):
    def calc(self, believed, tried, width):
        return mut.calc_step(
            np.array(believed), np.array(tried), np.array(width), 0.5, 2, 4, 4
        )

    def test_worked_numbers(self):
        q, m, x, a = mut.QUIET, mut.MATCH, mut.MISS, mut.ALONE
        for believed, tried, width, wanted in (
            ([m, q, x, a], [m, q, x, a], [0.0] * 4, 0.0),
            ([a], [m], [0.0], 2.0),
            ([a], [m], [0.25], 1.0),
            ([a], [m], [0.6], 0.0),
            ([m], [a], [0.0], -2.0),
            ([x], [m], [0.0], 4.0),
            ([q], [x], [0.0], -4.0),
            # A silent sensor is no evidence.
            ([x], [q], [-INF], 0.0),
            # A person is ALONE by both.
            ([a], [a], [0.1], 0.0),
            ([a, q], [m, x], [0.0, 0.0], -2.0),
            ([x, x], [m, m], [0.0, 0.0], 4.0),
        ):
            self.assertEqual(self.calc(believed, tried, width), wanted)


class TestCusum(unittest.TestCase):
    def test_begins_at_the_threshold_and_ends_at_0(self):
        total, alarm = 0.0, False
        seen = []
        for step in (-1, 3, 3, 9, 9, -9, -2, -1, -1):
            total, alarm = mut.step_cusum(total, alarm, float(step), 6.0)
            seen.append((total, alarm))
        self.assertEqual(
            seen,
            [
                (0, False),
                (3, False),
                (6, True),
                (12, True),
                (12, True),
                (3, True),
                (1, True),
                (0, False),
                (0, False),
            ],
        )

    def test_sensor_of_default_settings(self):
        """8 misses in a row are an alarm, ln(25) each; 7 are not."""
        config = mut.SelfHitConfig()
        total, alarm = np.zeros(2), np.zeros(2)
        args = config.miss_rate, config.broken_rate, config.sensor_threshold
        must = np.array([True, False])
        for look in range(8):
            self.assertEqual(alarm.tolist(), [0.0, 0.0])
            mut.step_sensors(
                total, alarm, np.array([mut.MISS, mut.QUIET]), must, *args
            )
            self.assertAlmostEqual(
                total[0], (look + 1) * math.log(25.0), places=9
            )
        self.assertEqual(alarm.tolist(), [1.0, 0.0])
        # A nearer hit, such as a person, shows that the sensor sees.
        for _ in range(100):
            mut.step_sensors(
                total, alarm, np.array([mut.ALONE, mut.QUIET]), must, *args
            )
        self.assertEqual(alarm.tolist(), [0.0, 0.0])

    def test_false_alarms_are_as_rare_as_stated(self):
        """At least e^threshold looks on the average (Lorden)."""
        generator = np.random.default_rng(0)
        threshold = 5.0
        looks = 0
        alarms = 0
        while alarms < 50:
            total, alarm = np.zeros(1), np.zeros(1)
            while not alarm[0]:
                miss = generator.random() < 0.02
                mut.step_sensors(
                    total,
                    alarm,
                    np.array([mut.MISS if miss else mut.MATCH]),
                    np.array([True]),
                    0.02,
                    0.5,
                    threshold,
                )
                looks += 1
            alarms += 1
        self.assertGreater(looks / alarms, math.exp(threshold))


class TestMisfits(unittest.TestCase):
    def test_orders(self):
        orders = mut.make_orders(8)
        self.assertEqual(orders.shape, (15, 8))
        self.assertEqual(len({tuple(order) for order in orders}), 15)
        names = [mut.name_order(order) for order in orders]
        self.assertEqual(
            names[0], "it is turned by 45 deg (its sensors are shifted by 1)"
        )
        self.assertEqual(
            names[6], "it is turned by -45 deg (its sensors are shifted by 1)"
        )
        self.assertEqual(orders[7].tolist(), [7, 6, 5, 4, 3, 2, 1, 0])
        self.assertEqual(set(names[7:]), {"its sensors are numbered backwards"})

    def test_list(self):
        misfits = mut.list_misfits(mut.SelfHitConfig(), 3)
        # 2 turns to 2 sides of 3 rings, the tool's ring, joint 1, delay.
        self.assertEqual(len(misfits), 12 + 2 + 2 + 2)
        nothing = mut.SelfHitConfig(
            turns_deg=[], tool_shift=0.0, joint_offset=0.0, joint_delay=0.0
        )
        self.assertEqual(mut.list_misfits(nothing, 3), ())
        self.assertEqual(mut.list_swaps(3), [(0, 1), (0, 2), (1, 2)])


if __name__ == "__main__":
    unittest.main()
