import functools
import unittest

import numpy as np
from paper_cell import RINGS, make_twin_plant
from pydrake.geometry import Role, SceneGraph
from pydrake.multibody.tree import BodyIndex
from pydrake.systems.framework import DiagramBuilder
from pydrake.systems.rendering import MultibodyPositionToGeometryPose
from robots import make_panda

from tofssm_drake.arms.cell_plant import make_cell_plant
from tofssm_drake.arms.kinematics import ArmKinematics
from tofssm_drake.arms.ur_arm import UrArm
from tofssm_drake.errors import UserError
import tofssm_drake.perception.twin as mut
from tofssm_drake.tasks.products import calc_object_positions
from tofssm_drake.tasks.program import (
    PickAndPlace,
    find_products,
    list_places,
    make_program_path,
)


@functools.cache
def make_twin():
    scene_graph = SceneGraph()
    return make_twin_plant(scene_graph), scene_graph


def _calc_positions(*, q, **reported):
    """Returns the positions of the twin's plant."""
    return np.append(q, calc_object_positions(q=q, **reported))


class TestTwin(unittest.TestCase):
    @classmethod
    def setUpClass(cls):
        cls.plant, cls.scene_graph = make_twin()
        cls.kinematics = ArmKinematics.from_plant(cls.plant)
        cls.objects = find_products(PickAndPlace())

    def test_poses_against_plant(self):
        plant = self.plant
        inspector = self.scene_graph.model_inspector()
        frame_ids = list(
            {
                inspector.GetFrameId(geometry_id)
                for geometry_id in inspector.GetAllGeometryIds(Role.kPerception)
            }
        )
        dut = mut.TwinPoses.from_plant(
            plant, objects=self.objects, frame_ids=frame_ids
        )
        context = plant.CreateDefaultContext()
        generator = np.random.default_rng(0)
        for closed, placed in ((0, 0), (1, 0), (1, 4), (0, 5), (1, 9), (0, 10)):
            q = generator.uniform(-3, 3, 6)
            carried = list_places(10)[2 * placed + closed]
            plant.SetPositions(
                context,
                _calc_positions(
                    objects=self.objects,
                    kinematics=self.kinematics,
                    q=q,
                    carried=carried,
                ),
            )
            X_WF = dut.calc(q, carried)
            for i, frame_id in enumerate(frame_ids):
                body = plant.GetBodyFromFrameId(frame_id)
                np.testing.assert_allclose(
                    X_WF[i],
                    plant.EvalBodyPoseInWorld(context, body).GetAsMatrix34(),
                    atol=1e-9,
                )

    def test_frames(self):
        """Checks sensor frames, which belong to no body of their own."""
        plant = self.plant
        frames = [
            plant.GetFrameByName(name)
            for name in ("base_ring_3", "tool_ring_0", "robot_base")
        ]
        dut = mut.TwinPoses.from_plant(
            plant, objects=self.objects, frames=frames
        )
        q = np.linspace(-1, 1, 6)
        context = plant.CreateDefaultContext()
        plant.SetPositions(context, plant.GetModelInstanceByName("ur10"), q)
        X_WF = np.empty((3, 3, 4))
        self.assertIs(dut.calc(q, np.zeros(10), X_WF), X_WF)
        for i, frame in enumerate(frames):
            np.testing.assert_allclose(
                X_WF[i],
                frame.CalcPoseInWorld(context).GetAsMatrix34(),
                atol=1e-9,
            )

    def test_other_arms(self):
        """Checks every frame of a UR5e and of a seven-joint arm."""
        for arm in (UrArm(model="ur5e"), make_panda()):
            scene_graph = SceneGraph()
            plant = make_cell_plant(
                scene_graph=scene_graph, products=10, arm=arm
            )
            frames = [
                plant.get_body(BodyIndex(i)).body_frame()
                for i in range(plant.num_bodies())
            ]
            dut = mut.TwinPoses.from_plant(
                plant, objects=self.objects, frames=frames
            )
            kinematics = ArmKinematics.from_plant(plant)
            context = plant.CreateDefaultContext()
            q = np.linspace(-0.5, 0.4, kinematics.num_joints)
            carried = list_places(10)[7]
            plant.SetPositions(
                context,
                _calc_positions(
                    objects=self.objects,
                    kinematics=kinematics,
                    q=q,
                    carried=carried,
                ),
            )
            for X_WF, frame in zip(dut.calc(q, carried), frames, strict=True):
                np.testing.assert_allclose(
                    X_WF,
                    frame.CalcPoseInWorld(context).GetAsMatrix34(),
                    atol=1e-9,
                )

    def test_foreign_body_is_an_error(self):
        objects = find_products(PickAndPlace(products=3))
        body = self.plant.GetBodyByName(
            "product", self.plant.GetModelInstanceByName("product_5")
        )
        with self.assertRaisesRegex(UserError, "product"):
            mut.TwinPoses.from_plant(
                self.plant, objects=objects, frames=[body.body_frame()]
            )


class TestSensorsAreOutside(unittest.TestCase):
    def test_no_sensor_inside_a_shape(self):
        """Checks over the whole task that no sensor's origin lies inside a
        shape that it could see, its own link apart; products included."""
        builder = DiagramBuilder()
        scene_graph = builder.AddSystem(SceneGraph())
        plant = make_twin_plant(scene_graph, count=16)
        poses = builder.AddSystem(MultibodyPositionToGeometryPose(plant))
        builder.Connect(
            poses.get_output_port(),
            scene_graph.get_source_pose_port(plant.get_source_id()),
        )
        builder.ExportInput(poses.get_input_port(), "positions")
        diagram = builder.Build()
        context = diagram.CreateDefaultContext()
        kinematics = ArmKinematics.from_plant(plant)
        objects = find_products(PickAndPlace())
        path = make_program_path(PickAndPlace(), kinematics)
        frames = [
            plant.GetFrameByName(f"{name}_ring_{j}")
            for name in RINGS
            for j in range(16)
        ]
        twin = mut.TwinPoses.from_plant(plant, objects=objects, frames=frames)
        inspector = scene_graph.model_inspector()
        own = {
            ring: {
                geometry_id
                for body in plant.GetBodiesWeldedTo(
                    plant.GetFrameByName(f"{ring}_ring").body()
                )
                for geometry_id in plant.GetCollisionGeometriesForBody(body)
            }
            for ring in RINGS
        }
        nearest = np.inf
        # One product of each row, the first and the last, densely.
        duration = path.duration
        times = np.concatenate(
            [
                np.arange(
                    path.close_time[i] - 0.8, path.open_time[i] + 0.6, 0.06
                )
                for i in (0, 4, 9)
            ]
        )
        for s in times[(times > 0) & (times < duration)]:
            q = path.calc_motion(s)[0]
            carried = path.calc_carried_objects(s)
            diagram.GetInputPort("positions").FixValue(
                context,
                _calc_positions(
                    objects=objects,
                    kinematics=kinematics,
                    q=q,
                    carried=carried,
                ),
            )
            query = scene_graph.get_query_output_port().Eval(
                scene_graph.GetMyContextFromRoot(context)
            )
            X_WS = twin.calc(q, carried)
            for i in range(len(frames)):
                found = query.ComputeSignedDistanceToPoint(
                    X_WS[i, :, 3], threshold=0.3
                )
                for one in found:
                    if one.id_G not in own[RINGS[i // 16]]:
                        nearest = min(nearest, one.distance)
                        self.assertGreater(
                            one.distance,
                            0.0,
                            (frames[i].name(), inspector.GetName(one.id_G), s),
                        )
        self.assertLess(nearest, 0.3)
