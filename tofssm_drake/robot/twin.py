"""The cell as a MultibodyPlant, and a fast way to pose a copy of it.

`make_cell_plant` parses the same models for everyone: with a SceneGraph for
what is seen, without one for dynamics. The monitor's occlusion mask has its
own copy, the twin, and poses it from measured joints at each sensor's own
sample time. `TwinPoses` does that without a plant context.
"""

import dataclasses as dc

from numba import njit
import numpy as np
from pydrake.geometry import SceneGraph
from pydrake.multibody.plant import MultibodyPlant

from tofssm_drake.errors import UserError
import tofssm_drake.models as models
from tofssm_drake.robot.kinematics import (
    UR10_JOINTS,
    RingKinematics,
    calc_link_poses,
)
from tofssm_drake.robot.products import (
    ProductLayout,
    calc_product_poses,
    calc_product_positions,
)
from tofssm_drake.robot.ring_looks import add_ring_looks

_URL = f"package://{models.PACKAGE}/"


def make_cell_plant(
    *,
    sensors_per_ring: int = 8,
    products: int = 0,
    scene_graph: SceneGraph | None = None,
    time_step: float = 0.0,
    cell: bool = True,
    meshes: bool = False,
) -> MultibodyPlant:
    """Makes the plant of robot, gripper, rings, cell and products.

    Args:
        sensors_per_ring: Which ring model to load; 0 loads none.
        products: Number of products, free bodies `product_0` and so on in
            model instances of the same name.
        scene_graph: Where to register the geometry; without it the plant has
            none and its steps cost nothing for contact.
        time_step: Of the discrete plant, s; 0 is continuous.
        cell: Whether to load floor, pedestal, tables and box. Without them
            the base is welded to the same place.
        meshes: Whether what is seen of the robot is Universal Robots' own
            meshes instead of primitive shapes; needs the SceneGraph and the
            optional extra `meshes`.

    Returns:
        A finalized plant.

    Raises:
        UserError: If there is no ring model for that many sensors.
    """
    plant = MultibodyPlant(time_step)
    if scene_graph is not None:
        plant.RegisterAsSourceForSceneGraph(scene_graph)
    parser = models.make_parser(plant)
    if cell:
        parser.AddModelsFromUrl(_URL + "workcell/workcell.dmd.yaml")
    else:
        parser.AddModelsFromUrl(_URL + "ur10/ur10_gripper.dmd.yaml")
        plant.WeldFrames(
            plant.world_frame(),
            plant.GetFrameByName("base"),
            _read_base_pose(),
        )
    if sensors_per_ring:
        folder = models.find_package_xml().parent / "rings"
        file = f"rings_{sensors_per_ring}.dmd.yaml"
        if not (folder / file).exists():
            shipped = sorted(
                int(path.name.split(".")[0].removeprefix("rings_"))
                for path in folder.glob("rings_*.dmd.yaml")
            )
            raise UserError(
                f"sensors_per_ring: no ring model with {sensors_per_ring} "
                f"sensors; there are {', '.join(map(str, shipped))}"
            )
        parser.AddModelsFromUrl(_URL + "rings/" + file)
    for i in range(products):
        (instance,) = parser.AddModelsFromUrl(_URL + "workcell/product.sdf")
        plant.RenameModelInstance(instance, f"product_{i}")
    if time_step > 0:
        # Outputs show the state itself: a quarter faster, and nothing here
        # reads what would be sampled (contact results).
        plant.SetUseSampledOutputPorts(False)
    plant.Finalize()
    if sensors_per_ring and scene_graph is not None:
        add_ring_looks(plant, scene_graph)
    if meshes:
        if scene_graph is None:
            raise ValueError("meshes: there is no scene_graph to put them in")
        # Its libraries are optional.
        from tofssm_drake.robot.meshes import replace_robot_shapes

        replace_robot_shapes(plant, scene_graph)
    return plant


def _read_base_pose():
    """Returns where the cell's model puts the robot's base."""
    plant = MultibodyPlant(0.0)
    parser = models.make_parser(plant)
    parser.AddModelsFromUrl(_URL + "workcell/cell.dmd.yaml")
    plant.Finalize()
    return plant.GetFrameByName("robot_base").CalcPoseInWorld(
        plant.CreateDefaultContext()
    )


def make_twin_plant(
    *,
    scene_graph: SceneGraph,
    sensors_per_ring: int = 8,
    products: int = 10,
    meshes: bool = False,
) -> MultibodyPlant:
    """Makes the plant of everything that is part of robot and cell.

    Its positions are [q (6), product_0 (7), product_1 (7), ...].
    """
    return make_cell_plant(
        sensors_per_ring=sensors_per_ring,
        products=products,
        scene_graph=scene_graph,
        meshes=meshes,
    )


@njit(cache=True)
def calc_twin_poses(
    X_WB,
    X_PJ,
    X_6T,
    kind,
    X_AF,
    pick_slots,
    place_slots,
    pick_yaw,
    place_yaw,
    q,
    placed,
    closed,
    X_WF,
):
    """Poses of frames that stand still, ride on the robot or are products.

    Args:
        X_WB: Pose of the robot's base, (3, 4).
        X_PJ: As in `calc_link_poses`, (6, 3, 4).
        X_6T: Pose of the tool centre point in the last link, (3, 4).
        kind: Per frame: -1 stands still, 0 to 6 rides on that link, 7 + i is
            product i, (f,).
        X_AF: Pose of each frame in world, in its link, or in its product,
            (f, 3, 4).
        pick_slots: As in `calc_product_poses`, like the next three.
        place_slots: As above.
        pick_yaw: As above.
        place_yaw: As above.
        q: Joint angles, rad, (6,).
        placed: How many products are in the box.
        closed: Whether the gripper is closed.
        X_WF: Written, (f, 3, 4).
    """
    n = q.shape[0]
    X_WA = np.empty((n + 1, 3, 4))
    calc_link_poses(X_WB, X_PJ, q, X_WA)
    X_WT = np.empty((3, 4))
    _multiply(X_WA[n], X_6T, X_WT)
    X_WP = np.empty((pick_slots.shape[0], 3, 4))
    calc_product_poses(
        pick_slots,
        place_slots,
        pick_yaw,
        place_yaw,
        placed,
        closed,
        X_WT,
        X_WP,
    )
    for f in range(kind.shape[0]):
        if kind[f] < 0:
            X_WF[f] = X_AF[f]
        elif kind[f] <= n:
            _multiply(X_WA[kind[f]], X_AF[f], X_WF[f])
        else:
            _multiply(X_WP[kind[f] - n - 1], X_AF[f], X_WF[f])


