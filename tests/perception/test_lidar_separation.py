import dataclasses as dc
import math

from hypothesis import given
from hypothesis import strategies as st
import numpy as np
from pydrake.common.yaml import yaml_load_typed
from pydrake.systems.analysis import Simulator
import pytest

from tofssm_drake.errors import UserError
from tofssm_drake.messages import LidarScan, Reading, RingHealth
import tofssm_drake.perception.lidar_separation as mut

CLEAR, VALID, MASKED, FAULTED, HELD = Reading
N = 360
ANGLES = np.radians(np.arange(N) - 180.0)
NOTHING = np.full(N, np.inf)
REST = np.zeros(3)


def make_scan(*returns, sequence=0, time=1.0):
    """A scan with (degrees, distance) of one ray each."""
    ranges = NOTHING.copy()
    for degrees, distance in returns:
        ranges[degrees + 180] = distance
    return LidarScan(sequence=sequence, time=time, angles=ANGLES, ranges=ranges)


def classify(scan, background=NOTHING):
    return mut.classify_rays(
        ranges=scan.ranges, background=background, margin=0.05
    )


def calc(scan, previous=None, v_WT=REST, background=NOTHING, **settings):
    return mut.calc_lidar_separation(
        config=mut.LidarSeparationConfig(**settings),
        scan=scan,
        reading=classify(scan, background),
        previous=previous,
        previous_reading=(
            None if previous is None else classify(previous, background)
        ),
        v_WT=np.array(v_WT, dtype=float),
    )


class TestDistanceRules:
    @pytest.mark.parametrize(
        ("rule", "outside", "border", "inside", "offset"),
        [
            ("raw", 1.5, 0.82, 0.6, 0.82),
            ("subtracted", 0.68, 0.0, 0.0, 0.0),
            ("literal", 0.68, 0.82, 0.6, 0.0),
        ],
    )
    def test_rules(self, rule, outside, border, inside, offset):
        config = mut.LidarSeparationConfig(distance_rule=rule)
        distance = mut.calc_lidar_distance(
            config, np.array([1.5, 0.82, 0.6, np.inf])
        )
        np.testing.assert_allclose(
            distance, [outside, border, inside, np.inf], atol=1e-12
        )
        assert config.threshold_offset == offset
        dut = calc(make_scan((30, 1.5)), distance_rule=rule)
        assert dut.distance[0] == pytest.approx(outside)

    def test_literal_jumps_at_the_border_and_the_others_do_not(self):
        near, far = 0.82 - 1e-9, 0.82 + 1e-9
        for rule, jump in (("raw", 0), ("subtracted", 0), ("literal", 0.82)):
            config = mut.LidarSeparationConfig(distance_rule=rule)
            step = mut.calc_lidar_distance(config, near)
            step = step - mut.calc_lidar_distance(config, far)
            assert step == pytest.approx(jump, abs=1e-8)

    @given(st.floats(0, 10), st.floats(0, 10))
    def test_nearer_is_nearer(self, a, b):
        for rule in ("raw", "subtracted"):
            config = mut.LidarSeparationConfig(distance_rule=rule)
            distance = mut.calc_lidar_distance(config, np.sort([a, b]))
            assert distance[0] <= distance[1]

    @given(st.floats(0, 10), st.floats(0.1, 5.0))
    def test_raw_and_subtracted_decide_alike_outside(self, d, threshold):
        """d <= threshold + r_o says the same as d - r_o <= threshold."""
        raw, subtracted = (
            mut.LidarSeparationConfig(distance_rule=rule)
            for rule in ("raw", "subtracted")
        )
        if abs(d - threshold - 0.82) > 1e-6:
            assert (
                mut.calc_lidar_distance(raw, d)
                <= threshold + raw.threshold_offset
            ) == (
                mut.calc_lidar_distance(subtracted, d)
                <= threshold + subtracted.threshold_offset
            )


