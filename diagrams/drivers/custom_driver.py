"""A driver of one's own as a choice of a scenario."""

import dataclasses as dc

import numpy as np

from tofssm_drake.diagrams.drivers.real_cell import RealCell
from tofssm_drake.errors import UserError, require
from tofssm_drake.factory import call_factory, call_factory_once, tell
from tofssm_drake.robots.driver import (
    Driver,
    DriverTraits,
    ProgressReport,
    Tap,
)
from tofssm_drake.robots.robot_connection import RobotConnection
from tofssm_drake.tasks.path import ProgramPath


@dc.dataclass(kw_only=True)
class CustomDriver(RealCell):
    """A robot that someone else's code talks to, see `Driver`."""

    # The function that returns the driver, "package.module:function". Python
    # looks for the module where it looks for all, and in the current folder.
    factory: str = ""

    # Its keyword arguments, e.g. the address of the controller.
    parameters: dict[str, bool | int | float | str] = dc.field(
        default_factory=dict
    )

    def check(self, where: str) -> None:
        """Raises UserError unless the factory makes a `Driver`.

        Nothing is opened.
        """
        super().check(where)
        require(
            bool(self.factory),
            f'{where}.factory: must be "package.module:function"',
        )
        driver = call_factory(self.factory, self.parameters, where=where)
        where = f"{where}.factory: {self.factory}: what it returns has no"
        traits = getattr(driver, "traits", None)
        if not isinstance(traits, DriverTraits):
            raise UserError(f"{where} `traits` of type DriverTraits")
        for method in (
            "open(*, write, tap)",
            "find_carried_objects(report, path)",
        ):
            require(
                callable(getattr(driver, method.partition("(")[0], None)),
                f"{where} method `{method}`",
            )

    @property
    def traits(self) -> DriverTraits:
        """See `Driver`."""
        return self._load().traits

    def open(
        self, *, write: bool = True, tap: Tap | None = None
    ) -> RobotConnection:
        """Connects to the robot, see `Driver`.

        Raises:
            UserError: The driver raises.
        """
        try:
            return self._load().open(write=write, tap=tap)
        except UserError:
            raise
        except Exception as error:
            raise UserError(f"{self.factory}: open: {tell(error)}") from error

    def find_carried_objects(
        self, report: ProgressReport, path: ProgramPath
    ) -> np.ndarray:
        """Returns each object's place, see `Driver`.

        Raises:
            UserError: They are not the task's objects.
        """
        places = self._load().find_carried_objects(report, path)
        count = len(path.objects)
        require(
            np.shape(places) == (count,) and bool(np.isfinite(places).all()),
            f"{self.factory}: find_carried_objects: must return a number for "
            f"each of the task's {count} objects, got {places!r}",
        )
        return places

    def _load(self) -> Driver:
        return call_factory_once(self.factory, self.parameters, where="driver")
