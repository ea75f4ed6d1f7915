import numpy as np

from tofssm_drake.diagrams.scenario import load_scenario
from tofssm_drake.diagrams.simulation import Run
from tofssm_drake.diagrams.workcell import make_workcell
import tofssm_drake.metrics.task_progress as mut

_CELL = (
    "{people: {}, simulation_duration: 20.0, task: !Waypoints {rounds: 2, "
    "waypoints: [{joints: [0, -1.5, 1.5, -1.5, -1.5, 0]}, "
    "{joints: [0.3, -1.5, 1.5, -1.5, -1.5, 0], dwell: 0.1}]}}"
)


def test_words():
    ten = mut.TaskSteps(step="product placed", steps=10)
    assert ten.describe(0) == "no products placed"
    assert ten.describe(1) == "1 product placed"
    assert ten.describe(3, with_total=True) == "3 of 10 products placed"
    assert ten.tell(3) == "3 of 10 products were placed"
    assert ten.tell(10) == "All 10 products were placed"
    one = mut.TaskSteps(step="waypoint reached", steps=1)
    assert one.tell(0) == "0 of 1 waypoint was reached"
    assert one.tell(1) == "The waypoint was reached"
    assert mut.TaskSteps().describe(0) == ""


def test_records_of_before_count_products():
    assert mut.read_task_steps({"products": 3}) == mut.TaskSteps(
        step="product placed", steps=3
    )
    assert mut.read_task_steps({"products": 0}) == mut.TaskSteps()


def test_path_time_by_hand():
    t = 0.1 * np.arange(5)
    np.testing.assert_allclose(
        mut.calc_path_time(t, np.array([1.0, 1.0, 0.0, 2.0, 1.0])),
        [0.0, 0.05, 0.15, 0.2, 0.25],
    )
    assert len(mut.calc_path_time(np.empty(0), np.empty(0))) == 0


def test_record_counts_waypoints_as_the_program_does():
    scenario = load_scenario(text=_CELL)
    run = Run(workcell=make_workcell(scenario), scenario=scenario)
    progress = run.advance()
    counts = {progress.steps_done}
    while not progress.finished:
        progress = run.advance()
        counts.add(progress.steps_done)
    samples = run.make_samples()
    steps = mut.read_task_steps(samples.metadata)
    assert steps == mut.TaskSteps(step="waypoint reached", steps=4)
    done = mut.count_steps(samples)
    assert done[0] == 0
    assert done[-1] == progress.steps_done == 4
    assert len(counts) > 2
    s = mut.calc_path_time(samples["t"], samples["speed_fraction"])
    assert s[-1] >= samples.metadata["task"]["step_time"][-1] - 1e-6
