import unittest

from hypothesis import given
from hypothesis import strategies as st
import numpy as np

from tofssm_drake.laws.config import SsmConfig
import tofssm_drake.laws.distances as mut

# Worked by hand from the equations: configuration, k, ||V_l||, psi(t - dt),
# d_C, d_R, DSI_C, DSI_R.
WORKED = (
    ("vo", 0, 0, 2, 0.665000, 0.995000, 0.203516, 0.090907),
    ("vr", 0, 0, 2, 0.585000, 0.755000, 0.262985, 0.157888),
    ("vo", 1.6, 0, 2, 0.985000, 1.795000, 0.092762, 0.027933),
    ("vo", 3.3, 1.7, 2, 1.465000, 2.785000, 0.041934, 0.011604),
    ("vr", 1.7, 1.7, 2, 1.065000, 1.745000, 0.079349, 0.029556),
    ("vo", 3.3, 1.7, 1, 1.465000, 2.955000, 0.041934, 0.010307),
    ("vo", 2.45, 0.85, 1, 1.155000, 2.390000, 0.067465, 0.015756),
    ("vo", -1.0, 0, 0, 0.465000, 0.835000, 0.416233, 0.129083),
    ("vr", 0, 0, 0, 0.585000, 1.095000, 0.262985, 0.075061),
    ("vo", 0, 1.7, 2, 0.805000, 1.135000, 0.138884, 0.069864),
    ("vr", 0.5, 0.9, 2, 0.685000, 1.005000, 0.191806, 0.089107),
    ("vo", 1.3, 0.9, 2, 0.925000, 1.645000, 0.105186, 0.033259),
)
WORKED_LITERAL = (("vo", -1.7, 1.7, 2, 0.465000, 0.285000, 0.416233, 1.108033),)
WORKED_SAFE = (
    ("vo", -1.7, 1.7, 2, 0.465000, 0.465000, 0.416233, 0.416233),
    ("vo", -3.3, 1.7, 2, 0.300000, 0.300000, 1.000000, 1.000000),
)
WORKED_LIDAR = (
    ("vo", 0, 0, 2, 1.485000, 1.815000, 0.568831, 0.380788),
    ("vo", 3.3, 1.7, 2, 2.285000, 3.605000, 0.240250, 0.096522),
)
WORKED_SM = (
    (0.3, 0.5, 1.1, 0.360000, 0.074380),
    (1.12, 1.32, 1.92, 0.719927, 0.340278),
)

configurations = st.sampled_from(("vo", "vr", "sm"))
speeds = st.floats(0.0, 3.0)
directed = st.floats(-5.0, 5.0)
states = st.sampled_from((0, 1, 2))


def calc(config, k, link_speed, psi):
    d_C = mut.calc_critical_distance(config=config, k=k, link_speed=link_speed)
    d_R = mut.calc_reduced_distance(
        config=config, k=k, robot_state=psi, d_C=d_C
    )
    return d_C, d_R


