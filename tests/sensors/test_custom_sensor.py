"""A user's sensor model: mistakes are named, and it is called as it is."""

import dataclasses as dc
import sys
import textwrap

import numpy as np
import pytest

from tofssm_drake.errors import UserError
import tofssm_drake.sensors.custom_sensor as mut
from tofssm_drake.sensors.range_sensor import SensorTraits, draw_constants
from tofssm_drake.sensors.range_status import STATUS_NONE, convert_status

MODULE = "my_own_sensor"
TEXT = """
import numpy as np
from tofssm_drake.sensors.range_sensor import SensorTraits

def make_traits(**changes):
    return SensorTraits(**dict(
        period=0.02, latency=0.01, fov_deg=20.0, rays_per_sensor=9,
        cast_range=2.0, max_range=2.2, sure_range=1.0, tolerance=0.03,
        noise_draws=1, constant_draws=2) | changes)

class Good:
    def __init__(self, gain=1.0):
        self.gain, self.traits = gain, make_traits()

    def measure(self, rays, noise, constants):
        nearest = rays.min(axis=1)
        return self.gain * nearest, np.where(nearest < np.inf, 0, 2)

class NoTraits:
    measure = Good.measure

class NoMeasure:
    traits = make_traits()

class Sideways(Good):
    def __init__(self):
        self.traits = make_traits(fov_deg=-5.0)

class OneTooMany(Good):
    def measure(self, rays, noise, constants):
        return np.zeros(len(rays) + 1), np.zeros(len(rays))

class Raises(Good):
    def measure(self, rays, noise, constants):
        raise KeyError("rays")

class Gambler(Good):
    def measure(self, rays, noise, constants):
        return np.random.standard_normal(len(rays)), np.zeros(len(rays))

class Nan(Good):
    def measure(self, rays, noise, constants):
        return np.full(len(rays), np.nan), np.full(len(rays), 2)
"""


@pytest.fixture(autouse=True)
def own_module(tmp_path, monkeypatch):
    (tmp_path / f"{MODULE}.py").write_text(textwrap.dedent(TEXT))
    monkeypatch.chdir(tmp_path)
    yield
    sys.modules.pop(MODULE, None)


def make(name, **parameters):
    return mut.CustomSensor(factory=f"{MODULE}:{name}", parameters=parameters)


def test_a_good_one_is_called_as_it_is():
    dut = make("Good", gain=2.0)
    dut.check("sensor")
    assert isinstance(dut.traits, SensorTraits)
    distance, status = dut.measure(np.array([[0.5, 0.4]]), None, None)
    assert distance[0] == 0.8
    assert status[0] == 0
    # Alike ones are alike, others not.
    assert dut == make("Good", gain=2.0) != make("Good", gain=1.0)
    assert make("Good").measure(np.array([[0.5]]), None, None)[0][0] == 0.5


def test_nan_is_no_mistake():
    """It is a fault of the sensor, during the run."""
    make("Nan").check("sensor")


@pytest.mark.parametrize(
    ("name", "expected"),
    [
        ("NoTraits", "has no `traits` of type SensorTraits"),
        ("NoMeasure", "has no method `measure"),
        ("Sideways", "traits.fov_deg: -5.0 is out of range"),
        ("OneTooMany", "must return distance and status of 4 sensors"),
        ("Raises", "measure: KeyError"),
        ("Gambler", "twice the same gives different results"),
        ("Missing", "no function 'Missing'"),
    ],
)
def test_mistakes_are_named(name, expected):
    with pytest.raises(UserError) as error:
        make(name).check("sensors.a.sensor")
    text = str(error.value)
    assert text.startswith("sensors.a.sensor")
    assert expected in text
    assert "\n" not in text


def test_wrong_parameters_and_no_factory():
    with pytest.raises(
        UserError, match=r"sensor\.parameters: .*unexpected keyword"
    ):
        make("Good", reach=1.0).check("sensor")
    with pytest.raises(UserError, match=r"sensor\.factory: .*module:function"):
        mut.CustomSensor().check("sensor")


def test_status_that_is_none_is_never_another():
    known = np.array([0, 2, 13, 255])
    np.testing.assert_array_equal(convert_status(known), known)
    for bad in (-1, 256, 258, 2.5, np.nan, np.inf):
        assert convert_status(np.array([bad]))[0] == STATUS_NONE, bad


def test_constants_follow_seed_and_ring():
    traits = make("Good").traits
    one = draw_constants(traits, sensors=5, seed=3)
    assert one.shape == (5, 2)
    np.testing.assert_array_equal(
        one, draw_constants(traits, sensors=5, seed=3)
    )
    for changes in ({"seed": 4}, {"seed": 3, "ring": 1}):
        assert (one != draw_constants(traits, sensors=5, **changes)).all()


def test_traits_are_checked():
    good = make("Good").traits
    good.check("traits")
    for changes, expected in (
        ({"period": 0.0}, "traits.period"),
        ({"rays_per_sensor": 2.5}, "traits.rays_per_sensor: .*whole"),
        ({"cast_range": np.inf}, "traits.cast_range"),
        ({"noise_draws": -1}, "traits.noise_draws"),
        ({"integration_time": 0.05}, "traits.latency: .*half"),
        ({"resolution": 0.1}, "traits.tolerance: .*half"),
    ):
        with pytest.raises(UserError, match=expected):
            dc.replace(good, **changes).check("traits")
