"""Where the products are: on the table, in the gripper or in the box.

A pure function of what a real robot also reports: how many products it has
placed (a register), whether its gripper is closed (a digital output), and its
joints. Hence the same function poses the products of the simulated cell and
those of the monitor's twin.
"""

import dataclasses as dc

import numpy as np
from pydrake.systems.framework import BasicVector, Context, LeafSystem

from tofssm_drake.arms.kinematics import ArmKinematics
from tofssm_drake.kernels import njit
from tofssm_drake.tasks.program import (
    PickAndPlace,
    calc_pick_slots,
    calc_place_slots,
)

HALF_PRODUCT = 0.0275
"""From a product's middle to its faces, m (models/workcell/product.urdf)."""


@dc.dataclass(frozen=True, eq=False, kw_only=True)
class ProductLayout:
    """Slots of the n products before and after."""

    pick_slots: np.ndarray
    """Middle of each product before, m in world, (n, 3)."""
    place_slots: np.ndarray
    """Middle of each product in the box, m in world, (n, 3)."""
    pick_yaw: float
    """Orientation of a product before, rad about the world's z."""
    place_yaw: float
    """Orientation of a product in the box, rad about the world's z."""

    @staticmethod
    def from_config(config: PickAndPlace) -> "ProductLayout":
        """Returns the layout that the program works on."""
        return ProductLayout(
            pick_slots=calc_pick_slots(config),
            place_slots=calc_place_slots(config),
            pick_yaw=float(np.deg2rad(config.pick_yaw)),
            place_yaw=float(np.deg2rad(config.pick_yaw + config.sweep)),
        )

    @staticmethod
    def make_empty() -> "ProductLayout":
        """Returns the layout of a task without products."""
        none = np.empty((0, 3))
        return ProductLayout(
            pick_slots=none, place_slots=none, pick_yaw=0.0, place_yaw=0.0
        )

    def __len__(self) -> int:
        return len(self.pick_slots)


@njit(cache=True)
def _write_slot(slot, yaw, X_WP):
    c = np.cos(yaw)
    s = np.sin(yaw)
    X_WP[:] = 0.0
    X_WP[0, 0] = c
    X_WP[0, 1] = -s
    X_WP[1, 0] = s
    X_WP[1, 1] = c
    X_WP[2, 2] = 1.0
    X_WP[:, 3] = slot


@njit(cache=True)
def calc_carried_pose(X_WT, X_WP):
    """Writes the pose of the product in the gripper, (3, 4).

    Its middle is at the tool centre point; it is turned by half a turn about
    the tool's x axis, so that its z points up when the tool points down.
    """
    for row in range(3):
        X_WP[row, 0] = X_WT[row, 0]
        X_WP[row, 1] = -X_WT[row, 1]
        X_WP[row, 2] = -X_WT[row, 2]
        X_WP[row, 3] = X_WT[row, 3]


@njit(cache=True)
def calc_product_poses(
    pick_slots, place_slots, pick_yaw, place_yaw, placed, closed, X_WT, X_WP
):
    """Poses of the products.

    Product i < placed is in its slot in the box; product `placed` is in the
    gripper if that is closed, see `calc_carried_pose`; all others are in their
    slots on the table.

    Args:
        pick_slots: Middle of each product before, m, (n, 3).
        place_slots: Middle of each product in the box, m, (n, 3).
        pick_yaw: Orientation before, rad about the world's z.
        place_yaw: Orientation in the box, rad about the world's z.
        placed: How many are in the box.
        closed: Whether the gripper is closed.
        X_WT: Pose of the tool centre point, (3, 4).
        X_WP: Written: poses of the products, (n, 3, 4).
    """
    for i in range(pick_slots.shape[0]):
        if i < placed:
            _write_slot(place_slots[i], place_yaw, X_WP[i])
        elif i == placed and closed:
            calc_carried_pose(X_WT, X_WP[i])
        else:
            _write_slot(pick_slots[i], pick_yaw, X_WP[i])


