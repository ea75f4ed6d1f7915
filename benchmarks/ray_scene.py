"""The closed loop's own cell as a scene for ray casters.

Robot, gripper, tables, box, ten products and a person, in states that follow
one another as the rings sample them.
"""

import dataclasses as dc

import numpy as np
from pydrake.common import MemoryFile
from pydrake.common.value import Value
from pydrake.geometry import (
    Capsule,
    Cylinder,
    FramePoseVector,
    InMemoryMesh,
    Mesh,
    QueryObject,
    SceneGraph,
    Sphere,
)
from pydrake.math import RigidTransform
from pydrake.systems.framework import DiagramBuilder

from tofssm_drake.arms.cell_plant import make_cell_plant
from tofssm_drake.arms.kinematics import ArmKinematics
from tofssm_drake.diagrams.scenario import load_scenario
from tofssm_drake.diagrams.sensors.rings import find_rings
from tofssm_drake.people.avatar import HumanAvatar
from tofssm_drake.people.motion import capsule_ends
from tofssm_drake.people.skeleton import calc_capsule_poses
from tofssm_drake.perception.twin import TwinPoses
from tofssm_drake.raycast.ray_caster import RayCaster
from tofssm_drake.raycast.triangle_mesh import read_mesh
from tofssm_drake.sensors.ring_mount import find_ring_mount
from tofssm_drake.sensors.tof_rings import make_ring_bundles
from tofssm_drake.tasks.products import calc_object_positions
from tofssm_drake.tasks.program import make_program_path

NUM_STATES = 256


@dc.dataclass(frozen=True, eq=False, kw_only=True)
class State:
    """What robot and avatar report at one time."""

    q: np.ndarray
    carried: np.ndarray
    ends: np.ndarray
    """Of the person's capsules, (c, 2, 3)."""
    positions: np.ndarray
    """Of the plant: joints, then products."""
    person_poses: FramePoseVector


class Scene:
    """The cell, its states, and both ways to cast the rings' rays.

    Args:
        sensors: Per ring, 8 or 16.
        meshes: Robot's real meshes, and a person of meshes.
    """

    def __init__(self, *, sensors: int, meshes: bool):
        scenario = load_scenario(name="Default")
        person = scenario.people["visitor"]
        motion = person.make_motion(scenario.control_period)
        rings = find_rings(scenario.sensors)
        for ring in rings.values():
            ring.count = sensors
        avatar = self._make_world(motion, rings=rings, meshes=meshes)
        inspector = self.scene_graph.model_inspector()
        self.caster = RayCaster(inspector)
        self.mounts = [
            find_ring_mount(self.plant, inspector, ring) for ring in rings
        ]
        sensor = next(iter(rings.values())).sensor
        self.bundles = make_ring_bundles(
            config=sensor, caster=self.caster, mounts=self.mounts
        )
        self.max_range = float(self.bundles.max_range[0])
        kinematics = ArmKinematics.from_plant(self.plant)
        path = make_program_path(scenario.task, kinematics)
        others = self.caster.frame_ids[: -len(avatar.frame_ids)]
        assert self.caster.frame_ids == [*others, *avatar.frame_ids]
        self._num_others = len(others)
        self._twin_poses = TwinPoses.from_plant(
            self.plant, objects=path.objects, frame_ids=others
        )
        # Scans that follow one another, from the middle of the task.
        times = 0.3 * path.duration + np.arange(NUM_STATES) * sensor.period
        self.states = []
        for time in times:
            reported = {
                "q": path.calc_motion(time)[0],
                "carried": path.calc_carried_objects(time),
            }
            ends = capsule_ends(motion, time)
            products = calc_object_positions(
                objects=path.objects, kinematics=kinematics, **reported
            )
            self.states.append(
                State(
                    ends=ends,
                    positions=np.append(reported["q"], products),
                    person_poses=_make_person_poses(avatar, ends),
                    **reported,
                )
            )
        self._person_port = self.scene_graph.get_source_pose_port(
            avatar.source_id
        ).FixValue(self.scene_context, Value(self.states[0].person_poses))
        self._query_port = self.scene_graph.get_query_output_port()
        self.X_WF = np.array([self.calc_poses(i) for i in range(NUM_STATES)])
        self.rays = [self.caster.calc_rays(self.bundles, X) for X in self.X_WF]

    def _make_world(self, motion, *, rings, meshes: bool) -> HumanAvatar:
        """Makes plant, SceneGraph and their Contexts; returns the person."""
        builder = DiagramBuilder()
        self.scene_graph = builder.AddSystem(SceneGraph())
        self.plant = builder.AddSystem(
            make_cell_plant(
                scene_graph=self.scene_graph,
                sensors=rings,
                products=10,
                meshes=meshes,
            )
        )
        builder.Connect(
            self.plant.get_geometry_pose_output_port(),
            self.scene_graph.get_source_pose_port(self.plant.get_source_id()),
        )
        # It registers the person; its poses are set from outside.
        avatar = HumanAvatar(scene_graph=self.scene_graph, motion=motion)
        if meshes:
            _turn_into_meshes(self.scene_graph, avatar)
        diagram = builder.Build()
        context = diagram.CreateDefaultContext()
        self.plant_context = self.plant.GetMyMutableContextFromRoot(context)
        self.scene_context = self.scene_graph.GetMyMutableContextFromRoot(
            context
        )
        self._diagram, self._context = diagram, context
        return avatar

    def count_triangles(self) -> int:
        """Returns how many triangles all meshes have."""
        inspector = self.scene_graph.model_inspector()
        shapes = map(inspector.GetShape, self.caster.geometry_ids)
        return sum(
            len(read_mesh(shape, "mesh").surface.triangles)
            for shape in shapes
            if isinstance(shape, Mesh)
        )

    def calc_poses(self, i: int) -> np.ndarray:
        """Returns all frames' poses as the twin does."""
        state = self.states[i]
        X_WF = np.empty((self._num_others + len(state.ends), 3, 4))
        self._twin_poses.calc(
            state.q,
            state.carried,
            X_WF[: self._num_others],
        )
        calc_capsule_poses(state.ends, X_WF[self._num_others :])
        return X_WF

    def query_poses(self, i: int) -> np.ndarray:
        """Returns them from Drake."""
        return self.caster.poses_from_query_object(self._move(i))

    def _move(self, i: int) -> QueryObject:
        state = self.states[i]
        self.plant.SetPositions(self.plant_context, state.positions)
        self._person_port.GetMutableData().set_value(state.person_poses)
        return self._query_port.Eval(self.scene_context)


def _make_person_poses(avatar, ends) -> FramePoseVector:
    """Returns the poses of the person's capsules as its port takes them."""
    poses = np.empty((len(ends), 3, 4))
    calc_capsule_poses(ends, poses)
    person_poses = FramePoseVector()
    for frame_id, pose in zip(avatar.frame_ids, poses, strict=True):
        person_poses.set_value(frame_id, RigidTransform.MakeUnchecked(pose))
    return person_poses


def _turn_into_meshes(scene_graph, avatar):
    inspector = scene_graph.model_inspector()
    for geometry_id in avatar.geometry_ids:
        scene_graph.ChangeShape(
            source_id=avatar.source_id,
            geometry_id=geometry_id,
            shape=tessellate(inspector.GetShape(geometry_id)),
        )


def tessellate(shape, around=16, along=14):
    """Returns a mesh of a round shape, 2 `around` `along` triangles."""
    assert isinstance(shape, Sphere | Capsule | Cylinder)
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
