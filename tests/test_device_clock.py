import random
import unittest

from hypothesis import given
from hypothesis import strategies as st

import tofssm_drake.device_clock as mut

_MAX_DRIFT = 200e-6


def follow(devices, hosts):
    clock = None
    for device, host in zip(devices, hosts, strict=True):
        if clock is None:
            clock = mut.start_clock_map(device=device, host=host)
        else:
            clock = mut.update_clock_map(
                clock, device=device, host=host, max_drift=_MAX_DRIFT
            )
        yield clock


class TestClockMap(unittest.TestCase):
    def simulate(self, *, drift, seconds, delay, seed=0):
        """Yields (true host time of sending, its estimate, map).

        The device is slower than the host by `drift`; frames every 24 ms.
        """
        generator = random.Random(seed)
        sent = [1000.0 + 0.024 * i for i in range(int(seconds / 0.024))]
        devices = [(t - 1000.0) * (1.0 - drift) + 55.5 for t in sent]
        hosts = [t + delay(t - 1000.0, generator) for t in sent]
        clocks = follow(devices, hosts)
        for t, device, clock in zip(sent, devices, clocks, strict=True):
            yield t, clock.calc_host_time(device), clock

    def test_finds_offset_and_drift(self):
        for drift in (-100e-6, -20e-6, 0.0, 50e-6, 150e-6):
            estimates = list(
                self.simulate(
                    drift=drift,
                    seconds=60.0,
                    delay=lambda t, g: 0.0005 + g.expovariate(1 / 0.002),
                )
            )
            errors = [estimate - t for t, estimate, _ in estimates if t > 1001]
            clock = estimates[-1][2]
            with self.subTest(drift=drift):
                # Never less than the fastest frames' delay, and not much more.
                self.assertGreaterEqual(min(errors), 0.0005 - 1e-9)
                self.assertLess(max(errors), 0.0012)
                self.assertAlmostEqual(clock.drift, drift, delta=15e-6)

    def test_late_frames_move_nothing(self):
        """Half of them late by up to 80 ms, and seconds of only late ones."""

        def delay(t, generator):
            if 20.0 < t < 25.0:
                return generator.uniform(0.05, 0.08)
            return generator.choice((0.0, generator.uniform(0.0, 0.08)))

        for t, estimate, clock in self.simulate(
            drift=30e-6, seconds=40.0, delay=delay
        ):
            if 20.1 < t - 1000.0 < 25.0:
                self.assertGreater(clock.lateness, 0.045)
            if t > 1001.0:
                self.assertGreater(estimate - t, -1e-9)
                # It may rise this much without better information.
                self.assertLess(estimate - t, 5.0 * _MAX_DRIFT + 1e-4)

    def test_a_queue_is_not_taken_for_a_slow_clock(self):
        """100 ms of delay from 10 s on are still seen a minute later."""
        *_, (t, estimate, clock) = self.simulate(
            drift=0.0,
            seconds=70.0,
            delay=lambda t, g: 0.1 if t > 10.0 else 0.0,
        )
        self.assertLess(estimate - t, 60.0 * _MAX_DRIFT + 1e-9)
        self.assertGreater(clock.lateness, 0.085)

    def test_a_link_that_is_late_goes_on_as_it_did(self):
        """100 ms of delay for an hour, with a drift that was measured."""
        drift = 100e-6
        clock = None
        for i in range(150_000):
            host = 0.024 * i + (0.1 if i > 2000 else 0.0)
            device = 0.024 * i * (1.0 - drift)
            if clock is None:
                clock = mut.start_clock_map(device=device, host=host)
            clock = mut.update_clock_map(
                clock,
                device=device,
                host=host,
                max_drift=_MAX_DRIFT,
                is_late=clock.lateness > 0.018,
            )
        self.assertAlmostEqual(clock.lateness, 0.1, delta=0.003)

    def test_a_clock_that_is_too_slow_looks_late(self):
        *_, (_, _, clock) = self.simulate(
            drift=2e-3, seconds=60.0, delay=lambda t, g: 0.0
        )
        self.assertGreater(clock.lateness, 0.1)

    @given(
        st.lists(
            st.tuples(st.floats(0.001, 1.0), st.floats(0.0, 0.5)),
            min_size=2,
            max_size=30,
        )
    )
    def test_no_estimate_is_after_the_arrival(self, steps):
        device = 0.0
        devices, hosts = [], []
        for step, delay in steps:
            device += step
            devices.append(device)
            hosts.append(device + 7.0 + delay)
        for device, host, clock in zip(
            devices, hosts, follow(devices, hosts), strict=True
        ):
            self.assertLessEqual(clock.calc_host_time(device), host + 1e-9)
            self.assertGreaterEqual(clock.lateness, -1e-9)
            self.assertGreaterEqual(
                clock.calc_host_time(device), device + 7.0 - 1e-9
            )

    def test_earliness(self):
        clock = mut.start_clock_map(device=5.0, host=100.0)
        self.assertAlmostEqual(
            mut.calc_earliness(clock, device=6.0, host=101.3), -0.3
        )
        self.assertAlmostEqual(
            mut.calc_earliness(clock, device=8.0, host=101.0), 2.0
        )


if __name__ == "__main__":
    unittest.main()
