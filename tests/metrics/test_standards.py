import dataclasses as dc
import math

from hypothesis import given
from hypothesis import strategies as st
import numpy as np
from pydrake.common.yaml import yaml_load_typed
import pytest

from tofssm_drake.errors import UserError
from tofssm_drake.laws.config import SsmConfig
from tofssm_drake.laws.distances import calc_critical_distance
import tofssm_drake.metrics.standards as mut

V_R = np.array([0.0, 0.5, 0.85, 1.0, 1.7])


def calc(v_r, v_h=1.6):
    return mut.calc_protective_distance(
        v_h=v_h, v_r=v_r, T_R=0.1, T_S=0.4, C=0.3
    )


def test_protective_distance():
    np.testing.assert_allclose(
        calc(V_R), [1.100, 1.250, 1.355, 1.400, 1.610], atol=1e-12
    )


@pytest.mark.parametrize(
    ("configuration", "shortfall"),
    [
        ("vo", [0.115, 0.165, 0.200, 0.215, 0.145]),
        ("vr", [0.515, 0.565, 0.600, 0.615, 0.545]),
        ("sm", [0.600, 0.750, 0.855, 0.900, 1.110]),
    ],
)
def test_shortfall_of_the_law(configuration, shortfall):
    """A person walks in at 1.6 m/s."""
    d_C = calc_critical_distance(
        config=SsmConfig(configuration=configuration),
        k=V_R + (1.6 if configuration == "vo" else 0.0),
        link_speed=V_R,
    )
    np.testing.assert_allclose(calc(V_R) - d_C, shortfall, atol=1e-12)


@given(st.floats(-1.6, 1.6), st.floats(-1.7, 1.7))
def test_shortfall_of_vo_in_closed_form(v_h, v_r):
    """0.3 v_h + 0.1 v_r - max(0.2, 0.2 v_r) - 0.165, link along the line."""
    config = SsmConfig(literal=True)
    d_C = calc_critical_distance(config=config, k=v_h + v_r, link_speed=v_r)
    expected = 0.3 * v_h + 0.1 * v_r - max(0.2, 0.2 * v_r) - 0.165
    assert calc(v_r, v_h) - d_C == pytest.approx(expected, abs=1e-12)


@pytest.mark.parametrize(
    ("budget", "milliseconds"), [(0.033, 108), (0.020, 82)]
)
def test_latency(budget, milliseconds):
    """Ideal sensors at 30 and 50 Hz."""
    parts = mut.make_latency_budget(
        config=mut.AuditConfig(),
        integration=budget,
        wait=budget,
        delivery=0.0,
        control_period=0.008,
    )
    in_ms = [round(1000 * part) for part in parts.values()]
    assert in_ms == [1000 * budget, 1000 * budget, 0, 2, 8, 8, 24]
    assert sum(in_ms) == milliseconds


def test_config():
    dut = yaml_load_typed(schema=mut.AuditConfig, data="{V_h: 2.0}")
    dut.check("audit")
    for bad in (-0.1, math.nan):
        with pytest.raises(UserError, match=r"here.brake_start: .*use"):
            dc.replace(dut, brake_start=bad).check("here")
