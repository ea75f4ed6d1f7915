"""What a law says of itself, as a record keeps it."""

import ast
import json
from pathlib import Path
import unittest

from tofssm_drake.laws.config import CONFIGURATIONS
import tofssm_drake.laws.law as mut
from tofssm_drake.laws.tri_ssm_law import TriSsm
from tofssm_drake.messages import LinkSignal
from tofssm_drake.recording.samples import Samples

# How a record of before laws described their signals is read.
_ALLOWED = {"samples.py": {"d_C", "d_R"}}


class TestDescribeLaw(unittest.TestCase):
    def test_plain_values_give_the_signals_again(self):
        for configuration in CONFIGURATIONS:
            law = TriSsm(configuration=configuration)
            words = json.loads(json.dumps(mut.describe_law(law)))
            samples = Samples(column={}, metadata={"law": words})
            self.assertEqual(samples.signals, law.traits.signals)
            self.assertEqual(samples.find_bound("stop"), "d_C")
            self.assertEqual(samples.find_bound("slow"), "d_R")
            self.assertEqual(words["kind"], "TriSsm")

    def test_law_without_words(self):
        class Law:
            traits = mut.LawTraits(signals={"x": LinkSignal(unit="m")})

        words = mut.describe_law(Law())
        samples = Samples(column={}, metadata={"law": words})
        self.assertEqual(samples.find_bound("stop"), "")
        self.assertEqual(words["title"], "")


class TestWhoKnowsTheLaw(unittest.TestCase):
    """Record, report and display know the decision message, no law."""

    def test_no_word_of_the_default_law_or_its_cell(self):
        words = {"TriSsm", "psi", "base", "elbow", "tool"}
        words |= set(TriSsm().traits.signals)
        root = Path(__file__).parents[2] / "tofssm_drake"
        for room in ("recording", "reports"):
            for path in (root / room).glob("*.py"):
                with self.subTest(file=path.name):
                    found = words & find_strings(path)
                    self.assertEqual(found, _ALLOWED.get(path.name, set()))


def find_strings(path):
    return {
        node.value
        for node in ast.walk(ast.parse(path.read_text("utf-8")))
        if isinstance(node, ast.Constant) and isinstance(node.value, str)
    }
