import dataclasses as dc
import unittest

from hypothesis import given, settings
from hypothesis import strategies as st
import numpy as np
from paper_cell import RINGS
from pydrake.common.value import Value
from pydrake.common.yaml import yaml_load_typed
from pydrake.geometry import (
    GeometryFrame,
    GeometryInstance,
    PerceptionProperties,
    SceneGraph,
    Sphere,
)
from pydrake.math import RigidTransform, RotationMatrix
from pydrake.systems.analysis import Simulator

from tofssm_drake.diagrams.scenario import Scenario, change_settings
from tofssm_drake.errors import UserError
from tofssm_drake.messages import MaskedScan, Reading, RingScan, SensorFault
import tofssm_drake.perception.occlusion_mask as mut
from tofssm_drake.perception.readings import (
    calc_self_interval,
    classify_readings,
)
from tofssm_drake.raycast.fan import make_cone_fan
from tofssm_drake.raycast.ray_caster import RayCaster
from tofssm_drake.sensors.ring_mount import RingMount
from tofssm_drake.sensors.vl53l1x import Vl53l1x

SENSOR = Vl53l1x().traits

CLEAR, VALID, MASKED, FAULTED, HELD = Reading
RADIUS = 0.1


class SphereTwin:
    """A robot that is a sphere; joint 0 is how far its near side is."""

    num_joints = 6
    num_objects = 2

    def __init__(self):
        self.asked = []

    def calc(self, q, carried):
        self.asked.append((q.copy(), carried.tolist()))
        X_WF = np.eye(3, 4)[None].repeat(2, axis=0)
        X_WF[0, 0, 3] = q[0] + RADIUS
        return X_WF


def make_cell(config, n=8, names=("base",), sensor=SENSOR):
    """Rings at the origin of the world, their sensors 0 look along x."""
    scene_graph = SceneGraph()
    source_id = scene_graph.RegisterSource("twin")
    frame_id = scene_graph.RegisterFrame(source_id, GeometryFrame("robot"))
    geometry = GeometryInstance(RigidTransform(), Sphere(RADIUS), "robot")
    geometry.set_perception_properties(PerceptionProperties())
    scene_graph.RegisterGeometry(source_id, frame_id, geometry)
    caster = RayCaster(scene_graph.model_inspector())
    X_FS = [
        RigidTransform(
            RotationMatrix.MakeZRotation(2 * np.pi * i / n), np.zeros(3)
        )
        for i in range(n)
    ]
    mounting = dict(
        config=config,
        sensor=sensor,
        caster=caster,
        mounts=[
            RingMount(
                name=name,
                frame_id=scene_graph.world_frame_id(),
                X_FS=X_FS,
                X_LS=X_FS,
                geometry_ids=[],
            )
            for name in names
        ],
    )
    return dict(
        sensor=sensor,
        caster=caster,
        bundles=mut.make_mask_bundles(**mounting),
        proof_bundles=mut.make_proof_bundles(**mounting),
        twin=SphereTwin(),
    )


def mask_scan(config, *, scan, before, cell, **kwargs):
    """Masks the scan of one ring."""
    (masked_scan,) = mut.mask_scans(
        config, scans=[scan], before=[before], **cell, **kwargs
    )
    return masked_scan


def make_scan(distance, status=0, *, sequence=0, time=1.0, n=8):
    """Sensor 0 reads `distance`, the others nothing."""
    every_status = np.full(n, 2, dtype=np.uint8)
    every_status[0] = status
    every_distance = np.full(n, 3.21)
    every_distance[0] = distance
    return RingScan(
        sequence=sequence,
        time=time + 0.015,
        sensor_time=np.full(n, time),
        distance=every_distance,
        status=every_status,
    )


def make_history(times, positions, carried=(0.0, 0.0), scale=10.0):
    table = mut.make_robot_history(len(times), 6, 2)
    for time, position in zip(times, positions, strict=True):
        q = np.zeros(6)
        q[0] = position
        mut.push_report(
            table,
            time,
            np.array([*q, *(scale * q), *carried]),
        )
    return table


class TestConfig(unittest.TestCase):
    def test_what_the_sensor_knows_is_set_there(self):
        for key in ("sigma", "min_range", "max_range"):
            with self.assertRaisesRegex(
                UserError, rf"mask\.{key}: is now .*sensors\.<ring>\.sensor"
            ):
                change_settings(
                    Scenario(), f"{{mask: {{{key}: 0.1}}}}", source="text"
                )

    def test_loads_and_checks(self):
        dut = yaml_load_typed(
            schema=mut.OcclusionMaskConfig, data="{enabled: false}"
        )
        self.assertFalse(dut.enabled)
        for name, bad in (
            ("edge_margin_deg", -1.0),
            ("time_margin", 1.0),
            ("rays_per_sensor", -1),
            ("max_age", 0.0),
        ):
            with self.assertRaisesRegex(UserError, f"here.{name}: "):
                mut.OcclusionMaskConfig(**{name: bad}).check("here")

    def test_rays_are_the_rings_and_a_circle_beyond(self):
        sensor = SENSOR
        for rays, margin, expected in ((0, 0.0, 25), (9, 0.0, 9), (0, 1, 41)):
            config = mut.OcclusionMaskConfig(
                rays_per_sensor=rays, edge_margin_deg=margin
            )
            fan_S = mut.make_mask_fan(config, sensor)
            self.assertEqual(len(fan_S), expected)
            angle = np.degrees(np.arccos(fan_S[:, 0]))
            self.assertAlmostEqual(angle.max(), 12.5 + margin)
            np.testing.assert_allclose(np.linalg.norm(fan_S, axis=1), 1.0)
        same = mut.make_mask_fan(mut.OcclusionMaskConfig(), sensor)[:25]
        np.testing.assert_array_equal(same, make_cone_fan(np.radians(25.0), 25))
        # Farther than a sensor can measure by the error of a reading.
        cell = make_cell(config)
        np.testing.assert_allclose(cell["bundles"].max_range, 1.36 + 0.03)


