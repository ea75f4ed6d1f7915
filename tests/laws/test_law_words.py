"""What a law says of itself, as a record keeps it."""

import json
import unittest

from tofssm_drake.laws.config import CONFIGURATIONS
import tofssm_drake.laws.law as mut
from tofssm_drake.laws.tri_ssm_law import TriSsm
from tofssm_drake.messages import LinkSignal
from tofssm_drake.recording.samples import Samples


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
