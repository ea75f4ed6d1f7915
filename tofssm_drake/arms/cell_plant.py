"""The cell as a MultibodyPlant.

`make_cell_plant` parses the same models for everyone: with a SceneGraph for
what is seen, without one for dynamics.
"""

from collections.abc import Mapping
from typing import Protocol

from pydrake.geometry import SceneGraph
from pydrake.multibody.plant import MultibodyPlant

from tofssm_drake.arms.arm import ArmModel
from tofssm_drake.arms.arm_file import add_workcell_file
from tofssm_drake.arms.ur_arm import UrArm
from tofssm_drake.errors import require
import tofssm_drake.models as models
from tofssm_drake.sensors.ring import Ring
from tofssm_drake.sensors.ring_looks import add_ring_looks

_URL = f"package://{models.PACKAGE}/"

WORKCELL = _URL + "workcell/cell.dmd.yaml"
"""The paper's cell: floor, pedestal, two tables and a box."""


class Mounted(Protocol):
    """What is fixed to the robot or stands in the cell, such as a sensor."""

    def add_frames(self, plant: MultibodyPlant, name: str) -> None:
        """Adds its frames to a plant that is not yet finalized."""


def make_cell_plant(
    *,
    sensors: Mapping[str, Mounted] | None = None,
    products: int = 0,
    scene_graph: SceneGraph | None = None,
    time_step: float = 0.0,
    workcell: str = WORKCELL,
    meshes: bool = False,
    arm: ArmModel | None = None,
) -> MultibodyPlant:
    """Makes the plant of robot, gripper, cell, sensors and products.

    Args:
        sensors: By name, for their frames and looks; None: there are none.
        products: Number of products, free bodies `product_0` and so on in
            model instances of the same name.
        scene_graph: Where to register the geometry; without it the plant has
            none, and steps spend no time on contact.
        time_step: Of the discrete plant, s; 0 is continuous.
        workcell: Model of what stands around the arm: a file, or a
            package:// URL; empty: nothing.
        meshes: Whether the robot's visible geometry is Universal Robots' own
            meshes instead of primitive shapes; needs the SceneGraph and the
            optional extra `meshes`. Of a UR10 only.
        arm: The arm with its tool; by default the UR10 with its gripper.

    Returns:
        A finalized plant.

    Raises:
        UserError: If a model cannot be found or read, a sensor is to be mounted
            where there is no frame, or there are no meshes of this arm.
    """
    plant = MultibodyPlant(time_step)
    if scene_graph is not None:
        plant.RegisterAsSourceForSceneGraph(scene_graph)
    if arm is None:
        arm = UrArm()
    if workcell:
        add_workcell_file(plant, workcell)
    arm.add_to_plant(plant)
    sensors = sensors or {}
    for name, sensor in sensors.items():
        sensor.add_frames(plant, name)
    parser = models.make_parser(plant)
    for i in range(products):
        (instance,) = parser.AddModelsFromUrl(_URL + "workcell/product.urdf")
        plant.RenameModelInstance(instance, f"product_{i}")
    if time_step > 0:
        # Outputs show the state itself: a quarter faster, and nothing here
        # reads what would be sampled (contact results).
        plant.SetUseSampledOutputPorts(False)
    plant.Finalize()
    if scene_graph is not None:
        arm.add_geometry(plant, scene_graph)
        rings = [name for name, s in sensors.items() if isinstance(s, Ring)]
        add_ring_looks(plant, scene_graph, rings=rings)
    if meshes:
        if scene_graph is None:
            raise ValueError("meshes: there is no scene_graph to put them in")
        require(
            plant.HasModelInstanceNamed("ur10"),
            "robot_meshes: only a UR10 has these; another arm's own shapes are "
            "chosen by robot.sensed",
        )
        # Its libraries are optional.
        from tofssm_drake.arms.meshes import replace_robot_shapes

        replace_robot_shapes(plant, scene_graph)
    return plant
