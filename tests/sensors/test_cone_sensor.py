import dataclasses as dc

from hypothesis import given, settings
from hypothesis import strategies as st
import numpy as np
from pydrake.common.yaml import yaml_load_typed
import pytest

from tofssm_drake.errors import UserError
import tofssm_drake.sensors.cone_sensor as mut
from tofssm_drake.sensors.range_sensor import measure_checked
from tofssm_drake.sensors.range_status import (
    STATUS_MIN_RANGE_FAIL,
    STATUS_SIGNAL_FAIL,
    STATUS_VALID,
)


def measure(sensor, ray_distance, noise=None, seed=0):
    ray_distance = np.atleast_2d(np.asarray(ray_distance, dtype=float))
    n = len(ray_distance)
    if noise is None:
        generator = np.random.default_rng(seed)
        noise = generator.standard_normal((n, sensor.traits.noise_draws))
    return measure_checked(sensor, ray_distance, noise, np.zeros((n, 0)))


def make_exact(**changes):
    """Returns a sensor without noise, steps and lost samples."""
    exact = {"sigma": 0.0, "sigma_per_metre": 0.0, "resolution": 0.0}
    return mut.ConeSensor(**exact | {"dropout": 0.0} | changes)


@pytest.mark.parametrize("distance", [0.5, 3.0, 11.0])
@pytest.mark.parametrize("per_metre", [0.0, 0.00167])
def test_noise_has_the_standard_deviation_of_the_settings(distance, per_metre):
    dut = make_exact(sigma=0.02, sigma_per_metre=per_metre)
    n = 20000
    measured, status = measure(dut, np.full((n, 1), distance))
    sigma = 0.02 + per_metre * distance
    assert (status == STATUS_VALID).all()
    assert measured.mean() == pytest.approx(distance, abs=5 * sigma / n**0.5)
    assert measured.std() == pytest.approx(sigma, rel=0.02)
    # Normal: 99.7 % lie within three standard deviations.
    off = np.abs(measured - distance)
    assert (off > 3.0 * sigma).mean() == pytest.approx(0.0027, abs=0.0012)


def test_defaults_are_no_better_than_the_datasheet():
    """+-60 mm up to 6 m and +-1 % beyond, as three standard deviations."""
    dut = mut.ConeSensor(dropout=0.0)
    for distance in np.linspace(0.5, 11.5, 12):
        measured, _ = measure(dut, np.full((20000, 1), distance))
        accuracy = max(0.06, 0.01 * distance)
        assert 3.0 * measured.std() > 0.98 * accuracy
        assert 3.0 * measured.std() < 1.6 * accuracy


def test_range():
    dut = make_exact(max_range=4.0)
    assert dut.traits.cast_range == dut.traits.sure_range == 4.0
    distance, status = measure(dut, [[3.999], [4.0], [4.001], [np.inf]])
    np.testing.assert_array_equal(
        status, [STATUS_VALID] * 2 + [STATUS_SIGNAL_FAIL] * 2
    )
    np.testing.assert_allclose(distance[:2], [3.999, 4.0], rtol=1e-12)


def test_too_near_is_detected_but_not_measured():
    dut = mut.ConeSensor(min_range=0.1, dropout=0.0)
    _, status = measure(dut, [[0.0], [0.0999], [0.1001]])
    np.testing.assert_array_equal(
        status, [STATUS_MIN_RANGE_FAIL] * 2 + [STATUS_VALID]
    )


def test_the_nearest_in_the_cone_counts():
    distance, _ = measure(make_exact(), [[2.0, 0.7, np.inf], [9.0, 8.0, 8.5]])
    np.testing.assert_array_equal(distance, [0.7, 8.0])


@pytest.mark.parametrize("dropout", [0.0, 0.05, 1.0])
def test_lost_samples_look_like_no_target(dropout):
    dut = mut.ConeSensor(dropout=dropout)
    _, status = measure(dut, np.full((20000, 1), 2.0))
    assert set(status) <= {STATUS_VALID, STATUS_SIGNAL_FAIL}
    assert (status != STATUS_VALID).mean() == pytest.approx(dropout, abs=0.005)


def test_same_numbers_give_the_same_readings():
    dut = mut.ConeSensor()
    rays = np.random.default_rng(1).uniform(0.0, 14.0, (200, 9))
    for one, same in zip(measure(dut, rays), measure(dut, rays), strict=True):
        np.testing.assert_array_equal(one, same)
    assert (measure(dut, rays)[0] != measure(dut, rays, seed=2)[0]).any()


def test_reported_in_steps():
    dut = mut.ConeSensor(resolution=0.05)
    rays = np.random.default_rng(1).uniform(0.2, 10.0, (500, 3))
    steps = measure(dut, rays)[0] / 0.05
    np.testing.assert_allclose(steps, np.round(steps), atol=1e-9)


ray = st.one_of(st.just(np.inf), st.floats(0.0, 14.0))


@settings(deadline=None, max_examples=200)
@given(
    rays=st.lists(ray, min_size=1, max_size=6),
    z=st.floats(-8.0, 8.0),
    lost=st.floats(-8.0, 8.0),
)
def test_reports_something_a_device_could(rays, z, lost):
    dut = mut.ConeSensor(dropout=0.1)
    (distance,), (status,) = measure(dut, [rays], np.array([[z, lost]]))
    assert 0.0 <= distance <= dut.max_range + 8.0 * 0.05
    assert status in (STATUS_VALID, STATUS_SIGNAL_FAIL, STATUS_MIN_RANGE_FAIL)
    if min(rays) > dut.max_range:
        assert status == STATUS_SIGNAL_FAIL
    if status == STATUS_VALID and abs(z) <= 3.0:
        assert abs(distance - min(rays)) <= dut.traits.tolerance + 1e-9
        assert distance <= dut.traits.max_range
    back = measure(dut, [rays[::-1]], np.array([[z, lost]]))
    assert (distance, status) == (back[0][0], back[1][0])


@settings(deadline=None, max_examples=100)
@given(near=st.floats(0.1, 12.0), more=st.floats(0.0, 12.0), z=st.floats(-3, 3))
def test_what_is_farther_never_reads_nearer(near, more, z):
    dut = mut.ConeSensor(max_range=50.0, sigma_per_metre=0.01)
    noise = np.array([[z, 0.0]] * 2)
    (first, second), _ = measure(dut, [[near], [near + more]], noise)
    assert first <= second


def test_traits_of_the_defaults():
    dut = mut.ConeSensor()
    dut.check("sensor")
    assert dut.traits.period == pytest.approx(0.010)
    assert dut.traits.delivery_time == pytest.approx(0.005)
    assert dut.traits.max_range > dut.max_range


def test_loads_and_checks():
    dut = yaml_load_typed(
        schema=mut.ConeSensor, data="{max_range: 4.0, rate: 50}"
    )
    assert dut.traits.period == pytest.approx(0.020)
    for field in dc.fields(mut.ConeSensor):
        for bad in (-1.0, np.nan, 1e6):
            config = mut.ConeSensor(**{field.name: bad})
            with pytest.raises(UserError, match=rf"here\.{field.name}: "):
                config.check("here")
    with pytest.raises(UserError, match=r"here\.min_range: .* below max_range"):
        mut.ConeSensor(max_range=0.5, min_range=0.5).check("here")
    with pytest.raises(UserError, match=r"here\.latency: .* half"):
        mut.ConeSensor(latency=0.001).check("here")
