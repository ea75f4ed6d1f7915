import json
from pathlib import Path
import tempfile
import unittest

import yaml

import tofssm_drake.diagrams.scenario as mut
from tofssm_drake.errors import UserError
from tofssm_drake.people.bvh import BvhRecording
from tofssm_drake.people.walk import GeneratedWalk
from tofssm_drake.scripts.simulate import override

_FILE = """
_slow: &slow
  speed: 0.9
Cell:
  random_seed: 4
  sensors_per_ring: 16
  ring_phases: [0.0, 0.008, 0.016]
  human: !GeneratedWalk
    <<: *slow
    stature: 1.6
  law:
    configuration: vr
    C_dC: 0.4
Empty: {}
Nobody:
  human: !NoHuman {}
"""


class TestLoad(unittest.TestCase):
    def setUp(self):
        folder = tempfile.TemporaryDirectory()
        self.addCleanup(folder.cleanup)
        self.filename = Path(folder.name) / "cell.yaml"
        self.filename.write_text(_FILE)

    def load(self, name="Cell", text=""):
        return mut.load_scenario(filename=self.filename, name=name, text=text)

    def test_defaults_are_those_of_the_dataclass(self):
        self.assertEqual(mut.load_scenario(), mut.Scenario())
        self.assertEqual(self.load("Empty"), mut.Scenario())

    def test_names_are_in_the_files_order(self):
        self.assertEqual(
            mut.list_scenarios(self.filename), ["Cell", "Empty", "Nobody"]
        )
        self.assertEqual(mut.list_scenarios()[0], "Default")

    def test_file_overrides_defaults(self):
        scenario = self.load()
        self.assertEqual(scenario.random_seed, 4)
        self.assertEqual(scenario.sensors_per_ring, 16)
        self.assertEqual(scenario.ring_phases, [0.0, 0.008, 0.016])
        self.assertEqual(scenario.human, GeneratedWalk(speed=0.9, stature=1.6))
        self.assertEqual(scenario.law.configuration, "vr")
        self.assertEqual(scenario.law.C_dC, 0.4)
        self.assertEqual(scenario.law.T_stop, mut.Scenario().law.T_stop)
        self.assertEqual(scenario.program, mut.Scenario().program)

    def test_text_overrides_file_and_keeps_the_rest(self):
        scenario = self.load(
            text="{random_seed: 5, law: {C_dC: 0.5}, human: {speed: 1.5}}"
        )
        self.assertEqual(scenario.random_seed, 5)
        self.assertEqual(scenario.law.C_dC, 0.5)
        self.assertEqual(scenario.law.configuration, "vr")
        self.assertEqual(scenario.human, GeneratedWalk(speed=1.5, stature=1.6))
        self.assertEqual(scenario.sensors_per_ring, 16)

    def test_text_changes_the_kind_of_person(self):
        self.assertEqual(
            self.load(text="human: !NoHuman {}").human, mut.NoHuman()
        )
        self.assertEqual(
            self.load("Nobody", text="human: !GeneratedWalk {}").human,
            GeneratedWalk(),
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
            sensors_per_ring=8,
            human_motion=Path("walk.bvh"),
            seed=0,
            duration=3.0,
        )
        self.assertEqual(scenario.random_seed, 0)
        self.assertEqual(scenario.law.configuration, "vo")
        self.assertEqual(scenario.law.C_dC, 0.5)
        self.assertEqual(scenario.sensors_per_ring, 8)
        self.assertEqual(scenario.simulation_duration, 3.0)
        self.assertEqual(scenario.human, BvhRecording(filename="walk.bvh"))

    def test_option_keeps_the_recordings_other_settings(self):
        scenario = self.load(
            text="human: !BvhRecording {filename: a.bvh, placement: own_path}"
        )
        override(scenario, human_motion=Path("b.bvh"))
        self.assertEqual(
            scenario.human,
            BvhRecording(filename="b.bvh", placement="own_path"),
        )

    def test_options_are_checked(self):
        with self.assertRaisesRegex(UserError, "--seed: -1"):
            override(self.load(), seed=-1)

    def test_two_loads_share_nothing(self):
        one, other = self.load(), self.load()
        one.ring_phases[0] = 1.0
        one.law.C_dC = 9.0
        self.assertEqual(other.ring_phases[0], 0.0)
        self.assertEqual(other.law.C_dC, 0.4)


class TestDump(unittest.TestCase):
    def test_what_is_dumped_loads_as_the_same(self):
        for name, text in (
            *((name, "") for name in mut.list_scenarios()),
            ("Default", "{human: {figure_eight: {centre: [1.2, 1e-3]}}}"),
            ("Default", "{law: {configuration: sm}, random_seed: 4294967295}"),
            ("Default", "{human: !BvhRecording {filename: a, end_time: 3}}"),
            ("Default", "{rings: {sensor: {wrap_probability: 1.0e-9}}}"),
        ):
            with self.subTest(name=name, text=text):
                scenario = mut.load_scenario(name=name, text=text)
                values = mut.dump_scenario(scenario)
                # As in summary.json, and as in the samples' metadata.
                for written in (
                    json.dumps(values, allow_nan=False),
                    yaml.safe_dump(values),
                ):
                    again = mut.load_scenario(text=written)
                    self.assertEqual(again, scenario)
                    self.assertEqual(type(again.human), type(scenario.human))

    def test_every_setting_is_written_out(self):
        values = mut.dump_scenario(mut.Scenario())
        self.assertEqual(set(values), set(vars(mut.Scenario())))
        self.assertEqual(values["human"]["kind"], "GeneratedWalk")
        self.assertEqual(values["law"]["C_dC"], 0.3)
        values = mut.dump_scenario(mut.Scenario(human=mut.NoHuman()))
        self.assertEqual(values["human"], {"kind": "NoHuman"})


class TestCheck(unittest.TestCase):
    def test_time_step_has_to_fit_the_tick(self):
        for text in (
            "{robot: {time_step: 0.005}}",
            "{control_period: 0.002}",
            "{control_period: 0.002, robot: {time_step: 0.004}}",
        ):
            with self.subTest(text=text):
                with self.assertRaisesRegex(UserError, "robot.time_step"):
                    mut.load_scenario(text=text)
        mut.load_scenario(
            text="{control_period: 0.002, robot: {time_step: 0.001}}"
        )
