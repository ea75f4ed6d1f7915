import dataclasses as dc
import math
import unittest

from pydrake.common.yaml import yaml_load_typed

from tofssm_drake.errors import UserError
import tofssm_drake.laws.config as mut


class TestSsmConfig(unittest.TestCase):
    def test_defaults_are_the_papers_table(self):
        dut = mut.SsmConfig()
        dut.check("law")
        self.assertEqual(
            [dut.T_red, dut.T_stop, dut.T_R, dut.V_lmax],
            [0.4, 0.4, 0.1, 1.7],
        )
        self.assertEqual([dut.C_dC, dut.B_min], [0.3, 0.2])
        self.assertEqual([dut.d_C_sm, dut.d_R_sm], [0.5, 1.1])
        self.assertEqual([dut.alpha_I, dut.alpha_D], [0.3, 0.8])
        self.assertEqual(dut.k_omax, 3.3)
        self.assertEqual(dut.k_lmax, dut.V_lmax)
        self.assertFalse(dut.literal)

    def test_k_max(self):
        self.assertEqual(mut.SsmConfig(configuration="vo").k_max(), 3.3)
        self.assertEqual(mut.SsmConfig(configuration="vr").k_max(), 1.7)

    def test_yaml(self):
        dut = yaml_load_typed(
            schema=mut.SsmConfig,
            data="{configuration: sm, literal: true, C_dC: 1.12}",
            defaults=mut.SsmConfig(),
        )
        self.assertEqual(
            dut,
            mut.SsmConfig(configuration="sm", literal=True, C_dC=1.12),
        )

    def test_rejects(self):
        """Checks that each mistake is reported in one line with its place."""
        for change, said in (
            (
                {"configuration": "Vo"},
                r"^here\.configuration: 'Vo' is unknown, use one of vo, vr, sm",
            ),
            (
                {"T_R": -0.1},
                r"^here\.T_R: -0\.1 must be at least 0 and at most 10 s$",
            ),
            (
                {"B_min": math.nan},
                r"^here\.B_min: nan must be at least 0 and at most 100 m$",
            ),
            ({"d_R_sm": 0.4}, r"^here\.d_R_sm: 0\.4 must be at least d_C_sm"),
            ({"d_R_sm": math.inf}, r"^here\.d_R_sm: inf must"),
            ({"alpha_I": 0.0}, r"^here\.alpha_I: 0\.0 must be above 0"),
            ({"alpha_D": 1.01}, r"^here\.alpha_D: 1\.01 must be above 0"),
            ({"rho_reduced": 1.0}, r"^here\.rho_reduced: 1\.0 must be between"),
        ):
            with self.subTest(change), self.assertRaisesRegex(UserError, said):
                dc.replace(mut.SsmConfig(), **change).check("here")

    def test_rejects_what_must_be_positive(self):
        others = {
            "configuration",
            "literal",
            "T_R",
            "B_min",
            "d_R_sm",
            "alpha_I",
            "alpha_D",
            "rho_reduced",
        }
        for field in dc.fields(mut.SsmConfig):
            if field.name in others:
                continue
            for value in (0.0, -1.0, math.nan, math.inf):
                with (
                    self.subTest(field.name, value=value),
                    self.assertRaisesRegex(
                        UserError,
                        rf"^here\.{field.name}: .*(greater than 0|out of ra)",
                    ),
                ):
                    dc.replace(mut.SsmConfig(), **{field.name: value}).check(
                        "here"
                    )
