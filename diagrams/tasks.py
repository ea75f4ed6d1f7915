"""The task of a cell.

To add a kind, write its file in `tofssm_drake/tasks`, and name it in `Task`
and in `make_task_path`.
"""

from tofssm_drake.arms.arm import ArmModel
from tofssm_drake.arms.kinematics import ArmKinematics
from tofssm_drake.tasks.path import ProgramPath
from tofssm_drake.tasks.products import ProductLayout
from tofssm_drake.tasks.program import PickAndPlace, make_program_path
from tofssm_drake.tasks.waypoints import Waypoints, make_waypoint_path

Task = PickAndPlace | Waypoints


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
    return make_program_path(task, kinematics)


def find_layout(task: Task) -> ProductLayout:
    """Returns where the products of a task are; there may be none."""
    if isinstance(task, PickAndPlace):
        return ProductLayout.from_config(task)
    return ProductLayout.make_empty()
