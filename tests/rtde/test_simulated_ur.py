import dataclasses as dc
import unittest

import numpy as np
from robot_room import make_kinematics, make_robot
from scipy.spatial.transform import Rotation

from tofssm_drake.errors import UserError
from tofssm_drake.robots.robot_modes import (
    RuntimeState,
    SafetyMode,
)
from tofssm_drake.rtde.model_match import make_pose
from tofssm_drake.rtde.rtde_fields import OUTPUT_TYPES
from tofssm_drake.rtde.rtde_protocol import Recipe
import tofssm_drake.rtde.simulated_ur as mut
from tofssm_drake.tasks.program import PickAndPlace


def calc_dh_pose(q, end=6):
    """Pose of UR's flange (or elbow) by its published DH table, (4, 4)."""
    X = np.eye(4)
    for theta, a, d, alpha in list(
        zip(
            q,
            (0, -0.612, -0.5723, 0, 0, 0),
            (0.1273, 0, 0, 0.163941, 0.1157, 0.0922),
            (np.pi / 2, 0, 0, np.pi / 2, -np.pi / 2, 0),
            strict=True,
        )
    )[:end]:
        ct, st, ca, sa = (
            np.cos(theta),
            np.sin(theta),
            np.cos(alpha),
            np.sin(alpha),
        )
        X = X @ [
            [ct, -st * ca, st * sa, a * ct],
            [st, ct * ca, -ct * sa, a * st],
            [0, sa, ca, d],
            [0, 0, 0, 1],
        ]
    return X


def run(robot, cycles):
    """Steps a robot; returns its outputs as arrays with a row per cycle."""
    rows = []
    names = ("timestamp", "actual_q", "actual_qd", "target_speed_fraction")
    names += ("runtime_state", "safety_mode", "safety_status_bits")
    for _ in range(cycles):
        robot.step()
        rows.append([robot.outputs[name] for name in names])
    return {
        name: np.array([row[i] for row in rows], dtype=float)
        for i, name in enumerate(names)
    }


def write_slider(robot, fraction, mask=1):
    robot.receive(
        {"speed_slider_mask": mask, "speed_slider_fraction": fraction}
    )


def make_tool():
    """Returns the modelled tool in the flange, (3, 4)."""
    return make_pose(mut.calc_tcp_offset(make_kinematics()))


