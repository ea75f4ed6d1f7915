"""A safety law of one's own: the nearer somebody is, the slower the robot.

tofssm simulate --scenario-file examples/my_law.yaml --out out/my_law
"""

import numpy as np
from pydrake.common.value import Value
from pydrake.systems.framework import LeafSystem

from tofssm_drake.laws.law import LawTraits
from tofssm_drake.laws.sensing_problem import find_sensing_problem
import tofssm_drake.messages as msg


def decide(separation, now, stop, slow):
    """Returns the decision: this function is the law."""
    margin = separation.distance - stop  # inf where nobody is seen.
    share = np.clip(margin / (slow - stop), 0.0, 1.0)
    # A blind or degraded link may overlook somebody: slow at best.
    share[separation.health != msg.RingHealth.HEALTHY] *= 0.3
    i = int(np.argmin(share))
    target, link = float(share[i]), separation.name[i]
    reason = f"{link} has {margin[i]:.3f} m to spare"
    # Old samples, faulted links; and a distance may be NaN.
    problem = find_sensing_problem(index=separation, now=now, deadline=0.1)
    if problem or not target <= 1.0:
        target, reason = 0.0, f"stop: {problem or f'{link} is unknown'}"
    return msg.SpeedDecision(
        name=separation.name,
        target=target,
        link=link if target < 1.0 else "",
        reason=reason,
        signal={"margin": margin},
    )


class MyLaw:
    """What the scenario's factory returns, see `Law` in laws/law.py."""

    traits = LawTraits(
        title="Nearer is slower",
        about="the speed fraction grows with the least distance",
        signals={"margin": msg.LinkSignal(unit="m", meaning="room to spare")},
    )

    def __init__(self, stop=0.6, slow=1.2):
        if not 0.0 <= stop < slow <= 100.0:
            raise ValueError(f"stop {stop} must be below slow {slow}, m")
        self.stop, self.slow = stop, slow

    def make(self, *, links, offset, period):
        """Makes the system; a lidar's link is measured from farther away."""
        return MySystem(links, self.stop + offset, self.slow + offset)


class MySystem(LeafSystem):
    """One input port, `separation`, and one output port, `decision`."""

    def __init__(self, links, stop, slow):
        super().__init__()
        port = self.DeclareAbstractInputPort(
            "separation", Value(msg.make_empty_separation(links))
        )

        def calc(context, output):
            now = context.get_time()
            output.set_value(decide(port.Eval(context), now, stop, slow))

        alloc = Value(msg.make_empty_decision(links, ("margin",))).Clone
        needs = {port.ticket(), self.time_ticket()}  # A sample grows old.
        self.DeclareAbstractOutputPort("decision", alloc, calc, needs)