@njit(cache=True)
def write_free_body_positions(X, positions):
    """Writes poses as quaternion (w, x, y, z) and position.

    Args:
        X: Poses, (n, 3, 4).
        positions: Written, (n, 7).
    """
    for i in range(X.shape[0]):
        # Dividing by the largest of the four components is well conditioned.
        r = X[i]
        trace = r[0, 0] + r[1, 1] + r[2, 2]
        largest = 0
        value = trace
        for k in range(3):
            if r[k, k] > value:
                value = r[k, k]
                largest = k + 1
        if largest == 0:
            w = np.sqrt(1.0 + trace) / 2
            x = (r[2, 1] - r[1, 2]) / (4 * w)
            y = (r[0, 2] - r[2, 0]) / (4 * w)
            z = (r[1, 0] - r[0, 1]) / (4 * w)
        elif largest == 1:
            x = np.sqrt(1.0 + r[0, 0] - r[1, 1] - r[2, 2]) / 2
            w = (r[2, 1] - r[1, 2]) / (4 * x)
            y = (r[0, 1] + r[1, 0]) / (4 * x)
            z = (r[0, 2] + r[2, 0]) / (4 * x)
        elif largest == 2:
            y = np.sqrt(1.0 - r[0, 0] + r[1, 1] - r[2, 2]) / 2
            w = (r[0, 2] - r[2, 0]) / (4 * y)
            x = (r[0, 1] + r[1, 0]) / (4 * y)
            z = (r[1, 2] + r[2, 1]) / (4 * y)
        else:
            z = np.sqrt(1.0 - r[0, 0] - r[1, 1] + r[2, 2]) / 2
            w = (r[1, 0] - r[0, 1]) / (4 * z)
            x = (r[0, 2] + r[2, 0]) / (4 * z)
            y = (r[1, 2] + r[2, 1]) / (4 * z)
        norm = np.sqrt(w * w + x * x + y * y + z * z)
        positions[i, 0] = w / norm
        positions[i, 1] = x / norm
        positions[i, 2] = y / norm
        positions[i, 3] = z / norm
        positions[i, 4] = r[0, 3]
        positions[i, 5] = r[1, 3]
        positions[i, 6] = r[2, 3]


def calc_product_positions(
    *,
    layout: ProductLayout,
    kinematics: ArmKinematics,
    q: np.ndarray,
    gripper_closed: float,
    products_placed: float,
) -> np.ndarray:
    """Returns the positions of the products as of free bodies.

    Args:
        layout: Slots.
        kinematics: Of the robot; gives the pose of its tool.
        q: Joint angles, rad, (6,).
        gripper_closed: More than 0.5 is closed.
        products_placed: How many products were let go of in the box.

    Returns:
        Quaternion (w, x, y, z) and position in world, m, (n, 7).
    """
    X_WP = np.empty((len(layout), 3, 4))
    calc_product_poses(
        layout.pick_slots,
        layout.place_slots,
        layout.pick_yaw,
        layout.place_yaw,
        round(products_placed),
        gripper_closed > 0.5,
        kinematics.calc_tcp_pose(q),
        X_WP,
    )
    positions = np.empty((len(layout), 7))
    write_free_body_positions(X_WP, positions)
    return positions


class ProductCarrier(LeafSystem):
    """Outputs where the products are, as positions of free bodies.

    .. pydrake_system::

        name: ProductCarrier
        input_ports:
        - position_measured
        - gripper_closed
        - products_placed
        output_ports:
        - product_positions

    `product_positions` holds, per product, a quaternion (w, x, y, z) and a
    position in world, m: the order of a MultibodyPlant's free bodies.

    Args:
        layout: Slots of the products.
        kinematics: Of the robot.
    """

    def __init__(self, *, layout: ProductLayout, kinematics: ArmKinematics):
        super().__init__()
        self._layout = layout
        self._kinematics = kinematics
        self._position = self.DeclareVectorInputPort(
            "position_measured", kinematics.num_joints
        )
        self._gripper_closed = self.DeclareVectorInputPort("gripper_closed", 1)
        self._products_placed = self.DeclareVectorInputPort(
            "products_placed", 1
        )
        self.DeclareVectorOutputPort(
            "product_positions",
            7 * len(layout),
            self._calc_product_positions,
            {
                self._position.ticket(),
                self._gripper_closed.ticket(),
                self._products_placed.ticket(),
            },
        )

    def _calc_product_positions(
        self, context: Context, output: BasicVector
    ) -> None:
        positions = calc_product_positions(
            layout=self._layout,
            kinematics=self._kinematics,
            q=self._position.Eval(context),
            gripper_closed=self._gripper_closed.Eval(context)[0],
            products_placed=self._products_placed.Eval(context)[0],
        )
        output.SetFromVector(positions.reshape(-1))
