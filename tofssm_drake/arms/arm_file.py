"""Robot descriptions: found, read into a plant, and what Drake cannot read.

Drake reads meshes in OBJ, glTF and VTK. Most public URDFs have STL and
COLLADA: these meshes are left out of what Drake parses and are listed, so
that `arm_shapes` adds them.
"""

import dataclasses as dc
import functools
import importlib.metadata
import pathlib
import xml.etree.ElementTree as ElementTree

import numpy as np
from pydrake.common.eigen_geometry import AngleAxis
from pydrake.math import RigidTransform, RollPitchYaw, RotationMatrix
from pydrake.multibody.parsing import PackageMap, Parser
from pydrake.multibody.plant import MultibodyPlant
from pydrake.multibody.tree import (
    ModelInstanceIndex,
    PrismaticJoint,
    RigidBody,
    WeldJoint,
)

from tofssm_drake.arms.model_check import check_model
from tofssm_drake.errors import UserError, require
import tofssm_drake.models as models

# Drake knows its own elements of a URDF, e.g. drake:capsule, by this prefix.
ElementTree.register_namespace("drake", "http://drake.mit.edu")

_FOREIGN = (".stl", ".dae")
_PUBLIC = "example-robot-data"
"""Public robot descriptions, which come with the extra `meshes`."""


@dc.dataclass(frozen=True, eq=False, kw_only=True)
class ForeignMesh:
    """A mesh that Drake cannot read."""

    model: str
    """Name of the model instance."""
    link: str
    """Name of the body."""
    kind: str
    """`visual` or `collision`."""
    path: pathlib.Path
    """STL or COLLADA."""
    X_LG: RigidTransform
    """Pose of the mesh in its body."""
    scale: np.ndarray
    """Factors along its own axes, (3,)."""


@dc.dataclass(frozen=True, eq=False, kw_only=True)
class ParsedArm:
    """What a description has put into a plant."""

    instance: ModelInstanceIndex
    """The model instance."""
    foreign: tuple[ForeignMesh, ...] = ()
    """Its meshes that Drake cannot read."""
    effort: dict = dc.field(default_factory=dict)
    """Limits of its joints' efforts by joint, Nm or N; Drake reads only those
    of joints with a transmission."""
    constraints: tuple = ()
    """Ids of its constraints, e.g. of fingers that move together."""


def make_package_map() -> PackageMap:
    """Returns where package:// URLs lead: this package, and public robots.

    Packages in ROS_PACKAGE_PATH are known, too.
    """
    packages = PackageMap()
    packages.PopulateFromRosPackagePath()
    packages.AddPackageXml(str(models.find_package_xml()))
    folder = _find_public_robots()
    if folder is not None and not packages.Contains(_PUBLIC):
        packages.Add(_PUBLIC, str(folder))
    return packages


@functools.cache
def _find_public_robots():
    """Returns the folder of example-robot-data; None: it is not installed."""
    try:
        files = importlib.metadata.files(_PUBLIC) or []
    except importlib.metadata.PackageNotFoundError:
        return None
    for file in files:
        if file.match(f"{_PUBLIC}/package.xml"):
            return pathlib.Path(str(file.locate())).resolve().parent
    return None


def find_model_file(file: str, where: str = "robot.file") -> pathlib.Path:
    """Returns the path of a description.

    Args:
        file: A path, or a package:// URL.
        where: What the user calls this, for the message.

    Raises:
        UserError: There is no such file or package.
    """
    if not file.startswith("package://"):
        path = pathlib.Path(file)
        require(path.is_file(), f"{where}: there is no file {file}")
        return path.resolve()
    return _resolve(make_package_map(), file, where)


def _resolve(packages, url, where):
    """Returns the path of a package:// URL."""
    name = url.removeprefix("package://").split("/")[0]
    if not packages.Contains(name):
        hint = (
            "needs the optional extra, pip install 'tofssm-drake[meshes]'"
            if name == _PUBLIC
            else f"known are {', '.join(sorted(packages.GetPackageNames()))}"
        )
        raise UserError(f"{where}: no package {name!r}; {hint}")
    try:
        folder = packages.GetPath(name)
    except RuntimeError:
        raise UserError(
            f"{where}: package {name!r} is not on this machine and cannot be "
            "downloaded now"
        ) from None
    path = pathlib.Path(folder) / url.split("/", 3)[3]
    require(path.is_file(), f"{where}: there is no file {url}")
    return path.resolve()