class TestKinematics(unittest.TestCase):
    def test_tool_pose_agrees_with_published_table(self):
        tcp = 0.0
        for q in np.random.default_rng(1).uniform(-3, 3, (20, 6)):
            pose, _, elbow, _ = mut.calc_tool_motion(
                make_kinematics(), q, np.zeros(6), make_tool()
            )
            flange = calc_dh_pose(q)
            # The tool stands off along the flange's axis.
            offset = flange[:3, :3].T @ (pose[:3] - flange[:3, 3])
            np.testing.assert_allclose(offset[:2], 0, atol=1e-9)
            tcp = tcp or offset[2]
            self.assertAlmostEqual(offset[2], tcp, places=9)
            R = Rotation.from_rotvec(pose[3:]).as_matrix()
            np.testing.assert_allclose(R[:, 2], flange[:3, 2], atol=1e-9)
            np.testing.assert_allclose(
                elbow, calc_dh_pose(q, 2)[:3, 3], atol=1e-9
            )
        self.assertGreater(tcp, 0.05)

    def test_tcp_offset_is_what_lies_between_flange_and_tool(self):
        robot = make_robot()
        for _ in range(3):
            run(robot, 200)
            flange = calc_dh_pose(robot.outputs["actual_q"])
            tool, offset = np.eye(4), np.eye(4)
            for X, name in ((tool, "actual_TCP_pose"), (offset, "tcp_offset")):
                pose = robot.outputs[name]
                X[:3, 3] = pose[:3]
                X[:3, :3] = Rotation.from_rotvec(pose[3:]).as_matrix()
            np.testing.assert_allclose(flange @ offset, tool, atol=1e-9)

    def test_tcp_offset_of_a_tool_that_is_turned(self):
        kinematics = make_kinematics()
        turn = np.array([0.3, -0.2, 0.5])
        X_AS = kinematics.X_AS.copy()
        X_AS[-1, :, :3] = Rotation.from_rotvec(turn).as_matrix()
        X_AS[-1, :, 3] = (0.01, -0.02, 0.15)
        np.testing.assert_allclose(
            mut.calc_tcp_offset(dc.replace(kinematics, X_AS=X_AS)),
            [0.01, -0.02, 0.15, *turn],
            atol=1e-12,
        )
        with self.assertRaisesRegex(UserError, "must sit on the flange"):
            mut.calc_tcp_offset(
                dc.replace(kinematics, site_link=np.array([2, 3, 6, 5]))
            )

    def test_velocities_are_derivatives(self):
        h = 1e-6
        for q, qd in np.random.default_rng(2).uniform(-2, 2, (10, 2, 6)):
            results = [
                mut.calc_tool_motion(
                    make_kinematics(), q + s * h * qd, qd, make_tool()
                )
                for s in (-1, 0, 1)
            ]
            (before, _, elbow_before, _), now, (after, _, elbow_after, _) = (
                results
            )
            np.testing.assert_allclose(
                (after[:3] - before[:3]) / (2 * h), now[1][:3], atol=1e-6
            )
            turn = (
                Rotation.from_rotvec(after[3:])
                * Rotation.from_rotvec(before[3:]).inv()
            )
            np.testing.assert_allclose(
                turn.as_rotvec() / (2 * h), now[1][3:], atol=1e-6
            )
            np.testing.assert_allclose(
                (elbow_after - elbow_before) / (2 * h), now[3], atol=1e-6
            )


class TestMotion(unittest.TestCase):
    def check_consistent(self, robot, data):
        """The reported speeds match the reported positions."""
        period = 1 / robot.rate
        np.testing.assert_allclose(
            np.diff(data["timestamp"]), period, atol=1e-9
        )
        moved = np.diff(data["actual_q"], axis=0) / period
        mean = (data["actual_qd"][1:] + data["actual_qd"][:-1]) / 2
        # Jerk of 300 rad/s^3 over one cycle.
        np.testing.assert_allclose(moved, mean, atol=300 * period**2)

    def test_whole_program(self):
        for series in ("cb3", "e"):
            with self.subTest(series=series):
                robot = make_robot(series=series)
                data = run(robot, int(3 * robot.rate))
                self.check_consistent(robot, data)
                while robot.runtime_state != RuntimeState.STOPPED:
                    robot.step()
                self.assertEqual(robot.outputs["output_int_register_24"], 2)
                self.assertEqual(robot.outputs["actual_qd"], (0.0,) * 6)
                # After that only play moves it.
                q = robot.outputs["actual_q"]
                run(robot, 10)
                self.assertEqual(robot.outputs["actual_q"], q)
                self.assertTrue(robot.play())
                run(robot, 100)
                self.assertNotEqual(robot.outputs["actual_q"], q)

    def test_slider_follows_its_ramp(self):
        robot = make_robot(ramp=0.4)
        run(robot, 125)
        write_slider(robot, 0.2)
        data = run(robot, 1)
        self.assertEqual(data["target_speed_fraction"][0], 0.2)
        self.assertAlmostEqual(robot.speed_fraction, 1 - 0.008 / 0.4)
        data = run(robot, 60)
        self.check_consistent(robot, data)
        self.assertAlmostEqual(robot.speed_fraction, 0.2)
        write_slider(robot, 0.0)
        run(robot, 60)
        self.assertEqual(robot.speed_fraction, 0.0)
        self.assertEqual(robot.outputs["actual_qd"], (0.0,) * 6)
        self.assertEqual(robot.runtime_state, RuntimeState.PLAYING)

    def test_no_ramp(self):
        robot = make_robot(ramp=0.0)
        run(robot, 125)
        write_slider(robot, 0.5)
        robot.step()
        self.assertEqual(robot.speed_fraction, 0.5)

    def test_slider_scales_speed_on_the_same_path(self):
        full, half = make_robot(ramp=0.0), make_robot(ramp=0.0)
        write_slider(half, 0.5)
        half.step()
        fast, slow = run(full, 200), run(half, 402)
        s = (half.path_time, full.path_time)
        self.assertLess(abs(s[0] - s[1]), 0.02)
        # Each point of the slow run lies between two of the fast one.
        for q in slow["actual_q"][::20]:
            gap = np.abs(fast["actual_q"] - q).max(axis=1).min()
            self.assertLess(gap, 2.1 * 0.008)

    def test_loop(self):
        robot = make_robot(loop=True, program=PickAndPlace(products=1))
        for _ in range(int(2.2 * robot._path.duration * robot.rate)):
            robot.step()
        self.assertEqual(robot.runtime_state, RuntimeState.PLAYING)

    def test_gripper_and_products(self):
        robot = make_robot(gripper_output=3, products_register=30)
        path = robot._path
        while robot.path_time < (path.close_time[1] + path.open_time[1]) / 2:
            robot.step()
        self.assertEqual(robot.outputs["actual_digital_output_bits"], 8)
        self.assertEqual(robot.outputs["output_int_register_30"], 1)


