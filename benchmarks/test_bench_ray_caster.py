"""What a scan of 600 rays costs: 24 sensors of 25 rays, 32 shapes."""

import numpy as np
from pydrake.common import MemoryFile
from pydrake.common.value import Value
from pydrake.geometry import (
    Box,
    Capsule,
    Cylinder,
    FramePoseVector,
    GeometryFrame,
    GeometryInstance,
    HalfSpace,
    InMemoryMesh,
    Mesh,
    PerceptionProperties,
    Sphere,
)
from pydrake.math import RigidTransform, RollPitchYaw, RotationMatrix
from pydrake.multibody.plant import AddMultibodyPlantSceneGraph
from pydrake.multibody.tree import (
    FixedOffsetFrame,
    RevoluteJoint,
    SpatialInertia,
)
from pydrake.systems.framework import DiagramBuilder
import pytest

from tofssm_drake.geometry.fan import make_cone_fan
from tofssm_drake.geometry.frame_poses import FramePoses
from tofssm_drake.geometry.ray_caster import RayCaster

SENSORS_PER_RING = 8
RAYS = 25
NEW_STATES = 64


class Cell:
    """A six-joint arm (12 shapes), a person of 16 capsules, 4 static shapes.

    The arm is a plant, the person a source of 17 poses: 24 moving frames.

    Args:
        as_mesh: Turns all round shapes into meshes of 448 triangles each.
    """

    def __init__(self, as_mesh=False):
        self.as_mesh = as_mesh
        builder = DiagramBuilder()
        plant, scene_graph = AddMultibodyPlantSceneGraph(builder, 0.004)
        self.plant, self.scene_graph = plant, scene_graph
        self.bodies = self._add_arm()
        self._add_cell()
        plant.Finalize()
        self._add_person()
        self.diagram = builder.Build()
        context = self.diagram.CreateDefaultContext()
        self.plant_context = plant.GetMyMutableContextFromRoot(context)
        self.scene_context = scene_graph.GetMyMutableContextFromRoot(context)
        rng = np.random.default_rng(0)
        self.q = rng.uniform(-1.5, 1.5, (NEW_STATES, plant.num_positions()))
        self.poses = [self._make_person_poses(rng) for _ in self.q]
        self.X_WP = np.array(
            [
                [
                    poses.value(frame_id).GetAsMatrix34()
                    for frame_id in self.person_frames
                ]
                for poses in self.poses
            ]
        )
        self.person_port = scene_graph.get_source_pose_port(
            self.person_source
        ).FixValue(self.scene_context, Value(self.poses[0]))
        self.tick = 0

    def _add_arm(self):
        plant = self.plant
        inertia = SpatialInertia.SolidSphereWithMass(1.0, 0.1)
        lengths = [0.13, 0.61, 0.57, 0.16, 0.12, 0.09, 0.08]
        bodies = [plant.AddRigidBody("base", inertia)]
        plant.WeldFrames(
            plant.world_frame(),
            bodies[0].body_frame(),
            RigidTransform([0, 0, 0.8]),
        )
        for i in range(6):
            bodies.append(plant.AddRigidBody(f"link_{i}", inertia))
            plant.AddJoint(
                RevoluteJoint(
                    f"joint_{i}",
                    plant.AddFrame(
                        _offset(plant, bodies[-2], [0, 0, lengths[i]], i)
                    ),
                    bodies[-1].body_frame(),
                    [0, 1, 0] if i % 2 else [0, 0, 1],
                )
            )
        for i, (body, length) in enumerate(zip(bodies, lengths, strict=True)):
            middle = RigidTransform([0, 0, length / 2])
            self._see(body, Capsule(0.06, length), middle, f"tube_{i}")
            if i in (1, 2, 3):
                self._see(body, Cylinder(0.07, 0.15), middle, f"joint_{i}")
            if i in (5, 6):
                self._see(body, Sphere(0.07), middle, f"ball_{i}")
        return bodies

    def _see(self, body, shape, X_BG, name):
        if self.as_mesh:
            shape = _tessellate(shape)
        self.plant.RegisterVisualGeometry(body, X_BG, shape, name, [1] * 4)

    def _add_cell(self):
        world = self.plant.world_body()
        for name, shape, p in (
            ("floor", HalfSpace(), [0, 0, 0]),
            ("pick_table", Box(0.8, 0.8, 0.7), [0, -0.9, 0.35]),
            ("place_table", Box(0.8, 0.8, 0.7), [0, 0.9, 0.35]),
            ("product_box", Box(0.3, 0.4, 0.2), [0, 0.8, 0.8]),
        ):
            self._see(world, shape, RigidTransform(p), name)

    def _add_person(self):
        scene_graph = self.scene_graph
        self.person_source = scene_graph.RegisterSource("person")
        self.person_frames = []
        for i in range(17):
            frame = scene_graph.RegisterFrame(
                self.person_source, GeometryFrame(f"limb_{i}")
            )
            self.person_frames.append(frame)
            if i == 16:
                continue  # A frame that moves but shows nothing.
            shape = Sphere(0.12) if i == 15 else Capsule(0.07, 0.35)
            if self.as_mesh:
                shape = _tessellate(shape)
            instance = GeometryInstance(RigidTransform(), shape, f"limb_{i}")
            instance.set_perception_properties(PerceptionProperties())
            scene_graph.RegisterGeometry(self.person_source, frame, instance)

    def _make_person_poses(self, rng):
        poses = FramePoseVector()
        for i, frame in enumerate(self.person_frames):
            poses.set_value(
                frame,
                RigidTransform(
                    RollPitchYaw(rng.uniform(-0.5, 0.5, 3)),
                    [
                        0.9 + rng.uniform(-0.2, 0.2),
                        rng.uniform(-0.3, 0.3),
                        0.1 + 0.1 * i,
                    ],
                ),
            )
        return poses

    def make_bundles(self, caster, sensors=SENSORS_PER_RING, links=(1, 2, 4)):
        """Returns a group of bundles for each ring."""
        groups = []
        for link in links:
            frame_id = self.plant.GetBodyFrameIdOrThrow(
                self.bodies[link].index()
            )
            own = self.scene_graph.model_inspector().GetGeometries(frame_id)
            turn = 2 * np.pi * np.arange(sensors) / sensors
            groups.append(
                caster.make_bundles(
                    frame_id=frame_id,
                    X_FS=[
                        RigidTransform(
                            RotationMatrix.MakeZRotation(a),
                            [0.075 * np.cos(a), 0.075 * np.sin(a), 0.1],
                        )
                        for a in turn
                    ],
                    fan_S=make_cone_fan(np.deg2rad(25), RAYS),
                    max_range=1.5,
                    excluded=[own] * sensors,
                )
            )
        return groups

    def move(self):
        """A new state of the robot and of the person."""
        self.tick = (self.tick + 1) % NEW_STATES
        self.plant.SetPositions(self.plant_context, self.q[self.tick])
        self.person_port.GetMutableData().set_value(self.poses[self.tick])

    def query_object(self):
        return self.scene_graph.get_query_output_port().Eval(self.scene_context)


