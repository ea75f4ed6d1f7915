"""The Scenario of a run, and how it is read from YAML."""

import copy
import dataclasses as dc
import difflib
from importlib import resources
import pathlib
import re
import types
import typing
from typing import ClassVar

import numpy as np
from pydrake.common.yaml import yaml_load_typed
import yaml

from tofssm_drake.arms.arm import Arm
from tofssm_drake.arms.arm_file import find_model_file
from tofssm_drake.arms.cell_plant import WORKCELL
from tofssm_drake.arms.sim_arm import Simulated
from tofssm_drake.arms.ur_arm import UrArm
from tofssm_drake.diagrams.drivers import ArmDriver
from tofssm_drake.diagrams.people import Person, require_apart
from tofssm_drake.diagrams.sensors import (
    PlanarLidar,
    Sensor,
    find_link_frames,
)
from tofssm_drake.diagrams.tasks import Task
from tofssm_drake.diagrams.waypoint_file import load_waypoints
from tofssm_drake.diagrams.yaml_check import (
    MOST_CHARACTERS,
    check_yaml,
    find_kind,
    get_children,
    parse_yaml,
)
from tofssm_drake.errors import UserError, prefix_errors, require
from tofssm_drake.laws.custom_law import Custom
from tofssm_drake.laws.tri_ssm_law import TriSsm
from tofssm_drake.metrics.standards import AuditConfig
from tofssm_drake.people.moving_box import MovingBox
from tofssm_drake.perception.occlusion_mask import OcclusionMaskConfig
from tofssm_drake.perception.self_hits import SelfHitConfig
from tofssm_drake.perception.separation import SeparationConfig
from tofssm_drake.tasks.program import PickAndPlace
from tofssm_drake.tasks.waypoints import Waypoints
from tofssm_drake.user_files import read_file

# Systems that every station has; a person's or sensor's is called by its name.
_SYSTEMS = (
    *("scene_graph", "program", "sim_arm", "objects", "positions"),
    *("geometry_poses", "people", "nobody", "ignored_separation"),
)

# Where changes given as text are from.
_TEXT = "--scenario-text"
_NAME = re.compile(r"[A-Za-z_][A-Za-z0-9_]*")