class TestHistory(unittest.TestCase):
    @settings(deadline=None)
    @given(
        t=st.floats(0.0, 0.056),
        slope=st.floats(-3.0, 3.0),
        start=st.floats(-3.0, 3.0),
    )
    def test_linear_motion_is_met_exactly(self, t, slope, start):
        times = 0.008 * np.arange(8)
        history = make_history(times, start + slope * times)
        dut = mut.interpolate_reports(history, t, 6)
        self.assertAlmostEqual(dut[1], start + slope * t, delta=1e-12)
        self.assertAlmostEqual(dut[7], 10 * (start + slope * t), delta=1e-11)

    def test_outside_of_its_span(self):
        history = make_history([1.0, 1.008], [0.5, 0.6])
        self.assertEqual(mut.interpolate_reports(history, 0.9, 6)[1], 0.5)
        self.assertEqual(mut.interpolate_reports(history, 1.1, 6)[1], 0.6)

    def test_unused_rows_are_not_looked_at(self):
        table = mut.make_robot_history(5, 6, 2)
        mut.push_report(table, 1.0, np.array([0.3] * 6 + [0.0] * 6 + [1, 4]))
        for time in (0.9, 1.0, 1.1):
            dut = mut.interpolate_reports(table, time, 6)
            np.testing.assert_array_equal(dut[1:7], np.full(6, 0.3))
            np.testing.assert_array_equal(dut[13:], [1.0, 4.0])

    def test_objects_are_where_they_were_before(self):
        table = make_history([1.0, 1.008], [0.0, 0.0], (0.0, 3.0))
        mut.push_report(table, 1.016, np.array([0.0] * 12 + [1.0, 4.0]))
        dut = mut.interpolate_reports(table, 1.0159, 6)
        np.testing.assert_array_equal(dut[13:], [0.0, 3.0])
        dut = mut.interpolate_reports(table, 1.016, 6)
        np.testing.assert_array_equal(dut[13:], [1.0, 4.0])

    def test_oldest_is_dropped(self):
        table = make_history([1.0, 1.008], [0.5, 0.6])
        mut.push_report(table, 1.016, np.array([0.7] * 6 + [0.0] * 8))
        np.testing.assert_array_equal(table[:, 0], [1.008, 1.016])
        np.testing.assert_array_equal(table[:, 1], [0.6, 0.7])


