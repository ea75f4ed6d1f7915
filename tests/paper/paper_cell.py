"""The paper's cell, for tests that need one."""

from collections.abc import Mapping

from pydrake.geometry import SceneGraph
from pydrake.multibody.plant import MultibodyPlant

from tofssm_drake.arms.cell_plant import make_cell_plant
from tofssm_drake.arms.kinematics import ArmKinematics
from tofssm_drake.diagrams.scenario import load_scenario
from tofssm_drake.sensors.ring import Ring

RINGS = ("base", "elbow", "tool")


def make_rings(count: int = 8) -> dict[str, Ring]:
    """Returns the rings of the default scenario."""
    rings = load_scenario().sensors
    for ring in rings.values():
        ring.count = count
    return rings


def make_plant(*, count: int = 8, **options) -> MultibodyPlant:
    """Makes the plant of robot, cell and rings."""
    return make_cell_plant(sensors=make_rings(count), **options)


def make_twin_plant(
    scene_graph: SceneGraph, *, count: int = 8, products: int = 10, **options
) -> MultibodyPlant:
    """Makes the plant of the monitor's twin."""
    return make_plant(
        count=count, scene_graph=scene_graph, products=products, **options
    )


def find_kinematics(plant: MultibodyPlant) -> ArmKinematics:
    """Returns the kinematics of a plant with the rings."""
    return ArmKinematics.from_plant(
        plant, links={ring: f"{ring}_ring" for ring in RINGS}
    )


def change_rings(text: str, rings: Mapping | tuple[str, ...] = RINGS) -> str:
    """Returns YAML that changes each ring alike, for a scenario's text."""
    return "sensors: {" + ", ".join(f"{r}: {text}" for r in rings) + "}"