class TestSlider(unittest.TestCase):
    def test_mask_is_a_strobe(self):
        robot = make_robot()
        write_slider(robot, 0.3)
        write_slider(robot, 0.8, mask=0)
        robot.step()
        self.assertEqual(robot.outputs["target_speed_fraction"], 0.3)
        robot.move_slider(0.6)
        write_slider(robot, 0.3, mask=2)
        robot.step()
        self.assertEqual(robot.outputs["target_speed_fraction"], 0.6)

    def test_clamped_and_not_a_number_refused(self):
        robot = make_robot()
        for fraction, expected in (
            (2.0, 1.0),
            (-1.0, 0.0),
            (np.nan, 0.0),
            (np.inf, 0.0),
        ):
            write_slider(robot, fraction)
            self.assertEqual(robot.slider, expected)

    def test_pause_resets_if_asked_to(self):
        robot = make_robot(slider_resets_on_pause=True)
        write_slider(robot, 0.2)
        robot.pause()
        self.assertEqual(robot.slider, 1.0)

    def test_protective_stop_when_leaving_zero_if_asked_to(self):
        robot = make_robot(protective_stop_after_zero=True)
        write_slider(robot, 0.2)
        write_slider(robot, 0.0)
        run(robot, 60)
        self.assertEqual(robot.safety_mode, SafetyMode.NORMAL)
        write_slider(robot, 0.1)
        robot.step()
        self.assertEqual(robot.safety_mode, SafetyMode.PROTECTIVE_STOP)


class TestModes(unittest.TestCase):
    def test_pause_and_play(self):
        robot = make_robot(pause_time=0.2)
        run(robot, 125)
        robot.pause()
        states = run(robot, 40)["runtime_state"]
        self.assertEqual(
            list(dict.fromkeys(states)),
            [RuntimeState.PAUSING, RuntimeState.PAUSED],
        )
        self.assertEqual(robot.outputs["actual_qd"], (0.0,) * 6)
        self.assertEqual(robot.outputs["robot_status_bits"], 1)
        self.assertTrue(robot.play())
        run(robot, 40)
        self.assertEqual(robot.runtime_state, RuntimeState.PLAYING)
        self.assertEqual(robot.speed_fraction, 1.0)
        self.assertEqual(robot.outputs["robot_status_bits"], 3)

    def test_protective_stop(self):
        robot = make_robot(protective_stop_time=0.1)
        run(robot, 125)
        robot.set_safety_mode(SafetyMode.PROTECTIVE_STOP)
        data = run(robot, 14)
        self.assertEqual(robot.outputs["actual_qd"], (0.0,) * 6)
        self.assertEqual(data["safety_mode"][-1], 3)
        self.assertEqual(data["safety_status_bits"][-1], 1 << 2 | 1 << 10)
        self.assertFalse(robot.play())
        robot.set_safety_mode(SafetyMode.NORMAL)
        run(robot, 10)
        # It does not resume on its own.
        self.assertEqual(robot.speed_fraction, 0.0)
        self.assertTrue(robot.play())
        run(robot, 40)
        self.assertEqual(robot.speed_fraction, 1.0)

    def test_stop(self):
        robot = make_robot()
        run(robot, 125)
        robot.stop()
        run(robot, 40)
        self.assertEqual(robot.runtime_state, RuntimeState.STOPPED)
        self.assertEqual(robot.speed_fraction, 0.0)

    def test_clock(self):
        robot = make_robot(initial_timestamp=50.0)
        robot.step()
        self.assertAlmostEqual(robot.outputs["timestamp"], 50.008)
        robot.restart_clock()
        robot.step()
        self.assertAlmostEqual(robot.outputs["timestamp"], 0.008)