class TestMaskScan(unittest.TestCase):
    def mask(self, scan, *, position=0.5, config=None, before=None):
        config = config or mut.OcclusionMaskConfig()
        self.cell = make_cell(config)
        return mask_scan(
            config,
            scan=scan,
            before=before or MaskedScan(),
            time=scan.time,
            table=make_history([0.0, 2.0], [position, position]),
            cell=self.cell,
        )

    def test_robot_is_masked_a_person_is_not(self):
        for distance, expected in (
            (0.5, MASKED),
            (0.475, MASKED),
            (0.525, MASKED),
            (0.46, VALID),
            (0.65, VALID),
        ):
            dut = self.mask(make_scan(distance))
            self.assertEqual(dut.reading[0], expected, distance)
            self.assertTrue((dut.reading[1:] == CLEAR).all())
        # The nearest hit of the cone is on its axis.
        self.assertAlmostEqual(dut.self_nearest[0], 0.5, delta=1e-12)
        # The sphere's edge is within the cone: a ray just misses it or not.
        self.assertGreater(dut.self_farthest[0], 0.51)
        self.assertLess(dut.self_farthest[0], 0.6)
        self.assertTrue((dut.self_nearest[1:] == np.inf).all())
        self.assertTrue((dut.self_farthest[1:] == -np.inf).all())

    def test_robot_out_of_range_is_no_excuse(self):
        dut = self.mask(make_scan(0.5), position=2.0)
        self.assertEqual(dut.reading[0], VALID)

    def test_switched_off(self):
        dut = self.mask(
            make_scan(0.5), config=mut.OcclusionMaskConfig(enabled=False)
        )
        self.assertEqual(dut.reading[0], VALID)
        self.assertEqual(self.cell["twin"].asked, [])

    def test_twin_is_posed_at_the_samples_own_time(self):
        config = mut.OcclusionMaskConfig()
        cell = make_cell(config)
        # 1.5 m/s: in the 24 ms until the tick the robot moves 36 mm.
        times = 1.0 + 0.008 * np.arange(5)
        history = make_history(times, 0.5 + 1.5 * (times - 1.0), (1.0, 3.0))
        time = 1.004
        dut = mask_scan(
            config,
            scan=make_scan(0.506, time=time),
            before=MaskedScan(),
            time=1.032,
            table=history,
            cell=cell,
        )
        self.assertAlmostEqual(dut.self_nearest[0], 0.506, delta=1e-12)
        self.assertEqual(dut.reading[0], MASKED)
        np.testing.assert_allclose(dut.position[:, 0], 0.506)
        np.testing.assert_allclose(dut.velocity[:, 0], 5.06)
        self.assertEqual(dut.position.shape, (8, 6))
        ((_, carried),) = cell["twin"].asked
        self.assertEqual(carried, [1.0, 3.0])

    def mask_moving(self, distance, still=False, **settings):
        """The robot comes at 1.5 m/s and is at 0.5 m at the sample's time."""
        config = mut.OcclusionMaskConfig(**settings)
        cell = make_cell(config, sensor=dc.replace(SENSOR, tolerance=0.0))
        times = 1.0 + 0.008 * np.arange(5)
        dut = mask_scan(
            config,
            scan=make_scan(distance, time=1.016),
            before=MaskedScan(),
            time=1.032,
            table=make_history(
                times, 0.5 - 1.5 * (times - 1.016), scale=0.0 if still else 1.0
            ),
            cell=cell,
        )
        return dut, len(cell["twin"].asked)

    def test_robot_a_little_earlier_and_later_counts(self):
        # In 4 ms it moves 6 mm.
        for distance, expected in (
            (0.4939, VALID),
            (0.4941, MASKED),
            (0.5, MASKED),
        ):
            dut, _ = self.mask_moving(distance, time_margin=0.004)
            self.assertEqual(dut.reading[0], expected, distance)
        dut, _ = self.mask_moving(0.4941, time_margin=0.0)
        self.assertEqual(dut.reading[0], VALID)
        farthest = dut.self_farthest[0]
        for margin, expected in ((0.0, VALID), (0.004, MASKED)):
            dut, _ = self.mask_moving(farthest + 0.005, time_margin=margin)
            self.assertEqual(dut.reading[0], expected)

    def test_second_look_only_where_it_can_matter(self):
        _, poses = self.mask_moving(0.5, time_margin=0.004)
        self.assertEqual(poses, 1)
        _, poses = self.mask_moving(0.4, time_margin=0.004)
        self.assertEqual(poses, 3)
        _, poses = self.mask_moving(0.4, time_margin=0.004, still=True)
        self.assertEqual(poses, 1)
        _, poses = self.mask_moving(0.4, time_margin=0.004, enabled=False)
        self.assertEqual(poses, 0)

    def test_each_sensor_at_its_own_time(self):
        config = mut.OcclusionMaskConfig()
        cell = make_cell(config)
        times = 1.0 + 0.008 * np.arange(5)
        scan = make_scan(0.5)
        scan = dc.replace(
            scan,
            sensor_time=np.array([1.0, 1.01] * 4),
            distance=np.full(8, 0.5),
            status=np.array([0, 0, 2, 2, 2, 2, 2, 2], dtype=np.uint8),
        )
        dut = mask_scan(
            config,
            scan=scan,
            before=MaskedScan(),
            time=1.032,
            table=make_history(times, 0.5 + 1.5 * (times - 1.0)),
            cell=cell,
        )
        np.testing.assert_allclose(dut.position[0::2, 0], 0.5)
        np.testing.assert_allclose(dut.position[1::2, 0], 0.515)
        # At both times, and then slightly off that of the second sensor.
        asked = [q[0] for q, _ in cell["twin"].asked]
        np.testing.assert_allclose(asked, [0.5, 0.515, 0.509, 0.521])
        self.assertAlmostEqual(dut.self_nearest[0], 0.5, delta=1e-12)
        self.assertEqual(dut.reading[0], MASKED)
        self.assertEqual(dut.reading[1], VALID)

    def test_previous_sample_of_each_sensor(self):
        first = self.mask(make_scan(0.8, sequence=0, time=1.0))
        self.assertTrue(np.isnan(first.previous_distance).all())
        second = self.mask(make_scan(0.7, sequence=1, time=1.024), before=first)
        self.assertEqual(second.previous_distance[0], 0.8)
        self.assertTrue(np.isnan(second.previous_distance[1:]).all())
        np.testing.assert_array_equal(second.previous_time, 1.0)
        # The robot does not count as a person's previous sample.
        third = self.mask(make_scan(0.5, sequence=2, time=1.048), before=second)
        fourth = self.mask(make_scan(0.6, sequence=3, time=1.072), before=third)
        self.assertTrue(np.isnan(fourth.previous_distance).all())

    def test_nearer_than_can_be_measured(self):
        dut = self.mask(make_scan(0.7, status=3))
        self.assertEqual(dut.reading[0], VALID)
        self.assertEqual(dut.scan.distance[0], 0.0)
        self.assertEqual(dut.scan.status[0], 3)

    def test_nothing_new_holds_the_sample_until_it_is_old(self):
        first = self.mask(make_scan(0.8, sequence=0, time=1.0))
        second = self.mask(make_scan(0.7, sequence=1, time=1.024), before=first)
        third = self.mask(
            make_scan(3.0, status=254, sequence=2, time=1.048), before=second
        )
        self.assertEqual(third.reading[0], VALID)
        self.assertEqual(third.scan.distance[0], 0.7)
        self.assertEqual(third.scan.sensor_time[0], 1.024)
        self.assertEqual(third.scan.sensor_time[1], 1.048)
        self.assertEqual(third.previous_distance[0], 0.8)
        self.assertEqual(third.previous_time[0], 1.0)
        self.assertEqual(third.previous_time[1], 1.024)
        fourth = self.mask(
            make_scan(3.0, status=254, sequence=3, time=1.096), before=third
        )
        self.assertEqual(fourth.fault[0], SensorFault.LATE)
        self.assertEqual(fourth.reading[0], HELD)
        self.assertEqual(fourth.reading[1], CLEAR)
        # And when it is back, there is no previous sample.
        fifth = self.mask(make_scan(0.6, sequence=4, time=1.12), before=fourth)
        self.assertEqual(fifth.reading[0], VALID)
        self.assertTrue(np.isnan(fifth.previous_distance[0]))

    def test_nothing_new_from_the_start_is_a_fault(self):
        dut = self.mask(make_scan(0.0, status=254))
        self.assertEqual(dut.reading[0], FAULTED)

    def test_time_that_is_not_a_number_is_a_fault(self):
        scan = make_scan(0.7)
        time = scan.sensor_time.copy()
        time[0] = np.nan
        dut = self.mask(dc.replace(scan, sensor_time=time))
        self.assertEqual(dut.reading[0], FAULTED)
        self.assertEqual(dut.reading[1], CLEAR)

    def test_rejects_a_scan_of_another_ring(self):
        with self.assertRaisesRegex(ValueError, "16 sensors.* 8"):
            self.mask(make_scan(0.5, n=16))

    @settings(deadline=None, max_examples=30)
    @given(
        distance=st.floats(0.05, 1.3),
        position=st.floats(0.05, 1.3),
    )
    def test_robot_never_stops_itself_and_a_person_in_front_counts(
        self, distance, position
    ):
        dut = self.mask(make_scan(distance), position=position)
        if abs(distance - position) < 0.025:
            self.assertEqual(dut.reading[0], MASKED)
        if distance < position - 0.031:
            self.assertEqual(dut.reading[0], VALID)


