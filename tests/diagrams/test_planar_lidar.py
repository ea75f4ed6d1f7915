"""The lidar under the robot of the real cell."""

import numpy as np
from pydrake.systems.framework import DiagramBuilder
import pytest

from tofssm_drake.arms.kinematics import ArmKinematics
from tofssm_drake.diagrams.monitor import make_monitor, make_twin
from tofssm_drake.diagrams.scenario import load_scenario
import tofssm_drake.diagrams.sensors.planar_lidar as mut
from tofssm_drake.errors import UserError
from tofssm_drake.metrics.ground_truth import TruthModel
from tofssm_drake.perception.twin import TwinPoses
from tofssm_drake.poses import Pose
from tofssm_drake.raycast.ray_caster import RayCaster
from tofssm_drake.sensors.lidar_2d import calc_lidar_angles
from tofssm_drake.tasks.program import make_program_path


class Cell:
    def __init__(self):
        self.scenario = load_scenario(name="PlanarLidar")
        twin = make_twin(DiagramBuilder(), self.scenario)
        self.lidar = self.scenario.sensors["lidar"]
        self.config = self.lidar.sensor
        self.scene_graph = twin.scene_graph
        self.plant = twin.plant
        self.kinematics = twin.kinematics
        inspector = self.scene_graph.model_inspector()
        self.caster = RayCaster(inspector)
        self.bundle = mut.make_bundle(
            "lidar", self.lidar, self.caster, self.plant, inspector
        )
        self.twin = TwinPoses.from_plant(
            self.plant,
            objects=twin.objects,
            frame_ids=self.caster.frame_ids,
            kinematics=self.kinematics,
        )
        self.path = make_program_path(self.scenario.task, self.kinematics)

    def scan(self, s=0.0, carried=None):
        """Casts the rays as the cell is at a path time."""
        if carried is None:
            carried = self.path.carried[0]
        X_WF = self.twin.calc(self.path.calc_motion(s)[0], carried)
        return self.caster.cast_bundles(self.bundle, X_WF)[0][0]


@pytest.fixture(scope="module")
def cell():
    return Cell()


def test_background_is_the_tables_legs(cell):
    background = mut.scan_background(
        caster=cell.caster,
        bundle=cell.bundle,
        twin=cell.twin,
        postures=[cell.path.calc_motion(0.0)[0]],
        margin=0.05,
        where="here",
    )
    angles = calc_lidar_angles(cell.config)
    seen = np.isfinite(background)
    assert 20 < seen.sum() < 200
    x = background[seen] * np.cos(angles[seen])
    y = background[seen] * np.sin(angles[seen])
    # Legs of 0.05 m at the corners of tables at y = -0.82 and 0.82.
    corners = np.array(
        [
            (a, b + c)
            for a in (-0.36, 0.36)
            for b in (-0.82, 0.82)
            for c in (-0.26, 0.26)
        ]
    )
    off = np.abs(np.stack([x, y], axis=1)[:, None] - corners).max(axis=2)
    assert off.min(axis=1).max() < 0.025 + 1e-9


def test_the_robot_never_enters_the_plane(cell):
    """Otherwise it would take itself for a person."""
    background = cell.scan()
    for s in np.linspace(0.0, cell.path.duration, 40):
        carried = cell.path.calc_carried_objects(s)
        np.testing.assert_array_equal(cell.scan(s, carried), background)


@pytest.mark.parametrize(("offset", "expected"), [(0.0, 0.5), (0.82, 0.0)])
def test_truth_is_from_the_lidar(cell, offset, expected):
    """To a ball of 0.1 m, 1.0 m away, and to one 0.6 m away."""
    dut = TruthModel(
        plant=cell.plant,
        inspector=cell.scene_graph.model_inspector(),
        radii=[0.1, 0.1],
        pelvis=0,
        kinematics=cell.kinematics,
        link_offsets=offset,
    )
    assert dut.layout.num_rings == 1
    far = [*(0.0, 1.0, 0.3) * 2, *(0.0, 0.0, 9.0) * 2]
    near = [*(0.0, 0.0, -9.0) * 2, *(0.0, -0.6, 0.3) * 2]
    truth = dut.calc(
        q=np.zeros((2, 6)), qd=np.zeros((2, 6)), skeleton=np.array([far, near])
    )
    np.testing.assert_allclose(
        truth[:, dut.layout.ring_distance][:, 0],
        [0.9 - offset, expected],
        atol=1e-12,
    )


def test_truth_s_link_stands_where_the_lidar_is(cell):
    dut = cell.kinematics
    assert dut.name == ("lidar",)
    rng = np.random.default_rng(1)
    q, qd = rng.uniform(-2, 2, (2, 6))
    p_WL, R_WL, v_WL = dut.calc(q, qd)
    np.testing.assert_allclose(p_WL, [[0, 0, 0.3]], atol=1e-12)
    np.testing.assert_allclose(R_WL[0], np.eye(3), atol=1e-12)
    np.testing.assert_array_equal(v_WL, np.zeros((1, 3)))
    # The tool is the robot's.
    np.testing.assert_array_equal(
        dut.calc_tcp_pose(q),
        ArmKinematics.from_plant(cell.plant).calc_tcp_pose(q),
    )


def test_a_lidar_inside_of_something_is_an_error(cell):
    lidar = mut.PlanarLidar(X_PS=Pose(translation=[0.0, 0.0, 0.3]), housing=[])
    inspector = cell.scene_graph.model_inspector()
    caster = RayCaster(inspector)
    bundle = mut.make_bundle("lidar", lidar, caster, cell.plant, inspector)
    with pytest.raises(UserError, match="here: the lidar is inside"):
        mut.scan_background(
            caster=caster,
            bundle=bundle,
            twin=cell.twin,
            postures=[cell.path.calc_motion(0.0)[0]],
            margin=0.05,
            where="here",
        )


def test_a_lidar_in_the_robots_reach_is_an_error():
    text = "{sensors: {far: !PlanarLidar {X_PS: {translation: [2, 0, 1.2]}}}}"
    with pytest.raises(
        UserError, match=r"sensors\.far\.X_PS: the robot crosses the lidar's"
    ):
        make_monitor(load_scenario(text=text))


def test_housing_must_be_in_the_cell(cell):
    inspector = cell.scene_graph.model_inspector()
    lidar = mut.PlanarLidar(housing=["cupboard"])
    with pytest.raises(UserError, match="no model 'cupboard'"):
        mut.make_bundle("lidar", lidar, cell.caster, cell.plant, inspector)
