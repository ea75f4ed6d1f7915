"""Universal Robots' own UR10 meshes in place of the primitive shapes.

Needs the optional extra `meshes` (example-robot-data).
Nothing is written to disk: the package's STL files become OBJ (what sensors
see), its COLLADA files become glTF (what a person sees), both in memory.
Distances between robot and human keep the capsules: they are closed-form and
their union covers the meshes to within a few centimetres (see tests).
"""

import functools
import importlib.metadata
import pathlib
import xml.etree.ElementTree as ElementTree

import numpy as np
from pydrake.common import MemoryFile
from pydrake.geometry import (
    GeometryInstance,
    IllustrationProperties,
    InMemoryMesh,
    Mesh,
    PerceptionProperties,
    Role,
    SceneGraph,
)
from pydrake.math import RigidTransform, RollPitchYaw
from pydrake.multibody.plant import MultibodyPlant
import trimesh

from tofssm_drake.errors import UserError

# Links of this project's model and of the package's.
_LINKS = {
    "base": "base_link",
    "shoulder_link": "shoulder_link",
    "upper_arm_link": "upper_arm_link",
    "forearm_link": "forearm_link",
    "wrist_1_link": "wrist_1_link",
    "wrist_2_link": "wrist_2_link",
    "wrist_3_link": "wrist_3_link",
}


@functools.cache
def find_ur10_urdf() -> pathlib.Path:
    """Returns the path of the UR10's URDF in example-robot-data.

    Raises:
        UserError: If the package is not installed.
    """
    try:
        files = importlib.metadata.files("example-robot-data") or []
    except importlib.metadata.PackageNotFoundError:
        files = []
    for file in files:
        if file.match("ur_description/urdf/ur10_robot.urdf"):
            return pathlib.Path(str(file.locate())).resolve()
    raise UserError(
        "robot_meshes: needs the optional extra, pip install "
        "'tofssm-drake[meshes]' (no UR10 in example-robot-data)"
    )


def _read_mesh_frames(root) -> dict[str, RigidTransform]:
    """Returns the poses of a URDF's links in its link `base` at q = 0."""
    joints = {}
    for joint in root.findall("joint"):
        origin = joint.find("origin")
        xyz = [float(x) for x in origin.get("xyz").split()]
        rpy = [float(x) for x in origin.get("rpy").split()]
        joints[joint.find("child").get("link")] = (
            joint.find("parent").get("link"),
            RigidTransform(RollPitchYaw(rpy), xyz),
        )

    def pose(link):
        if link not in joints:
            return RigidTransform()
        parent, X_PL = joints[link]
        return pose(parent).multiply(X_PL)

    X_base = pose("base").inverse()
    return {link: X_base.multiply(pose(link)) for link in _LINKS.values()}


def _calc_offsets(plant: MultibodyPlant) -> dict[str, RigidTransform]:
    """Returns X_LM: each package link's frame in this project's link frame.

    Both models describe one robot, with different link frames; at q = 0 their
    links coincide in the robot's base frame.
    """
    root = ElementTree.parse(find_ur10_urdf()).getroot()
    X_BM = _read_mesh_frames(root)
    context = plant.CreateDefaultContext()
    robot = plant.GetModelInstanceByName("ur10")
    plant.SetPositions(context, robot, np.zeros(plant.num_positions(robot)))
    base = plant.GetFrameByName("base", robot)
    return {
        link: plant.GetFrameByName(link, robot)
        .CalcPose(context, base)
        .inverse()
        .multiply(X_BM[other])
        for link, other in _LINKS.items()
    }


@functools.cache
def _find_mesh_files() -> dict[str, tuple[pathlib.Path, pathlib.Path]]:
    """Returns (collision, visual) mesh files per link of this project."""
    urdf = find_ur10_urdf()
    # .../share/example-robot-data/robots/ur_description/urdf/ur10_robot.urdf
    share = urdf.parents[4]
    root = ElementTree.parse(urdf).getroot()

    def find_file(link, kind):
        for mesh in root.iterfind(
            f"link[@name='{link}']/{kind}/geometry/mesh[@filename]"
        ):
            return share / mesh.attrib["filename"].removeprefix("package://")
        raise ValueError(f"{urdf}: link {link} has no {kind} mesh")

    return {
        link: (find_file(other, "collision"), find_file(other, "visual"))
        for link, other in _LINKS.items()
    }