class TestWorkedNumbers(unittest.TestCase):
    def check(self, cases, **settings):
        for case in cases:
            configuration, k, link_speed, psi, *expected = case
            with self.subTest(case=case):
                config = SsmConfig(configuration=configuration, **settings)
                d_C, d_R = calc(config, k, link_speed, psi)
                actual = [
                    d_C,
                    d_R,
                    mut.calc_distance_safety_index(
                        C_dC=config.C_dC, distance=d_C
                    ),
                    mut.calc_distance_safety_index(
                        C_dC=config.C_dC, distance=d_R
                    ),
                ]
                np.testing.assert_allclose(
                    actual, expected, rtol=0.0, atol=5.0e-7
                )

    def test_safe(self):
        self.check(WORKED + WORKED_SAFE)

    def test_literal(self):
        self.check(WORKED + WORKED_LITERAL, literal=True)

    def test_lidar(self):
        self.check(WORKED_LIDAR, C_dC=1.12)

    def test_sm(self):
        for C_dC, d_C_sm, d_R_sm, dsi_C, dsi_R in WORKED_SM:
            config = SsmConfig(
                configuration="sm", C_dC=C_dC, d_C_sm=d_C_sm, d_R_sm=d_R_sm
            )
            # Neither speed nor state matters.
            for k, link_speed, psi in ((0, 0, 2), (3.3, 1.7, 0), (-9, 1, 1)):
                d_C, d_R = calc(config, k, link_speed, psi)
                self.assertEqual((d_C, d_R), (d_C_sm, d_R_sm))
                np.testing.assert_allclose(
                    mut.calc_distance_safety_index(
                        C_dC=C_dC, distance=np.array([d_C, d_R])
                    ),
                    [dsi_C, dsi_R],
                    atol=5.0e-7,
                )

    def test_from_vectors(self):
        k_l, k_o = mut.calc_directed_speeds(
            p_LO=[0.9, 0.4, 0.2], v_WL=[0.6, 0.3, -0.1], v_WO=[-1, 0.2, 0]
        )
        np.testing.assert_allclose(
            [k_l, k_o], [0.636824, 1.452754], atol=5.0e-7
        )
        link_speed = np.linalg.norm([0.6, 0.3, -0.1])
        for configuration, k, expected in (
            ("vo", k_o, [0.955551, 1.721377, 0.098568, 0.030373]),
            ("vr", k_l, [0.712365, 1.073412, 0.177353, 0.078111]),
        ):
            distances = calc(
                SsmConfig(configuration=configuration), k, link_speed, 2
            )
            indices = mut.calc_distance_safety_index(
                C_dC=0.3, distance=np.array(distances)
            )
            np.testing.assert_allclose(
                [*distances, *indices], expected, atol=5.0e-7
            )
        np.testing.assert_allclose(
            mut.calc_distance_safety_index(C_dC=0.3, distance=1.004988),
            0.089109,
            atol=5.0e-7,
        )

    def test_ring(self):
        """The nearest unmasked sensor of a ring of radius 0.08 m."""
        self.assertAlmostEqual(
            float(
                mut.calc_distance_safety_index(C_dC=0.3, distance=0.08 + 0.64)
            ),
            0.173611,
            delta=5.0e-7,
        )


