"""What a reader of the record must know about the run besides the numbers."""

import importlib.metadata
import math
import platform

import numpy as np
from pydrake.geometry import Box, Role
import yaml

from tofssm_drake.arms.chain import find_chain
from tofssm_drake.diagrams.scenario import (
    Scenario,
    dump_scenario,
    make_law,
)
from tofssm_drake.diagrams.station import Station
from tofssm_drake.messages import RINGS
from tofssm_drake.metrics.audit import make_audit_metadata
from tofssm_drake.metrics.standards import make_latency_budget
from tofssm_drake.people.skeleton import CAPSULES
from tofssm_drake.perception.lidar_separation import LIDAR
from tofssm_drake.recording.samples import make_ring_metadata
from tofssm_drake.sensors.ring_mount import find_ring_mount
from tofssm_drake.sensors.vl53l1x import calc_cast_range

_PACKAGES = ("tofssm-drake", "drake", "numba", "numpy", "ruckig")

_FURNITURE = {
    "pick_table": "pick table",
    "place_table": "place table",
    "box": "box",
    "pedestal": "",
}


def make_run_metadata(
    scenario: Scenario, station: Station, robot_bodies: list[str]
) -> dict:
    """Returns plain values to store with the samples.

    Args:
        scenario: The scenario as run.
        station: Its station.
        robot_bodies: Names for the indices in the column `robot_body`.
    """
    return {
        "scenario": describe_scenario(scenario),
        "ssm": scenario.ssm.configuration,
        "sensing": scenario.sensing,
        "seed": scenario.random_seed,
        "human": type(scenario.human).__name__,
        "products": scenario.program.products,
        "sensors_per_ring": scenario.sensors_per_ring,
        "dead_sensors": scenario.dead_sensors,
        "robot_bodies": robot_bodies,
        "person_parts": [capsule.name for capsule in CAPSULES],
        "ring_geometry": (
            _describe_rings(scenario, station)
            if scenario.sensing == "tof"
            else {}
        ),
        "audit": make_audit_metadata(
            config=scenario.audit,
            ssm=make_law(scenario),
            latency=_calc_latency(scenario),
        ),
        "link_offset_m": _find_link_offsets(scenario, station),
        "plan": _describe_plan(station),
        "versions": get_versions(),
    }


def describe_scenario(scenario: Scenario) -> str:
    """Returns a scenario as YAML with every setting."""
    dumper = getattr(yaml, "CSafeDumper", yaml.SafeDumper)
    return yaml.dump(dump_scenario(scenario), Dumper=dumper, sort_keys=False)


def get_versions() -> dict[str, str]:
    """Returns the versions that a result depends on."""
    versions = {name: importlib.metadata.version(name) for name in _PACKAGES}
    return versions | {"python": platform.python_version()}


def _describe_rings(scenario, station):
    inspector = station.scene_graph.model_inspector()
    rings = {}
    for name in RINGS:
        mount = find_ring_mount(station.plant, inspector, name)
        p_LS = np.array([X.translation() for X in mount.X_LS])
        rings[name] = make_ring_metadata(
            azimuth=np.arctan2(p_LS[:, 1], p_LS[:, 0]),
            fov=math.radians(scenario.rings.fov_deg),
            radius=float(np.linalg.norm(p_LS[0])),
            max_range=calc_cast_range(scenario.rings.sensor),
        )
    return rings


def _calc_latency(scenario):
    """Returns the parts of the worst-case latency of the sensing, s."""
    if scenario.sensing == "ideal":
        integration, wait, delivery = (
            0.0,
            scenario.ideal.period,
            scenario.ideal.latency,
        )
    elif scenario.sensing == "lidar":
        # The mirror sweeps for a period; the scan's time is its middle.
        integration, wait, delivery = (
            0.5 * scenario.lidar.period,
            scenario.lidar.period,
            scenario.lidar.latency,
        )
    else:
        integration, wait, delivery = (
            scenario.rings.sensor.timing_budget,
            scenario.rings.period,
            scenario.rings.readout_time,
        )
    return make_latency_budget(
        config=scenario.audit,
        integration=integration,
        wait=wait,
        delivery=delivery,
        control_period=scenario.control_period,
    )


def _find_link_offsets(scenario, station):
    """Returns the distance of each link's surface from its centre, m.

    For a lidar it is the radius of the workspace around it, unless its
    distance rule has already subtracted it.
    """
    if scenario.sensing == "lidar":
        return {LIDAR[0]: scenario.lidar_separation.threshold_offset}
    inspector = station.scene_graph.model_inspector()
    return {
        name: float(
            np.linalg.norm(
                find_ring_mount(station.plant, inspector, name)
                .X_LS[0]
                .translation()
            )
        )
        for name in RINGS
    }


def _describe_plan(station):
    """Returns the furniture's outlines from above."""
    plant = station.plant
    inspector = station.scene_graph.model_inspector()
    context = plant.CreateDefaultContext()
    outlines = []
    for model, label in _FURNITURE.items():
        corners = []
        instance = plant.GetModelInstanceByName(model)
        for index in plant.GetBodyIndices(instance):
            X_WB = plant.EvalBodyPoseInWorld(context, plant.get_body(index))
            frame_id = plant.GetBodyFrameIdOrThrow(index)
            for geometry_id in inspector.GetGeometries(
                frame_id, Role.kPerception
            ):
                shape = inspector.GetShape(geometry_id)
                if isinstance(shape, Box):
                    X_WG = X_WB @ inspector.GetPoseInFrame(geometry_id)
                    half = 0.5 * np.array(shape.size())
                    corners += [
                        X_WG @ (half * [x, y, z])
                        for x in (-1, 1)
                        for y in (-1, 1)
                        for z in (-1, 1)
                    ]
        if corners:
            low = np.min(corners, axis=0)
            high = np.max(corners, axis=0)
            outlines.append(
                {
                    "label": label,
                    "outline": [
                        [low[0], low[1]],
                        [high[0], low[1]],
                        [high[0], high[1]],
                        [low[0], high[1]],
                    ],
                }
            )
    return {
        "outlines": outlines,
        "robot": find_chain(plant).X_WB[:2, 3].tolist(),
    }