@njit(cache=True)
def _multiply(X_AB, X_BC, X_AC):
    for row in range(3):
        for column in range(4):
            total = X_AB[row, 3] if column == 3 else 0.0
            for k in range(3):
                total += X_AB[row, k] * X_BC[k, column]
            X_AC[row, column] = total


@dc.dataclass(frozen=True, eq=False, kw_only=True)
class TwinPoses:
    """Poses the twin's frames from joints, gripper and product count.

    Made by `from_plant`; one compiled call per set of poses, no context.
    """

    kinematics: RingKinematics
    layout: ProductLayout
    kind: np.ndarray
    """See `calc_twin_poses`, (f,)."""
    X_AF: np.ndarray
    """See `calc_twin_poses`, (f, 3, 4)."""

    @staticmethod
    def from_plant(
        plant: MultibodyPlant,
        *,
        layout: ProductLayout,
        frame_ids: list | None = None,
        frames: list | None = None,
        kinematics: RingKinematics | None = None,
    ) -> "TwinPoses":
        """Reads once what is fixed.

        Args:
            plant: Finalized, from `make_twin_plant`.
            layout: Slots of the plant's products.
            frame_ids: SceneGraph frames to pose, e.g. a ray caster's; their
                plant must be registered with that SceneGraph.
            frames: Or plant frames to pose.
            kinematics: Of the plant's robot, if at hand.

        Raises:
            UserError: If a frame is neither fixed in the cell, nor a part of
                the robot, nor a product of the layout.
        """
        kinematics = kinematics or RingKinematics.from_plant(plant)
        if frames is None:
            frames = []
            for frame_id in frame_ids or []:
                body = plant.GetBodyFromFrameId(frame_id)
                if body is None:
                    raise UserError("twin: a frame belongs to no body of it")
                frames.append(body.body_frame())
        context = plant.CreateDefaultContext()
        links = [plant.GetJointByName(UR10_JOINTS[0]).parent_body()]
        for name in UR10_JOINTS:
            links.append(plant.GetJointByName(name).child_body())
        anchors = [(-1, plant.world_body())]
        # The base stands still, as all that is welded to it.
        anchors += list(enumerate(links))[1:]
        anchors += [
            (
                len(links) + i,
                plant.GetBodyByName(
                    "product", plant.GetModelInstanceByName(f"product_{i}")
                ),
            )
            for i in range(len(layout))
        ]
        anchor_of = {}
        for kind, anchor in anchors:
            for body in plant.GetBodiesWeldedTo(anchor):
                anchor_of[body.index()] = (kind, anchor)
        kinds = []
        X_AF = []
        for frame in frames:
            if frame.body().index() not in anchor_of:
                raise UserError(
                    f"twin: body {frame.body().name()} is neither robot, "
                    "cell nor product"
                )
            kind, anchor = anchor_of[frame.body().index()]
            kinds.append(kind)
            X_AF.append(
                frame.CalcPose(context, anchor.body_frame()).GetAsMatrix34()
            )
        return TwinPoses(
            kinematics=kinematics,
            layout=layout,
            kind=np.array(kinds, dtype=np.int64),
            X_AF=np.array(X_AF).reshape(-1, 3, 4),
        )

    def calc(
        self,
        q: np.ndarray,
        gripper_closed: float,
        products_placed: float,
        X_WF: np.ndarray | None = None,
    ) -> np.ndarray:
        """Returns X_WF (f, 3, 4).

        Args:
            q: Joint angles, rad, (6,).
            gripper_closed: More than 0.5 is closed.
            products_placed: How many products are in the box.
            X_WF: Where to write, if given.
        """
        if X_WF is None:
            X_WF = np.empty_like(self.X_AF)
        kinematics = self.kinematics
        layout = self.layout
        calc_twin_poses(
            kinematics.X_WB,
            kinematics.X_PJ,
            kinematics.X_AS[-1],
            self.kind,
            self.X_AF,
            layout.pick_slots,
            layout.place_slots,
            layout.pick_yaw,
            layout.place_yaw,
            q,
            round(products_placed),
            gripper_closed > 0.5,
            X_WF,
        )
        return X_WF


def calc_twin_positions(
    *,
    layout: ProductLayout,
    kinematics: RingKinematics,
    q: np.ndarray,
    gripper_closed: float,
    products_placed: float,
) -> np.ndarray:
    """Returns the positions of a plant from `make_twin_plant`.

    Args:
        layout: Slots of its products.
        kinematics: Of its robot.
        q: Joint angles, rad, (6,).
        gripper_closed: More than 0.5 is closed.
        products_placed: How many products are in the box.
    """
    products = calc_product_positions(
        layout=layout,
        kinematics=kinematics,
        q=q,
        gripper_closed=gripper_closed,
        products_placed=products_placed,
    )
    return np.concatenate([q, products.reshape(-1)])
