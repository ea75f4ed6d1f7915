"""A planar lidar in a cell: its systems in the world and in the monitor."""

from collections.abc import Sequence
import dataclasses as dc

import numpy as np
from pydrake.common import RandomDistribution
from pydrake.geometry import GeometryId, Role, SceneGraphInspector
from pydrake.math import RollPitchYaw
from pydrake.multibody.plant import MultibodyPlant
from pydrake.multibody.tree import FixedOffsetFrame
from pydrake.systems.primitives import RandomSource

from tofssm_drake.diagrams.sensors.parts import Monitor, Sensing, World
from tofssm_drake.errors import UserError, require
from tofssm_drake.perception.lidar_separation import (
    LidarSeparation,
    LidarSeparationConfig,
)
from tofssm_drake.perception.twin import TwinPoses
from tofssm_drake.poses import Pose
from tofssm_drake.raycast.ray_caster import RayBundles, RayCaster
from tofssm_drake.sensors.lidar_2d import (
    Lidar2d,
    Lidar2dConfig,
    make_lidar_bundle,
)
from tofssm_drake.sensors.ring import find_frame


@dc.dataclass(kw_only=True)
class PlanarLidar:
    """A planar lidar that stands in the cell and watches the whole robot.

    Its plane must be below the reach of the robot: the background is learned
    once, from a scan of the empty cell.
    """

    # Frame of the cell that carries the lidar.
    parent: str = "world"

    # Frame S of the scanner in it; the plane is that of x and y (*assumed*:
    # at the height of a person's shins).
    X_PS: Pose = dc.field(
        default_factory=lambda: Pose(translation=[0.0, 0.0, 0.3])
    )

    # Models that the lidar surrounds: it does not see them.
    housing: list[str] = dc.field(default_factory=list)

    # How well it measures, and how often.
    sensor: Lidar2dConfig = dc.field(default_factory=Lidar2dConfig)

    # From scans to distance and directed speeds.
    separation: LidarSeparationConfig = dc.field(
        default_factory=LidarSeparationConfig
    )

    def check(self, where: str) -> None:
        """Raises UserError unless every setting is within its limits."""
        require(bool(self.parent), f"{where}.parent: name a frame of the cell")
        self.X_PS.check(f"{where}.X_PS")
        self.sensor.check(f"{where}.sensor")
        self.separation.check(f"{where}.separation")

    def add_frames(self, plant: MultibodyPlant, name: str) -> None:
        """Adds the frame `<name>_scanner` to a plant not yet finalized."""
        parent = find_frame(plant, self.parent, f"sensors.{name}.parent")
        plant.AddFrame(
            FixedOffsetFrame(
                f"{name}_scanner", parent, self.X_PS.to_transform()
            )
        )

    def find_link_frames(self, name: str) -> dict[str, str]:
        """Returns the frame of the only link: the lidar itself."""
        return {name: f"{name}_scanner"}


def add_lidar_to_world(world: World, name: str, lidar: PlanarLidar) -> None:
    """Adds a simulated lidar with its noise; exports `scan_<name>`."""
    builder = world.builder
    system = builder.AddNamedSystem(
        name,
        Lidar2d(
            config=lidar.sensor,
            caster=world.caster,
            bundle=make_bundle(
                name,
                lidar,
                world.caster,
                world.plant,
                world.scene_graph.model_inspector(),
            ),
        ),
    )
    noise = builder.AddNamedSystem(
        f"noise_{name}",
        RandomSource(
            distribution=RandomDistribution.kGaussian,
            num_outputs=system.GetInputPort("noise").size(),
            sampling_interval_sec=lidar.sensor.period,
        ),
    )
    builder.Connect(noise.get_output_port(), system.GetInputPort("noise"))
    builder.Connect(
        world.scene_graph.get_query_output_port(),
        system.GetInputPort("geometry_query"),
    )
    builder.ExportOutput(system.GetOutputPort("scan"), f"scan_{name}")