@dc.dataclass(kw_only=True)
class Scenario:
    """All settings of a run; the same scenario gives the same run."""

    RENAMED: ClassVar[dict[str, str]] = {
        "ssm": "law",
        "human": "people.<name>",
        "program": "task",
        "sensors_per_ring": "sensors.<ring>.count",
        "sensing": "sensors, as in the scenarios MotionCapture, PlanarLidar",
        "rings": "sensors.<ring>.sensor",
        "ring_phases": "sensors.<ring>.phase",
        "dead_sensors": "sensors.<ring>.dead_sensors",
        "ideal": "sensors.<name>: !MotionCapture",
        "lidar": "sensors.<name>: !PlanarLidar",
        "lidar_separation": "sensors.<name>.separation of a !PlanarLidar",
    }
    """Former keys and what they are called now, for the error message."""

    PATHS: ClassVar[tuple[str, ...]] = ("workcell",)
    """Keys of files; every choice that reads files names its own."""

    # Seed of every random draw: the sensors' constant errors and their noise.
    random_seed: int = 0

    # Longest simulated time, s. A run ends earlier if the last product is
    # placed and the arm is back.
    simulation_duration: float = 300.0

    # Control tick, s: 0.008 of a CB3 controller, 0.002 of an e-Series. The
    # law, the program and the record all run at it.
    control_period: float = 0.008

    # UR's real meshes as sensed and shown geometry of the robot instead of
    # capsules. Needs the extra `meshes`.
    robot_meshes: bool = False

    # What stands around the arm, fixed to the world: model directives or a
    # model, a file or a package:// URL; empty: nothing.
    workcell: str = WORKCELL

    # The arm: where it stands, its tool, what the sensors see of it.
    robot: UrArm | Arm = dc.field(default_factory=UrArm)

    # What drives the arm: a simulation of its dynamics, or a real controller.
    driver: ArmDriver = dc.field(default_factory=Simulated)

    # The task: where the products are and how fast the arm moves.
    task: Task = dc.field(default_factory=PickAndPlace)

    # Who is in the cell, by name.
    people: dict[str, Person] = dc.field(default_factory=dict)

    # What else moves in the cell and is seen, e.g. a cart.
    obstacles: dict[str, MovingBox] = dc.field(default_factory=dict)

    # What watches the person, by name.
    sensors: dict[str, Sensor] = dc.field(default_factory=dict)

    # Which readings are the robot's own.
    mask: OcclusionMaskConfig = dc.field(default_factory=OcclusionMaskConfig)

    # How the rings are verified by what they see of the robot itself.
    self_hits: SelfHitConfig = dc.field(default_factory=SelfHitConfig)

    # From readings to distance and directed speeds.
    separation: SeparationConfig = dc.field(default_factory=SeparationConfig)

    # The safety law.
    law: TriSsm | Custom = dc.field(default_factory=TriSsm)

    # Assumptions of the audit; they do not affect the run.
    audit: AuditConfig = dc.field(default_factory=AuditConfig)

    def check(self, where: str = "") -> None:
        """Raises UserError unless every setting is valid.

        Args:
            where: Name of the scenario in the user's input.
        """
        at = f"{where}." if where else ""
        # Drake's generator takes a seed modulo 2^32.
        require(
            0 <= self.random_seed < 2**32,
            f"{at}random_seed: {self.random_seed} must be from 0 to "
            f"{2**32 - 1}",
        )
        require(
            0.0 < self.simulation_duration <= 86400.0,
            f"{at}simulation_duration: {self.simulation_duration} must be "
            "above 0 and at most 86400 s",
        )
        require(
            0.001 <= self.control_period <= 0.1,
            f"{at}control_period: {self.control_period} must be from 0.001 "
            "to 0.1 s",
        )
        if self.workcell:
            find_model_file(self.workcell, f"{at}workcell")
        self._check_sensors(f"{at}sensors")
        for group in ("people", "obstacles"):
            for name, member in getattr(self, group).items():
                _check_name(name, f"{at}{group}")
                member.check(f"{at}{group}.{name}")
        self._check_names(at)
        require_apart(self.people, f"{at}people")
        for field in dc.fields(self):
            value = getattr(self, field.name)
            if hasattr(value, "check"):
                value.check(f"{at}{field.name}")
        self._check_ticks(at)

    def _check_names(self, at):
        """Raises UserError unless each name stands for one thing."""
        taken = dict.fromkeys(_SYSTEMS, "a part of every cell")
        for group in ("sensors", "people", "obstacles"):
            for name in getattr(self, group):
                require(
                    name not in taken,
                    f"{at}{group}.{name}: {name!r} is {taken.get(name)} "
                    "already; use another name",
                )
                taken[name] = f"{group}.{name}"

    def _check_sensors(self, at):
        """Raises UserError unless the sensors fit together."""
        require(
            bool(self.sensors),
            f"{at}: there is none; without a sensor the robot cannot see "
            "anybody",
        )
        for name, sensor in self.sensors.items():
            _check_name(name, at)
            sensor.check(f"{at}.{name}")
        find_link_frames(self.sensors)

    def _check_ticks(self, at):
        """Raises UserError unless a control tick is whole plant steps."""
        if not isinstance(self.driver, Simulated):
            return
        tick = self.control_period
        steps = tick / self.driver.time_step
        require(
            round(steps) >= 1 and abs(steps - round(steps)) < 1e-6,
            f"{at}driver.time_step: control_period ({tick}) must be a multiple "
            f"of it, got {self.driver.time_step}",
        )


def _check_name(name, at):
    """Raises UserError unless a name can be that of a system."""
    require(
        _NAME.fullmatch(name) is not None,
        f"{at}: {name!r} must be a name of letters, digits and _",
    )


def find_links(scenario: Scenario) -> tuple[str, ...]:
    """Returns the names of the links that the sensors watch."""
    return tuple(find_link_frames(scenario.sensors))


def find_lidars(scenario: Scenario) -> dict[str, PlanarLidar]:
    """Returns the planar lidars among the sensors."""
    return {
        name: sensor
        for name, sensor in scenario.sensors.items()
        if isinstance(sensor, PlanarLidar)
    }


def find_threshold_offsets(scenario: Scenario) -> np.ndarray:
    """Returns by how much the law's distances are greater at each link, m.

    A lidar's distances are measured from itself. If they are used as they
    are, they include the radius of the robot's workspace (paper, Table:
    C_dC = r_o + 0.3 m).

    Returns:
        Shape (m,), in the order of `find_links`.
    """
    more = {
        name: lidar.separation.threshold_offset
        for name, lidar in find_lidars(scenario).items()
    }
    return np.array([more.get(link, 0.0) for link in find_links(scenario)])