def mask_in_full(config, *, scan, before, time, table, cell, ring):
    """As mask_scans, for one ring, without leaving anything out."""
    n = len(scan.status)
    rows = slice(n * ring, n * ring + n)
    nobody = before.reading.shape != (n,)
    sensor_time, distance, status = (
        scan.sensor_time.copy(),
        scan.distance.copy(),
        scan.status.copy(),
    )
    held = status == 254
    if nobody:
        sensor_time[held] = -np.inf
        distance[held] = np.nan
    else:
        sensor_time[held] = before.raw.sensor_time[held]
        distance[held] = before.raw.distance[held]
        status[held] = before.raw.status[held]
    raw = RingScan(
        sequence=scan.sequence,
        time=scan.time,
        sensor_time=sensor_time.copy(),
        distance=distance.copy(),
        status=status.copy(),
    )
    reports = np.zeros((n, 15))
    looks = []
    for shift in (0.0, -config.time_margin, config.time_margin):
        seen = np.full((n, len(cell["bundles"].fan_S)), np.inf)
        for i in np.flatnonzero(np.isfinite(sensor_time)):
            report = mut.interpolate_reports(table, sensor_time[i] + shift, 6)
            if shift == 0.0:
                reports[i] = report
            if config.enabled:
                X_WF = cell["twin"].calc(report[1:7], report[13:])
                distances, _ = cell["caster"].cast_bundles(
                    cell["bundles"], X_WF
                )
                seen[i] = distances[rows][i]
        looks.append(seen)

    def classify(looks):
        nearest, farthest = calc_self_interval(np.hstack(looks))
        reading, fault, counted = classify_readings(
            distance,
            status,
            time - sensor_time,
            nearest,
            farthest,
            cell["sensor"].tolerance,
            cell["sensor"].min_range,
            cell["sensor"].max_range,
            config.calc_max_age(cell["sensor"]),
        )
        return reading, fault, counted, nearest, farthest

    moves = np.abs(reports[:, 7:13]).max() > 0.05
    reading, fault, counted, nearest, farthest = classify(
        looks if moves else looks[:1]
    )
    same = not nobody and sensor_time == before.raw.sensor_time
    if nobody:
        previous_distance = np.full(n, np.nan)
        previous_time = np.full(n, -np.inf)
    else:
        previous_distance = np.where(
            same,
            before.previous_distance,
            np.where(before.reading == VALID, before.scan.distance, np.nan),
        )
        previous_time = np.where(
            same, before.previous_time, before.scan.sensor_time
        )
        for i in range(n):
            # The same number again: the speed is still the last one.
            if (
                not same[i]
                and before.reading[i] == VALID
                and distance[i] == before.raw.distance[i]
                and before.previous_distance[i] > distance[i]
            ):
                previous_distance[i] = before.previous_distance[i]
                previous_time[i] = sensor_time[i] - (
                    before.scan.sensor_time[i] - before.previous_time[i]
                )
    result = MaskedScan(
        scan=RingScan(
            sequence=scan.sequence,
            time=scan.time,
            sensor_time=sensor_time,
            distance=counted,
            status=status,
        ),
        raw=raw,
        reading=reading,
        fault=fault,
        healthy_time=np.full(n, -np.inf),
        no_returns=np.zeros(n, dtype=int),
        unmeasured=np.zeros(n, dtype=int),
        others=np.zeros(n, dtype=int),
        self_nearest=nearest,
        self_farthest=farthest,
        previous_distance=previous_distance,
        previous_time=previous_time,
        position=reports[:, 1:7],
        velocity=reports[:, 7:13],
    )
    # Only where a sensor is about to become clear must the ring prove itself.
    is_proven = True
    must_prove = (
        not nobody
        and ((reading == CLEAR) & np.isin(before.reading, (VALID, HELD))).any()
    )
    for i in np.flatnonzero((reading == CLEAR) & must_prove):
        report = mut.interpolate_reports(table, sensor_time[i], 6)
        X_WF = cell["twin"].calc(report[1:7], report[13:])
        rays, _ = cell["caster"].cast_bundles(cell["proof_bundles"], X_WF)
        rays = rays[rows][i]
        if ((rays >= SENSOR.min_range) & (rays <= 0.9)).sum() >= 2:
            is_proven = False
    for i in range(n):
        remember_in_full(
            config,
            result,
            None if nobody else before,
            i,
            is_proven=is_proven or not config.enabled,
            now=time,
            report=table[-1],
        )
    return result


