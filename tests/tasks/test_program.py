import functools
import unittest

from hypothesis import given, settings
from hypothesis import strategies as st
import numpy as np
from pydrake.common.yaml import yaml_load_typed
from pydrake.multibody.tree import MultibodyForces
from pydrake.systems.analysis import Simulator

from tofssm_drake.arms.cell_plant import make_cell_plant
from tofssm_drake.arms.kinematics import ArmKinematics
from tofssm_drake.errors import UserError
import tofssm_drake.tasks.program as mut


@functools.cache
def make_plant():
    return make_cell_plant()


@functools.cache
def make_kinematics():
    return ArmKinematics.from_plant(make_plant())


@functools.cache
def make_path():
    return mut.make_program_path(mut.PickAndPlace(), make_kinematics())


def calc_tcp(q):
    return make_kinematics().calc_tcp_pose(q)


class TestConfig(unittest.TestCase):
    def test_default_is_valid(self):
        mut.PickAndPlace().check("program")

    def test_yaml(self):
        loaded = yaml_load_typed(
            schema=mut.PickAndPlace,
            data="{products: 4, pick_center: [0.1, -0.8, 0.73]}",
            defaults=mut.PickAndPlace(),
        )
        self.assertEqual(
            loaded,
            mut.PickAndPlace(products=4, pick_center=[0.1, -0.8, 0.73]),
        )

    def test_wrong_settings_are_named(self):
        for name, value in (
            ("products", 0),
            ("hover_radius", -0.1),
            ("sweep", 0.0),
            ("sweep_speed", 1.8),
            ("arm_speed", 3.0),
            ("gripper_dwell", -1.0),
            ("pick_center", [0.0]),
            ("place_columns", 0),
        ):
            config = mut.PickAndPlace(**{name: value})
            with self.assertRaisesRegex(UserError, rf"cell\.{name}: "):
                config.check("cell")

    def test_limits_without_a_motion_are_an_error(self):
        slow = r"approach_speed: 0\.8 m/s .* task\.arm_speed; at most"
        for wrong, message in (
            ({"arm_speed": 0.5}, slow),
            ({"arm_speed": 0.1}, slow),
            ({"approach_speed": 1.6}, r"approach_speed: 1\.6 m/s .* at most"),
            ({"approach_speed": 3.0}, r"approach_speed: 3 m/s .* at most"),
            ({"base_jerk": 1e300}, "base_jerk: must be from 0.001"),
            ({"base_jerk": 1e-300}, "base_jerk: must be from 0.001"),
            ({"arm_jerk": 1e300}, "arm_jerk: must be from 0.001"),
            ({"sweep_speed": 1e-9}, "sweep_speed: must be from 0.001"),
        ):
            with self.subTest(wrong=wrong):
                with self.assertRaisesRegex(
                    UserError, rf"^task\.{message}"
                ) as context:
                    mut.make_program_path(
                        mut.PickAndPlace(**wrong), make_kinematics()
                    )
                self.assertNotIn("\n", str(context.exception))

    def test_the_approach_speed_told_as_the_most_is_possible(self):
        # The slots differ: each refusal names what its own slot permits.
        speed = 2.0
        for _ in range(20):
            try:
                mut.make_program_path(
                    mut.PickAndPlace(approach_speed=speed), make_kinematics()
                )
                break
            except UserError as error:
                slower = float(str(error).rpartition(" ")[2])
                self.assertLess(slower, speed)
                speed = slower
        else:
            self.fail("never")
        self.assertGreater(speed, 0.8)

    def test_a_refusal_of_the_planner_is_an_error(self):
        path = mut.PathBuilder(np.zeros(1), *np.full((3, 1), 1.0))
        for velocity in (2.0, np.nan):
            with self.assertRaisesRegex(UserError, "no motion within"):
                path.move(np.ones(1), np.array([velocity]))

    def test_unreachable_slot_is_an_error(self):
        config = mut.PickAndPlace(pick_center=[0.0, -1.5, 0.7])
        with self.assertRaisesRegex(UserError, "reach"):
            mut.make_program_path(config, make_kinematics())