def add_lidar_to_monitor(
    monitor: Monitor, name: str, lidar: PlanarLidar
) -> Sensing:
    """Adds the separation of a lidar.

    Its background is a scan of the twin, in which there are no people.

    Raises:
        UserError: If the lidar has no free view.
    """
    inspector = monitor.scene_graph.model_inspector()
    caster = RayCaster(inspector)
    bundle = make_bundle(name, lidar, caster, monitor.plant, inspector)
    twin = TwinPoses.from_plant(
        monitor.plant,
        objects=monitor.objects,
        frame_ids=caster.frame_ids,
        kinematics=monitor.kinematics,
    )
    settings = monitor.settings
    yaw = _find_yaw(name, monitor.plant)
    system = monitor.builder.AddNamedSystem(
        f"separation_{name}",
        LidarSeparation(
            config=dc.replace(
                lidar.separation,
                max_gap=lidar.separation.calc_max_gap(lidar.sensor.period),
            ),
            k_max=settings.k_max,
            kinematics=monitor.kinematics,
            background=scan_background(
                caster=caster,
                bundle=bundle,
                twin=twin,
                postures=settings.postures,
                margin=lidar.separation.background_margin,
                where=f"sensors.{name}.X_PS",
            ),
            period=settings.control_period,
            yaw=yaw,
            name=name,
        ),
    )
    monitor.connect_input(f"scan_{name}", system.GetInputPort("scan"))
    for port in ("position_measured", "velocity_measured"):
        monitor.connect_input(port, system.GetInputPort(port))
    return Sensing(
        links=(name,),
        separation=system.GetOutputPort("separation"),
        threshold_offset=lidar.separation.threshold_offset,
    )


def make_bundle(
    name: str,
    lidar: PlanarLidar,
    caster: RayCaster,
    plant: MultibodyPlant,
    inspector: SceneGraphInspector,
) -> RayBundles:
    """Makes the rays of a lidar that is fixed in the cell.

    Args:
        name: Of the lidar.
        lidar: Checked settings.
        caster: What the rays are cast against.
        plant: Of the cell, registered with the inspector's SceneGraph.
        inspector: Knows the shapes.

    Raises:
        UserError: The lidar moves, or its housing is not in the cell.
    """
    frame = plant.GetFrameByName(f"{name}_scanner")
    require(
        plant.IsAnchored(frame.body()),
        f"sensors.{name}.parent: {lidar.parent!r} moves; the lidar must stand "
        "still",
    )
    return make_lidar_bundle(
        config=lidar.sensor,
        caster=caster,
        X_FS=frame.CalcPoseInWorld(plant.CreateDefaultContext()),
        excluded=_find_housing(name, lidar.housing, plant, inspector),
    )


def _find_yaw(name, plant) -> float:
    """Returns the angle of the scanner's x axis about the world's z, rad.

    Raises:
        UserError: The scanner's plane is not level.
    """
    frame = plant.GetFrameByName(f"{name}_scanner")
    R_WS = frame.CalcPoseInWorld(plant.CreateDefaultContext()).rotation()
    require(
        R_WS.matrix()[2, 2] > 1.0 - 1e-9,
        f"sensors.{name}.X_PS: the scanner's plane must be level, its z axis "
        "up",
    )
    return float(RollPitchYaw(R_WS).yaw_angle())


def _find_housing(
    name: str,
    housing: Sequence[str],
    plant: MultibodyPlant,
    inspector: SceneGraphInspector,
) -> Sequence[GeometryId]:
    for model in housing:
        if not plant.HasModelInstanceNamed(model):
            raise UserError(
                f"sensors.{name}.housing: the cell has no model {model!r}"
            )
    return [
        geometry_id
        for model in housing
        for body in plant.GetBodyIndices(plant.GetModelInstanceByName(model))
        for geometry_id in inspector.GetGeometries(
            plant.GetBodyFrameIdOrThrow(body), Role.kPerception
        )
    ]


def scan_background(
    *,
    caster: RayCaster,
    bundle: RayBundles,
    twin: TwinPoses,
    postures: np.ndarray,
    margin: float,
    where: str,
) -> np.ndarray:
    """Returns the exact ranges in the empty cell, m, (n,).

    Args:
        caster: Of the twin's SceneGraph, in which there are no people.
        bundle: The lidar's rays.
        twin: Poses the caster's frames.
        postures: Joints of the robot along its task, rad or m, (k, n); the
            scan is made in the first.
        margin: A return this far before the background is a person's, m.
        where: What the user calls the lidar's pose, for the message.

    Raises:
        UserError: If the lidar is inside something, or would take the robot
            for a person.
    """
    # Objects are in their first places, above the lidar's plane.
    places = np.zeros(twin.num_objects)
    ranges = [
        caster.cast_bundles(bundle, twin.calc(q, places))[0][0]
        for q in postures
    ]
    background = ranges[0]
    require(
        bool((background > 0.0).all()),
        f"{where}: the lidar is inside the robot or something in its cell; use "
        "a height at which it has a free view, such as 0.3 m",
    )
    require(
        bool((np.min(ranges, axis=0) >= background - margin).all()),
        f"{where}: the robot crosses the lidar's plane during its task and "
        "would be taken for a person; use a plane below its reach, such as "
        "0.3 m",
    )
    return background
