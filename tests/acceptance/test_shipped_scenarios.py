"""Every shipped scenario runs, and does what its comment says."""

import numpy as np
import pytest

from tofssm_drake.diagrams.scenario import list_scenarios


@pytest.mark.parametrize(
    "duration", [1.0, pytest.param(10.0, marks=pytest.mark.long)]
)
@pytest.mark.parametrize("name", list_scenarios())
def test_scenario_runs(run, name, duration):
    samples, summary = run(name, f"{{simulation_duration: {duration}}}")
    assert summary["simulated_s"] == pytest.approx(duration, abs=0.02)
    assert np.isfinite(samples["tcp_speed"]).all()
    assert summary["max_tcp_speed_mps"] < 1.75


@pytest.mark.parametrize(
    ("ssm", "duration"),
    [
        ("vo", 4.0),
        *(
            pytest.param(ssm, 20.0, marks=pytest.mark.long)
            for ssm in ("vo", "vr", "sm")
        ),
    ],
)
def test_without_the_mask_the_robot_stops_at_itself(run, ssm, duration):
    _, summary = run(
        "NoMask",
        f"{{simulation_duration: {duration}, law: {{configuration: {ssm}}}}}",
    )
    assert summary["stop_events"] > 0
    assert summary["stopped_s"] > 1.0