def find_default_scenarios() -> pathlib.Path:
    """Returns the path of the scenarios that come with the package."""
    return pathlib.Path(
        str(resources.files("tofssm_drake.diagrams") / "scenarios.yaml")
    )


def list_scenarios(filename: pathlib.Path | None = None) -> list[str]:
    """Returns the names of the scenarios in a file, in order.

    Names that begin with an underscore are building blocks of others.

    Raises:
        UserError: The file cannot be read or is not a YAML mapping.
    """
    filename = filename or find_default_scenarios()
    node = parse_yaml(_read(filename), str(filename))
    return [name for name in get_children(node) if not name.startswith("_")]


def load_scenario(
    *,
    filename: pathlib.Path | str | None = None,
    name: str = "Default",
    text: str = "",
) -> Scenario:
    """Reads a named scenario from a file, then applies changes given as text.

    Files that a scenario names are looked for beside the file it is in; those
    in `text`, in the current folder.

    Args:
        filename: YAML file whose top-level keys are scenario names; None
            takes the scenarios that come with the package.
        name: Name of the scenario.
        text: YAML of the settings to change, e.g. `{random_seed: 3}`.

    Returns:
        The scenario, checked.

    Raises:
        UserError: Something is unknown, misspelt, of the wrong type or out of
            range; the message says where and what would be right.
    """
    filename = pathlib.Path(filename or find_default_scenarios())
    source = str(filename)
    content = _read(filename)
    children = get_children(parse_yaml(content, source))
    names = [key for key in children if not key.startswith("_")]
    if name not in names:
        near = difflib.get_close_matches(name, names, n=1)
        hint = f"did you mean {near[0]!r}? " if near else ""
        raise UserError(
            f"{source}: no scenario {name!r}; {hint}there are "
            f"{', '.join(names)}"
        )
    scenario = _change(
        _load_default(), children[name], source, name, replace=True
    )
    _resolve_paths(scenario, filename.parent)
    changed = _apply(scenario, text, _TEXT)
    try:
        return _complete(changed)
    except UserError as error:
        place = f"{source}: {name}" if _is_wrong(scenario) else _TEXT
        raise UserError(f"{place}: {error}") from None


def _is_wrong(scenario):
    """Returns whether a scenario would be refused as it is."""
    try:
        _complete(scenario)
    except UserError:
        return True
    return False


def _load_default() -> Scenario:
    """Returns the shipped scenario from which every other one starts."""
    filename = find_default_scenarios()
    children = get_children(parse_yaml(_read(filename), str(filename)))
    return _change(
        Scenario(), children["Default"], str(filename), "Default", replace=True
    )


def _resolve_paths(settings, folder):
    """Makes relative paths in settings those of files in a folder."""
    if isinstance(settings, dict):
        for child in settings.values():
            _resolve_paths(child, folder)
        return
    if not dc.is_dataclass(settings):
        return
    for key in getattr(settings, "PATHS", ()):
        value = getattr(settings, key)
        if value and not value.startswith("package://"):
            setattr(settings, key, str(folder.absolute() / value))
    for field in dc.fields(settings):
        _resolve_paths(getattr(settings, field.name), folder)


def change_scenario(scenario: Scenario, text: str, *, source: str) -> Scenario:
    """Returns a scenario with some settings changed, checked.

    Args:
        scenario: The original; not changed.
        text: YAML of these settings; may be empty. Files that it names are
            looked for in the current folder.
        source: Where the text is from, for the message.

    Raises:
        UserError: See `load_scenario`.
    """
    changed = _apply(scenario, text, source)
    with prefix_errors(source):
        return _complete(changed)


def _apply(scenario, text, source):
    """Returns a scenario changed by a text, not yet checked."""
    changed = copy.deepcopy(change_settings(scenario, text, source=source))
    _resolve_paths(changed, pathlib.Path.cwd())
    return changed


def _complete(scenario):
    """Returns a scenario with what is in files of their own, checked."""
    if isinstance(scenario.task, Waypoints):
        task = load_waypoints(scenario.task, "task")
        scenario = dc.replace(scenario, task=task)
    scenario.check()
    return scenario


