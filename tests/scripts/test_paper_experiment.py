"""The scenarios of the paper's cells."""

import unittest

from paper_cell import change_rings

from tofssm_drake.diagrams.campaign_run import make_run_scenario
from tofssm_drake.diagrams.scenario import (
    dump_scenario,
    find_threshold_offsets,
    load_scenario,
)
from tofssm_drake.diagrams.sensors import MotionCapture
from tofssm_drake.laws.config import CONFIGURATIONS
from tofssm_drake.paper.cells import SENSINGS, VARIANTS, Cell
import tofssm_drake.scripts.paper_experiment as mut
from tofssm_drake.studies.campaign import PlannedRun
from tofssm_drake.studies.trials import make_trial


def make_run(sensing="tof", configuration="vo", variant="", number=1):
    return PlannedRun(
        cell=Cell(
            sensing=sensing, configuration=configuration, variant=variant
        ),
        trial=make_trial(0, number),
    )


def make_scenario(base, run):
    """Returns the scenario of a run of the paper's experiment."""
    return make_run_scenario(mut.make_cell_scenario(base, run.cell), run.trial)


class TestScenario(unittest.TestCase):
    def setUp(self):
        self.base = load_scenario()

    def test_every_cell_makes_a_checked_scenario(self):
        before = dump_scenario(self.base)
        for sensing in SENSINGS:
            for configuration in CONFIGURATIONS:
                cell = mut.make_cell_scenario(
                    self.base, make_run(sensing, configuration).cell
                )
                self.assertEqual(cell.law.configuration, configuration)
                for number in range(1, 20):
                    trial = make_trial(0, number)
                    scenario = make_run_scenario(cell, trial)
                    scenario.check()
                    self.assertEqual(scenario.random_seed, trial.seed)
        self.assertEqual(dump_scenario(self.base), before)

    def test_sensing(self):
        for sensing, expected in (
            ("tof", "Default"),
            ("tof16", "SixteenSensors"),
            ("ideal", "MotionCapture"),
            ("lidar", "PlanarLidar"),
        ):
            scenario = make_scenario(self.base, make_run(sensing))
            self.assertEqual(
                scenario.sensors, load_scenario(name=expected).sensors
            )

    def test_changed_rings_are_those_of_the_cells(self):
        base = load_scenario(text=change_rings("{sensor: {dropout: 0.1}}"))
        for sensing, count in (("tof", 8), ("tof16", 16)):
            scenario = make_scenario(base, make_run(sensing))
            for ring in scenario.sensors.values():
                self.assertEqual(ring.count, count)
                self.assertEqual(ring.sensor.dropout, 0.1)

    def test_the_papers_table(self):
        for sensing, expected in (
            ("tof", (0.3, 0.5, 1.1)),
            ("ideal", (0.3, 0.5, 1.1)),
            ("lidar", (1.12, 1.32, 1.92)),
        ):
            scenario = make_scenario(self.base, make_run(sensing))
            law = scenario.law.grow(find_threshold_offsets(scenario)[0])
            self.assertEqual((law.C_dC, law.d_C_sm, law.d_R_sm), expected)
            self.assertEqual((law.T_red, law.T_stop, law.T_R), (0.4, 0.4, 0.1))
            self.assertEqual((law.alpha_I, law.alpha_D), (0.3, 0.8))

    def test_the_same_person_in_every_cell(self):
        people = [
            dump_scenario(make_scenario(self.base, make_run(s, c)))["people"][
                "visitor"
            ]
            for s in SENSINGS
            for c in CONFIGURATIONS
        ]
        self.assertTrue(all(person == people[0] for person in people))
        trial = make_trial(0, 1)
        self.assertEqual(people[0]["speed"], trial.speed)
        self.assertEqual(people[0]["figure_eight"]["start"], trial.start)
        self.assertAlmostEqual(
            people[0]["figure_eight"]["centre"][0], 1.15 + trial.centre[0]
        )

    def test_every_variant_changes_something(self):
        for variant in VARIANTS.values():
            for sensing in variant.sensings:
                for configuration in variant.configurations:
                    run = make_run(sensing, configuration, variant.key)
                    changed = make_scenario(self.base, run)
                    plain = make_scenario(
                        self.base, make_run(sensing, configuration)
                    )
                    self.assertNotEqual(
                        dump_scenario(changed), dump_scenario(plain)
                    )
                    # A late sample must not be taken for a lost one.
                    for sensor in changed.sensors.values():
                        if isinstance(sensor, MotionCapture):
                            self.assertGreaterEqual(
                                changed.law.deadline, sensor.latency + 0.1
                            )

    def test_nobody_there(self):
        run = PlannedRun(cell=make_run("lidar", "sm").cell)
        scenario = make_scenario(self.base, run)
        self.assertEqual(scenario.people, {})
        self.assertEqual(list(scenario.sensors), ["lidar"])


if __name__ == "__main__":
    unittest.main()
