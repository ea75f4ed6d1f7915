import dataclasses as dc
import unittest

import numpy as np
from pydrake.common.yaml import yaml_load_typed
import yaml

import tofssm_drake.diagrams.yaml_check as mut
from tofssm_drake.errors import UserError


@dc.dataclass(kw_only=True)
class _Walk:
    speed: float = 1.2


@dc.dataclass(kw_only=True)
class _Nobody:
    pass


@dc.dataclass(kw_only=True)
class _Cell:
    name: str = "cell"
    sensors: int = 8
    enabled: bool = True
    center: list[float] = dc.field(default_factory=lambda: [0.0, 0.0])
    matrix: np.ndarray = dc.field(default_factory=lambda: np.zeros(2))
    limits: dict[str, float] = dc.field(default_factory=dict)
    height: float | None = None
    human: _Walk | _Nobody = dc.field(default_factory=_Walk)


def _check(text):
    node = mut.parse_yaml(text, "cell.yaml")
    mut.check_yaml(node, _Cell, "cell.yaml")


class TestCheckYaml(unittest.TestCase):
    def test_good_documents_pass_here_and_in_drake(self):
        for text in (
            "{}",
            "sensors: 16",
            "{center: [1, 2.5], limits: {a: 1}, height: null}",
            "{height: 2, matrix: [1, 2]}",
            "human: !_Nobody {}",
            "human: {speed: 1}",
            "human: !_Walk {speed: 1.5}",
            "human: !_Nobody {}",
            "{height: 1e-3, limits: {a: 1E5}, matrix: [[1, 2], [3, 4]]}",
            "{height: -0.5, sensors: +12, center: [.5, 1.]}",
            "{height: 0, sensors: 0, center: [-1.5e+3, 2.E-3]}",
            "{name: '3'}",
        ):
            with self.subTest(text=text):
                _check(text)
                yaml_load_typed(schema=_Cell, data=text, defaults=_Cell())

    def test_an_empty_document_has_no_settings(self):
        _check("")
        _check("# nothing but a comment")

    def test_bad_documents_are_reported_with_line_path_and_remedy(self):
        for text, message in (
            ("sensor: 8", "cell.yaml:1: sensor: unknown key; did you mean"),
            ("name: a\nzzz: 8", "cell.yaml:2: zzz: unknown key; known keys:"),
            ("sensors: 8.5", "cell.yaml:1: sensors: must be a whole number"),
            ("sensors: eight", "must be a whole number, not 'eight'"),
            ("enabled: 1", "enabled: must be true or false, not '1'"),
            ("center: 3", "center: must be a list"),
            (
                "center: [1, b]",
                r"center\[1\]: must be a finite number, not 'b'",
            ),
            ("limits: {a: b}", "limits.a: must be a finite number"),
            ("limits: 3", "limits: must be a mapping"),
            ("human: {sped: 1}", "human.sped: unknown key; did you mean"),
            ("human: !Robot {}", "unknown kind !Robot; one of !_Walk, !_Nob"),
            ("human: !_Nobody {speed: 1}", "human.speed: unknown key"),
            ("height: .nan", "height: must be a finite number, not '.nan'"),
            ("height: -.inf", "height: must be a finite number"),
            ("height: nan", "height: must be a finite number"),
            ("height: 1.0e+999", "height: must be a finite number"),
            ("height: 1" + 400 * "0", "height: must be a finite number"),
            ("height: '1.0'", "height: must be a finite number"),
            ("center: [1, .inf]", r"center\[1\]: must be a finite number"),
            ("matrix: [1, .nan]", r"matrix\[1\]: must be a finite number"),
            ("matrix: [[1, a]]", r"matrix\[0\]\[1\]: must be a finite"),
            ("human: {kind: Robot}", "unknown kind !Robot"),
            ("human: {kind: _Nobody, speed: 1}", "human.speed: unknown key"),
            ("sensors: !Many 3", "sensors: takes no kind, but has !Many"),
            ("kind: Cell", "scenario: takes no kind"),
            ("human: 3", "human: must be a mapping"),
            ("name: [1]", "name: must be text, not a mapping or list"),
            ("[1, 2]", "cell.yaml:1: must be a mapping"),
            ("a: [", "cell.yaml:1: not YAML"),
            ("\tx: 1", "cell.yaml:1: not YAML"),
            ("a: \x00", "cell.yaml: not YAML"),
            (
                "name: a\nheight: 1\nname: b",
                "cell.yaml:3: name: appears twice, first in line 1",
            ),
            (
                "human: !_Walk\n  speed: 1\n  speed: 2",
                "cell.yaml:3: human.speed: appears twice, first in line 2",
            ),
            ("{human: {kind: _Walk, kind: _Nobody}}", "kind: appears twice"),
            ("? [1, 2]\n: 3", "cell.yaml:1: a key must be a word"),
            ("? {a: 1}\n: 3", "cell.yaml:1: a key must be a word"),
            ("limits: {? [1] : 3}", "a key must be a word, not a mapping"),
            ("a: &a {b: *a}", "cell.yaml:1: a.b: must not contain itself"),
            ("a: &a {<<: *a}", "cell.yaml:1: a.<<: must not contain itself"),
            ("a: &a [1, *a]", r"cell.yaml:1: a\[1\]: must not contain itself"),
            ("<<: 3", "cell.yaml:1: <<: must name mappings to merge"),
            ("human: {<<: [1]}", "<<: must name mappings to merge"),
            (
                "sensors: 010",
                "plain decimals, not '010', which YAML reads as 8",
            ),
            ("sensors: -010", "'-010', which YAML reads as -8"),
            ("sensors: 0x10", "'0x10', which YAML reads as 16"),
            ("sensors: 0b11", "'0b11', which YAML reads as 3"),
            ("sensors: 1:30", "'1:30', which YAML reads as 90"),
            ("height: 010", "height: must be a finite number in plain deci"),
            ("height: 1:30", "'1:30', which YAML reads as 90"),
            ("height: 1:30.5", "'1:30.5', which YAML reads as 90.5"),
            ("center: [1, 1:30]", r"center\[1\]: must be a finite number in"),
            ("name: 3", "cell.yaml:1: name: must be text, not '3'; write it"),
            ("name: 1.5", "name: must be text, not '1.5'; write it in quotes"),
            ("name: no", "name: must be text, not 'no'; write it in quotes"),
            ("name: 2020-01-01", "name: must be text, not '2020-01-01'"),
        ):
            with self.subTest(text=text):
                with self.assertRaisesRegex(UserError, message) as context:
                    _check(text)
                self.assertNotIn("\n", str(context.exception))

    def test_a_key_kind_is_a_tag(self):
        for text in (
            "human: {kind: _Nobody}",
            '{"human": {"kind": "_Nobody"}}',
            "human: !_Nobody {}",
        ):
            with self.subTest(text=text):
                node = mut.parse_yaml(text, "x")
                mut.check_yaml(node, _Cell, "x")
                cell = yaml_load_typed(schema=_Cell, data=yaml.serialize(node))
                self.assertEqual(cell.human, _Nobody())

    def test_a_text_is_bounded(self):
        """What would take minutes, or all the memory, is one line."""
        doubled = "".join(
            f"a{i}: &a{i} [*a{i - 1}, *a{i - 1}]\n" for i in range(1, 60)
        )
        merged = "".join(
            f"a{i}: &a{i} {{<<: [*a{i - 1}, *a{i - 1}]}}\n"
            for i in range(1, 28)
        )
        for text, problem in (
            ("a0: &a0 [1]\n" + doubled, "x:14: a13: stands for more than"),
            ("a0: &a0 {b: 1}\n" + merged, "x:14: a13.<<: stands for more than"),
            ("a: " + "[" * 1500 + "]" * 1500, "x:1: nested deeper than 50"),
            ("{a: " * 1500 + "}" * 1500, "x:1: nested deeper than 50"),
            (
                "\n".join(" " * i + "a:" for i in range(100)),
                "x:51: nested deeper than 50",
            ),
            ("? " * 1500, "x:1: nested deeper than 50"),
            ("a: [" + "0," * 100_000 + "]", "x:1: more than 20000 values"),
            ("a: [" + "0," * 1_000_000 + "]", "x: is longer than 1000000 ch"),
            ("a: &a [*a]", "x:1: a[0]: must not contain itself"),
        ):
            with self.subTest(text=text[:20]):
                with self.assertRaises(UserError) as caught:
                    mut.parse_yaml(text, "x")
                self.assertIn(problem, str(caught.exception))

    def test_aliases_are_followed(self):
        lines = ["a0: &a0 [1]"]
        lines += [f"a{i}: &a{i} [*a{i - 1}, *a{i - 1}]" for i in range(1, 9)]
        node = mut.parse_yaml("\n".join(lines), "x")
        self.assertEqual(len(mut.get_children(node)), 9)

    def test_a_merged_key_may_be_set_again(self):
        text = "{a: &a {speed: 1.0}, human: {<<: *a, speed: 2.0}}"
        human = mut.get_children(mut.parse_yaml(text, "x"))["human"]
        self.assertEqual(mut.get_children(human)["speed"].value, "2.0")

    def test_merged_keys_are_checked_too(self):
        text = "base: &base {sped: 1}\nhuman:\n  <<: *base\n"
        node = mut.get_children(mut.parse_yaml(text, "x"))["human"]
        with self.assertRaisesRegex(UserError, "sped"):
            mut.check_yaml(node, _Walk, "x")
