"""Whether the safety law's input is fresh and healthy."""

from pydrake.common.value import Value
from pydrake.systems.framework import Context, LeafSystem

from tofssm_drake.messages import (
    RingHealth,
    SafetyIndex,
    Separation,
    make_empty_separation,
)

_WORKING = (
    int(RingHealth.HEALTHY),
    int(RingHealth.BLIND),
    int(RingHealth.DEGRADED),
)


def find_sensing_problem(
    *, index: SafetyIndex | Separation, now: float, deadline: float
) -> str:
    """Returns what is wrong with some link's sensing; "" if nothing.

    These are the reasons why the safety law stops without having seen anybody:
    no sample, a faulted ring, a sample further from now than the deadline. The
    text does not change while the problem is the same.

    Args:
        index: The law's, or its input: with time and health of each link's
            sensing.
        now: Time, s, on the clock of `index.time`.
        deadline: The law's, s.
    """
    problems = dict(zip(index.name, index.problem, strict=False))
    for name, sequence, health, time in zip(
        index.name,
        index.sequence.tolist(),
        index.health.tolist(),
        index.time.tolist(),
        strict=True,
    ):
        if sequence < 0:
            return f"{name} has no sample yet"
        if health not in _WORKING:
            problem = problems.get(name, "")
            return f"{name} is faulted{problem and ', ' + problem}"
        # NaN is too old, too.
        if not abs(now - time) <= deadline:
            return f"{name} sample is too old"
    return ""


class SensingProblem(LeafSystem):
    """Reports why the sensing is not fresh and healthy.

    .. pydrake_system::

        name: SensingProblem
        input_ports:
        - separation
        output_ports:
        - problem

    `problem` (str) is the result of `find_sensing_problem` for `separation`.

    Args:
        deadline: Greatest age of a sample for the law, s.
    """

    def __init__(self, *, deadline: float):
        super().__init__()
        self._deadline = deadline
        self._separation = self.DeclareAbstractInputPort(
            "separation", Value(make_empty_separation(()))
        )
        self.DeclareAbstractOutputPort(
            "problem",
            lambda: Value(""),
            self._calc_problem,
            {self._separation.ticket(), self.time_ticket()},
        )

    def _calc_problem(self, context: Context, output):
        output.set_value(
            find_sensing_problem(
                index=self._separation.Eval(context),
                now=context.get_time(),
                deadline=self._deadline,
            )
        )
