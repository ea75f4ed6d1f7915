"""Rings in a cell: their systems in the world and in the monitor.

Alike rings (the same sensor model and number of sensors) share their systems:
it costs less, and their self-hits are compared with one another.
"""

from collections.abc import Mapping
import dataclasses as dc
import functools
import math

import numpy as np
from pydrake.common import RandomDistribution
from pydrake.systems.framework import OutputPort
from pydrake.systems.primitives import Multiplexer, RandomSource

from tofssm_drake.diagrams.sensors.parts import Monitor, Sensing, World
from tofssm_drake.perception.occlusion_mask import (
    OcclusionMask,
    make_mask_bundles,
    make_proof_bundles,
)
from tofssm_drake.perception.self_hit_watch import (
    SelfHitModel,
    SelfHitStop,
    SelfHitWatch,
    make_self_hit_model,
)
from tofssm_drake.perception.separation import TofSeparation, make_ring_geometry
from tofssm_drake.perception.twin import TwinPoses
from tofssm_drake.raycast.ray_caster import RayCaster
from tofssm_drake.sensors.range_sensor import SensorTraits, draw_constants
from tofssm_drake.sensors.ring import Ring
from tofssm_drake.sensors.ring_mount import find_ring_mount
from tofssm_drake.sensors.tof_rings import TofRings, make_ring_bundles

# Noise is drawn for this many scans at a time.
_NOISE_SCANS = 16


@dc.dataclass(frozen=True, eq=False, kw_only=True)
class RingGroup:
    """Alike rings of a cell, in the scenario's order."""

    rings: Mapping[str, Ring]
    number: Mapping[str, int]
    """Of each ring among all rings of the cell."""

    @property
    def name(self) -> tuple[str, ...]:
        """Names of the m rings."""
        return tuple(self.rings)

    @property
    def one(self) -> Ring:
        """A ring, for what they have in common."""
        return next(iter(self.rings.values()))

    @property
    def traits(self) -> SensorTraits:
        """Of their sensor model."""
        return self.one.sensor.traits

    def find_dead_sensors(self) -> np.ndarray:
        """Returns whether each sensor is declared dead, ring by ring, (N,)."""
        n = self.one.num_sensors
        is_dead = np.zeros((len(self.rings), n), dtype=bool)
        for row, ring in zip(is_dead, self.rings.values(), strict=True):
            row[ring.dead_sensors] = True
        return is_dead.ravel()


def find_rings(sensors: Mapping) -> dict[str, Ring]:
    """Returns the rings among a cell's sensors."""
    return {
        name: sensor
        for name, sensor in sensors.items()
        if isinstance(sensor, Ring)
    }


def group_rings(
    rings: Mapping[str, Ring], *, by_phase: bool = False
) -> list[RingGroup]:
    """Sorts rings into groups of alike ones.

    Args:
        rings: Of the cell.
        by_phase: Whether alike rings also sample at the same times.
    """
    number = {name: i for i, name in enumerate(rings)}
    groups: list[dict[str, Ring]] = []
    for name, ring in rings.items():
        for group in groups:
            other = next(iter(group.values()))
            if (
                ring.sensor == other.sensor
                and ring.num_sensors == other.num_sensors
                and (not by_phase or ring.phase == other.phase)
            ):
                group[name] = ring
                break
        else:
            groups.append({name: ring})
    return [RingGroup(rings=group, number=number) for group in groups]


def add_rings_to_world(world: World, rings: Mapping[str, Ring]) -> None:
    """Adds simulated rings with their noise; exports `scan_<ring>` of each.

    Args:
        world: That they see.
        rings: Of the cell; those of one phase sample together.
    """
    groups = group_rings(rings, by_phase=True)
    for group in sorted(groups, key=lambda group: group.one.phase):
        _add_group(world, group)


def _add_group(world, group):
    builder, name = world.builder, "_".join(group.name)
    sensor = group.one.sensor
    inspector = world.scene_graph.model_inspector()
    mounts = [
        find_ring_mount(world.plant, inspector, ring) for ring in group.name
    ]
    system = builder.AddNamedSystem(
        f"rings_{name}",
        TofRings(
            config=sensor,
            caster=world.caster,
            bundles=make_ring_bundles(
                config=sensor, caster=world.caster, mounts=mounts
            ),
            constants=_draw_constants(group, world.random_seed),
            phase=group.one.phase,
            noise_scans=_NOISE_SCANS,
            name=group.name,
        ),
    )
    _add_noise(builder, f"noise_{name}", system, group.traits.period)
    builder.Connect(
        world.scene_graph.get_query_output_port(),
        system.GetInputPort("geometry_query"),
    )
    for ring in group.name:
        port = f"scan_{ring}"
        builder.ExportOutput(system.GetOutputPort(port), port)


def _add_noise(builder, name, rings, period):
    """Adds the source of the noise, if the sensors have any."""
    port = rings.GetInputPort("noise")
    if port.size() == 0:
        return
    noise = builder.AddNamedSystem(
        name,
        RandomSource(
            distribution=RandomDistribution.kGaussian,
            num_outputs=port.size(),
            sampling_interval_sec=_NOISE_SCANS * period,
        ),
    )
    builder.Connect(noise.get_output_port(), port)


def _draw_constants(group, seed):
    """Draws what tells all sensors of some rings apart."""
    return np.concatenate(
        [
            draw_constants(
                group.traits,
                sensors=ring.num_sensors,
                seed=seed,
                ring=group.number[name],
            )
            for name, ring in group.rings.items()
        ]
    )