def add_arm_file(
    plant: MultibodyPlant, file: str, where: str = "robot.file"
) -> ParsedArm:
    """Reads a description into a plant.

    Args:
        plant: Not finalized.
        file: A path, or a package:// URL.
        where: What the user calls this, for the message.

    Raises:
        UserError: It cannot be found or read.
    """
    path = find_model_file(file, where)
    packages = make_package_map()
    _add_own_package(packages, path)
    parser = Parser(plant)
    parser.package_map().AddMap(packages)
    check_model(path, packages, file)
    before = set(plant.GetConstraintIds())
    foreign, effort = (), {}
    try:
        if path.suffix == ".urdf":
            text, foreign, effort = _split_urdf(path, packages, where)
        if foreign:
            found = parser.AddModelsFromString(text, "urdf")
        else:
            found = parser.AddModels(str(path))
    except (RuntimeError, ElementTree.ParseError, ValueError) as error:
        if isinstance(error, UserError):
            raise
        raise _tell_unreadable(where, file, error) from None
    require(
        len(found) == 1,
        f"{where}: {file}: must have one model, has {len(found)}",
    )
    return ParsedArm(
        instance=found[0],
        foreign=foreign,
        effort=effort,
        constraints=tuple(set(plant.GetConstraintIds()) - before),
    )


def _tell_unreadable(where, file, error):
    """Returns the error of a file that cannot be read, in one line."""
    message = " ".join(str(error).split()).removeprefix("error: ")
    return UserError(f"{where}: {file}: {message}")


def add_workcell_file(
    plant: MultibodyPlant, file: str, where: str = "workcell"
) -> None:
    """Adds what stands around an arm, fixed to the world.

    Args:
        plant: Not finalized.
        file: Model directives or a model (`.dmd.yaml`, URDF, SDF, MJCF): a
            path, or a package:// URL.
        where: What the user calls this, for the message.

    Raises:
        UserError: It cannot be found or read, or something in it could move.
    """
    path = find_model_file(file, where)
    packages = make_package_map()
    _add_own_package(packages, path)
    parser = Parser(plant)
    parser.SetStrictParsing()
    parser.package_map().AddMap(packages)
    check_model(path, packages, f"{where}: {file}")
    try:
        found = parser.AddModels(str(path))
    except (RuntimeError, ValueError) as error:
        raise _tell_unreadable(where, file, error) from None
    _require_fixed(plant, found, f"{where}: {file}")


def _require_fixed(plant, instances, where):
    """Raises UserError unless every body is welded to the world."""
    fixed = {
        body.index() for body in plant.GetBodiesWeldedTo(plant.world_body())
    }
    for instance in instances:
        for index in plant.GetBodyIndices(instance):
            name = plant.get_body(index).scoped_name().get_full()
            require(
                index in fixed,
                f"{where}: {name} could move; weld it to the world "
                "(what moves belongs to obstacles)",
            )


def _add_own_package(packages, path):
    """Adds the ROS package that a file is in."""
    for folder in path.parents:
        if (folder / "package.xml").is_file():
            try:
                package = ElementTree.parse(folder / "package.xml")
            except ElementTree.ParseError:
                return  # Of somebody else.
            name = package.findtext("name")
            if name and not packages.Contains(name):
                packages.Add(name, str(folder))
            return


