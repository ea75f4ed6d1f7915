"""The Scenario of a run, and how it is read from YAML."""

import dataclasses as dc
import difflib
from importlib import resources
import pathlib

import numpy as np
from pydrake.common.yaml import yaml_dump_typed, yaml_load_typed
import yaml

from tofssm_drake.arms.cell_plant import require_ring_model
from tofssm_drake.arms.sim_arm import SimArmConfig
from tofssm_drake.diagrams.yaml_check import (
    check_yaml,
    get_children,
    parse_yaml,
)
from tofssm_drake.errors import UserError, require
from tofssm_drake.laws.config import SsmConfig
from tofssm_drake.messages import RINGS
from tofssm_drake.metrics.standards import AuditConfig
from tofssm_drake.people.bvh import BvhRecording
from tofssm_drake.people.walk import GeneratedWalk
from tofssm_drake.perception.ideal_separation import IdealSeparationConfig
from tofssm_drake.perception.lidar_separation import (
    LIDAR,
    LidarSeparationConfig,
)
from tofssm_drake.perception.occlusion_mask import OcclusionMaskConfig
from tofssm_drake.perception.self_hits import SelfHitConfig
from tofssm_drake.perception.separation import SeparationConfig
from tofssm_drake.sensors.lidar_2d import Lidar2dConfig
from tofssm_drake.sensors.tof_rings import TofRingConfig
from tofssm_drake.tasks.program import ProgramConfig

SENSINGS = ("tof", "ideal", "lidar")


@dc.dataclass(kw_only=True)
class NoHuman:
    """Nobody is in the cell."""

    def check(self, where: str) -> None:
        """Does nothing."""


@dc.dataclass(kw_only=True)
class Scenario:
    """All settings of a run; the same scenario gives the same run."""

    # Seed of every random draw: the sensors' constant errors and their noise.
    random_seed: int = 0

    # Longest simulated time, s. A run ends earlier if the last product is
    # placed and the arm is back.
    simulation_duration: float = 300.0

    # Control tick, s: 0.008 of a CB3 controller, 0.002 of an e-Series. The
    # law, the program and the record all run at it.
    control_period: float = 0.008

    # Sensors per ring; models/rings/ holds the rings of 8 and of 16.
    sensors_per_ring: int = 8

    # UR's real meshes as sensed and shown geometry of the robot instead of
    # capsules. Needs the extra `meshes`.
    robot_meshes: bool = False

    # The simulated arm and its controller.
    robot: SimArmConfig = dc.field(default_factory=SimArmConfig)

    # The task: where the products are and how fast the arm moves.
    program: ProgramConfig = dc.field(default_factory=ProgramConfig)

    # Who is in the cell.
    human: GeneratedWalk | BvhRecording | NoHuman = dc.field(
        default_factory=GeneratedWalk
    )

    # How the monitor senses the person: "tof", the rings on the arm; "ideal",
    # the person's true surface, as motion capture would know it; "lidar", a
    # planar lidar at the robot's base. Settings of the others have no effect.
    sensing: str = "tof"

    # The Time-of-Flight sensors and the sampling of a ring.
    rings: TofRingConfig = dc.field(default_factory=TofRingConfig)

    # First sample of the rings base, elbow and tool, s; 0 is after one period.
    # *Assumed*: all are triggered together; rings of equal phase are one
    # system and cost one cast. Different values stagger them.
    ring_phases: list[float] = dc.field(default_factory=lambda: [0.0, 0.0, 0.0])

    # Sensors known to be dead, by ring: `{tool: [3]}`. They are ignored, and
    # the robot is never faster than reduced. A failed sensor that is not
    # listed stops the robot.
    dead_sensors: dict[str, list[int]] = dc.field(default_factory=dict)

    # Which readings are the robot's own.
    mask: OcclusionMaskConfig = dc.field(default_factory=OcclusionMaskConfig)

    # How the rings are verified by what they see of the robot itself.
    self_hits: SelfHitConfig = dc.field(default_factory=SelfHitConfig)

    # From readings to distance and directed speeds.
    separation: SeparationConfig = dc.field(default_factory=SeparationConfig)

    # From the true person to distance and directed speeds.
    ideal: IdealSeparationConfig = dc.field(
        default_factory=IdealSeparationConfig
    )

    # The lidar. Its height is above the floor and must be below the robot's
    # reach.
    lidar: Lidar2dConfig = dc.field(default_factory=Lidar2dConfig)

    # From the lidar's scans to distance and directed speeds.
    lidar_separation: LidarSeparationConfig = dc.field(
        default_factory=LidarSeparationConfig
    )

    # The safety law.
    ssm: SsmConfig = dc.field(default_factory=SsmConfig)

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
        require_ring_model(self.sensors_per_ring, f"{at}sensors_per_ring")
        require(
            len(self.ring_phases) == 3
            and all(0.0 <= phase < 10.0 for phase in self.ring_phases),
            f"{at}ring_phases: {self.ring_phases} must be three times of 0 s "
            "or more, of the rings base, elbow and tool",
        )
        self._check_dead_sensors(f"{at}dead_sensors")
        require(
            self.sensing in SENSINGS,
            f"{at}sensing: {self.sensing!r} is unknown, use one of "
            f"{', '.join(SENSINGS)}",
        )
        for field in dc.fields(self):
            value = getattr(self, field.name)
            if dc.is_dataclass(value):
                value.check(f"{at}{field.name}")
        self._check_ticks(at)

    def _check_dead_sensors(self, at):
        """Raises UserError unless these sensors exist and others are left."""
        n = self.sensors_per_ring
        for ring, sensors in self.dead_sensors.items():
            require(
                ring in RINGS,
                f"{at}: there is no ring {ring!r}, use one of "
                f"{', '.join(RINGS)}",
            )
            require(
                all(isinstance(i, int) and 0 <= i < n for i in sensors)
                and len(set(sensors)) == len(sensors) < n,
                f"{at}.{ring}: {sensors} must be different numbers from 0 to "
                f"{n - 1}, and not all of them",
            )

    def _check_ticks(self, at):
        """Raises UserError unless a control tick is whole plant steps."""
        tick = self.control_period
        steps = tick / self.robot.time_step
        require(
            round(steps) >= 1 and abs(steps - round(steps)) < 1e-6,
            f"{at}robot.time_step: control_period ({tick}) must be a multiple "
            f"of it, got {self.robot.time_step}",
        )