class TestSlots(unittest.TestCase):
    def test_grid(self):
        slots = mut.calc_slots(
            center=[1, 2, 3], pitch=[0.1, 0.2], columns=2, count=4
        )
        np.testing.assert_allclose(
            slots,
            [[0.95, 1.9, 3], [1.05, 1.9, 3], [0.95, 2.1, 3], [1.05, 2.1, 3]],
        )

    def test_products_fit_their_places(self):
        """Checks the default slots against the models: on the pick table,
        inside the box, none in another."""
        plant = make_plant()
        context = plant.CreateDefaultContext()
        config = mut.PickAndPlace()
        half = 0.0275
        pick = mut.calc_pick_slots(config)
        place = mut.calc_place_slots(config)
        for slots in (pick, place):
            self.assertEqual(slots.shape, (10, 3))
            gap = np.abs(slots[:, None] - slots[None]).max(axis=2)
            self.assertGreater((gap + np.eye(10)).min(), 2 * half)
        table = plant.GetFrameByName(
            "table", plant.GetModelInstanceByName("pick_table")
        ).CalcPoseInWorld(context)
        box = plant.GetFrameByName("box").CalcPoseInWorld(context)
        p_table = pick - table.translation()
        np.testing.assert_allclose(p_table[:, 2], half)
        self.assertLess(np.abs(p_table[:, 0]).max() + half, 0.40)
        self.assertLess(np.abs(p_table[:, 1]).max() + half, 0.30)
        p_box = place - box.translation()
        np.testing.assert_allclose(p_box[:, 2], half + 0.006)
        # The fingers reach 0.0455 m to either side along x.
        self.assertLess(np.abs(p_box[:, 0]).max() + 0.0455, 0.22)
        self.assertLess(np.abs(p_box[:, 1]).max() + half, 0.11)


