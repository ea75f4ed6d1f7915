import dataclasses as dc
import json
from pathlib import Path
import tempfile
import unittest

import yaml

from tofssm_drake.diagrams import drivers
from tofssm_drake.diagrams.drivers import find_real_cell
import tofssm_drake.diagrams.scenario as mut
from tofssm_drake.diagrams.station import make_station
from tofssm_drake.errors import UserError
from tofssm_drake.people.bvh import BvhRecording
from tofssm_drake.people.walk import GeneratedWalk
from tofssm_drake.scripts.simulate import override

_FILE = """
_slow: &slow
  speed: 0.9
Cell:
  random_seed: 4
  sensors:
    wrist: !Ring
      parent: ur10::tool0
      count: 16
      dead_sensors: [3]
  people:
    visitor: !GeneratedWalk
      <<: *slow
      stature: 1.6
  law:
    configuration: vr
    C_dC: 0.4
Empty: {}
Nobody:
  people: {}
"""


class TestLoad(unittest.TestCase):
    def setUp(self):
        folder = tempfile.TemporaryDirectory()
        self.addCleanup(folder.cleanup)
        self.filename = Path(folder.name) / "cell.yaml"
        self.filename.write_text(_FILE)

    def load(self, name="Cell", text=""):
        return mut.load_scenario(filename=self.filename, name=name, text=text)

    def test_each_name_stands_for_one_thing(self):
        for text, says in (
            (
                "{obstacles: {visitor: {waypoints: [[1.6, 1.0]]}}}",
                r"obstacles\.visitor: 'visitor' is people\.visitor already",
            ),
            (
                "{people: {tool: !GeneratedWalk {}}}",
                r"people\.tool: 'tool' is sensors\.tool already",
            ),
            (
                "{people: {scene_graph: !GeneratedWalk {}}}",
                r"people\.scene_graph: .* is a part of every cell already",
            ),
        ):
            with self.subTest(text), self.assertRaisesRegex(UserError, says):
                mut.load_scenario(text=text)

    def test_a_step_too_short_to_go_on(self):
        with self.assertRaisesRegex(
            UserError, r"driver\.time_step: must be from 0\.00001"
        ):
            mut.load_scenario(text="{driver: {time_step: 1.0e-12}}")

    def test_every_scenario_starts_from_the_default(self):
        default = mut.load_scenario()
        self.assertEqual(list(default.sensors), ["base", "elbow", "tool"])
        self.assertEqual(list(default.people), ["visitor"])
        plain = dc.replace(default, sensors={}, people={})
        self.assertEqual(plain, mut.Scenario())
        self.assertEqual(self.load("Empty"), default)

    def test_names_are_in_the_files_order(self):
        self.assertEqual(
            mut.list_scenarios(self.filename), ["Cell", "Empty", "Nobody"]
        )
        self.assertEqual(mut.list_scenarios()[0], "Default")

    def test_file_overrides_defaults(self):
        scenario = self.load()
        self.assertEqual(scenario.random_seed, 4)
        # The paper's rings are not among them.
        self.assertEqual(list(scenario.sensors), ["wrist"])
        self.assertEqual(scenario.sensors["wrist"].count, 16)
        self.assertEqual(
            scenario.people["visitor"], GeneratedWalk(speed=0.9, stature=1.6)
        )
        self.assertEqual(scenario.law.configuration, "vr")
        self.assertEqual(scenario.law.C_dC, 0.4)
        self.assertEqual(scenario.law.T_stop, mut.Scenario().law.T_stop)
        self.assertEqual(scenario.task, mut.Scenario().task)

    def test_text_overrides_file_and_keeps_the_rest(self):
        scenario = self.load(
            text="{random_seed: 5, law: {C_dC: 0.5}, "
            "people: {visitor: {speed: 1.5}}}"
        )
        self.assertEqual(scenario.random_seed, 5)
        self.assertEqual(scenario.law.C_dC, 0.5)
        self.assertEqual(scenario.law.configuration, "vr")
        self.assertEqual(
            scenario.people["visitor"], GeneratedWalk(speed=1.5, stature=1.6)
        )
        self.assertEqual(scenario.sensors["wrist"].count, 16)

    def test_text_changes_sensors_by_name(self):
        scenario = self.load(
            text="{sensors: {wrist: {radius: 0.05, sensor: {dropout: 0.1}}, "
            "low: !PlanarLidar {sensor: {period: 0.05}}}}"
        )
        self.assertEqual(list(scenario.sensors), ["wrist", "low"])
        wrist = scenario.sensors["wrist"]
        self.assertEqual((wrist.count, wrist.radius), (16, 0.05))
        self.assertEqual(wrist.dead_sensors, [3])
        self.assertEqual(wrist.sensor.dropout, 0.1)
        scenario = mut.change_scenario(
            scenario, "{sensors: {low: {housing: [pedestal]}}}", source="text"
        )
        self.assertEqual(scenario.sensors["low"].housing, ["pedestal"])
        self.assertEqual(scenario.sensors["low"].sensor.period, 0.05)

    def test_keys_of_before_name_the_new_one(self):
        for text, new in (
            ("sensing: lidar", "sensors, as in the scenarios MotionCapture"),
            ("sensors_per_ring: 16", "sensors.<ring>.count"),
            ("rings: {readout_time: 0.1}", "sensors.<ring>.sensor"),
            ("dead_sensors: {tool: [1]}", "sensors.<ring>.dead_sensors"),
        ):
            key = text.partition(":")[0]
            with (
                self.subTest(key),
                self.assertRaisesRegex(
                    UserError, f"--scenario-text:1: {key}: is now {new}"
                ),
            ):
                self.load(text=text)

    def test_sensors_are_checked(self):
        for text, message in (
            ("{x: {count: 3}}", "sensors.x.parent: name the frame"),
            ("{wrist: {count: 65}}", "sensors.wrist.count: 65 is out of range"),
            ("{wrist: {count: 3}}", r"wrist.dead_sensors: \[3\] must be diff"),
            ("{a b: {parent: tool0}}", "sensors: 'a b' must be a name"),
            ("{x: !Radar {}}", "sensors.x: unknown kind !Radar; one of !Ring"),
            (
                "{m: !MotionCapture {links: {wrist: {parent: tool0}}}}",
                "sensors.m: another sensor has a link called 'wrist'",
            ),
            ("{m: !MotionCapture {}}", "sensors.m.links: name what it watches"),
            ("{m: !PlanarLidar {parent: ''}}", "sensors.m.parent: name a fr"),
        ):
            with self.subTest(text), self.assertRaisesRegex(UserError, message):
                self.load(text=f"sensors: {text}")
        with self.assertRaisesRegex(UserError, "sensors: there is none"):
            mut.Scenario().check()

    def test_text_changes_the_kind_of_person(self):
        self.assertEqual(self.load(text="people: {visitor: null}").people, {})
        self.assertEqual(
            self.load("Nobody", text="people: {a: !GeneratedWalk {}}").people,
            {"a": GeneratedWalk()},
        )

    def test_options_override_text(self):
        scenario = self.load(
            text="{random_seed: 5, law: {configuration: sm, C_dC: 0.5}, "
            "simulation_duration: 7}"
        )
        override(scenario)
        self.assertEqual(scenario.random_seed, 5)
        self.assertEqual(scenario.simulation_duration, 7.0)
        override(
            scenario,
            ssm="vo",
            human_motion=Path("walk.bvh"),
            seed=0,
            duration=3.0,
        )
        self.assertEqual(scenario.random_seed, 0)
        self.assertEqual(scenario.law.configuration, "vo")
        self.assertEqual(scenario.law.C_dC, 0.5)
        self.assertEqual(scenario.simulation_duration, 3.0)
        self.assertEqual(
            scenario.people["visitor"], BvhRecording(filename="walk.bvh")
        )

    def test_option_keeps_the_recordings_other_settings(self):
        scenario = self.load(
            text="people: {visitor: "
            "!BvhRecording {filename: a.bvh, placement: own_path}}"
        )
        override(scenario, human_motion=Path("b.bvh"))
        self.assertEqual(
            scenario.people["visitor"],
            BvhRecording(filename="b.bvh", placement="own_path"),
        )

    def test_options_are_checked(self):
        with self.assertRaisesRegex(UserError, "--seed: -1"):
            override(self.load(), seed=-1)

    def test_two_loads_share_nothing(self):
        one, other = self.load(), self.load()
        one.sensors["wrist"].dead_sensors[0] = 1
        one.law.C_dC = 9.0
        self.assertEqual(other.sensors["wrist"].dead_sensors, [3])
        self.assertEqual(other.law.C_dC, 0.4)