class TestWatchdog(unittest.TestCase):
    def beat(self, robot, cycles, first=0):
        for i in range(cycles):
            robot.receive({"input_int_register_24": first + i})
            robot.step()

    def test_stops_the_program_when_the_heartbeat_stalls(self):
        for action, state in (
            ("stop", RuntimeState.STOPPED),
            ("pause", RuntimeState.PAUSED),
        ):
            with self.subTest(action=action):
                robot = make_robot(watchdog_timeout=0.1, watchdog_action=action)
                self.beat(robot, 250)
                self.assertEqual(robot.speed_fraction, 1.0)
                # Repeating the same number is not a sign of life.
                for _ in range(12):
                    robot.receive({"input_int_register_24": 249})
                    robot.step()
                self.assertEqual(robot.runtime_state, RuntimeState.PLAYING)
                data = run(robot, 30)
                self.assertEqual(robot.runtime_state, state)
                # 0.1 s and one cycle, then 0.2 s to standstill.
                still = np.abs(data["actual_qd"]).max(axis=1) == 0
                self.assertLessEqual(np.argmax(still), 27)

    def test_without_it_the_program_goes_on(self):
        robot = make_robot()
        run(robot, 250)
        self.assertEqual(robot.speed_fraction, 1.0)

    def test_start_with_the_heartbeat(self):
        robot = make_robot(start="heartbeat", watchdog_timeout=0.1)
        run(robot, 50)
        self.assertEqual(robot.runtime_state, RuntimeState.STOPPED)
        self.beat(robot, 3, first=1)
        self.assertEqual(robot.runtime_state, RuntimeState.PLAYING)
        # Once tripped, only people restart it, not the heartbeat.
        run(robot, 60)
        self.beat(robot, 10, first=9)
        self.assertEqual(robot.runtime_state, RuntimeState.STOPPED)