class TestRays:
    def test_beside_the_background(self):
        background = NOTHING.copy()
        background[:100] = 2.0
        ranges = NOTHING.copy()
        ranges[[0, 1, 2, 3, 4]] = [2.04, 1.96, 1.90, 2.10, np.inf]
        ranges[5] = np.nan
        ranges[6:100] = 2.0
        ranges[[200, 201, 202, 203]] = [3.0, 0.0, np.nan, -np.inf]
        # Less than nothing, beside something very near.
        background[210], ranges[210] = 0.03, -0.01
        reading = mut.classify_rays(
            ranges=ranges, background=background, margin=0.05
        )
        assert reading[:7].tolist() == [
            *(MASKED, MASKED, VALID),
            *(FAULTED, FAULTED, FAULTED, MASKED),
        ]
        assert reading[200:205].tolist() == [
            *(VALID, VALID, FAULTED, FAULTED, CLEAR)
        ]
        assert reading[210] == FAULTED

    def test_table_is_not_a_person(self):
        background = NOTHING.copy()
        background[:90] = 0.7
        scan = make_scan((30, 1.5))
        scan = dc.replace(scan, ranges=np.minimum(scan.ranges, background))
        dut = calc(scan, background=background)
        assert dut.distance[0] == pytest.approx(1.5)
        assert dut.count[0].tolist() == [N - 91, 1, 90, 0]
        assert dut.health[0] == RingHealth.HEALTHY

    def test_a_background_that_is_gone_stops(self):
        background = NOTHING.copy()
        background[:90] = 0.7
        dut = calc(make_scan(), background=background)
        assert dut.health[0] == RingHealth.FAULTED

    def test_walled_in_is_blind(self):
        background = np.full(N, 2.0)
        scan = dc.replace(make_scan(), ranges=background)
        dut = calc(scan, background=background)
        assert dut.health[0] == RingHealth.BLIND

    def test_some_faulted_rays_are_no_reason_to_stop(self):
        scan = make_scan(*((i, np.nan) for i in range(18)))
        assert calc(scan).health[0] == RingHealth.HEALTHY
        scan = make_scan(*((i, np.nan) for i in range(19)))
        assert calc(scan).health[0] == RingHealth.FAULTED


class TestSpeeds:
    def test_tool_towards_the_person(self):
        dut = calc(make_scan((60, 2.0), (-30, 3.0)), v_WT=[1.0, 0.5, 0.3])
        direction = [math.cos(math.pi / 3), math.sin(math.pi / 3), 0.0]
        np.testing.assert_allclose(dut.direction[0], direction)
        k_l = np.dot([1.0, 0.5, 0.3], direction)
        assert dut.k_l[0] == pytest.approx(k_l)
        assert dut.link_speed[0] == pytest.approx(math.sqrt(1.34))
        # Never seen before: taken to walk in.
        assert dut.k_o[0] == pytest.approx(k_l + 1.6)
        assert dut.sensor[0] == 60 + 180

    def test_person_who_walks_in(self):
        dut = calc(
            make_scan((0, 2.0 - 0.04 * 1.2), time=1.04),
            make_scan((0, 2.0)),
            v_WT=[-0.5, 0, 0],
        )
        assert dut.k_l[0] == pytest.approx(-0.5)
        assert dut.k_o[0] == pytest.approx(-0.5 + 1.2)

    def test_followed_to_the_side(self):
        previous = make_scan((5, 1.95), (90, 0.5))
        dut = calc(make_scan((0, 1.9), time=1.04), previous)
        assert dut.k_o[0] == pytest.approx(0.05 / 0.04)

    def test_another_person_is_a_new_one(self):
        dut = calc(make_scan((0, 1.9), time=1.04), make_scan((90, 1.9)))
        assert dut.k_o[0] == pytest.approx(1.6)

    def test_after_a_gap(self):
        dut = calc(make_scan((0, 1.9), time=1.2), make_scan((0, 2.0)))
        assert dut.k_o[0] == pytest.approx(1.6)

    def test_across_the_seam(self):
        dut = calc(make_scan((-180, 1.9), time=1.04), make_scan((179, 2.0)))
        assert dut.k_o[0] == pytest.approx(0.1 / 0.04)

    def test_saturates(self):
        dut = calc(make_scan((0, 1.0), time=1.04), make_scan((0, 1.3)))
        assert dut.k_o[0] == 3.3

    def test_the_rule_does_not_touch_the_speed(self):
        """Even where `literal` jumps."""
        for rule in mut.DISTANCE_RULES:
            dut = calc(
                make_scan((0, 0.80), time=1.04),
                make_scan((0, 0.84)),
                distance_rule=rule,
            )
            assert dut.k_o[0] == pytest.approx(1.0)

    def test_nobody(self):
        dut = calc(make_scan(), v_WT=[0, 1.5, 0])
        assert dut.distance[0] == np.inf
        assert dut.k_l[0] == pytest.approx(1.5)
        assert dut.k_o[0] == pytest.approx(3.1)
        assert dut.sensor[0] == -1
        assert np.isnan(dut.direction).all()


