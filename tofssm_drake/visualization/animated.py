"""Meshcat properties that also play back in a recording.

A Meshcat recording holds poses and properties only: objects cannot come
and go, so each look of a thing is an object of its own, shown or hidden.
Between two keyframes the player interpolates, so that a value which stays
and then jumps needs a keyframe on both sides of the jump.
"""

from pydrake.geometry import Meshcat


class AnimatedProperty:
    """One property of one Meshcat path, written only when it changes.

    The value last written is not State: it affects no output and lives as
    long as the browser's picture of it.

    Args:
        meshcat: Where to draw.
        path: Path of the object.
        name: Name of the property, e.g. `visible` or `scale`.
        hold: Whether to write the old value once more before a jump.
            Booleans are not interpolated and need none.
    """

    def __init__(
        self, *, meshcat: Meshcat, path: str, name: str, hold: bool = False
    ):
        self._meshcat = meshcat
        self._path = path
        self._name = name
        self._hold = hold
        self._value: object = None
        self._time: float | None = None

    def set(self, value, time: float, period: float) -> None:
        """Sets the property.

        Args:
            value: New value.
            time: Time in the recording, s.
            period: Between frames, s.
        """
        before = time if self._time is None else self._time
        if time < before:
            self._value = None  # A new run: draw everything again.
        if value == self._value:
            return
        if (
            self._hold
            and self._value is not None
            and time - before > 1.5 * period
        ):
            self._write(self._value, time - period)
        self._write(value, time)
        self._value = value
        self._time = time

    def _write(self, value, time):
        self._meshcat.SetProperty(self._path, self._name, value, time)