class TestPath(unittest.TestCase):
    def test_continuous(self):
        """Checks that q, q', q'' agree on both sides of every knot and that
        q' and q'' are the derivatives of q."""
        path = make_path()
        for i in range(1, len(path.start)):
            knot = path.start[i]
            before, after = (
                path.calc_motion(knot - 1e-9),
                path.calc_motion(knot),
            )
            np.testing.assert_allclose(before[0], after[0], atol=1e-7)
            np.testing.assert_allclose(before[1], after[1], atol=1e-6)
            np.testing.assert_allclose(before[2], after[2], atol=1e-4)
        h = 1e-5
        for s in np.linspace(0.1, path.duration, 300):
            a, b, c = (path.calc_motion(t) for t in (s - h, s, s + h))
            np.testing.assert_allclose((c[0] - a[0]) / 2 / h, b[1], atol=1e-5)
            np.testing.assert_allclose((c[1] - a[1]) / 2 / h, b[2], atol=5e-3)

    def test_limits(self):
        config = mut.PickAndPlace()
        path = make_path()
        motions = np.array(
            [path.calc_motion(s) for s in np.arange(0, path.duration, 0.01)]
        )
        base = config.sweep_speed / config.hover_radius
        arm = config.arm_speed
        tolerance = 1 + 1e-9
        speed = np.abs(motions[:, 1]).max(axis=0)
        self.assertLess(speed[0], base * tolerance)
        self.assertLess(speed[1:].max(), arm * tolerance)
        acceleration = np.abs(motions[:, 2]).max(axis=0)
        self.assertLess(acceleration[0], config.base_acceleration * tolerance)
        self.assertLess(
            acceleration[1:].max(), config.arm_acceleration * tolerance
        )
        self.assertLess(np.abs(motions[:, 0]).max(), 2 * np.pi)

    def test_sweep(self):
        """Checks that the tool peaks at 1.7 m/s at a radius of 0.82 m, and
        that the base joint alone turns, by exactly 180 degrees."""
        path = make_path()
        kinematics = make_kinematics()
        times = np.arange(0, path.duration, 0.004)
        speed = np.empty(len(times))
        radius = np.empty(len(times))
        for i, s in enumerate(times):
            q, qd, _ = path.calc_motion(s)
            speed[i] = np.linalg.norm(kinematics.calc_sites(q, qd)[1][-1])
            radius[i] = np.hypot(*calc_tcp(q)[:2, 3])
        self.assertAlmostEqual(speed.max(), 1.7, places=6)
        np.testing.assert_allclose(radius[speed > 1.69], 0.82, atol=1e-9)
        hover = path.calc_motion(0.0)[0]
        fast = np.abs(path.coefficients[:, 1, 0]) > 1.9
        self.assertEqual(np.count_nonzero(np.diff(fast.astype(int)) == 1), 20)
        for piece in path.coefficients[fast]:
            np.testing.assert_array_equal(piece[1:, 1:], 0)
            np.testing.assert_allclose(piece[0, 1:], hover[1:], atol=1e-9)
        # At rest over the box it is half a turn away from where it started.
        over_box = np.isclose(
            path.coefficients[:, 0, 0], hover[0] + np.pi, rtol=0, atol=1e-12
        )
        self.assertGreaterEqual(np.count_nonzero(over_box), 20)

    def test_gripper_events(self):
        """Checks that the tool rests at the right slot at each event."""
        config = mut.PickAndPlace()
        path = make_path()
        for events, slots in (
            (path.close_time, mut.calc_pick_slots(config)),
            (path.open_time, mut.calc_place_slots(config)),
        ):
            self.assertEqual(len(events), 10)
            for s, slot in zip(events, slots, strict=True):
                q, qd, _ = path.calc_motion(s)
                X_WT = calc_tcp(q)
                np.testing.assert_allclose(X_WT[:, 3], slot, atol=1e-9)
                np.testing.assert_allclose(X_WT[:, 2], [0, 0, -1], atol=1e-9)
                np.testing.assert_allclose(qd, 0, atol=1e-9)
        close_time, open_time = map(np.array, (path.close_time, path.open_time))
        self.assertTrue(np.all(close_time < open_time))
        self.assertTrue(np.all(open_time[:-1] < close_time[1:]))
        self.assertEqual(path.calc_products_placed(path.open_time[3] - 1e-6), 3)
        self.assertEqual(path.calc_products_placed(path.open_time[3]), 4)
        self.assertFalse(path.calc_gripper_closed(path.close_time[3] - 1e-6))
        self.assertTrue(path.calc_gripper_closed(path.close_time[3]))
        self.assertFalse(path.calc_gripper_closed(path.open_time[3]))
        self.assertFalse(path.calc_gripper_closed(np.inf))

    def test_approach_is_nearly_straight(self):
        """Checks that a product near its slot keeps above it, so that it
        neither meets its neighbours nor the box's wall (0.10 m high)."""
        config = mut.PickAndPlace()
        path = make_path()
        slots = np.vstack(
            [mut.calc_pick_slots(config), mut.calc_place_slots(config)]
        )
        for s in np.arange(0, path.duration, 0.01):
            p = calc_tcp(path.calc_motion(s)[0])[:, 3]
            if p[2] < 0.80 + 0.0275 + 0.01:
                sideways = np.hypot(*(slots - p)[:, :2].T).min()
                self.assertLess(sideways, 0.012)

    def test_duration(self):
        self.assertLess(abs(make_path().duration - 60), 10)

    def test_ends_where_it_starts(self):
        path = make_path()
        np.testing.assert_allclose(
            path.calc_motion(path.duration + 5)[0],
            path.calc_motion(0)[0],
            atol=1e-9,
        )
        np.testing.assert_array_equal(
            path.calc_motion(path.duration + 5)[1:], 0
        )

    def test_torques_have_margin(self):
        """Checks the nominal motion against the UR10's torque limits, with a
        quarter to spare."""
        plant = make_plant()
        context = plant.CreateDefaultContext()
        path = make_path()
        forces = MultibodyForces(plant)
        largest = np.zeros(6)
        for s in np.arange(0, path.duration, 0.02):
            q, qd, qdd = path.calc_motion(s)
            plant.SetPositions(context, q)
            plant.SetVelocities(context, qd)
            plant.CalcForceElementsContribution(context, forces)
            torque = plant.CalcInverseDynamics(context, qdd, forces)
            largest = np.maximum(largest, np.abs(torque))
        limit = np.array([330, 330, 150, 56, 56, 56])
        self.assertLess((largest / limit).max(), 0.75)


@functools.cache
def make_program(period=0.008):
    return mut.TaskProgram(
        path=mut.make_program_path(mut.PickAndPlace(), make_kinematics()),
        period=period,
    )