def read_collision_mesh(link: str, X_LM: RigidTransform):
    """Returns a link's collision mesh as a trimesh.Trimesh in the link frame.

    Args:
        link: Name of the link in this project's model.
        X_LM: Pose of the mesh in the link.
    """
    mesh = trimesh.load_mesh(_find_mesh_files()[link][0])
    mesh.merge_vertices()
    mesh.apply_transform(X_LM.GetAsMatrix4())
    return mesh


def read_collision_meshes(plant: MultibodyPlant) -> dict:
    """Returns all links' collision meshes, trimesh.Trimesh in link frames."""
    return {
        link: read_collision_mesh(link, X_LM)
        for link, X_LM in _calc_offsets(plant).items()
    }


def _make_obj(mesh, name: str) -> Mesh:
    text = mesh.export(file_type="obj")
    return Mesh(InMemoryMesh(mesh_file=MemoryFile(text, ".obj", name)))


def _make_gltf(link: str, X_LM: RigidTransform) -> Mesh:
    scene = trimesh.load(_find_mesh_files()[link][1], force="scene")
    scene.apply_transform(X_LM.GetAsMatrix4())
    # glTF is y-up: a reader turns it by +90 deg about x.
    scene.apply_transform(
        RigidTransform(
            RollPitchYaw([-np.pi / 2, 0, 0]), [0, 0, 0]
        ).GetAsMatrix4()
    )
    text = trimesh.exchange.gltf.export_gltf(scene, embed_buffers=True)
    text = text["model.gltf"]
    return Mesh(
        InMemoryMesh(mesh_file=MemoryFile(text, ".gltf", f"{link}.gltf"))
    )


def replace_robot_shapes(
    plant: MultibodyPlant,
    scene_graph: SceneGraph,
    *,
    perception: bool = True,
    illustration: bool = True,
) -> None:
    """Replaces the robot's primitive shapes by UR's meshes.

    Args:
        plant: Finalized and registered with the SceneGraph; its robot is
            model instance `ur10`.
        scene_graph: Before its context is made.
        perception: Whether sensors see the meshes. A mesh is the surface as
            it is, not its convex hull.
        illustration: Whether a person sees them.

    Raises:
        UserError: If the optional extra is not installed.
    """
    find_ur10_urdf()
    source_id = plant.get_source_id()
    inspector = scene_graph.model_inspector()
    robot = plant.GetModelInstanceByName("ur10")
    roles = []
    if perception:
        roles.append(Role.kPerception)
    if illustration:
        roles.append(Role.kIllustration)
    for link, X_LM in _calc_offsets(plant).items():
        body = plant.GetBodyByName(link, robot)
        frame_id = plant.GetBodyFrameIdOrThrow(body.index())
        for role in roles:
            for geometry_id in inspector.GetGeometries(frame_id, role):
                if not inspector.GetName(geometry_id).startswith("ur10::"):
                    continue  # What the robot wears, e.g. a ring.
                scene_graph.RemoveRole(
                    source_id=source_id, geometry_id=geometry_id, role=role
                )
        if perception:
            seen = GeometryInstance(
                RigidTransform(),
                _make_obj(read_collision_mesh(link, X_LM), f"{link}.obj"),
                f"{link}_mesh_seen",
            )
            seen.set_perception_properties(PerceptionProperties())
            scene_graph.RegisterGeometry(source_id, frame_id, seen)
        if illustration:
            look = GeometryInstance(
                RigidTransform(), _make_gltf(link, X_LM), f"{link}_mesh_look"
            )
            look.set_illustration_properties(IllustrationProperties())
            scene_graph.RegisterGeometry(source_id, frame_id, look)