def remember_in_full(config, result, before, i, *, is_proven, now, report):
    """Writes what is remembered of sensor i, the straightforward way."""
    for message in (result, result.scan):
        for array in vars(message).values():
            if isinstance(array, np.ndarray):
                array.setflags(write=True)
    memory = config.memory
    time, distance = result.raw.sensor_time[i], result.raw.distance[i]
    had_obstacle, is_new, is_changed = False, time != -np.inf, True
    if before is not None:
        had_obstacle = before.reading[i] in (VALID, HELD)
        is_new = time != before.raw.sensor_time[i]
        is_changed = is_new and distance != before.raw.distance[i]
        for name in ("healthy_time", "no_returns", "unmeasured", "others"):
            getattr(result, name)[i] = getattr(before, name)[i]
        if before.scan.sequence >= 0:
            pause = result.scan.time - before.scan.time - 0.1
            result.healthy_time[i] += max(pause, 0.0)
    is_good = result.fault[i] == SensorFault.NONE
    if is_good and is_new:
        if result.healthy_time[i] == -np.inf:
            result.healthy_time[i] = time
        else:
            worked = min(max(time - before.raw.sensor_time[i], 0.0), 0.1)
            lag = (
                time
                - result.healthy_time[i]
                - (1.0 + 1.0 / memory.recovery_ratio) * worked
            )
            lag = min(max(lag, 0.0), memory.longest_lag)
            result.healthy_time[i] = time - lag
    lag = time - result.healthy_time[i]
    has_lag = lag > 1e-6
    is_other = False
    if result.reading[i] == VALID:
        if had_obstacle:
            away = distance - before.scan.distance[i] - memory.recede_margin
            elapsed = max(time - before.scan.sensor_time[i], 0.0)
            is_other = away > memory.recede_speed * elapsed or (
                away > 0.0 and (has_lag or result.others[i] > 0)
            )
        if not is_other or has_lag:
            result.others[i] = 0
        elif is_changed:
            result.others[i] += 1
    is_clear = is_good and result.reading[i] == CLEAR
    if not is_clear or not is_proven:
        result.no_returns[i] = 0
    else:
        result.no_returns[i] += is_new
    if result.fault[i] == SensorFault.SIGMA:
        result.unmeasured[i] += is_new
    elif not is_clear or result.no_returns[i] >= memory.clear_samples:
        result.unmeasured[i] = 0
    is_held = had_obstacle and (
        not is_good
        or (is_clear and (has_lag or result.no_returns[i] < 2))
        or (is_other and result.others[i] < 2)
    )
    if is_good and lag > memory.unreliable_lag:
        result.fault[i] = SensorFault.UNRELIABLE
    if is_held:
        result.reading[i] = HELD
        result.scan.sensor_time[i] = before.scan.sensor_time[i]
        result.scan.distance[i] = before.scan.distance[i]
        result.previous_distance[i] = before.previous_distance[i]
        result.previous_time[i] = before.previous_time[i]
    elif result.unmeasured[i] >= memory.sigma_samples:
        result.reading[i] = HELD
        result.scan.sensor_time[i] = now
        result.scan.distance[i] = 0.0
        result.previous_distance[i] = np.nan
    if result.reading[i] == HELD:
        result.position[i] = report[1:7]
        result.velocity[i] = report[7:13]


class TestProof(unittest.TestCase):
    """A blind ring must not release the stop that it holds."""

    def run_blind(self, *, position):
        """Sensor 0 has seen somebody; then no sensor sees anything."""
        config = mut.OcclusionMaskConfig()
        cell = make_cell(config)
        table = make_history([0.9, 1.3], [position] * 2)
        readings = []
        masked = MaskedScan()
        for i in range(6):
            status = 0 if i < 2 else 2
            masked = mask_scan(
                config,
                scan=make_scan(0.3, status, sequence=i, time=1.0 + 0.024 * i),
                before=masked,
                cell=cell,
                time=1.015 + 0.024 * i,
                table=table,
            )
            readings.append(masked.reading[0])
        return readings

    def test_where_the_robot_must_be_seen_nothing_is_confirmed(self):
        self.assertEqual(self.run_blind(position=0.6), [VALID] * 2 + [HELD] * 4)

    def test_where_it_need_not_be_seen(self):
        self.assertEqual(
            self.run_blind(position=1.2), [VALID] * 2 + [HELD] + [CLEAR] * 3
        )


