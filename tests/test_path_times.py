import numpy as np

import tofssm_drake.path_times as mut


def test_a_short_path_is_looked_at_step_by_step():
    np.testing.assert_allclose(
        mut.list_times(0.35, step=0.1, most=4), [0.0, 0.1, 0.2, 0.3]
    )


def test_a_long_path_costs_no_more():
    """A robot without a task has a path of 1e6 s."""
    times = mut.list_times(1e6, step=0.1, most=2000)
    assert len(times) == 2000
    assert 0.0 <= times.min() < 1e3
    assert 1e6 - 1e3 < times.max() < 1e6
    # Rounds of 10 s are seen in every part, not always in the same.
    part, _ = np.histogram(times % 10.0, bins=10, range=(0.0, 10.0))
    assert part.min() > 100
