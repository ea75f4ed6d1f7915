import math

import numpy as np
import pytest
from synthetic_run import RINGS, make_run, make_steps

from tofssm_drake.laws.tri_ssm_law import TriSsm
import tofssm_drake.metrics.audit as mut
from tofssm_drake.metrics.standards import AuditConfig, make_latency_budget
from tofssm_drake.reports.report import make_audit_section


def add_metadata(run, **settings):
    run.metadata["audit"] = mut.make_audit_metadata(
        config=AuditConfig(),
        law=TriSsm(**settings).traits,
        offset=dict.fromkeys(RINGS, 0.0),
        latency=make_latency_budget(
            config=AuditConfig(),
            integration=0.033,
            wait=0.033,
            delivery=0.0,
            control_period=0.008,
        ),
    )
    return run


def make_constant_run(d_C, v_r, v_h, **settings):
    """Ten seconds of the same; only the tool knows anything."""
    run = add_metadata(make_run(10.0), **settings)
    for ring in RINGS:
        run[f"{ring}_d_C"][:] = d_C
        run[f"{ring}_link_closing_speed"][:] = v_r
        run[f"{ring}_closing_speed"][:] = v_r + v_h
        if ring != "tool":
            run[f"{ring}_sequence"][:] = -1
    return run


@pytest.mark.parametrize(
    ("configuration", "v_r", "d_C", "shortfall"),
    [
        ("vo", 0.0, 0.985, 0.115),
        ("vo", 1.0, 1.185, 0.215),
        ("vr", 1.7, 1.065, 0.545),
        ("sm", 0.0, 0.5, 0.6),
        ("sm", 1.7, 0.5, 1.11),
    ],
)
def test_worked_numbers(configuration, v_r, d_C, shortfall):
    run = make_constant_run(d_C, v_r, 1.6, configuration=configuration)
    dut = mut.calc_audit(run)
    assert dut.monitors_person == (configuration == "vo")
    for part in (dut.walking_in, dut.as_reckoned):
        assert part.worst == pytest.approx(shortfall)
        assert part.quantiles == pytest.approx((shortfall,) * 3)
        assert part.share == 1.0
        assert part.link == "tool"
        assert part.S_p == pytest.approx(d_C + shortfall)
        assert part.time == pytest.approx(0.04)
        assert (part.v_h, part.v_r) == pytest.approx((1.6, v_r))


def test_a_person_who_stands_still():
    """At rest Vo keeps more than is asked for a person who is watched."""
    dut = mut.calc_audit(make_constant_run(0.665, 0.0, 0.0))
    assert dut.walking_in.worst == pytest.approx(1.1 - 0.665)
    assert dut.as_reckoned.worst == pytest.approx(0.3 - 0.665)
    assert dut.as_reckoned.share == 0.0
    assert math.isnan(dut.as_reckoned.clear_share)


def test_what_is_assumed_is_not_measured():
    """The tool measures a person at rest, the elbow nothing for 2.5 s."""
    run = make_constant_run(0.9, 0.0, 0.0)
    t = run["t"]
    run["tool_measured_distance"][:] = 1.0
    run["tool_d_C"][:] = make_steps(t, (0, 0.9), (8.0, 0.2), (8.5, 0.9))
    run["elbow_measured_distance"][:] = np.inf
    run["elbow_closing_speed"][:] = 1.6
    run["elbow_sequence"][:] = make_steps(t, (0, -1), (5.0, 0), (7.5, -1))
    dut = mut.calc_audit(run)
    assert dut.as_reckoned.share == pytest.approx(3.0 / 9.96, abs=1e-3)
    assert dut.as_reckoned.clear_share == pytest.approx(2.5 / 3.0, abs=3e-3)
    assert dut.as_reckoned.worst == pytest.approx(1.1 - 0.9)
    assert dut.as_reckoned.link == "elbow"
    # Of the links that measure, only the tool's half second is left.
    assert dut.measuring.share == pytest.approx(0.5 / 9.96, abs=1e-3)
    assert dut.measuring.worst == pytest.approx(0.3 - 0.2)
    assert dut.measuring.clear_share == 0.0
    row = dut.make_row()
    assert row["shortfall_as_reckoned_clear_share"] > 0.8
    assert row["shortfall_measuring_share"] < row["shortfall_as_reckoned_share"]