class TestDriver(unittest.TestCase):
    def test_a_simulated_cell_has_the_defaults_of_a_ur(self):
        self.assertEqual(
            find_real_cell(mut.load_scenario().driver), drivers.Rtde()
        )

    def test_a_real_robot_is_not_simulated(self):
        scenario = mut.load_scenario()
        for driver in (drivers.Rtde(), drivers.CustomDriver()):
            scenario.driver = driver
            self.assertIs(find_real_cell(driver), driver)
            with self.assertRaisesRegex(UserError, "is a real robot"):
                make_station(scenario)

    def test_mistakes_of_kind_cost_one_line(self):
        for text, message in (
            (
                "{driver: !Arm {}}",
                "driver: unknown kind !Arm; one of !Simulated, !Rtde, !Cust",
            ),
            ("{driver: !!python/x {}}", "driver: unknown kind !!python/x; one"),
            ("{driver: {kind: Arm}}", "driver: unknown kind !Arm; one of"),
            ("{driver: Rtde}", "driver: must be a mapping"),
            ("{driver: !Rtde}", "a kind needs its settings: !Kind {}"),
            ("driver: !Rtde", "driver: must be a mapping .*; write !Rtde {}"),
            ("{mask: !Arm {}}", "mask: takes no kind, but has !Arm"),
            ("{mask: !!x {}}", "mask: takes no kind, but has !!x"),
            (
                "{driver: {robot: {host: a}}}",
                "driver.robot: unknown key; it is one of !Rtde, not of !Simul",
            ),
        ):
            with (
                self.subTest(text),
                self.assertRaisesRegex(UserError, f"^--scenario.*{message}"),
            ):
                mut.load_scenario(text=text)