class TestMaskScans(unittest.TestCase):
    def make_scan(self, rng, sequence, now, position):
        """A scan with anything that may come, often close to the robot."""
        n = 8
        distance = np.where(
            rng.random(n) < 0.8,
            rng.uniform(0.0, 1.4, n),
            rng.choice([np.nan, -0.1, 0.0, 5.0, 66.0], n),
        )
        if rng.random() < 0.7:
            distance[0] = max(position + rng.uniform(-0.05, 0.1), 0.0)
        kind = rng.integers(4)
        if kind == 0:
            sensor_time = np.full(n, now - 0.011)
        elif kind == 1:
            sensor_time = now - 0.008 * rng.integers(0, 3, n)
        elif kind == 2:
            sensor_time = now - rng.uniform(0.0, 0.09, n)
        else:
            sensor_time = rng.choice([now - 0.01, np.nan, np.inf, -np.inf], n)
        return RingScan(
            sequence=sequence,
            time=now,
            sensor_time=sensor_time,
            distance=distance,
            status=rng.choice(
                np.array([0, 0, 0, 0, 1, 2, 3, 254, 255], dtype=np.uint8), n
            ),
        )

    def check(self, seed, config, sensor):
        """Compares a run of scans with the straightforward way."""
        rng = np.random.default_rng(seed)
        cell = make_cell(config, names=RINGS, sensor=sensor)
        # The robot says whether it moves.
        speed, scale = rng.choice([-1.5, 0.0, 1.5]), rng.choice([0.0, 1.0])
        times = 0.008 * np.arange(12)
        before = expected_before = [MaskedScan()] * 3
        for sequence in range(4):
            now = times[-1]
            position = rng.uniform(0.05, 1.3)
            table = make_history(
                times,
                position + speed * (times - now + 0.01),
                scale=scale,
                carried=(sequence % 2, 0.0),
            )
            scans = [
                self.make_scan(rng, sequence, now, position)
                if rng.random() < 0.8
                else None
                for _ in RINGS
            ]
            after = mut.mask_scans(
                config,
                scans=scans,
                before=before,
                time=now,
                table=table,
                **cell,
            )
            expected_after = [
                was
                if scan is None
                else mask_in_full(
                    config,
                    scan=scan,
                    before=was,
                    time=now,
                    table=table,
                    cell=cell,
                    ring=ring,
                )
                for ring, (scan, was) in enumerate(
                    zip(scans, expected_before, strict=True)
                )
            ]
            for scan, was, dut, expected in zip(
                scans, before, after, expected_after, strict=True
            ):
                if scan is None:
                    self.assertIs(dut, was)
                else:
                    self.compare(dut, expected)
                    self.seen.update(dut.reading.tolist())
            before, expected_before = after, expected_after
            times = times + 0.024

    def compare(self, dut, expected):
        self.assertEqual(dut.scan.sequence, expected.scan.sequence)
        self.assertEqual(dut.scan.time, expected.scan.time)
        for one, two, names in (
            (dut.scan, expected.scan, ("sensor_time", "distance", "status")),
            (
                dut,
                expected,
                (
                    "reading",
                    "fault",
                    "healthy_time",
                    "no_returns",
                    "unmeasured",
                    "others",
                    "previous_distance",
                    "previous_time",
                    "position",
                    "velocity",
                ),
            ),
        ):
            for name in names:
                a, b = getattr(one, name), getattr(two, name)
                np.testing.assert_array_equal(a, b, err_msg=name)
                self.assertEqual(a.dtype, b.dtype, name)
                self.assertTrue(a.flags.c_contiguous, name)
                self.assertFalse(a.flags.writeable, name)
        # The hits are exactly the expected ones.
        valid = dut.reading == VALID
        for name in ("self_nearest", "self_farthest"):
            a, b = getattr(dut, name), getattr(expected, name)
            np.testing.assert_array_equal(a[valid], b[valid], err_msg=name)
            self.assertFalse(a.flags.writeable, name)
        self.assertTrue((dut.self_nearest >= expected.self_nearest).all())
        self.assertTrue((dut.self_farthest <= expected.self_farthest).all())
        self.assertEqual(
            set(vars(dut)), {field.name for field in dc.fields(MaskedScan)}
        )
        self.assertEqual(
            set(vars(dut.scan)), {field.name for field in dc.fields(RingScan)}
        )

    def test_as_without_leaving_anything_out(self):
        self.seen = set()
        exact = dc.replace(SENSOR, tolerance=0.006)
        for config, sensor in (
            (mut.OcclusionMaskConfig(), SENSOR),
            (mut.OcclusionMaskConfig(time_margin=0.0), SENSOR),
            (mut.OcclusionMaskConfig(time_margin=0.02), exact),
            (mut.OcclusionMaskConfig(enabled=False), SENSOR),
        ):
            for seed in range(40):
                with self.subTest(config=config, seed=seed):
                    self.check(seed, config, sensor)
        self.assertEqual(self.seen, set(Reading))

    def test_sensors_that_see_nothing_cost_no_look(self):
        config = mut.OcclusionMaskConfig()
        cell = make_cell(config)
        table = make_history([0.0, 2.0], [0.5, 0.5])
        for status, looks in ((2, 0), (255, 0), (3, 3), (0, 3)):
            cell["twin"].asked.clear()
            mask_scan(
                config,
                scan=make_scan(0.3, status),
                before=MaskedScan(),
                time=1.01,
                table=table,
                cell=cell,
            )
            self.assertEqual(len(cell["twin"].asked), looks)


