"""The cell as a MultibodyPlant.

`make_cell_plant` parses the same models for everyone: with a SceneGraph for
what is seen, without one for dynamics.
"""

from pydrake.geometry import SceneGraph
from pydrake.multibody.plant import MultibodyPlant

from tofssm_drake.arms.arm import ArmModel
from tofssm_drake.arms.ur_arm import UrArm
from tofssm_drake.errors import require
import tofssm_drake.models as models
from tofssm_drake.sensors.ring_looks import add_ring_looks

_URL = f"package://{models.PACKAGE}/"


def require_ring_model(
    sensors_per_ring: int, where: str = "sensors_per_ring"
) -> None:
    """Raises UserError if there is no ring model for that many sensors.

    Args:
        sensors_per_ring: How many.
        where: What the user calls this, for the message.
    """
    folder = models.find_package_xml().parent / "rings"
    shipped = sorted(
        int(path.name.split(".")[0].removeprefix("rings_"))
        for path in folder.glob("rings_*.dmd.yaml")
    )
    require(
        sensors_per_ring in shipped,
        f"{where}: no ring model with {sensors_per_ring} sensors; there are "
        f"{', '.join(map(str, shipped))}",
    )


def make_cell_plant(
    *,
    sensors_per_ring: int = 8,
    products: int = 0,
    scene_graph: SceneGraph | None = None,
    time_step: float = 0.0,
    cell: bool = True,
    meshes: bool = False,
    arm: ArmModel | None = None,
) -> MultibodyPlant:
    """Makes the plant of robot, gripper, rings, cell and products.

    Args:
        sensors_per_ring: Which ring model to load; 0 loads none.
        products: Number of products, free bodies `product_0` and so on in
            model instances of the same name.
        scene_graph: Where to register the geometry; without it the plant has
            none, and steps spend no time on contact.
        time_step: Of the discrete plant, s; 0 is continuous.
        cell: Whether to load floor, pedestal, tables and box.
        meshes: Whether the robot's visible geometry is Universal Robots' own
            meshes instead of primitive shapes; needs the SceneGraph and the
            optional extra `meshes`. Of a UR10 only.
        arm: The arm with its tool; by default the UR10 with its gripper.

    Returns:
        A finalized plant.

    Raises:
        UserError: If there is no ring model for that many sensors, or no
            meshes of this arm.
    """
    plant = MultibodyPlant(time_step)
    if scene_graph is not None:
        plant.RegisterAsSourceForSceneGraph(scene_graph)
    arm = arm or UrArm()
    parser = models.make_parser(plant)
    if cell:
        parser.AddModelsFromUrl(_URL + "workcell/cell.dmd.yaml")
    arm.add_to_plant(plant)
    if sensors_per_ring:
        require_ring_model(sensors_per_ring)
        parser.AddModelsFromUrl(
            f"{_URL}rings/rings_{sensors_per_ring}.dmd.yaml"
        )
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
    if sensors_per_ring and scene_graph is not None:
        add_ring_looks(plant, scene_graph)
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


def make_twin_plant(
    *,
    scene_graph: SceneGraph,
    sensors_per_ring: int = 8,
    products: int = 10,
    meshes: bool = False,
    arm: ArmModel | None = None,
) -> MultibodyPlant:
    """Makes the plant of robot, cell and products.

    Its positions are [q (n), product_0 (7), product_1 (7), ...].
    """
    return make_cell_plant(
        sensors_per_ring=sensors_per_ring,
        products=products,
        scene_graph=scene_graph,
        meshes=meshes,
        arm=arm,
    )