def find_dead_sensors(scenario: Scenario) -> np.ndarray:
    """Returns whether each sensor is declared dead, ring by ring, (N,)."""
    is_dead = np.zeros((len(RINGS), scenario.sensors_per_ring), dtype=bool)
    for ring, sensors in scenario.dead_sensors.items():
        is_dead[RINGS.index(ring), sensors] = True
    return is_dead.ravel()


def get_links(scenario: Scenario) -> tuple[str, ...]:
    """Returns the names of the links that the sensing watches."""
    return LIDAR if scenario.sensing == "lidar" else RINGS


def make_law(scenario: Scenario) -> SsmConfig:
    """Returns the law's settings for the sensing.

    A lidar's distances are measured from the base's axis. If they are used as
    they are, the law's constant distances grow by the radius of the robot's
    workspace (paper, Table: C_dC = r_o + 0.3 m).
    """
    ssm = scenario.ssm
    if scenario.sensing != "lidar":
        return ssm
    offset = scenario.lidar_separation.threshold_offset

    def grow(distance):
        # Exact in decimals: 0.3 + 0.82 is 1.12.
        return round(distance + offset, 12)

    return dc.replace(
        ssm,
        C_dC=grow(ssm.C_dC),
        d_C_sm=grow(ssm.d_C_sm),
        d_R_sm=grow(ssm.d_R_sm),
    )


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
    filename: pathlib.Path | None = None,
    name: str = "Default",
    text: str = "",
) -> Scenario:
    """Reads a named scenario from a file, then applies changes given as text.

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
    filename = filename or find_default_scenarios()
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
    check_yaml(children[name], Scenario, source, name)
    scenario = _load(source, children[name], Scenario())
    return change_scenario(scenario, text, source="--scenario-text")


def change_scenario(scenario: Scenario, text: str, *, source: str) -> Scenario:
    """Returns a scenario with some settings changed, checked.

    Args:
        scenario: The original; not changed.
        text: YAML of these settings; may be empty.
        source: Where the text is from, for the message.

    Raises:
        UserError: See `load_scenario`.
    """
    scenario = change_settings(scenario, text, source=source)
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
    check_yaml(node, type(settings), source, where)
    return _load(source, node, settings)


def dump_scenario(scenario: Scenario) -> dict:
    """Returns a scenario as plain values, with every setting.

    A tag in YAML (`human: !NoHuman {}`) becomes a key `kind`. `load_scenario`
    reads that as well, so the values give the same run again.
    """
    text = yaml_dump_typed(scenario, schema=Scenario)
    values = yaml.load(text, Loader=_PlainLoader)
    kind = type(scenario.human).__name__
    return values | {"human": {"kind": kind} | values["human"]}


# The C version is ten times faster; all wheels of PyYAML have it.
_SafeLoader = getattr(yaml, "CSafeLoader", yaml.SafeLoader)


class _PlainLoader(_SafeLoader):
    """Reads a mapping with a tag like one without."""


def _construct_tagged(loader, suffix, node):
    return loader.construct_mapping(node, deep=True)


_PlainLoader.add_multi_constructor("!", _construct_tagged)


def _read(filename: pathlib.Path) -> str:
    try:
        return filename.read_text(encoding="utf-8")
    except OSError as error:
        raise UserError(
            f"{filename}: cannot read the scenarios: {error.strerror}"
        ) from None
    except UnicodeDecodeError:
        raise UserError(f"{filename}: is not text in UTF-8") from None


def _load(source: str, node: yaml.Node, defaults):
    try:
        return yaml_load_typed(
            schema=type(defaults), data=yaml.serialize(node), defaults=defaults
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
