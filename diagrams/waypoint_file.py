"""A program of waypoints in a file of its own."""

import dataclasses as dc
from pathlib import Path

from pydrake.common.yaml import yaml_load_typed
import yaml

from tofssm_drake.diagrams.yaml_check import (
    MOST_CHARACTERS,
    check_yaml,
    parse_yaml,
)
from tofssm_drake.errors import UserError, require
from tofssm_drake.tasks.waypoints import CarriedProduct, Waypoint, Waypoints
from tofssm_drake.user_files import read_file


@dc.dataclass(kw_only=True)
class _Program:
    """What such a file has."""

    waypoints: list[Waypoint] = dc.field(default_factory=list)
    objects: list[CarriedProduct] = dc.field(default_factory=list)


def load_waypoints(task: Waypoints, where: str) -> Waypoints:
    """Returns a task with its file's waypoints and objects in it.

    Args:
        task: It may name a file; then it must have neither of its own.
        where: What the user calls it, for the message.

    Returns:
        The task, which no longer names a file, so that a record has all of it.

    Raises:
        UserError: The file cannot be read, or is not such a program.
    """
    if not task.file:
        return task
    require(
        not task.waypoints and not task.objects,
        f"{where}.file: give either a file or waypoints and objects",
    )
    where = f"{where}.file"
    try:
        text = read_file(task.file, most=4 * MOST_CHARACTERS).decode("utf-8")
    except OSError as error:
        raise UserError(f"{where}: {task.file}: {error.strerror}") from None
    except UnicodeDecodeError:
        raise UserError(f"{where}: {task.file}: is not UTF-8") from None
    source = f"{where}: {Path(task.file)}"
    node = parse_yaml(text, source)
    check_yaml(node, _Program, source, "program")
    program = yaml_load_typed(schema=_Program, data=yaml.serialize(node))
    return dc.replace(
        task, file="", waypoints=program.waypoints, objects=program.objects
    )
