import unittest

from hypothesis import given, settings
from hypothesis import strategies as st
import numpy as np

from tofssm_drake.errors import UserError
from tofssm_drake.messages import Reading, SensorFault
import tofssm_drake.sensing.memory as mut

CLEAR, VALID, MASKED, FAULTED, HELD = Reading
NONE, BUS, SIGMA, DEAD = (
    SensorFault.NONE,
    SensorFault.BUS,
    SensorFault.SIGMA,
    SensorFault.DEAD,
)


class Sensor:
    """One sensor, sample by sample."""

    def __init__(self, clear_samples=2, sigma_samples=2):
        self.settings = clear_samples, sigma_samples
        self.reading = CLEAR
        self.counts = np.zeros((2, 1), dtype=int)

    def take(self, reading, fault=NONE, *, is_new=True, is_proven=True):
        """Returns the reading and whether it is held at 0 m."""
        readings = np.array([reading], dtype=np.uint8)
        is_nearest = mut.hold_obstacles(
            readings,
            np.array([fault]),
            np.array([is_new]),
            np.array([is_proven]),
            np.array([self.reading in (VALID, HELD)]),
            *self.counts,
            *self.settings,
        )
        self.reading = Reading(readings[0])
        return self.reading, bool(is_nearest[0])


class TestHoldObstacles(unittest.TestCase):
    def check(self, dut, *steps):
        for sample, expected in steps:
            sample = sample if isinstance(sample, tuple) else (sample,)
            self.assertEqual(dut.take(*sample)[0], expected)

    def test_clear_must_be_confirmed_by_a_sensor_that_saw_something(self):
        self.check(
            Sensor(),
            (CLEAR, CLEAR),
            (VALID, VALID),
            (CLEAR, HELD),
            (CLEAR, CLEAR),
            (VALID, VALID),
            (CLEAR, HELD),
            (VALID, VALID),
            (CLEAR, HELD),
            # The robot is seen where it must be: nothing is in front of it.
            (MASKED, MASKED),
            (CLEAR, CLEAR),
        )

    def test_the_same_sample_again_confirms_nothing(self):
        dut = Sensor()
        dut.take(VALID)
        dut.take(CLEAR)
        for _ in range(5):
            self.assertEqual(dut.take(CLEAR, is_new=False)[0], HELD)
        self.assertEqual(dut.take(CLEAR)[0], CLEAR)

    def test_a_ring_that_does_not_see_the_robot_confirms_nothing(self):
        dut = Sensor()
        dut.take(VALID)
        for _ in range(5):
            self.assertEqual(dut.take(CLEAR, is_proven=False)[0], HELD)
        self.assertEqual(dut.take(CLEAR)[0], HELD)
        self.assertEqual(dut.take(CLEAR)[0], CLEAR)
        # It must not have seen anything for that to matter.
        self.assertEqual(dut.take(CLEAR, is_proven=False)[0], CLEAR)

    def test_a_fault_holds_what_was_there_and_nothing_else(self):
        self.check(
            Sensor(),
            ((FAULTED, BUS), FAULTED),
            (VALID, VALID),
            *[((FAULTED, BUS), HELD)] * 50,
            # A fault between two samples without return: not in a row.
            (CLEAR, HELD),
            ((FAULTED, BUS), HELD),
            (CLEAR, HELD),
            (CLEAR, CLEAR),
            ((FAULTED, BUS), FAULTED),
        )

    def test_target_without_a_distance_is_the_nearest_possible(self):
        dut = Sensor()
        self.assertEqual(dut.take(FAULTED, SIGMA), (FAULTED, False))
        self.assertEqual(dut.take(FAULTED, SIGMA), (HELD, True))
        # From then on it closes in from there.
        self.assertEqual(dut.take(FAULTED, SIGMA), (HELD, False))
        dut = Sensor()
        dut.take(VALID)
        self.assertEqual(dut.take(FAULTED, SIGMA), (HELD, False))

    def test_a_dead_sensor_holds_nothing(self):
        dut = Sensor()
        dut.take(VALID)
        self.assertEqual(dut.take(VALID, DEAD), (FAULTED, False))

    samples = st.lists(
        st.tuples(
            st.sampled_from([CLEAR, FAULTED]),
            st.sampled_from([f for f in SensorFault if f not in (NONE, DEAD)]),
            st.booleans(),
        ),
        max_size=40,
    )

    @settings(deadline=None)
    @given(samples=samples, clear_samples=st.integers(1, 4))
    def test_an_obstacle_ends_with_good_samples_only(
        self, samples, clear_samples
    ):
        dut = Sensor(clear_samples)
        dut.take(VALID)
        in_a_row = 0
        for reading, fault, is_new in samples:
            if reading == CLEAR:
                in_a_row += is_new
                dut.take(CLEAR, is_new=is_new)
            else:
                in_a_row = 0
                dut.take(FAULTED, fault, is_new=is_new)
            if in_a_row >= clear_samples:
                return
            self.assertEqual(dut.reading, HELD)


class TestConfig(unittest.TestCase):
    def test_check(self):
        mut.SensorMemoryConfig().check("here")
        for name in ("clear_samples", "sigma_samples"):
            for bad in (0, 101, 1.5):
                with self.assertRaisesRegex(UserError, f"here.{name}: .*use"):
                    mut.SensorMemoryConfig(**{name: bad}).check("here")


if __name__ == "__main__":
    unittest.main()