class TestDistances(unittest.TestCase):
    def test_arrays(self):
        """Checks that arrays give what their elements give."""
        config = SsmConfig()
        k, v = np.array([-3.0, 0.0, 2.0]), np.array([0.1, 0.2, 1.5])
        d_C, d_R = calc(config, k, v, np.array([0, 1, 2]))
        for i in range(3):
            self.assertEqual(
                calc(config, k[i], v[i], i),
                (d_C[i], d_R[i]),
            )

    def test_compiled(self):
        """Checks that the compiled functions give what the public ones do."""
        for configuration in ("vo", "vr", "sm"):
            for literal in (False, True):
                config = SsmConfig(configuration=configuration, literal=literal)
                constants = mut.make_distance_constants(config)
                for k in (-9.0, -1.3, 0.4, 9.0):
                    d_C, d_R = calc(config, k, 1.3, 1.0)
                    self.assertEqual(
                        mut.critical_distance(constants, k, 1.3), d_C
                    )
                    self.assertEqual(
                        mut.reduced_distance(constants, k, 1.0, d_C), d_R
                    )

    def test_clear_has_index_zero(self):
        self.assertEqual(
            mut.calc_distance_safety_index(C_dC=0.3, distance=np.inf), 0.0
        )

    def test_index_is_not_clipped(self):
        self.assertAlmostEqual(
            float(mut.calc_distance_safety_index(C_dC=0.3, distance=0.1)), 9.0
        )

    @given(configurations, directed, speeds, states)
    def test_order(self, configuration, k, link_speed, psi):
        """C_dC <= d_C <= d_R for any input."""
        config = SsmConfig(configuration=configuration)
        d_C, d_R = calc(config, k, link_speed, psi)
        self.assertGreaterEqual(d_C, config.C_dC)
        self.assertGreaterEqual(d_R, d_C)

    @given(
        configurations,
        st.booleans(),
        directed,
        directed,
        speeds,
        speeds,
        states,
    )
    def test_monotonic(self, configuration, literal, k0, k1, v0, v1, psi):
        """Faster closing, a faster link, a slower state: never nearer."""
        config = SsmConfig(configuration=configuration, literal=literal)
        k0, k1 = sorted((k0, k1))
        v0, v1 = sorted((v0, v1))
        less = calc(config, k0, v0, 2)
        more = calc(config, k1, v1, psi)
        self.assertLessEqual(less[0], more[0])
        self.assertLessEqual(less[1], more[1] + 1e-15)

    @given(st.sampled_from(("vo", "vr")), directed, speeds, states)
    def test_literal_differs_only_where_it_must(
        self, configuration, k, link_speed, psi
    ):
        safe = calc(SsmConfig(configuration=configuration), k, link_speed, psi)
        literal = calc(
            SsmConfig(configuration=configuration, literal=True),
            k,
            link_speed,
            psi,
        )
        self.assertEqual(safe[0], max(literal[0], 0.3))
        if literal[0] >= 0.3:
            self.assertEqual(safe[1], max(literal[1], literal[0]))

    def test_where_literal_reduced_falls_below_critical(self):
        for configuration, k in (("vo", -1.1), ("vr", -0.17 / 0.3)):
            config = SsmConfig(configuration=configuration, literal=True)
            d_C, d_R = calc(config, k + 1e-6, 1.0, 2)
            self.assertGreater(d_R, d_C)
            d_C, d_R = calc(config, k - 1e-6, 1.0, 2)
            self.assertLess(d_R, d_C)

    def test_saturation(self):
        for configuration, k_max in (("vo", 3.3), ("vr", 1.7)):
            config = SsmConfig(configuration=configuration)
            for sign in (-1, 1):
                self.assertEqual(
                    calc(config, sign * 100.0, 1.0, 2),
                    calc(config, sign * k_max, 1.0, 2),
                )

    @given(
        st.lists(st.floats(-2, 2), min_size=9, max_size=9),
        st.floats(0.05, 3.0),
    )
    def test_directed_speed_is_the_closing_speed(self, numbers, distance):
        """Checks against the numeric derivative of the distance."""
        u, v_WL, v_WO = np.reshape(numbers, (3, 3))
        if np.linalg.norm(u) < 0.1:
            u = np.array([0.0, 0.0, 1.0])
        p_LO = distance * u / np.linalg.norm(u)
        k_l, k_o = mut.calc_directed_speeds(p_LO=p_LO, v_WL=v_WL, v_WO=v_WO)
        dt = 1e-6
        for k, v in ((k_l, v_WL), (k_o, v_WL - v_WO)):
            closing = (
                np.linalg.norm(p_LO + v * dt) - np.linalg.norm(p_LO - v * dt)
            ) / (2.0 * dt)
            self.assertAlmostEqual(float(k), closing, delta=1e-6)


class TestAgainstTheStandard(unittest.TestCase):
    def test_shortfall(self):
        """The figures of docs/safety_law.md: S_p of ISO/TS 15066 less d_C."""
        v_r = np.array([0.0, 0.5, 0.85, 1.0, 1.7])
        v_h, T_R, T_S, C = 1.6, 0.1, 0.4, 0.3
        S_p = v_h * (T_R + T_S) + v_r * T_R + v_r * T_S / 2.0 + C
        np.testing.assert_allclose(S_p, [1.1, 1.25, 1.355, 1.4, 1.61])
        for configuration, k, shortfall in (
            ("vo", v_h + v_r, [0.115, 0.165, 0.200, 0.215, 0.145]),
            ("vr", v_r, [0.515, 0.565, 0.600, 0.615, 0.545]),
            ("sm", v_r, [0.600, 0.750, 0.855, 0.900, 1.110]),
        ):
            d_C = mut.calc_critical_distance(
                config=SsmConfig(configuration=configuration),
                k=k,
                link_speed=v_r,
            )
            np.testing.assert_allclose(S_p - d_C, shortfall)
