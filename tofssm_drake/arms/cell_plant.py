"""The cell as a MultibodyPlant.

`make_cell_plant` parses the same models for everyone: with a SceneGraph for
what is seen, without one for dynamics.
"""

from collections.abc import Mapping
import functools
from typing import Protocol

from pydrake.geometry import SceneGraph
from pydrake.multibody.plant import MultibodyPlant

import tofssm_drake.models as models
from tofssm_drake.sensors.ring import Ring
from tofssm_drake.sensors.ring_looks import add_ring_looks

_URL = f"package://{models.PACKAGE}/"


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
    cell: bool = True,
    meshes: bool = False,
) -> MultibodyPlant:
    """Makes the plant of robot, gripper, cell, sensors and products.

    Args:
        sensors: By name, for their frames and looks; None: there are none.
        products: Number of products, free bodies `product_0` and so on in
            model instances of the same name.
        scene_graph: Where to register the geometry; without it the plant has
            none, and steps spend no time on contact.
        time_step: Of the discrete plant, s; 0 is continuous.
        cell: Whether to load floor, pedestal, tables and box. Without them
            the base is welded to the same place.
        meshes: Whether the robot's visible geometry is Universal Robots' own
            meshes instead of primitive shapes; needs the SceneGraph and the
            optional extra `meshes`.

    Returns:
        A finalized plant.

    Raises:
        UserError: If a sensor is to be mounted where there is no frame.
    """
    plant = MultibodyPlant(time_step)
    if scene_graph is not None:
        plant.RegisterAsSourceForSceneGraph(scene_graph)
    parser = models.make_parser(plant)
    if cell:
        parser.AddModelsFromUrl(_URL + "workcell/workcell.dmd.yaml")
    else:
        parser.AddModelsFromUrl(_URL + "ur10/ur10_gripper.dmd.yaml")
        plant.WeldFrames(
            plant.world_frame(),
            plant.GetFrameByName("base"),
            _read_base_pose(),
        )
    sensors = sensors or {}
    for name, sensor in sensors.items():
        sensor.add_frames(plant, name)
    for i in range(products):
        (instance,) = parser.AddModelsFromUrl(_URL + "workcell/product.urdf")
        plant.RenameModelInstance(instance, f"product_{i}")
    if time_step > 0:
        # Outputs show the state itself: a quarter faster, and nothing here
        # reads what would be sampled (contact results).
        plant.SetUseSampledOutputPorts(False)
    plant.Finalize()
    if scene_graph is not None:
        rings = [name for name, s in sensors.items() if isinstance(s, Ring)]
        add_ring_looks(plant, scene_graph, rings=rings)
    if meshes:
        if scene_graph is None:
            raise ValueError("meshes: there is no scene_graph to put them in")
        # Its libraries are optional.
        from tofssm_drake.arms.meshes import replace_robot_shapes

        replace_robot_shapes(plant, scene_graph)
    return plant


@functools.cache
def _read_base_pose():
    """Returns where the cell's model puts the robot's base."""
    plant = MultibodyPlant(0.0)
    parser = models.make_parser(plant)
    parser.AddModelsFromUrl(_URL + "workcell/cell.dmd.yaml")
    plant.Finalize()
    return plant.GetFrameByName("robot_base").CalcPoseInWorld(
        plant.CreateDefaultContext()
    )
