"""How far the task of a run is, in the task's own terms."""

import dataclasses as dc

import numpy as np

from tofssm_drake.recording.samples import Samples

# Path time is summed up from the record, so it is off by rounding, s.
_ROUNDING = 1e-6


@dc.dataclass(frozen=True, kw_only=True)
class TaskSteps:
    """What a task counts, such as products placed."""

    step: str = ""
    """One step as a noun and what is done with it, e.g. "product placed";
    empty: the task counts nothing."""
    steps: int = 0
    """How many there are."""

    def describe(self, done: int, *, with_total: bool = False) -> str:
        """Returns how far the task is; empty: it counts nothing.

        Args:
            done: Steps that are done.
            with_total: "3 of 10 products placed", not "3 products placed".
        """
        if not self.step:
            return ""
        noun, _, verb = self.step.partition(" ")
        plural = "" if (self.steps if with_total else done) == 1 else "s"
        count = f"{done} of {self.steps}" if with_total else f"{done or 'no'}"
        return f"{count} {noun}{plural} {verb}"

    def tell(self, done: int) -> str:
        """Returns it as a clause: "3 of 10 products were placed"."""
        noun, _, verb = self.step.partition(" ")
        be = "was" if self.steps == 1 else "were"
        plural = "" if self.steps == 1 else "s"
        if done < self.steps:
            return f"{done} of {self.steps} {noun}{plural} {be} {verb}"
        if self.steps == 1:
            return f"The {noun} {be} {verb}"
        return f"All {self.steps} {noun}s {be} {verb}"


def read_task_steps(metadata: dict) -> TaskSteps:
    """Returns what the task of a run counts.

    Args:
        metadata: Of the samples: `task`, or in older records `products`.
    """
    task = metadata.get("task")
    if task is None:
        products = int(metadata.get("products", 10))
        return TaskSteps(
            step="product placed" if products else "", steps=products
        )
    return TaskSteps(step=task["step"], steps=task["steps"])


def count_steps(samples: Samples) -> np.ndarray:
    """Returns how many steps of the task are done at each tick, (k,).

    Products are counted by the program. Waypoints have been reached when path
    time has come to them.

    Args:
        samples: The run.
    """
    step_time = samples.metadata.get("task", {}).get("step_time")
    if step_time is None:
        return samples["products_placed"]
    s = calc_path_time(samples["t"], samples["speed_fraction"])
    return np.searchsorted(step_time, s + _ROUNDING, side="right")


def calc_path_time(t: np.ndarray, speed_fraction: np.ndarray) -> np.ndarray:
    """Returns how far the program is along its motion, s, (k,).

    The rate goes to each tick's speed fraction linearly within the tick, see
    `TaskProgram`.

    Args:
        t: Times of the ticks, s, (k,).
        speed_fraction: At each, (k,).
    """
    if not len(t):
        return np.zeros(0)
    rate = np.concatenate([[0.0], np.clip(speed_fraction[:-1], 0.0, 1.0)])
    covered = 0.5 * (rate[:-1] + rate[1:]) * np.diff(t)
    return np.concatenate([[0.0], np.cumsum(covered)])
