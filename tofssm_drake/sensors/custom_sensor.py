"""A sensor model of one's own as a choice of a scenario."""

import dataclasses as dc

import numpy as np

from tofssm_drake.errors import UserError, require
from tofssm_drake.factory import call_factory, call_factory_once
from tofssm_drake.sensors.range_sensor import (
    RangeSensor,
    SensorTraits,
    measure_checked,
)


@dc.dataclass(kw_only=True)
class CustomSensor:
    """A sensor model that someone else's code makes, see `RangeSensor`."""

    # The function that returns the model, "package.module:function". Python
    # looks for the module where it looks for all, and in the current folder.
    factory: str = ""

    # Its keyword arguments.
    parameters: dict[str, bool | int | float | str] = dc.field(
        default_factory=dict
    )

    def check(self, where: str) -> None:
        """Raises UserError unless the factory makes a `RangeSensor`.

        The model is asked to measure, twice the same.
        """
        require(
            bool(self.factory),
            f'{where}.factory: must be "package.module:function"',
        )
        sensor = call_factory(self.factory, self.parameters, where=where)
        where = f"{where}.factory: {self.factory}"
        traits = getattr(sensor, "traits", None)
        if not isinstance(traits, SensorTraits):
            raise UserError(
                f"{where}: what it returns has no `traits` of type SensorTraits"
            )
        require(
            callable(getattr(sensor, "measure", None)),
            f"{where}: what it returns has no method "
            "`measure(ray_distance, noise, constants)`",
        )
        traits.check(f"{where}: traits")
        _try_to_measure(sensor, traits, where)

    @property
    def traits(self) -> SensorTraits:
        """See `RangeSensor`."""
        return self._load().traits

    def measure(
        self,
        ray_distance: np.ndarray,
        noise: np.ndarray,
        constants: np.ndarray,
    ) -> tuple[np.ndarray, np.ndarray]:
        """See `RangeSensor`."""
        return self._load().measure(ray_distance, noise, constants)

    def _load(self) -> RangeSensor:
        return call_factory_once(
            self.factory, self.parameters, where="sensors.<ring>.sensor"
        )


def _try_to_measure(sensor, traits, where):
    """Raises UserError unless a model measures as it must."""
    rays = np.full((4, traits.rays_per_sensor), np.inf)
    rays[1:] = np.array([[0.0], [0.5], [1.0]]) * traits.cast_range
    generator = np.random.default_rng(0)
    noise = generator.standard_normal((4, traits.noise_draws))
    constants = generator.standard_normal((4, traits.constant_draws))
    try:
        one, other = (
            measure_checked(sensor, rays.copy(), noise.copy(), constants.copy())
            for _ in range(2)
        )
    except Exception as error:
        text = " ".join(str(error).split())
        raise UserError(
            f"{where}: measure: {type(error).__name__}: {text}"
        ) from error
    require(
        all(
            np.array_equal(a, b, equal_nan=True)
            for a, b in zip(one, other, strict=True)
        ),
        f"{where}: measure: twice the same gives different results; it must "
        "take random numbers from `noise` only, and remember nothing",
    )
