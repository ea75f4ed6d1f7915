"""The task of a cell.

To add a kind, write its file in `tofssm_drake/tasks`, and name it in `Task`
and in `make_task_path`.
"""

import numpy as np
from pydrake.geometry import SceneGraph
from pydrake.multibody.plant import MultibodyPlant

from tofssm_drake.arms.arm import ArmModel
from tofssm_drake.arms.kinematics import ArmKinematics
from tofssm_drake.carried_objects import CarriableObjects
from tofssm_drake.errors import UserError
from tofssm_drake.perception.twin import TwinPoses
from tofssm_drake.raycast.ray_caster import RayCaster
from tofssm_drake.tasks.no_task import NoTask, make_resting_path
from tofssm_drake.tasks.path import ProgramPath
from tofssm_drake.tasks.products import HALF_PRODUCT
from tofssm_drake.tasks.program import PickAndPlace, make_program_path
from tofssm_drake.tasks.waypoints import Waypoints, make_waypoint_path

Task = PickAndPlace | Waypoints | NoTask

# A product may be this far from resting on something, m.
_MOST_GAP = 0.005


def make_task_path(
    task: Task, kinematics: ArmKinematics, arm: ArmModel
) -> ProgramPath:
    """Returns the nominal motion of a task.

    Args:
        task: Checked settings.
        kinematics: Of the arm in its cell.
        arm: The arm, for its limits.

    Raises:
        UserError: The arm cannot do it.
    """
    if isinstance(task, Waypoints):
        return make_waypoint_path(task, kinematics, arm.read_limits())
    if isinstance(task, NoTask):
        return make_resting_path(task, kinematics, arm.read_limits())
    return make_program_path(task, kinematics)


def require_supported(
    objects: CarriableObjects,
    cell: MultibodyPlant,
    scene_graph: SceneGraph,
    q: np.ndarray,
) -> None:
    """Raises UserError unless every product rests on something.

    Args:
        objects: Of the task.
        cell: Arm and cell, without the products.
        scene_graph: With which it is registered.
        q: Joints at the start, rad or m, (n,).
    """
    if not len(objects):
        return
    caster = RayCaster(scene_graph.model_inspector())
    twin = TwinPoses.from_plant(
        cell,
        objects=CarriableObjects.make_empty(),
        frame_ids=caster.frame_ids,
    )
    X_WF = twin.calc(q, np.empty(0))
    down = np.tile([0.0, 0.0, -1.0], (len(objects), 1))
    for place in range(objects.X_WO.shape[1]):
        middle = objects.X_WO[:, place, :, 3]
        below, _ = caster.cast(X_WF, middle, down)
        gap = below - HALF_PRODUCT
        i = int(np.argmax(np.abs(gap)))
        if abs(gap[i]) <= _MOST_GAP:
            continue
        what = (
            "have nothing under it"
            if np.isinf(gap[i])
            else f"float {gap[i]:.3f} m above what is under it"
            if gap[i] > 0.0
            else f"reach {-gap[i]:.3f} m into what is under it"
        )
        raise UserError(
            f"task.{objects.setting[i][place]}: product {i} would {what}"
        )
