"""The law of the 2019 paper, TriSSM, as a choice of a scenario."""

import dataclasses as dc

import numpy as np
from pydrake.systems.framework import Diagram, DiagramBuilder

from tofssm_drake.laws.config import SsmConfig
from tofssm_drake.laws.dsi_filter import DsiFilter
from tofssm_drake.laws.law import LawTraits
from tofssm_drake.laws.speed_fraction import SpeedRamp
from tofssm_drake.laws.tri_ssm import (
    SIGNALS,
    TriSsmDecision,
    TriSsmState,
)
from tofssm_drake.messages import LinkSignal

_WORDS = {
    "vo": (
        "Vo",
        "directed relative speed of robot and person, as measured",
    ),
    "vr": ("Vr", "directed speed of the robot alone"),
    "sm": ("SM", "fixed distances, whatever the speeds"),
}
# Of the default's critical distance against ISO/TS 15066, 5.5.4, for a person
# who walks at 1.6 m/s.
_SHORTFALL = {
    "vo": "0.12 to 0.22 m",
    "vr": "0.52 to 0.62 m",
    "sm": "0.60 to 1.11 m",
}
_MOVING = (
    "Both grow with the speed at which robot and person close in, so they "
    "move all the time."
)
_FIXED = "In this configuration both are fixed."

_SIGNALS = {
    "d_C": LinkSignal(unit="m", meaning="critical distance", bound="stop"),
    "d_R": LinkSignal(unit="m", meaning="reduced distance", bound="slow"),
    # The distance again, on another scale.
    "dsi_raw": LinkSignal(
        meaning="Distance Safety Index as measured", is_drawn=False
    ),
    "dsi": LinkSignal(
        meaning="Distance Safety Index after the filter", is_drawn=False
    ),
    "dsi_C": LinkSignal(meaning="index at d_C", is_drawn=False),
    "dsi_R": LinkSignal(meaning="index at d_R", is_drawn=False),
}


@dc.dataclass(kw_only=True)
class TriSsm(SsmConfig):
    """Normal, reduced and stop by two distances (the 2019 paper, II)."""

    @property
    def traits(self) -> LawTraits:
        """See `Law`."""
        title, about = _WORDS[self.configuration]
        is_fixed = self.configuration == "sm"
        return LawTraits(
            title=f"Configuration {title}",
            about=about,
            guide=(
                (
                    "Three states.",
                    "Normal: full speed. Reduced: a speed fraction of "
                    f"{self.rho_reduced:g}. Stopped: no motion; the robot "
                    "continues by itself when the person has left.",
                ),
                (
                    "Two thresholds.",
                    "Below the critical distance d_C the robot stops, below "
                    "the reduced distance d_R it slows. "
                    f"{_FIXED if is_fixed else _MOVING}",
                ),
            ),
            limits="With the default parameters, the critical distance of "
            f"this configuration is {_SHORTFALL[self.configuration]} shorter "
            "than the protective separation distance of ISO/TS 15066 for a "
            "person who walks in at 1.6 m/s.",
            states=("stop", "reduced", "normal"),
            signals={name: _SIGNALS[name] for name in SIGNALS},
            deadline=self.deadline,
            T_R=self.T_R,
            T_stop=self.T_stop,
            C=self.C_dC,
            k_max=self.k_omax,
            monitors_person=self.configuration == "vo",
            reduced_fraction=self.rho_reduced,
            ramp=SpeedRamp(
                max_rate=self.rho_max_rate,
                max_acceleration=self.rho_max_acceleration,
                literal=self.literal,
            ),
        )

    def make(
        self, *, links: tuple[str, ...], offset: np.ndarray, period: float
    ) -> Diagram:
        """Makes the filter, the states and the decision, see `Law`.

        .. pydrake_system::

            name: tri_ssm_law
            input_ports:
            - separation
            output_ports:
            - decision
        """
        builder = DiagramBuilder()
        dsi_filter = builder.AddNamedSystem(
            "dsi_filter",
            DsiFilter(name=links, config=self, offset=offset, period=period),
        )
        state = builder.AddNamedSystem(
            "tri_ssm", TriSsmState(name=links, config=self, offset=offset)
        )
        decision = builder.AddNamedSystem(
            "decision", TriSsmDecision(name=links, config=self, offset=offset)
        )
        dsi = dsi_filter.GetOutputPort("dsi")
        builder.Connect(dsi, state.GetInputPort("dsi"))
        builder.Connect(dsi, decision.GetInputPort("dsi"))
        builder.Connect(
            state.GetOutputPort("ring_states"),
            decision.GetInputPort("ring_states"),
        )
        builder.Connect(
            state.GetOutputPort("robot_state"),
            dsi_filter.GetInputPort("robot_state"),
        )
        builder.ExportInput(dsi_filter.GetInputPort("separation"), "separation")
        builder.ExportOutput(decision.GetOutputPort("decision"), "decision")
        diagram = builder.Build()
        diagram.set_name("tri_ssm_law")
        return diagram
