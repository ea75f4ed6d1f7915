"""What a reader of the record must know about the run besides the numbers."""

import importlib.metadata
import itertools
import math
import platform

import numpy as np
from pydrake.geometry import Role
from pydrake.multibody.tree import ModelInstanceIndex
import yaml

from tofssm_drake.arms.chain import find_chain
from tofssm_drake.diagrams.scenario import (
    Scenario,
    dump_scenario,
    find_links,
    find_threshold_offsets,
)
from tofssm_drake.diagrams.sensors import MotionCapture, PlanarLidar
from tofssm_drake.diagrams.sensors.rings import Ring, find_rings
from tofssm_drake.diagrams.station import Station
from tofssm_drake.laws.law import describe_law
from tofssm_drake.metrics.audit import make_audit_metadata
from tofssm_drake.metrics.standards import make_latency_budget
from tofssm_drake.people.moving_box import calc_box_place
from tofssm_drake.people.skeleton import CAPSULES
from tofssm_drake.recording.samples import make_ring_metadata
from tofssm_drake.sensors.ring_mount import find_ring_mount

_PACKAGES = ("tofssm-drake", "drake", "numba", "numpy", "ruckig")

_KIND = {
    Ring: "rings",
    MotionCapture: "motion capture",
    PlanarLidar: "planar lidar",
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
    rings = find_rings(scenario.sensors)
    return {
        "scenario": describe_scenario(scenario),
        "law": describe_law(scenario.law),
        "sensing": describe_sensing(scenario),
        "link_kinds": {
            link: _KIND.get(type(sensor), "")
            for name, sensor in scenario.sensors.items()
            for link in sensor.find_link_frames(name)
        },
        "seed": scenario.random_seed,
        "human": ", ".join(
            f"{name} ({type(person).__name__})"
            for name, person in scenario.people.items()
        )
        or "nobody",
        "products": scenario.task.products,
        "task": describe_task(scenario, station),
        "sensors_per_ring": {n: ring.num_sensors for n, ring in rings.items()},
        "dead_sensors": {
            n: ring.dead_sensors
            for n, ring in rings.items()
            if ring.dead_sensors
        },
        "robot_bodies": robot_bodies,
        "joint_units": [
            "m" if slides else "rad"
            for slides in find_chain(station.plant).slides
        ],
        "people": list(station.people.avatars),
        "shirts": {
            name: _to_hex(avatar.shirt)
            for name, avatar in station.people.avatars.items()
        },
        "person_parts": _name_parts(scenario.people),
        "ring_geometry": _describe_rings(rings, station),
        "audit": make_audit_metadata(
            config=scenario.audit,
            law=scenario.law.traits,
            offset=dict(
                zip(
                    find_links(scenario),
                    find_threshold_offsets(scenario).tolist(),
                    strict=True,
                )
            ),
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


def describe_task(scenario: Scenario, station: Station) -> dict:
    """Returns what the task counts, and when, see `count_steps`.

    Args:
        scenario: The scenario as run.
        station: Its station.
    """
    path = station.path
    if station.program is None:
        step = scenario.task.step if scenario.task.products else ""
        if path.open_time and not step:
            step = "object put down"
        return {"step": step, "steps": len(path.open_time)}
    described = {"step": scenario.task.step, "steps": len(path.step_time)}
    if path.step_time != path.open_time:
        # Later ones are not reached.
        end = scenario.simulation_duration
        described["step_time"] = [s for s in path.step_time if s <= end]
    return described


def _to_hex(rgba):
    """Returns a colour as `#rrggbb`."""
    return "#" + "".join(f"{round(255 * c):02x}" for c in rgba[:3])


def _name_parts(people):
    """Returns names for the indices in the column `person_part`."""
    return [
        f"{name}'s {capsule.name}" if len(people) > 1 else capsule.name
        for name in people
        for capsule in CAPSULES
    ] or [capsule.name for capsule in CAPSULES]


def describe_sensing(scenario: Scenario) -> str:
    """Returns what watches the person, for the report's words."""
    kinds = {_KIND.get(type(s), "mixed") for s in scenario.sensors.values()}
    return kinds.pop() if len(kinds) == 1 else "mixed"


def _describe_rings(rings, station):
    inspector = station.scene_graph.model_inspector()
    described = {}
    for name, ring in rings.items():
        mount = find_ring_mount(station.plant, inspector, name)
        p_LS = np.array([X.translation() for X in mount.X_LS])
        described[name] = make_ring_metadata(
            azimuth=np.arctan2(p_LS[:, 1], p_LS[:, 0]),
            fov=math.radians(ring.sensor.traits.fov_deg),
            radius=float(np.linalg.norm(p_LS[0])),
            max_range=ring.sensor.traits.cast_range,
        )
    return described


def _calc_latency(scenario):
    """Returns the parts of the worst-case latency of the sensing, s.

    Of several sensors the slowest counts.
    """
    integration, wait, delivery = max(
        map(_list_delays, scenario.sensors.values()), key=sum
    )
    return make_latency_budget(
        config=scenario.audit,
        integration=integration,
        wait=wait,
        delivery=delivery,
        control_period=scenario.control_period,
    )


def _list_delays(sensor):
    """Returns integration, longest wait and delivery of a sensor, s."""
    if isinstance(sensor, MotionCapture):
        return 0.0, sensor.period, sensor.latency
    if isinstance(sensor, PlanarLidar):
        # The mirror sweeps for a period; the scan's time is its middle.
        lidar = sensor.sensor
        return 0.5 * lidar.period, lidar.period, lidar.latency
    traits = sensor.sensor.traits
    return traits.integration_time, traits.period, traits.delivery_time


def _find_link_offsets(scenario, station):
    """Returns the distance of each link's surface from its centre, m.

    For a lidar it is the radius of the workspace around it, unless its
    distance rule has already subtracted it; for a link that motion capture
    watches it is that of the nearest surface of a ring there.
    """
    inspector = station.scene_graph.model_inspector()
    offsets = {}
    for name, sensor in scenario.sensors.items():
        if isinstance(sensor, PlanarLidar):
            offsets[name] = sensor.separation.threshold_offset
        elif isinstance(sensor, MotionCapture):
            offsets |= {
                link: entry.radius for link, entry in sensor.links.items()
            }
        else:
            mount = find_ring_mount(station.plant, inspector, name)
            offsets[name] = float(np.linalg.norm(mount.X_LS[0].translation()))
    return offsets


def _describe_plan(station):
    """Returns where the robot stands and what is around it, from above."""
    robot = find_chain(station.plant).X_WB[:2, 3]
    outlines = []
    for instance in _find_furniture(station.plant):
        corners = _find_corners(station, instance)
        if len(corners):
            low, high = corners.min(axis=0)[:2], corners.max(axis=0)[:2]
            name = station.plant.GetModelInstanceName(instance)
            # The mark of the robot's base covers what it stands on.
            is_under_robot = np.all((low <= robot) & (robot <= high))
            outlines.append(
                {
                    "label": "" if is_under_robot else name.replace("_", " "),
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
        "robot": robot.tolist(),
        "obstacles": [
            _describe_obstacle(name, box)
            for name, box in station.people.obstacles.items()
        ],
    }


def _describe_obstacle(name, box):
    """Returns where a moving box is at first, and its way, from above."""
    place, angle = calc_box_place(box, 0.0)
    x, y = 0.5 * np.array(box.size[:2])
    corners = np.array([[x, y], [-x, y], [-x, -y], [x, -y]])
    c, s = math.cos(angle), math.sin(angle)
    return {
        "label": name.replace("_", " "),
        "outline": (place + corners @ np.array([[c, s], [-s, c]])).tolist(),
        "way": [list(map(float, point)) for point in box.waypoints],
    }


def _find_furniture(plant):
    """Returns the model instances that are fixed to the world as a whole."""
    fixed = {
        body.index() for body in plant.GetBodiesWeldedTo(plant.world_body())
    }
    instances = map(ModelInstanceIndex, range(1, plant.num_model_instances()))
    return [i for i in instances if fixed.issuperset(plant.GetBodyIndices(i))]


def _find_corners(station, instance):
    """Returns the corners of boxes around what is seen of a model, (k, 3)."""
    plant = station.plant
    inspector = station.scene_graph.model_inspector()
    context = plant.CreateDefaultContext()
    corners = []
    for index in plant.GetBodyIndices(instance):
        X_WB = plant.EvalBodyPoseInWorld(context, plant.get_body(index))
        frame_id = plant.GetBodyFrameIdOrThrow(index)
        for geometry_id in inspector.GetGeometries(frame_id, Role.kPerception):
            box = inspector.GetObbInGeometryFrame(geometry_id)
            if box is None:  # A half-space.
                continue
            X_WO = X_WB @ inspector.GetPoseInFrame(geometry_id) @ box.pose()
            corners += [
                X_WO @ (box.half_width() * signs)
                for signs in itertools.product((-1.0, 1.0), repeat=3)
            ]
    return np.reshape(corners, (-1, 3))