def change_settings(settings, text: str, *, source: str, where: str = ""):
    """Returns settings with some of them changed, not yet checked.

    Args:
        settings: A dataclass; not changed.
        text: YAML of the changes; may be empty.
        source: Where the text is from, for the message.
        where: Path of keys to the settings, for the message.

    Raises:
        UserError: Something is unknown, misspelt or of the wrong type.
    """
    if not text.strip():
        return settings
    node = parse_yaml(text, source)
    return _change(settings, node, source, where, replace=False)


def _change(settings, node, source, where, *, replace):
    """Returns settings changed by a node.

    Args:
        settings: A dataclass.
        node: The changes.
        source: Where they are from, for the message.
        where: Path of keys, for the message.
        replace: Whether a mapping of names (sensors) replaces the one in
            `settings`; else it changes the names that it has, and removes
            those that are null.
    """
    if not replace:
        settings = _remove_names(node, settings)
        _keep_kinds(node, settings)
    check_yaml(node, type(settings), source, where)
    return _load(source, node, settings, retain_map_defaults=not replace)


def _remove_names(node, settings):
    """Returns settings without the names that a node maps to null.

    Args:
        node: Of the changes; those names are taken out of it.
        settings: A dataclass.
    """
    removed = {}
    for key, child in get_children(node).items():
        now = getattr(settings, key, None)
        if not isinstance(now, dict) or not isinstance(child, yaml.MappingNode):
            continue
        gone = {
            name.value
            for name, value in child.value
            if value.tag == "tag:yaml.org,2002:null"
        }
        child.value = [
            (name, value)
            for name, value in child.value
            if name.value not in gone
        ]
        removed[key] = {n: v for n, v in now.items() if n not in gone}
    return dc.replace(settings, **removed) if removed else settings


def _keep_kinds(node, settings):
    """Gives mappings without a kind that of the settings they change."""
    if not isinstance(node, yaml.MappingNode):
        return
    for key, child in get_children(node).items():
        now = (
            settings.get(key)
            if isinstance(settings, dict)
            else getattr(settings, key, None)
        )
        if not isinstance(child, yaml.MappingNode) or now is None:
            continue
        is_one_of_many = isinstance(settings, dict) or typing.get_origin(
            typing.get_type_hints(type(settings)).get(key)
        ) in (types.UnionType, typing.Union)
        if is_one_of_many and dc.is_dataclass(now) and not find_kind(child):
            child.tag = f"!{type(now).__name__}"
        _keep_kinds(child, now)


def dump_scenario(scenario: Scenario) -> dict:
    """Returns a scenario as plain values, with every setting.

    A tag in YAML (`visitor: !GeneratedWalk {}`) becomes a key `kind`.
    `load_scenario` reads that as well, so the values give the same run again.
    """
    return _dump(scenario, Scenario)


def _dump(value, schema):
    """Returns a value of a schema as plain values."""
    origin = typing.get_origin(schema)
    is_union = origin in (types.UnionType, typing.Union)
    if dc.is_dataclass(value):
        hints = typing.get_type_hints(type(value))
        kind = {"kind": type(value).__name__} if is_union else {}
        return kind | {
            field.name: _dump(getattr(value, field.name), hints[field.name])
            for field in dc.fields(value)
        }
    if isinstance(value, dict):
        item = typing.get_args(schema)[1]
        return {key: _dump(child, item) for key, child in value.items()}
    if isinstance(value, (list, tuple)):
        item = typing.get_args(schema)[0]
        return [_dump(child, item) for child in value]
    if isinstance(value, np.ndarray):
        return value.tolist()
    return value


def _read(filename: pathlib.Path) -> str:
    try:
        return read_file(filename, most=4 * MOST_CHARACTERS).decode("utf-8")
    except OSError as error:
        raise UserError(
            f"{filename}: cannot read the scenarios: {error.strerror}"
        ) from None
    except UnicodeDecodeError:
        raise UserError(f"{filename}: is not text in UTF-8") from None


def _load(source: str, node: yaml.Node, defaults, *, retain_map_defaults):
    try:
        return yaml_load_typed(
            schema=type(defaults),
            data=yaml.serialize(node),
            defaults=defaults,
            retain_map_defaults=retain_map_defaults,
        )
    except (
        AssertionError,
        KeyError,
        RuntimeError,
        TypeError,
        ValueError,
        yaml.YAMLError,
    ) as error:
        # The check above should have found it, with a better message.
        raise UserError(f"{source}: {' '.join(str(error).split())}") from None
