import dataclasses as dc

from hypothesis import given
from hypothesis import strategies as st
import numpy as np
from paper_cell import RINGS
from pydrake.common.yaml import yaml_load_typed
from pydrake.systems.analysis import Simulator
import pytest

from tofssm_drake.errors import UserError
from tofssm_drake.messages import Reading, RingHealth
import tofssm_drake.perception.ideal_separation as mut

ZEROS = np.zeros((1, 3))


def calc(*, p=(0, 0, 0), v=(0, 0, 0), ends, velocities=None, radii, **options):
    ends = np.array(ends, dtype=float)
    if velocities is None:
        velocities = np.zeros(ends.shape)
    return mut.calc_ideal_separation(
        p_WL=np.array([p], dtype=float),
        v_WL=np.array([v], dtype=float),
        ends=ends,
        velocities=np.array(velocities, dtype=float),
        radii=np.array(radii, dtype=float),
        name=("tool",),
        **options,
    )


def test_worked_numbers():
    """A ball whose centre is at P: the vector case of the paper's symbols."""
    P = [0.9, 0.4, 0.2]
    V_o = [-1.0, 0.2, 0.0]
    dut = calc(
        v=[0.6, 0.3, -0.1],
        ends=[[P, P]],
        velocities=[[V_o, V_o]],
        radii=[0.1],
    )
    assert dut.distance[0] == pytest.approx(1.004988 - 0.1, abs=5e-7)
    assert dut.k_l[0] == pytest.approx(0.636824, abs=5e-7)
    assert dut.k_o[0] == pytest.approx(1.452754, abs=5e-7)
    assert dut.link_speed[0] == pytest.approx(0.678233, abs=5e-7)
    np.testing.assert_allclose(
        dut.direction[0], np.array(P) / np.linalg.norm(P)
    )
    assert dut.health[0] == RingHealth.HEALTHY
    assert dut.count[0].tolist() == [0, 1, 0, 0]


def test_beside_and_beyond_a_capsule():
    ends = [[[1, -1, 0], [1, 1, 0]]]
    assert calc(ends=ends, radii=[0.2]).distance[0] == pytest.approx(0.8)
    beyond = calc(p=[1, 4, 0], ends=ends, radii=[0.2])
    assert beyond.distance[0] == pytest.approx(2.8)
    np.testing.assert_allclose(beyond.direction[0], [0, -1, 0])


def test_nearest_surface_and_not_nearest_bone():
    ends = [[[1, 0, 0], [1, 0, 0]], [[0, 1.1, 0], [0, 1.1, 0]]]
    dut = calc(ends=ends, radii=[0.1, 0.4])
    assert dut.distance[0] == pytest.approx(0.7)
    np.testing.assert_allclose(dut.direction[0], [0, 1, 0])


def test_a_turning_forearm_moves_where_it_is_nearest():
    ends = [[[1, -1, 0], [1, 1, 0]]]
    velocities = [[[0, 0, 0], [-2, 0, 0]]]
    dut = calc(p=[0, 0.5, 0], ends=ends, velocities=velocities, radii=[0.1])
    assert dut.k_o[0] == pytest.approx(1.5)
    assert dut.k_l[0] == 0.0


def test_nobody():
    dut = calc(v=[0.5, 0, 0], ends=np.empty((0, 2, 3)), radii=[])
    assert dut.distance[0] == np.inf
    assert dut.k_l[0] == pytest.approx(0.5)
    assert dut.k_o[0] == pytest.approx(0.5 + 1.6)
    assert dut.sensor[0] == -1
    assert np.isnan(dut.direction).all()
    assert dut.count[0, Reading.CLEAR] == 1


def test_unknown_velocity_is_a_person_who_walks_in():
    ends = [[[1, 0, 0], [1, 0, 0]]]
    dut = calc(
        v=[0.5, 0, 0],
        ends=ends,
        velocities=np.full((1, 2, 3), np.nan),
        radii=[0.1],
    )
    assert dut.k_l[0] == pytest.approx(0.5)
    assert dut.k_o[0] == pytest.approx(2.1)


def test_inside_the_person_and_on_the_bone():
    ends = [[[1, -1, 0], [1, 1, 0]]]
    assert calc(p=[1.05, 0, 0], ends=ends, radii=[0.2]).distance[0] == 0.0
    dut = calc(p=[1, 0, 0], v=[0, 0.4, 0], ends=ends, radii=[0.2])
    assert dut.distance[0] == 0.0
    assert dut.k_l[0] == pytest.approx(0.4)
    assert dut.k_o[0] == pytest.approx(2.0)


@pytest.mark.parametrize("wrong", [np.nan, np.inf])
def test_what_is_nowhere_is_faulted(wrong):
    """A link or a part of the person at an unknown place is not clear."""
    for p, end in (((0, wrong, 0), (1, 0, 0)), ((0, 0, 0), (1, wrong, 0))):
        dut = calc(p=p, ends=[[(1, 0, 0), end]], radii=[0.1])
        assert dut.health[0] == RingHealth.FAULTED
        assert dut.count[0].tolist() == [0, 0, 0, 1]


