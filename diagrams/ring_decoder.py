"""Makes the decoder for the frames of a scenario's real rings."""

from tofssm_drake.diagrams.drivers import find_real_cell
from tofssm_drake.diagrams.scenario import Scenario
from tofssm_drake.diagrams.sensors.rings import Ring, find_rings
from tofssm_drake.ringlink.ring_budget import RingBudget, calc_max_age
from tofssm_drake.ringlink.ring_receiver import RingDecoder, RingLinkConfig


def make_ring_budget(
    scenario: Scenario, ring: Ring, control_period: float | None = None
) -> RingBudget:
    """Returns the limits of a ring's link with which the law's T_R holds.

    Args:
        scenario: Checked settings.
        ring: One of its rings.
        control_period: Control tick, s; None: that of the scenario.
    """
    if control_period is None:
        control_period = scenario.control_period
    period = ring.sensor.traits.period
    audit = scenario.audit
    return RingBudget(
        period=period,
        max_age=calc_max_age(
            T_R=scenario.law.traits.T_R,
            period=period,
            monitor_time=audit.monitor_time,
            control_period=control_period,
            rtde_period=audit.rtde_period,
            brake_start=audit.brake_start,
        ),
    )


def make_ring_decoder(
    scenario: Scenario,
    *,
    config: RingLinkConfig | None = None,
    control_period: float | None = None,
) -> RingDecoder:
    """Returns a decoder of the frames of the scenario's rings.

    Args:
        scenario: Checked settings; uses rings, law and audit.
        config: Of the link; None: the scenario's.
        control_period: Control tick, s; None: that of the scenario.
    """
    rings = find_rings(scenario.sensors)
    return RingDecoder(
        config=config or find_real_cell(scenario.driver).ring_link,
        rings=rings,
        budget={
            name: make_ring_budget(scenario, ring, control_period)
            for name, ring in rings.items()
        },
    )