def _split_urdf(path, packages, where):
    """Returns a URDF for Drake, its foreign meshes and limits of effort."""
    root = ElementTree.parse(path).getroot()
    foreign = []
    for link in root.findall("link"):
        for kind in ("visual", "collision"):
            for element in link.findall(kind):
                mesh = element.find("geometry/mesh")
                if mesh is None:
                    continue
                file = _find_mesh(
                    mesh.get("filename") or "", path, packages, where
                )
                if file.suffix.lower() not in _FOREIGN:
                    mesh.set("filename", str(file))
                    continue
                names = root.get("name"), link.get("name")
                foreign.append(_read_mesh(*names, element, file))
                link.remove(element)
    for joint in root.findall("joint"):
        for element in joint.findall("safety_controller"):
            joint.remove(element)  # Of ROS controllers; Drake warns of it.
    effort = {}
    for joint in root.findall("joint"):
        limit = joint.find("limit")
        if limit is not None and (most := limit.get("effort")):
            effort[joint.get("name")] = float(most)
    text = ElementTree.tostring(root, encoding="unicode")
    return text, tuple(foreign), effort


def _find_mesh(name, path, packages, where):
    """Returns the path of a mesh file that a URDF names."""
    if name.startswith("package://"):
        return _resolve(packages, name, f"{where}: {path}")
    return (path.parent / name.removeprefix("file://")).resolve()


def _read_mesh(model, link, element, file):
    origin = element.find("origin")
    xyz, rpy = (
        [float(x) for x in (origin.get(key) or "0 0 0").split()]
        if origin is not None
        else [0.0, 0.0, 0.0]
        for key in ("xyz", "rpy")
    )
    scale = element.find("geometry/mesh").get("scale") or "1 1 1"
    return ForeignMesh(
        model=model,
        link=link,
        kind=element.tag,
        path=file,
        X_LG=RigidTransform(RollPitchYaw(rpy), xyz),
        scale=np.array([float(x) for x in scale.split()]),
    )


def fix_joints(
    plant: MultibodyPlant,
    parsed: ParsedArm,
    fixed: dict[str, float],
    file: str,
) -> None:
    """Replaces joints by welds.

    Args:
        plant: Not finalized.
        parsed: The arm in it.
        fixed: Where each joint stays, rad or m.
        file: The description, for the message.

    Raises:
        UserError: There is no such joint.
    """
    if fixed:
        # They tie joints together that do not move any more.
        for constraint in parsed.constraints:
            plant.RemoveConstraint(constraint)
    for name, position in fixed.items():
        require(
            plant.HasJointNamed(name, parsed.instance),
            f"robot.fixed_joints: {file} has no joint {name!r}",
        )
        joint = plant.GetJointByName(name, parsed.instance)
        parent, child = joint.frame_on_parent(), joint.frame_on_child()
        X_FM = _calc_joint_pose(joint, position)
        for index in plant.GetJointActuatorIndices(parsed.instance):
            actuator = plant.get_joint_actuator(index)
            if actuator.joint().index() == joint.index():
                plant.RemoveJointActuator(actuator)
        plant.RemoveJoint(joint)
        plant.WeldFrames(parent, child, X_FM)


def read_foreign_meshes(
    file: str, where: str = "robot.file"
) -> tuple[ForeignMesh, ...]:
    """Returns the meshes of a description that Drake cannot read.

    Args:
        file: A path, or a package:// URL; empty: none.
        where: What the user calls this, for the message.

    Raises:
        UserError: It cannot be found or read.
    """
    if not file:
        return ()
    return add_arm_file(MultibodyPlant(0.0), file, where).foreign


def free_from_world(plant: MultibodyPlant, body: RigidBody) -> None:
    """Removes the weld by which a description itself has placed its base.

    Args:
        plant: Not finalized.
        body: The base.
    """
    for index in plant.GetJointIndices(body.model_instance()):
        joint = plant.get_joint(index)
        if (
            isinstance(joint, WeldJoint)
            and joint.parent_body().index() == plant.world_body().index()
            and joint.child_body().index() == body.index()
        ):
            plant.RemoveJoint(joint)


def _calc_joint_pose(joint, position):
    """Returns the pose across a revolute or prismatic joint."""
    if isinstance(joint, PrismaticJoint):
        return RigidTransform(position * joint.translation_axis())
    turn = AngleAxis(position, joint.revolute_axis())
    return RigidTransform(RotationMatrix(turn), [0.0, 0.0, 0.0])