def set_progress(context, progress):
    """Sets path time, its rate, the rate's change, time of the tick."""
    context.SetDiscreteState(0, progress)


def get_progress(context):
    return context.get_discrete_state(0).value()


def run(fractions, period=0.008):
    """Returns path time and motion_commanded at ticks and between them."""
    dut = make_program(period)
    context = dut.CreateDefaultContext()
    rows = []
    for k, fraction in enumerate(fractions):
        context.SetTime(k * period)
        dut.GetInputPort("speed_fraction").FixValue(context, [fraction])
        state = dut.EvalUniquePeriodicDiscreteUpdate(context)
        context.SetDiscreteState(state)
        for part in (0.0, 0.31, 0.77, 1.0):
            time = (k + part) * period
            context.SetTime(time)
            s, rate, change = mut.advance_path_time(
                get_progress(context), time, period
            )
            motion = dut.GetOutputPort("motion_commanded").Eval(context)
            rows.append((s, rate, change, *motion))
    return np.array(rows)


class TestTaskProgram(unittest.TestCase):
    def test_ports(self):
        dut = make_program()
        self.assertEqual(
            [dut.get_input_port(i).get_name() for i in range(1)],
            ["speed_fraction"],
        )
        self.assertEqual(
            [
                dut.get_output_port(i).get_name()
                for i in range(dut.num_output_ports())
            ],
            [
                "motion_commanded",
                "position_commanded",
                "velocity_commanded",
                "acceleration_commanded",
                "gripper_closed",
                "carried_objects",
                "products_placed",
                "task_done",
            ],
        )
        self.assertFalse(dut.HasAnyDirectFeedthrough())

    @settings(max_examples=30, deadline=None)
    @given(
        st.lists(
            st.floats(min_value=-0.5, max_value=1.5), min_size=1, max_size=60
        ),
        st.sampled_from((0.002, 0.008, 0.016)),
    )
    def test_path_does_not_change(self, fractions, period):
        """Whatever the speed fraction, the commanded q lies exactly on the
        nominal path, path time never goes back, the velocity is continuous
        and is the derivative of the position."""
        rows = run(fractions, period)
        path = make_path()
        for s, rate, change, *motion in rows:
            q, qd, qdd = path.calc_motion(s)
            np.testing.assert_array_equal(motion[:6], q)
            np.testing.assert_allclose(motion[6:12], qd * rate, atol=1e-12)
            np.testing.assert_allclose(
                motion[12:], qdd * rate**2 + qd * change, atol=1e-9
            )
        s, rate = rows[:, 0], rows[:, 1]
        self.assertTrue(np.all(np.diff(s) >= 0))
        self.assertTrue(np.all((rate >= -1e-12) & (rate <= 1 + 1e-12)))
        # The end of a tick is the start of the next one.
        np.testing.assert_allclose(rate[3:-1:4], rate[4::4], atol=1e-12)
        np.testing.assert_allclose(s[3:-1:4], s[4::4], atol=1e-12)

    def test_bad_speed_fraction_stops(self):
        rows = run([1.0, 1.0, np.nan, np.nan, np.nan])
        self.assertEqual(rows[-1, 1], 0.0)
        self.assertEqual(rows[-1, 0], rows[-4, 0])

    def test_stands_still_at_zero(self):
        rows = run([0.0] * 5)
        np.testing.assert_array_equal(rows[:, 0], 0)
        np.testing.assert_array_equal(rows[:, 9:], 0)

    def test_parts(self):
        dut = make_program()
        context = dut.CreateDefaultContext()
        set_progress(context, [1.7, 0.9, 2.0, 0.0])
        context.SetTime(0.003)
        motion = dut.GetOutputPort("motion_commanded").Eval(context)
        for i, name in enumerate(("position", "velocity", "acceleration")):
            np.testing.assert_array_equal(
                dut.GetOutputPort(f"{name}_commanded").Eval(context),
                motion[6 * i : 6 * i + 6],
            )

    def read_registers(self, dut, context):
        closed, placed, done = (
            dut.GetOutputPort(name).Eval(context)[0]
            for name in ("gripper_closed", "products_placed", "task_done")
        )
        carried = dut.GetOutputPort("carried_objects").Eval(context)
        np.testing.assert_array_equal(
            carried, mut.list_places(10)[int(2 * placed + closed)]
        )
        return [closed, placed, done]

    def update_at(self, progress, fraction=1.0, period=0.008):
        """Returns the registers after a tick, one period after the last."""
        dut = make_program(period)
        context = dut.CreateDefaultContext()
        set_progress(context, [*progress, 0.0])
        context.SetTime(period)
        dut.GetInputPort("speed_fraction").FixValue(context, [fraction])
        context.SetDiscreteState(dut.EvalUniquePeriodicDiscreteUpdate(context))
        return self.read_registers(dut, context)

    def test_registers(self):
        dut = make_program()
        path = dut.path
        context = dut.CreateDefaultContext()
        self.assertEqual(self.read_registers(dut, context), [0, 0, 0])
        for s, expected in (
            (0.01, [0, 0, 0]),
            (path.close_time[0] - 1e-6, [0, 0, 0]),
            (path.close_time[0] + 1e-6, [1, 0, 0]),
            (path.open_time[0] - 1e-6, [1, 0, 0]),
            (path.open_time[0] + 1e-6, [0, 1, 0]),
            (path.open_time[9] + 1e-6, [0, 10, 0]),
            (path.duration - 1e-6, [0, 10, 0]),
            (path.duration + 1e-6, [0, 10, 1]),
        ):
            for rate in (0.3, 1.0):
                self.assertEqual(
                    self.update_at([s - 0.008 * rate, rate, 0.0]), expected
                )

    def test_registers_are_those_of_a_robot_that_stops(self):
        """The last tick of a stop moves the robot on, too."""
        path = make_program().path
        for s, expected in (
            (path.close_time[2], [1, 2, 0]),
            (path.open_time[2], [0, 3, 0]),
            (path.duration, [0, 10, 1]),
        ):
            # From full rate to none within the tick: half a tick's way.
            progress = [s - 0.004 + 1e-6, 1.0, -1.0 / 0.008]
            for fraction in (0.0, 1.0):
                self.assertEqual(self.update_at(progress, fraction), expected)

    def test_registers_in_simulator(self):
        """At each tick they are those of the path time that was reached."""
        for period in (0.002, 0.016):
            dut = make_program(period)
            path = dut.path
            simulator = Simulator(dut)
            context = simulator.get_mutable_context()
            dut.GetInputPort("speed_fraction").FixValue(context, [1.0])
            seen = []
            for k in range(1, 300):
                simulator.AdvanceTo(0.031 * k)
                s = get_progress(context)[0]
                registers = self.read_registers(dut, context)
                self.assertEqual(
                    registers,
                    [
                        path.calc_gripper_closed(s),
                        path.calc_products_placed(s),
                        0,
                    ],
                )
                seen.append(tuple(registers))
            self.assertEqual(
                sorted(set(seen)), [(0, 0, 0), (0, 1, 0), (1, 0, 0), (1, 1, 0)]
            )

    def test_tick_must_last(self):
        for period in (0.0, -0.008, np.nan, np.inf):
            with self.assertRaisesRegex(UserError, "period"):
                make_program(period)

    def test_in_simulator(self):
        """Half speed takes twice the time, up to the first tick's ramp."""
        dut = make_program()
        simulator = Simulator(dut)
        context = simulator.get_mutable_context()
        dut.GetInputPort("speed_fraction").FixValue(context, [0.5])
        simulator.AdvanceTo(1.0)
        # The tick at 1.0 s is still to come.
        s, rate, _ = mut.advance_path_time(get_progress(context), 1.0, 0.008)
        self.assertAlmostEqual(s, 0.5 - 0.25 * 0.008, places=9)
        self.assertAlmostEqual(rate, 0.5)

    def test_stays_at_the_end(self):
        dut = make_program()
        context = dut.CreateDefaultContext()
        end = dut.path.duration
        set_progress(context, [end - 0.001, 1.0, 0.0, 0.0])
        context.SetTime(0.008)
        dut.GetInputPort("speed_fraction").FixValue(context, [1.0])
        state = dut.EvalUniquePeriodicDiscreteUpdate(context)
        self.assertEqual(state.value(0)[0], end)
