"""Casts rays in a Diagram of one's own: the ray caster alone.

Run it with `python examples/cast_rays.py`.
"""

import numpy as np
from pydrake.geometry import Role, Sphere
from pydrake.math import RigidTransform
from pydrake.multibody.plant import AddMultibodyPlantSceneGraph
from pydrake.systems.framework import DiagramBuilder

from tofssm_drake.raycast import RayCaster, make_cone_fan


def measure():
    """Returns the distances along a cone of rays to a ball 2 m away, m."""
    builder = DiagramBuilder()
    plant, scene_graph = AddMultibodyPlantSceneGraph(builder, time_step=0.0)
    X_WG = RigidTransform([2.0, 0.0, 0.0])
    plant.RegisterVisualGeometry(
        plant.world_body(), X_WG, Sphere(0.5), "ball", np.ones(4)
    )
    plant.Finalize()
    diagram = builder.Build()
    context = diagram.CreateDefaultContext()

    # Shapes are read once, poses with each query.
    caster = RayCaster(scene_graph.model_inspector(), role=Role.kPerception)
    query_object = scene_graph.get_query_output_port().Eval(
        scene_graph.GetMyContextFromRoot(context)
    )
    bundles = caster.make_bundles(
        frame_id=caster.world_frame_id,
        X_FS=[RigidTransform()],
        fan_S=make_cone_fan(np.radians(25.0), 25),
        max_range=4.0,
    )
    X_WF = caster.poses_from_query_object(query_object)
    distances, _ = caster.cast_bundles(bundles, X_WF)
    return distances[0]


if __name__ == "__main__":
    print(measure().round(3))
