"""Objects that a robot may carry: on its tool, or at one of their places.

A task says which objects there are (`CarriableObjects`), and at each moment
where they are: for each object the number of its place, or `ON_TOOL`. That is
what the ports `carried_objects` hold, and all that a monitor knows of grippers.
"""

import dataclasses as dc

import numpy as np

from tofssm_drake.kernels import njit

ON_TOOL = -1
"""In place of the number of a place: the object hangs on the tool."""


@dc.dataclass(frozen=True, eq=False, kw_only=True)
class CarriableObjects:
    """The p objects of a task, and where each of them may be."""

    X_TO: np.ndarray
    """Pose of each object in the tool's frame while it is carried, m,
    (p, 3, 4)."""
    X_WO: np.ndarray
    """Each object's k places in world, m, (p, k, 3, 4)."""
    setting: tuple[tuple[str, ...], ...]
    """Which setting each place comes from, for messages, (p, k)."""

    @staticmethod
    def make_empty() -> "CarriableObjects":
        """Returns those of a task that carries nothing that can be seen."""
        return CarriableObjects(
            X_TO=np.empty((0, 3, 4)), X_WO=np.empty((0, 1, 3, 4)), setting=()
        )

    def __len__(self) -> int:
        return len(self.X_TO)

    def calc_poses(self, carried: np.ndarray, X_WT: np.ndarray) -> np.ndarray:
        """Returns where the objects are in world, m, (p, 3, 4).

        Args:
            carried: Place of each object, or ON_TOOL, (p,).
            X_WT: Pose of the tool, m, (3, 4).
        """
        X = np.empty((len(self), 3, 4))
        for i in range(len(self)):
            calc_object_pose(self.X_TO, self.X_WO, i, carried[i], X_WT, X[i])
        return X


@njit(cache=True)
def calc_object_pose(X_TO, X_WO, i, place, X_WT, X):
    """Writes the pose of an object in world, m, (3, 4).

    Args:
        X_TO: Of `CarriableObjects`, as the next.
        X_WO: The objects' places.
        i: Number of the object.
        place: Where it is; ON_TOOL: on the tool.
        X_WT: Pose of the tool, m, (3, 4).
        X: Written.
    """
    if place < 0:
        for row in range(3):
            for column in range(4):
                total = X_WT[row, 3] if column == 3 else 0.0
                for k in range(3):
                    total += X_WT[row, k] * X_TO[i, k, column]
                X[row, column] = total
    else:
        X[:] = X_WO[i, min(int(place), X_WO.shape[1] - 1)]
