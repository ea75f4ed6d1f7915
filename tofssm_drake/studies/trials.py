"""The trials of a campaign: who walks how, in every cell alike.

Trials are paired: trial n is the same person on the same way in every cell, so
that cells are compared person by person.
"""

import dataclasses as dc

import numpy as np


@dc.dataclass(frozen=True, kw_only=True)
class Trial:
    """One person on one path, and the seed of the sensors' errors.

    The seed determines everything, see `make_trial`.
    """

    number: int
    """From 1."""
    seed: int
    """Also the seed of the sensors' errors."""
    speed: float
    """Walking speed, m/s."""
    stature: float
    """Standing height, m."""
    start: float
    """Where on the figure of eight the person starts, fraction of a round."""
    reverse: bool
    """Whether the person walks the other way round."""
    centre: tuple[float, float]
    """Where the lobes cross, m from where the scenario has it."""
    half_length: float
    """Of the figure of eight, as a factor to the scenario's."""
    half_width: float
    """Likewise."""


def make_trial(campaign_seed: int, number: int) -> Trial:
    """Draws a trial. *Assumed*: how much people differ.

    Speeds are from 1.0 to 1.4 m/s, statures from 1.60 to 1.90 m, the path is
    shifted by up to 0.1 m in x and y and up to 5 % longer and wider or
    shorter and narrower than the scenario's.

    Args:
        campaign_seed: Seed of the campaign.
        number: Which trial, from 1. The same whatever the number of trials.
    """
    seed = int(
        np.random.SeedSequence((campaign_seed, number)).generate_state(1)[0]
    )
    rng = np.random.default_rng(seed)
    return Trial(
        number=number,
        seed=seed,
        speed=float(rng.uniform(1.0, 1.4)),
        stature=float(rng.uniform(1.6, 1.9)),
        start=float(rng.uniform(0.0, 1.0)),
        reverse=bool(rng.integers(2)),
        centre=tuple(rng.uniform(-0.1, 0.1, 2).tolist()),
        half_length=float(rng.uniform(0.95, 1.05)),
        half_width=float(rng.uniform(0.95, 1.05)),
    )