class TestDump(unittest.TestCase):
    def setUp(self):
        folder = tempfile.TemporaryDirectory()
        self.addCleanup(folder.cleanup)
        self.filename = Path(folder.name) / "cell.yaml"

    def test_what_is_dumped_loads_as_the_same(self):
        for name, text in (
            *((name, "") for name in mut.list_scenarios()),
            (
                "Default",
                "{people: {visitor: {figure_eight: {centre: [1.2, 1e-3]}}}}",
            ),
            ("Default", "{law: {configuration: sm}, random_seed: 4294967295}"),
            (
                "Default",
                "{people: {visitor: !BvhRecording {filename: a, end_time: 3}}}",
            ),
            ("Default", "{driver: !Rtde {}}"),
            (
                "Default",
                "{driver: !Rtde {rings: [virtual], slider: {operator_limit: "
                "0.5}, robot: {host: there}}}",
            ),
            (
                "Default",
                "{sensors: {tool: {sensor: {wrap_probability: 1.0e-9}}}}",
            ),
        ):
            with self.subTest(name=name, text=text):
                scenario = mut.load_scenario(name=name, text=text)
                values = mut.dump_scenario(scenario)
                # As in summary.json, and as in the samples' metadata.
                for written in (
                    json.dumps(values, allow_nan=False),
                    yaml.safe_dump(values),
                ):
                    self.filename.write_text(json.dumps({"X": values}))
                    again = mut.load_scenario(filename=self.filename, name="X")
                    self.assertEqual(again, scenario)
                    again = mut.change_scenario(
                        mut.Scenario(), written, source="text"
                    )
                    self.assertEqual(again, scenario)

    def test_every_setting_is_written_out(self):
        values = mut.dump_scenario(mut.Scenario())
        self.assertEqual(set(values), set(vars(mut.Scenario())))
        values = mut.dump_scenario(mut.load_scenario())
        self.assertEqual(values["people"]["visitor"]["kind"], "GeneratedWalk")
        self.assertEqual(values["sensors"]["tool"]["kind"], "Ring")
        self.assertEqual(values["law"]["C_dC"], 0.3)


class TestCheck(unittest.TestCase):
    def test_time_step_has_to_fit_the_tick(self):
        for text in (
            "{driver: {time_step: 0.005}}",
            "{control_period: 0.002}",
            "{control_period: 0.002, driver: {time_step: 0.004}}",
        ):
            with self.subTest(text=text):
                with self.assertRaisesRegex(UserError, "driver.time_step"):
                    mut.load_scenario(text=text)
        mut.load_scenario(
            text="{control_period: 0.002, driver: {time_step: 0.001}}"
        )


class TestWhereAMistakeIs(unittest.TestCase):
    """File and scenario, or the text that changes it, is to blame."""

    def load(self, content, text=""):
        with tempfile.TemporaryDirectory() as folder:
            path = Path(folder) / "mine.yaml"
            path.write_text(content)
            with self.assertRaises(UserError) as caught:
                mut.load_scenario(filename=path, name="Mine", text=text)
        return str(caught.exception)

    def test_in_the_file(self):
        wrong = "Mine: {simulation_duration: -1}"
        for text in ("", "{random_seed: 3}"):
            said = self.load(wrong, text)
            self.assertRegex(said, r"mine\.yaml: Mine: simulation_duration: ")

    def test_in_the_text(self):
        said = self.load("Mine: {random_seed: 3}", "{simulation_duration: -1}")
        self.assertRegex(said, r"^--scenario-text: simulation_duration: ")

    def test_what_the_file_alone_lacks_the_text_may_give(self):
        with tempfile.TemporaryDirectory() as folder:
            path = Path(folder) / "mine.yaml"
            path.write_text("Mine: {simulation_duration: -1}")
            scenario = mut.load_scenario(
                filename=path, name="Mine", text="{simulation_duration: 2}"
            )
        self.assertEqual(scenario.simulation_duration, 2.0)

    def test_a_path_may_be_a_text(self):
        scenario = mut.load_scenario(filename=str(mut.find_default_scenarios()))
        self.assertEqual(scenario, mut.load_scenario())
