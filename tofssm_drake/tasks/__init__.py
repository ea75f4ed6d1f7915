"""What the arm does and carries."""

from tofssm_drake.tasks.no_task import NoTask
from tofssm_drake.tasks.path import PathBuilder, ProgramPath
from tofssm_drake.tasks.products import ObjectCarrier
from tofssm_drake.tasks.program import PickAndPlace, TaskProgram
from tofssm_drake.tasks.waypoints import Waypoint, Waypoints

__all__ = [
    "NoTask",
    "ObjectCarrier",
    "PathBuilder",
    "PickAndPlace",
    "ProgramPath",
    "TaskProgram",
    "Waypoint",
    "Waypoints",
]
