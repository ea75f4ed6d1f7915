"""Where the lidar is: under the robot's base, with the axes of the world."""

from collections.abc import Sequence
import dataclasses as dc

import numpy as np
from pydrake.geometry import GeometryId, Role, SceneGraphInspector
from pydrake.math import RigidTransform
from pydrake.multibody.plant import MultibodyPlant

from tofssm_drake.arms.kinematics import ArmKinematics
from tofssm_drake.errors import require
from tofssm_drake.perception.lidar_separation import LIDAR
from tofssm_drake.perception.twin import TwinPoses
from tofssm_drake.raycast.ray_caster import RayBundles, RayCaster
from tofssm_drake.sensors.lidar_2d import Lidar2dConfig, make_lidar_bundle

_HOUSING = ("pedestal",)
"""Models that the lidar surrounds: it does not see them."""


def calc_lidar_pose(
    config: Lidar2dConfig, kinematics: ArmKinematics
) -> RigidTransform:
    """Returns X_WS of the scanner: on the base's axis, above the floor.

    Args:
        config: height above the floor.
        kinematics: of the robot; its base stands upright.
    """
    x, y = kinematics.X_WB[:2, 3]
    return RigidTransform([x, y, config.height])


def make_base_lidar_bundle(
    *,
    config: Lidar2dConfig,
    caster: RayCaster,
    plant: MultibodyPlant,
    inspector: SceneGraphInspector,
    kinematics: ArmKinematics,
) -> RayBundles:
    """Makes the rays of the lidar at the robot's base.

    Args:
        config: of the lidar.
        caster: what the rays are cast against.
        plant: of robot and cell, registered with the inspector's SceneGraph.
        inspector: knows the shapes.
        kinematics: of the robot.
    """
    return make_lidar_bundle(
        config=config,
        caster=caster,
        X_FS=calc_lidar_pose(config, kinematics),
        excluded=_find_housing(plant, inspector),
    )


def _find_housing(
    plant: MultibodyPlant, inspector: SceneGraphInspector
) -> Sequence[GeometryId]:
    return [
        geometry_id
        for model in _HOUSING
        for body in plant.GetBodyIndices(plant.GetModelInstanceByName(model))
        for geometry_id in inspector.GetGeometries(
            plant.GetBodyFrameIdOrThrow(body), Role.kPerception
        )
    ]


def scan_background(
    *,
    caster: RayCaster,
    bundle: RayBundles,
    twin: TwinPoses,
    q: np.ndarray,
) -> np.ndarray:
    """Returns the exact ranges in the empty cell, m, (n,).

    Args:
        caster: of the twin's SceneGraph, in which there are no people.
        bundle: the lidar's rays.
        twin: poses the caster's frames.
        q: joints of the robot during the scan, rad, (6,).

    Raises:
        UserError: if the lidar is inside something.
    """
    distance, _ = caster.cast_bundles(bundle, twin.calc(q, 0.0, 0.0))
    require(
        bool((distance[0] > 0.0).all()),
        "lidar.height: the lidar is inside the robot or something in its "
        "cell; use a height at which it has a free view, such as 0.3",
    )
    return distance[0]


def make_lidar_kinematics(
    config: Lidar2dConfig, kinematics: ArmKinematics
) -> ArmKinematics:
    """Returns kinematics with one link, fixed where the lidar is.

    So the true distance of that link is from the lidar to the person.

    Args:
        config: of the lidar.
        kinematics: of the robot; its tool is kept.
    """
    X_WB = RigidTransform(np.vstack([kinematics.X_WB, [0.0, 0.0, 0.0, 1.0]]))
    X_BS = X_WB.InvertAndCompose(calc_lidar_pose(config, kinematics))
    return dc.replace(
        kinematics,
        name=LIDAR,
        site_link=np.array([0, kinematics.site_link[-1]]),
        X_AS=np.stack([X_BS.GetAsMatrix34(), kinematics.X_AS[-1]]),
    )
