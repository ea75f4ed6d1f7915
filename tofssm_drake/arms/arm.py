"""The arm as a choice of the scenario: any robot description.

`UrArm` (ur_arm.py) is the other member, with the same interface. To add a
kind of arm, write another class like these.
"""

import dataclasses as dc
from typing import ClassVar, Protocol

import numpy as np
from pydrake.geometry import SceneGraph
from pydrake.multibody.plant import MultibodyPlant
from pydrake.multibody.tree import FixedOffsetFrame

from tofssm_drake.arms.arm_file import (
    add_arm_file,
    find_model_file,
    fix_joints,
    free_from_world,
    read_foreign_meshes,
)
from tofssm_drake.arms.arm_shapes import calc_arm_coverage, set_arm_shapes
from tofssm_drake.arms.capsules import Coverage
from tofssm_drake.arms.chain import find_chain
from tofssm_drake.arms.limits import ArmLimits
from tofssm_drake.errors import UserError, require
import tofssm_drake.models as models
from tofssm_drake.poses import Pose

TCP = "tcp"
"""Name of the tool centre point's frame in every plant of an arm."""

GRIPPER = f"package://{models.PACKAGE}/gripper/gripper.urdf"
"""The tool that comes with the package."""

_TOOL = "robot.tool"

# A joint's greatest speed, acceleration and effort are far below this in any
# unit.
_MOST = 1e6

SENSED = ("perception", "proximity", "capsules")
"""Which of an arm's shapes the sensors see."""


class ArmModel(Protocol):
    """What the rest of the project needs of an arm.

    The plant has the arm's joints, welded to the world at `X_WB`, its tool,
    the frame `tool_frame` and an actuator for each joint. With a SceneGraph,
    the arm's proximity geometry is capsules and spheres.
    """

    @property
    def tool_frame(self) -> str:
        """Name of the tool's frame."""

    @property
    def X_WB(self) -> Pose:
        """Pose of the arm's base in the world."""

    def check(self, where: str) -> None:
        """Raises UserError with one line if a setting is out of range."""

    def add_to_plant(self, plant: MultibodyPlant) -> None:
        """Adds arm and tool to a plant that is not finalized."""

    def add_geometry(
        self, plant: MultibodyPlant, scene_graph: SceneGraph
    ) -> None:
        """Completes the shapes once the plant is finalized."""

    def read_limits(self, where: str = "robot") -> ArmLimits:
        """Returns what the joints can do.

        Raises:
            UserError: A limit of speed or acceleration is missing.
        """


@dc.dataclass(kw_only=True)
class ArmMount:
    """Where an arm stands and what it holds; every kind of arm has these."""

    # Pose of the arm's base frame in the world; by default on top of the
    # shipped cell's pedestal.
    X_WB: Pose = dc.field(
        default_factory=lambda: Pose(translation=[0.0, 0.0, 0.72])
    )

    # Model of the tool: a file, or a package:// URL; empty: none. Its first
    # body is welded to the flange.
    tool: str = GRIPPER

    # The tool centre point in the flange, if no model has a frame `tcp`.
    X_FT: Pose = dc.field(default_factory=Pose)

    tool_frame: ClassVar[str] = TCP

    PATHS: ClassVar[tuple[str, ...]] = ("tool",)

    def check_mount(self, where: str) -> None:
        """Raises UserError with one line if one of these is out of range."""
        self.X_WB.check(f"{where}.X_WB")
        self.X_FT.check(f"{where}.X_FT")
        if self.tool:
            find_model_file(self.tool, f"{where}.tool")

    def add_tool(self, plant: MultibodyPlant, flange: str) -> None:
        """Welds the tool to the flange and names the tool centre point.

        Args:
            plant: Holds the arm.
            flange: Name of the flange's frame.
        """
        frame = plant.GetFrameByName(flange)
        has_own = plant.HasFrameNamed(TCP, frame.model_instance())
        if self.tool:
            require(
                not has_own,
                f"{_TOOL}: the arm's model has a frame {TCP!r} and a tool "
                "of its own; leave this empty",
            )
            instance = add_arm_file(plant, self.tool, _TOOL).instance
            body = plant.get_body(plant.GetBodyIndices(instance)[0])
            plant.WeldFrames(frame, body.body_frame())
            if plant.HasFrameNamed(TCP, instance):
                return
        if not has_own:
            plant.AddFrame(
                FixedOffsetFrame(TCP, frame, self.X_FT.to_transform())
            )