def _offset(plant, body, p, i):
    return FixedOffsetFrame(f"tip_{i}", body.body_frame(), RigidTransform(p))


def _tessellate(shape, around=16, along=14):
    """Returns a mesh of a round shape, others as they are."""
    if not isinstance(shape, Sphere | Capsule | Cylinder):
        return shape
    half = 0.0 if isinstance(shape, Sphere) else 0.5 * shape.length()
    polar = np.pi * (np.arange(along) + 0.5) / along
    turn = 2.0 * np.pi * np.arange(around) / around
    rings = [
        shape.radius()
        * np.column_stack(
            [
                np.sin(a) * np.cos(turn),
                np.sin(a) * np.sin(turn),
                np.full(around, np.cos(a)),
            ]
        )
        + [0.0, 0.0, np.copysign(half, np.cos(a))]
        for a in polar
    ]
    top, bottom = rings[0].mean(axis=0), rings[-1].mean(axis=0)
    vertices = np.vstack([*rings, top, bottom])
    faces = []
    for j in range(around):
        k = (j + 1) % around
        faces.append([len(vertices) - 2, j, k])
        last = (along - 1) * around
        faces.append([len(vertices) - 1, last + k, last + j])
        for i in range(along - 1):
            a, b = i * around, (i + 1) * around
            faces += [[a + j, b + j, b + k], [a + j, b + k, a + k]]
    text = "\n".join(
        ["v {} {} {}".format(*v) for v in vertices]
        + ["f {} {} {}".format(*(i + 1 for i in f)) for f in faces]
    )
    return Mesh(InMemoryMesh(mesh_file=MemoryFile(text, ".obj", "round")))