class TestMaxAge(unittest.TestCase):
    def calc(self, config=None, **changes):
        config = config or mut.OcclusionMaskConfig()
        return config.calc_max_age(dc.replace(SENSOR, **changes))

    def test_follows_from_the_sensor(self):
        self.assertEqual(self.calc(period=0.024, latency=0.015), 0.072)
        self.assertEqual(self.calc(period=0.037, latency=0.02), 0.111)
        self.assertEqual(self.calc(period=0.1, latency=0.05), 0.3)
        # Two periods, and a latency that is longer than one.
        self.assertEqual(self.calc(period=0.1, latency=0.15), 0.35)

    def test_never_below_that_of_the_default_ring(self):
        self.assertEqual(self.calc(period=0.001, latency=0.001), 0.072)

    def test_the_scenario_has_the_last_word(self):
        config = mut.OcclusionMaskConfig(max_age=0.2)
        self.assertEqual(self.calc(config, period=0.024), 0.2)
        self.assertEqual(self.calc(config, period=1.0), 0.2)


class TestOcclusionMask(unittest.TestCase):
    def setUp(self):
        config = mut.OcclusionMaskConfig()
        self.cell = make_cell(config, names=RINGS)
        self.set_up_dut(
            mut.OcclusionMask(config=config, name=RINGS, **self.cell)
        )

    def set_up_dut(self, dut):
        self.dut = dut
        self.simulator = Simulator(self.dut)
        self.context = self.simulator.get_mutable_context()
        for ring in RINGS:
            self.fix_scan(RingScan(), ring)
        self.report = np.array([0.5, *[0] * 5, *range(6), 1.0, 3.0])
        self.fix_report()

    def fix_report(self, first_position=None, velocity=None):
        if first_position is not None:
            self.report[0] = first_position
        if velocity is not None:
            self.report[6:12] = velocity
        self.dut.GetInputPort("robot_report").FixValue(
            self.context, self.report
        )

    def fix_scan(self, scan, ring="base"):
        self.dut.GetInputPort(f"scan_{ring}").FixValue(
            self.context, Value(scan)
        )

    def eval(self, ring="base", context=None):
        return self.dut.GetOutputPort(f"masked_scan_{ring}").Eval(
            context or self.context
        )

    def test_ports(self):
        self.assertEqual(
            [
                self.dut.get_input_port(i).get_name()
                for i in range(self.dut.num_input_ports())
            ],
            [
                "scan_base",
                "scan_elbow",
                "scan_tool",
                "robot_report",
            ],
        )
        self.assertEqual(
            [
                self.dut.get_output_port(i).get_name()
                for i in range(self.dut.num_output_ports())
            ],
            ["masked_scan_base", "masked_scan_elbow", "masked_scan_tool"],
        )
        self.assertFalse(self.dut.HasAnyDirectFeedthrough())

    def test_as_many_rays_for_each_ring(self):
        for n in (1, 8, 16):
            cell = make_cell(mut.OcclusionMaskConfig(), n=n)
            with self.assertRaisesRegex(ValueError, f"{n} for 3 rings"):
                mut.OcclusionMask(
                    config=mut.OcclusionMaskConfig(), name=RINGS, **cell
                )

    def test_nothing_before_the_first_scan(self):
        self.simulator.AdvanceTo(0.1)
        for ring in RINGS:
            self.assertEqual(self.eval(ring).scan.sequence, -1)
        self.assertEqual(self.cell["twin"].asked, [])

    def test_masks_each_scan_once_in_the_tick_that_sees_it(self):
        self.simulator.AdvanceTo(0.031)
        self.fix_scan(make_scan(0.5, sequence=0, time=0.016))
        self.simulator.AdvanceTo(0.0319)
        self.assertEqual(self.eval().scan.sequence, -1)
        self.simulator.AdvanceTo(0.0321)
        first = self.eval()
        self.assertEqual(first.scan.sequence, 0)
        self.assertEqual(first.reading[0], MASKED)
        np.testing.assert_array_equal(first.velocity[0], np.arange(6.0))
        self.simulator.AdvanceTo(0.05)
        self.assertIs(self.eval(), first)
        ((_, carried),) = self.cell["twin"].asked
        self.assertEqual(carried, [1.0, 3.0])

        self.fix_scan(make_scan(0.7, sequence=1, time=0.040))
        self.simulator.AdvanceTo(0.0561)
        self.assertEqual(self.eval().reading[0], VALID)
        # The robot was masked: no previous sample.
        self.assertTrue(np.isnan(self.eval().previous_distance[0]))

    def test_rings_do_not_touch_each_other(self):
        self.fix_scan(make_scan(0.7, time=0.0), "elbow")
        self.simulator.AdvanceTo(0.001)
        elbow = self.eval("elbow")
        self.assertEqual(elbow.reading[0], VALID)
        self.assertEqual(self.eval("base").scan.sequence, -1)
        self.fix_scan(make_scan(0.5, time=0.008), "tool")
        self.simulator.AdvanceTo(0.009)
        self.assertIs(self.eval("elbow"), elbow)
        self.assertEqual(self.eval("tool").reading[0], MASKED)
        self.assertEqual(self.eval("base").scan.sequence, -1)

    def approach(self):
        """The robot comes at 1.5 m/s and is at 0.5 m at 32 ms."""
        for tick in range(6):
            time = 0.008 * tick
            self.fix_report(0.5 - 1.5 * (time - 0.032))
            self.simulator.AdvanceTo(time + 0.001)

    def test_rings_of_different_sampling_times(self):
        """Each ring's robot is that of its own samples' time."""
        self.fix_report(velocity=[-1.5, 0, 0, 0, 0, 0])
        self.approach()
        scans = {
            "base": make_scan(0.4, time=0.021),
            "elbow": make_scan(0.4, time=0.028),
            "tool": make_scan(0.5, time=0.037),
        }
        for ring, scan in scans.items():
            self.fix_scan(scan, ring)
        self.simulator.AdvanceTo(0.049)
        masked = {ring: self.eval(ring) for ring in RINGS}
        for ring, position in zip(RINGS, (0.5165, 0.506, 0.4925), strict=True):
            np.testing.assert_allclose(masked[ring].position[:, 0], position)
        # The wider look counts where something is valid.
        for ring, nearest in zip(
            RINGS, (0.5165 - 0.006, 0.506 - 0.006, 0.4925), strict=True
        ):
            self.assertAlmostEqual(masked[ring].self_nearest[0], nearest)
        self.assertEqual(
            [masked[ring].reading[0] for ring in RINGS], [VALID, VALID, MASKED]
        )
        self.assertEqual(len(self.cell["twin"].asked), 7)

        # One by one they give the same.
        for ring in RINGS:
            self.setUp()
            self.fix_report(velocity=[-1.5, 0, 0, 0, 0, 0])
            self.approach()
            self.fix_scan(scans[ring], ring)
            self.simulator.AdvanceTo(0.049)
            alone = self.eval(ring)
            for field in dc.fields(MaskedScan):
                if field.name != "scan":
                    np.testing.assert_array_equal(
                        getattr(masked[ring], field.name),
                        getattr(alone, field.name),
                        err_msg=f"{ring} {field.name}",
                    )

    def test_rings_of_one_sampling_time_share_their_looks(self):
        self.fix_report(velocity=[-1.5, 0, 0, 0, 0, 0])
        self.approach()
        for ring in RINGS:
            self.fix_scan(make_scan(0.5, time=0.029), ring)
        self.simulator.AdvanceTo(0.049)
        self.assertEqual(len(self.cell["twin"].asked), 1)
        for ring in RINGS:
            self.fix_scan(make_scan(0.4, time=0.037, sequence=1), ring)
        self.simulator.AdvanceTo(0.057)
        self.assertEqual(len(self.cell["twin"].asked), 4)
        for ring in RINGS:
            self.assertEqual(self.eval(ring).scan.sequence, 1)
            self.assertEqual(self.eval(ring).reading[0], VALID)

    def test_other_control_ticks(self):
        for period in (0.001, 0.002, 0.016, 0.072):
            config = mut.OcclusionMaskConfig()
            self.setUp()
            self.set_up_dut(
                mut.OcclusionMask(
                    config=config, period=period, name=RINGS, **self.cell
                )
            )
            last = int(np.ceil(0.3 / period))
            # As old as a sample may be, and a look back from there.
            time = period * last - 0.072 + 1e-6
            for tick in range(last + 1):
                self.fix_report(0.5 + 1.25 * (period * tick - time))
                if tick == last:
                    self.fix_scan(make_scan(0.4, time=time))
                self.simulator.AdvanceTo(period * (tick + 0.5))
            dut = self.eval()
            self.assertEqual(dut.reading[0], VALID)
            self.assertAlmostEqual(dut.position[0, 0], 0.5)
            # 4 ms earlier it was 5 mm nearer.
            self.assertAlmostEqual(dut.self_nearest[0], 0.495)

    def test_tick_must_last(self):
        for period in (0.0, -0.008, np.nan, np.inf):
            with self.assertRaisesRegex(UserError, "period"):
                mut.OcclusionMask(
                    config=mut.OcclusionMaskConfig(),
                    period=period,
                    name=RINGS,
                    **self.cell,
                )

    def test_samples_may_be_as_old_as_a_tick(self):
        with self.assertRaisesRegex(UserError, r"mask\.max_age: 0.07.*0.08"):
            mut.OcclusionMask(
                config=mut.OcclusionMaskConfig(max_age=0.07),
                period=0.08,
                name=RINGS,
                **self.cell,
            )

    def test_history_reaches_back_as_far_as_a_sample_may_be_old(self):
        for tick in range(30):
            self.fix_report(0.5 + 0.01 * tick)
            if tick == 29:
                # 70 ms ago, between the ticks 20 and 21.
                self.fix_scan(make_scan(0.7, time=0.008 * 29 - 0.070))
            self.simulator.AdvanceTo(0.008 * tick + 0.001)
        self.assertEqual(self.eval().reading[0], MASKED)
        self.assertAlmostEqual(self.eval().position[0, 0], 0.7025)

    def test_another_context_is_another_history(self):
        other = self.context.Clone()
        self.simulator.AdvanceTo(0.1)
        self.fix_scan(make_scan(0.5, time=0.09))
        self.simulator.AdvanceTo(0.105)
        self.assertEqual(self.eval().scan.sequence, 0)
        self.assertEqual(self.eval(context=other).scan.sequence, -1)


if __name__ == "__main__":
    unittest.main()