class TestFaults(unittest.TestCase):
    def test_arm_that_ignores_its_slider(self):
        for fault, fraction in (
            ({"ignores_slider": True}, 1.0),
            ({"slowest_fraction": 0.6}, 0.6),
            ({"slowest_fraction": 0.1}, 0.3),
            ({}, 0.3),
        ):
            robot = make_robot()
            run(robot, 50)
            vars(robot).update(fault)
            write_slider(robot, 0.3)
            run(robot, 50)
            self.assertEqual(robot.outputs["target_speed_fraction"], 0.3)
            self.assertAlmostEqual(robot.speed_fraction, fraction)

    def test_a_program_that_ends_ends(self):
        robot = make_robot()
        robot.ignores_slider = True
        run(robot, 50)
        robot.stop()
        run(robot, 50)
        self.assertEqual(robot.speed_fraction, 0.0)

    def test_joints_that_are_off_or_late(self):
        for series in ("cb3", "e"):
            right, wrong = make_robot(series=series), make_robot(series=series)
            wrong.joint_offset[2] = 0.1
            wrong.joints_late = 0.048
            before = []
            for _ in range(right.rate // 2):
                right.step()
                wrong.step()
                before.append(np.array(right.outputs["actual_q"]))
            q = before[-1 - round(0.048 * right.rate)]
            np.testing.assert_allclose(
                wrong.outputs["actual_q"], np.add(q, [0, 0, 0.1, 0, 0, 0])
            )
            self.assertGreater(abs(q - before[-1]).max(), 0.01)
            np.testing.assert_allclose(wrong.position, before[-1])
            np.testing.assert_allclose(
                wrong.velocity, right.outputs["actual_qd"]
            )
            for name in ("actual_TCP_pose", "actual_TCP_speed", "timestamp"):
                self.assertEqual(wrong.outputs[name], right.outputs[name])

    def test_tool_that_is_set_up_elsewhere(self):
        robot = make_robot()
        run(robot, 60)
        robot.tcp_offset[:3] = (0.1, 0.0, 0.3)
        before = robot.outputs["actual_TCP_pose"]
        robot.step()
        now = robot.outputs["actual_TCP_pose"]
        self.assertEqual(robot.outputs["tcp_offset"][:3], (0.1, 0.0, 0.3))
        # 0.1 m to the side and 0.1 m beyond the modelled tool.
        self.assertAlmostEqual(
            np.linalg.norm(np.subtract(now[:3], before[:3])), 0.1414, delta=0.02
        )

    def test_rate_of_the_clock(self):
        robot = make_robot(watchdog_timeout=0.2)
        start = robot.timestamp
        robot.clock_rate = 2.0
        run(robot, 24)
        self.assertAlmostEqual(robot.timestamp - start, 2 * 24 * 0.008)
        # The watchdog counts true seconds.
        self.assertEqual(robot.runtime_state, RuntimeState.PLAYING)
        run(robot, 3)
        self.assertEqual(robot.runtime_state, RuntimeState.STOPPING)


class TestInputsAndFields(unittest.TestCase):
    def test_registers_are_read_back(self):
        robot = make_robot()
        robot.receive(
            {"input_int_register_25": -5, "input_bit_register_64": True}
        )
        robot.step()
        self.assertEqual(robot.outputs["input_int_register_25"], -5)
        self.assertTrue(robot.outputs["input_bit_register_64"])

    def test_digital_and_analog_outputs(self):
        robot = make_robot()
        robot.receive(
            {"standard_digital_output_mask": 6, "standard_digital_output": 2}
        )
        robot.receive(
            {
                "configurable_digital_output_mask": 1,
                "configurable_digital_output": 255,
            }
        )
        robot.receive(
            {
                "standard_analog_output_mask": 1,
                "standard_analog_output_0": 0.4,
                "standard_analog_output_1": 0.6,
            }
        )
        robot.step()
        bits = robot.outputs["actual_digital_output_bits"]
        self.assertEqual(bits, 2 | 1 << 8)
        self.assertEqual(robot.outputs["standard_analog_output0"], 0.4)
        self.assertEqual(robot.outputs["standard_analog_output1"], 0)

    def test_every_output_fits_its_type(self):
        for series, unknown in (
            ("cb3", {"actual_current_as_torque", "ft_raw_wrench"}),
            ("e", {"actual_current_as_torque"}),
        ):
            robot = make_robot(series=series)
            self.assertEqual(
                set(OUTPUT_TYPES) - set(robot.output_types), unknown
            )
            names = tuple(robot.output_types)
            recipe = Recipe(names, tuple(robot.output_types.values()), 1)
            recipe.encode([robot.outputs[name] for name in names])

    def test_settings_are_checked(self):
        for settings, message in (
            ({"series": "cb2"}, "robot.series: 'cb2' is unknown"),
            ({"ramp": -1.0}, "robot.ramp: must be from 0 to 10 s, got -1"),
            ({"ramp": np.nan}, "robot.ramp"),
            ({"heartbeat_register": 48}, "robot.heartbeat_register"),
            ({"start": ""}, "robot.start"),
        ):
            with (
                self.subTest(settings=settings),
                self.assertRaisesRegex(UserError, message),
            ):
                make_robot(**settings)