@pytest.fixture(scope="module", params=["shapes", "meshes"])
def cell(request):
    return Cell(as_mesh=request.param == "meshes")


def test_scan_of_three_rings_through_the_query_object(benchmark, cell):
    """The whole ray-cast part: poses and 600 rays, after a new state."""
    caster = RayCaster(cell.scene_graph.model_inspector())
    groups = cell.make_bundles(caster)
    assert len(caster.geometry_ids) == 32

    def scan():
        X_WF = caster.poses_from_query_object(cell.query_object())
        return [caster.cast_bundles(bundles, X_WF) for bundles in groups]

    distance = [d for d, _ in scan()]
    assert sum(d.size for d in distance) == 600
    assert np.isfinite(np.concatenate(distance)).any()
    benchmark.pedantic(scan, setup=cell.move, rounds=5000, warmup_rounds=100)


def test_scan_of_three_rings_from_known_poses(benchmark, cell):
    """The same with poses from the plant and from the person's array."""
    caster = RayCaster(cell.scene_graph.model_inspector())
    groups = cell.make_bundles(caster)
    poses = FramePoses(
        caster=caster, plant=cell.plant, frame_ids=cell.person_frames
    )
    body_poses = cell.plant.get_body_poses_output_port()

    def scan():
        X_WF = poses.calc(
            X_WB=body_poses.Eval(cell.plant_context), X_WF=cell.X_WP[cell.tick]
        )
        return [caster.cast_bundles(bundles, X_WF) for bundles in groups]

    benchmark.pedantic(scan, setup=cell.move, rounds=5000, warmup_rounds=100)


def test_rays_of_three_rings_alone(benchmark, cell):
    caster = RayCaster(cell.scene_graph.model_inspector())
    groups = cell.make_bundles(caster)
    X_WF = caster.poses_from_query_object(cell.query_object())

    def scan():
        for bundles in groups:
            caster.cast_bundles(bundles, X_WF)

    benchmark(scan)


def test_rays_of_one_group_alone(benchmark, cell):
    caster = RayCaster(cell.scene_graph.model_inspector())
    (bundles,) = cell.make_bundles(caster, sensors=24, links=(2,))
    X_WF = caster.poses_from_query_object(cell.query_object())
    benchmark(caster.cast_bundles, bundles, X_WF)


def test_600_single_rays_alone(benchmark, cell):
    caster = RayCaster(cell.scene_graph.model_inspector())
    X_WF = caster.poses_from_query_object(cell.query_object())
    rng = np.random.default_rng(1)
    p_WR = np.tile([0.5, 0.0, 1.2], (600, 1))
    n_WR = rng.normal(size=(600, 3))
    n_WR /= np.linalg.norm(n_WR, axis=1, keepdims=True)
    benchmark(caster.cast, X_WF, p_WR, n_WR, 1.5)