def test_nothing_is_measured():
    run = make_constant_run(0.9, 0.0, 1.6)
    for ring in RINGS:
        run[f"{ring}_measured_distance"][:] = np.inf
    section = make_audit_section(run)
    assert section["sentences"][-1].startswith("In 100 % of the time")
    names = [row["name"] for row in section["shortfall"]]
    assert names[1:] == ["as monitored", "as measured, links that measure"]
    assert section["shortfall"][2]["share"] == "\u2013"
    dut = mut.calc_audit(run)
    assert dut.as_reckoned.clear_share == 1.0
    assert not len(dut.measuring.values)
    assert math.isnan(dut.measuring.share)


def test_lidar_s_offset_is_in_both_distances():
    run = make_constant_run(1.32, 0.0, 1.6, configuration="sm", C_dC=1.12)
    assert mut.calc_audit(run).walking_in.worst == pytest.approx(0.6)


def test_distribution_and_worst_case():
    """d_C of 1.1 m, for 1 s of 9 s of 0.9 m, and for 16 ms of 0.6 m."""
    run = make_constant_run(1.1, 0.0, 1.6)
    t = run["t"]
    run["tool_d_C"][:] = make_steps(
        t, (0, 1.1), (2.0, 0.9), (3.0, 1.1), (5.0, 0.6), (5.016, 1.1)
    )
    # What was not known does not count, nor does start-up.
    run["base_d_C"][:] = 0.1
    run["tool_d_C"][t < 0.04 - 1e-9] = 0.1
    dut = mut.calc_audit(run).walking_in
    assert dut.worst == pytest.approx(0.5)
    assert dut.time == pytest.approx(5.0)
    assert dut.quantiles == pytest.approx((0.0, 0.0, 0.2))
    assert dut.share == pytest.approx(1.016 / 9.96)
    assert len(dut.values) == len(t) - 5


def test_the_worst_link_counts():
    run = make_constant_run(1.0, 0.0, 1.6)
    run["elbow_sequence"][:] = 0
    run["elbow_d_C"][:] = 0.8
    dut = mut.calc_audit(run).walking_in
    assert dut.link == "elbow"
    assert dut.quantiles == pytest.approx((0.3,) * 3)


def test_inside():
    """Within S_p = 1.1 m for 2 s, in the last 0.5 s told to stop."""
    run = make_constant_run(0.985, 0.0, 1.6)
    run["tool_true_distance"][:] = make_steps(
        run["t"], (0, 1.2), (4.0, 1.0), (6.0, 1.2)
    )
    run.column["robot_state"] = make_steps(
        run["t"], (0, 0), (0.04, 2), (5.5, 0)
    ).astype(np.int8)
    assert mut.calc_audit(run).inside == pytest.approx(1.5, abs=0.009)


def test_latency_and_stopping_time():
    run = make_constant_run(0.985, 0.0, 1.6)
    run["tcp_speed"][:] = make_steps(run["t"], (0, 0.4), (7.5, 1.7))
    dut = mut.calc_audit(run)
    assert dut.total_latency == pytest.approx(0.108)
    assert dut.stop_time == pytest.approx(0.520)
    assert dut.slow_share == pytest.approx(0.25, abs=1e-3)
    row = dut.make_row()
    assert row["latency_over_T_R_s"] == pytest.approx(0.008)
    assert row["stated_stop_over_T_stop_s"] == pytest.approx(0.120)


def test_row_is_flat():
    for run in (make_run(2.0), make_run(0.0)):
        row = mut.calc_audit(add_metadata(run)).make_row()
        assert all(type(value) is float for value in row.values())
    assert math.isnan(row["shortfall_walking_in_max_m"])
    assert math.isnan(row["shortfall_measuring_share"])


def test_old_records_are_not_audited():
    assert mut.calc_audit(make_run(1.0)) is None
    run = add_metadata(make_run(1.0))
    del run.column["tool_link_closing_speed"]
    assert mut.calc_audit(run) is None
