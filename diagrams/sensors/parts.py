"""What a sensor is given when it is added to the world or to the monitor."""

from collections.abc import Mapping, Sequence
import dataclasses as dc

import numpy as np
from pydrake.geometry import SceneGraph
from pydrake.multibody.plant import MultibodyPlant
from pydrake.systems.framework import DiagramBuilder, InputPort, OutputPort

from tofssm_drake.arms.kinematics import ArmKinematics
from tofssm_drake.carried_objects import CarriableObjects
from tofssm_drake.perception.occlusion_mask import OcclusionMaskConfig
from tofssm_drake.perception.self_hits import SelfHitConfig
from tofssm_drake.perception.separation import SeparationConfig
from tofssm_drake.raycast.ray_caster import RayCaster


@dc.dataclass(frozen=True, eq=False, kw_only=True)
class World:
    """The simulated cell that sensors look at."""

    builder: DiagramBuilder
    scene_graph: SceneGraph
    plant: MultibodyPlant
    """Robot, cell and products as registered with `scene_graph`."""
    caster: RayCaster
    """Of `scene_graph`."""
    random_seed: int
    """Of the sensors' constant errors."""


@dc.dataclass(frozen=True, eq=False, kw_only=True)
class MonitorSettings:
    """What a scenario says of the monitor's side of all sensors."""

    control_period: float
    """s."""
    k_max: float
    """Directed speeds are saturated to +-k_max, m/s."""
    mask: OcclusionMaskConfig
    self_hits: SelfHitConfig
    separation: SeparationConfig
    postures: np.ndarray
    """Joints along the task, rad or m, (k, n); the first is where it starts."""


@dc.dataclass(frozen=True, eq=False, kw_only=True)
class Monitor:
    """The monitor under construction, with its model of the cell."""

    builder: DiagramBuilder
    settings: MonitorSettings
    scene_graph: SceneGraph
    """Of the twin; it only provides the shapes, once."""
    plant: MultibodyPlant
    """The twin."""
    kinematics: ArmKinematics
    """Of all watched links."""
    objects: CarriableObjects
    """That the task carries."""
    person_radii: np.ndarray | None
    """Radii of the true person's capsules, m; for motion capture."""
    inputs: set[str] = dc.field(default_factory=set)
    """Names of the input ports so far."""

    @property
    def num_joints(self) -> int:
        """Number of the robot's joints."""
        return self.kinematics.num_joints

    def select_links(self, links: Sequence[str]) -> ArmKinematics:
        """Returns the kinematics of some of the links."""
        return self.kinematics.select(links)

    def connect_input(self, name: str, port: InputPort) -> None:
        """Connects a port to the monitor's input of a name."""
        if name in self.inputs:
            self.builder.ConnectInput(name, port)
        else:
            self.builder.ExportInput(port, name)
            self.inputs.add(name)


@dc.dataclass(frozen=True, eq=False, kw_only=True)
class Sensing:
    """What a sensor, or a group of them, adds to the monitor."""

    links: tuple[str, ...]
    """The m links that it watches."""
    separation: OutputPort
    """Of these links."""
    threshold_offset: float = 0.0
    """Amount added to the law's distances for these links, m."""
    outputs: Mapping[str, OutputPort] = dc.field(default_factory=dict)
    """Further ports to export."""