class Kinematics:
    """A tool that moves along x as fast as joint 0 turns."""

    num_joints = 6

    def calc_sites(self, q, qd):
        return np.zeros((2, 3, 4)), np.array([[9, 9, 9], [qd[0], 0, 0]])


class TestSystem:
    def make(self):
        dut = mut.LidarSeparation(
            config=mut.LidarSeparationConfig(),
            kinematics=Kinematics(),
            background=NOTHING,
        )
        simulator = Simulator(dut)
        context = simulator.get_mutable_context()
        for name in ("position_measured", "velocity_measured"):
            dut.GetInputPort(name).FixValue(context, np.full(6, 0.5))
        return dut, simulator, context

    def test_each_scan_counts_once(self):
        dut, simulator, context = self.make()
        port = dut.GetOutputPort("separation")
        scan_port = dut.GetInputPort("scan")
        scan_port.FixValue(context, LidarScan())
        simulator.AdvanceTo(0.02)
        assert port.Eval(context).sequence[0] == -1
        assert port.Eval(context).health[0] == RingHealth.FAULTED
        scan_port.FixValue(context, make_scan((0, 2.0), time=0.01))
        simulator.AdvanceTo(0.03)
        first = port.Eval(context)
        assert first.name == ("lidar",)
        assert first.distance[0] == 2.0
        assert first.time[0] == 0.01
        assert first.k_o[0] == pytest.approx(0.5 + 1.6)
        simulator.AdvanceTo(0.05)
        assert port.Eval(context) is first
        scan_port.FixValue(context, make_scan((0, 1.96), time=0.05, sequence=1))
        simulator.AdvanceTo(0.07)
        assert port.Eval(context).k_o[0] == pytest.approx(0.5 + 1.0)

    def test_no_feedthrough(self):
        assert not self.make()[0].HasAnyDirectFeedthrough()

    def test_another_lidar_s_scan(self):
        dut, simulator, context = self.make()
        scan = LidarScan(
            sequence=0, time=0.0, angles=np.zeros(3), ranges=np.ones(3)
        )
        dut.GetInputPort("scan").FixValue(context, scan)
        with pytest.raises(ValueError, match="3 rays, the background 360"):
            simulator.AdvanceTo(0.01)


def test_config():
    dut = yaml_load_typed(
        schema=mut.LidarSeparationConfig, data="{distance_rule: literal}"
    )
    dut.check("lidar_separation")
    for name, bad, right in (
        ("distance_rule", "row", "use one of raw, subtracted, literal"),
        ("workspace_radius", -1.0, "use"),
        ("max_faulted_share", 1.5, "use"),
    ):
        with pytest.raises(UserError, match=f"here.{name}: .*{right}"):
            dc.replace(dut, **{name: bad}).check("here")