@dc.dataclass(kw_only=True)
class Arm(ArmMount):
    """An arm from a robot description: URDF, SDF or MJCF.

    All joints between its base and its flange count, revolute or prismatic.
    """

    PATHS: ClassVar[tuple[str, ...]] = ("file", *ArmMount.PATHS)

    # The description: a file, or a package:// URL.
    file: str = ""

    # Frame of the description that stands at X_WB, and the one to which the
    # tool is welded. Empty: its first and its last body.
    base_frame: str = ""
    flange_frame: str = ""

    # Joints that do not move, such as a gripper's fingers, and where they
    # stay, rad or m.
    fixed_joints: dict[str, float] = dc.field(default_factory=dict)

    # Limits of the joints, base to flange, instead of the description's:
    # rad/s or m/s, rad/s^2 or m/s^2, Nm or N, (n,). Few descriptions limit
    # accelerations. Without a limit of effort the simulated motors have none.
    joint_speed: list[float] = dc.field(default_factory=list)
    joint_acceleration: list[float] = dc.field(default_factory=list)
    joint_effort: list[float] = dc.field(default_factory=list)

    # What the sensors see of the arm: the description's "perception" or
    # "proximity" shapes (visual and collision), or "capsules", which are
    # fitted around the collision shapes of each link.
    sensed: str = "perception"

    def check(self, where: str) -> None:
        """Raises UserError with one line if a setting is out of range."""
        self.check_mount(where)
        require(bool(self.file), f"{where}.file: names no robot description")
        find_model_file(self.file, f"{where}.file")
        require(
            self.sensed in SENSED,
            f"{where}.sensed: {self.sensed!r} is unknown, use one of "
            f"{', '.join(SENSED)}",
        )
        for name in ("joint_speed", "joint_acceleration", "joint_effort"):
            require(
                all(0.0 < value <= _MOST for value in getattr(self, name)),
                f"{where}.{name}: must be greater than 0 and at most {_MOST:g}",
            )
        for name, position in self.fixed_joints.items():
            require(
                abs(position) <= 100.0,
                f"{where}.fixed_joints.{name}: {position:g} must be within 100 "
                "rad or m",
            )
        self.read_limits(where)

    def add_to_plant(self, plant: MultibodyPlant) -> None:
        """Adds arm and tool to a plant that is not finalized.

        Raises:
            UserError: The description lacks a frame or a joint that is named
                here, or cannot be read.
        """
        parsed = add_arm_file(plant, self.file)
        bodies = plant.GetBodyIndices(parsed.instance)
        base = self.base_frame or plant.get_body(bodies[0]).name()
        flange = self.flange_frame or plant.get_body(bodies[-1]).name()
        for key, name in (("base_frame", base), ("flange_frame", flange)):
            require(
                plant.HasFrameNamed(name, parsed.instance),
                f"robot.{key}: {self.file} has no frame {name!r}",
            )
        fix_joints(plant, parsed, self.fixed_joints, self.file)
        base_frame = plant.GetFrameByName(base, parsed.instance)
        free_from_world(plant, base_frame.body())
        plant.WeldFrames(
            plant.world_frame(), base_frame, self.X_WB.to_transform()
        )
        self.add_tool(plant, flange)
        self._set_limits(plant, parsed)

    def _set_limits(self, plant, parsed):
        """Gives each joint an actuator and the limits of the settings."""
        joints = [
            joint
            for joint in map(
                plant.get_joint, plant.GetJointIndices(parsed.instance)
            )
            if joint.num_velocities() == 1
        ]
        actuators = {
            actuator.joint().name(): actuator
            for actuator in map(
                plant.get_joint_actuator,
                plant.GetJointActuatorIndices(parsed.instance),
            )
        }
        require(
            bool(joints),
            "robot.fixed_joints: leaves no joint that moves",
        )
        for name in ("joint_speed", "joint_acceleration", "joint_effort"):
            values = getattr(self, name)
            require(
                len(values) in (0, len(joints)),
                f"robot.{name}: has {len(values)} values; the arm's joints "
                f"are {', '.join(joint.name() for joint in joints)}",
            )
        for i, joint in enumerate(joints):
            actuator = actuators.get(joint.name())
            effort = parsed.effort.get(joint.name(), np.inf)
            if actuator is None:
                actuator = plant.AddJointActuator(
                    f"{joint.name()}_motor", joint, effort
                )
            if self.joint_effort:
                actuator.set_effort_limit(self.joint_effort[i])
            if self.joint_speed:
                speed = np.array([self.joint_speed[i]])
                joint.set_velocity_limits(-speed, speed)
            if self.joint_acceleration:
                acceleration = np.array([self.joint_acceleration[i]])
                joint.set_acceleration_limits(-acceleration, acceleration)

    def add_geometry(
        self, plant: MultibodyPlant, scene_graph: SceneGraph
    ) -> None:
        """Completes the shapes once the plant is finalized.

        Args:
            plant: Finalized and registered with the SceneGraph.
            scene_graph: Before its context is made.
        """
        set_arm_shapes(
            plant,
            scene_graph,
            sensed=self.sensed,
            foreign=self._list_foreign(),
        )

    def calc_coverage(self) -> dict[str, Coverage]:
        """Returns how well fitted capsules cover each body's collision shapes.

        By name of the body; those with capsules of their own are left out.
        """
        scene_graph = SceneGraph()
        plant = MultibodyPlant(0.0)
        plant.RegisterAsSourceForSceneGraph(scene_graph)
        self.add_to_plant(plant)
        plant.Finalize()
        return calc_arm_coverage(
            plant, scene_graph, foreign=self._list_foreign()
        )

    def _list_foreign(self):
        own = read_foreign_meshes(self.file)
        return own + read_foreign_meshes(self.tool, _TOOL)

    def read_limits(self, where: str = "robot") -> ArmLimits:
        """Returns what the joints can do.

        Raises:
            UserError: A limit of speed or acceleration is missing, or a joint
                that moves is not between base and tool.
        """
        plant = MultibodyPlant(0.0)
        self.add_to_plant(plant)
        plant.Finalize()
        chain = find_chain(plant, TCP)
        own = {joint.name() for joint in chain.joints}
        others = [
            joint.name()
            for joint in map(plant.get_joint, plant.GetJointIndices())
            if joint.num_velocities() and joint.name() not in own
        ]
        if others:
            raise UserError(
                f"{where}.fixed_joints: {', '.join(others)} is not between "
                "base and tool; say where it stays, e.g. {" + others[0] + ": 0}"
            )
        return ArmLimits.from_plant(plant, tcp=TCP, where=where)


def make_arm_plant(arm: ArmModel, *, time_step: float = 0.0) -> MultibodyPlant:
    """Returns a finalized plant of an arm with its tool, without geometry.

    Args:
        arm: Checked.
        time_step: Of the discrete plant, s; 0 is continuous.
    """
    plant = MultibodyPlant(time_step)
    arm.add_to_plant(plant)
    if time_step > 0:
        # Outputs show the state itself: a quarter faster, and nothing here
        # reads what would be sampled (contact results).
        plant.SetUseSampledOutputPorts(False)
    plant.Finalize()
    return plant
