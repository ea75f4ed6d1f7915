"""Runs the same monitor on a run's recorded input."""

import dataclasses as dc
import json

import numpy as np
import yaml

from tofssm_drake.arms.kinematics import ArmKinematics
from tofssm_drake.diagrams.hardware_loop import HardwareLoop, TickInput
from tofssm_drake.diagrams.hardware_run import describe_state
from tofssm_drake.diagrams.hardware_station import make_slider_config
from tofssm_drake.diagrams.scenario import Scenario, change_scenario
from tofssm_drake.errors import UserError, require
from tofssm_drake.recording.run_record import RunReader, encode_json
from tofssm_drake.rtde.arm_obedience import ArmConfig

_MISSING = "missing"
# Results that a tick of any version has.
_ALWAYS = ("robot_state", "reason", "speed_fraction", "distance")


@dc.dataclass(frozen=True, kw_only=True)
class ReplayResult:
    """Result of a replay."""

    ticks: int
    """Number of replayed ticks."""
    end_time: float
    """Diagram's time of the last one, s."""
    differences: int
    """Number of ticks with other results or commands."""
    first: str
    """The first difference; empty: none."""


def replay_record(reader: RunReader) -> ReplayResult:
    """Runs the monitor on a record and compares the results tick by tick.

    Args:
        reader: Reads the record.

    Raises:
        UserError: The record's scenario cannot be used here, or a tick is of
            another robot or of other rings than the scenario's.
    """
    try:
        loop = _make_loop(reader.run)
    except (AttributeError, LookupError, TypeError) as error:
        raise UserError(
            f"the record: what it says of its run is incomplete: {error!r}"
        ) from None
    ticks = differences = 0
    first, end_time = "", 0.0
    plant = loop.workcell.station.plant
    num_joints = ArmKinematics.from_plant(plant).num_joints
    for tick in reader.read_ticks():
        result = _replay_tick(loop, tick, num_joints)
        ticks += 1
        end_time = tick.time
        # As it would have been written: a number that is none is null.
        state = json.loads(encode_json(describe_state(result)))
        now = state | _name_command(result.slider.command)
        then = tick.state | _name_command(tick.command)
        expected = now if reader.is_of_this_version else _ALWAYS
        names = dict.fromkeys((*expected, *then))
        changed = [n for n in names if now.get(n) != then.get(n, _MISSING)]
        if changed:
            differences += 1
            first = first or (
                f"first at {tick.time:.3f} s: "
                + ", ".join(
                    f"{n} {now.get(n)}, was {then.get(n, _MISSING)}"
                    for n in changed
                )
            )
    return ReplayResult(
        ticks=ticks, end_time=end_time, differences=differences, first=first
    )


def _replay_tick(loop, tick, num_joints):
    """Runs the monitor on a tick.

    Raises:
        UserError: It is of another robot or of other rings.
    """
    where = f"the record: tick at {tick.time:.3f} s"
    _check_report(tick.report, num_joints, where)
    try:
        return loop.tick(
            TickInput(
                time=tick.time,
                report=tick.report,
                scans=tick.scans,
                clock_offset=tick.clock_offset,
            )
        )
    except (
        AttributeError,
        LookupError,
        RuntimeError,
        TypeError,
        ValueError,
    ) as error:
        raise UserError(
            f"{where}: it does not fit the scenario: {error}"
        ) from None


def _check_report(report, num_joints, where):
    """Raises UserError if a report is of a robot with other joints."""
    joints = ("position", "velocity", "acceleration_commanded")
    sizes = dict.fromkeys(joints, num_joints)
    sizes |= dict.fromkeys(("tcp_pose", "tcp_velocity", "tcp_offset"), 6)
    for name, size in sizes.items():
        values = getattr(report, name)
        # What was not sent may have another size.
        is_unknown = values.size > 0 and np.isnan(values).all()
        require(
            is_unknown or values.shape == (size,),
            f"{where}: {name} has {values.size} numbers, of the scenario's "
            f"robot {size}",
        )


def _name_command(command):
    """Returns a command's values by name, none like that of a result."""
    return {f"command.{name}": v for name, v in vars(command).items()}


def _make_loop(run):
    """Returns the loop of a record's run."""
    scenario = change_scenario(
        Scenario(),
        yaml.safe_dump(_get_scenario(run), sort_keys=False),
        source="the record",
    )
    return HardwareLoop(
        scenario=scenario,
        virtual_rings=run["virtual_rings"],
        slider=dc.replace(
            make_slider_config(scenario),
            minimum_fraction=run["minimum_fraction"],
            operator_limit=run.get("slider_limit"),
            arm=ArmConfig(**run["arm"]),
        ),
    )


def _get_scenario(run):
    """Returns a record's scenario with the keys of today."""
    scenario = dict(run["scenario"])
    if run["version"] < 5:
        scenario["law"] = {"kind": "TriSsm", **scenario.pop("ssm")}
    return scenario
