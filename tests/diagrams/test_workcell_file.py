"""What stands around the arm is a file of the user's."""

import contextlib
import pathlib
import tempfile
import unittest

from pydrake.geometry import SceneGraph

from tofssm_drake.arms.cell_plant import make_cell_plant
from tofssm_drake.diagrams.run_metadata import make_run_metadata
from tofssm_drake.diagrams.scenario import load_scenario
from tofssm_drake.diagrams.station import make_station
from tofssm_drake.errors import UserError

_TABLE = """
<robot name="bench">
  <link name="top">
    <visual>
      <origin xyz="0.6 0 0.5"/>
      <geometry><box size="0.4 1.0 1.0"/></geometry>
    </visual>
    <collision>
      <origin xyz="0.6 0 0.5"/>
      <geometry><box size="0.4 1.0 1.0"/></geometry>
    </collision>
  </link>
</robot>
"""

_DIRECTIVES = """
directives:
- add_model: {name: work_bench, file: "package://my_cell/bench.urdf"}
- add_weld: {parent: world, child: work_bench::top}
"""

_SCENARIO = """
Mine:
  workcell: cell.dmd.yaml
  task: &task !Waypoints
    waypoints:
      - {joints: [0.0, -1.5, 1.5, -1.5, -1.5, 0.0], speed: 0.3}
      - {joints: [0.5, -1.5, 1.5, -1.5, -1.5, 0.0], speed: 0.3}
Falls:
  workcell: bench.urdf
  task: *task
Gone:
  workcell: nowhere.dmd.yaml
"""


class TestWorkcellFile(unittest.TestCase):
    def setUp(self):
        folder = tempfile.TemporaryDirectory()
        self.addCleanup(folder.cleanup)
        self.folder = pathlib.Path(folder.name).resolve()
        for name, text in (
            ("bench.urdf", _TABLE),
            ("cell.dmd.yaml", _DIRECTIVES),
            ("package.xml", "<package><name>my_cell</name></package>"),
            ("mine.yaml", _SCENARIO),
        ):
            (self.folder / name).write_text(text)

    def load(self, name):
        return load_scenario(filename=self.folder / "mine.yaml", name=name)

    def test_beside_the_scenario(self):
        scenario = self.load("Mine")
        self.assertEqual(scenario.workcell, str(self.folder / "cell.dmd.yaml"))
        plan = make_run_metadata(scenario, make_station(scenario), [])["plan"]
        (bench,) = plan["outlines"]
        self.assertEqual(bench["label"], "work bench")
        for corner, expected in zip(
            bench["outline"],
            ([0.4, -0.5], [0.8, -0.5], [0.8, 0.5], [0.4, 0.5]),
            strict=True,
        ):
            self.assertAlmostEqual(corner[0], expected[0])
            self.assertAlmostEqual(corner[1], expected[1])

    def test_what_is_not_fixed(self):
        with self.assertRaisesRegex(
            UserError, "workcell: .*bench.urdf: bench::top could move; weld it"
        ):
            make_station(self.load("Falls"))

    def test_no_such_file(self):
        with self.assertRaisesRegex(
            UserError, f"workcell: there is no file {self.folder}/nowhere"
        ):
            self.load("Gone")

    def test_what_is_no_model(self):
        (self.folder / "cell.dmd.yaml").write_text("directives: [what: {}]")
        with self.assertRaisesRegex(UserError, "^workcell: .*cell.dmd.yaml: "):
            make_cell_plant(
                workcell=self.load("Mine").workcell, scene_graph=SceneGraph()
            )

    def test_paths_of_other_choices(self):
        (self.folder / "mine.yaml").write_text(
            "Mine:\n  people: {guest: !BvhRecording {filename: walk.bvh}}\n"
        )
        scenario = self.load("Mine")
        self.assertEqual(
            scenario.people["guest"].filename, str(self.folder / "walk.bvh")
        )

    def test_text_is_relative_to_the_current_folder(self):
        guest = "!BvhRecording {filename: walk.bvh}"
        text = f"{{people: {{visitor: null, guest: {guest}}}}}"
        with contextlib.chdir(self.folder):
            scenario = load_scenario(text=text)
        self.assertEqual(
            scenario.people["guest"].filename, str(self.folder / "walk.bvh")
        )
