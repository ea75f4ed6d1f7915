"""Seeds and a few thousand mutations of each; `make fuzz` has many more."""

import random

from parsers import PARSERS, SEEDS
import pytest

_MUTATIONS = 300


def mutate(dice, data):
    """Returns bytes that differ in a few places."""
    changed = bytearray(data)
    for _ in range(dice.randint(1, 4)):
        at = dice.randrange(len(changed) + 1)
        kind = dice.randrange(4)
        if kind == 0 and at < len(changed):
            changed[at] ^= 1 << dice.randrange(8)
        elif kind == 1:
            changed[at:at] = dice.randbytes(dice.randint(1, 4))
        elif kind == 2:
            del changed[at : at + dice.randint(1, 8)]
        else:
            start = dice.randrange(len(changed) + 1)
            changed[at:at] = changed[start : start + dice.randint(1, 30)]
    return bytes(changed)


@pytest.mark.parametrize("name", PARSERS)
def test_parser(name):
    dice = random.Random(name)
    for seed in SEEDS[name]:
        PARSERS[name](seed)
        if len(seed) > 50_000:
            continue
        for _ in range(_MUTATIONS):
            PARSERS[name](mutate(dice, seed))


def test_every_parser_has_seeds():
    assert SEEDS.keys() == PARSERS.keys()
