"""Same seed, same bytes."""

import functools

import numpy as np
import pytest

from tofssm_drake.diagrams.scenario import load_scenario
from tofssm_drake.diagrams.simulation import Run
from tofssm_drake.diagrams.workcell import make_workcell
from tofssm_drake.recording.samples import read_samples, write_samples

# The person starts close by, so that the rings have something to measure.
_TEXT = """
simulation_duration: 1.0
people: {visitor: {figure_eight: {start: 0.0}}}
"""


@functools.cache
def run_once(seed, again=False):
    scenario = load_scenario(text=f"{_TEXT}\nrandom_seed: {seed}\n")
    run = Run(workcell=make_workcell(scenario), scenario=scenario)
    progress = [run.advance()]
    while not progress[-1].finished:
        progress.append(run.advance())
    return run.make_samples(), progress


def get_bytes(samples, folder):
    write_samples(samples, folder)
    read = read_samples(folder)
    values = {name: v.tobytes() for name, v in read.column.items()}
    reasons = values.pop("reason")
    assert reasons
    values["reason"] = list(read["reason"])
    for ring, scan in read.scan.items():
        values |= {f"{ring} {name}": v.tobytes() for name, v in scan.items()}
    return values


def test_same_seed_same_bytes(tmp_path):
    values = []
    for again in (False, True):
        folder = tmp_path / str(again)
        folder.mkdir()
        values.append(get_bytes(run_once(3, again)[0], folder))
        values[-1]["file"] = (folder / "samples.parquet").read_bytes()
    assert list(values[0]) == list(values[1])
    for name in values[0]:
        assert values[0][name] == values[1][name], name


def test_another_seed_another_measurement():
    one, other = run_once(3)[0], run_once(4)[0]
    for ring in ("base", "elbow", "tool"):
        a, b = one.scan[ring]["distance"], other.scan[ring]["distance"]
        seen = np.isfinite(a) & np.isfinite(b)
        assert seen.any()
        assert (a[seen] != b[seen]).mean() > 0.5
    assert any(
        not np.array_equal(one[name], other[name], equal_nan=True)
        for name in one.column
        if name.endswith("measured_distance")
    )
    # The person does not depend on the seed.
    np.testing.assert_array_equal(one["person_x"], other["person_x"])


def test_progress():
    samples, progress = run_once(3)
    times = [p.time for p in progress]
    np.testing.assert_allclose(times, [0.2, 0.4, 0.6, 0.8, 1.0])
    assert [p.finished for p in progress] == [False] * 4 + [True]
    # Without the first step, which loads or compiles the kernels.
    assert progress[-1].real_time_factor == pytest.approx(
        0.8 / (progress[-1].wall_time - progress[0].wall_time)
    )
    assert progress[0].real_time_factor == pytest.approx(
        0.2 / progress[0].wall_time
    )
    np.testing.assert_allclose(
        np.diff(samples["t"]), 0.008, rtol=0.0, atol=1e-9
    )
    assert len(samples) == 126