def add_rings_to_monitor(
    monitor: Monitor, rings: Mapping[str, Ring]
) -> list[Sensing]:
    """Adds mask, self-hit watch and separation of rings.

    Args:
        monitor: With the twin.
        rings: Of the cell.

    Returns:
        The separation of each group of alike rings, and the ports of its
        masked scans and of the watch.
    """
    if not rings:
        return []
    report = _add_report(monitor)
    groups = group_rings(rings)
    return [
        _add_group_to_monitor(
            monitor, group, report, "" if len(groups) == 1 else f"_{i}"
        )
        for i, group in enumerate(groups)
    ]


def _add_report(monitor) -> OutputPort:
    """Adds the robot's report as the mask takes it."""
    n = monitor.num_joints
    sizes = {
        "position_measured": n,
        "velocity_measured": n,
        "carried_objects": len(monitor.objects),
    }
    report = monitor.builder.AddNamedSystem(
        "robot_report", Multiplexer(list(sizes.values()))
    )
    for i, name in enumerate(sizes):
        monitor.connect_input(name, report.get_input_port(i))
    return report.get_output_port()


def _add_group_to_monitor(monitor, group, report, suffix) -> Sensing:
    builder, settings = monitor.builder, monitor.settings
    mask, geometries = _add_mask(monitor, group, f"mask{suffix}")
    builder.Connect(report, mask.GetInputPort("robot_report"))
    separation = builder.AddNamedSystem(
        f"separation{suffix}",
        TofSeparation(
            config=settings.separation,
            k_max=settings.k_max,
            kinematics=monitor.select_links(group.name),
            geometries=geometries,
            sensor_period=group.traits.period,
            name=group.name,
        ),
    )
    ports = [mask.GetOutputPort(f"masked_scan_{name}") for name in group.name]
    for port in ports:
        builder.Connect(port, separation.GetInputPort(port.get_name()))
    outputs = {port.get_name(): port for port in ports}
    result = separation.GetOutputPort("separation")
    if settings.self_hits.enabled:
        health = _add_watch(monitor, group, ports, report, suffix)
        stop = builder.AddNamedSystem(
            f"self_hit_stop{suffix}", SelfHitStop(group.name)
        )
        builder.Connect(health, stop.GetInputPort("self_hit_health"))
        builder.Connect(result, stop.GetInputPort("separation"))
        result = stop.GetOutputPort("separation")
        outputs[f"self_hit_health{suffix}"] = health
    return Sensing(links=group.name, separation=result, outputs=outputs)


def _add_watch(monitor, group, ports, report, suffix) -> OutputPort:
    """Adds the self-hit watch; returns its port."""
    builder = monitor.builder
    watch = builder.AddNamedSystem(
        f"self_hit_watch{suffix}",
        SelfHitWatch(
            model=make_group_self_hits(monitor, group),
            period=_calc_look_period(monitor.settings, group),
        ),
    )
    for port in ports:
        builder.Connect(port, watch.GetInputPort(port.get_name()))
    builder.Connect(report, watch.GetInputPort("robot_report"))
    return watch.GetOutputPort("self_hit_health")


def _calc_look_period(settings, group):
    """Returns the time between looks, a multiple of the control tick."""
    wanted = settings.self_hits.scans_per_look * group.traits.period
    tick = settings.control_period
    return max(1, math.ceil(wanted / tick - 1e-6)) * tick


def make_group_self_hits(monitor: Monitor, group: RingGroup) -> SelfHitModel:
    """Makes the model of what alike rings should see of the robot.

    Args:
        monitor: With the twin.
        group: Of the cell.
    """
    inspector = monitor.scene_graph.model_inspector()
    caster = RayCaster(inspector)
    return make_self_hit_model(
        config=monitor.settings.self_hits,
        mask_config=monitor.settings.mask,
        sensor=group.traits,
        caster=caster,
        mounts=[
            find_ring_mount(monitor.plant, inspector, name)
            for name in group.name
        ],
        make_twin=functools.partial(_pose_twin, monitor),
        name=group.name,
        is_dead=group.find_dead_sensors(),
    )


def _pose_twin(monitor, caster):
    return TwinPoses.from_plant(
        monitor.plant,
        objects=monitor.objects,
        frame_ids=caster.frame_ids,
        kinematics=monitor.kinematics,
    )


def _add_mask(monitor, group, name):
    """Adds the mask with its scans; returns it, and the rings' geometry."""
    settings = monitor.settings
    inspector = monitor.scene_graph.model_inspector()
    caster = RayCaster(inspector)
    mounts = [
        find_ring_mount(monitor.plant, inspector, ring) for ring in group.name
    ]
    parts = {
        "config": settings.mask,
        "sensor": group.traits,
        "caster": caster,
        "mounts": mounts,
    }
    proof = make_proof_bundles(**parts) if settings.self_hits.enabled else None
    bundles = make_mask_bundles(**parts)
    mask = monitor.builder.AddNamedSystem(
        name,
        OcclusionMask(
            config=settings.mask,
            sensor=group.traits,
            caster=caster,
            period=settings.control_period,
            proof_bundles=proof,
            is_dead=group.find_dead_sensors(),
            bundles=bundles,
            # After the bundles, which may add frames to the caster's.
            twin=_pose_twin(monitor, caster),
            name=group.name,
        ),
    )
    for ring in group.name:
        port = f"scan_{ring}"
        monitor.connect_input(port, mask.GetInputPort(port))
    return mask, [make_ring_geometry(mount.X_LS) for mount in mounts]