def test_saturates():
    ends = [[[1, 0, 0], [1, 0, 0]]]
    fast = calc(
        ends=ends,
        velocities=[[[-9, 0, 0], [-9, 0, 0]]],
        radii=[0.1],
        k_max=3.3,
    )
    assert fast.k_o[0] == 3.3


_point = st.tuples(*[st.floats(-2, 2)] * 3)


@given(_point, _point, _point, _point, _point, st.floats(0.01, 0.3))
def test_closing_speed_is_how_fast_the_distance_shrinks(p, v, a, b, va, r):
    """An independent oracle: move everything a little and measure again."""
    vb = np.array([0.3, -0.2, 0.1])
    ends = np.array([[a, b]])
    velocities = np.array([[va, vb]])
    dt = 1e-6
    options = {"radii": [r], "k_max": 1e3}
    now = calc(p=p, v=v, ends=ends, velocities=velocities, **options)
    before, after = (
        calc(
            p=np.array(p) + s * dt * np.array(v),
            ends=ends + s * dt * velocities,
            **options,
        ).distance[0]
        for s in (-0.5, 0.5)
    )
    if min(before, after) > 0.01 and np.linalg.norm(ends[0, 1] - a) > 0.05:
        rate = (after - before) / dt
        assert now.k_o[0] == pytest.approx(-rate, abs=1e-3)


class Kinematics:
    """Three links, at the joints 0 to 2 along x, that move as those do."""

    num_joints = 6

    def calc(self, q, qd):
        p, v = np.zeros((3, 3)), np.zeros((3, 3))
        p[:, 0], v[:, 0] = q[:3], qd[:3]
        return p, np.tile(np.eye(3), (3, 1, 1)), v


class Rig:
    def __init__(self, **settings):
        self.dut = mut.IdealSeparation(
            name=RINGS,
            config=mut.IdealSeparationConfig(**settings),
            kinematics=Kinematics(),
            radii=[0.1],
        )
        self.simulator = Simulator(self.dut)
        self.context = self.simulator.get_mutable_context()
        self.time = 0.0

    def step(self, x, q=0.0, qd=0.0):
        """Takes one sample of a ball at x; returns the separation."""
        for name, value in (
            ("position_measured", np.full(6, q)),
            ("velocity_measured", np.full(6, qd)),
            ("skeleton", [x, 0, 0] * 2),
        ):
            self.dut.GetInputPort(name).FixValue(self.context, value)
        # The update at a time happens when time goes on.
        self.simulator.AdvanceTo(self.time + 1e-6)
        self.time += 0.008
        return self.dut.GetOutputPort("separation").Eval(self.context)


class TestSystem:
    def test_samples_at_every_period(self):
        rig = Rig()
        first = rig.step(1.0)
        assert first.sequence.tolist() == [0, 0, 0]
        np.testing.assert_allclose(first.distance, 0.9)
        # The person's motion is not known yet.
        np.testing.assert_allclose(first.k_o, 1.6)
        second = rig.step(1.0 - 0.008 * 1.2, q=0.1, qd=0.5)
        assert second.sequence.tolist() == [1, 1, 1]
        np.testing.assert_allclose(second.time, 0.008)
        np.testing.assert_allclose(second.distance, 0.8 - 0.0096)
        np.testing.assert_allclose(second.k_l, 0.5)
        np.testing.assert_allclose(second.k_o, 1.7)

    def test_latency(self):
        """Rounded up to whole periods, and each sample keeps its time."""
        rig = Rig(latency=0.012)
        assert rig.step(1.0).sequence[0] == -1
        assert rig.step(0.9).sequence[0] == -1
        third = rig.step(0.8)
        assert third.sequence[0] == 0
        np.testing.assert_allclose(third.distance, 0.9)
        fourth = rig.step(0.7)
        np.testing.assert_allclose(fourth.time, 0.008)
        np.testing.assert_allclose(fourth.distance, 0.8)

    def test_before_the_first_sample_nothing_is_known(self):
        dut = Rig().dut
        context = dut.CreateDefaultContext()
        empty = dut.GetOutputPort("separation").Eval(context)
        assert empty.name == RINGS
        assert (empty.health == RingHealth.FAULTED).all()

    def test_no_feedthrough(self):
        assert not Rig().dut.HasAnyDirectFeedthrough()

    def test_contexts_do_not_share_their_state(self):
        rig = Rig()
        rig.step(1.0)
        clone = rig.context.Clone()
        rig.step(0.5)
        port = rig.dut.GetOutputPort("separation")
        assert port.Eval(clone).sequence[0] == 0
        assert port.Eval(rig.context).sequence[0] == 1


def test_config():
    dut = yaml_load_typed(
        schema=mut.IdealSeparationConfig, data="{latency: 0.04}"
    )
    dut.check("ideal")
    for name, bad in (("period", 0.0), ("latency", -1.0), ("V_hmax", np.nan)):
        with pytest.raises(UserError, match=f"here.{name}: .*use"):
            dc.replace(dut, **{name: bad}).check("here")
